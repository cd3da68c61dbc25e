#include "blend/denoise_leaf.h"

#include <algorithm>
#include <cmath>

#include "blend/ballot.h"
#include "blend/denoise.h"
#include "stream/base/nearest_points.h"

namespace chiaro::blend {
namespace {

constexpr double kReachSpacings = 6;             // sixteen neighbours lie within 4.5 on a surface
constexpr std::size_t kMostAround = 1u << 17;    // surfels of other leaves
constexpr std::uint32_t kLargestLeaf = 1u << 16;
constexpr int kMostTries = 6;

bool usable(const BlendedSurfel& s) { return s.photographs > 0 && s.albedo.allFinite() && std::isfinite(s.own_sigma); }

/// The surfel's own deviation of log_value(): that of the albedo, less in the dark.
float log_deviation(const BlendedSurfel& s, float brightness) {
  const float value = std::max(0.0f, s.albedo.mean() / brightness);
  return s.own_sigma * value / (value + kDarkOffset);
}

void append(NoisySurfels& to, const stream::Surfel& surfel, const BlendedSurfel& value, const Vec3d& origin, float brightness) {
  to.position.push_back((surfel.position_in_world - origin).cast<float>());
  to.normal.push_back(surfel.normal);
  to.oriented.push_back((surfel.flags & stream::SurfelBlock::kOriented) != 0);
  to.log_albedo.push_back(log_value(value.albedo, brightness));
  to.sd.push_back(log_deviation(value, brightness));
}

Box3d grown(const Box3d& box, double by) {
  Box3d result = box;
  result.min -= Vec3d::Constant(by);
  result.max += Vec3d::Constant(by);
  return result;
}

bool overlap(const Box3d& a, const Box3d& b) { return (a.min.array() <= b.max.array()).all() && (b.min.array() <= a.max.array()).all(); }
bool contains(const Box3d& box, const Vec3d& p) { return (p.array() >= box.min.array()).all() && (p.array() <= box.max.array()).all(); }

/// What changes goes into the albedo as a difference, so that what does not change keeps its bits.
void put(const Denoised& value, const Vec3f& log_before, float sd_before, float brightness, BlendedSurfel& s) {
  if (!(sd_before > 0)) return;
  for (int c = 0; c < 3; ++c) s.albedo[c] += brightness * (std::exp(value.log_albedo[c]) - std::exp(log_before[c]));
  const float own = s.own_sigma * std::min(1.0f, value.sd / sd_before);
  s.sigma = std::sqrt(std::max(0.0f, s.sigma * s.sigma - s.own_sigma * s.own_sigma) + own * own);
  s.own_sigma = own;
}

}  // namespace

LeafDenoiser::LeafDenoiser(const stream::Store& store, float brightness, std::function<std::vector<BlendedSurfel>(std::size_t)> blended)
    : store_(store), brightness_(brightness), blended_(std::move(blended)), leaf_of_chunk_(store.chunks().size(), 0) {
  for (std::size_t i = 0; i < store.leaves().size(); ++i) leaf_of_chunk_[store.leaves()[i]] = static_cast<std::uint32_t>(i);
}

std::uint64_t LeafDenoiser::bytes_per_surfel() {
  constexpr std::uint64_t kNoisy = 3 * sizeof(Vec3f) + sizeof(float) + 1, kMost = 2 + kMostAround / kLargestLeaf;   // vectors grow by doubling
  return kMost * (kNoisy + NearestPoints::bytes_per_point()) + sizeof(Denoised) + 3 * sizeof(BlendedSurfel) + 2 * sizeof(Accumulator);
}

std::vector<std::uint32_t> LeafDenoiser::leaves_near(std::uint32_t chunk, const Box3d& box) const {
  std::vector<std::uint32_t> found, open;
  std::uint32_t root = chunk;
  while (store_.chunks()[root].parent != 0xffffffffu) root = store_.chunks()[root].parent;
  open.push_back(root);
  while (!open.empty()) {
    const std::uint32_t at = open.back();
    open.pop_back();
    const stream::ChunkFrame cell = store_.frame(at);
    Box3d cell_box;
    cell_box.min = cell.origin_in_world;
    cell_box.max = cell.origin_in_world + Vec3d::Constant(65536 * cell.step);
    if (!overlap(cell_box, box)) continue;
    const stream::ChunkEntry& entry = store_.chunks()[at];
    if (entry.is_leaf() && at != chunk) found.push_back(at);
    for (std::uint32_t c = 0; c < entry.num_children; ++c) open.push_back(entry.first_child + c);
  }
  std::sort(found.begin(), found.end());
  return found;
}

void LeafDenoiser::denoise(std::size_t leaf, std::vector<BlendedSurfel>& values) const {
  const std::uint32_t chunk = store_.leaves()[leaf];
  const stream::Chunk own = store_.read_chunk(chunk);
  const Vec3d origin = own.frame.origin_in_world;
  NoisySurfels surfels;
  std::vector<std::uint32_t> slots;
  for (std::uint32_t slot = 0; slot < own.count; ++slot) {
    if (!usable(values[slot])) continue;
    append(surfels, own.surfel(slot), values[slot], origin, brightness_);
    slots.push_back(slot);
  }
  if (slots.empty() || std::all_of(surfels.sd.begin(), surfels.sd.end(), [](float sd) { return !(sd > 0); })) return;
  double reach = kReachSpacings * static_cast<double>(store_.chunks()[chunk].spacing);
  // A sparse leaf beside dense ones takes no more of each than that one's own reach, and less if it is still too much. Where nothing helps (duplicates), it is alone.
  for (int tries = 0; !add_surroundings(chunk, origin, reach, surfels, slots.size()); ++tries) {
    reach /= 2;
    if (tries < kMostTries) continue;
    surfels.resize(slots.size());
    break;
  }
  const std::vector<Denoised> found = blend::denoise(surfels, slots.size(), static_cast<float>(reach));
  for (std::size_t i = 0; i < slots.size(); ++i) put(found[i], surfels.log_albedo[i], surfels.sd[i], brightness_, values[slots[i]]);
}

bool LeafDenoiser::add_surroundings(std::uint32_t chunk, const Vec3d& origin, double reach, NoisySurfels& surfels, std::size_t own) const {
  surfels.resize(own);
  const Box3d box = store_.bounds(chunk);
  for (const std::uint32_t near : leaves_near(chunk, grown(box, reach))) {
    const Box3d within = grown(box, std::min(reach, kReachSpacings * static_cast<double>(store_.chunks()[near].spacing)));
    if (!overlap(store_.bounds(near), within)) continue;
    const std::vector<BlendedSurfel> values = blended_(leaf_of_chunk_[near]);
    const stream::Chunk beside = store_.read_chunk(near);
    for (std::uint32_t slot = 0; slot < beside.count; ++slot) {
      if (!usable(values[slot])) continue;
      const stream::Surfel surfel = beside.surfel(slot);
      if (contains(within, surfel.position_in_world)) append(surfels, surfel, values[slot], origin, brightness_);
    }
    if (surfels.size() > own + kMostAround) return false;
  }
  return true;
}

}  // namespace chiaro::blend
