#include "optimize/light_solve.h"

#include <gtest/gtest.h>

#include <cmath>

#include "stream/base/error.h"
#include "stream/base/parallel.h"
#include "stream/base/rng.h"

namespace chiaro::optimize {
namespace {

struct Truth {
  double flash = 12, ambient = 0.2, bounce = 1, noise = 0;
  double gathered = 0.4;   ///< size of G; 0 = convex
};

/// Surfels seen by three photographs from different distances.
std::vector<LightSample> make_samples(const Truth& truth, std::size_t count) {
  std::vector<LightSample> samples;
  for (std::size_t i = 0; i < count; ++i) {
    const auto a = uniform01x4(2, Purpose::kTest, i, 0);
    const float v = 3.14159265f * (0.4f + 0.6f * a[3]);
    for (std::uint32_t k = 0; k < 3; ++k) {
      const auto u = uniform01x4(2, Purpose::kTest, i, 1 + k);
      LightSample s;
      s.group = static_cast<std::uint32_t>(i);
      s.flash = (0.3f + 0.7f * u[0]) / static_cast<float>((1.0 + k) * (1.0 + k));
      s.sky[0] = v;
      for (std::size_t c = 0; c < 3; ++c) {
        s.gathered[c] = static_cast<float>(truth.gathered) * (0.2f + u[1 + c % 3]);
        const double h = truth.flash * static_cast<double>(s.flash) + truth.ambient * static_cast<double>(v) + truth.bounce * static_cast<double>(s.gathered[c]);
        const double rho = 0.2 + 0.6 * static_cast<double>(a[c]);
        s.radiosity[c] = static_cast<float>(rho * h * std::exp(truth.noise * normal01(3, Purpose::kTest, 100 * i + k, static_cast<std::uint32_t>(c))));
      }
      samples.push_back(s);
    }
  }
  return samples;
}

Lights start(double flash, double ambient) {
  Lights x;
  x.flash_intensity = flash;
  x.sky[0] = ambient;
  return x;
}

TEST(LightSolve, FindsTheLightsFromAnyStartWhereBouncesFixTheScale) {
  const auto samples = make_samples({}, 600);
  LightSolveOptions options;
  options.bounce_sd = 0;
  for (const double factor : {0.6, 1.0, 1.6}) {
    const LightSolution s = solve_lights(samples, {}, options, start(12 * factor, 0.05));
    EXPECT_NEAR(s.lights.flash_intensity, 12, 0.01) << factor;
    EXPECT_NEAR(s.lights.sky[0], 0.2, 0.001) << factor;
    EXPECT_TRUE(s.converged);
  }
}

TEST(LightSolve, AConvexBodyGivesTheRatioAndThePriorTheScale) {
  Truth truth;
  truth.gathered = 0;
  LightSolveOptions options;
  options.flash_ln_mean = std::log(13.0);
  options.flash_ln_sd = 0.05;
  const LightSolution s = solve_lights(make_samples(truth, 400), {}, options, start(9, 0.5));
  EXPECT_NEAR(s.lights.sky[0] / s.lights.flash_intensity, 0.2 / 12, 1e-4);
  EXPECT_NEAR(s.lights.flash_intensity, 13, 0.02);
  EXPECT_NEAR(std::sqrt(s.covariance(0, 0)), 0.05, 0.005);   // the data say nothing about the scale
}

TEST(LightSolve, AReferenceFixesTheScale) {
  Truth truth;
  truth.gathered = 0;
  const auto samples = make_samples(truth, 400);
  ReferenceSample reference;
  reference.sample = samples[0];
  for (std::size_t c = 0; c < 3; ++c) {
    const double h = truth.flash * static_cast<double>(samples[0].flash) + truth.ambient * static_cast<double>(samples[0].sky[0]);
    reference.albedo[c] = static_cast<double>(samples[0].radiosity[c]) / h;
  }
  LightSolveOptions options;
  options.flash_ln_mean = std::log(14.0);
  options.flash_ln_sd = 0.1;
  const LightSolution s = solve_lights(samples, {&reference, 1}, options, start(14, 0.1));
  EXPECT_NEAR(s.lights.flash_intensity, 12, 0.12);
  EXPECT_LT(std::sqrt(s.covariance(0, 0)), 0.02);
}

std::vector<LightSample> samples_of_a_convex_body() {
  Truth truth;
  truth.gathered = 0;
  return make_samples(truth, 400);
}

LightSolveOptions calibrated_to_five_percent() {
  LightSolveOptions options;
  options.flash_ln_mean = std::log(12.0);
  options.flash_ln_sd = 0.05;
  return options;
}

// On a convex body the samples fix the ratio of the lights and a reference the scale, with its own error where the flash lights it, and with that of the sky's
// share (3 %) besides where it lies in the flash's shadow: sd = 1 / sqrt(1 / prior^2 + 1 / error^2).
TEST(LightSolve, AReferenceInShadowSaysLessThanOneInLight) {
  const auto samples = samples_of_a_convex_body();
  const LightSolveOptions options = calibrated_to_five_percent();
  const auto sd = [&](float flash, float sky) {
    ReferenceSample reference;
    reference.sample.flash = flash;
    reference.sample.sky[0] = sky;
    for (std::size_t c = 0; c < 3; ++c) {
      reference.albedo[c] = 0.5;
      reference.sample.radiosity[c] = 0.5f * (12 * flash + 0.2f * sky);
    }
    return std::sqrt(solve_lights(samples, {&reference, 1}, options, start(12, 0.2)).covariance(0, 0));
  };
  EXPECT_NEAR(sd(1, 0), 1 / std::sqrt(400.0 + 1e4), 5e-4);
  EXPECT_NEAR(sd(0, 3), 1 / std::sqrt(400.0 + 1 / (1e-4 + 9e-4)), 2e-3);
}

// The same for light whose source nobody sees (half of it may be wrong) and for a normal that may be off; here half of the light is gathered, or the flash grazes.
TEST(LightSolve, ATargetSaysLessWhereUnseenSurfacesLightItOrItsNormalIsUncertain) {
  const auto samples = samples_of_a_convex_body();
  LightSolveOptions options = calibrated_to_five_percent();
  options.bounce_sd = 0;
  const auto sd = [&](float gathered, double unknown_share, float tan_flash, double normal_rad) {
    ReferenceSample reference;
    reference.sample.flash = 1;
    reference.sample.tan_flash = tan_flash;
    reference.normal_rad = normal_rad;
    reference.unknown_share = unknown_share;
    for (std::size_t c = 0; c < 3; ++c) {
      reference.sample.gathered[c] = gathered;
      reference.albedo[c] = 0.5;
      reference.sample.radiosity[c] = 0.5f * (12 + static_cast<float>(options.bounce_mean) * gathered);
    }
    return std::sqrt(solve_lights(samples, {&reference, 1}, options, start(12, 0.2)).covariance(0, 0));
  };
  const auto expected = [](double direct, double error2) { return 1 / std::sqrt(400 + direct * direct / (1e-4 + error2)); };
  EXPECT_NEAR(sd(0, 1, 2, 0.01), expected(1, 4e-4), 3e-4);
  EXPECT_NEAR(sd(0, 1, 2, 0.001), expected(1, 4e-6), 3e-4);
  EXPECT_NEAR(sd(12, 0, 0, 0.01), expected(0.5, 2.25e-4), 1e-3);
  EXPECT_NEAR(sd(12, 0.4, 0, 0.01), expected(0.5, 2.25e-4 + 0.01), 1e-3);
  // Of half as much gathered light, a third of all: half of 0.4 of it, and 3 % of it.
  options.bounce_mean = 0.5;
  EXPECT_NEAR(sd(12, 0.4, 0, 0.01), expected(2.0 / 3, std::pow(0.5 * 0.4 / 3, 2) + 1e-4), 1e-3);
}

// Lights far too dark make albedos above 1. With nothing else known they are pulled up until albedos are possible.
TEST(LightSolve, NoSurfaceReflectsMoreThanItReceives) {
  Truth truth;
  truth.gathered = 0;
  LightSolveOptions options;
  options.flash_ln_mean = std::log(3.0);   // a quarter of the truth: albedos of 0.2 .. 0.8 become 0.8 .. 3.2
  options.flash_ln_sd = 0.35;
  options.flash_is_guess = true;
  const LightSolution s = solve_lights(make_samples(truth, 400), {}, options, start(3, 0.05));
  EXPECT_GT(s.lights.flash_intensity, 6);
  EXPECT_LT(s.lights.flash_intensity, 12);
  EXPECT_NEAR(s.lights.sky[0] / s.lights.flash_intensity, 0.2 / 12, 1e-3);
  EXPECT_FALSE(s.scale_known);
}

// ... and a bound is no measurement: the deviation stays that of the guess.
TEST(LightSolve, WhatIsOnlyBoundedIsNotKnown) {
  Truth truth;
  truth.gathered = 0;
  LightSolveOptions options;
  options.flash_ln_mean = std::log(3.0);
  options.flash_ln_sd = 0.35;
  options.flash_is_guess = true;
  EXPECT_NEAR(std::sqrt(solve_lights(make_samples(truth, 400), {}, options, start(3, 0.05)).covariance(0, 0)), 0.35, 0.03);
}

// No flash anywhere: the ambient light is what it was guessed to be, and as uncertain.
TEST(LightSolve, WithoutAnyFlashAGuessHoldsTheAmbientLight) {
  Truth truth;
  truth.gathered = 0;
  auto samples = make_samples(truth, 400);
  for (LightSample& s : samples) s.flash = 0;
  LightSolveOptions options;
  options.flash_ln_mean = std::log(12.0);
  options.flash_ln_sd = 0.05;
  options.ambient_guess = 0.3;
  const LightSolution s = solve_lights(samples, {}, options, start(12, 0.3));
  EXPECT_FALSE(s.scale_known);
  EXPECT_NEAR(s.lights.flash_intensity, 12, 0.01);
  EXPECT_NEAR(s.lights.sky[0], 0.3, 0.1);
  EXPECT_NEAR(std::sqrt(s.covariance(1, 1)), 0.35 * 0.3, 0.01);
}

// Scatter of 30 % where 2 % is expected: however many samples there are, they do not outvote the prior.
TEST(LightSolve, DataThatTheModelDoesNotExplainLeaveThePriorItsSay) {
  Truth truth;
  truth.noise = 0.3;
  LightSolveOptions options;
  options.flash_ln_mean = std::log(12.0);
  options.flash_ln_sd = 0.1;
  const LightSolution s = solve_lights(make_samples(truth, 5000), {}, options, start(12, 0.2));
  EXPECT_GT(std::sqrt(s.covariance(0, 0)), 0.05);
}

TEST(LightSolve, StandsOutliers) {
  Truth truth;
  truth.noise = 0.01;
  auto samples = make_samples(truth, 1500);
  for (std::size_t i = 0; i < samples.size(); i += 10)
    for (float& b : samples[i].radiosity) b *= 3;   // a highlight in every tenth
  LightSolveOptions options;
  options.bounce_sd = 0;
  const LightSolution s = solve_lights(samples, {}, options, start(20, 0));
  EXPECT_NEAR(s.lights.flash_intensity / 12, 1, 0.03);
  EXPECT_NEAR(s.lights.sky[0] / 0.2, 1, 0.05);
}

TEST(LightSolve, ItsUncertaintyCoversItsError) {
  double squares = 0;
  constexpr int kTrials = 12;
  for (int trial = 0; trial < kTrials; ++trial) {
    Truth truth;
    truth.noise = 0.02;
    auto samples = make_samples(truth, 300);
    for (std::size_t i = 0; i < samples.size(); ++i)
      for (std::size_t c = 0; c < 3; ++c)
        samples[i].radiosity[c] *= std::exp(0.02f * static_cast<float>(normal01(50 + static_cast<std::uint64_t>(trial), Purpose::kTest, i, static_cast<std::uint32_t>(c))));
    LightSolveOptions options;
    options.bounce_sd = 0;
    const LightSolution s = solve_lights(samples, {}, options, start(12, 0.1));
    squares += std::pow(std::log(s.lights.flash_intensity / 12), 2) / s.covariance(0, 0);
  }
  const double z = std::sqrt(squares / kTrials);
  EXPECT_GT(z, 0.4);
  EXPECT_LT(z, 1.9);   // chi-square of 12 trials, with the robust weights' approximation
}

TEST(LightSolve, TheSkyIsNeverDarkerThanBlack) {
  Truth truth;
  truth.ambient = 0;
  truth.noise = 0.01;
  LightSolveOptions options;
  options.bounce_sd = 0;
  const LightSolution s = solve_lights(make_samples(truth, 500), {}, options, start(10, 0.3));
  EXPECT_GE(s.lights.sky[0], 0);
  EXPECT_LT(s.lights.sky[0], 0.01);
}

/// Each surfel of make_samples() once more, without flash, under a sky of this colour.
void add_photographs_without_flash(std::vector<LightSample>& samples, const Truth& truth, const std::array<double, 3>& colour) {
  std::vector<LightSample> all;
  for (std::size_t i = 0; i < samples.size(); ++i) {
    LightSample s = samples[i];
    for (std::size_t c = 0; c < 3; ++c) {
      const double bounced = truth.bounce * static_cast<double>(s.gathered[c]), flash = truth.flash * static_cast<double>(s.flash), sky = truth.ambient * static_cast<double>(s.sky[0]);
      const double albedo = static_cast<double>(s.radiosity[c]) / (flash + sky + bounced);
      s.radiosity[c] = static_cast<float>(albedo * (flash + colour[c] * sky + bounced));
    }
    all.push_back(s);
    if (i % 3 != 2) continue;   // one for the three with flash
    LightSample dark = s;
    dark.flash = 0;
    for (std::size_t c = 0; c < 3; ++c) {
      const double flash = truth.flash * static_cast<double>(s.flash), sky = colour[c] * truth.ambient * static_cast<double>(s.sky[0]);
      const double albedo = static_cast<double>(s.radiosity[c]) / (flash + sky + truth.bounce * static_cast<double>(s.gathered[c]));
      dark.gathered[c] = 0.1f * s.gathered[c];
      dark.radiosity[c] = static_cast<float>(albedo * (sky + truth.bounce * static_cast<double>(dark.gathered[c])));
    }
    all.push_back(dark);
  }
  samples = all;
}

// Surfels that all see the sky and the flash alike say nothing about their ratio; one look without flash does, and about the sky's colour.
TEST(LightSolve, APhotographWithoutFlashMeasuresTheAmbientLightAndItsColour) {
  Truth truth;
  std::vector<LightSample> samples = make_samples(truth, 300);
  const std::array<double, 3> colour{1.3, 1, 0.6};
  add_photographs_without_flash(samples, truth, colour);
  LightSolveOptions options;
  options.flash_ln_mean = std::log(12.0);
  options.flash_ln_sd = 0.05;
  options.sky_colour = true;
  const LightSolution s = solve_lights(samples, {}, options, start(12, 0.05));
  EXPECT_NEAR(s.lights.sky[0] / s.lights.flash_intensity, 0.2 / 12, 2e-5);
  EXPECT_NEAR(s.lights.sky_colour[0], 1.3, 0.005);
  EXPECT_EQ(s.lights.sky_colour[1], 1);
  EXPECT_NEAR(s.lights.sky_colour[2], 0.6, 0.005);
  EXPECT_EQ(s.covariance.rows(), 5);   // flash, sky, red, blue, bounce
  options.sky_colour = false;
  EXPECT_GT(solve_lights(samples, {}, options, start(12, 0.05)).scatter, 10 * s.scatter);   // a grey sky cannot explain them
}

// Richer models never fit worse; whether they fit better by more than ln(residuals) for each parameter is what decides between them.
TEST(LightSolve, TheMisfitTellsAColouredSkyFromAGreyOne) {
  for (const double red : {1.0, 1.2}) {
    Truth truth;
    truth.noise = 0.02;
    std::vector<LightSample> samples = make_samples(truth, 800);
    add_photographs_without_flash(samples, truth, {red, 1, 1});
    LightSolveOptions grey, coloured;
    coloured.sky_colour = true;
    const Lights base = solve_lights(samples, {}, grey, start(12, 0.2)).lights, rich = solve_lights(samples, {}, coloured, start(12, 0.2)).lights;
    const double gain = 2 * (light_misfit(samples, grey, base, base) - light_misfit(samples, grey, rich, base)), price = 2 * std::log(independent_residuals(samples, grey));
    EXPECT_NEAR(independent_residuals(samples, grey), 2000, 1e-9);
    if (red > 1) {
      EXPECT_GT(gain, 5 * price);
    } else {
      EXPECT_LT(gain, price);
    }
  }
}

// A floor of albedo 0.4 lights half of the surfels from below; the misfit without it is far larger than its one parameter costs, and where there is none it is not.
TEST(LightSolve, FindsTheAlbedoOfAFloor) {
  for (const double albedo : {0.4, 0.0}) {
    Truth truth;
    truth.noise = 0.01;
    std::vector<LightSample> samples = make_samples(truth, 800);
    for (std::size_t i = 0; i < samples.size(); ++i) {
      LightSample& s = samples[i];
      const auto u = uniform01x4(5, Purpose::kTest, i, 0);
      s.hidden[0] = samples[i].group % 2 ? 0.5f * s.sky[0] : 0.0f;
      s.floor_flash = s.hidden[0] * 0.05f * u[0];
      if (!(albedo > 0)) continue;
      Lights with = start(truth.flash, truth.ambient), without = with;
      with.floor = true;
      with.floor_albedo = albedo;
      for (int c = 0; c < 3; ++c) s.radiosity[static_cast<std::size_t>(c)] *= static_cast<float>(irradiance(with, s, c) / irradiance(without, s, c));
    }
    LightSolveOptions plain, floor;
    plain.bounce_sd = floor.bounce_sd = 0;
    floor.floor = true;
    const LightSolution base = solve_lights(samples, {}, plain, start(12, 0.2)), found = solve_lights(samples, {}, floor, start(12, 0.2));
    const double gain = 2 * (light_misfit(samples, plain, base.lights, base.lights) - light_misfit(samples, plain, found.lights, base.lights));
    if (albedo > 0) {
      EXPECT_NEAR(found.lights.floor_albedo, albedo, 0.03);
      EXPECT_NEAR(found.lights.flash_intensity, 12, 0.1);
      EXPECT_GT(gain, 5 * std::log(independent_residuals(samples, plain)));
      EXPECT_EQ(found.covariance.rows(), 4);   // flash, sky, floor, bounce
    } else {
      EXPECT_LT(gain, std::log(independent_residuals(samples, plain)));
    }
  }
}

// No sample says anything: everything is where it was believed to be, and as certain.
TEST(LightSolve, WhereNothingIsSaidThePriorsHold) {
  LightSolveOptions options;
  options.flash_ln_mean = std::log(7.0);
  options.flash_ln_sd = 0.1;
  options.sky_terms = 4;
  options.sky_colour = options.floor = options.gloss = true;
  options.bounce_mean = 1.02;
  options.bounce_sd = 0.03;
  Lights from = start(5, 0.2);
  from.sky[1] = 0.1;
  from.sky[5] = 0.3;   // no unknown
  from.sky_colour = {2, 1, 0.7};
  from.floor = true;
  from.floor_albedo = 0.6;
  from.gloss = {true, 0.06, 0.4};
  from.bounce = 0.9;
  const LightSolution s = solve_lights({}, {}, options, from);
  EXPECT_TRUE(s.converged);
  EXPECT_TRUE(s.scale_known);
  EXPECT_NEAR(s.lights.flash_intensity, 7, 1e-4);
  EXPECT_NEAR(s.lights.sky[1], 0, 1e-4);
  EXPECT_EQ(s.lights.sky[5], 0);
  EXPECT_NEAR(s.lights.sky_colour[0], 1, 1e-4);
  EXPECT_NEAR(s.lights.sky_colour[2], 1, 1e-4);
  EXPECT_NEAR(s.lights.floor_albedo, 0.3, 1e-4);
  EXPECT_NEAR(s.lights.gloss.reflectance, 0.04, 1e-5);
  EXPECT_NEAR(s.lights.gloss.roughness, 0.25, 1e-4);
  EXPECT_NEAR(s.lights.bounce, 1.02, 1e-5);
  const double sd[] = {0.1, 0, 0.2, 0.2, 0.2, 0.5, 0.5, 0.3, 0.2, 0.5, 0.03};   // flash, sky (its mean is free), colours, floor, coat, bounce
  ASSERT_EQ(s.covariance.rows(), 11);
  for (Eigen::Index k = 0; k < 11; ++k) {
    if (k != 1) EXPECT_NEAR(std::sqrt(s.covariance(k, k)), sd[k], 1e-3 * sd[k]) << k;
  }
}

TEST(LightSolve, WhatPriorsCostIsSaid) {
  Truth truth;
  LightSolveOptions options;
  options.flash_ln_mean = std::log(13.0);
  options.flash_ln_sd = 0.02;
  options.bounce_sd = 0;
  options.independent_residuals = 1e9;
  const LightSolution s = solve_lights(make_samples(truth, 600), {}, options, start(12, 0.2));
  const double off = std::log(s.lights.flash_intensity / 13) / 0.02;
  EXPECT_LT(off, -2);
  EXPECT_NEAR(s.outside_misfit, 0.5 * off * off, 1e-3);
}

TEST(LightSolve, AReferenceAloneMakesTheScaleKnown) {
  Truth truth;
  truth.gathered = 0;
  ReferenceSample reference;
  reference.sample.flash = 1;
  for (std::size_t c = 0; c < 3; ++c) {
    reference.albedo[c] = 0.5;
    reference.sample.radiosity[c] = 6;
  }
  const LightSolution s = solve_lights(make_samples(truth, 400), {&reference, 1}, {}, start(14, 0.1));
  EXPECT_TRUE(s.scale_known);
  EXPECT_NEAR(s.lights.flash_intensity, 12, 0.01);
  LightSolveOptions guessed;
  guessed.ambient_guess = 0.3;
  guessed.flash_ln_mean = std::log(12.0);
  guessed.flash_ln_sd = 0.05;
  EXPECT_FALSE(solve_lights(make_samples(truth, 400), {}, guessed, start(14, 0.1)).scale_known);
}

// A surface that only the flash lights beside one that only bounces light: the flash is known as well as the gathered light, 1.3 %, however many and however good they are.
TEST(LightSolve, WhatIsWrongWithAllGatheredLightIsWrongWithTheFlash) {
  std::vector<LightSample> samples;
  for (std::uint32_t i = 0; i < 2000; ++i) {
    LightSample lit, shaded;
    lit.group = shaded.group = i;
    lit.flash = 0.5f;
    lit.radiosity.fill(0.5f * 12 * 0.5f);
    shaded.gathered.fill(2);
    shaded.radiosity.fill(1);
    samples.push_back(lit);
    samples.push_back(shaded);
  }
  LightSolveOptions options;
  options.sky_terms = 0;
  options.bounce_sd = 0;
  const LightSolution s = solve_lights(samples, {}, options, start(11, 0));
  EXPECT_NEAR(s.lights.flash_intensity, 12, 1e-3);
  EXPECT_NEAR(std::sqrt(s.covariance(0, 0)), 0.013, 1e-4);
  // Where it does not prevail it is as good as what else there is.
  for (LightSample& sample : samples)
    if (sample.flash == 0) {
      sample.flash = 0.3f;
      sample.radiosity.fill(0.5f * (12 * 0.3f + 2));
    }
  EXPECT_LT(std::sqrt(solve_lights(samples, {}, options, start(11, 0)).covariance(0, 0)), 0.002);
}

// Twice the scatter of 10 %, of which 2 to 3 are expected: each residual is worth a quarter, and a quarter as many are independent.
TEST(LightSolve, ScatterCountsTwiceAgainstCertainty) {
  const auto sd = [](double noise) {
    Truth truth;
    truth.noise = noise;
    truth.gathered = 0;
    LightSolveOptions options;
    options.sky_terms = 1;
    options.bounce_sd = 0;
    options.flash_ln_mean = std::log(12.0);
    options.flash_ln_sd = 1e-4;
    const LightSolution s = solve_lights(make_samples(truth, 4000), {}, options, start(12, 0.2));
    EXPECT_NEAR(s.scatter / noise, 1, 0.1);
    return std::sqrt(s.covariance(1, 1));
  };
  EXPECT_NEAR(sd(0.2) / sd(0.1), 4, 0.8);
}

TEST(LightSolve, FloorAndCoatStayPossible) {
  std::vector<LightSample> samples = make_samples({}, 800);
  for (std::size_t i = 0; i < samples.size(); ++i) {
    samples[i].hidden[0] = samples[i].group % 2 ? 0.5f * samples[i].sky[0] : 0.0f;
    samples[i].floor_flash = samples[i].hidden[0] * 0.05f * uniform01(5, Purpose::kTest, i, 0);
    Lights with = start(12, 0.2), without = with;
    with.floor = true;
    with.floor_albedo = 2.5;   // whiter than white
    for (int c = 0; c < 3; ++c) samples[i].radiosity[static_cast<std::size_t>(c)] *= static_cast<float>(irradiance(with, samples[i], c) / irradiance(without, samples[i], c));
  }
  LightSolveOptions options;
  options.bounce_sd = 0;
  options.floor = true;
  EXPECT_LE(solve_lights(samples, {}, options, start(12, 0.2)).lights.floor_albedo, 0.95);
  LightSolveOptions coat;
  coat.flash_ln_mean = std::log(7.0);
  coat.flash_ln_sd = 0.1;
  coat.gloss = true;
  Lights from = start(5, 0.2);
  from.gloss = {true, 0.5, 0.9};
  coat.max_iterations = 1;
  const Lights stepped = solve_lights({}, {}, coat, from).lights;
  EXPECT_LE(stepped.gloss.reflectance, 0.08);
  EXPECT_LE(stepped.gloss.roughness, 0.6);
}

TEST(LightSolve, ASkyThatIsNotSolvedForHasNoColour) {
  Lights from = start(12, 0.2);
  from.sky_colour = {2, 1, 0.5};
  const LightSolution s = solve_lights(make_samples({}, 200), {}, {}, from);
  EXPECT_EQ(s.lights.sky_colour, (std::array<double, 3>{1, 1, 1}));
}

TEST(LightSolve, SaysWhenThereIsNothingToSolveFrom) {
  EXPECT_THROW(solve_lights({}, {}, {}, start(1, 0)), Error);
}

TEST(LightSolve, IsTheSameForAnyThreads) {
  const auto samples = make_samples({}, 2000);
  const auto solve = [&](int threads) {
    const ThreadLimit limit(threads);
    return solve_lights(samples, {}, {}, start(9, 0.1)).lights.flash_intensity;
  };
  EXPECT_EQ(solve(1), solve(8));
}

}  // namespace
}  // namespace chiaro::optimize
