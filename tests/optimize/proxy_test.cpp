#include "optimize/proxy.h"

#include <gtest/gtest.h>

#include <cmath>

#include "optimize/albedo_mean.h"
#include "optimize/fields.h"
#include "optimize/proxy_file.h"
#include "optimize/radiosity.h"
#include "stream/base/error.h"
#include "stream/base/file.h"
#include "tests/optimize/lit.h"

namespace chiaro::optimize {
namespace {

constexpr float kSpacing = 0.1f;

void add(Proxy& proxy, const Vec3f& position, const Vec3f& normal) {
  proxy.position.push_back(position);
  proxy.normal.push_back(normal);
  proxy.radius.push_back(0.7f * kSpacing);
  proxy.oriented.push_back(0);
}

/// z = 0, facing up.
Proxy plane(int side) {
  Proxy proxy;
  for (int i = 0; i < side; ++i)
    for (int k = 0; k < side; ++k) add(proxy, {kSpacing * static_cast<float>(i), kSpacing * static_cast<float>(k), 0}, Vec3f::UnitZ());
  return proxy;
}

TEST(Orient, VotesDecideAndTheRestFollowsItsNeighboursOutwards) {
  Proxy proxy = plane(20);
  const std::size_t n = proxy.size();
  for (std::size_t i = 0; i < n; ++i)
    if (i % 3 != 0) proxy.normal[i] = -proxy.normal[i];
  std::vector<float> votes(n, 0.0f);
  for (std::size_t i = 0; i < n; ++i)
    if (proxy.position[i].x() < 0.25f) votes[i] = proxy.normal[i].z();   // seen from above
  const NearestPoints nearest(proxy.position);
  orient(proxy, votes, nearest);
  for (std::size_t i = 0; i < n; ++i) {
    ASSERT_EQ(proxy.normal[i], Vec3f::UnitZ()) << i;
    ASSERT_EQ(proxy.oriented[i], 1);
  }
}

TEST(Orient, WhatTheFileSaysStaysAndAnIslandKeepsItsSign) {
  Proxy proxy = plane(20);
  const std::size_t island = proxy.size();
  for (int i = 0; i < 20; ++i) add(proxy, {100 + kSpacing * static_cast<float>(i), 0, 0}, -Vec3f::UnitZ());
  proxy.oriented[5] = 1;
  std::vector<float> votes(proxy.size(), 0.0f);
  votes[5] = -1;
  votes[300] = 1;
  const NearestPoints nearest(proxy.position);
  orient(proxy, votes, nearest);
  for (std::size_t i = 0; i < island; ++i) ASSERT_EQ(proxy.normal[i], Vec3f::UnitZ()) << i;
  for (std::size_t i = island; i < proxy.size(); ++i) {
    ASSERT_EQ(proxy.normal[i], -Vec3f::UnitZ());
    ASSERT_EQ(proxy.oriented[i], 0);
  }
}

/// A floor and a wall that meet at x = 0, and a second floor close below the first.
Proxy corner() {
  Proxy proxy;
  for (int i = 0; i < 12; ++i)
    for (int k = 0; k < 12; ++k) {
      const float a = kSpacing * (static_cast<float>(i) + 0.5f), b = kSpacing * static_cast<float>(k);
      add(proxy, {a, b, 0}, Vec3f::UnitZ());
      add(proxy, {0, b, a}, Vec3f::UnitX());
      add(proxy, {a, b, -2 * kSpacing}, Vec3f::UnitZ());
    }
  return proxy;
}

bool is_wall(const Proxy& proxy, std::size_t i) { return proxy.normal[i].x() > 0.5f; }
float of_surface(const Proxy& proxy, std::size_t i) { return is_wall(proxy, i) ? 10.0f : proxy.position[i].z() < -0.01f ? 20.0f : 1.0f; }

TEST(Smoother, DoesNotMixSurfaces) {
  const Proxy proxy = corner();
  const NearestPoints nearest(proxy.position);
  const Smoother smoother = make_smoother(proxy, nearest);
  std::vector<float> values;
  for (std::size_t i = 0; i < proxy.size(); ++i) values.insert(values.end(), {of_surface(proxy, i), -of_surface(proxy, i)});
  smoother.apply(values, 2, 4);
  for (std::size_t i = 0; i < proxy.size(); ++i) {
    // exp(-0.5 (2 / 0.7)^2) = 1.7 % to the floor below, a pass, of a few neighbours; nothing of the wall
    ASSERT_NEAR(values[2 * i], of_surface(proxy, i), is_wall(proxy, i) ? 1e-3 : 1.6) << proxy.position[i].transpose();
    ASSERT_EQ(values[2 * i + 1], -values[2 * i]);
  }
}

TEST(Smoother, TakesNoiseOffWhatIsEven) {
  const Proxy proxy = plane(30);
  const NearestPoints nearest(proxy.position);
  const Smoother smoother = make_smoother(proxy, nearest);
  std::vector<float> values(proxy.size(), 0.0f);
  const std::size_t middle = 15 * 30 + 15;
  values[middle] = 1;
  std::vector<float> none = values;
  smoother.apply(none, 1, 0);
  EXPECT_EQ(none, values);
  smoother.apply(values, 1, 1);
  float most = 0;
  for (const float v : values) most = std::max(most, v);
  EXPECT_LT(most, 0.15f);
  EXPECT_GT(values[middle + 1], 0.02f);
}

TEST(Stencil, ReadsTheSurfaceThatThePointLiesOn) {
  const Proxy proxy = corner();
  const NearestPoints nearest(proxy.position);
  std::vector<float> values;
  for (std::size_t i = 0; i < proxy.size(); ++i) values.push_back(of_surface(proxy, i));
  // Beside the crease most neighbours are the wall's.
  EXPECT_NEAR(interpolate<1>(stencil_at(proxy, nearest, {0.02f, 0.5f, 0}, Vec3f::UnitZ()), values)[0], 1, 0.05);
  EXPECT_NEAR(interpolate<1>(stencil_at(proxy, nearest, {0, 0.5f, 0.02f}, Vec3f::UnitX()), values)[0], 10, 0.05);
  // Half way between the floors both count alike; at a quarter the nearer one does.
  EXPECT_NEAR(interpolate<1>(stencil_at(proxy, nearest, {0.6f, 0.5f, -0.04f}, Vec3f::UnitZ()), values)[0], 1, 1);
  const Stencil s = stencil_at(proxy, nearest, {0.31f, 0.52f, 0}, Vec3f::UnitZ());
  float sum = 0;
  for (const float w : s.weight) sum += w;
  EXPECT_NEAR(sum, 1, 1e-6);
}

TEST(Stencil, FollowsASlope) {
  const Proxy proxy = plane(30);
  const NearestPoints nearest(proxy.position);
  std::vector<float> values;
  for (const Vec3f& p : proxy.position) values.insert(values.end(), {p.x(), 2 * p.y()});
  for (const Vec3f& p : {Vec3f(1.45f, 1.45f, 0), Vec3f(1.5f, 1.3f, 0), Vec3f(1.52f, 1.31f, 0), Vec3f(1.48f, 1.56f, 0)}) {
    const auto v = interpolate<2>(stencil_at(proxy, nearest, p, Vec3f::UnitZ()), values);
    EXPECT_NEAR(v[0], p.x(), 0.2 * kSpacing) << p.transpose();
    EXPECT_NEAR(v[1], 2 * p.y(), 0.4 * kSpacing) << p.transpose();
  }
}

// By hand: exp(-d^2 / (half of the farthest's)) in the plane, and exp(-(height / radius)^2 / 2) of what lies above or below it.
TEST(Stencil, WeighsByDistanceAndByPlane) {
  Proxy proxy;
  add(proxy, {0.05f, 0, 0}, Vec3f::UnitZ());
  add(proxy, {0, 0.1f, 0}, Vec3f::UnitZ());
  add(proxy, {0, 0, 0.1f}, Vec3f::UnitZ());
  const NearestPoints nearest(proxy.position);
  const Stencil s = stencil_at(proxy, nearest, Vec3f::Zero(), Vec3f::UnitZ());
  double weight[3] = {};
  for (std::size_t j = 0; j < kStencil; ++j) weight[s.index[j]] += static_cast<double>(s.weight[j]);
  EXPECT_NEAR(weight[0] / weight[1], std::exp((0.01 - 0.0025) / 0.005), 1e-3);
  EXPECT_NEAR(weight[2] / weight[1], std::exp(-0.5 / (0.7 * 0.7)), 1e-4);
  EXPECT_NEAR(weight[0] + weight[1] + weight[2], 1, 1e-6);
}

// Nothing near has a normal like that: the least unlike serves, and the nearest of those.
TEST(Stencil, IsNeverEmpty) {
  Proxy proxy;
  for (int i = 0; i < 4; ++i) add(proxy, {kSpacing * static_cast<float>(i), 0, 0}, Vec3f::UnitZ());
  for (int i = 0; i < 4; ++i) add(proxy, {kSpacing * static_cast<float>(i), kSpacing, 0}, Vec3f(0, 0.8f, 0.6f));
  const NearestPoints nearest(proxy.position);
  const Stencil s = stencil_at(proxy, nearest, {0, 0, 0}, Vec3f(0, 0.6f, -0.8f));
  std::size_t used = 0;
  for (std::size_t j = 0; j < kStencil; ++j)
    if (s.weight[j] > 0) {
      ++used;
      EXPECT_EQ(s.weight[j], 1);
      EXPECT_EQ(s.index[j], 4u);
    }
  EXPECT_EQ(used, 1u);
}

/// Two surfels that see half of each other and half of the sky.
Transport facing_pair() {
  Transport t;
  t.rays = 4;
  t.hits = {1, Transport::kSky, 1, Transport::kSky, 0, 0, Transport::kSky, Transport::kSky};
  t.sky.assign(2 * kSkyTerms, 0.0f);
  return t;
}

// B = rho (E + b F B), solved by hand: B0 = rho0 (E0 + b / 2 B1), B1 = rho1 (E1 + b / 2 B0).
TEST(Radiosity, OfTwoThatFaceEachOtherIsTheirClosedForm) {
  const Transport t = facing_pair();
  const double b = 1.2, rho[2] = {0.5, 0.8}, e[2] = {2, 1};
  const double first = rho[0] * (e[0] + b / 2 * rho[1] * e[1]) / (1 - rho[0] * rho[1] * b * b / 4), second = rho[1] * (e[1] + b / 2 * first);
  std::vector<float> albedo, direct;
  for (int i = 0; i < 2; ++i)
    for (int c = 0; c < 3; ++c) {
      albedo.push_back(static_cast<float>(rho[i]));
      direct.push_back(static_cast<float>(e[i]));
    }
  const std::vector<float> all = forward_radiosity(t, albedo, direct, b, 60);
  EXPECT_NEAR(all[0], first, 1e-5);
  EXPECT_NEAR(all[4], second, 1e-5);
  EXPECT_NEAR(forward_radiosity(t, albedo, direct, b, 1)[0], rho[0] * e[0], 1e-6) << "one scattering";
  EXPECT_NEAR(forward_radiosity(t, albedo, direct, b, 2)[0], rho[0] * (e[0] + b / 2 * rho[1] * e[1]), 1e-6);
  // Of the first it is measured, and is another; of the second it follows.
  Observation o;
  o.seen = {1, 0};
  o.flash = {0, static_cast<float>(e[1])};
  o.radiosity = {3, 3, 3, 0, 0, 0};
  Lights lights;
  lights.flash_intensity = 1;
  lights.bounce = b;
  Smoother still;
  still.k = 1;
  still.index = {0, 1};
  still.weight = {1, 1};
  const std::vector<float> g = tests::complete_alone(t, still, 4, lights, albedo, o, 30, 1e-8);
  EXPECT_EQ(o.radiosity[0], 3);
  EXPECT_NEAR(o.radiosity[4], rho[1] * (e[1] + b / 2 * 3), 1e-5);
  EXPECT_NEAR(g[0], 0.5 * rho[1] * (e[1] + b / 2 * 3), 1e-5);
  EXPECT_NEAR(g[3], 1.5, 1e-6);
  // What a floor sends up of the flash lights the second as well.
  o.floor_flash = {0, 0.5f};
  lights.floor = true;
  lights.floor_albedo = 0.4;
  tests::complete_alone(t, still, 4, lights, albedo, o, 30, 1e-8);
  EXPECT_NEAR(o.radiosity[4], rho[1] * (e[1] + 0.4 * 0.5 + b / 2 * 3), 1e-5);
  o.floor_flash.clear();
  lights.floor = false;
  // What is gathered is smoothed.
  Smoother mean;
  mean.k = 2;
  mean.index = {0, 1, 1, 0};
  mean.weight = {0.75f, 0.25f, 0.75f, 0.25f};
  EXPECT_NEAR(tests::complete_alone(t, mean, 1, lights, albedo, o, 30, 1e-8)[0], 0.75 * g[0] + 0.25 * g[3], 1e-5);
}

TEST(Radiosity, SweepsUntilNothingMovesOrAsOftenAsAllowed) {
  const Transport t = facing_pair();
  Smoother still;
  still.k = 1;
  still.index = {0, 1};
  still.weight = {1, 1};
  const std::vector<float> albedo(6, 0.9f);
  Lights lights;
  const auto sweeps = [&](int most, double tolerance) {
    Observation o;
    o.seen = {0, 0};
    o.flash = {1, 1};
    o.radiosity.assign(6, 0.0f);
    int done = 0;
    tests::complete_alone(t, still, 0, lights, albedo, o, most, tolerance, &done);
    return done;
  };
  EXPECT_EQ(sweeps(3, 1e-6), 3);
  // Each sweep moves by 0.45 of what the one before did; the sum tends to 1 / (1 - 0.45).
  EXPECT_EQ(sweeps(100, 1e-3), 1 + static_cast<int>(std::ceil(std::log(1e-3 / 0.55) / std::log(0.45))));
}

TEST(DirectIrradiance, IsFlashSkyAndWhatAFloorMakesOfBoth) {
  Transport t;
  for (int i = 0; i < 2; ++i)
    for (std::size_t k = 0; k < kSkyTerms; ++k) {
      t.sky.push_back(static_cast<float>(i + 1) + 0.1f * static_cast<float>(k));
      t.hidden.push_back(0.2f * static_cast<float>(i + 1) - 0.01f * static_cast<float>(k));
    }
  Lights l;
  l.flash_intensity = 3;
  l.sky = {0.5, 0.1, 0, 0, -0.2, 0, 0, 0, 0.05};
  l.sky_colour = {1.5, 1, 0.4};
  const std::vector<float> flash{0.3f, 0.7f}, by_floor{0.11f, 0.05f};
  const auto expect = [&](std::span<const float> floor_flash) {
    const std::vector<float> e = direct_irradiance(t, flash, floor_flash, l);
    for (std::size_t i = 0; i < 2; ++i) {
      const auto term = [&](const std::vector<float>& v, std::size_t k) { return static_cast<double>(v[i * kSkyTerms + k]); };
      double sky = 0;
      for (const std::size_t k : {0, 1, 4, 8}) sky += l.sky[k] * (term(t.sky, k) - (l.floor ? term(t.hidden, k) : 0));
      if (l.floor) sky += l.floor_albedo * 0.5 * term(t.hidden, 0);
      const double lit = 3 * (static_cast<double>(flash[i]) + (l.floor && !floor_flash.empty() ? l.floor_albedo * static_cast<double>(by_floor[i]) : 0));
      for (std::size_t c = 0; c < 3; ++c) EXPECT_NEAR(e[3 * i + c], lit + l.sky_colour[c] * sky, 1e-5) << i << ' ' << c;
    }
  };
  expect(by_floor);
  l.floor = true;
  l.floor_albedo = 0.6;
  expect(by_floor);
  expect({});
  l.sky = {};
  l.sky[1] = -1;   // a shape without a mean: no light is taken away
  EXPECT_NEAR(direct_irradiance(t, flash, {}, l)[0], 3 * 0.3f, 1e-6);
}

TEST(AlbedoMean, IsTheWeightedMeanOfLogarithmsUnderEachPhotographsLight) {
  Proxy proxy = plane(2);
  Transport t;
  t.sky.assign(4 * kSkyTerms, 0.0f);
  for (std::size_t i = 0; i < 4; ++i) t.sky[i * kSkyTerms] = 3;
  Lights lights;
  lights.flash_intensity = 2;
  lights.sky[0] = 0.2;
  lights.sky[1] = 0.1;
  EXPECT_NEAR(exposed(lights, 3).sky[0], 0.6, 1e-12);
  EXPECT_NEAR(exposed(lights, 3).sky[1], 0.3, 1e-12);
  AlbedoMean mean(4);
  const std::vector<float> gathered(12, 0.4f);
  // Of albedo 0.5 and 0.3 by two photographs, the first ten times as certain; surfel 1 by the first, 2 by nobody, 3 whiter than white.
  const auto photograph = [&](float flash, double albedo, float variance, std::vector<std::uint8_t> seen) {
    Observation o;
    o.seen = std::move(seen);
    for (auto* v : {&o.spread, &o.noise, &o.gradient, &o.tan_flash}) v->assign(4, 0.0f);
    o.flash.assign(4, flash);
    o.variance.assign(4, variance);
    o.radiosity.assign(12, static_cast<float>(albedo * (2 * static_cast<double>(flash) + 0.6 + 0.4)));
    for (std::size_t c = 9; c < 12; ++c) o.radiosity[c] *= 10;
    mean.add(t, o, gathered, lights, proxy, {});
  };
  photograph(1, 0.5, 0.001f, {1, 1, 0, 1});
  photograph(1, 0.3, 0.01f, {1, 0, 0, 1});
  // Deviations beside: 2 % by the model, 3 % of the light that is not the flash's, a third here.
  const double other = 1.0 / 3, w1 = 1 / (4e-4 + 9e-4 * other * other + 0.001), w2 = 1 / (4e-4 + 9e-4 * other * other + 0.01);
  const std::vector<float> albedo = mean.albedo({0, 1, 0, 3});
  EXPECT_NEAR(albedo[0], std::exp((w1 * std::log(0.5) + w2 * std::log(0.3)) / (w1 + w2)), 1e-5);
  EXPECT_NEAR(albedo[3], 0.5, 1e-6);
  EXPECT_EQ(albedo[6], albedo[0]) << "as the nearest that is seen";
  EXPECT_EQ(albedo[9], 0.98f);
  EXPECT_EQ(AlbedoMean(4).albedo({})[0], 0.3f) << "nobody saw anything";
}

TEST(AlbedoMean, BelowACoatIsTheBodys) {
  const Proxy proxy = plane(2);
  Transport t;
  t.sky.assign(4 * kSkyTerms, 0.0f);
  Lights lights;
  lights.flash_intensity = 2;
  lights.gloss = {true, 0.05, 0.3};
  const Viewpoint from{Vec3f(0, 0, 1), Vec3f(0.1f, 0, 1)};
  Observation o;
  o.seen.assign(4, 1);
  for (auto* v : {&o.spread, &o.variance, &o.noise, &o.gradient, &o.tan_flash}) v->assign(4, 0.0f);
  o.flash.assign(4, 0.7f);
  for (std::size_t i = 0; i < 4; ++i) {
    const CoatFactors f = coat_factors(lights.gloss, gloss_angles(proxy.position[i], proxy.normal[i], from));
    for (int c = 0; c < 3; ++c) o.radiosity.push_back(static_cast<float>((0.35 * f.direct + f.direct_mirrored) * 1.4));
  }
  AlbedoMean mean(4);
  mean.add(t, o, std::vector<float>(12, 0.0f), lights, proxy, from);
  for (const float a : mean.albedo({0, 1, 2, 3})) EXPECT_NEAR(a, 0.35, 1e-5);
}

TEST(NearestSeen, IsTheSurfelItselfOrTheNearestThatAPhotographShows) {
  const Proxy proxy = plane(10);
  std::vector<std::uint16_t> times(100, 0);
  times[37] = 2;
  times[82] = 1;
  const auto found = nearest_seen_surfels(proxy, times);
  EXPECT_EQ(found[37], 37u);
  EXPECT_EQ(found[0], 37u);
  EXPECT_EQ(found[90], 82u);
  EXPECT_TRUE(nearest_seen_surfels(proxy, std::vector<std::uint16_t>(100, 0)).empty());
}

TEST(ProxyFile, HoldsTheNormalsAsTheyWereOriented) {
  const tests::Lit s(chiaro::tests::sphere_points(500, 1, {1, 2, 3}, false), 4);
  Proxy turned = s.proxy;
  for (std::size_t i = 0; i < turned.size(); i += 2) turned.normal[i] = -turned.normal[i];
  const auto path = s.folder.path() / "proxy.bin";
  write_proxy(turned, s.store.manifest().key, path);
  const Proxy back = read_proxy(s.store, path);
  EXPECT_EQ(back.normal, turned.normal);
  EXPECT_EQ(back.position, turned.position);
  EXPECT_EQ(back.metres_per_unit, turned.metres_per_unit);
  write_proxy(turned, "another", path);
  EXPECT_THROW(read_proxy(s.store, path), Error);
}

}  // namespace
}  // namespace chiaro::optimize
