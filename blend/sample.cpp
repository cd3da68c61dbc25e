#include "blend/sample.h"

#include <algorithm>
#include <array>
#include <cmath>

namespace chiaro::blend {
namespace {

constexpr float kLeastCos = 0.05f;   // beyond 87 degrees a tangent plane predicts nothing

}  // namespace

float visibility_tolerance(float surfel_radius, float pixel_radius, float footprint, float cosv) {
  const float c = std::max(kLeastCos, cosv);
  const float slope = std::sqrt(std::max(0.0f, 1 - c * c)) / c;
  return 0.3f * (surfel_radius + pixel_radius) + 0.5f * footprint * (1 + slope);
}

namespace {

/// Axes of the image on the sphere of directions around `direction`: one pixel to the right or down is footprint / depth along them.
struct PixelAxes {
  Vec3f right, down;
};
PixelAxes pixel_axes(const Mat3d& rotation_camera_from_world, const Vec3f& direction) {
  const Vec3f x = rotation_camera_from_world.row(0).transpose().cast<float>();
  Vec3f right = x - direction * direction.dot(x);
  const float length = right.norm();
  right = length > 1e-6f ? Vec3f(right / length) : direction.unitOrthogonal();
  return {right, direction.cross(right)};
}

/// A surfel before a camera.
struct SurfelView {
  Vec2d pixel;
  Vec3f direction;
  PixelAxes axes;
  float distance = 0, radius = 0;
};

/// Four pixels around a place, a plane a number: the compiler does all four at once.
struct FourPixels {
  const WindowPixel* pixel[4] = {};
  float share[4] = {}, du[4] = {}, dv[4] = {};   // bilinear share; pixels from the surfel's own
  float depth[4] = {}, footprint[4] = {}, radius[4] = {}, nx[4] = {}, ny[4] = {}, nz[4] = {};
};

FourPixels pixels_around(const SurfelView& view, const Vec2d& place, const PhotoWindow& window) {
  FourPixels four;
  const int x0 = static_cast<int>(std::floor(place.x() - 0.5)), y0 = static_cast<int>(std::floor(place.y() - 0.5));
  for (int k = 0; k < 4; ++k) {
    const int x = x0 + (k & 1), y = y0 + (k >> 1);
    const WindowPixel* p = window.at(x, y);
    if (!p || !(p->weight > 0)) continue;
    four.share[k] = static_cast<float>((1 - std::abs(x + 0.5 - place.x())) * (1 - std::abs(y + 0.5 - place.y())));
    if (!(four.share[k] > 0)) continue;
    four.pixel[k] = p;
    four.du[k] = static_cast<float>(x + 0.5 - view.pixel.x());
    four.dv[k] = static_cast<float>(y + 0.5 - view.pixel.y());
    four.depth[k] = p->depth;
    four.footprint[k] = p->footprint;
    four.radius[k] = p->radius;
    four.nx[k] = p->normal.x();
    four.ny[k] = p->normal.y();
    four.nz[k] = p->normal.z();
  }
  return four;
}

/// Whether the tangent planes of the pixels meet the surfel, and the cosines of their slants. A plane is met where the ray through the surfel does.
struct Met {
  bool is[4];
  float cosv[4];
};
Met meet(const FourPixels& p, const SurfelView& view) {
  Met met;
  const float x = view.direction.x(), y = view.direction.y(), z = view.direction.z();
  const Vec3f &right = view.axes.right, &down = view.axes.down;
  float distance[4], tolerance[4];
  for (int k = 0; k < 4; ++k) {
    const float angle = p.footprint[k] / p.depth[k];
    const float tx = x + angle * (p.du[k] * right.x() + p.dv[k] * down.x()), ty = y + angle * (p.du[k] * right.y() + p.dv[k] * down.y()), tz = z + angle * (p.du[k] * right.z() + p.dv[k] * down.z());
    const float length = std::sqrt(tx * tx + (ty * ty + tz * tz));
    const float along = p.nx[k] * x + (p.ny[k] * y + p.nz[k] * z), towards = p.nx[k] * (tx / length) + (p.ny[k] * (ty / length) + p.nz[k] * (tz / length));
    const float c = std::abs(along);
    const bool is_grazing = c < kLeastCos;
    distance[k] = is_grazing ? p.depth[k] : p.depth[k] * towards / along;
    met.cosv[k] = is_grazing ? kLeastCos : c;
    tolerance[k] = visibility_tolerance(view.radius, p.radius[k], p.footprint[k], met.cosv[k]);
  }
  for (int k = 0; k < 4; ++k) met.is[k] = p.pixel[k] && std::abs(view.distance - distance[k]) <= tolerance[k];
  return met;
}

/// Bilinear at `place`, from the pixels whose planes, carried on to the surfel, meet it.
std::optional<Sample> read_at(const SurfelView& view, const Vec2d& place, const PhotoWindow& window) {
  const FourPixels four = pixels_around(view, place, window);
  const Met met = meet(four, view);
  Sample sample;
  float agreeing = 0;
  for (int k = 0; k < 4; ++k) {
    if (!met.is[k]) continue;
    const WindowPixel& p = *four.pixel[k];
    const float share = four.share[k];
    agreeing += share;
    sample.weight += share * p.weight;
    sample.sigma += share * p.sigma;
    sample.shared += share * p.shared;
    sample.footprint += share * p.footprint / std::sqrt(met.cosv[k]);
    sample.low += share * p.low;
    sample.high += share * p.high;
    const Vec3f* wider = window.wider_means.data() + (&p - window.pixels.data()) * window.wider;
    for (int i = 0; i < window.wider; ++i) sample.wider[static_cast<std::size_t>(i)] += share * wider[i];
  }
  if (!(sample.weight > 0) || agreeing < 0.25f) return std::nullopt;   // less than a quarter is extrapolation
  sample.sigma /= agreeing;
  sample.shared /= agreeing;
  sample.footprint /= agreeing;
  sample.low /= agreeing;
  sample.high /= agreeing;
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

std::optional<Vec2d> SurfelReader::project(const stream::Surfel& surfel) const {
  const auto pixel = stream::project(camera_.lens, camera_.pose.camera_from_world(surfel.position_in_world));
  if (!pixel || !(pixel->x() >= 0 && pixel->x() < camera_.lens.width_px && pixel->y() >= 0 && pixel->y() < camera_.lens.height_px)) return std::nullopt;
  const int row = static_cast<int>(pixel->y());
  return row >= y0_ && row < y1_ ? pixel : std::nullopt;
}

std::optional<Sample> SurfelReader::read(const stream::Surfel& surfel, const Vec2d& pixel) const {
  const Vec3d from_camera = surfel.position_in_world - centre_in_world_;
  const double distance = from_camera.norm();
  const Vec3f direction = (from_camera / distance).cast<float>();
  if ((surfel.flags & stream::SurfelBlock::kOriented) != 0 && surfel.normal.dot(direction) >= 0) return std::nullopt;
  const SurfelView view{pixel, direction, pixel_axes(camera_.pose.rotation_camera_from_world, direction), static_cast<float>(distance), surfel.radius};
  auto sample = read_at(view, pixel + shift_px_.cast<double>(), window_);
  if (!sample || shift_px_ == Vec2f::Zero()) return sample;
  // Pixels are mixed where the surface itself ends, which is at its own place, whatever the photograph is shifted by.
  const auto own = read_at(view, pixel, window_);
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
