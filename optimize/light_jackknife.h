/// How far the lights move with the choice of photographs: what a model gets wrong is wrong in another way in each of them.
#pragma once
#include <optional>
#include <span>

#include "optimize/light_solve.h"

namespace chiaro::optimize {

/// Variance of sky[0] by leaving out one photograph at a time (or one of eight lots of them), delete-one jackknife: Efron & Tibshirani, "An Introduction to the
/// Bootstrap", 1993, eq. 11.5. Scatter of the residuals does not say it where they are wrong alike over a photograph: of the sky, a small share of all light, the
/// photographs of a deep room say what their last thousandths of error let them.
///
/// samples     sorted by group. References stay: they are knowledge from outside.
/// solution    of these samples, or of more of the same photographs.
/// returns     absent where fewer than three photographs or 100 groups are left to compare.
/// memory      a copy of the samples.
std::optional<double> ambient_variance_by_photographs(std::span<const LightSample> samples, std::span<const ReferenceSample> references, const LightSolveOptions& options, const LightSolution& solution);

}  // namespace chiaro::optimize
