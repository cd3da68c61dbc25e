#include "stream/base/heap.h"

#include <gtest/gtest.h>

#include <memory>
#include <vector>

#include "stream/base/budget.h"
#include "stream/base/parallel.h"

namespace chiaro {
namespace {

TEST(Heap, WhatWasFreedBetweenBlocksThatLiveGoesBackToTheSystem) {
#if defined(__SANITIZE_ADDRESS__) || defined(__SANITIZE_THREAD__)
  GTEST_SKIP() << "the sanitizers have an allocator of their own";
#endif
  constexpr std::size_t kBlocks = 4096, kBytes = 32 << 10;   // 128 MiB, in blocks that are no mappings of their own
  std::vector<std::unique_ptr<char[]>> blocks(kBlocks);
  parallel_blocks(kBlocks, 64, [&](std::size_t begin, std::size_t end) {
    for (std::size_t i = begin; i < end; ++i) {
      blocks[i] = std::make_unique<char[]>(kBytes);
      for (std::size_t at = 0; at < kBytes; at += 1024) blocks[i][at] = 1;
    }
  });
  for (std::size_t i = 0; i < kBlocks; ++i)
    if (i % 64 != 63) blocks[i].reset();
  const std::uint64_t before = resident_bytes();
  return_freed_memory();
  EXPECT_LT(resident_bytes() + (64u << 20), before);
}

}  // namespace
}  // namespace chiaro
