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
#include <span>
#include <utility>
#include <vector>

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

/// Pixels of an image, a plane a number: sums over them take four at a time.
class SurfacePlanes {
 public:
  SurfacePlanes() = default;
  SurfacePlanes(int width, int rows);
  int width() const { return width_; }
  int rows() const { return rows_; }
  SurfacePixel at(int x, int y) const;
  void set(int x, int y, const SurfacePixel& pixel);
  enum Plane { kX, kY, kZ, kArea, kRed, kGreen, kBlue, kNormalX, kNormalY, kNormalZ, kCos, kPlanes };
  /// Row of a plane. Up to three floats beyond its end may be read: they have no area.
  const float* row(Plane plane, int y) const { return &values_[plane][static_cast<std::size_t>(y) * stride_]; }
  static std::size_t bytes_per_pixel() { return kPlanes * sizeof(float); }

 private:
  int width_ = 0, rows_ = 0;
  std::size_t stride_ = 0;
  std::array<std::vector<float>, kPlanes> values_;
};

/// Pixels and their means over blocks of 2, 4, 8, 16 pixels, so that a mean takes about as many samples at any radius.
class SurfacePyramid {
 public:
  /// pixels: whole rows; the first row is a multiple of kPyramidRows in the image. Samples farther apart than radius / 2 share no block.
  SurfacePyramid(SurfacePlanes pixels, float radius);
  /// footprint: side of this pixel on the surface, across the view.
  SurfaceMean mean(int x, int y, float footprint) const;
  /// Gives the pixels back.
  SurfacePlanes release() && { return std::move(levels_[0]); }

 private:
  static SurfacePlanes halve(const SurfacePlanes& fine, float radius);
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
