/// Cells of k x k pixels as one pixel: the mean of those that can be used. Inside of develop; a header of its own for tests.
#pragma once
#include <array>
#include <cstdint>
#include <span>
#include <vector>

namespace chiaro::stream {

/// Takes the rows of a picture in order and gives rows of cells. What is left beside the last whole cell, right and below, belongs to none.
///
/// A cell is usable where half of its pixels are (flags: kUsableByMask alone); its value is the mean of these. Of others it is the mean of all that are finite,
/// and the flags say why: what any of its pixels has, and the mask's where half of them have it.
class Cells {
 public:
  Cells(int picture_width_px, int cell_px);
  int width() const { return static_cast<int>(flags_.size()); }
  /// The next row of the picture, flags as MaskBit. Whether a row of cells is complete: then rgb() and flags() have it until the next call.
  bool push(const std::array<std::span<const float>, 3>& rgb, std::span<const std::uint8_t> flags);
  const std::vector<float>& rgb(std::size_t channel) const { return rgb_[channel]; }
  const std::vector<std::uint8_t>& flags() const { return flags_; }

 private:
  struct Sums {
    std::array<double, 3> usable{}, finite{};
    int num_usable = 0, num_finite = 0, num_allowed = 0;
    std::uint8_t any = 0;
  };
  void finish();
  int cell_px_, rows_ = 0;
  std::vector<Sums> sums_;
  std::array<std::vector<float>, 3> rgb_;
  std::vector<std::uint8_t> flags_;
};

}  // namespace chiaro::stream
