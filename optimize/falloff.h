/// How light falls off over the pictures of an acquisition: by the lens (vignetting, of all that a photograph shows), or by the flash (its pattern: what it sends out beside its axis).
#pragma once
#include "stream/photo/camera.h"

namespace chiaro::optimize {

/// Where something lies off an axis: sines of its direction across the axis, right and down, in units of `corner_sine`. Never farther out than a tenth beyond the corner:
/// what no picture shows is taken to be as its edge. Behind is as far out as that.
Vec2d off_axis(const Vec3d& direction_in_camera, double corner_sine);

/// Sine of the angle between the axis and the picture's farthest corner.
double corner_sine(const stream::Lens& lens);

struct Falloff {
  Vec2d lens = Vec2d::Zero();        ///< ln of what the picture keeps: of q and q^2, where q is the squared distance from the middle, 1 in the corners
  Eigen::Vector4d flash = Eigen::Vector4d::Zero();   ///< ln of the flash's intensity beside that along the camera's axis: of x, y, q, q^2
  double flash_corner_sine = 1;      ///< where q is 1 for the flash
  Eigen::Matrix4d covariance = Eigen::Matrix4d::Zero();   ///< of the one that is there: of `lens` the first two
  bool of_lens() const { return !lens.isZero(); }
  bool of_flash() const { return !flash.isZero(); }
  bool none() const { return !of_lens() && !of_flash(); }
};

/// The functions that the coefficients belong to, at a place off the axis.
Vec2d lens_terms(const Vec2d& off_axis);
Eigen::Vector4d flash_terms(const Vec2d& off_axis);

/// Factor on the picture, and on the flash's intensity; between 1/8 and 2.
double lens_factor(const Falloff& falloff, const Vec2d& off_axis);
double flash_pattern(const Falloff& falloff, const Vec2d& off_axis);
/// What is left of the light in the corners, all around; 1 where there is no falloff.
double kept_in_corners(const Falloff& falloff);
/// Variance of the ln of the factor that is there.
double falloff_variance(const Falloff& falloff, const Vec2d& off_axis_of_camera, const Vec2d& off_axis_of_flash);

}  // namespace chiaro::optimize
