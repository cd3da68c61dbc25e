#include "optimize/view_detail.h"

#include <algorithm>
#include <array>
#include <cmath>

#include "stream/base/error.h"
#include "stream/base/parallel.h"

namespace chiaro::optimize {
namespace {

constexpr int kPhotoRows = 64, kHalo = 16;   ///< rows of a photograph at a time, and beyond them on both sides
constexpr int kMostSamples = 4;            ///< a side, where the view is coarser than the photograph
constexpr float kDepthFootprints = 3;      ///< how far depths may lie apart
constexpr float kFullWeightFromEdge = 8;   ///< pixels
constexpr float kLeastEdge = 1;            ///< pixels
constexpr float kCubicEdge = 2;              ///< pixels: nearer to an edge some of the sixteen show something else
constexpr float kSigmaFloor = 0.1f;
constexpr float kAgreement = 0.4f;         ///< log albedo
constexpr float kFlashApart = 0.09f;       ///< rad: flashes further apart shade relief unlike
constexpr float kLeastAlbedo = 1e-3f;
constexpr float kPointsShare = 0.03f, kPointsSigma = 0.05f;   ///< the points take part like one more photograph, so that there is no seam where photographs end

/// Rows [y0, y0 + rows) of a photograph.
struct PhotoRows {
  static constexpr std::uint64_t kBytesPerPixel = 8 * sizeof(float);
  int y0, rows, width;
  std::vector<float> r, g, b, sigma, depth, footprint, cosv, edge;

  PhotoRows(const stream::RasterReader& albedo, const stream::RasterReader& gbuffer, int first, int count) : y0(first), rows(count), width(albedo.width()) {
    r = albedo.rows<float>("r", y0, rows);
    g = albedo.rows<float>("g", y0, rows);
    b = albedo.rows<float>("b", y0, rows);
    sigma = albedo.rows<float>("sigma", y0, rows);
    depth = gbuffer.rows<float>("depth", y0, rows);
    footprint = gbuffer.rows<float>("footprint", y0, rows);
    cosv = gbuffer.rows<float>("cosv", y0, rows);
    edge = gbuffer.rows<float>("edge", y0, rows);
  }
};

/// Where a pixel of the view lies in a photograph.
struct Place {
  float u = 0, v = 0, distance = -1;   ///< pixels, middles at integers; distance from the photograph's camera; < 0: nowhere
  float blur_px = 0;                   ///< diameter of the lens's blur there
};

/// Weighted sums over the photographs.
struct Sum {
  Vec3f albedo = Vec3f::Zero();
  float weight = 0;
  float strength = 0;   ///< weight but for the likeness of the light: beside the points
};

/// The four pixels around a place, and how much each counts.
struct Four {
  std::size_t first, width;
  float s, t;

  /// Nullopt where they are not all held.
  static std::optional<Four> around(const PhotoRows& photo, float u, float v) {
    if (!(u >= 0 && v >= static_cast<float>(photo.y0))) return std::nullopt;
    const auto x = static_cast<int>(u), y = static_cast<int>(v);
    if (x + 1 >= photo.width || y + 1 >= photo.y0 + photo.rows) return std::nullopt;
    const auto width = static_cast<std::size_t>(photo.width);
    return Four{static_cast<std::size_t>(y - photo.y0) * width + static_cast<std::size_t>(x), width, u - static_cast<float>(x), v - static_cast<float>(y)};
  }
  float mean(const std::vector<float>& plane) const {
    return (plane[first] * (1 - s) + plane[first + 1] * s) * (1 - t) + (plane[first + width] * (1 - s) + plane[first + width + 1] * s) * t;
  }
  float least(const std::vector<float>& plane) const { return std::min({plane[first], plane[first + 1], plane[first + width], plane[first + width + 1]}); }
};

/// Shares of the four pixels from the one before a place on. source: Catmull and Rom 1974; Keys 1981, a = -1/2.
std::array<float, 4> cubic_shares(float t) {
  const float t2 = t * t, t3 = t2 * t;
  return {-0.5f * t + t2 - 0.5f * t3, 1 - 2.5f * t2 + 1.5f * t3, 0.5f * t + 2 * t2 - 1.5f * t3, -0.5f * t2 + 0.5f * t3};
}

/// The sixteen pixels around a place.
struct Sixteen {
  std::size_t first, width;
  std::array<float, 4> s, t;

