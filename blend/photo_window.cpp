#include "blend/photo_window.h"

#include <algorithm>
#include <cmath>
#include <functional>
#include <numeric>

#include "blend/view_weights.h"
#include "stream/base/error.h"
#include "stream/base/parallel.h"

namespace chiaro::blend {
namespace {

constexpr std::uint8_t kMaskUsable = 1, kMaskSaturated = 2, kMaskNotFinite = 4;

void check_raster(const stream::RasterReader& raster, const std::filesystem::path& path, const stream::Lens& lens, std::initializer_list<const char*> planes) {
  if (raster.width() != lens.width_px || raster.height() != lens.height_px)
    throw Error(concat(path.string(), ": is ", raster.width(), " x ", raster.height(), ", expected the camera's ", lens.width_px, " x ", lens.height_px));
  for (const char* plane : planes)
    if (!raster.has(plane)) throw Error(concat(path.string(), ": has no plane \"", plane, "\""));
}

/// Rows of the planes that the weights need, while a window is prepared.
struct Preparation {
  const stream::Camera& camera;
  int width = 0, y0 = 0, rows = 0;
  std::vector<WindowPixel> pixels;
  SurfacePlanes surface;
  std::vector<float> cosv, edge;
  std::vector<std::uint8_t> masked, saturated;
  std::size_t size() const { return static_cast<std::size_t>(width) * static_cast<std::size_t>(rows); }
  /// Diameter of the lens's blur, pixels; 0 where the focus is not known.
  float blur_px(std::size_t i) const {
    if (!(camera.focus.aperture > 0 && pixels[i].depth > 0)) return 0;
    const auto across = static_cast<std::size_t>(width);
    const auto direction = stream::unproject(camera.lens, {static_cast<double>(i % across) + 0.5, static_cast<double>(i / across) + y0 + 0.5});
    return direction ? static_cast<float>(stream::blur_px(camera, direction->z() * static_cast<double>(pixels[i].depth))) : 0;
  }
};

template <class Set>
void for_plane(const stream::RasterReader& raster, const char* plane, Preparation& p, const Set& set) {
  const auto values = raster.rows<float>(plane, p.y0, p.rows);
  parallel_blocks(values.size(), 1 << 16, [&](std::size_t begin, std::size_t end) {
    for (std::size_t i = begin; i < end; ++i) set(i, values[i]);
  });
}

void read_geometry(const PhotographRasters& rasters, Preparation& p) {
  const stream::RasterReader& g = rasters.gbuffer();
  for_plane(g, "depth", p, [&](std::size_t i, float v) { p.pixels[i].depth = std::isfinite(v) && v > 0 ? v : 0; });
  for_plane(g, "nx", p, [&](std::size_t i, float v) { p.pixels[i].normal.x() = v; });
  for_plane(g, "ny", p, [&](std::size_t i, float v) { p.pixels[i].normal.y() = v; });
  for_plane(g, "nz", p, [&](std::size_t i, float v) { p.pixels[i].normal.z() = v; });
  for_plane(g, "radius", p, [&](std::size_t i, float v) { p.pixels[i].radius = v; });
  for_plane(g, "footprint", p, [&](std::size_t i, float v) { p.pixels[i].footprint = v; });
  p.cosv = g.rows<float>("cosv", p.y0, p.rows);
  p.edge = g.rows<float>("edge", p.y0, p.rows);
}

void read_mask(const PhotographRasters& rasters, Preparation& p) {
  const auto mask = rasters.radiance().rows<std::uint8_t>("mask", p.y0, p.rows);
  p.masked.resize(mask.size());
  p.saturated.resize(mask.size());
  for (std::size_t i = 0; i < mask.size(); ++i) {
    p.saturated[i] = (mask[i] & kMaskSaturated) != 0;
    p.masked[i] = !p.saturated[i] && ((mask[i] & kMaskUsable) == 0 || (mask[i] & kMaskNotFinite) != 0);
  }
}

/// Empty without a flash.
std::vector<float> spread_of(const stream::RasterReader& gbuffer, int y0, int rows) {
  return gbuffer.has("spread") ? gbuffer.rows<float>("spread", y0, rows) : std::vector<float>();
}

PixelEvidence own_evidence(const WindowPixel& pixel, float blur_px, float spread, float coverage) {
  return {.footprint = pixel.footprint, .blur_px = blur_px, .sigma = std::hypot(pixel.sigma, pixel.shared), .spread = spread, .coverage = coverage};
}

/// Albedo, quality (kept in `weight` until the bands are split) and place on the surface of the pixels that may be used.
void read_values(const PhotographRasters& rasters, Preparation& p, const WindowOptions& options) {
  const stream::RasterReader& a = rasters.albedo();
  for_plane(a, "r", p, [&](std::size_t i, float v) { p.pixels[i].low.x() = v; });   // the albedo itself until the bands are split
  for_plane(a, "g", p, [&](std::size_t i, float v) { p.pixels[i].low.y() = v; });
  for_plane(a, "b", p, [&](std::size_t i, float v) { p.pixels[i].low.z() = v; });
  for_plane(a, "sigma", p, [&](std::size_t i, float v) { p.pixels[i].sigma = std::isfinite(v) ? std::max(v, 0.0f) : 1.0f; });
  if (a.has("shared")) for_plane(a, "shared", p, [&](std::size_t i, float v) { p.pixels[i].shared = std::isfinite(v) ? std::max(v, 0.0f) : 0.0f; });
  const stream::RasterReader& g = rasters.gbuffer();
  const auto coverage = g.rows<float>("coverage", p.y0, p.rows);
  const auto spread = spread_of(g, p.y0, p.rows);
  p.surface = SurfacePlanes(p.width, p.rows);
  parallel_blocks(p.size(), 1 << 14, [&](std::size_t begin, std::size_t end) {
    for (std::size_t i = begin; i < end; ++i) {
      WindowPixel& pixel = p.pixels[i];
      const float blur_px = p.blur_px(i), quality = pixel_quality(own_evidence(pixel, blur_px, spread.empty() ? 0 : spread[i], coverage[i]), options.scale());
      if (!(pixel.depth > 0) || p.masked[i] || p.saturated[i] || !pixel.low.allFinite() || !pixel.normal.allFinite() || !std::isfinite(pixel.radius) ||
          !(p.edge[i] - 0.5f * blur_px > kMixedPixels) || !(p.cosv[i] > kLeastViewCos) || !(quality > 0))
        continue;
      const auto x = static_cast<int>(i % static_cast<std::size_t>(p.width)), y = static_cast<int>(i / static_cast<std::size_t>(p.width));
      const Vec2d middle(x + 0.5, y + p.y0 + 0.5);
      const auto direction = stream::unproject(p.camera.lens, middle);
      if (!direction) continue;
      const float side = pixel.footprint / options.reference_footprint;
      p.surface.set(x, y, {Vec3f((*direction * static_cast<double>(pixel.depth)).cast<float>()), side * side / p.cosv[i], pixel.low, pixel.normal, p.cosv[i]});
      pixel.weight = quality;
    }
  });
}

/// What pixels lie beside, once all of them are read: takes their surface over.
class Surroundings {
 public:
  Surroundings(Preparation& p, const WindowOptions& options)
      : p_(p), to_mask_(distance_to_marked(p.masked, p.width, p.rows, options.border_px)),
        to_saturated_(distance_to_marked(p.saturated, p.width, p.rows, saturation_ramp_px(options.border_px))), surface_(std::move(p.surface), options.low_radius) {}
  /// What it took over; there are no means after that.
  SurfacePlanes release() { return std::move(surface_).release(); }
  SurfaceMean mean(int x, int y) const { return surface_.mean(x, y, p_.pixels[index(x, y)].footprint); }
  void add(int x, int y, float cosv, PixelEvidence& e) const {
    e.cosv = cosv;
    e.edge_px = p_.edge[index(x, y)] - 0.5f * p_.blur_px(index(x, y));
    e.mask_px = to_mask_[index(x, y)];
    e.saturated_px = to_saturated_[index(x, y)];
  }
  std::size_t index(int x, int y) const { return static_cast<std::size_t>(y) * static_cast<std::size_t>(p_.width) + static_cast<std::size_t>(x); }

