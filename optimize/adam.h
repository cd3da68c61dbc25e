/// The paper's solver, on cached transport: Adam over albedo, flash intensity and ambient against one photograph.
///
/// source: Pintus, Zorcolo, Jaspe-Villanueva, Gobbetti 2025: preliminary 1-D search of the flash in its calibrated range with albedo and ambient
/// optimised, then all three together; rate 0.05, six scatterings; after each iteration lights are made grey and everything is clamped.
#pragma once
#include <span>
#include <vector>

#include "optimize/gather.h"
#include "optimize/light_solve.h"
#include "optimize/observe.h"
#include "stream/base/report.h"

namespace chiaro::optimize {

struct AdamOptions {
  double rate = 0.05, beta1 = 0.9, beta2 = 0.999, epsilon = 1e-8;
  int scatterings = 6;
  int search_steps = 5, search_iterations = 20, iterations = 60;   ///< as the prototype ran the published method
};

struct AdamState {
  std::vector<float> albedo;     ///< 3 N
  double flash_intensity = 1, ambient = 0;
};

struct AdamGradient {
  std::vector<float> albedo;     ///< 3 N
  double flash_intensity = 0, ambient = 0;
};

/// Mean squared radiance error over the seen surfels and channels, and its gradient by the adjoint (F transposed) of the truncated series.
double adam_loss(const Transport& transport, const Observation& o, const AdamState& state, int scatterings, AdamGradient* gradient);

struct AdamResult {
  AdamState state;
  double loss = 0, search_loss_low = 0, search_loss_high = 0;
};

/// flash_range: calibrated lowest and highest intensity.
AdamResult solve_adam(const Transport& transport, const Observation& o, const std::array<double, 2>& flash_range, const AdamOptions& options, Reporter& report);

}  // namespace chiaro::optimize
