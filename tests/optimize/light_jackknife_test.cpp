#include "optimize/light_jackknife.h"

#include <gtest/gtest.h>

#include <cmath>

#include "stream/base/rng.h"

namespace chiaro::optimize {
namespace {

Lights truth() {
  Lights x;
  x.flash_intensity = 10;
  x.sky[0] = 0.3;
  return x;
}

/// Surfels that each of some photographs sees from another distance; what photograph 0 sees is off by so much, in proportion to the sky's share there.
std::vector<LightSample> samples_of(std::uint32_t photographs, double off, std::size_t surfels = 600) {
  std::vector<LightSample> samples;
  for (std::size_t i = 0; i < surfels; ++i)
    for (std::uint32_t k = 0; k < photographs; ++k) {
      const auto u = uniform01x4(4, Purpose::kTest, i, k);
      LightSample s;
      s.group = static_cast<std::uint32_t>(i);
      s.photograph = k;
      s.flash = (0.1f + u[0]) / static_cast<float>(1 + k % 3);
      s.sky[0] = 0.5f + 2 * uniform01x4(4, Purpose::kTest, i, 99)[0];
      for (int c = 0; c < 3; ++c) {
        const auto at = static_cast<std::size_t>(c);
        s.gathered[at] = 0.5f * u[1];
        const double h = irradiance(truth(), s, c), share = 0.3 * static_cast<double>(s.sky[0]) / h, noise = 0.01 * normal01(6, Purpose::kTest, 10 * i + k, static_cast<std::uint32_t>(c));
        s.radiosity[at] = static_cast<float>(0.5 * h * std::exp(noise + (k == 0 ? off * share : 0)));
      }
      samples.push_back(s);
    }
  return samples;
}

LightSolveOptions options() {
  LightSolveOptions o;
  o.flash_ln_mean = std::log(10.0);
  o.flash_ln_sd = 0.05;
  return o;
}

std::optional<double> by_photographs(const std::vector<LightSample>& samples) {
  return ambient_variance_by_photographs(samples, {}, options(), solve_lights(samples, {}, options(), truth()));
}

TEST(LightJackknife, AgreeingPhotographsLeaveLittleOpen) {
  const auto variance = by_photographs(samples_of(5, 0));
  ASSERT_TRUE(variance);
  EXPECT_LT(std::sqrt(*variance), 0.01 * 0.3);
}

// Photograph 0 says that there is so much more of it, the others do not; without it the ambient light is right.
TEST(LightJackknife, APhotographThatSaysOtherwiseShows) {
  const std::vector<LightSample> samples = samples_of(5, 0.3);
  const double error = solve_lights(samples, {}, options(), truth()).lights.sky[0] - 0.3;
  const auto variance = by_photographs(samples);
  ASSERT_TRUE(variance);
  EXPECT_GT(std::fabs(error), 0.03 * 0.3);
  EXPECT_GT(2 * std::sqrt(*variance), std::fabs(error));
  EXPECT_LT(std::sqrt(*variance), 2 * std::fabs(error));
}

TEST(LightJackknife, ManyPhotographsGoInEightLots) { EXPECT_LT(std::sqrt(by_photographs(samples_of(20, 0, 150)).value()), 0.02 * 0.3); }

// (n - 1) / n of the squared deviations of what is found without each one, or without each lot of several.
TEST(LightJackknife, IsTheDeleteOneFormula) {
  for (const std::uint32_t photographs : {5u, 20u}) {
    const std::vector<LightSample> samples = samples_of(photographs, 0.3, 200);
    const std::uint32_t lots = std::min(8u, photographs);
    ReferenceSample reference;
    reference.sample = samples[0];
    reference.sample.gathered.fill(0);
    reference.albedo = {0.45, 0.45, 0.45};
    const std::vector<ReferenceSample> references{reference};
    const LightSolution all = solve_lights(samples, references, options(), truth());
    std::vector<double> found;
    for (std::uint32_t lot = 0; lot < lots; ++lot) {
      std::vector<LightSample> left;
      for (const LightSample& s : samples)
        if (s.photograph % lots != lot) left.push_back(s);
      found.push_back(solve_lights(left, references, options(), all.lights).lights.sky[0]);
    }
    double mean = 0, squares = 0;
    for (const double v : found) mean += v / lots;
    for (const double v : found) squares += (v - mean) * (v - mean);
    const auto variance = ambient_variance_by_photographs(samples, references, options(), all);
    ASSERT_TRUE(variance);
    EXPECT_NEAR(*variance / (squares * (lots - 1) / lots), 1, 1e-9) << photographs;
  }
}

TEST(LightJackknife, SaysNothingOfTwoPhotographsOrAFewSurfels) {
  EXPECT_FALSE(by_photographs(samples_of(2, 0.1)));
  EXPECT_FALSE(by_photographs(samples_of(5, 0.1, 50)));
  LightSolveOptions dark = options();
  dark.sky_terms = 0;
  const auto samples = samples_of(4, 0);
  EXPECT_FALSE(ambient_variance_by_photographs(samples, {}, dark, solve_lights(samples, {}, dark, truth())));
}

}  // namespace
}  // namespace chiaro::optimize
