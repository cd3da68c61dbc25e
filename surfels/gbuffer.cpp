#include "surfels/gbuffer.h"

#include <algorithm>
#include <array>
#include <atomic>
#include <cmath>
#include <vector>

#include "stream/base/error.h"
#include "stream/base/parallel.h"
#include "stream/photo/raster.h"
#include "surfels/gbuffer_edges.h"
#include "surfels/tracer.h"

namespace chiaro::surfels {
namespace {

using stream::PlaneType;

constexpr int kBandRows = 64;
constexpr float kCasterSlack = 0.5f;   ///< how well discs tell where a surface ends, in radii

/// Depths are compared with each other; what says how sure something is need not be known well itself.
stream::Precision precision_of(std::string_view plane) {
  if (plane == "depth") return stream::Precision::kAll;
  return plane == "spread" || plane == "penumbra" || plane == "shadow" ? stream::Precision::kCoarse : stream::Precision::kFine;
}

const std::vector<std::string>& float_planes(bool flash) {
  static const std::vector<std::string> geometry{"depth", "nx", "ny", "nz", "radius", "footprint", "cosv", "coverage"};
  static const std::vector<std::string> with_flash = [] {
    auto all = geometry;
    all.insert(all.end(), {"flash", "spread", "lit", "penumbra"});
    return all;
  }();
  return flash ? with_flash : geometry;
}

struct Pixel {
  float depth = 0, radius = 0, footprint = 0, cosv = 0, coverage = 0, flash = 0, spread = 0, lit = 0, penumbra = 0, back = 0;
  Vec3f normal = Vec3f::Zero();
  SurfelId surfel;
};

/// What all pixels of a photograph share.
struct Shot {
  const stream::Camera& camera;
  const Tracer& tracer;
  Vec3f eye;                       ///< scene frame
  std::optional<Vec3f> flash;      ///< scene frame
  Eigen::Matrix3f world_from_camera;
  float focal_px;
  int subpixels;
  float metres_per_unit;
};

struct RayCounts {
  std::uint64_t primary = 0, shadow = 0;
};

/// Irradiance at a hit per unit of flash intensity: visibility * cos / r^2, 1/m^2.
float flash_irradiance(const Shot& shot, const Vec3f& p, const Hit& hit, RayCounts& counts, bool& lit) {
  const Vec3f to_flash = *shot.flash - p;
  const float r2 = to_flash.squaredNorm(), r = std::sqrt(r2);
  const float cosine = hit.normal.dot(to_flash) / r;
  if (!(cosine > 0)) return 0;
  const Ray ray = escape_ray(p, hit.normal, hit.radius, to_flash / r, r);
  ++counts.shadow;
  if (shot.tracer.occluded(ray)) return 0;
  lit = true;
  return cosine / (r2 * shot.metres_per_unit * shot.metres_per_unit);
}

/// How far the shadow's edge may lie from where it is found, in pixels: what casts it is known to a part of its sampling only, and the flash throws that
/// on the pixel's surface magnified.
float penumbra_px(const Shot& shot, const Vec3f& p, const Hit& hit, float footprint) {
  const Vec3f to_flash = *shot.flash - p;
  const float r = to_flash.norm(), cosine = hit.normal.dot(to_flash) / r;
  Hit caster;
  if (!shot.tracer.closest(escape_ray(p, hit.normal, hit.radius, to_flash / r, r), caster)) return 0;
  const float from_flash = std::max(0.02f * r, r - caster.t);
  return std::min(kPenumbraReach, kCasterSlack * caster.radius * r / (from_flash * std::max(0.2f, cosine) * footprint));
}

/// Sums over the rays of a pixel.
class PixelSum {
 public:
  PixelSum(const Shot& shot, int column, int row, bool wanted, RayCounts& counts) : shot_(shot), column_(column), row_(row), wanted_(wanted), counts_(counts) {}

