#include "optimize/floor.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <numbers>

#include "stream/base/error.h"
#include "stream/base/parallel.h"
#include "tests/optimize/lit.h"

namespace chiaro::optimize {
namespace {

using tests::Lit;

/// z = 0 of the world.
Floor ground(const Proxy& proxy) { return {Vec3f::UnitZ(), static_cast<float>(-proxy.origin_in_world.z())}; }

/// Of the surfel nearest to the middle.
std::size_t middle_of(const Proxy& proxy) {
  std::size_t best = 0;
  for (std::size_t i = 1; i < proxy.size(); ++i)
    if (proxy.position[i].squaredNorm() < proxy.position[best].squaredNorm()) best = i;
  return best;
}

std::vector<float> by_floor(const Proxy& proxy, const Transport& transport, const Smoother& smoother, const surfels::Tracer& tracer, const Floor& floor, const Vec3d& flash) {
  return flash_by_floor(proxy, transport, smoother, tracer, floor, std::array{flash}).front();
}

TEST(Floor, HidesTheHalfOfTheSkyThatASurfaceFaces) {
  for (const auto& [normal, share] : {std::pair{Vec3d(0, 0, -1), 1.0}, std::pair{Vec3d(1, 0, 0), 0.5}, std::pair{Vec3d(0, 0, 1), 0.0}}) {
    const Lit s(chiaro::tests::square_points(30, 0.2, {0, 0, 1}, normal, 1), 256);
    const std::vector<float> hidden = hidden_by_floor(s.proxy, s.transport, s.smoother, ground(s.proxy));
    const std::size_t i = middle_of(s.proxy);
    EXPECT_NEAR(hidden[i * kSkyTerms] / std::numbers::pi, share, 0.005) << normal.transpose();
    EXPECT_LE(hidden[i * kSkyTerms], s.transport.sky[i * kSkyTerms] + 1e-5f);
    // The term that follows z: all of it comes from below, mean z of a cosine-distributed ray about the normal is 2/3 of it.
    if (share == 1) {
      EXPECT_NEAR(hidden[i * kSkyTerms + 2] / std::numbers::pi, -2.0 / 3, 0.005);
    }
  }
}

// A patch that faces the floor at height a, a flash at height b below its middle. The floor at distance s from the foot receives b / (b^2 + s^2)^1.5, and the patch
// gets a^2 / (pi (a^2 + s^2)^2) of what leaves it.
TEST(Floor, SendsBackTheFlashThatFallsOnIt) {
  const Lit s(chiaro::tests::square_points(30, 0.2, {0, 0, 1}, {0, 0, -1}, 1), 1024);
  constexpr double kA = 1, kB = 0.9;
  double expected = 0;
  constexpr double kStep = 1e-3;
  for (double r = kStep / 2; r < 60; r += kStep) expected += 2 * std::numbers::pi * r * kStep * kB / std::pow(kB * kB + r * r, 1.5) * kA * kA / (std::numbers::pi * std::pow(kA * kA + r * r, 2));
  const std::vector<float> e = by_floor(s.proxy, s.transport, s.smoother, *s.tracer, ground(s.proxy), {0, 0, kB});
  EXPECT_NEAR(static_cast<double>(e[middle_of(s.proxy)]) / expected, 1, 0.01);
  const std::vector<float> below = by_floor(s.proxy, s.transport, s.smoother, *s.tracer, ground(s.proxy), {0, 0, -0.5});
  EXPECT_EQ(below[middle_of(s.proxy)], 0) << "a flash under the floor";
}

// A flash above the patch: what the patch shades is dark, and most of what it sees is that.
TEST(Floor, LiesInTheShadowOfTheCloud) {
  const Lit s(chiaro::tests::square_points(40, 1, {0, 0, 0.2}, {0, 0, -1}, 1), 256);
  const Vec3d flash(0, 0, 1.5);
  const auto at_middle = [&](const std::vector<float>& e) { return e[middle_of(s.proxy)]; };
  MemoryBudget budget(16u << 20);
  surfels::Tracer empty(s.proxy.origin_in_world, budget);
  empty.commit();
  const float lit = at_middle(by_floor(s.proxy, s.transport, s.smoother, empty, ground(s.proxy), flash));
  const float shaded = at_middle(by_floor(s.proxy, s.transport, s.smoother, *s.tracer, ground(s.proxy), flash));
  EXPECT_GT(shaded, 0);
  EXPECT_LT(shaded, 0.25f * lit);
}

Mat3d looking_along(const Vec3d& forward, const Vec3d& down) {
  Mat3d r;
  r.row(2) = forward.normalized();
  r.row(1) = (down - down.dot(r.row(2)) * r.row(2).transpose()).normalized();
  r.row(0) = r.row(1).cross(r.row(2));
  return r;
}

TEST(Floor, IsFoundBelowTheCloud) {
  const Lit s(chiaro::tests::sphere_points(5000, 0.5, {3, 4, 5}, false), 16);
  const std::vector<Mat3d> cameras{looking_along({1, 0, -0.3}, {0, 0, -1}), looking_along({0, 1, 0.1}, {0.1, 0, -1}), looking_along({-1, -1, 0}, {0, 0.2, -1})};
  const auto floor = find_floor(s.proxy, cameras);
  ASSERT_TRUE(floor);
  EXPECT_EQ(floor->normal, Vec3f::UnitZ()) << "the cameras' mean is off by some degrees; the frame's axis is not";
  EXPECT_NEAR(static_cast<double>(floor->height) + s.proxy.origin_in_world.z(), 4.5, 0.005);
  const std::vector<Mat3d> confused{looking_along({1, 0, 0}, {0, 0, -1}), looking_along({1, 0, 0}, {0, 0, 1})};
  EXPECT_FALSE(find_floor(s.proxy, confused));
  EXPECT_FALSE(find_floor(s.proxy, {}));
}

// Each as by itself, to the last bit.
TEST(Floor, IsLitByManyFlashesAtOnce) {
  const Lit s(chiaro::tests::sphere_points(3000, 0.5, {0, 0, 1}, false), 32);
  const std::array flashes{Vec3d(1, 1, 1), Vec3d(-2, 0.3, 0.6), Vec3d(0.1, -1, 3)};
  const std::vector<std::vector<float>> all = flash_by_floor(s.proxy, s.transport, s.smoother, *s.tracer, ground(s.proxy), flashes);
  ASSERT_EQ(all.size(), flashes.size());
  for (std::size_t f = 0; f < flashes.size(); ++f) {
    EXPECT_EQ(all[f], by_floor(s.proxy, s.transport, s.smoother, *s.tracer, ground(s.proxy), flashes[f])) << f;
    EXPECT_GT(*std::max_element(all[f].begin(), all[f].end()), 0);
  }
}

TEST(Floor, IsTheSameForAnyThreadsAndFromDisk) {
  const Lit s(chiaro::tests::sphere_points(4000, 0.5, {0, 0, 0.6}, false), 32, 1);
  const auto both = [&](int threads) {
    const ThreadLimit limit(threads);
    std::vector<float> v = hidden_by_floor(s.proxy, s.transport, s.smoother, ground(s.proxy));
    const std::vector<float> e = by_floor(s.proxy, s.transport, s.smoother, *s.tracer, ground(s.proxy), {1, 1, 1});
    v.insert(v.end(), e.begin(), e.end());
    return v;
  };
  EXPECT_EQ(both(1), both(8));
  const std::vector<float> hidden = hidden_by_floor(s.proxy, s.transport, s.smoother, ground(s.proxy));
  write_floor(ground(s.proxy), hidden, s.folder.path() / "floor.bin");
  std::vector<float> back;
  const auto floor = read_floor(s.folder.path() / "floor.bin", s.proxy.size(), back);
  ASSERT_TRUE(floor);
  EXPECT_EQ(floor->height, ground(s.proxy).height);
  EXPECT_EQ(back, hidden);
  EXPECT_THROW(read_floor(s.folder.path() / "floor.bin", s.proxy.size() + 1, back), Error);
  EXPECT_THROW(read_floor(s.folder.path() / "none.bin", s.proxy.size(), back), Error);
  write_floor(std::nullopt, {}, s.folder.path() / "floor.bin");
  EXPECT_FALSE(read_floor(s.folder.path() / "floor.bin", s.proxy.size(), back));
}

TEST(Floor, StandsPointsBelowIt) {
  auto points = chiaro::tests::sphere_points(5000, 0.5, {0, 0, 1}, false);
  for (int i = 0; i < 3; ++i) points.push_back({Vec3d(0.1 * i, 0, -2), Vec3f::UnitZ()});   // outliers
  const Lit s(points, 4);
  const auto floor = find_floor(s.proxy, std::vector<Mat3d>{looking_along({1, 0, -0.3}, {0, 0, -1})});
  ASSERT_TRUE(floor);
  EXPECT_NEAR(static_cast<double>(floor->height) + s.proxy.origin_in_world.z(), 0.5, 0.01);
}

// Irradiance is per square metre: in units of half a metre a lamp at the same number of units is four times as bright.
TEST(Floor, SendsBackTheFlashPerSquareMetre) {
  Lit s(chiaro::tests::square_points(20, 0.2, {0, 0, 1}, {0, 0, -1}, 1), 64);
  const auto at_middle = [&] { return by_floor(s.proxy, s.transport, s.smoother, *s.tracer, ground(s.proxy), {0, 0, 0.9})[middle_of(s.proxy)]; };
  const float metres = at_middle();
  s.proxy.metres_per_unit = 0.5;
  EXPECT_NEAR(at_middle() / metres, 4, 1e-4);
}

// What is hidden are the rays of the transport, whatever their seed: half of what a wall sees is another wall, and of the rest the lower half the floor's.
TEST(Floor, HidesTheRaysThatTheTransportCast) {
  auto points = chiaro::tests::square_points(20, 1, {0, 0, 0.6}, {1, 0, 0}, 1);
  const auto wall = chiaro::tests::square_points(20, 1, {0.4, 0, 0.6}, {-1, 0, 0}, 2);
  points.insert(points.end(), wall.begin(), wall.end());
  Lit s(points, 32);
  s.transport = gather(s.proxy, *s.tracer, s.smoother, {32, 7, 0}, silent_reporter());
  std::vector<float> expected(s.proxy.size() * kSkyTerms, 0.0f);
  for (std::size_t i = 0; i < s.proxy.size(); ++i) {
    const RayFan fan(s.proxy, 7, i);
    for (std::size_t m = 0; m < 32; ++m) {
      const Vec3f d = fan.direction(m);
      if (s.transport.hits[32 * i + m] == Transport::kSky && d.z() < -1e-4f) expected[i * kSkyTerms] += 3.14159265f / 32;
    }
  }
  s.smoother.apply(expected, kSkyTerms, kSmoothPasses);
  const std::vector<float> hidden = hidden_by_floor(s.proxy, s.transport, s.smoother, ground(s.proxy));
  for (std::size_t i = 0; i < s.proxy.size(); ++i) ASSERT_NEAR(hidden[i * kSkyTerms], expected[i * kSkyTerms], 1e-4) << i;
}

}  // namespace
}  // namespace chiaro::optimize
