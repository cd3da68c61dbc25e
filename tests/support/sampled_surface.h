/// Stores made from analytic surfaces, for tests of rays and light whose answers are known in closed form.
#pragma once
#include <filesystem>
#include <vector>

#include "stream/store/store.h"

namespace chiaro::tests {

struct SampledPoint {
  Vec3d position;
  Vec3f normal;
};

/// `count` nearly even points on a sphere (Fibonacci lattice); inward: normals point to the centre.
std::vector<SampledPoint> sphere_points(std::size_t count, double radius, const Vec3d& centre, bool inward);
/// n x n points on a square of the given side around `centre`, jittered a little so that no grid shows.
std::vector<SampledPoint> square_points(std::size_t n, double side, const Vec3d& centre, const Vec3d& normal, std::uint64_t seed);

/// A wedge of 45 degrees whose edge is cut off: a lid (z = 0, -1 - kBlunt < x < -kBlunt, -0.5 < y < 0.5), a face that leans back under it, and between them a strip
/// narrower than points lie apart. Seen from above it ends at x = -kBlunt.
constexpr double kWedgeSpacing = 0.02, kBlunt = 0.8 * kWedgeSpacing;
std::vector<SampledPoint> blunt_wedge();

/// Writes the points as PLY with normals and builds folder/test.chiaro.
stream::Store build_test_store(const std::vector<SampledPoint>& points, const std::filesystem::path& folder, std::uint32_t chunk_surfels = stream::kMaxChunkSurfels);

}  // namespace chiaro::tests
