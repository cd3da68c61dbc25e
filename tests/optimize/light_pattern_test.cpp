#include "optimize/light_pattern.h"

#include <gtest/gtest.h>

#include <cmath>

#include "optimize/flash_place.h"
#include "stream/base/rng.h"

namespace chiaro::optimize {
namespace {

constexpr double kCornerSine = 0.8;

/// What is wrong with the photographs.
struct Wrong {
  Vec3d shift = Vec3d::Zero();   ///< of the flash from its said place
  double lens_loss = 0, flash_loss = 0;   ///< in the corners; by other formulas than the program's
  double tilt = 0;               ///< of the flash's intensity, from one side to the other
  double noise = 0.01;
  std::vector<double> brightness{0, 0, 0, 0};   ///< ln of each photograph's
};

/// A rough floor under four flashes beside four cameras that look down at it from above the middle of its parts; camera axes are the world's, turned to look down. Samples hold the flash at its said place and even.
std::vector<LightSample> samples_with(const Wrong& wrong, const Lights& lights) {
  const std::vector<Vec3d> eyes{{0.1, 0.1, 1.2}, {1.2, 0.2, 1.0}, {0.3, 1.1, 0.7}, {0.9, 0.9, 1.5}};
  const Mat3d look_down = Vec3d(1, -1, -1).asDiagonal();
  const Vec3d flash_in_camera(0.15, -0.1, 0.02);
  std::vector<LightSample> samples;
  for (std::uint32_t i = 0; i < 1500; ++i) {
    const auto u = uniform01x4(3, Purpose::kTest, i, 0);
    const Vec3d place(static_cast<double>(u[0]) * 1.5, static_cast<double>(u[1]) * 1.5, 0);
    const Vec3d normal = Vec3d(static_cast<double>(u[2]) - 0.5, static_cast<double>(u[3]) - 0.5, 1).normalized();
    for (std::uint32_t k = 0; k < eyes.size(); ++k) {
      const Vec3d flash = eyes[k] + look_down.transpose() * flash_in_camera, to = flash - place;
      const double cosine = normal.dot(to.normalized());
      if (cosine < 0.1) continue;
      LightSample s;
      s.group = i;
      s.photograph = k;
      s.flash = static_cast<float>(cosine / to.squaredNorm());
      s.flash_by_shift = (look_down * ((normal / cosine - 3 * to.normalized()) / to.norm())).cast<float>();
      const Vec2d seen = off_axis(look_down * (place - eyes[k]), kCornerSine), lit = off_axis(look_down * -to, kCornerSine);
      s.off_axis = seen.cast<float>();
      s.flash_off_axis = lit.cast<float>();
      s.sky[0] = 3;
      const double sends = std::exp(wrong.tilt * lit.x()) * std::pow(1 - wrong.flash_loss, lit.squaredNorm());
      const double keeps = std::pow(1 + (1 / std::sqrt(1 - wrong.lens_loss) - 1) * seen.squaredNorm(), -2);
      const double h = lights.flash_intensity * static_cast<double>(s.flash) * flash_factor(place, normal, flash, flash + look_down.transpose() * wrong.shift) * sends + lights.sky[0] * 3;
      s.radiosity.fill(static_cast<float>(0.4 * h * keeps * std::exp(wrong.brightness[k] + wrong.noise * normal01(4, Purpose::kTest, 10 * i + k, 0))));
      samples.push_back(s);
    }
  }
  return samples;
}

Lights lights() {
  Lights x;
  x.flash_intensity = 10;
  x.sky[0] = 1.2;   // a quarter to a half of the light
  return x;
}

LightPattern pattern_in(const std::vector<LightSample>& samples, const Lights& now, const LightPatternOptions& options = {}, const LightPattern& already = {}) {
  return find_light_pattern(samples, now, already, 2000, options).pattern;
}
LightPattern pattern_of(const Wrong& wrong, const LightPatternOptions& options = {}) { return pattern_in(samples_with(wrong, lights()), lights(), options); }

TEST(LightPattern, AFlashBesideItsPlaceIsFoundAndIsNoFalloff) {
  const Vec3d shift(0.02, -0.01, 0.015);
  const LightPattern found = pattern_of({shift});
  EXPECT_LE((found.flash_shift - shift).norm(), 0.003) << found.flash_shift.transpose();
  EXPECT_TRUE(found.falloff.none());
}

/// With so few independent residuals its information criterion would speak against it.
TEST(LightPattern, ASmallShiftThatTheSamplesHoldIsKept) {
  constexpr double kIndependent = 200;
  const Vec3d shift(0.006, -0.005, 0.005);
  std::vector<LightSample> samples = samples_with({shift}, lights());
  const LightPattern first = find_light_pattern(samples, lights(), {}, kIndependent).pattern;
  EXPECT_LE((first.flash_shift - shift).norm(), 0.002) << first.flash_shift.transpose();
  for (LightSample& s : samples) s.flash *= static_cast<float>(std::exp(s.flash_by_shift.cast<double>().dot(first.flash_shift)));
  const LightPattern again = find_light_pattern(samples, lights(), first, kIndependent).pattern;
  EXPECT_LE((again.flash_shift - first.flash_shift).norm(), 0.001) << again.flash_shift.transpose();
}

TEST(LightPattern, WhatIsRightIsLeftAlone) {
  const LightPattern found = pattern_of({});
  EXPECT_EQ(found.flash_shift.norm(), 0);
  EXPECT_TRUE(found.falloff.none());
}

TEST(LightPattern, LightsThatAreALittleOffDoNotPassForOne) {
  Lights off = lights();
  off.flash_intensity *= 1.05;
  off.sky[0] *= 0.9;
  const LightPattern found = pattern_in(samples_with({}, lights()), off);
  EXPECT_EQ(found.flash_shift.norm(), 0);
  EXPECT_TRUE(found.falloff.none());
}

TEST(LightPattern, AVignetteOfTheLensIsFoundAndIsNotTheFlashs) {
  for (const double loss : {0.1, 0.4}) {
    Wrong wrong;
    wrong.lens_loss = loss;
    const LightPattern found = pattern_of(wrong);
    ASSERT_TRUE(found.falloff.of_lens()) << loss;
    EXPECT_FALSE(found.falloff.of_flash());
    EXPECT_NEAR(lens_factor(found.falloff, {1, 0}), 1 - loss, 0.03) << loss;
    EXPECT_NEAR(lens_factor(found.falloff, {0.5, 0.3}), std::pow(1 + (1 / std::sqrt(1 - loss) - 1) * 0.34, -2), 0.015) << loss;
    EXPECT_EQ(found.flash_shift.norm(), 0);
  }
}

TEST(LightPattern, AFlashThatIsWeakerOffItsAxisIsFoundAndIsNotTheLenss) {
  Wrong wrong;
  wrong.flash_loss = 0.4;
  wrong.tilt = 0.06;
  std::vector<LightSample> samples = samples_with(wrong, lights());
  LightPattern found;
  for (int round = 0; round < 4; ++round) {   // what a weaker flash does is linear in small steps only
    const LightPattern before = found;
    found = pattern_in(samples, lights(), {}, before);
    ASSERT_TRUE(found.falloff.of_flash());
    EXPECT_FALSE(found.falloff.of_lens());
    for (LightSample& s : samples) s.flash *= static_cast<float>(flash_pattern(found.falloff, s.flash_off_axis.cast<double>()) / flash_pattern(before.falloff, s.flash_off_axis.cast<double>()));
  }
  EXPECT_NEAR(flash_pattern(found.falloff, {0, 1}), 0.6, 0.03);
  EXPECT_NEAR(flash_pattern(found.falloff, {0.5, 0}) / flash_pattern(found.falloff, {-0.5, 0}), std::exp(0.06), 0.015);
  EXPECT_EQ(found.flash_shift.norm(), 0);
}

TEST(LightPattern, AFalloffAndAShiftAreToldApart) {
  Wrong wrong;
  wrong.lens_loss = 0.3;
  wrong.shift = {0.03, 0.01, 0};
  const LightPattern found = pattern_of(wrong);
  EXPECT_TRUE(found.falloff.of_lens());
  EXPECT_NEAR(lens_factor(found.falloff, {1, 0}), 0.7, 0.04);
  EXPECT_LE((found.flash_shift - wrong.shift).norm(), 0.006) << found.flash_shift.transpose();
}

TEST(LightPattern, AFlashThatIsNeverTheSameIsNoPattern) {
  Wrong wrong;
  wrong.brightness = {0.04, -0.05, 0.03, -0.02};
  const LightPattern found = pattern_of(wrong);
  EXPECT_EQ(found.flash_shift.norm(), 0);
  EXPECT_TRUE(found.falloff.none());
}

TEST(LightPattern, IsFoundBesideAFlashThatIsNeverTheSame) {
  Wrong wrong;
  wrong.brightness = {0.04, -0.05, 0.03, -0.02};
  wrong.lens_loss = 0.3;
  const LightPattern found = pattern_of(wrong);
  ASSERT_TRUE(found.falloff.of_lens());
  EXPECT_NEAR(lens_factor(found.falloff, {1, 0}), 0.7, 0.03);
  EXPECT_EQ(found.flash_shift.norm(), 0);
  LightPatternOptions options;
  options.spread[kExposure] = 0.04;   // as it is known by then
  EXPECT_NEAR(lens_factor(pattern_of(wrong, options).falloff, {1, 0}), 0.7, 0.03);
}

TEST(LightPattern, WhatTheProjectRulesOutIsNotLookedFor) {
  Wrong wrong;
  wrong.lens_loss = 0.3;
  LightPatternOptions options;
  options.falloff = FalloffModel::kNone;
  EXPECT_TRUE(pattern_of(wrong, options).falloff.none());
  options.falloff = FalloffModel::kFlash;
  EXPECT_FALSE(pattern_of(wrong, options).falloff.of_lens());
}

TEST(LightPattern, ThePriorPullsAtTheWholeShift) {
  LightPattern already;
  already.flash_shift = {0.01, 0, 0};
  LightPatternOptions tight;
  tight.shift_prior_sd = 1e-5;
  EXPECT_LE(pattern_in(samples_with({}, lights()), lights(), tight, already).flash_shift.norm(), 0.001) << "back to where it is said to be";
}

TEST(LightPattern, WhatTheSamplesHoldAlreadyStays) {
  LightPattern already;
  already.falloff.lens = {-0.3, -0.05};
  std::vector<LightSample> samples = samples_with({}, lights());   // the vignette was taken off
  for (LightSample& s : samples)
    for (float& b : s.radiosity) b *= static_cast<float>(1 + 0.002 * static_cast<double>(s.off_axis.squaredNorm()));   // and a little too much
  const LightPattern found = pattern_in(samples, lights(), {}, already);
  ASSERT_TRUE(found.falloff.of_lens());
  EXPECT_NEAR(lens_factor(found.falloff, {1, 0}), std::exp(-0.35) * 1.002, 0.01);
}

TEST(LightPattern, NobodyMisplacesAFlashByTwentyCentimetres) {
  Wrong wrong;
  wrong.shift = {0.15, -0.1, 0.1};
  EXPECT_EQ(pattern_of(wrong).flash_shift.norm(), 0);
}

// A tenth where two hundredths are expected: what bends like the flash's light may be anything.
TEST(LightPattern, WhereTheModelExplainsLittleNothingPassesForOne) {
  Wrong wrong;
  wrong.shift = {0.03, -0.02, 0.02};
  wrong.noise = 0.15;
  EXPECT_EQ(pattern_of(wrong).flash_shift.norm(), 0);
  Wrong lens;
  lens.lens_loss = 0.4;
  lens.noise = 0.15;
  EXPECT_TRUE(pattern_of(lens).falloff.none());
}

TEST(LightPattern, ALossOfTwoPerCentIsNone) {
  Wrong wrong;
  wrong.lens_loss = 0.02;
  EXPECT_TRUE(pattern_of(wrong).falloff.none());
}

// Its deviation covers its error, and is no less than what noise of 1 % leaves after a few thousand readings.
TEST(LightPattern, AFalloffSaysHowCertainItIs) {
  Wrong lens;
  lens.lens_loss = 0.3;
  const FoundPattern found = find_light_pattern(samples_with(lens, lights()), lights(), {}, 2000);
  const double sd = std::sqrt(falloff_variance(found.pattern.falloff, {1, 0}, {1, 0}));
  EXPECT_GT(sd, 5e-4);
  EXPECT_LT(sd, 0.05);
  EXPECT_LE(std::fabs(std::log(lens_factor(found.pattern.falloff, {1, 0}) / 0.7)), 3 * sd + 0.02);   // by another formula than the program's
  EXPECT_EQ(found.pattern.falloff.covariance(2, 2), 0);
  EXPECT_GT(found.lights_covariance(0, 0), 0);
  EXPECT_GT(found.lights_covariance(1, 1), 0);
  Wrong flash;
  flash.flash_loss = 0.4;
  const Falloff of_flash = find_light_pattern(samples_with(flash, lights()), lights(), {}, 2000).pattern.falloff;
  ASSERT_TRUE(of_flash.of_flash());
  for (Eigen::Index k = 0; k < 4; ++k) {
    EXPECT_GT(std::sqrt(of_flash.covariance(k, k)), 5e-4) << k;
    EXPECT_LT(std::sqrt(of_flash.covariance(k, k)), 0.3) << k;
  }
  EXPECT_TRUE(find_light_pattern(samples_with({}, lights()), lights(), {}, 2000).lights_covariance.isZero());
}

TEST(LightPattern, OfNoSamplesThereIsNone) {
  const LightPattern found = pattern_in({}, lights());
  EXPECT_EQ(found.flash_shift.norm(), 0);
  EXPECT_TRUE(found.falloff.none());
}

TEST(FlashFactor, IsFalloffAndCosine) {
  EXPECT_NEAR(flash_factor(Vec3d::Zero(), Vec3d(0, 0, 1), Vec3d(0, 0, 1), Vec3d(0, 0, 1.1)), 1 / 1.21, 1e-12);
  EXPECT_NEAR(flash_factor(Vec3d::Zero(), Vec3d(0, 0, 1), Vec3d(0, 0, 1), Vec3d(1, 0, 1)), std::max(0.5, 1 / std::pow(2, 1.5)), 1e-12);
  EXPECT_EQ(flash_factor(Vec3d::Zero(), Vec3d(0, 0, 1), Vec3d(0, 0, -1), Vec3d(0, 0, 1)), 1);
}

}  // namespace
}  // namespace chiaro::optimize