  void trace(int i, int j, int n) {
    ++rays_;
    const Vec2d at(column_ + (i + 0.5) / n, row_ + (j + 0.5) / n);
    const auto direction = stream::unproject(shot_.camera.lens, at);
    if (!direction) return;
    const Ray ray{shot_.eye, (shot_.world_from_camera * direction->cast<float>()).normalized(), 0, 1e30f};
    Hit hit;
    ++counts_.primary;
    if (!shot_.tracer.closest(ray, hit)) return;
    const Vec3f p = ray.origin + ray.direction * hit.t;
    if (hits_++ == 0) {
      first_ = p;
      first_normal_ = hit.normal;
    }
    off_plane_ = std::max(off_plane_, std::fabs(first_normal_.dot(p - first_)));
    least_cosine_ = std::min(least_cosine_, first_normal_.dot(hit.normal));
    depth_ += static_cast<double>(hit.t);
    normal_ += hit.normal;
    pixel_.cosv -= hit.normal.dot(ray.direction);
    const auto off = static_cast<float>((at - Vec2d(column_ + 0.5, row_ + 0.5)).squaredNorm());
    if (off < nearest_) {
      nearest_ = off;
      pixel_.surfel = hit.surfel;
      pixel_.radius = hit.radius;
      pixel_.back = hit.back;
    }
    if (!shot_.flash || !wanted_) return;
    bool sees = false;
    const auto e = static_cast<double>(flash_irradiance(shot_, p, hit, counts_, sees));
    if (!sees && !dark_ && hit.normal.dot(*shot_.flash - p) > 0) dark_.emplace(p, hit);
    flash_ += e;
    flash2_ += e * e;
    lit_ += sees;
  }

  /// More rays would tell the same: one plane, all in light or all in shadow.
  bool even() const {
    if (hits_ == 0) return true;
    if (hits_ < rays_ || (lit_ > 0 && lit_ < hits_)) return false;
    const double mean = flash_ / hits_;
    return least_cosine_ > kEvenCosine && off_plane_ < 0.5f * static_cast<float>(depth_ / hits_) / shot_.focal_px && flash2_ / hits_ - mean * mean <= kEvenSpread * kEvenSpread * mean * mean;
  }

  Pixel result() {
    if (hits_ == 0) return {};
    pixel_.depth = static_cast<float>(depth_ / hits_);
    pixel_.normal = normal_.normalized();
    pixel_.cosv /= static_cast<float>(hits_);
    pixel_.coverage = static_cast<float>(hits_) / static_cast<float>(rays_);
    pixel_.footprint = pixel_.depth / shot_.focal_px;
    pixel_.flash = static_cast<float>(flash_ / hits_);
    pixel_.lit = static_cast<float>(lit_) / static_cast<float>(hits_);
    const double mean = flash_ / hits_, variance = std::max(0.0, flash2_ / hits_ - mean * mean);
    pixel_.spread = mean > 0 ? static_cast<float>(std::sqrt(variance) / mean) : 0.0f;
    if (lit_ > 0 && dark_) pixel_.penumbra = penumbra_px(shot_, dark_->first, dark_->second, pixel_.footprint);
    return pixel_;
  }

 private:
  static constexpr float kEvenCosine = 0.98f;
  static constexpr double kEvenSpread = 0.04;

