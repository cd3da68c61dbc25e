/// What the model of the acquisition has wrong in a way that shows as a pattern: the flash stands elsewhere, or light falls off towards the corners of the pictures.
#pragma once
#include <span>

#include "optimize/falloff.h"
#include "optimize/light_solve.h"
#include "optimize/light_spread.h"

namespace chiaro::optimize {

enum class FalloffModel { kNone, kLens, kFlash, kAuto };

struct LightPattern {
  Vec3d flash_shift = Vec3d::Zero();   ///< project units, camera axes, from where the flash is said to be
  Falloff falloff;
};

struct LightPatternOptions {
  double shift_prior_sd = 0.03;   ///< project units (here 3 cm), of each coordinate: how well people measure it
  double farthest_shift = 0.06;   ///< nobody mistakes more
  FalloffModel falloff = FalloffModel::kAuto;
  LightSpread spread{};           ///< of the photographs' light, as far as it is known to vary; 0: it may, and then by kUsualSpread (optimize/own_light.h)
};

struct FoundPattern {
  LightPattern pattern;     ///< the whole, not what is to be added
  Eigen::Matrix2d lights_covariance = Eigen::Matrix2d::Zero();   ///< of ln flash and ln ambient: what they owe to its uncertainty
};

/// What there is of them beyond doubt; the others nothing. Whether photographs differ in brightness or ambient light by themselves (optimize/own_light.h) is left open where that may be, too. Needs LightSample::flash_by_shift, off_axis, flash_off_axis.
///
/// already      what the samples hold.
/// independent  residuals that the samples count for (independent_residuals()).
/// threads      one.
FoundPattern find_light_pattern(std::span<const LightSample> samples, const Lights& lights, const LightPattern& already, double independent, const LightPatternOptions& options = {});

}  // namespace chiaro::optimize
