/// Photographs that show something else than the others of their acquisition: another object, or by the wrong camera.
#pragma once
#include <cstddef>
#include <span>
#include <vector>

#include "optimize/light_solve.h"

namespace chiaro::optimize {

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