  const Shot& shot_;
  int column_, row_;
  bool wanted_;
  RayCounts& counts_;
  Pixel pixel_;
  int rays_ = 0, hits_ = 0, lit_ = 0;
  double depth_ = 0, flash_ = 0, flash2_ = 0;
  Vec3f normal_ = Vec3f::Zero(), first_ = Vec3f::Zero(), first_normal_ = Vec3f::Zero();
  float off_plane_ = 0, least_cosine_ = 1, nearest_ = 1e30f;
  std::optional<std::pair<Vec3f, Hit>> dark_;   ///< the first hit that faces the flash and lies in shadow
};

/// One ray in each row and each column of the 4x4 grid: enough where the pixel is even.
constexpr std::array<int, 4> kFirstColumn{1, 3, 0, 2};

Pixel trace_pixel(const Shot& shot, int column, int row, bool wanted, RayCounts& counts) {
  const int n = wanted ? shot.subpixels : 1;
  PixelSum sum(shot, column, row, wanted, counts);
  const bool adaptive = n == 4;
  if (adaptive) {
    for (int j = 0; j < 4; ++j) sum.trace(kFirstColumn[static_cast<std::size_t>(j)], j, n);
    if (sum.even()) return sum.result();
  }
  for (int j = 0; j < n; ++j)
    for (int i = 0; i < n; ++i)
      if (!adaptive || i != kFirstColumn[static_cast<std::size_t>(j)]) sum.trace(i, j, n);
  return sum.result();
}

void store_band(stream::RasterWriter& out, const std::vector<Pixel>& pixels, int y0, bool flash) {
  const std::size_t n = pixels.size();
  std::vector<float> values(n);
  const auto put = [&](const char* plane, auto&& get) {
    for (std::size_t i = 0; i < n; ++i) values[i] = get(pixels[i]);
    out.write_rows<float>(plane, y0, values);
  };
  put("depth", [](const Pixel& p) { return p.depth; });
  put("nx", [](const Pixel& p) { return p.normal.x(); });
  put("ny", [](const Pixel& p) { return p.normal.y(); });
  put("nz", [](const Pixel& p) { return p.normal.z(); });
  put("radius", [](const Pixel& p) { return p.radius; });
  put("footprint", [](const Pixel& p) { return p.footprint; });
  put("cosv", [](const Pixel& p) { return p.cosv; });
  put("coverage", [](const Pixel& p) { return p.coverage; });
  if (flash) {
    put("flash", [](const Pixel& p) { return p.flash; });
    put("spread", [](const Pixel& p) { return p.spread; });
    put("lit", [](const Pixel& p) { return p.lit; });
    put("penumbra", [](const Pixel& p) { return p.penumbra; });
  }
  std::vector<std::uint32_t> chunk(n);
  std::vector<std::uint16_t> slot(n);
  for (std::size_t i = 0; i < n; ++i) {
    chunk[i] = pixels[i].surfel.chunk;
    slot[i] = pixels[i].surfel.slot;
  }
  out.write_rows<std::uint32_t>("chunk", y0, chunk);
  out.write_rows<std::uint16_t>("slot", y0, slot);
}

/// Traces rows [y0, y1) with what the cut for them needs; splits the rows when the cut is large, or the budget does not hold it.
class Caster {
 public:
  Caster(const stream::Store& store, const stream::Camera& camera, const GBufferOptions& options, stream::RasterWriter& out, MemoryBudget& budget, Reporter& report)
      : store_(store), camera_(camera), options_(options), out_(out), budget_(budget), report_(report) {}

  void run(int y0, int y1) {
    View view{camera_.lens, camera_.pose, {0, y0, camera_.lens.width_px, y1}, {}};
    if (options_.flash_in_camera) view.lights_in_world.push_back(camera_.pose.world_from_camera(*options_.flash_in_camera));
    CutOptions cut = options_.cut;
    cut.max_bytes = budget_.free_bytes() / 10 * 8;
    const WorkingSet set = select_visible(store_, view, cut, budget_, report_);
    const bool one_band = y1 - y0 <= kBandRows;
    if (!set.complete || (set.bytes > options_.tile_bytes && !one_band)) {
      if (one_band)
        throw Error(concat("memory budget: the surfels seen in rows ", y0, " to ", y1, " of ", camera_.photograph, " need ", format_bytes(set.bytes), ", ",
                           format_bytes(budget_.free_bytes()), " left; raise --memory"));
      const int bands = (y1 - y0 + kBandRows - 1) / kBandRows;
      const auto parts = static_cast<int>(std::clamp<std::uint64_t>(set.bytes / (std::min(options_.tile_bytes, cut.max_bytes) + 1) + 1, 2, static_cast<std::uint64_t>(bands)));
      const int rows = (bands + parts - 1) / parts * kBandRows;
      for (int y = y0; y < y1; y += rows) run(y, std::min(y1, y + rows));
      return;
    }
    ++stats.tiles;
    stats.surfels += set.surfels;
    stats.chunks += set.chunks.size();
    stats.chunks_hidden += set.chunks_hidden;
    Tracer tracer(camera_.pose.centre_in_world(), budget_);
    for (const std::uint32_t c : set.chunks) {
      tracer.add(store_.read_chunk(c));
      report_.check();
    }
    tracer.commit();
    trace(tracer, y0, y1);
  }

