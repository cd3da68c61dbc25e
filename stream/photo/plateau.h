/// Clipped values in pictures of floats, whose white nobody states: a plateau at the brightest value.
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

}  // namespace chiaro::stream
