/// The inner loops of ordering a leaf by patches, many numbers at a time (see lanes.h). Internal to stream/store.
#pragma once
#include <array>
#include <cstddef>
#include <cstdint>
#include <span>
#include <vector>

namespace chiaro::stream {

/// Positions column by column, and their numbers.
struct PatchColumns {
  static constexpr std::size_t kNumber = 3, kColumns = 4;
  std::array<std::vector<std::uint16_t>, kColumns> of;
  /// For `count` and, as vectors are stored whole, some behind.
  void make_room(std::size_t count);
};

struct ValueRange {
  std::uint16_t low = 65535, high = 0;
  int extent() const { return high - low; }
};
ValueRange range_of(std::span<const std::uint16_t> values);
/// How many are less.
std::uint32_t count_below(std::span<const std::uint16_t> values, std::uint16_t limit);

struct PatchCut {
  std::size_t axis = 0;
  std::uint16_t value = 0;    ///< a position goes to the first half if it is below this there,
  std::uint32_t equals = 0;   ///< as do the first so many of those at it
};
/// Moves the first half of first ... last to the front; both keep their order. Returns where the second half begins. room: as large as the columns.
std::size_t divide(PatchColumns& columns, std::size_t first, std::size_t last, const PatchCut& cut, PatchColumns& room);

}  // namespace chiaro::stream
