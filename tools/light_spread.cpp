#include "tools/light_spread.h"

#include <Eigen/Dense>
#include <algorithm>
#include <cmath>

namespace chiaro::tools {
namespace {

/// Covariance of ln flash and ln ambient.
Eigen::Matrix2d plane_of(const Eigen::MatrixXd& covariance, double ambient) {
  Eigen::Matrix2d c = covariance.topLeftCorner(2, 2);
  c(0, 1) /= ambient;
  c(1, 0) /= ambient;
  c(1, 1) /= ambient * ambient;
  return c;
}

}  // namespace

LightSpread light_spread(const optimize::LightSolution& s) {
  const double flash = s.lights.flash_intensity, ambient = s.lights.sky[0];
  LightSpread spread{{flash, flash}, {ambient, ambient}, {}, {}};
  if (s.covariance.rows() < 1) return spread;
  Eigen::Vector2d direction(1, 0);
  double sd = std::sqrt(std::max(0.0, s.covariance(0, 0)));
  Eigen::Matrix2d plane = Eigen::Matrix2d::Zero();
  plane(0, 0) = sd * sd;
  if (s.sky_terms > 0 && ambient > 0) {
    plane = plane_of(s.covariance, ambient);
    // Known to less than a factor of two: in logarithms it would drown the flash.
    if (plane(1, 1) < 0.25) {
      const Eigen::SelfAdjointEigenSolver<Eigen::Matrix2d> eigen(plane);
      direction = eigen.eigenvectors().col(1);
      if (direction[0] < 0) direction = -direction;
      sd = std::sqrt(std::max(0.0, eigen.eigenvalues()[1]));
    }
  }
  const double variance = direction.dot(plane * direction);
  for (std::size_t end = 0; end < 2; ++end) {
    const double t = (end == 0 ? -2 : 2) * sd;
    const Eigen::Vector2d change = variance > 0 ? Eigen::Vector2d(plane * direction * (t / variance)) : Eigen::Vector2d::Zero();
    spread.flash_intensity[end] = flash * std::exp(change[0]);
    spread.ambient[end] = ambient * std::exp(change[1]);
    spread.albedo_in_flash[end] = std::expm1(-change[0]);
    spread.albedo_in_ambient[end] = std::expm1(-change[1]);
  }
  return spread;
}

}  // namespace chiaro::tools
