#include "optimize/own_light.h"

#include <gtest/gtest.h>

#include <array>
#include <cmath>

#include "stream/base/parallel.h"
#include "stream/base/rng.h"

namespace chiaro::optimize {
namespace {

constexpr std::size_t kPhotographs = 6;

Lights truth() {
  Lights x;
  x.flash_intensity = 10;
  x.sky[0] = 0.3;
  return x;
}

OwnLight own(double ambient, double exposure = 1) { return {ambient, exposure}; }

/// Surfels in nooks and in the open that three of the photographs see each, from different distances, with 2 % of noise.
std::vector<LightSample> samples_of(const std::vector<OwnLight>& own, std::size_t surfels = 900) {
  std::vector<LightSample> samples;
  for (std::size_t i = 0; i < surfels; ++i) {
    const float open = uniform01x4(4, Purpose::kTest, i, 9)[0];
    for (std::size_t n = 0; n < std::min<std::size_t>(3, own.size()); ++n) {
      const auto u = uniform01x4(4, Purpose::kTest, i, static_cast<std::uint32_t>(n));
      LightSample s;
      s.group = static_cast<std::uint32_t>(i);
      s.photograph = static_cast<std::uint32_t>((i + n * (1 + i % 2)) % own.size());
      s.flash = (0.1f + u[0]) / static_cast<float>(1 + s.photograph % 3);
      s.sky[0] = 3 * (0.3f + 0.7f * open);
      for (std::size_t c = 0; c < 3; ++c) s.gathered[c] = 0.5f * u[1];
      LightSample taken = s;
      change_own_light(taken, own[s.photograph].ambient, 1);
      for (std::size_t c = 0; c < 3; ++c) {
        const double albedo = 0.2 + 0.1 * static_cast<double>((i + c) % 6), noise = std::exp(0.02 * normal01(6, Purpose::kTest, 10 * i + n, static_cast<std::uint32_t>(c)));
        s.radiosity[c] = static_cast<float>(own[s.photograph].exposure * albedo * noise * irradiance(truth(), taken, static_cast<int>(c)));
        s.gathered[c] *= static_cast<float>(own[s.photograph].exposure);
      }
      samples.push_back(s);
    }
  }
  return samples;
}

OwnLights all_found_in(const std::vector<LightSample>& samples, const std::vector<OwnLight>& known, std::span<const ReferenceSample> references = {}, const LightSpread& known_spread = {}) {
  LightSolveOptions options;
  options.flash_ln_mean = std::log(10.5);
  options.flash_ln_sd = 0.05;
  options.bounce_sd = 0.02;
  return find_own_lights(samples, references, options, solve_lights(samples, references, options, truth()), known, known_spread);
}

std::vector<OwnLight> found_in(const std::vector<LightSample>& samples, const std::vector<OwnLight>& known, std::span<const ReferenceSample> references = {}) {
  return all_found_in(samples, known, references).of;
}

const std::vector<OwnLight> kAlike(kPhotographs);

std::vector<OwnLight> all_but(std::size_t k, const OwnLight& own) {
  std::vector<OwnLight> all(kPhotographs);
  all[k] = own;
  return all;
}

void expect_near(const std::vector<OwnLight>& found, const std::vector<OwnLight>& expected, double relative) {
  for (std::size_t k = 0; k < expected.size(); ++k) {
    EXPECT_NEAR(found[k].ambient, expected[k].ambient, expected[k].ambient == 1 ? 0 : relative * expected[k].ambient) << k;
    EXPECT_NEAR(found[k].exposure, expected[k].exposure, expected[k].exposure == 1 ? 0 : relative * expected[k].exposure) << k;
  }
}

TEST(OwnLight, AnotherAmbientLightIsFound) {
  for (const double ambient : {1.5, 0.6, 3.0}) {
    const auto expected = all_but(2, own(ambient)), found = found_in(samples_of(expected), kAlike);
    expect_near(found, expected, 0.03);
    EXPECT_LE(std::fabs(std::log(found[2].ambient / ambient)), 3 * found[2].ambient_ln_sd);
    EXPECT_LE(found[2].ambient_ln_sd, 0.1);
  }
}

TEST(OwnLight, AnotherExposureIsFoundAndNotTakenForAmbientLight) {
  for (const double exposure : {1.3, 0.6, 3.0}) expect_near(found_in(samples_of(all_but(2, own(1, exposure))), kAlike), all_but(2, own(1, exposure)), 0.01);
}

TEST(OwnLight, AmbientLightAndExposureAreToldApartInOnePhotograph) {
  for (const auto& both : {own(1.6, 1.25), own(1.6, 0.75), own(0.5, 1.3)}) expect_near(found_in(samples_of(all_but(4, both)), kAlike), all_but(4, both), 0.05);
}

TEST(OwnLight, TwoOfSixAreFound) {
  std::vector<OwnLight> expected = kAlike;
  expected[0] = own(1.8);
  expected[4] = own(1, 0.8);
  expect_near(found_in(samples_of(expected), kAlike), expected, 0.03);
}

TEST(OwnLight, OneOfThreeIsFound) {
  std::vector<OwnLight> expected(3);
  expected[1] = own(1.5);
  expect_near(found_in(samples_of(expected), std::vector<OwnLight>(3)), expected, 0.03);
}

TEST(OwnLight, PhotographsThatAreAlikeGetNothing) {
  expect_near(found_in(samples_of(kAlike), kAlike), kAlike, 0);
  const std::vector<OwnLight> nearly{own(1.01, 1.001), own(0.99, 0.999), own(1.01, 0.998), own(1, 0.999), own(1), own(0.99, 1.001)};
  expect_near(found_in(samples_of(nearly), kAlike), kAlike, 0);
}

/// Six photographs whose ln brightness has that deviation, mean 0.
std::vector<OwnLight> varying(double spread) {
  std::vector<OwnLight> all;
  for (const double ln : {-1.2, 0.9, 0.4, -0.6, 1.3, -0.8}) all.push_back(own(1, std::exp(spread * ln)));
  return all;
}

/// Brightness beside the mean of all: how bright they are together, the flash alone says.
double beside_mean(const std::vector<OwnLight>& all, std::size_t k) {
  double mean = 0;
  for (const OwnLight& o : all) mean += std::log(o.exposure) / static_cast<double>(all.size());
  return std::log(all[k].exposure) - mean;
}

TEST(OwnLight, AFlashThatIsNeverTheSameIsFollowed) {
  for (const double spread : {0.02, 0.08}) {
    const std::vector<OwnLight> expected = varying(spread);
    const OwnLights found = all_found_in(samples_of(expected), kAlike);
    EXPECT_NEAR(found.spread[kExposure], spread, 0.3 * spread);
    for (std::size_t k = 0; k < kPhotographs; ++k) {
      EXPECT_NEAR(beside_mean(found.of, k), beside_mean(expected, k), 0.003) << k;
      EXPECT_EQ(found.of[k].ambient, 1) << k;
      EXPECT_FALSE(found.of[k].unlike) << k;
      EXPECT_LE(std::fabs(std::log(found.of[k].exposure / expected[k].exposure)), 3 * found.of[k].exposure_ln_sd) << k;
    }
    EXPECT_GT(found.lights_covariance(0, 0), 0.5 * spread * spread / kPhotographs) << "their mean is no better known than that";
  }
}

TEST(OwnLight, OneIsUnlikeOthersThatVary) {
  std::vector<OwnLight> expected = varying(0.02);
  expected[3] = own(1, 1.6);
  const OwnLights found = all_found_in(samples_of(expected), kAlike);
  EXPECT_TRUE(found.of[3].unlike);
  EXPECT_NEAR(found.of[3].exposure, 1.6, 0.03);
  EXPECT_LE(found.spread[kExposure], 0.04);
  EXPECT_NEAR(found.of[0].exposure / found.of[4].exposure, expected[0].exposure / expected[4].exposure, 0.01);
}

TEST(OwnLight, WhetherOneOfThreeIsUnlikeOrAllVaryIsLeftOpenWhereItMayBeEither) {
  std::vector<OwnLight> expected(3);
  expected[1] = own(1, 0.93);
  const OwnLights found = all_found_in(samples_of(expected), std::vector<OwnLight>(3));
  EXPECT_GT(found.spread[kExposure], 0.02);
  EXPECT_NEAR(found.of[1].exposure / found.of[0].exposure, 0.93, 0.01);
  EXPECT_GT(std::sqrt(found.lights_covariance(0, 0)), 0.01);
}

TEST(OwnLight, WhatVariesIsFollowedFurther) {
  std::vector<LightSample> samples = samples_of(varying(0.05));
  const std::vector<OwnLight> before = varying(0.04);
  for (LightSample& s : samples) change_own_light(s, 1, before[s.photograph].exposure);
  const OwnLights found = all_found_in(samples, before, {}, {0, 0.04});
  EXPECT_NEAR(found.spread[kExposure], 0.05, 0.015);
  for (std::size_t k = 0; k < kPhotographs; ++k) EXPECT_NEAR(beside_mean(found.of, k), beside_mean(varying(0.05), k), 0.003) << k;
}

constexpr std::array kScatter{-1.2, 0.9, 0.4, -0.6, 1.3, -0.8};   // mean 0, deviation .91

/// Ambient light, and brightness, beside the means of all.
void expect_beside_means(const std::vector<OwnLight>& found, const std::vector<OwnLight>& expected, double ambient_within, double exposure_within) {
  double ambient = 0, exposure = 0;
  for (std::size_t k = 0; k < found.size(); ++k) {
    ambient += std::log(found[k].ambient / expected[k].ambient) / static_cast<double>(found.size());
    exposure += std::log(found[k].exposure / expected[k].exposure) / static_cast<double>(found.size());
  }
  for (std::size_t k = 0; k < found.size(); ++k) {
    EXPECT_NEAR(std::log(found[k].ambient / expected[k].ambient), ambient, ambient_within) << k;
    EXPECT_NEAR(std::log(found[k].exposure / expected[k].exposure), exposure, exposure_within) << k;
  }
}

TEST(OwnLight, AmbientLightThatIsNeverTheSameIsFollowed) {
  for (const double spread : {0.1, 0.4}) {
    std::vector<OwnLight> expected;
    for (const double s : kScatter) expected.push_back(own(std::exp(spread * s)));
    const OwnLights found = all_found_in(samples_of(expected), kAlike);
    EXPECT_NEAR(found.spread[kAmbient], 0.91 * spread, 0.25 * spread);
    EXPECT_EQ(found.spread[kExposure], 0);
    expect_beside_means(found.of, expected, 0.02, 0);
    for (const OwnLight& o : found.of) EXPECT_FALSE(o.unlike || o.unlike_ambient);
    EXPECT_GT(found.lights_covariance(1, 1), 0.3 * spread * spread / kPhotographs * truth().sky[0] * truth().sky[0]) << "their mean is no better known than that";
  }
}

TEST(OwnLight, FlashAndAmbientLightThatBothVaryAreToldApart) {
  std::vector<OwnLight> expected;
  for (std::size_t k = 0; k < kPhotographs; ++k) expected.push_back(own(std::exp(0.3 * kScatter[k]), std::exp(0.05 * kScatter[(k + 2) % kPhotographs])));
  const OwnLights found = all_found_in(samples_of(expected), kAlike);
  EXPECT_NEAR(found.spread[kAmbient], 0.27, 0.1);
  EXPECT_NEAR(found.spread[kExposure], 0.046, 0.02);
  expect_beside_means(found.of, expected, 0.03, 0.006);
}

TEST(OwnLight, ThatAmbientLightVariesTooIsSeenLater) {
  std::vector<OwnLight> expected, before;
  for (std::size_t k = 0; k < kPhotographs; ++k) {
    expected.push_back(own(std::exp(0.3 * kScatter[k]), std::exp(0.05 * kScatter[(k + 2) % kPhotographs])));
    before.push_back(own(1, std::exp(0.06 * kScatter[(k + 2) % kPhotographs])));
  }
  std::vector<LightSample> samples = samples_of(expected);
  for (LightSample& s : samples) change_own_light(s, 1, before[s.photograph].exposure);
  const OwnLights found = all_found_in(samples, before, {}, {0, 0.06});
  EXPECT_NEAR(found.spread[kAmbient], 0.27, 0.1);
  expect_beside_means(found.of, expected, 0.03, 0.006);
}

TEST(OwnLight, WhatDoesNotVaryOnceAnotherIsFollowedIsForgotten) {
  std::vector<OwnLight> expected, before;
  for (const double s : kScatter) {
    expected.push_back(own(std::exp(0.3 * s)));
    before.push_back(own(std::exp(0.25 * s), std::exp(0.02 * s)));
  }
  std::vector<LightSample> samples = samples_of(expected);
  for (LightSample& s : samples) change_own_light(s, before[s.photograph].ambient, before[s.photograph].exposure);
  const OwnLights found = all_found_in(samples, before, {}, {0.25, 0.02});
  EXPECT_EQ(found.spread[kExposure], 0);
  for (const OwnLight& o : found.of) EXPECT_EQ(o.exposure, 1);
  expect_beside_means(found.of, expected, 0.03, 0);
}

TEST(OwnLight, OneAmbientLightIsUnlikeOthersThatVary) {
  std::vector<OwnLight> expected;
  for (const double s : kScatter) expected.push_back(own(std::exp(0.05 * s)));
  expected[3] = own(4);
  const OwnLights found = all_found_in(samples_of(expected), kAlike);
  EXPECT_TRUE(found.of[3].unlike_ambient);
  EXPECT_LE(found.spread[kAmbient], 0.15);
  expect_beside_means(found.of, expected, 0.05, 0.02);
}

TEST(OwnLight, WhatRemainsOfAFactorIsCorrectedByHoweverLittle) {
  std::vector<LightSample> samples = samples_of(all_but(3, own(1.53, 1.22)));
  for (LightSample& s : samples)
    if (s.photograph == 3) change_own_light(s, 1.5, 1.2);
  std::vector<OwnLight> known = all_but(3, own(1.5, 1.2));
  known[3].unlike = known[3].unlike_ambient = true;
  expect_near(found_in(samples, known), all_but(3, own(1.53, 1.22)), 0.02);
}

TEST(OwnLight, TwoPhotographsOrAFewSurfelsAreNotJudged) {
  const std::vector<OwnLight> two{own(1), own(2)};
  expect_near(found_in(samples_of(two), std::vector<OwnLight>(2)), std::vector<OwnLight>(2), 0);
  expect_near(found_in(samples_of(all_but(2, own(2)), 30), kAlike), kAlike, 0);
}

TEST(OwnLight, OfAPhotographWithoutFlashTheAmbientLightIsTheExposure) {
  std::vector<LightSample> samples = samples_of(all_but(5, own(1.5)));
  for (LightSample& s : samples) {
    if (s.photograph != 5) continue;
    s.flash_photograph = false;
    for (std::size_t c = 0; c < 3; ++c) {
      LightSample taken = s;
      change_own_light(taken, 1.5, 1);
      const double with = irradiance(truth(), taken, static_cast<int>(c));
      taken.flash = 0;
      s.radiosity[c] *= static_cast<float>(irradiance(truth(), taken, static_cast<int>(c)) / with);
    }
    s.flash = 0;
  }
  expect_near(found_in(samples, kAlike), all_but(5, own(1.5)), 0.03);
}

TEST(OwnLight, ATargetIsSeenUnderTheLightOfItsPhotograph) {
  const std::vector<OwnLight> expected = all_but(2, own(2));
  std::vector<LightSample> samples = samples_of(expected);
  ReferenceSample reference;
  for (const LightSample& s : samples)
    if (s.photograph == 2 && s.sky[0] > 2.5f) reference.sample = s;
  LightSample taken = reference.sample;
  change_own_light(taken, 2, 1);
  for (std::size_t c = 0; c < 3; ++c) reference.albedo[c] = static_cast<double>(reference.sample.radiosity[c]) / irradiance(truth(), taken, static_cast<int>(c));
  reference.sigma = 0.005;
  expect_near(found_in(samples, kAlike, {&reference, 1}), expected, 0.03);
}

TEST(OwnLight, IsTheSameForAnyNumberOfThreads) {
  const std::vector<LightSample> samples = samples_of(all_but(1, own(1.7)));
  const auto with = [&](int threads) {
    const ThreadLimit limit(threads);
    return found_in(samples, kAlike)[1].ambient;
  };
  EXPECT_EQ(with(1), with(8));
}

TEST(OwnLight, FortyPhotographsOfWhichEightDiffer) {
  std::vector<OwnLight> expected(40);
  for (std::size_t k = 0; k < 8; ++k) expected[5 * k] = own(k % 2 ? 1.6 : 0.6);
  const std::vector<OwnLight> found = found_in(samples_of(expected, 2000), std::vector<OwnLight>(40));
  expect_near(found, expected, 0.08);
}

TEST(OwnLight, ChangesTheAmbientLightOrAllThatIsShown) {
  LightSample s;
  s.flash = 0.5f;
  s.floor_flash = 0.1f;
  for (std::size_t k = 0; k < kSkyTerms; ++k) {
    s.sky[k] = static_cast<float>(k + 1);
    s.hidden[k] = 0.1f * static_cast<float>(k + 1);
  }
  s.radiosity = {1, 2, 3};
  s.gathered = {0.4f, 0.6f, 0.8f};
  change_own_light(s, 3, 2);
  EXPECT_EQ(s.flash, 0.5f);
  EXPECT_EQ(s.floor_flash, 0.1f);
  for (std::size_t k = 0; k < kSkyTerms; ++k) {
    EXPECT_FLOAT_EQ(s.sky[k], 3 * static_cast<float>(k + 1));
    EXPECT_FLOAT_EQ(s.hidden[k], 0.3f * static_cast<float>(k + 1));
  }
  EXPECT_EQ(s.radiosity, (std::array<float, 3>{0.5f, 1, 1.5f}));
  EXPECT_EQ(s.gathered, (std::array<float, 3>{0.2f, 0.3f, 0.4f}));
}

// Half of them under twice the ambient light: who is unlike whom?
TEST(OwnLight, FewerThanHalfAreUnlikeTheOthers) {
  std::vector<OwnLight> expected = kAlike;
  for (const std::size_t k : {0, 2, 3}) expected[k] = own(2);
  int unlike = 0;
  for (const OwnLight& o : found_in(samples_of(expected), kAlike)) unlike += o.unlike || o.unlike_ambient;
  EXPECT_LT(unlike, 3);
}

}  // namespace
}  // namespace chiaro::optimize