  static std::optional<Sixteen> around(const PhotoRows& photo, float u, float v) {
    const auto x = static_cast<int>(u), y = static_cast<int>(v);
    if (x < 1 || y - 1 < photo.y0 || x + 2 >= photo.width || y + 2 >= photo.y0 + photo.rows) return std::nullopt;
    const auto width = static_cast<std::size_t>(photo.width);
    return Sixteen{static_cast<std::size_t>(y - 1 - photo.y0) * width + static_cast<std::size_t>(x - 1), width, cubic_shares(u - static_cast<float>(x)), cubic_shares(v - static_cast<float>(y))};
  }
  float mean(const std::vector<float>& plane) const {
    float sum = 0;
    for (std::size_t j = 0; j < 4; ++j)
      for (std::size_t i = 0; i < 4; ++i) sum += t[j] * s[i] * plane[first + j * width + i];
    return sum;
  }
};

/// pixels: Four or Sixteen.
template <class Pixels>
Vec3f albedo_of(const PhotoRows& photo, const Pixels& pixels) {
  return {pixels.mean(photo.r), pixels.mean(photo.g), pixels.mean(photo.b)};
}

/// Adds what the photograph shows at `at`, if that surface is there.
void add_sample(const PhotoRows& photo, const Place& at, const Vec2f& shift_px, float radius, Sum& sum) {
  const auto surface = Four::around(photo, at.u, at.v), shown = Four::around(photo, at.u + shift_px.x(), at.v + shift_px.y());
  if (!surface || !shown) return;
  const float footprint = photo.footprint[surface->first], edge = surface->least(photo.edge) - 0.5f * at.blur_px;
  if (!(footprint > 0) || footprint > radius || edge < kLeastEdge) return;
  if (std::fabs(surface->mean(photo.depth) - at.distance) > kDepthFootprints * footprint) return;
  const auto wider = edge >= kCubicEdge ? Sixteen::around(photo, at.u + shift_px.x(), at.v + shift_px.y()) : std::nullopt;
  Vec3f albedo = wider ? albedo_of(photo, *wider) : albedo_of(photo, *shown);
  if (wider && !(albedo.sum() >= 0)) albedo = albedo_of(photo, *shown);   // one of the sixteen has no value: the next four may
  const float sigma = shown->mean(photo.sigma);
  if (!(albedo.sum() >= 0) || !(sigma >= 0)) return;   // NaN: no value at one of the four
  const float resolution = photo.cosv[surface->first] / footprint;
  const float strength = resolution * resolution * stream::focus_share(at.blur_px) * std::min(1.0f, edge / kFullWeightFromEdge) / (sigma * sigma + kSigmaFloor * kSigmaFloor);
  sum.albedo += albedo * strength;
  sum.strength += strength;
}

/// One photograph against some rows of a view.
class Lookup {
 public:
  Lookup(const DetailView& view, const ViewRows& rows, const DetailPhotograph& photograph)
      : view_(view), rows_(rows), photograph_(photograph), camera_(photograph.camera), centre_(camera_.pose.centre_in_world()) {}

  /// What the view shows at the pixel coordinates (x + dx, y0 + row + dy), at the pixel's distance.
  std::optional<Vec3d> point(int x, int row, double dx, double dy) const {
    const float depth = rows_.depth[at(x, row)];
    if (!(depth > 0)) return std::nullopt;
    const auto d = stream::unproject(view_.lens, {x + dx, rows_.y0 + row + dy});
    if (!d) return std::nullopt;
    return view_.pose.world_from_camera(*d * static_cast<double>(depth));
  }

