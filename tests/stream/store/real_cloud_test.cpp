// Clouds that other programs wrote, through the readers into a store. They lie beside the repository and are not part of it.
#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <cstdlib>
#include <filesystem>

#include "stream/base/file.h"
#include "stream/cloud/point_stream.h"
#include "stream/store/layer.h"
#include "stream/store/octree_build.h"

namespace chiaro::stream {
namespace {

namespace fs = std::filesystem;

fs::path shared_folder() {
  const char* given = std::getenv("CHIARO_SHARED");
  return given ? fs::path(given) : fs::path(CHIARO_SOURCE_DIR) / ".." / "shared";
}

// Builds, verifies, and compares every surfel with the point it came from.
void expect_stored(const fs::path& file) {
  if (!fs::exists(file)) GTEST_SKIP() << file << " is not here";
  const ScratchFolder scratch;
  const fs::path out = scratch.path() / "a.chiaro";
  MemoryBudget budget(1 << 29);
  const Manifest m = build_store({file}, out, {}, budget, silent_reporter());
  EXPECT_THAT(verify_store(out, budget, silent_reporter()).problems, testing::IsEmpty());
  PointBlock all, block;
  const auto reader = open_points(file);
  while (reader->read(block, 65536)) {
    all.position.insert(all.position.end(), block.position.begin(), block.position.end());
    all.colour.insert(all.colour.end(), block.colour.begin(), block.colour.end());
  }
  EXPECT_EQ(m.points_read, all.size());
  const Store store(out);
  EXPECT_EQ(has_layer(store, "input"), reader->schema().has_colour);
  for (const std::uint32_t leaf : store.leaves()) {
    const Chunk c = store.read_chunk(leaf);
    const auto sources = store.read_sources(leaf);
    std::vector<std::array<std::uint16_t, 3>> colours;
    if (reader->schema().has_colour) colours = read_colour(Layer(store, "input"), store, leaf);
    for (std::uint32_t i = 0; i < c.count; ++i) {
      ASSERT_LE((c.surfel(i).position_in_world - all.position[sources[i]]).cwiseAbs().maxCoeff(), 0.501 * c.frame.step);
      ASSERT_TRUE(colours.empty() || colours[i] == all.colour[sources[i]]);
    }
  }
}

TEST(RealCloud, APhotogrammetricPlyWithNormalsIsStored) { expect_stored(shared_folder() / "real/rodin_flash/derived/points_normals.ply"); }
TEST(RealCloud, ALasFileWithColourIsStored) { expect_stored(shared_folder() / "real/clouds/1.2-with-color.las"); }
TEST(RealCloud, APcdFileOfASurveyIsStored) { expect_stored(shared_folder() / "real/clouds/autzen-utm.pcd"); }
TEST(RealCloud, ASparseReconstructionWithOutliersIsStored) { expect_stored(shared_folder() / "real/sceaux/formats/Example_colors.ply"); }

}  // namespace
}  // namespace chiaro::stream
