/// Where new points go: on the surface that the discs make up, evenly, and nowhere beyond it.
#include "blend/insert.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>

#include "stream/base/rng.h"

namespace chiaro::blend {
namespace {

constexpr double kEdge = 1;

/// A cloud whose discs are searched one by one.
struct Cloud {
  std::vector<Vec3d> positions;
  std::vector<Vec3f> normals;
  float spacing = 0.02f;
  bool oriented = true;

  std::vector<NewPoint> refined(int level) const {
    std::vector<NewPoint> points;
    for (std::size_t i = 0; i < positions.size(); ++i) {
      std::vector<NearDisc> around;
      for (std::size_t k = 0; k < positions.size(); ++k)
        if (const Vec3f offset = (positions[k] - positions[i]).cast<float>(); k != i && offset.norm() <= kReachSpacings * spacing) around.push_back({offset, normals[k]});
      insert_around({positions[i], normals[i], oriented, spacing}, around, kEdge, level, points);
    }
    return points;
  }
};

/// One point a square of the spacing, jittered, on the plane through the origin with this normal.
Cloud plane(const Vec3d& normal, bool flip_some = false) {
  Cloud cloud;
  const Vec3d u = normal.unitOrthogonal(), v = normal.cross(u);
  const int n = 30;
  for (int i = 0; i < n * n; ++i) {
    const auto jitter = uniform01x4(3, Purpose::kTest, static_cast<std::uint64_t>(i), 0);
    const double a = (i % n + static_cast<double>(jitter[0])) / n, b = (static_cast<double>(i / n) + static_cast<double>(jitter[1])) / n;
    cloud.positions.push_back(static_cast<double>(cloud.spacing) * n * (a * u + b * v));
    cloud.normals.push_back((flip_some && i % 3 == 0 ? Vec3d(-normal) : normal).cast<float>());
  }
  cloud.oriented = !flip_some;
  return cloud;
}

double nearest_pair(const std::vector<NewPoint>& points) {
  double least = 1e300;
  for (std::size_t i = 0; i < points.size(); ++i)
    for (std::size_t k = 0; k < i; ++k) least = std::min(least, (points[i].from_anchor - points[k].from_anchor).norm());
  return least;
}

TEST(Insert, LevelsHalveTheAreaOfAPoint) {
  EXPECT_DOUBLE_EQ(lattice_spacing(2, 0, 1), 2);
  EXPECT_DOUBLE_EQ(lattice_spacing(2, 4, 1), 0.5);
  EXPECT_DOUBLE_EQ(lattice_spacing(2, 4, 0.64f), 0.5 / std::sqrt(static_cast<double>(0.64f)));   // seen at a slant
  for (int level = 0; level < 20; ++level) {
    EXPECT_NEAR(std::pow(lattice_spacing(1, level, 1) / lattice_spacing(1, level + 1, 1), 2), 2, 1e-12);
    EXPECT_EQ(lattice_level(1, lattice_spacing(1, level, 0.7f) * 1.1, 0.7f), level);
  }
  EXPECT_EQ(lattice_level(1, 5, 1), 0);
}

TEST(Insert, NewPointsLieOnThePlaneAndAreEven) {
  const Vec3d normal = Vec3d(0.3, -0.5, 0.8).normalized();
  for (const bool flip : {false, true}) {
    const Cloud cloud = plane(normal, flip);
    const int level = 14;   // 1 / 128 in the lattice's plane
    const double apart = lattice_spacing(kEdge, level, static_cast<float>(normal.cwiseAbs().maxCoeff()));
    const std::vector<NewPoint> points = cloud.refined(level);
    // Inside, one a square of the lattice's spacing, but for places where the cloud has one.
    const double area = std::pow(static_cast<double>(cloud.spacing) * 30, 2);
    EXPECT_GT(static_cast<double>(points.size()), 0.75 * area / (apart * apart));
    EXPECT_LT(static_cast<double>(points.size()), area / (apart * apart));
    EXPECT_GT(nearest_pair(points), 0.8 / 128);
    for (const NewPoint& p : points)
      for (const Vec3d& q : cloud.positions) ASSERT_GT((p.from_anchor - q).norm(), 0.499 * apart);
    for (const NewPoint& p : points) {
      ASSERT_NEAR(normal.dot(p.from_anchor), 0, 1e-6);
      ASSERT_NEAR(std::abs(normal.dot(p.normal.cast<double>())), 1, 1e-5);
    }
  }
}

TEST(Insert, CoarserLevelsArePartOfFinerOnes) {
  const Cloud cloud = plane(Vec3d::UnitZ());
  const auto key = [](const Vec3d& p) { return std::pair(std::lround(p.x() * 4096), std::lround(p.y() * 4096)); };
  std::vector<std::pair<long, long>> fine;
  for (const NewPoint& p : cloud.refined(15)) fine.push_back(key(p.from_anchor));
  std::sort(fine.begin(), fine.end());
  std::size_t missing = 0;
  const auto coarse = cloud.refined(14);
  for (const NewPoint& p : coarse) missing += !std::binary_search(fine.begin(), fine.end(), key(p.from_anchor));
  EXPECT_EQ(missing, 0u);   // on a plane a finer lattice keeps no more distance from the cloud's points
  EXPECT_GT(fine.size(), 1.8 * static_cast<double>(coarse.size()));
}

TEST(Insert, NothingIsInsertedBeyondTheBorder) {
  const Cloud cloud = plane(Vec3d::UnitZ());
  Box3d box;
  for (const Vec3d& p : cloud.positions) box.extend(p);
  const auto points = cloud.refined(16);
  EXPECT_GT(points.size(), 10000u);
  for (const NewPoint& p : points) {
    const Vec3d outside = (box.min - p.from_anchor).cwiseMax(p.from_anchor - box.max);
    ASSERT_LE(std::max(outside.x(), outside.y()), 1e-6) << p.from_anchor.transpose();
  }
}

TEST(Insert, PointsOfACurvedSurfaceLieOnIt) {
  Cloud cloud;
  const double radius = 0.25;
  const int n = static_cast<int>(4 * M_PI * radius * radius / static_cast<double>(cloud.spacing * cloud.spacing));
  for (int i = 0; i < n; ++i) {
    const double z = 1 - 2 * (i + 0.5) / n, phi = i * M_PI * (3 - std::sqrt(5.0)), w = std::sqrt(1 - z * z);
    const Vec3d normal(w * std::cos(phi), w * std::sin(phi), z);
    cloud.positions.push_back(radius * normal);
    cloud.normals.push_back(normal.cast<float>());
  }
  const auto points = cloud.refined(14);
  ASSERT_GT(points.size(), cloud.positions.size());
  // Planes of neighbours lie outside by half their distance squared over the radius.
  const double sag = std::pow(1.6 * static_cast<double>(cloud.spacing), 2) / (2 * radius);
  for (const NewPoint& p : points) {
    ASSERT_NEAR(p.from_anchor.norm(), radius, 0.5 * sag);
    ASSERT_GT(p.from_anchor.normalized().dot(p.normal.cast<double>()), std::cos(0.03));
  }
}

TEST(Insert, NoiseOfTheCloudIsAveraged) {
  Cloud cloud = plane(Vec3d::UnitZ());
  double cloud_square = 0, square = 0;
  for (std::size_t i = 0; i < cloud.positions.size(); ++i) {
    cloud.positions[i].z() = 0.2 * static_cast<double>(cloud.spacing) * (static_cast<double>(uniform01(4, Purpose::kTest, i, 0)) - 0.5);
    cloud_square += cloud.positions[i].z() * cloud.positions[i].z();
  }
  const auto points = cloud.refined(14);
  for (const NewPoint& p : points) square += p.from_anchor.z() * p.from_anchor.z();
  // Some nine discs take part with unlike weights: a third of the deviation would be left with equal ones.
  EXPECT_LT(std::sqrt(square / static_cast<double>(points.size())), 0.5 * std::sqrt(cloud_square / static_cast<double>(cloud.positions.size())));
}

/// Every point of the cloud once more, `apart` above it, with the normal that is asked for.
Cloud with_layer(Cloud cloud, double apart, const Vec3f& normal) {
  for (std::size_t i = 0, n = cloud.positions.size(); i < n; ++i) {
    cloud.positions.push_back(cloud.positions[i] + Vec3d(0, 0, apart));
    cloud.normals.push_back(normal);
  }
  return cloud;
}

TEST(Insert, AnotherLayerTakesNoPart) {
  const Cloud one = plane(Vec3d::UnitZ());
  const double far = 1.3 * static_cast<double>(one.spacing), near = 0.5 * static_cast<double>(one.spacing);
  // a sheet above another one, and the two sides of a thin wall
  for (const auto& [cloud, apart] : {std::pair{with_layer(one, far, Vec3f::UnitZ()), far}, std::pair{with_layer(one, near, -Vec3f::UnitZ()), near}}) {
    const auto points = cloud.refined(14);
    ASSERT_GT(points.size(), one.positions.size()) << apart;
    for (const NewPoint& p : points) {
      ASSERT_NEAR(std::min(std::abs(p.from_anchor.z()), std::abs(p.from_anchor.z() - apart)), 0, 1e-6);
      ASSERT_NEAR(std::abs(p.normal.z()), 1, 1e-5);
    }
  }
}

TEST(Insert, NormalsOfUnknownSignAreTurnedAlike) {
  Cloud cloud;   // a cylinder around y, every other normal turned
  cloud.oriented = false;
  const double radius = 0.15, step = static_cast<double>(cloud.spacing);
  const int around = static_cast<int>(2 * M_PI * radius / step);
  for (int i = 0; i < around; ++i)
    for (int k = 0; k < 20; ++k) {
      const double angle = 2 * M_PI * (i + 0.5 * (k % 2)) / around;
      const Vec3d normal(std::sin(angle), 0, std::cos(angle));
      cloud.positions.push_back(radius * normal + Vec3d(0, k * step, 0));
      cloud.normals.push_back((k % 2 == 0 ? normal : Vec3d(-normal)).cast<float>());
    }
  const auto points = cloud.refined(14);
  ASSERT_GT(points.size(), 100u);
  for (const NewPoint& p : points) {
    const Vec3d outwards = Vec3d(p.from_anchor.x(), 0, p.from_anchor.z()).normalized();
    ASSERT_GT(std::abs(outwards.dot(p.normal.cast<double>())), std::cos(0.05));
  }
}

TEST(Insert, TheOtherFaceOfAnEdgeTakesNoPart) {
  for (const double angle : {1.05, 1.5708, 2.2}) {   // between the normals of floor and wall, which meet in the line x = z = 0
    Cloud cloud;
    const Vec3d wall(std::sin(angle), 0, std::cos(angle)), up(-std::cos(angle), 0, std::sin(angle));
    for (int i = 0; i < 20; ++i)
      for (int k = 0; k < 20; ++k) {
        const double a = (i + 0.5) * static_cast<double>(cloud.spacing), b = (k + 0.5) * static_cast<double>(cloud.spacing);
        cloud.positions.emplace_back(a, b, 0);
        cloud.normals.push_back(Vec3f::UnitZ());
        cloud.positions.emplace_back(a * up + b * Vec3d::UnitY());
        cloud.normals.push_back(wall.cast<float>());
      }
    const auto points = cloud.refined(14);
    ASSERT_GT(points.size(), cloud.positions.size()) << angle;
    for (const NewPoint& p : points) ASSERT_NEAR(std::min(std::abs(p.from_anchor.z()), std::abs(wall.dot(p.from_anchor))), 0, 1e-6) << angle << ": " << p.from_anchor.transpose();
  }
}

}  // namespace
}  // namespace chiaro::blend