 private:
  const Preparation& p_;
  std::vector<float> to_mask_, to_saturated_;
  SurfacePyramid surface_;
};

/// Rows [first, last) of what is prepared are the window's.
void split_bands(Preparation& p, const WindowOptions& options, int first, int last, PhotoWindow& window) {
  Surroundings around(p, options);
  parallel_blocks(static_cast<std::size_t>(last - first), 2, [&](std::size_t y0, std::size_t y1) {
    for (int y = first + static_cast<int>(y0); y < first + static_cast<int>(y1); ++y)
      for (int x = 0; x < p.width; ++x) {
        WindowPixel& pixel = p.pixels[around.index(x, y)];
        const SurfaceMean mean = around.mean(x, y);
        if (!mean.valid) {
          pixel.weight = 0;
          continue;
        }
        pixel.high = pixel.low - mean.albedo;
        pixel.low = mean.albedo;
        PixelEvidence evidence;
        around.add(x, y, mean.cosv, evidence);
        pixel.weight *= surroundings_quality(evidence, options.scale());
      }
  });
  window.wider = options.wider;
  window.wider_means.assign(static_cast<std::size_t>(last - first) * static_cast<std::size_t>(p.width * options.wider), Vec3f::Zero());
  SurfacePlanes surface;
  if (options.wider > 0) surface = around.release();
  for (int i = 0; i < options.wider; ++i) {
    SurfacePyramid pyramid(std::move(surface), options.wider_radius(i));
    parallel_blocks(static_cast<std::size_t>(last - first), 2, [&](std::size_t y0, std::size_t y1) {
      for (std::size_t y = y0; y < y1; ++y)
        for (int x = 0; x < p.width; ++x) {
          const int row = first + static_cast<int>(y);
          const SurfaceMean mean = pyramid.mean(x, row, p.pixels[around.index(x, row)].footprint);
          if (mean.valid) window.wider_means[(y * static_cast<std::size_t>(p.width) + static_cast<std::size_t>(x)) * static_cast<std::size_t>(options.wider) + static_cast<std::size_t>(i)] = mean.albedo;
        }
    });
    surface = std::move(pyramid).release();
  }
}

/// Rows [y0, y1) with their halo, up to where only their surroundings are missing.
Preparation prepare(const PhotographRasters& rasters, const stream::Camera& camera, int y0, int y1, int halo, const WindowOptions& options) {
  Preparation p{.camera = camera};
  p.width = rasters.width();
  p.y0 = std::max(0, y0 - halo + kPyramidRows - 1) / kPyramidRows * kPyramidRows;
  p.rows = std::min(rasters.height(), (y1 + halo) / kPyramidRows * kPyramidRows) - p.y0;
  p.pixels.resize(p.size());
  read_geometry(rasters, p);
  read_mask(rasters, p);
  read_values(rasters, p, options);
  return p;
}

}  // namespace

PhotographRasters::PhotographRasters(const stream::Lens& lens, const std::filesystem::path& gbuffer, const std::filesystem::path& albedo,
                                     const std::filesystem::path& radiance)
    : gbuffer_(gbuffer), albedo_(albedo), radiance_(radiance) {
  check_raster(gbuffer_, gbuffer, lens, {"depth", "nx", "ny", "nz", "radius", "footprint", "cosv", "coverage", "edge"});
  check_raster(albedo_, albedo, lens, {"r", "g", "b", "sigma"});
  check_raster(radiance_, radiance, lens, {"mask"});
}

void OctaveHistogram::add(float value) {
  if (!(value > 0) || !std::isfinite(value)) return;
  const int step = std::clamp(static_cast<int>(std::floor((std::log2(value) - kLowest) * kSteps)), 0, static_cast<int>(counts_.size()) - 1);
  ++counts_[static_cast<std::size_t>(step)];
}

void OctaveHistogram::merge(const OctaveHistogram& other) {
  for (std::size_t i = 0; i < counts_.size(); ++i) counts_[i] += other.counts_[i];
}

std::uint64_t OctaveHistogram::count() const { return std::accumulate(counts_.begin(), counts_.end(), std::uint64_t{0}); }

float OctaveHistogram::median() const {
  std::uint64_t total = 0, below = 0;
  for (const std::uint64_t n : counts_) total += n;
  for (std::size_t i = 0; i < counts_.size(); ++i)
    if ((below += counts_[i]) * 2 > total) return static_cast<float>(std::exp2((static_cast<double>(i) + 0.5) / kSteps + kLowest));
  return 0;
}

float OctaveHistogram::smallest() const {
  for (std::size_t i = 0; i < counts_.size(); ++i)
    if (counts_[i] > 0) return static_cast<float>(std::exp2(static_cast<double>(i) / kSteps + kLowest));
  return 0;
}

namespace {

/// Counts what `add_rows(histogram, y0, rows)` adds, by bands of rows in parallel.
OctaveHistogram count_rows(int height, const std::function<void(OctaveHistogram&, int, int)>& add_rows) {
  constexpr int kRows = 64;
  const auto num_blocks = static_cast<std::size_t>((height + kRows - 1) / kRows);
  std::vector<OctaveHistogram> partial(num_blocks);
  parallel_blocks(num_blocks, 1, [&](std::size_t b0, std::size_t b1) {
    for (std::size_t b = b0; b < b1; ++b) {
      const int y0 = static_cast<int>(b) * kRows;
      add_rows(partial[b], y0, std::min(kRows, height - y0));
    }
  });
  OctaveHistogram sum;
  for (const OctaveHistogram& h : partial) sum.merge(h);
  return sum;
}

}  // namespace

OctaveHistogram footprints(const PhotographRasters& rasters) {
  return count_rows(rasters.height(), [&](OctaveHistogram& counts, int y0, int rows) {
    const auto depth = rasters.gbuffer().rows<float>("depth", y0, rows), footprint = rasters.gbuffer().rows<float>("footprint", y0, rows);
    for (std::size_t i = 0; i < depth.size(); ++i)
      if (depth[i] > 0) counts.add(footprint[i]);
  });
}

OctaveHistogram brightnesses(const PhotographRasters& rasters) {
  return count_rows(rasters.height(), [&](OctaveHistogram& counts, int y0, int rows) {
    const auto depth = rasters.gbuffer().rows<float>("depth", y0, rows), red = rasters.albedo().rows<float>("r", y0, rows), green = rasters.albedo().rows<float>("g", y0, rows),
               blue = rasters.albedo().rows<float>("b", y0, rows);
    for (std::size_t i = 0; i < depth.size(); ++i)
      if (depth[i] > 0) counts.add((red[i] + green[i] + blue[i]) / 3);
  });
}

int halo_rows(const WindowOptions& options, float smallest_footprint) {
  const int reach = std::max(reach_rows(options.wider > 0 ? options.wider_radius(options.wider - 1) : options.low_radius, smallest_footprint), static_cast<int>(std::ceil(options.border_px)) + 1);
  return reach + kPyramidRows;   // the window begins and ends at whole blocks
}

std::size_t window_bytes_per_pixel(int wider) {
  // pixel, surface and its coarser levels, cosv and edge, masks, two distances with their work array or two planes on the way in
  return held_bytes_per_pixel(wider) + SurfacePlanes::bytes_per_pixel() * 4 / 3 + 2 * sizeof(float) + 2 + 3 * sizeof(float);
}

PhotoWindow load_window(const PhotographRasters& rasters, const stream::Camera& camera, int y0, int y1, int margin, int halo, const WindowOptions& options) {
  PhotoWindow window;
  window.width = rasters.width();
  window.y0 = std::max(0, y0 - margin);
  window.rows = std::min(rasters.height(), y1 + margin) - window.y0;
  Preparation p = prepare(rasters, camera, y0 - margin, y1 + margin, halo, options);
  const int first = window.y0 - p.y0;
  split_bands(p, options, first, first + window.rows, window);
  const auto begin = p.pixels.begin() + static_cast<std::ptrdiff_t>(first) * p.width;
  p.pixels.erase(begin + static_cast<std::ptrdiff_t>(window.rows) * p.width, p.pixels.end());
  p.pixels.erase(p.pixels.begin(), begin);
  window.pixels = std::move(p.pixels);
  return window;
}

std::vector<SeenEvidence> load_evidence(const PhotographRasters& rasters, const stream::Camera& camera, int y0, int y1, int step, int halo, const WindowOptions& options) {
  Preparation p = prepare(rasters, camera, y0, y1, halo, options);
  const auto coverage = rasters.gbuffer().rows<float>("coverage", y0, y1 - y0), spread = spread_of(rasters.gbuffer(), y0, y1 - y0);
  const Surroundings around(p, options);
  const auto across = static_cast<std::size_t>((p.width + step - 1) / step), down = static_cast<std::size_t>((y1 - y0 + step - 1) / step);
  std::vector<SeenEvidence> all(across * down);
  parallel_blocks(down, 2, [&](std::size_t v0, std::size_t v1) {
    for (std::size_t i = v0 * across; i < v1 * across; ++i) {
      const int x = static_cast<int>(i % across) * step, y = static_cast<int>(i / across) * step + y0 - p.y0;
      const std::size_t at = around.index(x, y), in_rows = around.index(x, y + p.y0 - y0);
      const WindowPixel& pixel = p.pixels[at];
      if (!(pixel.depth > 0)) continue;
      const SurfaceMean mean = around.mean(x, y);
      all[i] = {own_evidence(pixel, p.blur_px(at), spread.empty() ? 0 : spread[in_rows], coverage[in_rows]), true, pixel.weight > 0 && mean.valid};
      around.add(x, y, mean.valid ? mean.cosv : p.cosv[at], all[i].evidence);
    }
  });
  return all;
}

}  // namespace chiaro::blend
