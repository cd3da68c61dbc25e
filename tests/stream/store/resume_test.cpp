#include <gtest/gtest.h>
#include <sys/resource.h>

#include <atomic>
#include <csignal>
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

class CancellingReporter : public KillingReporter {
 public:
  CancellingReporter() : KillingReporter(1 << 30) {}
  void progress(std::uint64_t) override { ++calls_; }
  bool cancelled() const override { return calls_ > 8; }

 private:
  std::atomic<int> calls_{0};
};

TEST(Resume, ACancelledBuildStopsAndGoesOnWithLessMemory) {
  const ScratchFolder scratch;
  const MemoryCloud cloud = sphere_cloud(80000, 1.0);
  build(cloud, scratch.path() / "whole.chiaro", 256);
  BuildOptions options;
  options.chunk_surfels = 256;
  MemoryBudget large(1 << 29), small(40 << 20);
  CancellingReporter reporter;
  const fs::path out = scratch.path() / "a.chiaro";
  EXPECT_THROW(build_store_from(input_of(cloud), out, options, large, reporter), Cancelled);
  EXPECT_TRUE(fs::exists(out.string() + ".part/journal.json"));
  build_store_from(input_of(cloud), out, options, small, silent_reporter());
  EXPECT_TRUE(bytes_of(out) == bytes_of(scratch.path() / "whole.chiaro"));
}

// From the named stage on, files cannot grow beyond 64 KiB, as if the disk were full.
class DiskFillsAt : public KillingReporter {
 public:
  explicit DiskFillsAt(std::string stage) : KillingReporter(1 << 30), stage_(std::move(stage)) {
    getrlimit(RLIMIT_FSIZE, &old_);
    handler_ = std::signal(SIGXFSZ, SIG_IGN);
  }
  ~DiskFillsAt() override {
    setrlimit(RLIMIT_FSIZE, &old_);
    std::signal(SIGXFSZ, handler_);
  }
  void begin(std::string_view stage, std::uint64_t, std::string_view) override {
    if (stage != stage_) return;
    struct rlimit limit = old_;
    limit.rlim_cur = 65536;
    setrlimit(RLIMIT_FSIZE, &limit);
  }

 private:
  std::string stage_;
  struct rlimit old_ {};
  void (*handler_)(int) = nullptr;
};

TEST(Resume, ADiskThatFillsUpIsAnErrorAndTheBuildGoesOnLater) {
  const ScratchFolder scratch;
  MemoryCloud cloud = sphere_cloud(20000, 1.0);
  cloud.colour.assign(cloud.position.size(), {1, 2, 3});
  const fs::path out = scratch.path() / "a.chiaro";
  MemoryBudget budget(1 << 29);
  for (const char* stage : {"count points", "distribute points", "sort points", "normals", "radii", "inner levels"}) {
    DiskFillsAt reporter(stage);
    EXPECT_THROW(build_store_from(input_of(cloud), out, {}, budget, reporter), Error) << stage;
    EXPECT_FALSE(fs::exists(out)) << stage;
  }
  EXPECT_EQ(build_store_from(input_of(cloud), out, {}, budget, silent_reporter()).points_stored, 20000u);
  EXPECT_TRUE(verify_store(out, budget, silent_reporter()).problems.empty());
  EXPECT_EQ(budget.used_bytes(), 0u);
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
