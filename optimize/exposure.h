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

struct StrangerOptions {
  double least = 0.12;               ///< robust deviation of ln albedo from that of the other photographs: what a mere misfit does not reach
  double least_ratio = 5;            ///< ... and so many times the typical one of the others
  std::size_t least_surfels = 50;    ///< that two others saw as well
};

/// Whether a photograph shows something else than the others, all over: its readings scatter about the median of the others by far more than theirs do, whatever its
/// brightness. Only surfels that three photographs saw count, as of two nobody knows which is right.
///
/// samples            sorted by group; those without flash take no part.
/// returns            one a photograph; false for all if fewer than three photographs can be compared.
/// threads            one.
std::vector<bool> strangers(std::span<const LightSample> samples, const Lights& lights, std::size_t photographs, const StrangerOptions& options = {});

}  // namespace chiaro::optimize
