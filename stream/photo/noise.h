/// Noise of a photograph from the photograph itself. Inside of develop; a header of its own for tests.
#pragma once
#include <cstdint>
#include <vector>

#include "stream/photo/develop.h"

namespace chiaro::stream {

/// Collects small blocks of a picture and fits variance = gain * value + read_sigma^2 to the flattest of them.
///
/// Each 16x16 block gives its mean and the energy of a second difference in both directions, which a smooth surface does not excite
/// (J. Immerkaer, "Fast Noise Variance Estimation", CVIU 1996). Texture only adds to it, so of the blocks of about equal brightness a low quantile counts.
class NoiseEstimator {
 public:
  static constexpr int kBlock = 16;
  explicit NoiseEstimator(int width_px, int height_px);
  /// A band that starts at row y0 (a multiple of 16): planar r, g, b of rows * width; good: 1 where a pixel may be used.
  void add_band(int y0, int rows, const std::vector<float> (&rgb)[3], const std::vector<std::uint8_t>& good);
  std::size_t num_blocks() const { return blocks_.size(); }
  /// nullopt where too few blocks could be used.
  std::optional<NoiseModel> fit() const;

 private:
  struct Block {
    float mean, variance;
  };
  int width_, stride_;
  std::vector<Block> blocks_;
};

}  // namespace chiaro::stream
