#include "blend/sample.h"

#include <algorithm>
#include <array>
#include <cmath>

namespace chiaro::blend {
namespace {

constexpr float kLeastCos = 0.05f;   // beyond 87 degrees a tangent plane predicts nothing

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

/// Distance along `direction` to the tangent plane of a pixel that lies (du, dv) pixels away, and the cosine of its slant.
struct Prediction {
  float distance = 0, cosv = 0;
};
Prediction predict(const WindowPixel& pixel, const Vec3f& direction, const PixelAxes& axes, float du, float dv) {
  const float angle = pixel.footprint / pixel.depth;
  const Vec3f towards_pixel = (direction + angle * (du * axes.right + dv * axes.down)).normalized();
  const float c = std::abs(pixel.normal.dot(direction));
  if (c < kLeastCos) return {pixel.depth, kLeastCos};
  return {pixel.depth * pixel.normal.dot(towards_pixel) / pixel.normal.dot(direction), c};
}

/// A surfel before a camera.
struct SurfelView {
  Vec2d pixel;
  Vec3f direction;
  PixelAxes axes;
  float distance = 0, radius = 0;
};

/// Bilinear at `place`, from the pixels whose planes, carried on to the surfel, meet it.
std::optional<Sample> read_at(const SurfelView& view, const Vec2d& place, const PhotoWindow& window) {
  const int x0 = static_cast<int>(std::floor(place.x() - 0.5)), y0 = static_cast<int>(std::floor(place.y() - 0.5));
  Sample sample;
  float agreeing = 0;
  for (int k = 0; k < 4; ++k) {
    const int x = x0 + (k & 1), y = y0 + (k >> 1);
    const WindowPixel* p = window.at(x, y);
    if (!p || !(p->weight > 0)) continue;
    const auto share = static_cast<float>((1 - std::abs(x + 0.5 - place.x())) * (1 - std::abs(y + 0.5 - place.y())));
    if (!(share > 0)) continue;
    const auto du = static_cast<float>(x + 0.5 - view.pixel.x()), dv = static_cast<float>(y + 0.5 - view.pixel.y());
    const Prediction seen = predict(*p, view.direction, view.axes, du, dv);
    if (!(std::abs(view.distance - seen.distance) <= visibility_tolerance(view.radius, p->radius, p->footprint, seen.cosv))) continue;
    agreeing += share;
    sample.weight += share * p->weight;
    sample.sigma += share * p->sigma;
    sample.shared += share * p->shared;
    sample.footprint += share * p->footprint / std::sqrt(seen.cosv);
    sample.low += share * p->low;
    sample.high += share * p->high;
  }
  if (!(sample.weight > 0) || agreeing < 0.25f) return std::nullopt;   // less than a quarter is extrapolation
  sample.sigma /= agreeing;
  sample.shared /= agreeing;
  sample.footprint /= agreeing;
  sample.low /= agreeing;
  sample.high /= agreeing;
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

float visibility_tolerance(float surfel_radius, float pixel_radius, float footprint, float cosv) {
  const float c = std::max(kLeastCos, cosv);
  const float slope = std::sqrt(std::max(0.0f, 1 - c * c)) / c;
  return 0.3f * (surfel_radius + pixel_radius) + 0.5f * footprint * (1 + slope);
}

std::optional<Vec2d> project_surfel(const stream::Camera& camera, const stream::Surfel& surfel) {
  const auto pixel = stream::project(camera.lens, camera.pose.camera_from_world(surfel.position_in_world));
  if (!pixel || !(pixel->x() >= 0 && pixel->x() < camera.lens.width_px && pixel->y() >= 0 && pixel->y() < camera.lens.height_px)) return std::nullopt;
  return pixel;
}

std::optional<Sample> read_surfel(const stream::Camera& camera, const stream::Surfel& surfel, const Vec2d& pixel, const Vec2f& shift_px, const PhotoWindow& window) {
  const Vec3d from_camera = surfel.position_in_world - camera.pose.centre_in_world();
  const double distance = from_camera.norm();
  const Vec3f direction = (from_camera / distance).cast<float>();
  if ((surfel.flags & stream::SurfelBlock::kOriented) != 0 && surfel.normal.dot(direction) >= 0) return std::nullopt;
  const SurfelView view{pixel, direction, pixel_axes(camera.pose.rotation_camera_from_world, direction), static_cast<float>(distance), surfel.radius};
  auto sample = read_at(view, pixel + shift_px.cast<double>(), window);
  if (!sample || shift_px == Vec2f::Zero()) return sample;
  // Pixels are mixed where the surface itself ends, which is at its own place, whatever the photograph is shifted by.
  const auto own = read_at(view, pixel, window);
  if (!own) return std::nullopt;
  sample->weight = std::min(sample->weight, own->weight);
  return sample;
}

std::vector<Sample> sample_chunk(const stream::Chunk& chunk, const stream::Camera& camera, const Vec2f& shift_px, const PhotoWindow& window, int y0, int y1) {
  std::vector<Sample> samples;
  for (std::uint32_t slot = 0; slot < chunk.count; ++slot) {
    const stream::Surfel surfel = chunk.surfel(slot);
    const auto pixel = project_surfel(camera, surfel);
    if (!pixel) continue;
    const int row = static_cast<int>(pixel->y());
    if (row < y0 || row >= y1) continue;
    if (auto sample = read_surfel(camera, surfel, *pixel, shift_px, window)) {
      sample->slot = slot;
      samples.push_back(*sample);
    }
  }
  return samples;
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
