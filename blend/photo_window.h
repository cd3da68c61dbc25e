/// A band of rows of one photograph, ready to be read at surfels: geometry for the visibility test, weight, and albedo split into bands.
#pragma once
#include <filesystem>
#include <optional>
#include <string>
#include <vector>

#include "blend/bands.h"
#include "blend/view_weights.h"
#include "stream/photo/camera.h"
#include "stream/photo/raster.h"

namespace chiaro::blend {

/// What the readers of all three rasters of a photograph must agree on, checked once.
class PhotographRasters {
 public:
  /// throws Error naming the file if a plane is missing or a size differs from the lens.
  PhotographRasters(const stream::Lens& lens, const std::filesystem::path& gbuffer, const std::filesystem::path& albedo, const std::filesystem::path& radiance);
  const stream::RasterReader& gbuffer() const { return gbuffer_; }
  const stream::RasterReader& albedo() const { return albedo_; }
  const stream::RasterReader& radiance() const { return radiance_; }
  int width() const { return gbuffer_.width(); }
  int height() const { return gbuffer_.height(); }

 private:
  stream::RasterReader gbuffer_, albedo_, radiance_;
};

/// Counts of positive values on a logarithmic scale, 16 steps an octave.
class OctaveHistogram {
 public:
  void add(float value);
  void merge(const OctaveHistogram& other);
  std::uint64_t count() const;
  /// Centre of the median's step; 0 if nothing was counted.
  float median() const;
  /// Lower end of the lowest step that holds something; 0 if none does.
  float smallest() const;

 private:
  static constexpr int kSteps = 16, kLowest = -40, kHighest = 40;   // octaves: 1e-12 .. 1e12
  std::vector<std::uint64_t> counts_ = std::vector<std::uint64_t>(static_cast<std::size_t>((kHighest - kLowest) * kSteps), 0);
};
/// Footprints (project units) of the pixels that see something: their median fixes the surface scale of the bands.
OctaveHistogram footprints(const PhotographRasters& rasters);
/// Albedos of these pixels, mean of the channels.
OctaveHistogram brightnesses(const PhotographRasters& rasters);

struct WindowOptions {
  float low_radius = 0;           ///< project units: the split between the highest band and the next
  float reference_footprint = 1;  ///< project units
  float border_px = 12;
  int wider = 0;                  ///< further splits, each at twice the radius of the one before
  float wider_radius(int i) const { return low_radius * static_cast<float>(2 << i); }
  WeightScale scale() const { return {reference_footprint, border_px}; }
};

/// One pixel as the surfels read it: a cache line, taken four numbers at a time. weight 0: not to be read.
struct alignas(64) WindowPixel {
  float depth = 0, footprint = 0, radius = 0, weight = 0;
  Vec3f normal = Vec3f::Zero();
  float sigma = 0;    ///< relative deviation that is independent between photographs
  Vec3f low = Vec3f::Zero();
  float shared = 0;   ///< relative deviation that photographs have in common
  Vec3f high = Vec3f::Zero();
  float unused = 0;
};

struct PhotoWindow {
  int width = 0, y0 = 0, rows = 0;   ///< rows of the image that are held: [y0, y0 + rows)
  std::vector<WindowPixel> pixels;
  int wider = 0;
  std::vector<Vec3f> wider_means;    ///< of each pixel as many: the albedo's means over twice the radius of WindowPixel::low, four times, …
  const WindowPixel* at(int x, int y) const {
    if (x < 0 || x >= width || y < y0 || y >= y0 + rows) return nullptr;
    return &pixels[static_cast<std::size_t>(y - y0) * static_cast<std::size_t>(width) + static_cast<std::size_t>(x)];
  }
};

/// Memory for what only preparing a window needs: used again for the next one, as fresh pages cost a tenth of preparing.
struct WindowRoom {
  std::vector<SurfacePlanes> surface;   ///< pixels and coarser levels
  std::vector<float> edge_px;
  std::vector<std::uint8_t> masked, saturated;
};

/// Rows that must be read above and below so that every pixel of the window is final.
int halo_rows(const WindowOptions& options, float smallest_footprint);
/// Memory while a window is prepared, per pixel, halo included; and of the finished one.
std::size_t window_bytes_per_pixel(int wider = 0);
inline std::size_t held_bytes_per_pixel(int wider) { return sizeof(WindowPixel) + static_cast<std::size_t>(wider) * sizeof(Vec3f); }

/// Pixels whose surfels belong to rows [y0, y1), with `margin` rows more on both sides: one for interpolation, more where it is read beside the surfel.
PhotoWindow load_window(const PhotographRasters& rasters, const stream::Camera& camera, int y0, int y1, int margin, int halo, const WindowOptions& options, WindowRoom& room);
inline PhotoWindow load_window(const PhotographRasters& rasters, const stream::Camera& camera, int y0, int y1, int margin, int halo, const WindowOptions& options) {
  WindowRoom room;
  return load_window(rasters, camera, y0, y1, margin, halo, options, room);
}

/// What the weight of a pixel is made of. is_read: surfels are read there; its weight is the product of all criteria.
struct SeenEvidence {
  PixelEvidence evidence;
  bool is_on_surface = false, is_read = false;
};
/// Of every step-th pixel of rows y0, y0 + step, … below y1, row by row: for pictures of the weights.
std::vector<SeenEvidence> load_evidence(const PhotographRasters& rasters, const stream::Camera& camera, int y0, int y1, int step, int halo, const WindowOptions& options);

}  // namespace chiaro::blend