  GBufferStats stats;

 private:
  void trace(const Tracer& tracer, int y0, int y1) {
    const Shot shot{camera_, tracer, tracer.scene_from_world(camera_.pose.centre_in_world()),
                    options_.flash_in_camera ? std::optional<Vec3f>(tracer.scene_from_world(camera_.pose.world_from_camera(*options_.flash_in_camera))) : std::nullopt,
                    camera_.pose.rotation_camera_from_world.transpose().cast<float>(), static_cast<float>(0.5 * (camera_.lens.fx + camera_.lens.fy)), options_.subpixels, static_cast<float>(stream::metres_per_unit(store_.manifest().unit))};
    const int width = camera_.lens.width_px;
    for (int band = y0; band < y1; band += kBandRows) {
      const int rows = std::min(kBandRows, y1 - band);
      std::vector<Pixel> pixels(static_cast<std::size_t>(rows) * static_cast<std::size_t>(width));
      std::vector<RayCounts> counts(static_cast<std::size_t>(rows));
      std::vector<std::uint8_t> mask(pixels.size(), 1);
      if (options_.mask_raster) mask = stream::RasterReader(*options_.mask_raster).rows<std::uint8_t>("mask", band, rows);
      parallel_blocks(static_cast<std::size_t>(rows), 1, [&](std::size_t r0, std::size_t r1) {
        for (std::size_t r = r0; r < r1; ++r)
          for (int x = 0; x < width; ++x) {
            const std::size_t i = r * static_cast<std::size_t>(width) + static_cast<std::size_t>(x);
            pixels[i] = trace_pixel(shot, x, band + static_cast<int>(r), (mask[i] & 1) != 0, counts[r]);
          }
      });
      for (const RayCounts& c : counts) {
        stats.rays += c.primary;
        stats.shadow_rays += c.shadow;
      }
      for (std::size_t i = 0; i < pixels.size(); ++i) {
        const Pixel& p = pixels[i];
        stats.pixels_hit += p.coverage > 0;
        stats.pixels_hit_in_mask += p.coverage > 0 && (mask[i] & 1) != 0;
        stats.pixels_from_behind += p.coverage > 0 && p.back > 0.5f;
      }
      store_band(out_, pixels, band, shot.flash.has_value());
      report_.progress(static_cast<std::uint64_t>(band + rows));
      report_.check();
    }
  }

  const stream::Store& store_;
  const stream::Camera& camera_;
  const GBufferOptions& options_;
  stream::RasterWriter& out_;
  MemoryBudget& budget_;
  Reporter& report_;
};

}  // namespace

GBufferStats write_gbuffer(const stream::Store& store, const stream::Camera& camera, const GBufferOptions& options, const std::filesystem::path& out_path,
                           MemoryBudget& budget, Reporter& report) {
  if (options.subpixels < 1 || options.subpixels > 16) throw std::invalid_argument("GBufferOptions::subpixels must be 1 to 16");
  std::vector<stream::PlaneInfo> planes;
  for (const std::string& name : float_planes(options.flash_in_camera.has_value())) planes.push_back({name, PlaneType::kF32, precision_of(name)});
  planes.push_back({"chunk", PlaneType::kU32});
  planes.push_back({"slot", PlaneType::kU16});
  planes.push_back({"edge", PlaneType::kF32, precision_of("edge")});
  if (options.flash_in_camera) planes.push_back({"shadow", PlaneType::kF32, precision_of("shadow")});
  const int width = camera.lens.width_px, height = camera.lens.height_px;
  report.begin(concat("raycast ", camera.photograph), static_cast<std::uint64_t>(height), "rows");
  stream::RasterWriter out(out_path, width, height, planes);
  Caster caster(store, camera, options, out, budget, report);
  caster.run(0, height);
  write_edge_distance(out, camera);
  if (options.flash_in_camera) write_shadow_doubt(out);
  out.commit();
  GBufferStats stats = caster.stats;
  report.end();
  stats.pixels = static_cast<std::uint64_t>(width) * static_cast<std::uint64_t>(height);
  return stats;
}

}  // namespace chiaro::surfels