  /// Where that lies in the photograph.
  Place place(int x, int row, double dx, double dy) const {
    const auto p = point(x, row, dx, dy);
    if (!p) return {};
    const Vec3d in_camera = camera_.pose.camera_from_world(*p);
    const auto pixel = stream::project(camera_.lens, in_camera);
    if (!pixel) return {};
    const double u = pixel->x() - 0.5, v = pixel->y() - 0.5;
    if (!(u >= 0 && v >= 0 && u < camera_.lens.width_px - 1 && v < camera_.lens.height_px - 1)) return {};
    return {static_cast<float>(u), static_cast<float>(v), static_cast<float>((*p - centre_).norm()), static_cast<float>(stream::blur_px(camera_, in_camera.z()))};
  }

  /// False where none of some of the pixels falls into the photograph: most photographs of an acquisition see nothing of a few rows.
  bool may_see() const {
    constexpr int kStep = 8;
    for (int row = 0; row < rows_.rows; row += kStep)
      for (int x = 0; x < rows_.width; x += kStep)
        if (place(x, row, 0.5, 0.5).distance >= 0) return true;
    return false;
  }

  void add(const stream::RasterReader& albedo, const stream::RasterReader& gbuffer, std::vector<Sum>& sums) const {
    std::vector<Place> places(rows_.depth.size());
    std::vector<std::uint8_t> touched(static_cast<std::size_t>(camera_.lens.height_px / kPhotoRows) + 1, 0);
    parallel_blocks(static_cast<std::size_t>(rows_.rows), 4, [&](std::size_t b, std::size_t e) {
      for (std::size_t row = b; row < e; ++row)
        for (int x = 0; x < rows_.width; ++x) places[at(x, static_cast<int>(row))] = place(x, static_cast<int>(row), 0.5, 0.5);
    });
    for (const Place& p : places)
      if (p.distance >= 0) touched[static_cast<std::size_t>(p.v) / kPhotoRows] = 1;
    for (std::size_t band = 0; band < touched.size(); ++band)
      if (touched[band]) add_band(albedo, gbuffer, static_cast<int>(band), places, sums);
  }

 private:
  /// How alike the flashes of view and photograph light the pixel: 1 from the same side.
  float likeness(int x, int row) const {
    if (!view_.flash_in_world || !photograph_.flash_in_world) return 1;
    const Vec3d p = *point(x, row, 0.5, 0.5);
    const Vec3d a = (*view_.flash_in_world - p).normalized(), b = (*photograph_.flash_in_world - p).normalized();
    const float apart = static_cast<float>((a - b).norm()) / kFlashApart;
    return 1 / (1 + apart * apart);
  }

  std::size_t at(int x, int row) const { return static_cast<std::size_t>(row) * static_cast<std::size_t>(rows_.width) + static_cast<std::size_t>(x); }

  /// The pixels of the view whose middle falls into a band of the photograph; their samples may reach a few rows further.
  void add_band(const stream::RasterReader& albedo, const stream::RasterReader& gbuffer, int band, const std::vector<Place>& places, std::vector<Sum>& sums) const {
    const int first = std::max(0, band * kPhotoRows - kHalo), last = std::min(camera_.lens.height_px, (band + 1) * kPhotoRows + kHalo);
    const PhotoRows photo(albedo, gbuffer, first, last - first);
    parallel_blocks(static_cast<std::size_t>(rows_.rows), 4, [&](std::size_t b, std::size_t e) {
      for (std::size_t row = b; row < e; ++row)
        for (int x = 0; x < rows_.width; ++x) {
          const std::size_t i = at(x, static_cast<int>(row));
          if (places[i].distance >= 0 && static_cast<int>(places[i].v) / kPhotoRows == band) add_pixel(photo, x, static_cast<int>(row), places[i], sums[i]);
        }
    });
  }

