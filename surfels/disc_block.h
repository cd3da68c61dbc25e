/// A ray against the sixteen discs of a block: the inner loop of the tracer. Internal to surfels.
#pragma once
#include <array>
#include <cstdint>

#include "stream/store/block.h"

namespace chiaro::surfels {

/// A ray as a chunk sees it: relative to the lower corner of its cell.
struct LocalRay {
  float origin[3], direction[3];
  float t_min, t_max;
};

/// What a chunk's integers stand for.
struct DiscScale {
  float step = 0, radius2_max = 0;
};

/// Where the ray meets the sixteen planes, how far from the centres, squared, and the squared radii (times `share`).
struct BlockHits {
  alignas(64) float t[16], distance2[16], radius2[16];
};

/// Bit i is set if the ray meets disc i, shrunk to `share` of its squared radius, with t_min < t <= t_max. Where a disc ends at an edge is not looked at, see
/// is_clipped(). The same bits on every processor: plain IEEE operations, no contraction.
std::uint32_t intersect_block(const stream::SurfelBlock& block, const DiscScale& scale, const LocalRay& ray, float share, BlockHits& hits);
/// A box around the discs of a block, relative to the lower corner of the cell; clips are not looked at. At least one of the sixteen is no padding.
struct BlockBox {
  std::array<float, 3> lower, upper;
};
BlockBox box_of_block(const stream::SurfelBlock& block, const DiscScale& scale);
/// Squared radius of a disc.
float radius2_of(const stream::SurfelBlock& block, std::size_t lane, const DiscScale& scale);
/// Does the disc end before the point at which the ray meets its plane?
bool is_beyond_clip(const stream::SurfelBlock& block, std::size_t lane, const DiscScale& scale, const LocalRay& ray, float t);
inline bool is_clipped(const stream::SurfelBlock& block, std::size_t lane, const DiscScale& scale, const LocalRay& ray, float t) {
  return (stream::clip_of(block, lane) & 31) != 0 && is_beyond_clip(block, lane, scale, ray, t);
}

/// For tests: false takes the way of processors without AVX-512.
void use_wide_discs(bool use);

}  // namespace chiaro::surfels
