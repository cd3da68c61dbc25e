#include "optimize/light_samples.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <numeric>

namespace chiaro::optimize {
namespace {

std::size_t readings(const std::vector<std::uint16_t>& times_seen, const std::vector<std::uint32_t>& chosen) {
  return std::accumulate(chosen.begin(), chosen.end(), std::size_t{0}, [&](std::size_t sum, std::uint32_t i) { return sum + times_seen[i]; });
}

TEST(ChooseSurfels, TakesThoseSeenOftenEnoughAndNoMoreThanAskedFor) {
  std::vector<std::uint16_t> times_seen(1000);
  for (std::size_t i = 0; i < times_seen.size(); ++i) times_seen[i] = static_cast<std::uint16_t>(i % 4);
  const auto chosen = choose_surfels(times_seen, 2, 300, 1);
  EXPECT_EQ(chosen.size(), 300u);
  EXPECT_TRUE(std::is_sorted(chosen.begin(), chosen.end()));
  for (const std::uint32_t i : chosen) EXPECT_GE(times_seen[i], 2);
  EXPECT_EQ(choose_surfels(times_seen, 2, 3000, 1).size(), 500u);
}

// A thousand photographs that each see a quarter of everything: memory must not follow them.
TEST(ChooseSurfels, TakesFewerWhereEachIsSeenByHundreds) {
  const std::vector<std::uint16_t> times_seen(20000, 250);
  const auto all = choose_surfels(times_seen, 2, 20000, 1), few = choose_surfels(times_seen, 2, 20000, 1, 400000);
  EXPECT_EQ(readings(times_seen, all), 5000000u);
  EXPECT_EQ(readings(times_seen, few), 400000u);
  EXPECT_TRUE(std::includes(all.begin(), all.end(), few.begin(), few.end()));
  EXPECT_EQ(choose_surfels(times_seen, 2, 20000, 1, 10).size(), 1u);
}

}  // namespace
}  // namespace chiaro::optimize
