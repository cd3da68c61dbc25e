#include "tests/support/sampled_surface.h"

#include <cmath>
#include <cstring>
#include <numbers>

#include "stream/base/rng.h"
#include "stream/cloud/point_stream.h"
#include "stream/store/octree_build.h"

namespace chiaro::tests {

std::vector<SampledPoint> sphere_points(std::size_t count, double radius, const Vec3d& centre, bool inward) {
  std::vector<SampledPoint> points;
  const double golden = std::numbers::pi * (3 - std::sqrt(5.0));
  for (std::size_t i = 0; i < count; ++i) {
    const double z = 1 - (2 * static_cast<double>(i) + 1) / static_cast<double>(count), r = std::sqrt(1 - z * z), phi = golden * static_cast<double>(i);
    const Vec3d n(r * std::cos(phi), r * std::sin(phi), z);
    points.push_back({centre + radius * n, (inward ? -n : n).cast<float>()});
  }
  return points;
}

std::vector<SampledPoint> square_points(std::size_t n, double side, const Vec3d& centre, const Vec3d& normal, std::uint64_t seed) {
  const Vec3d u = normal.unitOrthogonal(), v = normal.cross(u);
  std::vector<SampledPoint> points;
  for (std::size_t i = 0; i < n * n; ++i) {
    const auto jitter = uniform01x4(seed, Purpose::kTest, i, 0);
    const double x = (static_cast<double>(i % n) + 0.3 + 0.4 * static_cast<double>(jitter[0])) / static_cast<double>(n) - 0.5;
    const double y = (static_cast<double>(i / n) + 0.3 + 0.4 * static_cast<double>(jitter[1])) / static_cast<double>(n) - 0.5;
    points.push_back({centre + side * (x * u + y * v), normal.cast<float>()});
  }
  return points;
}

std::vector<SampledPoint> blunt_wedge() {
  constexpr std::size_t kRow = 50, kStrip = 40;
  auto points = square_points(kRow, 1.0, {-kBlunt - 0.5, 0, 0}, {0, 0, 1}, 7);
  const double half = 0.5 * std::sqrt(0.5);
  const auto below = square_points(kRow, 1.0, {-kBlunt - half, 0, -kBlunt - half}, Vec3d(1, 0, -1).normalized(), 8);
  points.insert(points.end(), below.begin(), below.end());
  for (std::uint64_t i = 0; i < kStrip; ++i) {
    const auto u = uniform01x4(13, Purpose::kTest, i, 0);
    points.push_back({{-kBlunt, static_cast<double>(u[0]) - 0.5, -kBlunt * static_cast<double>(u[1])}, {1, 0, 0}});
  }
  return points;
}

stream::Store build_test_store(const std::vector<SampledPoint>& points, const std::filesystem::path& folder, std::uint32_t chunk_surfels) {
  stream::PointWriterOptions options;
  options.num_points = points.size();
  for (const char* name : {"x", "y", "z"}) options.properties.push_back({name, stream::ScalarType::kF64});
  for (const char* name : {"nx", "ny", "nz"}) options.properties.push_back({name, stream::ScalarType::kF32});
  for (const SampledPoint& p : points) options.bounds.extend(p.position);
  const auto writer = stream::create_points(folder / "test.ply", options);
  for (const SampledPoint& p : points) {
    std::byte row[36];
    std::memcpy(row, p.position.data(), 24);
    std::memcpy(row + 24, p.normal.data(), 12);
    writer->write(row, 1);
  }
  writer->commit();
  MemoryBudget budget(256u << 20);
  stream::BuildOptions build;
  build.chunk_surfels = chunk_surfels;
  stream::build_store({folder / "test.ply"}, folder / "test.chiaro", build, budget, silent_reporter());
  return stream::Store(folder / "test.chiaro");
}

}  // namespace chiaro::tests
