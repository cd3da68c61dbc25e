#include "optimize/normal_scatter.h"

#include <gtest/gtest.h>

#include <cmath>

#include "stream/base/rng.h"

namespace chiaro::optimize {
namespace {

/// Points of a sphere of radius 1 about 0.02 apart, their normals turned by a random angle of this rms.
double scatter_of_sphere(double rms_rad) {
  Proxy proxy;
  constexpr int kPoints = 30000;
  for (int i = 0; i < kPoints; ++i) {
    const double z = 1 - 2 * (i + 0.5) / kPoints, r = std::sqrt(1 - z * z), a = i * 2.39996323;
    const Vec3d p(r * std::cos(a), r * std::sin(a), z), u = p.cross(std::fabs(z) < 0.9 ? Vec3d(0, 0, 1) : Vec3d(1, 0, 0)).normalized(), v = p.cross(u);
    const double s = rms_rad / std::sqrt(2.0);
    const auto at = static_cast<std::uint64_t>(i);
    proxy.position.push_back(p.cast<float>());
    proxy.normal.push_back((p + s * normal01(1, Purpose::kTest, at, 0) * u + s * normal01(1, Purpose::kTest, at, 1) * v).normalized().cast<float>());
    proxy.radius.push_back(0.01f);
  }
  const NearestPoints nearest(proxy.position);
  return normal_scatter_rad(proxy, nearest);
}

TEST(NormalScatter, IsTheErrorOfEachNormalAndNotTheCurvature) {
  EXPECT_LT(scatter_of_sphere(0), 0.002);
  for (const double rms : {0.02, 0.1}) EXPECT_NEAR(scatter_of_sphere(rms), rms, 0.05 * rms);
}

}  // namespace
}  // namespace chiaro::optimize
