#include "tools/fill_unseen.h"

#include <algorithm>
#include <array>

#include "stream/base/nearest_points.h"

namespace chiaro::tools {
namespace {

constexpr std::size_t kNeighbours = 8;
constexpr double kReachSpacings = 4;   // farther away the next coarser level knows more

/// Positions and albedo of the seen surfels of a node, in float relative to the node's cell.
struct SeenSurfels {
  std::vector<Vec3f> positions, albedo;
};

Vec3f relative(const Vec3d& p, const Vec3d& origin) { return (p - origin).cast<float>(); }

SeenSurfels seen_surfels(const stream::Chunk& chunk, const std::vector<Vec3f>& albedo) {
  SeenSurfels seen;
  for (std::uint32_t slot = 0; slot < chunk.count; ++slot) {
    if (!albedo[slot].allFinite()) continue;
    seen.positions.push_back(relative(chunk.surfel(slot).position_in_world, chunk.frame.origin_in_world));
    seen.albedo.push_back(albedo[slot]);
  }
  return seen;
}

/// Fills what has a seen surfel within `reach`; the others stay in `unseen`.
void fill_within(const SeenSurfels& seen, const stream::Chunk& leaf, const Vec3d& origin, double reach, std::vector<std::uint32_t>& unseen, std::vector<Vec3f>& albedo) {
  const NearestPoints nearest(seen.positions);
  std::array<std::uint32_t, kNeighbours> index{};
  std::array<float, kNeighbours> squared{};
  std::erase_if(unseen, [&](std::uint32_t slot) {
    const std::size_t found = nearest.find(relative(leaf.surfel(slot).position_in_world, origin), kNeighbours, index.data(), squared.data());
    if (found == 0 || squared[0] > reach * reach) return false;
    Vec3f sum = Vec3f::Zero();
    float weights = 0;
    for (std::size_t k = 0; k < found; ++k) {
      const float w = 1 / (squared[k] + 1e-3f * squared[found - 1] + 1e-30f);
      sum += w * seen.albedo[index[k]];
      weights += w;
    }
    albedo[slot] = sum / weights;
    return true;
  });
}

}  // namespace

std::size_t fill_unseen(const stream::Store& store, const stream::Layer& layer, const stream::Chunk& leaf, std::vector<Vec3f>& albedo) {
  std::vector<std::uint32_t> unseen;
  for (std::uint32_t slot = 0; slot < leaf.count; ++slot)
    if (!albedo[slot].allFinite()) unseen.push_back(slot);
  const std::size_t wanted = unseen.size();
  for (std::uint32_t node = leaf.index; !unseen.empty() && node != SurfelId::kNone; node = store.chunks()[node].parent) {
    const stream::ChunkEntry& entry = store.chunks()[node];
    const bool is_leaf = node == leaf.index, is_root = entry.parent == SurfelId::kNone;
    const stream::Chunk chunk = is_leaf ? leaf : store.read_chunk(node);
    const SeenSurfels seen = seen_surfels(chunk, is_leaf ? albedo : read_albedo(layer, store, node).albedo);
    if (seen.positions.empty()) continue;
    const double reach = is_root ? 1e30 : kReachSpacings * std::max(entry.spacing, 0.5f * entry.radius_max);
    fill_within(seen, leaf, chunk.frame.origin_in_world, reach, unseen, albedo);
  }
  return wanted - unseen.size();
}

}  // namespace chiaro::tools
