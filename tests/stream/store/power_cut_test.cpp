/// Nothing is noted as done, or takes its name, before it is on the disk: a power cut finds no more than a kill does.
#include <gtest/gtest.h>

#include <filesystem>
#include <set>

#include "memory_cloud.h"
#include "stream/base/file.h"
#include "stream/store/layer.h"
#include "tests/support/sync_watch.h"

namespace chiaro::stream {
namespace {

namespace fs = std::filesystem;

std::set<std::string> not_synced(const SyncWatch& watch, const fs::path& path) {
  std::set<std::string> names;
  const auto look_at = [&](const fs::path& file) {
    if (!watch.is_synced(file)) names.insert(file.filename().string());
  };
  if (!fs::is_directory(path)) look_at(path);
  else
    for (const auto& entry : fs::recursive_directory_iterator(path))
      if (entry.is_regular_file()) look_at(entry.path());
  return names;
}

TEST(PowerCut, ABuildNotesAPhaseOnceItsFilesAreOnTheDisk) {
  const ScratchFolder scratch;
  MemoryCloud cloud = sphere_cloud(20000, 1.0, 0.001);
  cloud.colour.assign(cloud.position.size(), {1, 2, 3});
  const fs::path out = scratch.path() / "a.chiaro", part = out.string() + ".part";
  int journals = 0, renames = 0;
  const SyncWatch* watch = nullptr;
  const SyncWatch watching(scratch.path(), [&](const fs::path& from, const fs::path& to) {
    ++renames;
    EXPECT_EQ(not_synced(*watch, from), std::set<std::string>{}) << to;
    if (to.filename() != "journal.json") return;
    ++journals;
    EXPECT_EQ(not_synced(*watch, part), std::set<std::string>{}) << "journal " << journals;
    // What the phase before goes on from is there until this one is noted.
    EXPECT_EQ(fs::exists(part / "spill.bin"), journals <= 2) << "journal " << journals;
    EXPECT_TRUE(fs::exists(part / "colour.bin") || journals == 1) << "journal " << journals;
  });
  watch = &watching;
  BuildOptions options;
  options.chunk_surfels = 512;
  MemoryBudget budget(1 << 28);
  build_store_from(input_of(cloud), out, options, budget, silent_reporter());
  EXPECT_EQ(journals, 5);
  EXPECT_GT(renames, journals + 3);   // leaves, index, manifest, layer, the store itself
}

}  // namespace
}  // namespace chiaro::stream
