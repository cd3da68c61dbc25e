/// The split of an image into a low and a high band at a fixed scale on the surface, not in the image.
///
/// The low band of a pixel is the mean of the albedo over the surface within a ball of fixed radius around the pixel's own surface point; pixels count by
/// the area that they cover. Distance, slant, creases and silhouettes need no special case, and two photographs of the same place get the same low band
/// but for what only one of them sees. Measured on a rendered tower (difference between the low bands of two photographs of one surfel): 0.15-0.45 % of the
/// albedo, against 0.4-0.7 % for box filters in the image whose widths follow footprint and slant; those added a tenth to the final error.
#pragma once
#include <array>
#include <cstddef>
#include <cstdint>
#include <optional>
#include <span>
#include <utility>
#include <vector>

#include "blend/ball_sums.h"
#include "stream/base/types.h"

namespace chiaro::blend {

inline constexpr float kMaxLowRadiusPx = 64;   ///< beyond it the low band of a very near photograph is split finer than on the others
inline constexpr int kPyramidRows = 16;        ///< windows begin and end at multiples of this many rows, so that all windows share the same blocks

/// What a pixel, or a block of pixels, shows. area 0: nothing.
struct SurfacePixel {
  Vec3f position = Vec3f::Zero();   ///< relative to the camera, project units
  float area = 0;                   ///< surface covered, any unit common to the image
  Vec3f albedo = Vec3f::Zero();
  Vec3f normal = Vec3f::Zero();
  float cosv = 0;
};

/// Means over the surface around a pixel.
struct SurfaceMean {
  Vec3f albedo = Vec3f::Zero();
  float cosv = 0;      ///< over the part of the surroundings that faces the same way: the other side of a crease says nothing about this one
  bool valid = false;
};

/// Pixels of an image, four beside each other together: sums over them take four at a time.
class SurfacePlanes {
 public:
  SurfacePlanes() = default;
  SurfacePlanes(int width, int rows);
  int width() const { return width_; }
  int rows() const { return rows_; }
  SurfacePixel at(int x, int y) const;
  void set(int x, int y, const SurfacePixel& pixel);
  /// Shows nothing.
  void leave_out(int x, int y) { values_[index(x, y) + kArea * kBlocksTogether] = 0; }
  /// Of this size; what pixels are is open, but for those beyond the end of a row.
  void fit(int width, int rows) {
    if (width == width_ && rows == rows_) return;
    *this = {};   // never both at once
    *this = SurfacePlanes(width, rows);
  }
  /// The four that x is one of, see Plane. Three columns beyond the image, up to the end of their group, may be read: they have no area.
  const float* group(int x, int y) const { return &values_[group_index(x, y)]; }
  float* group(int x, int y) { return &values_[group_index(x, y)]; }
  std::size_t row_stride() const { return groups_ * kGroupFloats; }
  static std::size_t bytes_per_pixel() { return kPlanes * sizeof(float); }

 private:
  std::size_t group_index(int x, int y) const { return (static_cast<std::size_t>(y) * groups_ + static_cast<std::size_t>(x) / kBlocksTogether) * kGroupFloats; }
  std::size_t index(int x, int y) const { return group_index(x, y) + static_cast<std::size_t>(x) % kBlocksTogether; }
  int width_ = 0, rows_ = 0;
  std::size_t groups_ = 0;   // in a row
  std::vector<float> values_;
};

/// Pixels and their means over blocks of 2, 4, 8, 16 pixels, so that a mean takes about as many samples at any radius.
class SurfacePyramid {
 public:
  /// pixels: whole rows; the first row is a multiple of kPyramidRows in the image. Samples farther apart than radius / 2 share no block.
  SurfacePyramid(SurfacePlanes pixels, float radius);
  /// levels: the pixels, and perhaps coarser levels of another image, whose memory is used again.
  SurfacePyramid(std::vector<SurfacePlanes> levels, float radius);
  /// Of all pixels of a row. footprints: side of each pixel on the surface, across the view; 0 where nobody asks.
  void means(int y, std::span<const float> footprints, std::span<SurfaceMean> means) const;
  SurfaceMean mean(int x, int y, float footprint) const;
  /// Gives pixels and coarser levels back.
  std::vector<SurfacePlanes> release() && { return std::move(levels_); }

 private:
  struct Ball;
  std::optional<Ball> ball_around(int x, int y, float footprint) const;
  std::array<SurfaceMean, kBallsTogether> means_of(std::span<const Ball> balls, int y) const;
  static void halve(const SurfacePlanes& fine, float radius, SurfacePlanes& coarse);
  std::vector<SurfacePlanes> levels_;
  float radius_ = 0;
};

/// Bands of a blend: 2, or up to two more between the low and the high one.
inline constexpr int kMostBands = 4, kMostWider = kMostBands - 2;

/// Rows that mean() reaches beyond a pixel at most, where no footprint is smaller than this one.
int reach_rows(float radius, float smallest_footprint);

/// Euclidean distance to the nearest marked pixel, at most `cap` (pixels). Rows nearer than cap to the window's end see only what is inside it.
std::vector<float> distance_to_marked(std::span<const std::uint8_t> marked, int width, int rows, float cap);

}  // namespace chiaro::blend
