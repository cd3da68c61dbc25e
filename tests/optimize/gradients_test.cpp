#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <numbers>

#include "optimize/adam.h"
#include "optimize/observe.h"
#include "tests/optimize/lit.h"

namespace chiaro::optimize {
namespace {

using tests::Lit;
using tests::SampledPoint;

constexpr std::size_t kSide = 120;       // surfels a side of each plate
constexpr float kAlbedo[4][3] = {{0.7f, 0.5f, 0.3f}, {0.4f, 0.6f, 0.2f}, {0.5f, 0.55f, 0.6f}, {0.2f, 0.3f, 0.8f}};   // floor low, high, wall low, high

// By Mitsuba 3.9.1's path replay: tests/peers/gradients_mitsuba.py --rounds 24 --spp 256. Standard errors: albedos 2e-5 at most, flash 1.2e-5, sky 3.8e-5.
constexpr double kAlbedoGradient[4][3] = {{0.035484, 0.017674, 0.000991}, {0.003469, 0.020639, -0.008627}, {0.030034, 0.033870, 0.034728}, {-0.009841, 0.000916, 0.044806}};
constexpr double kFlashGradient = 0.033819, kSkyGradient = 0.133861;
// Surfels are points: next to the corner the gathered light is coarser than the path tracer's. Measured: 6e-5 at most with 14 400 surfels a plate, 1.1e-4 with 3 600.
constexpr double kTolerance = 1e-4;

/// The scene of gradients_mitsuba.py: floor and wall of 1 m x 1 m, each in two halves of one albedo.
std::vector<SampledPoint> corner() {
  std::vector<SampledPoint> points = tests::square_points(kSide, 1.0, {0.5, 0.5, 0}, {0, 0, 1}, 1);
  const auto wall = tests::square_points(kSide, 1.0, {0, 0.5, 0.5}, {1, 0, 0}, 2);
  points.insert(points.end(), wall.begin(), wall.end());
  return points;
}

TEST(Adam, GradientsThroughCachedTransportAreThoseOfMitsuba) {
  const Lit s(corner(), 256);
  const Proxy& proxy = s.proxy;

  const std::size_t n = proxy.size();
  Observation o;
  o.seen.assign(n, 0);      // cast_flash fills what no photograph sees
  o.flash.assign(n, 0.0f);
  o.tan_flash.assign(n, 0.0f);
  o.radiosity.assign(3 * n, static_cast<float>(std::numbers::pi * 0.25));
  cast_flash(proxy, *s.tracer, {0.9, 0.4, 1.2}, o);
  o.seen.assign(n, 1);
  AdamState x;
  x.flash_intensity = 3;
  x.ambient = 0.2;
  x.albedo.resize(3 * n);
  std::vector<std::size_t> part(n);
  for (std::size_t i = 0; i < n; ++i) {
    const double y = static_cast<double>(proxy.position[i].y()) + proxy.origin_in_world.y();
    part[i] = (proxy.normal[i].x() > 0.5f ? 2u : 0u) + (y > 0.5 ? 1u : 0u);
    std::copy(std::begin(kAlbedo[part[i]]), std::end(kAlbedo[part[i]]), x.albedo.begin() + static_cast<std::ptrdiff_t>(3 * i));
  }
  AdamGradient g;
  adam_loss(s.transport, o, x, 6, &g);
  double sum[4][3] = {};
  for (std::size_t i = 0; i < n; ++i)
    for (std::size_t c = 0; c < 3; ++c) sum[part[i]][c] += static_cast<double>(g.albedo[3 * i + c]);
  for (std::size_t p = 0; p < 4; ++p)
    for (std::size_t c = 0; c < 3; ++c) EXPECT_NEAR(sum[p][c], kAlbedoGradient[p][c], kTolerance) << "part " << p << ", channel " << c;
  EXPECT_NEAR(g.flash_intensity, kFlashGradient, kTolerance);
  EXPECT_NEAR(g.ambient, kSkyGradient, 3 * kTolerance);      // all three channels of both plates
}

}  // namespace
}  // namespace chiaro::optimize
