#include "blend/photo_window.h"

#include <algorithm>
#include <atomic>
#include <cmath>
#include <functional>
#include <numeric>
#include <span>

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
  WindowRoom& room;             ///< edge_px: from the rim of the blur
  std::vector<WindowPixel> pixels;
  std::size_t size() const { return static_cast<std::size_t>(width) * static_cast<std::size_t>(rows); }
};

/// What the rasters say of some rows, as it is packed there; room that is used again.
struct PackedRows {
  std::vector<float> depth, nx, ny, nz, radius, footprint, cosv, edge, coverage, spread, red, green, blue, sigma, shared;   ///< spread, shared: empty where the rasters have none
  std::vector<std::uint8_t> mask;

  void read(const PhotographRasters& rasters, int y0, int rows) {
    const stream::RasterReader &g = rasters.gbuffer(), &a = rasters.albedo();
    const auto plane = [&](const stream::RasterReader& from, const char* name, auto& to) {
      to.resize(static_cast<std::size_t>(rows) * static_cast<std::size_t>(from.width()));
      from.read_rows(name, y0, rows, std::as_writable_bytes(std::span(to)));
    };
    plane(g, "depth", depth);
    plane(g, "nx", nx);
    plane(g, "ny", ny);
    plane(g, "nz", nz);
    plane(g, "radius", radius);
    plane(g, "footprint", footprint);
    plane(g, "cosv", cosv);
    plane(g, "edge", edge);
    plane(g, "coverage", coverage);
    if (g.has("spread")) plane(g, "spread", spread);   // there with a flash
    plane(a, "r", red);
    plane(a, "g", green);
    plane(a, "b", blue);
    plane(a, "sigma", sigma);
    if (a.has("shared")) plane(a, "shared", shared);
    plane(rasters.radiance(), "mask", mask);
  }
  /// The albedo stands in `low` until the bands are split.
  WindowPixel pixel(std::size_t i) const {
    const auto deviation = [](float v, float unknown) { return std::isfinite(v) ? std::max(v, 0.0f) : unknown; };
    WindowPixel pixel;
    pixel.depth = std::isfinite(depth[i]) && depth[i] > 0 ? depth[i] : 0;
    pixel.footprint = footprint[i];
    pixel.radius = radius[i];
    pixel.normal = Vec3f(nx[i], ny[i], nz[i]);
    pixel.sigma = deviation(sigma[i], 1);
    pixel.low = Vec3f(red[i], green[i], blue[i]);
    pixel.shared = shared.empty() ? 0 : deviation(shared[i], 0);
    return pixel;
  }
};

PixelEvidence own_evidence(const WindowPixel& pixel, float blur_px, float spread, float coverage) {
  return {.footprint = pixel.footprint, .blur_px = blur_px, .sigma = std::hypot(pixel.sigma, pixel.shared), .spread = spread, .coverage = coverage};
}

/// Where a pixel looks, asked for at most once.
class Sight {
 public:
  Sight(const stream::Camera& camera, const Vec2d& middle) : camera_(camera), middle_(middle) {}
  const std::optional<Vec3d>& direction() {
    if (!asked_) direction_ = stream::unproject(camera_.lens, middle_);
    asked_ = true;
    return direction_;
  }
  /// Diameter of the lens's blur, pixels; 0 where the focus is not known.
  float blur_px(float depth) {
    if (!(camera_.focus.aperture > 0 && depth > 0) || !direction()) return 0;
    return static_cast<float>(stream::blur_px(camera_, direction_->z() * static_cast<double>(depth)));
  }

 private:
  const stream::Camera& camera_;
  Vec2d middle_;
  std::optional<Vec3d> direction_;
  bool asked_ = false;
};

