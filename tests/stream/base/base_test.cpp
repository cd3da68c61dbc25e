#include <gtest/gtest.h>

#include <array>
#include <atomic>
#include <chrono>
#include <cmath>
#include <future>
#include <optional>
#include <thread>

#include "stream/base/budget.h"
#include "stream/base/error.h"
#include "stream/base/file.h"
#include "stream/base/folder_lock.h"
#include "stream/base/hash.h"
#include "stream/base/parallel.h"
#include "stream/base/rng.h"
#include "stream/base/text.h"

namespace chiaro {
namespace {

TEST(Philox, GivesThePublishedNumbersForCounterZeroKeyZero) {
  const auto r = philox4x32({0, 0, 0, 0}, {0, 0});
  EXPECT_EQ(r, (std::array<std::uint32_t, 4>{0x6627e8d5, 0xe169c58d, 0xbc57ac4c, 0x9b00dbd8}));
}

TEST(Philox, NormalsHaveUnitVariance) {
  double sum = 0, squares = 0;
  constexpr int kCount = 20000;
  for (int i = 0; i < kCount; ++i) {
    const double v = normal01(7, Purpose::kTest, i, 0);
    sum += v;
    squares += v * v;
  }
  EXPECT_NEAR(sum / kCount, 0, 4 / std::sqrt(double{kCount}));              // 4 standard errors
  EXPECT_NEAR(squares / kCount, 1, 4 * std::sqrt(2.0 / kCount));
}

TEST(Crc32c, MatchesTheCheckValueAndChains) {
  EXPECT_EQ(crc32c("123456789", 9), 0xe3069283u);
  EXPECT_EQ(crc32c("6789", 4, crc32c("12345", 5)), 0xe3069283u);
}

TEST(Hasher, DoesNotDependOnHowBytesArrive) {
  const std::string text(100, 'x');
  Hasher whole, pieces;
  whole.add_bytes(text.data(), 100);
  pieces.add_bytes(text.data(), 7);
  pieces.add_bytes(text.data() + 7, 60);
  pieces.add_bytes(text.data() + 67, 33);
  EXPECT_EQ(whole.hex(), pieces.hex());
  EXPECT_NE(whole.hex(), Hasher().add_bytes(text.data(), 99).hex());
}

TEST(MemoryBudget, RefusesWhatDoesNotFitAndSaysSo) {
  MemoryBudget budget(1000);
  const BudgetLease lease(budget, 600, "image");
  EXPECT_FALSE(budget.try_take(401));
  EXPECT_TRUE(budget.try_take(400));
  budget.give(400);
  try {
    budget.take(500, "chunk cache");
    FAIL();
  } catch (const Error& e) {
    EXPECT_NE(std::string(e.what()).find("chunk cache"), std::string::npos);
  }
  EXPECT_EQ(budget.peak_bytes(), 1000u);
}

TEST(ParseBytes, ReadsUnitsAndRefusesNonsense) {
  EXPECT_EQ(parse_bytes("512MiB"), 512u << 20);
  EXPECT_EQ(parse_bytes("2 GiB"), 2ull << 30);
  EXPECT_EQ(parse_bytes("1.5GB"), 1500000000u);
  EXPECT_EQ(parse_bytes("800"), 800u);
  for (const char* bad : {"", "much", "-3GB", "3 parsec", "1e300 TiB", "nan"}) EXPECT_THROW(parse_bytes(bad), UsageError) << bad;
}

TEST(AtomicFile, AppearsOnlyWhenCommitted) {
  const ScratchFolder folder;
  const auto path = folder.path() / "a.txt";
  {
    AtomicFile file(path);
    file.append("half");
  }
  EXPECT_FALSE(std::filesystem::exists(path));
  EXPECT_TRUE(std::filesystem::is_empty(folder.path()));
  write_text(path, "whole");
  EXPECT_EQ(read_text(path), "whole");
  EXPECT_THROW(read_text(path, 3), Error);
}

TEST(File, SaysWhereItEndsEarly) {
  const ScratchFolder folder;
  write_text(folder.path() / "short", "abc");
  const File file(folder.path() / "short", File::Mode::kRead);
  char buffer[8];
  EXPECT_EQ(file.read_some_at(1, buffer, 8), 2u);
  EXPECT_THROW(file.read_at(0, buffer, 8), Error);
  EXPECT_THROW(File(folder.path(), File::Mode::kRead), Error);
}

TEST(Parallel, SumsTheSameBitsForAnyThreadCount) {
  const auto sum = [](int threads) {
    const ThreadLimit limit(threads);
    return deterministic_sum<double>(100000, 1000, 0.0, [](std::size_t b, std::size_t e) {
      double s = 0;
      for (std::size_t i = b; i < e; ++i) s += 1.0 / static_cast<double>(i + 1);
      return s;
    });
  };
  EXPECT_EQ(sum(1), sum(8));
}

TEST(Parallel, SurfacesExceptions) {
  EXPECT_THROW(parallel_blocks(100, 1, [](std::size_t b, std::size_t) { if (b == 57) throw Error("x"); }), Error);
}

TEST(Parallel, APipelineKeepsTheOrderAndItsSlots) {
  for (const int threads : {1, 2, 5}) {
    const ThreadLimit limit(threads);
    constexpr std::size_t kSlots = 3, kItems = 500;
    std::array<std::size_t, kSlots> item{}, made{};
    std::array<bool, kSlots> taken{};
    std::size_t next = 0;
    std::vector<std::size_t> results;
    ordered_pipeline(
        kSlots,
        [&](std::size_t slot) {
          if (next == kItems) return false;
          EXPECT_FALSE(taken[slot]);
          taken[slot] = true;
          item[slot] = next++;
          return true;
        },
        [&](std::size_t slot) {
          for (volatile std::size_t i = 0; i < (item[slot] % 7) * 300; ++i) {}   // some take longer
          made[slot] = item[slot] * item[slot];
        },
        [&](std::size_t slot) {
          results.push_back(made[slot]);
          taken[slot] = false;
        });
    ASSERT_EQ(results.size(), kItems);
    for (std::size_t i = 0; i < kItems; ++i) EXPECT_EQ(results[i], i * i);
  }
}

TEST(Parallel, WhatGoesWrongInAPipelineSurfaces) {
  for (const int where : {0, 1, 2}) {
    std::atomic<std::size_t> next = 0;
    const auto check = [&](int step) {
      if (step == where && next == 40) throw Error("x");
      return true;
    };
    EXPECT_THROW(ordered_pipeline(
                     4, [&](std::size_t) { return ++next <= 40 && check(0); }, [&](std::size_t) { check(1); }, [&](std::size_t) { check(2); }),
                 Error);
  }
}

TEST(FolderLock, HoldsAFolderForOneAtATime) {
  const ScratchFolder scratch;
  {
    EXPECT_FALSE(FolderLock::is_held(scratch.path()));
    FolderLock first(scratch.path());
    EXPECT_TRUE(FolderLock::is_held(scratch.path()));
    EXPECT_THROW(FolderLock(scratch.path()), Error);
    const FolderLock moved = std::move(first);
    EXPECT_THROW(FolderLock(scratch.path()), Error);
  }
  EXPECT_NO_THROW(FolderLock(scratch.path()));
  EXPECT_TRUE(std::filesystem::is_empty(scratch.path()));
}

// As where a build is published while a second one waits for its folder: a third may have begun in a new one of that name.
TEST(FolderLock, OfAFolderThatWasMovedMeanwhileIsNone) {
  const ScratchFolder scratch;
  const std::filesystem::path folder = std::filesystem::canonical(scratch.path()) / "a.part";
  std::filesystem::create_directory(folder);
  const auto times_open = [&] {
    int times = 0;
    for (const auto& fd : std::filesystem::directory_iterator("/proc/self/fd")) {
      std::error_code code;
      times += std::filesystem::read_symlink(fd, code) == folder;
    }
    return times;
  };
  std::optional<FolderLock> first(folder);
  std::future<void> second = std::async(std::launch::async, [&] { FolderLock{folder}; });
  while (times_open() < 2 && second.wait_for(std::chrono::seconds(0)) != std::future_status::ready) std::this_thread::yield();
  std::filesystem::rename(folder, scratch.path() / "a");
  std::filesystem::create_directory(folder);
  first.reset();
  EXPECT_THROW(second.get(), Error);
  EXPECT_FALSE(FolderLock::is_held(folder));
}

TEST(EmptyFolder, RemovesAllButTheFolder) {
  const ScratchFolder scratch;
  std::filesystem::create_directories(scratch.path() / "a/b");
  write_text(scratch.path() / "a/b/file", "x");
  write_text(scratch.path() / ".hidden", "x");
  empty_folder(scratch.path());
  EXPECT_TRUE(std::filesystem::is_empty(scratch.path()));
}

TEST(Text, Utf8IsToldFromOtherBytes) {
  for (const char* good : {"", "plain", "B\xc3\xbcste", "\xe2\x82\xac", "\xed\x9f\xbf", "\xf0\x90\x8d\x88", "\xf4\x8f\xbf\xbf"}) EXPECT_TRUE(is_utf8(good)) << good;
  for (const char* bad : {"B\xfcste", "\xc3", "\xc3z", "\x80", "\xc0\xaf", "\xe0\x80\x80", "\xed\xa0\x80", "\xf0\x80\x80\x80", "\xf4\x90\x80\x80", "\xf5\x80\x80\x80", "\xe2\x82"}) EXPECT_FALSE(is_utf8(bad));
}

}  // namespace
}  // namespace chiaro
