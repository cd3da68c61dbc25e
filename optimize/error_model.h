/// How large the errors of an acquisition are, by their causes: estimated from how far its photographs disagree about the same surfels (physics.md E.6).
#pragma once
#include <span>

#include "optimize/light_solve.h"

namespace chiaro::optimize {

/// Variance of ln albedo in one photograph = pixel noise + the squares of what stands here times its cause. The values here hold where nothing can be estimated.
struct ErrorModel {
  double normal_rad = 0.02;          ///< of normals, along each of two directions; times the direct share and the tangent of incidence
  double registration_px = 0.3;      ///< photographs beside their place, geometry beside the truth; times the image's relative change per pixel
  double other_light = 0.03;         ///< relative, of light from sky and surfaces; times their share
  double spread = 0.3;               ///< times the direct share and the relative spread of the flash in the pixel
  double rest = 0.01;                ///< what nothing explains
  bool estimated = false;
};

/// Least squares of the squared deviations from each surfel's mean, robust, with coefficients that are not negative. What all photographs of a surfel have in common does
/// not show in them; an error of the normal does, as its effect changes with the direction of the light.
///
/// samples      sorted by group.
/// returns      the values of a default ErrorModel if fewer than 500 groups have two samples.
/// threads      one.
ErrorModel estimate_errors(std::span<const LightSample> samples, const Lights& lights);

}  // namespace chiaro::optimize
