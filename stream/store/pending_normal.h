/// While a store is built: a better normal of a surfel waits beside the one that its neighbours still look at, where radius and clip will stand. Internal to stream/store.
#pragma once
#include <span>

#include "stream/store/block.h"

namespace chiaro::stream {

/// Set beside kEstimated, where it can say nothing else: the normal is to be refined, and from then on the better one waits.
inline constexpr std::uint8_t kPending = SurfelBlock::kOriented;

inline bool is_pending(const SurfelBlock& block, std::size_t lane) {
  constexpr std::uint8_t kBoth = SurfelBlock::kEstimated | kPending;
  return (block.flags[lane] & kBoth) == kBoth;
}
/// Upper 10 bits of both codes of encode_normal(), good to 0.2 degrees, go into log_radius and the bits of the clip. The normal that stands there stays.
void put_pending(SurfelBlock& block, std::size_t lane, const Vec3f& unit_normal);
/// Better normals take their place; radius and clip are 0 there.
void settle(std::span<SurfelBlock> blocks);
/// Better normals are forgotten.
void forget_pending(std::span<SurfelBlock> blocks);

}  // namespace chiaro::stream
