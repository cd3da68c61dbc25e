#include "blend/accumulate.h"

#include <gtest/gtest.h>

#include <cmath>

namespace chiaro::blend {
namespace {

Sample sample(float weight, float low, float high, float sigma) { return {weight, sigma, 0, Vec3f::Constant(low), Vec3f::Constant(high)}; }

TEST(Accumulate, TwoPhotographsByHand) {
  Accumulator sum;
  add_sample(sum, sample(1, 0.6f, 0.1f, 0.02f), 2);
  add_sample(sum, sample(3, 0.6f, -0.1f, 0.04f), 2);
  const BlendedSurfel s = resolve(sum, 0.03f);
  EXPECT_NEAR(s.albedo[0], 0.6f + (0.1f - 9 * 0.1f) / 10, 1e-6f);
  EXPECT_EQ(s.photographs, 2);
  const float low = std::hypot(0.02f, 3 * 0.04f) / 4, high = std::hypot(0.02f, 9 * 0.04f) / 10;
  EXPECT_NEAR(s.sigma, std::hypot(std::max(low, high), 0.03f), 1e-6f);
  // another low band: mean 0.55, variance (0.16 + 3 * 0.36) / 4 - 0.55^2 = 0.0075, as good as 16 / 10 readings of equal weight
  Accumulator apart;
  add_sample(apart, sample(1, 0.4f, 0.1f, 0.02f), 2);
  add_sample(apart, sample(3, 0.6f, -0.1f, 0.04f), 2);
  EXPECT_NEAR(resolve(apart, 0.03f).albedo[0], (0.4f + 3 * 0.6f) / 4 + (0.1f - 9 * 0.1f) / 10, 1e-6f);
  EXPECT_NEAR(resolve(apart, 0).sigma, std::sqrt(0.0075f / 0.6f) / 0.55f, 1e-5f);
}

TEST(Accumulate, ThePowerOfOneAndAHalfByHand) {
  Accumulator sum;   // weights 1 and 8 in the high band
  add_sample(sum, sample(1, 0.5f, 0.1f, 0.02f), 1.5f);
  add_sample(sum, sample(4, 0.5f, -0.1f, 0), 1.5f);
  const BlendedSurfel s = resolve(sum, 0);
  EXPECT_NEAR(s.albedo[2], 0.5f + (0.1f - 0.8f) / 9, 1e-6f);
  EXPECT_NEAR(s.sigma, 0.02f / 5, 1e-6f);
}

TEST(Accumulate, ThreeBandsByHand) {
  Accumulator sum;
  std::array<MiddleSum, 1> middle{};
  Sample a = sample(1, 0.6f, 0.1f, 0.02f), b = sample(4, 0.5f, -0.1f, 0.02f);
  a.wider[0].setConstant(0.55f);
  b.wider[0].setConstant(0.45f);
  add_sample(sum, a, 2, middle);
  add_sample(sum, b, 2, middle);
  // weights 1 and 4 in the lowest band, to the power of 1.5 in the middle one, of 2 in the highest
  EXPECT_NEAR(resolve(sum, 0, middle).albedo[1], (0.55f + 4 * 0.45f) / 5 + 0.05f + (0.1f - 16 * 0.1f) / 17, 1e-6f);
  a.wider[0].setConstant(0.5f);   // middle bands of 0.1 and 0.05
  sum = {};
  middle = {};
  add_sample(sum, a, 2, middle);
  add_sample(sum, b, 2, middle);
  EXPECT_NEAR(resolve(sum, 0, middle).albedo[1], (0.5f + 4 * 0.45f) / 5 + (0.1f + 8 * 0.05f) / 9 + (0.1f - 16 * 0.1f) / 17, 1e-6f);
}

TEST(Accumulate, ContradictionShowsInSigma) {
  Accumulator agree, contradict;
  for (const float value : {0.5f, 0.5f, 0.5f}) add_sample(agree, sample(1, value, 0, 0.01f), 2);
  for (const float value : {0.3f, 0.5f, 0.7f}) add_sample(contradict, sample(1, value, 0, 0.01f), 2);
  EXPECT_NEAR(resolve(agree, 0).sigma, 0.01f / std::sqrt(3.0f), 1e-5f);
  // variance of the three 0.08 / 3, of their mean (0.08 / 3) / 2, relative to 0.5
  EXPECT_NEAR(resolve(contradict, 0).sigma, std::sqrt(0.08f / 6) / 0.5f, 1e-4f);
  Accumulator one_counts;   // the second reading has next to no weight: the two are as good as one
  add_sample(one_counts, sample(1, 0.5f, 0, 0.01f), 2);
  add_sample(one_counts, sample(1e-9f, 0.9f, 0, 0.01f), 2);
  EXPECT_NEAR(resolve(one_counts, 0).sigma, 0.01f, 1e-5f);
  Accumulator dark;
  for (int i = 0; i < 3; ++i) add_sample(dark, sample(1, 0, 0, 0.01f), 2);
  EXPECT_TRUE(std::isfinite(resolve(dark, 0).sigma));
}

TEST(Accumulate, ExactReadingsThatDifferAreUncertainButHaveNoNoise) {
  Accumulator sum;
  for (const float value : {0.4f, 0.6f}) add_sample(sum, sample(1, value, 0, 0), 2);
  EXPECT_NEAR(resolve(sum, 0).sigma, 0.2f, 1e-5f);
  EXPECT_EQ(resolve(sum, 0).own_sigma, 0);   // nothing for denoising to take away
}

TEST(Accumulate, WhatPhotographsHaveInCommonDoesNotAverageOut) {
  Accumulator sum;
  for (int k = 0; k < 100; ++k) {
    Sample s = sample(1, 0.5f, 0, 0.1f);
    s.shared = 0.04f;
    add_sample(sum, s, 4);
  }
  EXPECT_NEAR(resolve(sum, 0).sigma, std::hypot(0.01f, 0.04f), 1e-5f);
}

TEST(Accumulate, UnseenIsNaN) {
  const BlendedSurfel s = resolve({}, 0.1f);
  EXPECT_TRUE(std::isnan(s.albedo[1]));
  EXPECT_TRUE(std::isnan(s.sigma));
  EXPECT_EQ(s.photographs, 0);
}

TEST(Accumulate, OnePhotographGivesItsAlbedoBackAtAnyWeight) {
  for (const float weight : {1e-12f, 1e-3f, 1.0f, 1e4f}) {
    Accumulator sum;
    add_sample(sum, sample(weight, 0.42f, 0.0137f, 0.05f), 4);
    EXPECT_NEAR(resolve(sum, 0).sigma, 0.05f, 1e-6f) << weight;
    EXPECT_NEAR(resolve(sum, 0).albedo[2], 0.42f + 0.0137f, 1e-6f) << weight;
  }
}

}  // namespace
}  // namespace chiaro::blend
