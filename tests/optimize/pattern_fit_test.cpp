#include "optimize/pattern_fit.h"

#include <gtest/gtest.h>

#include <cmath>

#include "stream/base/rng.h"

namespace chiaro::optimize {
namespace {

constexpr std::uint32_t kPhotographs = 4;

Lights lights() {
  Lights x;
  x.flash_intensity = 10;
  x.sky[0] = 1;
  return x;
}

/// Surfels that four photographs see, in the light of the flash, the sky and of each other, as it is under `truth`; brightness: of each photograph.
std::vector<LightSample> samples_under(const Lights& truth, const std::array<double, kPhotographs>& brightness = {1, 1, 1, 1}) {
  std::vector<LightSample> samples;
  for (std::uint32_t i = 0; i < 800; ++i)
    for (std::uint32_t k = 0; k < kPhotographs; ++k) {
      const auto u = uniform01x4(3, Purpose::kTest, i, k);
      LightSample s;
      s.group = i;
      s.photograph = k;
      s.flash = (0.1f + u[0]) / static_cast<float>(1 + k);
      s.sky[0] = 0.3f + 2 * u[1];
      s.gathered.fill(0.2f + 4 * u[2]);
      s.variance = 1e-5f;
      for (int c = 0; c < 3; ++c) s.radiosity[static_cast<std::size_t>(c)] = static_cast<float>(0.4 * brightness[k] * irradiance(truth, s, c) * std::exp(0.003 * normal01(4, Purpose::kTest, 10 * i + k, static_cast<std::uint32_t>(c))));
      for (float& g : s.gathered) g *= static_cast<float>(brightness[k]);   // what lights it is as bright as what is seen
      samples.push_back(s);
    }
  return samples;
}

/// One unknown that says nothing, as there must be some.
PatternEffect nothing(const LightSample&) { return {PatternVector::Zero(1), PatternVector::Zero(1)}; }
Pattern none(double already = 0, double prior_sd = 1) {
  Pattern p;
  p.already = PatternVector::Constant(1, already);
  p.prior_sd = PatternVector::Constant(1, prior_sd);
  return p;
}

// Five per cent of one light that the lights given lack: of that, and of no other.
TEST(PatternFit, FindsByHowMuchTheLightsAreOff) {
  constexpr double kOff = 0.05;
  for (const int which : {0, 1}) {
    Lights truth = lights();
    (which == 0 ? truth.flash_intensity : truth.sky[0]) *= std::exp(kOff);
    const PatternFit fit = PatternResiduals(samples_under(truth), lights(), nothing, 1e6).fit(none());
    EXPECT_NEAR(fit.beside[0], which == 0 ? kOff : 0, 0.004) << which;
    EXPECT_NEAR(fit.beside[1], which == 1 ? kOff : 0, 0.004) << which;
    EXPECT_NEAR(fit.beside[2], 0, 0.004) << which;
    EXPECT_LT(fit.after, 0.5 * fit.before);
  }
}

TEST(PatternFit, FindsTheBrightnessOfEachPhotographBesideBouncedLight) {
  const std::array<double, kPhotographs> brightness{1.05, 0.93, 1.02, 1.0};
  Pattern pattern = none();
  pattern.open[kExposure] = 0.1;
  const PatternFit fit = PatternResiduals(samples_under(lights(), brightness), lights(), nothing, 1e6).fit(pattern);
  for (Eigen::Index k = 1; k < 4; ++k) EXPECT_NEAR(fit.beside[3 + k] - fit.beside[3], std::log(brightness[static_cast<std::size_t>(k)] / brightness[0]), 0.003) << k;
}

TEST(PatternFit, PhotographsWithoutFlashTakeNoPart) {
  std::vector<LightSample> samples = samples_under(lights());
  for (LightSample& s : samples)
    if (s.photograph == 3) {
      s.flash_photograph = false;
      for (float& b : s.radiosity) b *= 1 + 0.5f * s.flash;
    }
  const PatternFit fit = PatternResiduals(samples, lights(), nothing, 1e6).fit(none());
  EXPECT_NEAR(fit.beside[0], 0, 0.003);
  EXPECT_LT(fit.before, 0.3);
}

// What the samples say of an effect, n times of weight w, beside its prior: 1 / (1 / sd^2 + information), and the mean of both. Half of the rows have it, so that of the groups' means it is +-1/2.
TEST(PatternFit, WeighsThePriorAgainstWhatTheSamplesSay) {
  std::vector<LightSample> samples;
  constexpr std::uint32_t kGroups = 50;
  constexpr double kTrue = 0.02;
  for (std::uint32_t i = 0; i < kGroups; ++i)
    for (std::uint32_t k = 0; k < 2; ++k) {
      LightSample s;
      s.group = i;
      s.photograph = k;
      s.flash = 1;
      s.trust = 0.5f;
      s.radiosity.fill(static_cast<float>(0.5 * 10 * std::exp(k * kTrue)));
      samples.push_back(s);
    }
  Lights flash;
  flash.flash_intensity = 10;
  const auto effect = [](const LightSample& s) { return PatternEffect{PatternVector::Zero(1), PatternVector::Constant(1, s.photograph)}; };
  const double weight = 0.5 / 4e-4;   // 2 % of model error, half trusted
  for (const double already : {0.0, 0.01}) {
    std::vector<LightSample> held = samples;
    for (LightSample& s : held)
      if (s.photograph == 1)
        for (float& b : s.radiosity) b *= static_cast<float>(std::exp(-already));
    const PatternFit fit = PatternResiduals(held, flash, effect, 1e6).fit(none(already, 0.01));
    // What is left is alike in all rows, 1 / 1.4826 of the robust deviation: Cauchy's weight of that.
    const double robust = 1 / (1 + 1 / std::pow(1.4826 * 2.385, 2)), information = 2 * kGroups * 0.25 * weight * robust, prior = 1e4;
    EXPECT_NEAR(fit.value[0], kTrue * information / (information + prior), 1e-3 * kTrue) << already;
    EXPECT_NEAR(fit.covariance(0, 0) * (information + prior), 1, 1e-3);
    // Fewer of them are independent: the prior says more.
    const double few = information * 20 / (2 * kGroups);
    EXPECT_NEAR(PatternResiduals(held, flash, effect, 20).fit(none(already, 0.01)).value[0], kTrue * few / (few + prior), 1e-3 * kTrue) << already;
  }
}

}  // namespace
}  // namespace chiaro::optimize