/// One pixel: what it is and, if it may be used, its quality (kept in `weight` until the bands are split) and place on the surface.
void prepare_pixel(const PackedRows& packed, std::size_t from, int x, int y, const WindowOptions& options, Preparation& p) {
  const std::size_t i = static_cast<std::size_t>(y) * static_cast<std::size_t>(p.width) + static_cast<std::size_t>(x);
  WindowPixel pixel = packed.pixel(from);
  Sight sight(p.camera, Vec2d(x + 0.5, y + p.y0 + 0.5));
  const float cosv = packed.cosv[from], blur_px = sight.blur_px(pixel.depth);
  const float edge_px = p.room.edge_px[i] = packed.edge[from] - 0.5f * blur_px;
  const bool is_saturated = p.room.saturated[i] = (packed.mask[from] & kMaskSaturated) != 0;
  const bool is_masked = p.room.masked[i] = !is_saturated && ((packed.mask[from] & kMaskUsable) == 0 || (packed.mask[from] & kMaskNotFinite) != 0);
  SurfacePlanes& surface = p.room.surface[0];
  surface.leave_out(x, y);
  if (pixel.depth > 0 && !is_masked && !is_saturated && pixel.low.allFinite() && pixel.normal.allFinite() && std::isfinite(pixel.radius) && edge_px > kMixedPixels && cosv > kLeastViewCos) {
    const float quality = pixel_quality(own_evidence(pixel, blur_px, packed.spread.empty() ? 0 : packed.spread[from], packed.coverage[from]), options.scale());
    if (quality > 0 && sight.direction()) {
      const float side = pixel.footprint / options.reference_footprint;
      surface.set(x, y, {Vec3f((*sight.direction() * static_cast<double>(pixel.depth)).cast<float>()), side * side / cosv, pixel.low, pixel.normal, cosv});
      pixel.weight = quality;
    }
  }
  p.pixels[i] = pixel;
}

/// All pixels, by the blocks of rows that the rasters pack together: a third of them at once at most, which take less than the coarser levels and distances later.
void read_pixels(const PhotographRasters& rasters, const WindowOptions& options, Preparation& p) {
  const int block = stream::raster_block_rows(p.width, rasters.height()), first = p.y0 / block, last = (p.y0 + p.rows + block - 1) / block;
  const auto at_once = static_cast<std::size_t>(std::clamp((last - first) / 3, 1, ThreadLimit::current()));
  std::atomic<int> next{first};
  parallel_blocks(at_once, 1, [&](std::size_t, std::size_t) {
    PackedRows packed;
    for (int b = next++; b < last; b = next++) {
      const int y0 = std::max(p.y0, b * block), y1 = std::min(p.y0 + p.rows, (b + 1) * block);
      packed.read(rasters, y0, y1 - y0);
      std::size_t from = 0;
      for (int y = y0; y < y1; ++y)
        for (int x = 0; x < p.width; ++x) prepare_pixel(packed, from++, x, y - p.y0, options, p);
    }
  });
}

/// What pixels lie beside, once all of them are read: takes their surface over.
class Surroundings {
 public:
  Surroundings(Preparation& p, const WindowOptions& options)
      : p_(p), to_mask_(distance_to_marked(p.room.masked, p.width, p.rows, options.border_px)),
        to_saturated_(distance_to_marked(p.room.saturated, p.width, p.rows, saturation_ramp_px(options.border_px))), surface_(std::move(p.room.surface), options.low_radius) {}
  /// What it took over; there are no means after that.
  std::vector<SurfacePlanes> release() { return std::move(surface_).release(); }
  const SurfacePyramid& surface() const { return surface_; }
  void add(int x, int y, float cosv, PixelEvidence& e) const {
    e.cosv = cosv;
    e.edge_px = p_.room.edge_px[index(x, y)];
    e.mask_px = to_mask_[index(x, y)];
    e.saturated_px = to_saturated_[index(x, y)];
  }
  std::size_t index(int x, int y) const { return static_cast<std::size_t>(y) * static_cast<std::size_t>(p_.width) + static_cast<std::size_t>(x); }

 private:
  const Preparation& p_;
  std::vector<float> to_mask_, to_saturated_;
  SurfacePyramid surface_;
};

/// Calls task(y, means of row y) for rows [first, last), side by side.
template <class Task>
void for_means(const Preparation& p, const SurfacePyramid& surface, int first, int last, const Task& task) {
  const auto across = static_cast<std::size_t>(p.width);
  parallel_blocks(static_cast<std::size_t>(last - first), 2, [&](std::size_t y0, std::size_t y1) {
    std::vector<float> footprints(across);
    std::vector<SurfaceMean> means(across);
    for (std::size_t y = static_cast<std::size_t>(first) + y0; y < static_cast<std::size_t>(first) + y1; ++y) {
      for (std::size_t x = 0; x < across; ++x) footprints[x] = p.pixels[y * across + x].footprint;
      surface.means(static_cast<int>(y), footprints, means);
      task(static_cast<int>(y), means);
    }
  });
}

