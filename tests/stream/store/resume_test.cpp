#include <gtest/gtest.h>

#include <filesystem>
#include <fstream>

#include "memory_cloud.h"
#include "stream/base/error.h"
#include "stream/base/file.h"

namespace chiaro::stream {
namespace {

namespace fs = std::filesystem;

std::map<std::string, std::string> bytes_of(const fs::path& folder) {
  std::map<std::string, std::string> all;
  for (const auto& f : fs::recursive_directory_iterator(folder))
    if (f.is_regular_file()) all[fs::relative(f.path(), folder).string()] = read_text(f.path());
  return all;
}

struct Killed {};

// Throws at the n-th call, as a kill would end the work there.
class KillingReporter : public Reporter {
 public:
  explicit KillingReporter(int calls) : left_(calls) {}
  void begin(std::string_view, std::uint64_t, std::string_view) override { step(); }
  void progress(std::uint64_t) override { step(); }
  void end() override { step(); }
  void note(std::string_view) override {}
  bool cancelled() const override { return false; }
  bool killed() const { return left_ <= 0; }

 private:
  void step() {
    if (--left_ <= 0) throw Killed{};
  }
  std::atomic<int> left_;
};

TEST(Resume, AKilledBuildGoesOnAndEndsWithTheSameBytes) {
  const ScratchFolder scratch;
  MemoryCloud cloud = sphere_cloud(30000, 1.0, 0.001);
  for (std::size_t i = 0; i < cloud.position.size(); ++i) cloud.colour.push_back({static_cast<std::uint16_t>(i), 0, 9});
  const fs::path whole = scratch.path() / "whole.chiaro", out = scratch.path() / "killed.chiaro";
  build(cloud, whole, 512);
  const auto expected = bytes_of(whole);
  BuildOptions options;
  options.chunk_surfels = 512;
  int kills = 0, attempts = 0;
  for (int calls = 1;; calls += 7) {
    KillingReporter reporter(calls);
    MemoryBudget budget(1 << 28);
    ++attempts;
    ASSERT_LT(attempts, 500);
    try {
      build_store_from(input_of(cloud), out, options, budget, reporter);
      break;
    } catch (const Killed&) {
      ++kills;
      EXPECT_FALSE(fs::exists(out));
    }
  }
  EXPECT_GT(kills, 10);
  EXPECT_TRUE(bytes_of(out) == expected);
  EXPECT_FALSE(fs::exists(out.string() + ".part"));
}

TEST(Resume, AnotherInputOrOptionStartsOver) {
  const ScratchFolder scratch;
  const MemoryCloud first = sphere_cloud(5000, 1.0), second = sphere_cloud(6000, 2.0);
  const fs::path out = scratch.path() / "a.chiaro";
  KillingReporter reporter(40);
  MemoryBudget budget(1 << 28);
  BuildOptions options;
  options.chunk_surfels = 256;
  EXPECT_THROW(build_store_from(input_of(first, "first"), out, options, budget, reporter), Killed);
  ASSERT_TRUE(fs::exists(out.string() + ".part"));
  const Manifest m = build_store_from(input_of(second, "second"), out, options, budget, silent_reporter());
  EXPECT_EQ(m.points_stored, 6000u);
  EXPECT_EQ(Store(out).manifest().points_stored, 6000u);
}

TEST(Resume, TheOldStoreStaysReadableUntilTheNewOneIsThere) {
  const ScratchFolder scratch;
  const fs::path out = scratch.path() / "a.chiaro";
  build(sphere_cloud(1000, 1.0), out);
  KillingReporter reporter(15);
  MemoryBudget budget(1 << 28);
  const MemoryCloud second = sphere_cloud(6000, 2.0);
  BuildOptions options;
  options.chunk_surfels = 256;
  EXPECT_THROW(build_store_from(input_of(second, "second"), out, options, budget, reporter), Killed);
  EXPECT_EQ(Store(out).manifest().points_stored, 1000u);
  build_store_from(input_of(second, "second"), out, options, budget, silent_reporter());
  EXPECT_EQ(Store(out).manifest().points_stored, 6000u);
}

TEST(Resume, ADamagedJournalStartsOver) {
  const ScratchFolder scratch;
  const MemoryCloud cloud = sphere_cloud(5000, 1.0);
  const fs::path out = scratch.path() / "a.chiaro";
  BuildOptions options;
  options.chunk_surfels = 256;
  MemoryBudget budget(1 << 28);
  KillingReporter reporter(40);
  EXPECT_THROW(build_store_from(input_of(cloud), out, options, budget, reporter), Killed);
  { std::ofstream(out.string() + ".part/journal.json", std::ios::app) << " "; }
  EXPECT_EQ(build_store_from(input_of(cloud), out, options, budget, silent_reporter()).points_stored, 5000u);
}

}  // namespace
}  // namespace chiaro::stream
