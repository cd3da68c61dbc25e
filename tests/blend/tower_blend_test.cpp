// Photographs that are the albedo itself, of a rendered scene with known albedo: what visibility, weights and bands alone do to it.
#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <cstdlib>

#include "blend/blend.h"
#include "stream/base/file.h"
#include "stream/photo/camera_files.h"
#include "stream/photo/develop.h"
#include "stream/photo/raster.h"
#include "stream/store/layer.h"
#include "stream/store/octree_build.h"
#include "surfels/gbuffer.h"

namespace chiaro::blend {
namespace {

std::filesystem::path tower_folder() {
  if (const char* shared = std::getenv("CHIARO_SHARED")) return std::filesystem::path(shared) / "scenes" / "tower";
  return std::filesystem::path(CHIARO_SOURCE_DIR) / ".." / "shared" / "scenes" / "tower";
}

float from_half(std::uint16_t bits) {
  const int exponent = bits >> 10 & 31, mantissa = bits & 1023;
  const double value = exponent == 0 ? std::ldexp(mantissa, -24) : std::ldexp(1024 + mantissa, exponent - 25);
  return static_cast<float>(bits >> 15 ? -value : value);
}

/// N x 3 half values of an .npy file.
std::vector<Vec3f> read_truth(const std::filesystem::path& path) {
  const std::string text = read_text(path);
  const std::size_t begin = text.find('\n') + 1;
  std::vector<Vec3f> truth((text.size() - begin) / 6);
  for (std::size_t i = 0; i < truth.size(); ++i)
    for (std::size_t c = 0; c < 3; ++c) {
      const auto at = begin + 6 * i + 2 * c;
      truth[i][static_cast<Eigen::Index>(c)] = from_half(static_cast<std::uint16_t>(static_cast<unsigned char>(text[at]) | static_cast<unsigned char>(text[at + 1]) << 8));
    }
  return truth;
}

void radiance_as_albedo(const std::filesystem::path& radiance, const std::filesystem::path& albedo) {
  const stream::RasterReader in(radiance);
  stream::RasterWriter out(albedo, in.width(), in.height(), {{"r"}, {"g"}, {"b"}, {"sigma"}});
  for (const char* plane : {"r", "g", "b"}) out.write_rows<float>(plane, 0, in.all<float>(plane));
  out.write_rows<float>("sigma", 0, std::vector<float>(static_cast<std::size_t>(in.width()) * static_cast<std::size_t>(in.height()), 0.01f));
  out.commit();
}

TEST(TowerBlend, PureAlbedoPhotographsComeBackWithinASmallError) {
  const std::filesystem::path scene = tower_folder();
  if (!std::filesystem::exists(scene / "project_blend.toml")) GTEST_SKIP() << "no shared scenes at " << scene;
  const ScratchFolder folder;
  MemoryBudget budget(std::uint64_t{1} << 30);
  stream::build_store({scene / "cloud.ply"}, folder.path() / "store.chiaro", {}, budget, silent_reporter());
  const stream::Store store(folder.path() / "store.chiaro");
  std::vector<std::string> notes;
  const auto cameras = stream::read_cameras(scene / "sparse", notes);
  std::vector<BlendPhotograph> photographs;
  for (int k = 0; k < 7; ++k) {
    const std::string stem = "photo_0" + std::to_string(k);
    const stream::Camera* camera = stream::find_camera(cameras, stem + ".exr");
    ASSERT_NE(camera, nullptr);
    BlendPhotograph p{stem, *camera, folder.path() / (stem + "_g"), folder.path() / (stem + "_a"), folder.path() / (stem + "_r")};
    stream::DevelopOptions develop;
    develop.mask = scene / "masks" / (stem + ".png");
    stream::develop(scene / "blend" / (stem + ".exr"), develop, p.radiance, silent_reporter());
    radiance_as_albedo(p.radiance, p.albedo);
    surfels::GBufferOptions gbuffer;
    gbuffer.subpixels = 2;
    surfels::write_gbuffer(store, p.camera, gbuffer, p.gbuffer, budget, silent_reporter());
    photographs.push_back(std::move(p));
  }
  const BlendStats stats = blend(store, photographs, {}, folder.path() / "scratch", budget, silent_reporter());

  const std::vector<Vec3f> truth = read_truth(scene / "truth" / "albedo.npy");
  const stream::Layer layer(store, "albedo");
  std::vector<double> errors;
  for (const std::uint32_t leaf : store.leaves()) {
    const auto sources = store.read_sources(leaf);
    const stream::AlbedoValues values = stream::read_albedo(layer, store, leaf);
    for (std::size_t i = 0; i < sources.size(); ++i)
      if (values.photos[i] > 0) errors.push_back(static_cast<double>(((values.albedo[i] - truth[sources[i]]).cwiseAbs().cwiseQuotient(truth[sources[i]])).mean()));
  }
  ASSERT_EQ(errors.size(), stats.points_seen);
  double mean = 0;
  for (const double e : errors) mean += e / static_cast<double>(errors.size());
  std::sort(errors.begin(), errors.end());
  const double median = errors[errors.size() / 2], seen = static_cast<double>(stats.points_seen) / static_cast<double>(stats.points);
  RecordProperty("mean_percent", std::to_string(100 * mean));
  RecordProperty("median_percent", std::to_string(100 * median));
  std::printf("mean %.3f %%, median %.3f %%, seen %.2f %%\n", 100 * mean, 100 * median, 100 * seen);
  EXPECT_TRUE(mean <= 0.007);
  EXPECT_TRUE(median <= 0.0025);
  EXPECT_GE(seen, 0.45);
}

}  // namespace
}  // namespace chiaro::blend
