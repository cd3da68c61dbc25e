/// In which order the surfels of a chunk are stored, and how to go through them cell by cell all the same.
#pragma once
#include <array>
#include <cstdint>
#include <span>
#include <vector>

#include "stream/store/block.h"
#include "stream/store/patch_kernels.h"

namespace chiaro::stream {

using StoredPosition = std::array<std::uint16_t, 3>;

/// The order in which each block holds a small patch of the surface, so that its box is small and rays visit few: the chunk is halved across its longest axis,
/// and each half again, down to blocks. One object a thread; keeps its room.
class PatchOrder {
 public:
  /// positions: at most kMaxChunkSurfels, in Morton order. Result: for each slot the number of the position. Those on one spot stay together and in order.
  std::span<const std::uint16_t> of(std::span<const StoredPosition> positions);

 private:
  void halve(std::size_t first, std::size_t last);
  bool choose_cut(std::size_t first, std::size_t last, std::size_t wanted, PatchCut& cut) const;
  void keep_spots_together(std::size_t first, std::size_t last, PatchCut& cut) const;
  bool same_spot(std::size_t i, std::size_t j) const;
  bool has_spots_ = false;       // several positions on one spot
  PatchColumns items_, other_;
};

/// Goes through a chunk in Morton order of the stored positions, those on one spot by slot. One object a thread; keeps its room.
class MortonOrder {
 public:
  /// Slots of the first `count` surfels in that order.
  std::span<const std::uint16_t> of(const std::vector<SurfelBlock>& blocks, std::uint32_t count);
  /// For each in that order the bits in which any axis differs from the one before: two Morton codes part where the highest of these is. 0 for the first.
  std::span<const std::uint16_t> differences() const { return differences_; }

 private:
  void compare(const std::vector<SurfelBlock>& blocks);
  std::vector<std::uint64_t> items_, other_;  // 48 bits of code above 16 bits of slot
  std::vector<std::uint16_t> order_, differences_;
};

}  // namespace chiaro::stream
