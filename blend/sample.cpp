#include "blend/sample.h"

#include <algorithm>
#include <array>
#include <cmath>

#include "blend/four.h"

namespace chiaro::blend {
namespace {

constexpr float kLeastCos = 0.05f;   // beyond 87 degrees a tangent plane predicts nothing

float larger(float a, float b) { return a < b ? b : a; }
Four larger(float a, const Four& b) { return a < b ? b : Four{} + a; }
float root(float v) { return std::sqrt(v); }
Four root(const Four& v) { return Four{std::sqrt(v[0]), std::sqrt(v[1]), std::sqrt(v[2]), std::sqrt(v[3])}; }
Four magnitude(const Four& v) { return v < 0 ? -v : v; }

template <class Number>
Number tolerance_of(const Number& radii, const Number& footprint, const Number& cosv) {
  const Number c = larger(kLeastCos, cosv), slope = root(larger(0.0f, 1 - c * c)) / c;
  return 0.3f * radii + 0.5f * footprint * (1 + slope);
}

/// Axes of the image on the sphere of directions around `direction`: one pixel to the right or down is footprint / depth along them.
struct PixelAxes {
  Vec3f right, down;
};
PixelAxes pixel_axes(const Vec3f& right_in_world, const Vec3f& direction) {
  Vec3f right = right_in_world - direction * direction.dot(right_in_world);
  const float length = right.norm();
  right = length > 1e-6f ? Vec3f(right / length) : direction.unitOrthogonal();
  return {right, direction.cross(right)};
}

/// Columns from rows.
void transpose(Four& a, Four& b, Four& c, Four& d) {
  const Four ab = __builtin_shufflevector(a, b, 0, 4, 1, 5), cd = __builtin_shufflevector(c, d, 0, 4, 1, 5);
  const Four ab2 = __builtin_shufflevector(a, b, 2, 6, 3, 7), cd2 = __builtin_shufflevector(c, d, 2, 6, 3, 7);
  a = __builtin_shufflevector(ab, cd, 0, 1, 4, 5);
  b = __builtin_shufflevector(ab, cd, 2, 3, 6, 7);
  c = __builtin_shufflevector(ab2, cd2, 0, 1, 4, 5);
  d = __builtin_shufflevector(ab2, cd2, 2, 3, 6, 7);
}

/// A pixel's numbers in fours, as they lie there; what is not read shows nothing.
struct PixelRows {
  Four shape[4], normal[4], low[4], high[4];
  explicit PixelRows(const FourPixels& p) {
    for (std::size_t k = 0; k < 4; ++k) {
      shape[k] = normal[k] = low[k] = high[k] = Four{};
      if (!p.pixel[k]) continue;
      const auto* from = reinterpret_cast<const float*>(p.pixel[k]);
      shape[k] = load_four(from);
      normal[k] = load_four(from + 4);
      low[k] = load_four(from + 8);
      high[k] = load_four(from + 12);
    }
  }
};
static_assert(sizeof(WindowPixel) == 4 * sizeof(Four));

/// Which tangent planes of the pixels meet the surfel, and the cosines of their slants. A plane is met where the ray through the surfel does.
struct Met {
  FourMask is;
  Four cosv;
};
Met meet(const PixelRows& rows, const FourPixels& p, const SurfelView& view, const PixelAxes& axes) {
  Four depth = rows.shape[0], footprint = rows.shape[1], radius = rows.shape[2], weight = rows.shape[3];
  Four nx = rows.normal[0], ny = rows.normal[1], nz = rows.normal[2], sigma = rows.normal[3];
  transpose(depth, footprint, radius, weight);
  transpose(nx, ny, nz, sigma);
  const float x = view.direction.x(), y = view.direction.y(), z = view.direction.z();
  const Four du = load_four(p.du.data()), dv = load_four(p.dv.data()), angle = footprint / depth;
  const Four tx = x + angle * (du * axes.right.x() + dv * axes.down.x()), ty = y + angle * (du * axes.right.y() + dv * axes.down.y()), tz = z + angle * (du * axes.right.z() + dv * axes.down.z());
  const Four length = root(tx * tx + (ty * ty + tz * tz));
  const Four along = nx * x + (ny * y + nz * z), towards = nx * (tx / length) + (ny * (ty / length) + nz * (tz / length)), c = magnitude(along);
  const FourMask is_grazing = c < kLeastCos;
  const Four distance = is_grazing ? depth : depth * towards / along;
  Met met;
  met.cosv = is_grazing ? Four{} + kLeastCos : c;
  met.is = (magnitude(view.distance - distance) <= tolerance_of(view.radius + radius, footprint, met.cosv)) & (load_four(p.share.data()) > 0);
  return met;
}

Vec3f first_three(const Four& v) { return {v[0], v[1], v[2]}; }

/// Bilinear, from the pixels whose planes, carried on to the surfel, meet it.
std::optional<Sample> read_from(const FourPixels& p, const SurfelView& view, const PixelAxes& axes, const PhotoWindow& window) {
  const PixelRows rows(p);
  const Met met = meet(rows, p, view, axes);
  const Four share = met.is ? load_four(p.share.data()) : Four{};
  Four shape{}, normal{}, low{}, high{};
  float agreeing = 0;
  for (int k = 0; k < 4; ++k) {
    agreeing += share[k];
    shape += share[k] * rows.shape[k];
    normal += share[k] * rows.normal[k];
    low += share[k] * rows.low[k];
    high += share[k] * rows.high[k];
  }
  if (!(shape[3] > 0) || agreeing < 0.25f) return std::nullopt;   // less than a quarter is extrapolation
  Sample sample;
  sample.weight = shape[3];
  sample.sigma = normal[3] / agreeing;
  low /= agreeing;
  sample.low = first_three(low);
  sample.shared = low[3];
  sample.high = first_three(high / agreeing);
  for (int k = 0; k < 4; ++k) {
    if (!met.is[k]) continue;
    sample.footprint += share[k] * rows.shape[k][1] / std::sqrt(met.cosv[k]);
    const Vec3f* wider = window.wider_means.data() + (p.pixel[static_cast<std::size_t>(k)] - window.pixels.data()) * window.wider;
    for (int i = 0; i < window.wider; ++i) sample.wider[static_cast<std::size_t>(i)] += share[k] * wider[i];
  }
  sample.footprint /= agreeing;
  for (Vec3f& mean : sample.wider) mean /= agreeing;
  return sample;
}

std::vector<Vec3d> box_points(const Box3d& box) {
  std::vector<Vec3d> points;
  const Vec3d half = 0.5 * (box.max - box.min), centre = box.min + half;
  for (int z = -1; z <= 1; ++z)
    for (int y = -1; y <= 1; ++y)
      for (int x = -1; x <= 1; ++x) points.push_back(centre + half.cwiseProduct(Vec3d(x, y, z)));
  return points;
}

}  // namespace

float visibility_tolerance(float surfel_radius, float pixel_radius, float footprint, float cosv) { return tolerance_of(surfel_radius + pixel_radius, footprint, cosv); }

SurfelReader::SurfelReader(const stream::Camera& camera, const PhotoWindow& window, const Vec2f& shift_px, int y0, int y1)
    : camera_(camera), window_(window), shift_px_(shift_px), centre_in_world_(camera.pose.centre_in_world()),
      right_in_world_(camera.pose.rotation_camera_from_world.row(0).transpose().cast<float>()), is_pinhole_(stream::is_pinhole(camera.lens)), y0_(y0), y1_(y1) {}

std::optional<SurfelView> SurfelReader::before(const stream::Surfel& surfel) const {
  const Vec3d from_camera = surfel.position_in_world - centre_in_world_;
  const double distance = from_camera.norm();
  SurfelView view{{}, (from_camera / distance).cast<float>(), static_cast<float>(distance), surfel.radius};
  if ((surfel.flags & stream::SurfelBlock::kOriented) != 0 && surfel.normal.dot(view.direction) >= 0) return std::nullopt;
  const Vec3d in_camera = camera_.pose.camera_from_world(surfel.position_in_world);
  const auto pixel = is_pinhole_ ? stream::project_pinhole(camera_.lens, in_camera) : stream::project(camera_.lens, in_camera);
  if (!pixel || !(pixel->x() >= 0 && pixel->x() < camera_.lens.width_px && pixel->y() >= 0 && pixel->y() < camera_.lens.height_px)) return std::nullopt;
  const int row = static_cast<int>(pixel->y());
  if (row < y0_ || row >= y1_) return std::nullopt;
  view.pixel = *pixel;
  return view;
}

namespace {

/// std::floor is a call where the processor is not known.
int whole_below(double v) {
  const int towards_zero = static_cast<int>(v);
  return towards_zero - (v < towards_zero);
}

}  // namespace

FourPixels SurfelReader::pixels_around(const SurfelView& view, const Vec2d& place) const {
  FourPixels four;
  const int x0 = whole_below(place.x() - 0.5), y0 = whole_below(place.y() - 0.5);
  for (std::size_t k = 0; k < 4; ++k) {
    const int x = x0 + static_cast<int>(k & 1), y = y0 + static_cast<int>(k >> 1);
    const WindowPixel* p = window_.at(x, y);
    if (!p || !(p->weight > 0)) continue;
    four.share[k] = static_cast<float>((1 - std::abs(x + 0.5 - place.x())) * (1 - std::abs(y + 0.5 - place.y())));
    if (!(four.share[k] > 0)) continue;
    four.pixel[k] = p;
    four.du[k] = static_cast<float>(x + 0.5 - view.pixel.x());
    four.dv[k] = static_cast<float>(y + 0.5 - view.pixel.y());
    four.most_weight += four.share[k] * p->weight;
  }
  return four;
}

std::optional<Sample> SurfelReader::read(const SurfelView& view, const FourPixels& four) const {
  const PixelAxes axes = pixel_axes(right_in_world_, view.direction);
  auto sample = read_from(four, view, axes, window_);
  if (!sample || shift_px_ == Vec2f::Zero()) return sample;
  // Pixels are mixed where the surface itself ends, which is at its own place, whatever the photograph is shifted by.
  const auto own = read_from(pixels_around(view, view.pixel), view, axes, window_);
  if (!own) return std::nullopt;
  sample->weight = std::min(sample->weight, own->weight);
  return sample;
}

RowSpan rows_of_box(const stream::Camera& camera, const Box3d& box) {
  const RowSpan everything{0, camera.lens.height_px}, nothing{};
  Vec2d lo = Vec2d::Constant(1e300), hi = Vec2d::Constant(-1e300);
  bool all_projected = true, any_in_front = camera.lens.kind == stream::LensKind::kFisheye;
  for (const Vec3d& point : box_points(box)) {
    const Vec3d p = camera.pose.camera_from_world(point);
    any_in_front |= p.z() > 0;
    if (const auto pixel = stream::project(camera.lens, p)) {
      lo = lo.cwiseMin(*pixel);
      hi = hi.cwiseMax(*pixel);
    } else {
      all_projected = false;
    }
  }
  if (!any_in_front) return nothing;
  if (!all_projected) return everything;
  // Distortion bends the box's edges: a quarter of its size covers what lies between the projected points.
  const Vec2d margin = 0.25 * (hi - lo) + Vec2d::Constant(8);
  lo -= margin;
  hi += margin;
  if (hi.x() < 0 || lo.x() >= camera.lens.width_px || hi.y() < 0 || lo.y() >= camera.lens.height_px) return nothing;
  return {static_cast<int>(std::max(0.0, std::floor(lo.y()))), static_cast<int>(std::min<double>(camera.lens.height_px, std::floor(hi.y()) + 1))};
}

}  // namespace chiaro::blend
