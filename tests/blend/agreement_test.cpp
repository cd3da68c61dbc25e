#include "blend/agreement.h"

#include <gtest/gtest.h>

#include <cmath>

#include "stream/base/rng.h"

namespace chiaro::blend {
namespace {

/// Pairs of photographs in a chain 0-1-2-…, each brighter than the truth by its factor; a share of the second photograph's readings is of something else.
std::vector<ReadingPair> chain(const std::vector<Vec3f>& log_factor, double share_wrong = 0) {
  std::vector<ReadingPair> pairs;
  for (std::uint16_t k = 0; k + 1u < log_factor.size(); ++k)
    for (std::uint32_t i = 0; i < 500; ++i) {
      const auto u = uniform01x4(3, Purpose::kTest, k, i);
      Vec3f difference = log_factor[k + 1u] - log_factor[k] + Vec3f::Constant(0.01f * (u[0] + u[1] - 1));
      if (static_cast<double>(u[2]) < share_wrong) difference += Vec3f::Constant(1 + u[3]);
      pairs.push_back({k, static_cast<std::uint16_t>(k + 1), difference});
    }
  return pairs;
}
std::vector<Vec3f> factors(std::initializer_list<float> values) {
  std::vector<Vec3f> all;
  for (const float v : values) all.push_back(Vec3f::Constant(std::log(v)));
  return all;
}

TEST(Agreement, OnePhotographThatIsOffDoesNotDragTheOthers) {
  const Agreement a = find_agreement(chain(factors({1, 1, 1.3f, 1, 1})), 5, Gain::kGrey);
  for (const std::size_t k : {0u, 1u, 3u, 4u}) EXPECT_EQ(a.log_gain[k], Vec3f(Vec3f::Zero())) << k;
  EXPECT_NEAR(a.log_gain[2][0], -std::log(1.3f), 2e-3f);
  EXPECT_LT(a.scatter, 0.01f);
}

TEST(Agreement, AThirdOfReadingsOfSomethingElseDoesNotChangeAGain) {
  const Agreement a = find_agreement(chain(factors({1, 1, 1.3f, 1, 1}), 0.33), 5, Gain::kGrey);
  EXPECT_NEAR(a.log_gain[2][1], -std::log(1.3f), 5e-3f);
  EXPECT_EQ(a.log_gain[1], Vec3f(Vec3f::Zero()));
}

TEST(Agreement, ChannelsHaveGainsOfTheirOwnWhereAskedFor) {
  std::vector<Vec3f> factor = factors({1, 1, 1});
  factor[0] = Vec3f(0.1f, 0, -0.1f);
  const std::vector<ReadingPair> pairs = chain(factor);
  EXPECT_EQ(find_agreement(pairs, 3, Gain::kGrey).log_gain[0], Vec3f(Vec3f::Zero()));
  EXPECT_EQ(find_agreement(pairs, 3, Gain::kNone).log_gain[0], Vec3f(Vec3f::Zero()));
  const Agreement a = find_agreement(pairs, 3, Gain::kChannels);
  EXPECT_NEAR(a.log_gain[0][0], -0.1f, 2e-3f);
  EXPECT_NEAR(a.log_gain[0][2], 0.1f, 2e-3f);
}

TEST(Agreement, EachGroupOfPhotographsKeepsItsOwnBrightness) {
  std::vector<ReadingPair> pairs = chain(factors({1, 1, 1.2f}));
  for (ReadingPair p : chain(factors({3, 3, 3.6f}))) {
    p.a = static_cast<std::uint16_t>(p.a + 3);
    p.b = static_cast<std::uint16_t>(p.b + 3);
    pairs.push_back(p);
  }
  const Agreement a = find_agreement(pairs, 7, Gain::kGrey);   // the seventh overlaps with none
  EXPECT_NEAR(a.log_gain[2][0], -std::log(1.2f), 2e-3f);
  EXPECT_NEAR(a.log_gain[5][0], -std::log(1.2f), 2e-3f);
  for (const std::size_t k : {0u, 1u, 3u, 4u, 6u}) EXPECT_EQ(a.log_gain[k], Vec3f(Vec3f::Zero())) << k;
}

TEST(Agreement, FactorsWithinTheScatterAreLeftAlone) {
  const Agreement a = find_agreement(chain(factors({1, 1.01f, 1})), 3, Gain::kGrey);
  EXPECT_EQ(a.log_gain[1], Vec3f(Vec3f::Zero()));
  // Half of the readings lie 10 % and more from the others: a factor of 8 % is within that.
  std::vector<ReadingPair> wide = chain(factors({1, 1.08f, 1}));
  for (std::size_t i = 0; i < wide.size(); ++i) wide[i].difference.array() += 0.004f * (static_cast<float>(i * 37 % 101) - 50);   // evenly within 0.2
  const Agreement b = find_agreement(wide, 3, Gain::kGrey);
  EXPECT_NEAR(b.scatter, 0.1f, 0.02f);
  EXPECT_EQ(b.log_gain[1], Vec3f(Vec3f::Zero()));
}

TEST(Agreement, TheDarkSaysNothingOfAFactor) {
  Ballot ballot;
  const auto cast = [&](std::uint16_t k, float value) { cast_vote(ballot, k, {1, 0.01f, 0, Vec3f::Constant(value), Vec3f::Zero()}, 1); };
  cast(0, 0.5f);
  cast(1, 0.6f);
  cast(2, 0.05f);   // below five times the offset
  std::vector<ReadingPair> pairs;
  append_pairs(ballot, pairs);
  ASSERT_EQ(pairs.size(), 1u);
  EXPECT_NEAR(pairs[0].difference[1], std::log(1.2f), 1e-3f);   // of the values, and not of what is added to them in the dark
}

TEST(Agreement, NoPairsNoGains) {
  const Agreement a = find_agreement({}, 2, Gain::kGrey);
  EXPECT_EQ(a.log_gain.size(), 2u);
  EXPECT_EQ(a.log_gain[1], Vec3f(Vec3f::Zero()));
  EXPECT_EQ(a.scatter, 0);
}

ReadingDistances distances(std::array<float, Tolerance::kClasses> medians, std::uint32_t readings = 1000) {
  ReadingDistances d{medians, {}};
  d.readings.fill(readings);
  return d;
}

TEST(Agreement, WhatHasNoVoteMayDifferAsUsualInItsClass) {
  const std::vector<ReadingDistances> usual(5, distances({0.004f, 0.005f, 0.02f, 0.1f, 0.05f}));
  const Tolerance t = tolerance_by_class(0.032f, usual);
  EXPECT_FLOAT_EQ(t.by_class[0], 0.032f);
  EXPECT_FLOAT_EQ(t.by_class[1], 0.032f);          // four medians are less than the votes are allowed
  EXPECT_FLOAT_EQ(t.by_class[2], 0.032f * 2 * std::sqrt(2.0f));   // 0.08, up to the next half octave
  EXPECT_GE(t.by_class[3], 0.4f);
  EXPECT_LE(t.by_class[3], 0.4f * std::sqrt(2.0f));
  EXPECT_FLOAT_EQ(t.by_class[4], t.by_class[3]);   // never less than what weighs more
}

TEST(Agreement, FewReadingsAndTheMinorityOfPhotographsDoNotWiden) {
  EXPECT_EQ(tolerance_by_class(0.032f, std::vector<ReadingDistances>(5, distances({0.1f, 0.1f, 0.1f, 0.1f, 0.1f}, 30))).by_class[4], 0.032f);
  EXPECT_EQ(tolerance_by_class(0.032f, {}).by_class[4], 0.032f);
  std::vector<ReadingDistances> some(5, distances({0.004f, 0.004f, 0.004f, 0.004f, 0.004f}));
  some[1] = some[3] = distances({0.5f, 0.5f, 0.5f, 0.5f, 0.5f});
  EXPECT_EQ(tolerance_by_class(0.032f, some).by_class[4], 0.032f);
}

}  // namespace
}  // namespace chiaro::blend
