#include "optimize/light_residuals.h"

#include <gtest/gtest.h>

#include <cmath>
#include <functional>

#include "stream/base/rng.h"

namespace chiaro::optimize {
namespace {

/// A sample in which nothing is nothing.
LightSample some_sample(std::size_t which) {
  const auto u = uniform01x4(9, Purpose::kTest, which, 0), v = uniform01x4(9, Purpose::kTest, which, 1);
  LightSample s;
  s.flash = 0.2f + u[0];
  s.floor_flash = 0.05f + 0.1f * u[1];
  for (std::size_t k = 0; k < kSkyTerms; ++k) {
    s.sky[k] = (k == 0 ? 2.5f : 0.3f) * (0.5f + uniform01x4(9, Purpose::kTest, which, static_cast<std::uint32_t>(2 + k))[0]);
    s.hidden[k] = 0.25f * s.sky[k] * (0.5f + v[0]);
  }
  for (std::size_t c = 0; c < 3; ++c) {
    s.gathered[c] = 0.1f + 0.3f * u[1 + c % 3];
    s.radiosity[c] = 1.1f + 0.4f * v[1 + c % 3];
  }
  s.angles = {0.8f + 0.15f * v[1], 0.85f + 0.1f * v[2], 0.95f + 0.04f * v[3]};
  return s;
}

Lights some_lights() {
  Lights x;
  x.flash_intensity = 3;
  x.sky = {0.3, 0.05, -0.04, 0.02, 0.03, 0.01, 0.02, -0.02, 0.04};
  x.sky_colour = {1.4, 1, 0.6};
  x.bounce = 1.1;
  return x;
}

/// Irradiance below, and what is mirrored: by the formula of the header.
struct Written {
  double below = 0, mirrored = 0;
};
Written written(const Lights& x, const LightSample& s, std::size_t c) {
  double sky = 0;
  for (std::size_t k = 0; k < kSkyTerms; ++k) sky += x.sky[k] * (static_cast<double>(s.sky[k]) - (x.floor ? static_cast<double>(s.hidden[k]) : 0.0));
  double other = x.sky_colour[c] * (sky + (x.floor ? x.floor_albedo * x.sky[0] * static_cast<double>(s.hidden[0]) : 0)) + x.bounce * static_cast<double>(s.gathered[c]);
  if (x.floor) other += x.floor_albedo * x.flash_intensity * static_cast<double>(s.floor_flash);
  const double direct = x.flash_intensity * static_cast<double>(s.flash);
  if (!x.gloss.on) return {direct + other, 0};
  const CoatFactors f = coat_factors(x.gloss, s.angles);
  return {f.direct * direct + f.other * other, f.direct_mirrored * direct + f.other_mirrored * other};
}

struct Case {
  const char* name;
  bool floor, gloss;
};

TEST(LightModel, IsFlashSkyFloorAndBouncesBelowACoatIfThereIsOne) {
  for (const Case& now : {Case{"plain", false, false}, Case{"floor", true, false}, Case{"coat", false, true}, Case{"both", true, true}}) {
    Lights x = some_lights();
    x.floor = now.floor;
    x.floor_albedo = now.floor ? 0.4 : 0;
    x.gloss = {now.gloss, 0.045, 0.3};
    for (std::size_t i = 0; i < 4; ++i)
      for (std::size_t c = 0; c < 3; ++c) {
        const LightSample s = some_sample(i);
        const Written w = written(x, s, c);
        EXPECT_NEAR(irradiance(x, s, static_cast<int>(c)), w.below, 1e-9) << now.name;
        EXPECT_NEAR(mirrored_radiosity(x, s, static_cast<int>(c)), w.mirrored, 1e-9) << now.name;
        EXPECT_NEAR(body_radiosity(x, s, static_cast<int>(c)), static_cast<double>(s.radiosity[c]) - w.mirrored, 1e-9) << now.name;
      }
  }
}

/// The change of -ln(albedo H + mirrored) by each parameter, by differences.
TEST(LightModel, DerivativesAreThoseOfDifferences) {
  for (const Case& now : {Case{"plain", false, false}, Case{"floor", true, false}, Case{"coat", false, true}, Case{"both", true, true}}) {
    Lights x = some_lights();
    x.floor = now.floor;
    x.floor_albedo = now.floor ? 0.4 : 0;
    x.gloss = {now.gloss, 0.045, 0.3};
    const LightLayout layout{kSkyTerms, true, now.floor, now.gloss};
    std::vector<std::function<void(Lights&, double)>> parameters{[](Lights& l, double by) { l.flash_intensity *= std::exp(by); }};
    for (std::size_t k = 0; k < kSkyTerms; ++k) parameters.emplace_back([k](Lights& l, double by) { l.sky[k] += by; });
    parameters.emplace_back([](Lights& l, double by) { l.sky_colour[0] *= std::exp(by); });
    parameters.emplace_back([](Lights& l, double by) { l.sky_colour[2] *= std::exp(by); });
    if (now.floor) parameters.emplace_back([](Lights& l, double by) { l.floor_albedo += by; });
    if (now.gloss) parameters.emplace_back([](Lights& l, double by) { l.gloss.reflectance *= std::exp(by); });
    if (now.gloss) parameters.emplace_back([](Lights& l, double by) { l.gloss.roughness *= std::exp(by); });
    parameters.emplace_back([](Lights& l, double by) { l.bounce += by; });
    ASSERT_EQ(layout.size(), static_cast<int>(parameters.size()));
    constexpr double kStep = 1e-5, kAlbedo = 0.4;
    for (std::size_t i = 0; i < 4; ++i)
      for (int c = 0; c < 3; ++c) {
        const LightSample s = some_sample(i);
        const LightVector j = light_derivative(x, s, c, layout, irradiance(x, s, c), kAlbedo);
        for (std::size_t p = 0; p < parameters.size(); ++p) {
          const auto ln = [&](double by) {
            Lights y = x;
            parameters[p](y, by);
            const Written w = written(y, s, static_cast<std::size_t>(c));
            return -std::log(kAlbedo * w.below + w.mirrored);
          };
          EXPECT_NEAR(j[static_cast<Eigen::Index>(p)], (ln(kStep) - ln(-kStep)) / (2 * kStep), 1e-6) << now.name << " parameter " << p << " channel " << c;
        }
      }
  }
}

TEST(LightModel, ASamplesWeightIsOneOverTheVarianceThatItsCausesMake) {
  Lights x;
  x.flash_intensity = 2;
  x.sky[0] = 0.5;
  LightSample s;
  s.flash = 0.5f;   // half of the light
  s.sky[0] = 2;
  const double model = 0.02 * 0.02, gather = 0.03 * 0.5 * 0.03 * 0.5;
  EXPECT_NEAR(sample_weight(x, s), 1 / (model + gather), 1e-3);
  s.variance = 4e-4f;
  EXPECT_NEAR(sample_weight(x, s), 1 / (model + gather + 4e-4), 1e-3);
  s.spread = 0.4f;
  const double spread = 0.3 * 0.5 * 0.4;
  EXPECT_NEAR(sample_weight(x, s), 1 / (model + gather + 4e-4 + spread * spread), 1e-3);
  s.tan_flash = 2;
  const double normal = 0.01745 * 0.5 * 2;
  EXPECT_NEAR(sample_weight(x, s), 1 / (model + gather + 4e-4 + spread * spread + normal * normal), 1e-3);
  s.flash = 0;
  s.sky[0] = 0;
  EXPECT_EQ(sample_weight(x, s), 0) << "no light";
}

/// Groups of two samples that differ by `apart`, up and down in turn; weights are those of noise alone.
std::vector<LightSample> pairs_apart(double apart, std::size_t groups) {
  std::vector<LightSample> samples;
  for (std::size_t i = 0; i < groups; ++i)
    for (const double off : {0.5, -0.5}) {
      LightSample s;
      s.group = static_cast<std::uint32_t>(i);
      s.flash = 1;
      s.radiosity.fill(static_cast<float>(0.5 * std::exp(off * apart)));
      samples.push_back(s);
    }
  return samples;
}

// Two residuals of +-apart / 2 each, of which one is free: the deviation of one sample is apart / sqrt(2).
TEST(RobustScale, IsTheDeviationOfOneSample) {
  const auto samples = pairs_apart(0.1, 40);
  const std::vector<SampleGroup> groups = groups_of(samples);
  const auto [weighted, plain] = robust_scale(Lights{}, samples, groups, layout_of({}));
  EXPECT_NEAR(plain, 1.4826 * 0.1 / std::sqrt(2.0), 1e-5);
  EXPECT_NEAR(weighted, plain / 0.02, 1e-3);
  EXPECT_NEAR(cauchy_scale(Lights{}, samples, groups, layout_of({})), 2.385 * weighted, 1e-3);
  EXPECT_NEAR(cauchy_scale(Lights{}, pairs_apart(1e-5, 40), groups, layout_of({})), 2.385 * 0.1, 1e-6) << "no scene is that good";
  EXPECT_NEAR(dispersion_of(2.385 * 3), 9, 1e-12);
  EXPECT_EQ(dispersion_of(2.385 * 0.5), 1);
}

TEST(Residuals, AreThreeChannelsLessTheAlbedoOfEachGroup) {
  std::vector<LightSample> samples = pairs_apart(0, 10);
  EXPECT_EQ(residuals_of(groups_of(samples)), 3 * 10);
  samples.push_back(samples.back());
  EXPECT_EQ(residuals_of(groups_of(samples)), 3 * 11);
  samples.push_back(samples.back());
  samples.back().group = 77;
  EXPECT_EQ(residuals_of(groups_of(samples)), 3 * 11) << "a surfel that is seen once says nothing";
  LightSolveOptions options;
  EXPECT_NEAR(independent_residuals(samples, options), 33, 1e-9);
  options.information = 0.04;
  EXPECT_NEAR(independent_residuals(samples, options), 0.04 * 33, 1e-9) << "pairs of one photograph overlap";
  options.information = 1;
  options.independent_residuals = 20;
  EXPECT_NEAR(independent_residuals(samples, options), 20, 1e-9);
}

// By hand: c^2 / 2 ln(1 + w r^2 / c^2) each, for fewer the more they scatter; the samples differ by 0.1 where 0.02 is expected.
TEST(LightMisfit, IsCauchysOfAsManyResidualsAsAreIndependent) {
  const auto samples = pairs_apart(0.1, 40);
  const double w = 1 / 4e-4, scale = 2.385 * 1.4826 * 0.1 / std::sqrt(2.0) / 0.02, dispersion = scale * scale / (2.385 * 2.385), r = 0.05;
  const double each = 0.5 * scale * scale * std::log1p(w * r * r / (scale * scale));
  LightSolveOptions options;
  options.sky_terms = 0;
  EXPECT_NEAR(light_misfit(samples, options, Lights{}, Lights{}), 3 * 80 * each / (dispersion * dispersion), 1e-3);
  options.independent_residuals = 30;
  EXPECT_NEAR(light_misfit(samples, options, Lights{}, Lights{}), 3 * 80 * each / (dispersion * dispersion) * 30 / 120, 1e-3);
}

TEST(Deviations, OfATrustedSampleCountMore) {
  std::vector<LightSample> samples = pairs_apart(0.01, 1);
  samples[1].trust = 0.25f;
  Deviations d;
  ASSERT_TRUE(deviations(Lights{}, Lights{}, samples, 1, layout_of({}), 0, false, d));
  EXPECT_NEAR(d.w[1] / d.w[0], 0.25, 1e-6);
  EXPECT_NEAR(d.mean_r, std::log(0.5) + (0.005 - 0.25 * 0.005) / 1.25, 1e-6);
}

// The shared albedo is free below a coat too: whatever the lights are, the weighted residuals and their derivatives sum to nothing,
// each by the body's share of what it shows.
TEST(Deviations, BelowACoatLeaveTheAlbedoFree) {
  Lights x = some_lights();
  x.gloss = {true, 0.045, 0.3};
  const LightLayout layout{1, false, false, true};
  std::vector<LightSample> samples;
  const double rho = 0.37;
  for (std::size_t i = 0; i < 5; ++i) {
    samples.push_back(some_sample(i));
    if (i == 2) samples.back().angles.half = 0.999f;   // a highlight: half of what is seen is mirrored
    for (std::size_t c = 0; c < 3; ++c) {
      const Written w = written(x, samples.back(), c);
      samples.back().radiosity[c] = static_cast<float>((rho * w.below + w.mirrored) * std::exp(i == 2 ? 0.05 : i == 3 ? -0.03 : 0));
    }
  }
  Deviations d;
  ASSERT_TRUE(deviations(x, x, samples, 1, layout, 0, true, d));
  double residual = 0, size = 0;
  for (std::size_t k = 0; k < d.r.size(); ++k) {
    const Written w = written(x, samples[k], 1);
    residual += d.w[k] * d.robust[k] * rho * w.below / (rho * w.below + w.mirrored) * (d.r[k] - d.mean_r);
    size += d.w[k] * std::fabs(d.r[k] - d.mean_r);
  }
  EXPECT_NEAR(d.mean_r, std::log(rho), 0.02);
  EXPECT_NEAR(residual / size, 0, 0.003);
  // Half a per cent more light of the flash, the albedo following: each residual changes as its derivative, less the mean's, says.
  Lights more = x;
  more.flash_intensity *= std::exp(1e-3);
  Deviations after;
  ASSERT_TRUE(deviations(more, x, samples, 1, layout, 0, false, after));
  for (std::size_t k = 0; k < d.r.size(); ++k) EXPECT_NEAR((after.r[k] - after.mean_r) - (d.r[k] - d.mean_r), 1e-3 * (d.j[k] - d.mean_j)[0], 4e-5) << k;
}

}  // namespace
}  // namespace chiaro::optimize