  void add_pixel(const PhotoRows& photo, int x, int row, const Place& middle, Sum& sum) const {
    const std::size_t i = at(x, row);
    const Place beside = place(x, row, 1.5, 0.5), below = place(x, row, 0.5, 1.5);
    const float apart = std::max(beside.distance < 0 ? 0.0f : std::hypot(beside.u - middle.u, beside.v - middle.v),
                                 below.distance < 0 ? 0.0f : std::hypot(below.u - middle.u, below.v - middle.v));
    const int n = std::clamp(static_cast<int>(std::ceil(apart - 0.25f)), 1, kMostSamples);
    Sum own;
    for (int j = 0; j < n; ++j)
      for (int k = 0; k < n; ++k) {
        const Place p = n == 1 ? middle : place(x, row, (k + 0.5) / n, (j + 0.5) / n);
        if (p.distance >= 0) add_sample(photo, p, photograph_.shift_px, rows_.radius[i], own);
      }
    if (!(own.strength > 0)) return;
    const Vec3f albedo = photograph_.gain.cwiseProduct(own.albedo) / own.strength;
    if (!(albedo.mean() > kLeastAlbedo)) return;
    const float off = std::log(albedo.mean() / rows_.albedo[i].mean()) / kAgreement, doubt = 1 + off * off;
    const float strength = photograph_.trust * own.strength / (static_cast<float>(n * n) * doubt * doubt), like = likeness(x, row);
    sum.albedo += albedo * (like * strength);
    sum.weight += like * strength;
    sum.strength += strength;
  }

  const DetailView& view_;
  const ViewRows& rows_;
  const DetailPhotograph& photograph_;
  const stream::Camera& camera_;
  const Vec3d centre_;
};

void require_size(const std::filesystem::path& path, const stream::RasterReader& raster, const stream::Lens& lens) {
  if (raster.width() != lens.width_px || raster.height() != lens.height_px)
    throw Error(concat(path.string(), ": expected ", lens.width_px, " x ", lens.height_px, " pixels, found ", raster.width(), " x ", raster.height()));
}

}  // namespace

std::uint64_t sharpening_bytes(std::size_t pixels, std::span<const DetailPhotograph> photographs) {
  int widest = 0;
  for (const DetailPhotograph& p : photographs) widest = std::max(widest, p.camera.lens.width_px);
  return pixels * (sizeof(Sum) + sizeof(Place) + sizeof(Vec3f)) + static_cast<std::uint64_t>(kPhotoRows + 2 * kHalo) * static_cast<std::uint64_t>(widest) * PhotoRows::kBytesPerPixel;
}

std::vector<Vec3f> sharpening(const DetailView& view, const ViewRows& rows, std::span<const DetailPhotograph> photographs) {
  std::vector<Sum> sums(rows.depth.size());
  for (const DetailPhotograph& photograph : photographs) {
    const Lookup lookup(view, rows, photograph);
    if (!lookup.may_see()) continue;
    const stream::RasterReader albedo(photograph.albedo), gbuffer(photograph.gbuffer);
    require_size(photograph.albedo, albedo, photograph.camera.lens);
    require_size(photograph.gbuffer, gbuffer, photograph.camera.lens);
    lookup.add(albedo, gbuffer, sums);
  }
  std::vector<Vec3f> factors(sums.size(), Vec3f::Ones());
  for (std::size_t i = 0; i < sums.size(); ++i) {
    if (!(sums[i].weight > 0) || !(rows.albedo[i].minCoeff() > kLeastAlbedo)) continue;
    const float of_points = kPointsShare / (rows.radius[i] * rows.radius[i] * (kPointsSigma * kPointsSigma + kSigmaFloor * kSigmaFloor));
    const float share = sums[i].strength / (sums[i].strength + of_points);
    const Vec3f albedo = share / sums[i].weight * sums[i].albedo + (1 - share) * rows.albedo[i];
    factors[i] = albedo.cwiseMax(0.0f).cwiseQuotient(rows.albedo[i]);
  }
  return factors;
}

}  // namespace chiaro::optimize
