/// Photographs that were exposed unlike the others of their acquisition: a flash that had not recharged, another power step, an edited file.
#pragma once
#include <cstddef>
#include <span>
#include <vector>

#include "optimize/light_solve.h"

namespace chiaro::optimize {

struct ExposureOptions {
  double least = 0.04;               ///< relative; smaller differences are more likely the model's than the camera's
  double least_scatters = 3;         ///< ... and so many robust deviations of the other photographs' factors
  std::size_t least_surfels = 50;    ///< that a photograph shares with others
};

/// Factor of brightness of each photograph beside the photograph in the middle: by medians of ln albedo against the median of the other photographs of the same
/// surfel. 1 where it is not clearly off, and for all if fewer than three photographs can be compared: of two that differ nobody knows which is right.
///
/// samples            sorted by group; those without flash take no part.
/// known              factors that were taken out before: photographs that had one are corrected by however little.
/// returns            factors still in the samples, one a photograph.
/// threads            one; the samples are few.
std::vector<double> unlike_exposures(std::span<const LightSample> samples, const Lights& lights, std::span<const double> known, const ExposureOptions& options = {});

}  // namespace chiaro::optimize
