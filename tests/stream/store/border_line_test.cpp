#include "stream/store/border_line.h"

#include <gtest/gtest.h>

#include <cmath>
#include <numbers>

#include "stream/base/rng.h"

namespace chiaro::stream {
namespace {

// Evenly drawn points of the half-plane x * u + y * v <= border, one to a unit of area, seen from the origin.
struct HalfPlane {
  std::vector<float> x, y;
  HalfPlane(double angle, double border, std::uint64_t seed) {
    const double u = std::cos(angle), v = std::sin(angle);
    for (std::uint64_t i = 0; i < 64; ++i) {
      const auto r = uniform01x4(seed, Purpose::kTest, i, 0);
      const double px = 8 * r[0] - 4, py = 8 * r[1] - 4;
      if (px * u + py * v > border) continue;
      x.push_back(static_cast<float>(px));
      y.push_back(static_cast<float>(py));
    }
  }
};

TEST(BorderLine, LiesWhereTheSurfaceEnds) {
  double distance = 0, turned = 0;
  constexpr int kTimes = 400;
  for (int i = 0; i < kTimes; ++i) {
    const double angle = 2 * std::numbers::pi * i / kTimes;
    const HalfPlane surface(angle, 0.3, static_cast<std::uint64_t>(i));
    const auto border = find_border_line(surface.x, surface.y, 3, 1, 0);
    ASSERT_TRUE(border) << i;
    EXPECT_NEAR(std::hypot(border->u, border->v), 1, 1e-5);
    distance += border->distance / kTimes;
    turned += std::acos(std::min(1.0, border->u * std::cos(angle) + border->v * std::sin(angle))) / kTimes;
  }
  EXPECT_NEAR(0.3 - distance, 1.0 / 6, 0.05);   // the outermost of six strips of one spacing's width
  EXPECT_LT(turned, 0.3);                       // radians
}

TEST(BorderLine, KeepsAllNeighboursAndAddsTheMargin) {
  for (std::uint64_t i = 0; i < 200; ++i) {
    const HalfPlane surface(1.1, 0.2, 1000 + i);
    const auto exact = find_border_line(surface.x, surface.y, 3, 1, 0), wide = find_border_line(surface.x, surface.y, 3, 1, 0.4f);
    ASSERT_TRUE(exact && wide);
    EXPECT_NEAR(wide->distance - exact->distance, 0.4f, 1e-6f);
    for (std::size_t k = 0; k < surface.x.size(); ++k)
      if (std::hypot(surface.x[k], surface.y[k]) <= 3) EXPECT_LE(surface.x[k] * exact->u + surface.y[k] * exact->v, exact->distance + 1e-6f);
  }
}

TEST(BorderLine, PointsInTheMiddleHaveNone) {
  int found = 0;
  for (std::uint64_t i = 0; i < 400; ++i) {
    const HalfPlane surface(0, 10, 5000 + i);
    found += find_border_line(surface.x, surface.y, 3, 1, 0.4f).has_value();
  }
  EXPECT_LE(found, 8);   // expected: two. Nothing beyond distance 1 has a chance of exp(-8.25) in each of some twenty directions
}

TEST(BorderLine, ACornerIsCutAcrossItsMiddle) {
  std::vector<float> x, y;
  for (int i = 0; i <= 3; ++i)
    for (int k = 0; k <= 3; ++k)
      if (i + k > 0) x.push_back(static_cast<float>(-i)), y.push_back(static_cast<float>(-k));
  const auto border = find_border_line(x, y, 3, 1, 0.5f);
  ASSERT_TRUE(border);
  EXPECT_NEAR(std::atan2(border->v, border->u), std::numbers::pi / 4, 0.11);
  EXPECT_FLOAT_EQ(border->distance, 0.5f);
}

TEST(BorderLine, OnePointAloneHasSomeLineAtItsMargin) {
  const auto border = find_border_line({}, {}, 3, 1, 0.5f);
  ASSERT_TRUE(border);
  EXPECT_FLOAT_EQ(border->distance, 0.5f);
}

}  // namespace
}  // namespace chiaro::stream
