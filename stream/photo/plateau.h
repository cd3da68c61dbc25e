/// Clipped values where the file's white is none or too high: a plateau at the brightest value.
#pragma once
#include <cstdint>
#include <optional>
#include <span>
#include <vector>

namespace chiaro::stream {

/// One channel of a picture, taken in as it comes. Clipping heaps what would be brighter onto one value. Without it the brightest values thin out, also where a file of
/// half floats rounds them, and a smooth highlight reaches its top with no more pixels than the values just below.
/// Memory: 1 MiB.
class PlateauFinder {
 public:
  PlateauFinder();
  /// usable: nonzero where a value counts; same size. Values that are not finite do not.
  void add(std::span<const float> values, std::span<const std::uint8_t> usable);
  /// The smallest value of the plateau; absent where there is none.
  std::optional<float> level() const;

 private:
  float top_ = 0;
  std::uint64_t at_top_ = 0, all_ = 0;
  std::vector<std::uint32_t> histogram_;   ///< of positive values, by their leading bits: 10 of the mantissa
};

/// The same for whole numbers of a sensor, by how often each occurs. Saturated pixels scatter by some units, so all within a thousandth of the brightest value that
/// 32 pixels reach are the plateau, where few are brighter. returns its smallest value; absent where there is none.
std::optional<std::size_t> plateau_of_counts(std::span<const std::uint32_t> count_of_value);

}  // namespace chiaro::stream