/// Rows [first, last) of what is prepared are the window's.
void split_bands(Preparation& p, const WindowOptions& options, int first, int last, PhotoWindow& window) {
  Surroundings around(p, options);
  for_means(p, around.surface(), first, last, [&](int y, const std::vector<SurfaceMean>& means) {
    for (int x = 0; x < p.width; ++x) {
      WindowPixel& pixel = p.pixels[around.index(x, y)];
      const SurfaceMean& mean = means[static_cast<std::size_t>(x)];
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
  std::vector<SurfacePlanes> surface = around.release();
  for (int i = 0; i < options.wider; ++i) {
    SurfacePyramid pyramid(std::move(surface), options.wider_radius(i));
    for_means(p, pyramid, first, last, [&](int y, const std::vector<SurfaceMean>& means) {
      for (int x = 0; x < p.width; ++x)
        if (means[static_cast<std::size_t>(x)].valid) window.wider_means[around.index(x, y - first) * static_cast<std::size_t>(options.wider) + static_cast<std::size_t>(i)] = means[static_cast<std::size_t>(x)].albedo;
    });
    surface = std::move(pyramid).release();
  }
  p.room.surface = std::move(surface);
}

/// Rows [y0, y1) with their halo, up to where only their surroundings are missing.
Preparation prepare(const PhotographRasters& rasters, const stream::Camera& camera, int y0, int y1, int halo, const WindowOptions& options, WindowRoom& room) {
  Preparation p{.camera = camera, .room = room};
  p.width = rasters.width();
  p.y0 = std::max(0, y0 - halo + kPyramidRows - 1) / kPyramidRows * kPyramidRows;
  p.rows = std::min(rasters.height(), (y1 + halo) / kPyramidRows * kPyramidRows) - p.y0;
  p.pixels.resize(p.size());
  room.edge_px.resize(p.size());
  room.masked.resize(p.size());
  room.saturated.resize(p.size());
  room.surface.resize(std::max<std::size_t>(room.surface.size(), 1));
  room.surface[0].fit(p.width, p.rows);
  read_pixels(rasters, options, p);
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
  // pixel, surface and its coarser levels, edge, masks, two distances with their work array; before these, rows as they are packed
  return held_bytes_per_pixel(wider) + SurfacePlanes::bytes_per_pixel() * 4 / 3 + sizeof(float) + 2 + 3 * sizeof(float);
}

PhotoWindow load_window(const PhotographRasters& rasters, const stream::Camera& camera, int y0, int y1, int margin, int halo, const WindowOptions& options, WindowRoom& room) {
  PhotoWindow window;
  window.width = rasters.width();
  window.y0 = std::max(0, y0 - margin);
  window.rows = std::min(rasters.height(), y1 + margin) - window.y0;
  Preparation p = prepare(rasters, camera, y0 - margin, y1 + margin, halo, options, room);
  const int first = window.y0 - p.y0;
  split_bands(p, options, first, first + window.rows, window);
  const auto begin = p.pixels.begin() + static_cast<std::ptrdiff_t>(first) * p.width;
  p.pixels.erase(begin + static_cast<std::ptrdiff_t>(window.rows) * p.width, p.pixels.end());
  p.pixels.erase(p.pixels.begin(), begin);
  window.pixels = std::move(p.pixels);
  return window;
}

std::vector<SeenEvidence> load_evidence(const PhotographRasters& rasters, const stream::Camera& camera, int y0, int y1, int step, int halo, const WindowOptions& options) {
  WindowRoom room;
  Preparation p = prepare(rasters, camera, y0, y1, halo, options, room);
  const stream::RasterReader& g = rasters.gbuffer();
  const auto coverage = g.rows<float>("coverage", y0, y1 - y0), cosv = g.rows<float>("cosv", y0, y1 - y0), spread = g.has("spread") ? g.rows<float>("spread", y0, y1 - y0) : std::vector<float>();
  const Surroundings around(p, options);
  const auto across = static_cast<std::size_t>((p.width + step - 1) / step), down = static_cast<std::size_t>((y1 - y0 + step - 1) / step);
  std::vector<SeenEvidence> all(across * down);
  parallel_blocks(down, 2, [&](std::size_t v0, std::size_t v1) {
    for (std::size_t i = v0 * across; i < v1 * across; ++i) {
      const int x = static_cast<int>(i % across) * step, y = static_cast<int>(i / across) * step + y0 - p.y0;
      const std::size_t at = around.index(x, y), in_rows = around.index(x, y + p.y0 - y0);
      const WindowPixel& pixel = p.pixels[at];
      if (!(pixel.depth > 0)) continue;
      const SurfaceMean mean = around.surface().mean(x, y, pixel.footprint);
      all[i] = {own_evidence(pixel, Sight(camera, Vec2d(x + 0.5, y + p.y0 + 0.5)).blur_px(pixel.depth), spread.empty() ? 0 : spread[in_rows], coverage[in_rows]), true, pixel.weight > 0 && mean.valid};
      around.add(x, y, mean.valid ? mean.cosv : cosv[in_rows], all[i].evidence);
    }
  });
  return all;
}

}  // namespace chiaro::blend
