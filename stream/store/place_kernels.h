/// From positions to cells and Morton codes, many points at a time (see lanes.h). Columns hold one number a point. Internal to stream/store.
#pragma once
#include <array>
#include <cstdint>
#include <span>
#include <vector>

#include "stream/store/count_grid.h"

namespace chiaro::stream {

/// Three numbers a point, axis by axis.
template <class T>
struct AxisColumns {
  std::array<std::vector<T>, 3> of;
  void resize(std::size_t count) {
    for (std::vector<T>& axis : of) axis.resize(count);
  }
};

/// One axis of a grid: position = k * scale + add, rounded as doubles are.
struct GridAxis {
  double scale = 1, add = 0;
};

/// positions[i] of the integers k[i], |k| < 2^53.
void positions_of(std::span<const std::int64_t> k, GridAxis axis, double* positions);
/// The integers that give back the positions bit by bit, |k| < 2^40; whole[i] is cleared where there is none.
void integers_of(std::span<const double> positions, GridAxis axis, std::int64_t* k, std::uint8_t* whole);
/// RootCube::quantise of one axis. Positions that are no numbers give some cell.
void quantise(std::span<const double> positions, const RootCube& root, std::size_t axis, std::int64_t* q);
/// usable[i] is cleared where the magnitude is above `most`, or no number.
void clear_unusable(std::span<const double> positions, double most, std::uint8_t* usable);
/// Which bits of a number >= 0: `count` (at most 21) from `first` on.
struct AxisBits {
  int first = 0, count = kMaxLevel;
};
/// Morton codes of those bits of the three axes.
void morton_codes(const AxisColumns<std::int64_t>& q, AxisBits bits, std::span<std::uint64_t> codes);
/// The three numbers of 16 bits of each code of 48.
void places_of_codes(std::span<const std::uint64_t> codes, AxisColumns<std::uint16_t>& places);

}  // namespace chiaro::stream
