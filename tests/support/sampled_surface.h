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

/// Writes the points as PLY with normals and builds folder/test.chiaro.
stream::Store build_test_store(const std::vector<SampledPoint>& points, const std::filesystem::path& folder, std::uint32_t chunk_surfels = stream::kMaxChunkSurfels);

}  // namespace chiaro::tests
