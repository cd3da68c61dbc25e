/// Where the flash really is: it leaves a pattern in how photographs disagree when it is not where the project says.
#pragma once
#include <span>

#include "optimize/light_solve.h"

namespace chiaro::optimize {

struct FlashPlace {
  Vec3d shift_in_camera = Vec3d::Zero();   ///< project units, from where it is said to be
  Vec3d sd = Vec3d::Zero();
  double chi2 = 0;                         ///< of the shift being nothing, three degrees of freedom
  double before = 0, after = 0;            ///< robust deviation of the residuals, in expected ones, as the samples are and with the shift
  Eigen::Matrix2d lights_covariance = Eigen::Matrix2d::Zero();   ///< of ln flash and ln ambient: what they owe to the shift's uncertainty
};

struct FlashPlaceOptions {
  double prior_sd = 0.03;            ///< project units (here 3 cm), of each coordinate: how well people measure it
  double lights_sd = 0.1, bounce_sd = 0.02;   ///< of what is left open beside: ln flash, ln ambient; the factor on gathered light
};

/// Least squares of the log ratios within groups, robust, linear in the shift; lights are free beside it. Needs LightSample::flash_by_shift.
///
/// already      the shift that the samples hold, project units: the result is the whole of it, and so is what the prior pulls at.
/// independent  residuals that the samples count for (independent_residuals()).
/// threads      one.
FlashPlace find_flash_place(std::span<const LightSample> samples, const Lights& lights, const Vec3d& already, double independent, const FlashPlaceOptions& options = {});

/// Factor on the flash's irradiance at a place whose normal is n if the flash moves: of falloff and cosine, not of shadows. Between 1/2 and 2.
double flash_factor(const Vec3d& place, const Vec3d& normal, const Vec3d& flash, const Vec3d& moved);

}  // namespace chiaro::optimize
