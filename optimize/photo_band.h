/// A band of rows of one photograph with all that is known about its pixels.
#pragma once
#include <cstdint>
#include <vector>

#include "stream/base/types.h"
#include "stream/photo/camera.h"
#include "stream/photo/raster.h"

namespace chiaro::optimize {

/// Noise of a linear pixel value: variance = gain * value + read_sigma^2.
struct PixelNoise {
  double gain = 0, read_sigma = 0;
  double variance(double value) const { return gain * value + read_sigma * read_sigma; }
};

struct PhotoBand {
  int y0 = 0, rows = 0, width = 0;
  std::vector<float> r, g, b, depth, nx, ny, nz, radius, footprint, cosv, coverage, edge, flash, spread, lit, shadow;
  std::vector<std::uint8_t> mask;   ///< bits: 1 usable, 2 saturated, 4 not finite
  bool has_flash = false;

  std::size_t at(int x, int y) const { return static_cast<std::size_t>(y - y0) * static_cast<std::size_t>(width) + static_cast<std::size_t>(x); }
  bool contains(int x, int y) const { return x >= 0 && x < width && y >= y0 && y < y0 + rows; }
  /// Measured, on a surface, and whole.
  bool usable(std::size_t i) const { return mask[i] == 1 && depth[i] > 0 && coverage[i] > 0.99f; }
  Vec3f normal(std::size_t i) const { return {nx[i], ny[i], nz[i]}; }
  Vec3f colour(std::size_t i) const { return {r[i], g[i], b[i]}; }
};

PhotoBand read_band(const stream::RasterReader& radiance, const stream::RasterReader& gbuffer, int y0, int rows);
inline constexpr std::uint64_t kBandBytesPerPixel = 16 * 4 + 1;

/// Relative change of the pixel to its neighbours, per pixel: what a registration error of one pixel does. Of the channel that is brightest around it (the green of a red
/// paint is nothing but noise); what noise makes of it is taken off.
double relative_gradient(const PhotoBand& band, int x, int y, const PixelNoise& noise);

/// Point that a pixel sees, in the scene frame of `origin_in_world`.
Vec3f pixel_point(const stream::Camera& camera, const Vec3d& origin_in_world, int x, int y, float depth);

}  // namespace chiaro::optimize
