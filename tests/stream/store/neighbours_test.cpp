#include "stream/store/neighbours.h"

#include <gtest/gtest.h>

namespace chiaro::stream {
namespace {

TEST(HaloCache, HoldsWhatWasUsedLastUpToItsShareOfTheBudget) {
  MemoryBudget budget(1 << 20);
  std::vector<std::uint32_t> loads;
  const auto load = [&](std::uint32_t chunk) {
    loads.push_back(chunk);
    auto made = std::make_shared<HaloChunk>();
    made->index = chunk;
    return made;
  };
  HaloCache cache(budget, load, [](std::uint32_t) { return std::uint64_t{1000}; }, 3000);
  for (std::uint32_t chunk = 0; chunk < 10; ++chunk) {
    EXPECT_EQ(cache.get(chunk)->index, chunk);
    EXPECT_LE(budget.used_bytes(), 3000u);
  }
  loads.clear();
  for (const std::uint32_t chunk : {9u, 8u, 7u, 6u, 9u, 7u}) cache.get(chunk);
  EXPECT_EQ(loads, (std::vector<std::uint32_t>{6, 9}));   // 6 pushed 9 out, the longest unused, and 9 then 8
  const auto held = cache.get(1);
  for (std::uint32_t chunk = 20; chunk < 30; ++chunk) cache.get(chunk);
  loads.clear();
  EXPECT_EQ(cache.get(1), held) << "what is in use is not pushed out";
  EXPECT_TRUE(loads.empty());
}

}  // namespace
}  // namespace chiaro::stream
