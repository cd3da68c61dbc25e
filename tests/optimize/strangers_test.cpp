#include "optimize/strangers.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>

#include "stream/base/rng.h"

namespace chiaro::optimize {
namespace {

constexpr std::size_t kPhotographs = 6;

Lights lights() {
  Lights x;
  x.flash_intensity = 10;
  x.sky[0] = 0.1;
  return x;
}

/// Surfels that three of six photographs see each, with 3 % of noise; the brightness of each photograph times its factor.
std::vector<LightSample> samples_of(const std::vector<double>& factors, std::size_t surfels = 900) {
  std::vector<LightSample> samples;
  for (std::size_t i = 0; i < surfels; ++i)
    for (std::size_t n = 0; n < 3; ++n) {
      const auto u = uniform01x4(4, Purpose::kTest, i, static_cast<std::uint32_t>(n));
      LightSample s;
      s.group = static_cast<std::uint32_t>(i);
      s.photograph = static_cast<std::uint32_t>((i + n * (1 + i % 2)) % factors.size());
      s.flash = 0.1f + u[0];
      s.sky[0] = 3;
      for (std::size_t c = 0; c < 3; ++c) {
        s.gathered[c] = 0.2f * u[1];
        const double albedo = 0.2 + 0.1 * static_cast<double>((i + c) % 6), noise = std::exp(0.03 * normal01(6, Purpose::kTest, 10 * i + n, static_cast<std::uint32_t>(c)));
        s.radiosity[c] = static_cast<float>(factors[s.photograph] * albedo * noise * irradiance(lights(), s, static_cast<int>(c)));
      }
      samples.push_back(s);
    }
  return samples;
}

const std::vector<double> kAlike(kPhotographs, 1.0);

// The photographs of another object: albedos that have nothing to do with those of the others.
void replace_photograph(std::vector<LightSample>& samples, std::uint32_t photograph, double ln_spread) {
  for (std::size_t i = 0; i < samples.size(); ++i)
    if (samples[i].photograph == photograph)
      for (float& b : samples[i].radiosity) b *= static_cast<float>(std::exp(ln_spread * normal01(8, Purpose::kTest, i, 0)));
}

TEST(Strangers, APhotographOfSomethingElseIsFoundAtAnyBrightness) {
  std::vector<double> factors = kAlike;
  factors[4] = 3;
  std::vector<LightSample> samples = samples_of(factors);
  replace_photograph(samples, 4, 0.4);
  EXPECT_EQ(strangers(samples, lights(), kPhotographs), (std::vector<bool>{false, false, false, false, true, false}));
}

TEST(Strangers, ABrighterPhotographIsNone) {
  std::vector<double> factors = kAlike;
  factors[4] = 3;
  EXPECT_EQ(strangers(samples_of(factors), lights(), kPhotographs), std::vector<bool>(kPhotographs, false));
}

TEST(Strangers, WhereAllPhotographsDisagreeNoneIs) {
  std::vector<LightSample> samples = samples_of(kAlike);
  for (std::uint32_t k = 0; k < kPhotographs; ++k) replace_photograph(samples, k, 0.4);
  EXPECT_EQ(strangers(samples, lights(), kPhotographs), std::vector<bool>(kPhotographs, false));
}

TEST(Strangers, TwoPhotographsAreNotJudged) {
  std::vector<LightSample> samples = samples_of(kAlike);
  samples.erase(std::remove_if(samples.begin(), samples.end(), [](const LightSample& s) { return s.photograph > 1; }), samples.end());
  replace_photograph(samples, 1, 0.4);
  EXPECT_EQ(strangers(samples, lights(), 2), std::vector<bool>(2, false));
}

TEST(Strangers, APhotographWithoutFlashIsNotJudged) {
  std::vector<LightSample> samples = samples_of(kAlike);
  replace_photograph(samples, 4, 0.4);
  for (LightSample& s : samples)
    if (s.photograph == 4) s.flash_photograph = false;
  EXPECT_EQ(strangers(samples, lights(), kPhotographs), std::vector<bool>(kPhotographs, false));
}

// Of two photographs that disagree nobody knows which is right: surfels that two saw do not count.
TEST(Strangers, WhatTwoPhotographsSawSaysNothing) {
  std::vector<LightSample> all = samples_of(kAlike), samples;
  for (std::size_t i = 0; i < all.size(); ++i)
    if (i % 3 != 2) samples.push_back(all[i]);
  replace_photograph(samples, 4, 0.4);
  EXPECT_EQ(strangers(samples, lights(), kPhotographs), std::vector<bool>(kPhotographs, false));
}

}  // namespace
}  // namespace chiaro::optimize
