/// Clouds in memory as input of builds, and synthetic shapes with known answers.
#pragma once
#include <filesystem>
#include <functional>
#include <memory>
#include <string>
#include <vector>

#include "stream/base/rng.h"
#include "stream/store/octree_build.h"

namespace chiaro::stream {

struct MemoryCloud {
  std::vector<Vec3d> position;
  std::vector<Vec3f> normal;                           // empty: none
  std::vector<std::array<std::uint16_t, 3>> colour;    // empty: none
};

class MemoryReader : public PointReader {
 public:
  explicit MemoryReader(const MemoryCloud& cloud) : cloud_(cloud) {
    schema_.declared_points = cloud.position.size();
    schema_.position_is_double = true;
    schema_.has_normal = !cloud.normal.empty();
    schema_.has_colour = !cloud.colour.empty();
  }
  const PointSchema& schema() const override { return schema_; }
  bool read(PointBlock& block, std::size_t max_points) override {
    block.clear();
    const std::size_t end = std::min(cloud_.position.size(), at_ + max_points);
    const auto slice = [&](const auto& from, auto& to) { if (!from.empty()) to.assign(from.begin() + static_cast<std::ptrdiff_t>(at_), from.begin() + static_cast<std::ptrdiff_t>(end)); };
    slice(cloud_.position, block.position);
    slice(cloud_.normal, block.normal);
    slice(cloud_.colour, block.colour);
    at_ = end;
    return block.size() > 0;
  }

 private:
  const MemoryCloud& cloud_;
  PointSchema schema_;
  std::size_t at_ = 0;
};

inline CloudInput input_of(const MemoryCloud& cloud, const std::string& fingerprint = "cloud") {
  CloudInput input;
  input.files = {"memory"};
  input.fingerprints = {fingerprint};
  input.open = [&cloud](std::size_t) { return std::make_unique<MemoryReader>(cloud); };
  return input;
}

/// Random uniforms by element and draw.
inline double uniform(std::uint64_t i, std::uint32_t draw, std::uint64_t seed = 7) { return static_cast<double>(uniform01(seed, Purpose::kTest, i, draw)); }

inline Vec3d sphere_direction(std::uint64_t i, std::uint64_t seed = 7) {
  const double z = 2 * uniform(i, 0, seed) - 1, angle = 6.283185307179586 * uniform(i, 1, seed), r = std::sqrt(1 - z * z);
  return {r * std::cos(angle), r * std::sin(angle), z};
}

/// Random points of a sphere, with radial noise.
inline MemoryCloud sphere_cloud(std::size_t n, double radius, double noise = 0, const Vec3d& centre = Vec3d::Zero()) {
  MemoryCloud cloud;
  for (std::size_t i = 0; i < n; ++i) cloud.position.push_back(centre + (radius + noise * normal01(7, Purpose::kTest, i, 4)) * sphere_direction(i));
  return cloud;
}

/// Random points of the unit square in z = 0.
inline MemoryCloud plane_cloud(std::size_t n) {
  MemoryCloud cloud;
  for (std::size_t i = 0; i < n; ++i) cloud.position.push_back({uniform(i, 0), uniform(i, 1), 0});
  return cloud;
}

inline Manifest build(const MemoryCloud& cloud, const std::filesystem::path& out, std::uint32_t chunk_surfels = kMaxChunkSurfels, std::uint64_t memory = 1ull << 29) {
  BuildOptions options;
  options.chunk_surfels = chunk_surfels;
  MemoryBudget budget(memory);
  return build_store_from(input_of(cloud), out, options, budget, silent_reporter());
}

}  // namespace chiaro::stream
