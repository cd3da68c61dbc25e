#include "optimize/gloss.h"

#include <gtest/gtest.h>

#include <cmath>
#include <numbers>

#include "optimize/gloss_light.h"
#include "stream/base/rng.h"

namespace chiaro::optimize {
namespace {

constexpr double kPi = std::numbers::pi, kIndex = 1.49;

double fresnel(double cosine) {
  const double t = std::sqrt(1 - (1 - cosine * cosine) / (kIndex * kIndex));
  const double s = (cosine - kIndex * t) / (cosine + kIndex * t), p = (t - kIndex * cosine) / (t + kIndex * cosine);
  return 0.5 * (s * s + p * p);
}

double smith(double cosine, double roughness) {
  if (!(cosine > 0)) return 0;
  const double tan2 = (1 - cosine * cosine) / (cosine * cosine);
  return 2 / (1 + std::sqrt(1 + roughness * roughness * tan2));
}

struct Integral {
  double reflected = 0, transmitted = 0;
};

/// Light from one direction on a rough dielectric, in one scattering: over all microfacets by their visible share (Walter et al. 2007).
Integral scattered(double roughness, double cosine) {
  const Vec3d in(std::sqrt(1 - cosine * cosine), 0, cosine);
  const double a2 = roughness * roughness;
  constexpr int kTheta = 400, kPhi = 64;
  Integral sum;
  for (int i = 0; i < kTheta; ++i)
    for (int k = 0; k < kPhi; ++k) {
      const double theta = (i + 0.5) / kTheta * kPi / 2, phi = (k + 0.5) / kPhi * 2 * kPi, c = std::cos(theta);
      const Vec3d m(std::sin(theta) * std::cos(phi), std::sin(theta) * std::sin(phi), c);
      const double facing = in.dot(m);
      if (!(facing > 0)) continue;
      const double t = 1 + c * c * (a2 - 1), d = a2 / (kPi * t * t), solid = std::sin(theta) * (kPi / 2 / kTheta) * (2 * kPi / kPhi);
      const double visible = smith(cosine, roughness) * facing * d / cosine * solid, f = fresnel(facing);
      const Vec3d back = 2 * facing * m - in, through = (facing / kIndex - std::sqrt(1 - (1 - facing * facing) / (kIndex * kIndex))) * m - in / kIndex;
      sum.reflected += visible * f * smith(back.z(), roughness);
      sum.transmitted += visible * (1 - f) * smith(-through.z(), roughness);
    }
  return sum;
}

TEST(Gloss, TheLobeAlongTheNormalIsWorkedByHand) {
  EXPECT_DOUBLE_EQ(gloss_lobe(0.5, {1, 1, 1}), 1.0);   // pi * 1 / (pi a^2) / 4
  EXPECT_DOUBLE_EQ(gloss_lobe(0.25, {1, 1, 1}), 4.0);
  EXPECT_EQ(gloss_lobe(0.25, {-0.1f, 1, 0.7f}), 0);
  EXPECT_EQ(gloss_lobe(0.25, {1, -0.1f, 0.7f}), 0);
}

TEST(Gloss, TransmissionFollowsTheMicrofacetIntegral) {
  for (const double roughness : {0.15, 0.2, 0.3, 0.4}) {
    const double along = scattered(roughness, 1).transmitted;
    for (const double degrees : {15.0, 30.0, 45.0, 60.0, 75.0}) {
      const double cosine = std::cos(degrees * kPi / 180);
      EXPECT_NEAR(coat_transmission(cosine), scattered(roughness, cosine).transmitted / along, 0.025) << roughness << ' ' << degrees;
    }
  }
}

TEST(Gloss, ReflectionFollowsTheMicrofacetIntegral) {
  for (const double degrees : {0.0, 30.0, 45.0, 60.0, 75.0}) {
    const double cosine = std::cos(degrees * kPi / 180);
    EXPECT_NEAR(coat_reflection(cosine), scattered(0.3, cosine).reflected / fresnel(1), 0.15) << degrees;
  }
}

TEST(Gloss, MeansAreThoseOverTheHemisphere) {
  double transmitted = 0, reflected = 0;
  constexpr int kSteps = 1000;
  for (int i = 0; i < kSteps; ++i) {
    const double cosine = (i + 0.5) / kSteps;
    transmitted += 2 * cosine * coat_transmission(cosine) / kSteps;
    reflected += 2 * cosine * coat_reflection(cosine) / kSteps;
  }
  EXPECT_NEAR(transmitted, kMeanTransmission, 1e-5);
  EXPECT_NEAR(reflected, kMeanReflection, 1e-5);
}

TEST(Gloss, WithoutItEverythingIsLambert) {
  const CoatFactors none = coat_factors({}, {0.5f, 0.6f, 0.9f});
  EXPECT_EQ(none.direct, 1);
  EXPECT_EQ(none.other, 1);
  EXPECT_EQ(none.direct_mirrored, 0);
  EXPECT_EQ(none.other_mirrored, 0);
}

/// Seven photographs around surfels, the flash beside the camera as on a bracket.
std::vector<LightSample> glossy_samples(const Gloss& gloss, std::size_t count, double noise) {
  Lights truth;
  truth.flash_intensity = 12;
  truth.sky[0] = 0.2;
  truth.gloss = gloss;
  std::vector<LightSample> samples;
  for (std::size_t i = 0; i < count; ++i) {
    const auto a = uniform01x4(5, Purpose::kTest, i, 0);
    for (std::uint32_t k = 0; k < 7; ++k) {
      const auto u = uniform01x4(5, Purpose::kTest, i, 1 + k);
      LightSample s;
      s.group = static_cast<std::uint32_t>(i);
      s.photograph = k;
      const double tilt = 1.2 * static_cast<double>(u[0]), turn = 6.2831853 * static_cast<double>(u[1]);
      const Vec3f camera = 1.8f * Vec3f(static_cast<float>(std::sin(tilt) * std::cos(turn)), static_cast<float>(std::sin(tilt) * std::sin(turn)), static_cast<float>(std::cos(tilt)));
      const Viewpoint from{camera, camera + Vec3f(0.15f, 0.1f, 0.05f)};
      s.angles = gloss_angles(Vec3f::Zero(), Vec3f::UnitZ(), from);
      s.flash = std::max(0.01f, s.angles.flash) * (0.3f + 0.7f * u[2]) / 3;
      s.sky[0] = 3.14159265f * (0.4f + 0.6f * a[3]);
      const CoatFactors f = coat_factors(gloss, s.angles);
      for (int c = 0; c < 3; ++c) {
        const auto at = static_cast<std::size_t>(c);
        s.gathered[at] = 0.3f * (0.2f + u[3]);
        const double rho = 0.1 + 0.5 * static_cast<double>(a[at]), direct = truth.flash_intensity * static_cast<double>(s.flash), other = other_irradiance(truth, s, c);
        const double b = rho * (f.direct * direct + f.other * other) + f.direct_mirrored * direct + f.other_mirrored * other;
        s.radiosity[at] = static_cast<float>(b * std::exp(noise * normal01(6, Purpose::kTest, 100 * i + k, static_cast<std::uint32_t>(c))));
      }
      s.variance = static_cast<float>(noise * noise);
      samples.push_back(s);
    }
  }
  return samples;
}

Lights some_lights() {
  Lights x;
  x.flash_intensity = 10;
  x.sky[0] = 0.1;
  return x;
}

TEST(Gloss, LightsAndCoatAreFoundTogether) {
  const auto samples = glossy_samples({true, 0.045, 0.2}, 1500, 0.01);
  LightSolveOptions options;
  options.bounce_sd = 0;
  const LightSolution lambert = solve_lights(samples, {}, options, some_lights());
  EXPECT_GT(std::fabs(std::log(lambert.lights.flash_intensity / 12)), 0.05);   // what this is for
  options.gloss = true;
  const LightSolution s = solve_lights(samples, {}, options, some_lights());
  EXPECT_NEAR(s.lights.flash_intensity, 12, 0.4);
  EXPECT_NEAR(s.lights.sky[0], 0.2, 0.01);
  EXPECT_NEAR(s.lights.gloss.reflectance, 0.045, 0.003);
  EXPECT_NEAR(s.lights.gloss.roughness, 0.2, 0.005);
  EXPECT_EQ(s.covariance.rows(), 5);   // flash, sky, reflectance, roughness, bounce
  EXPECT_LT(gloss_criterion(samples, {}, lambert.lights, s.lights), -50);
}

TEST(Gloss, NoneIsFoundOnLambertsSurfaces) {
  const auto samples = glossy_samples({}, 1500, 0.01);
  LightSolveOptions options;
  options.bounce_sd = 0;
  const LightSolution lambert = solve_lights(samples, {}, options, some_lights());
  options.gloss = true;
  const LightSolution coated = solve_lights(samples, {}, options, lambert.lights);
  EXPECT_GT(gloss_criterion(samples, {}, lambert.lights, coated.lights), 100);
}

/// ln of the mean albedo that a pixel has under these lights.
double ln_albedo(const Gloss& gloss, const GlossAngles& angles, double direct, double other, const std::array<double, 3>& radiosity) {
  const std::array<double, 3> whole{direct + other, direct + other, direct + other};
  const CoatedAlbedo r = coated_reading(gloss, angles, direct, whole, radiosity);
  double sum = 0;
  for (std::size_t c = 0; c < 3; ++c) sum += radiosity[c] / whole[c] * r.factor[c] / 3;
  return std::log(sum);
}

TEST(Gloss, APixelsAlbedoIsTheBodysAndMovesWithTheLightsAsSaid) {
  const Gloss gloss{true, 0.04, 0.25};
  const GlossAngles angles{0.9f, 0.92f, 0.97f};
  const double direct = 1.5, other = 0.4, rho = 0.3;
  const CoatFactors f = coat_factors(gloss, angles);
  const double b = rho * (f.direct * direct + f.other * other) + f.direct_mirrored * direct + f.other_mirrored * other;
  const std::array<double, 3> radiosity{b, b, b};
  EXPECT_NEAR(ln_albedo(gloss, angles, direct, other, radiosity), std::log(rho), 1e-12);
  const CoatedAlbedo r = coated_reading(gloss, angles, direct, {direct + other, direct + other, direct + other}, radiosity);
  EXPECT_GT(r.highlight, 0.1);
  constexpr double kStep = 1e-4, kTol = 1e-5;
  const double share = direct / (direct + other);
  EXPECT_NEAR(r.direct * share, -(ln_albedo(gloss, angles, direct * (1 + kStep), other, radiosity) - std::log(rho)) / kStep, 20 * kStep);
  EXPECT_NEAR(r.other * (1 - share), -(ln_albedo(gloss, angles, direct, other * (1 + kStep), radiosity) - std::log(rho)) / kStep, 20 * kStep);
  Gloss brighter = gloss, darker = gloss, broader = gloss, narrower = gloss;
  brighter.reflectance *= std::exp(kStep);
  darker.reflectance *= std::exp(-kStep);
  broader.roughness *= std::exp(kStep);
  narrower.roughness *= std::exp(-kStep);
  EXPECT_NEAR(r.reflectance, -(ln_albedo(brighter, angles, direct, other, radiosity) - ln_albedo(darker, angles, direct, other, radiosity)) / (2 * kStep), kTol);
  EXPECT_NEAR(r.roughness, -(ln_albedo(broader, angles, direct, other, radiosity) - ln_albedo(narrower, angles, direct, other, radiosity)) / (2 * kStep), kTol);
}

TEST(Gloss, AHighlightNeverTakesMoreThanThreeQuarters) {
  EXPECT_DOUBLE_EQ(below_coat(1, 0.5), 0.5);
  EXPECT_DOUBLE_EQ(below_coat(1, 0.9), 0.25);
}

// Under light from everywhere a coated surface sends out one amount, whatever the angle that it was seen under.
TEST(Gloss, WhatIsSentOutDoesNotDependOnTheCamera) {
  Proxy proxy;
  proxy.position = {Vec3f::Zero()};
  proxy.normal = {Vec3f::UnitZ()};
  Transport transport;
  transport.sky.assign(kSkyTerms, 0.0f);
  transport.sky[0] = 3.14159265f;
  Lights lights;
  lights.flash_intensity = 1;
  lights.sky[0] = 0.5;
  lights.gloss = {true, 0.04, 0.3};
  const double other = 0.5 * kPi, rho = 0.4;
  for (const double tilt : {0.0, 0.6, 1.1}) {
    const Viewpoint from{Vec3f(2 * static_cast<float>(std::sin(tilt)), 0, 2 * static_cast<float>(std::cos(tilt))), {}};
    const CoatFactors f = coat_factors(lights.gloss, gloss_angles(Vec3f::Zero(), Vec3f::UnitZ(), from));
    Observation o;
    o.seen = {1};
    for (auto* v : {&o.flash, &o.spread, &o.variance, &o.noise, &o.gradient, &o.tan_flash}) v->assign(1, 0.0f);
    o.radiosity.assign(3, static_cast<float>(other * (rho * f.other + f.other_mirrored)));
    const std::vector<float> measured = send_out(proxy, transport, from, {0, 0, 0}, lights, o);
    EXPECT_EQ(measured[0], static_cast<float>(other * (rho * f.other + f.other_mirrored)));
    EXPECT_NEAR(static_cast<double>(o.radiosity[1]), other * static_cast<double>(coated_albedo(lights.gloss, {static_cast<float>(rho)})[0]), 1e-5) << tilt;
  }
}

// By hand, for three angles that differ.
TEST(Gloss, FactorsAreThoseOfTheirAngles) {
  const Gloss gloss{true, 0.05, 0.3};
  const GlossAngles angles{0.6f, 0.8f, 0.95f};
  const CoatFactors f = coat_factors(gloss, angles);
  const double in = 1 - 0.3 * 0.16, out = 1 - 0.3 * 0.04;
  EXPECT_NEAR(f.direct, in * out, 1e-6);
  EXPECT_NEAR(f.other, 0.95 * out, 1e-6);
  EXPECT_NEAR(f.direct_mirrored, 0.05 * gloss_lobe(0.3, angles), 1e-12);
  EXPECT_NEAR(f.other_mirrored, 0.05 * (0.9 + 3 * 0.04), 1e-6);
}

// Of the flash the body sends out what it does to any side, and the coat what it does not let through.
TEST(Gloss, WhatIsSentOutOfTheFlashIsBodyAndCoat) {
  Proxy proxy;
  proxy.position = {Vec3f::Zero(), Vec3f::Zero()};
  proxy.normal = {Vec3f::UnitZ(), Vec3f::UnitZ()};
  Transport transport;
  transport.sky.assign(2 * kSkyTerms, 0.0f);
  Lights lights;
  lights.flash_intensity = 3;
  lights.gloss = {true, 0.05, 0.3};
  const Viewpoint from{Vec3f(1, 0, 2), Vec3f(2, 0, 1)};
  const CoatFactors f = coat_factors(lights.gloss, gloss_angles(Vec3f::Zero(), Vec3f::UnitZ(), from));
  Observation o;
  o.seen = {1, 0};
  for (auto* v : {&o.spread, &o.variance, &o.noise, &o.gradient, &o.tan_flash}) v->assign(2, 0.0f);
  o.flash = {0.4f, 0.4f};
  constexpr double kRho = 0.4, kLit = 1.2;
  o.radiosity.assign(6, static_cast<float>((kRho * f.direct + f.direct_mirrored) * kLit));
  const std::vector<float> measured = send_out(proxy, transport, from, std::vector<float>(6, 0.0f), lights, o);
  const double flash = 1 / std::sqrt(5.0), camera = 2 / std::sqrt(5.0);
  const double through_in = 1 - 0.3 * (1 - flash) * (1 - flash), through_out = 1 - 0.3 * (1 - camera) * (1 - camera);
  // The body's albedo is below_coat / (direct E): what leaves it passes the coat by 0.95 on the mean instead of towards the camera.
  const double body = kRho * through_in * through_out * kLit * 0.95 / through_out, coat = 0.05 * (0.9 + 3 * (1 - flash) * (1 - flash)) * kLit;
  EXPECT_NEAR(o.radiosity[1], body + coat, 1e-5);
  EXPECT_EQ(o.radiosity[4], measured[4]) << "nothing was seen there";
}

TEST(Gloss, ACoatHasToBeWorthItsTwoParameters) {
  const auto samples = glossy_samples({}, 200, 0.01);
  EXPECT_NEAR(gloss_criterion(samples, {}, some_lights(), some_lights()), 2 * std::log(independent_residuals(samples, {})), 1e-9);
}

}  // namespace
}  // namespace chiaro::optimize
