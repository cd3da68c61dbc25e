#include "optimize/falloff.h"

#include <algorithm>
#include <cmath>

namespace chiaro::optimize {
namespace {

constexpr double kFarthest = 1.1;
constexpr double kLeastLn = -2.08, kMostLn = 0.69;

double factor(double ln) { return std::exp(std::clamp(ln, kLeastLn, kMostLn)); }

}  // namespace

Vec2d off_axis(const Vec3d& d, double corner_sine) {
  const double length = d.norm(), across = d.head<2>().norm();
  if (!(length > 0)) return Vec2d::Zero();
  const double far = d.z() > 0 ? std::min(kFarthest, across / (length * corner_sine)) : kFarthest;
  return across > 0 ? Vec2d(d.head<2>() * (far / across)) : Vec2d(d.z() > 0 ? 0.0 : far, 0.0);
}

double corner_sine(const stream::Lens& lens) {
  double sine = 0;
  for (const double x : {0.0, static_cast<double>(lens.width_px)})
    for (const double y : {0.0, static_cast<double>(lens.height_px)}) {
      const auto d = stream::unproject(lens, {x, y});
      sine = std::max(sine, d && d->z() > 0 ? d->head<2>().norm() / d->norm() : 1.0);
    }
  return sine;
}

Vec2d lens_terms(const Vec2d& w) {
  const double q = w.squaredNorm();
  return {q, q * q};
}

Eigen::Vector4d flash_terms(const Vec2d& w) {
  const double q = w.squaredNorm();
  return {w.x(), w.y(), q, q * q};
}

double lens_factor(const Falloff& falloff, const Vec2d& w) { return falloff.of_lens() ? factor(falloff.lens.dot(lens_terms(w))) : 1; }

double flash_pattern(const Falloff& falloff, const Vec2d& w) { return falloff.of_flash() ? factor(falloff.flash.dot(flash_terms(w))) : 1; }

double kept_in_corners(const Falloff& falloff) { return factor(falloff.of_lens() ? falloff.lens.sum() : falloff.flash.tail<2>().sum()); }

double falloff_variance(const Falloff& falloff, const Vec2d& of_camera, const Vec2d& of_flash) {
  if (falloff.of_lens()) {
    const Vec2d t = lens_terms(of_camera);
    return std::max(0.0, t.dot(falloff.covariance.topLeftCorner<2, 2>() * t));
  }
  const Eigen::Vector4d t = flash_terms(of_flash);
  return std::max(0.0, t.dot(falloff.covariance * t));
}

}  // namespace chiaro::optimize
