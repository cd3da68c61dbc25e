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

TEST(UnknownShare, CountsTheLightOfSurfacesThatNoPhotographShows) {
  Transport transport;
  transport.rays = 4;
  transport.sky.assign(3 * kSkyTerms, 0.0f);
  transport.hits = {1, 2, Transport::kSky, 2, 0, 0, 0, 0, Transport::kSky, Transport::kSky, Transport::kSky, Transport::kSky};
  const std::vector<float> radiosity{1, 1, 1, 2, 1, 0, 0.5f, 0.5f, 0};   // sums 3, 3, 1
  const std::vector<std::uint16_t> times_seen{2, 1, 0};
  Stencil stencil;   // surfel 0 meets surfel 1 and twice 2; surfel 1 meets 0 alone
  stencil.weight[0] = 0.5f;
  stencil.index[1] = 1;
  stencil.weight[1] = 0.5f;
  EXPECT_NEAR(unknown_share(transport, stencil, radiosity, times_seen), 2.0 / (3 + 2 + 12), 1e-6);
  stencil.index.fill(2);   // and 2 nothing
  EXPECT_EQ(unknown_share(transport, stencil, radiosity, times_seen), 0);
}

TEST(Thinned, KeepsWholeGroupsFromEverywhere) {
  std::vector<LightSample> samples;
  for (std::uint32_t group = 0; group < 900; ++group)
    for (std::uint32_t k = 0; k < 2 + group % 3; ++k) {
      samples.emplace_back();
      samples.back().group = 7 * group;
      samples.back().photograph = k;
    }
  const std::vector<LightSample> some = thinned(samples, 300);
  std::vector<std::uint32_t> groups;
  for (std::size_t i = 0; i < some.size(); ++i)
    if (i == 0 || some[i].group != some[i - 1].group) {
      groups.push_back(some[i].group / 7);
      EXPECT_EQ(some[i].photograph, 0u);
      EXPECT_TRUE(i == 0 || some[i - 1].photograph == 1 + (some[i - 1].group / 7) % 3);
    }
  EXPECT_EQ(groups.size(), 300u);
  EXPECT_GT(groups.back(), 890u);
  EXPECT_EQ(thinned(samples, 900).size(), samples.size());
  EXPECT_EQ(thinned(samples, 5000).size(), samples.size());
  EXPECT_TRUE(thinned({}, 10).empty());
}

}  // namespace
}  // namespace chiaro::optimize
