/// Radiosity on the proxy: what is measured stays, what a photograph does not see follows from its albedo (physics.md A.4).
#pragma once
#include <span>
#include <vector>

#include "optimize/gather.h"
#include "optimize/light_solve.h"
#include "optimize/observe.h"

namespace chiaro::optimize {

/// Irradiance without bounces of the cloud: flash and sky, and a floor's share of both. 3 N values. floor_flash: flash_by_floor(), may be empty.
std::vector<float> direct_irradiance(const Transport& transport, std::span<const float> flash, std::span<const float> floor_flash, const Lights& lights);

/// B of unseen surfels = albedo * (direct + bounce * F B), by sweeps that start from what o.radiosity holds; seen surfels keep their measurement.
/// albedo: 3 N. Stops after max_sweeps or when no value moves by more than tolerance of the mean. Returns G = F B, smoothed; sweeps done in `sweeps`.
std::vector<float> complete_radiosity(const Transport& transport, const Smoother& smoother, int smooth_passes, const Lights& lights, std::span<const float> albedo,
                                      Observation& o, int max_sweeps, double tolerance, int* sweeps = nullptr);

/// All surfels from their albedo: B = albedo * (direct + bounce * F B) with `scatterings` surface scatterings (each sweep adds one).
std::vector<float> forward_radiosity(const Transport& transport, std::span<const float> albedo, std::span<const float> direct, double bounce, int scatterings);

}  // namespace chiaro::optimize
