/// Where two sets of colours differ: the cloud from six sides, each point in the colour of its difference.
#pragma once
#include <array>
#include <cstdint>
#include <filesystem>
#include <vector>

#include "stream/base/types.h"

namespace chiaro::tools {

/// Orthographic views along the axes, one scale for all: front (along +y), right (-x), back (-y), left (+x); below, top (-z) and bottom (+z); under them
/// the scale. z is up. Memory depends on the picture alone.
class DifferencePicture {
 public:
  /// bounds: of the positions, not empty. range: |difference| of full colour, > 0.
  DifferencePicture(const Box3d& bounds, std::uint64_t num_points, double range);
  /// difference: signed; NaN = not compared (grey). Positions that are not finite are left out.
  void add(const Vec3d& position, double difference);
  /// Blue: A darker than B; white: alike; red: A brighter. Atomic; throws Error.
  void write(const std::filesystem::path& file) const;
  int width() const { return width_; }
  int height() const { return height_; }
  std::array<std::uint8_t, 3> pixel(int x, int y) const;
  /// sRGB of a difference.
  static std::array<std::uint8_t, 3> colour(double difference, double range);

 private:
  struct View {
    Vec3d right, down, ahead;   // unit, world
    int x0 = 0, y0 = 0, width = 0, height = 0;
    double right0 = 0, down0 = 0, ahead0 = 0;
  };
  void draw_scale();
  std::array<View, 6> views_;
  double range_ = 1, pitch_ = 1;
  int width_ = 0, height_ = 0, half_ = 0;
  std::vector<float> depth_;
  std::vector<std::uint8_t> pixels_;
};

}  // namespace chiaro::tools
