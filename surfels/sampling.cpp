#include "surfels/sampling.h"

#include <algorithm>
#include <cmath>
#include <optional>
#include <utility>

namespace chiaro::surfels {
namespace {

constexpr std::size_t kFewLeaves = 256;
constexpr std::uint32_t kOfEach = 64;
constexpr double kNearerShare = 0.1;

/// In pixels, of a length across the view at a point; nullopt outside the picture.
std::optional<double> length_px(const stream::Camera& camera, const Vec3d& p_in_world, double length) {
  const Vec3d p = camera.pose.camera_from_world(p_in_world);
  const auto at = stream::project(camera.lens, p), beside = stream::project(camera.lens, p + Vec3d(length, 0, 0));
  if (!at || !beside || at->x() < 0 || at->y() < 0 || at->x() > camera.lens.width_px || at->y() > camera.lens.height_px) return std::nullopt;
  return (*beside - *at).norm();
}

}  // namespace

SpacingSamples::SpacingSamples(const stream::Store& store) {
  const bool few = store.leaves().size() <= kFewLeaves;
  for (const std::uint32_t leaf : store.leaves()) {
    const stream::ChunkEntry& entry = store.chunks()[leaf];
    const auto spacing = static_cast<double>(entry.spacing);
    if (!few) {
      const Box3d box = store.bounds(leaf);
      samples_.push_back({0.5 * (box.min + box.max), spacing, static_cast<double>(entry.count)});
      continue;
    }
    const stream::Chunk chunk = store.read_chunk(leaf);
    const std::uint32_t num = std::min(kOfEach, chunk.count);
    for (std::uint32_t i = 0; i < num; ++i)
      samples_.push_back({chunk.surfel(static_cast<std::uint32_t>(std::uint64_t{i} * chunk.count / num)).position_in_world, spacing, static_cast<double>(chunk.count) / num});
  }
}

double SpacingSamples::spacing_px(const stream::Camera& camera) const {
  std::vector<std::pair<double, double>> seen;   // pixels, points
  double points = 0, nearer = 0;
  for (const Sample& s : samples_)
    if (const auto px = length_px(camera, s.position_in_world, s.spacing)) {
      seen.emplace_back(*px, s.points);
      points += s.points;
    }
  std::sort(seen.begin(), seen.end());
  for (const auto& [px, count] : seen)
    if ((nearer += count) >= kNearerShare * points) return px;
  return 0;
}

int most_cell(int width_px, int height_px) {
  constexpr double kLeastCells = 4e6, kMost = 64;
  return static_cast<int>(std::clamp(std::sqrt(static_cast<double>(width_px) * height_px / kLeastCells), 1.0, kMost));
}

int cell_for(double spacing_px, int width_px, int height_px) {
  constexpr double kCellsPerSpacing = 4;
  return static_cast<int>(std::clamp(spacing_px / kCellsPerSpacing, 1.0, static_cast<double>(most_cell(width_px, height_px))));
}

}  // namespace chiaro::surfels
