/// What a run shows of each photograph: albedo, sigma, light shares, and what the blended result leaves unexplained.
#pragma once
#include <filesystem>

#include "optimize/observe.h"
#include "stream/base/report.h"
#include "stream/store/layer.h"

namespace chiaro::optimize {

/// albedo.exr (half RGB, linear, 0 where there is no value), sigma.exr (half Y, relative standard deviation, independent and shared part together),
/// light.exr (half, channels direct, indirect, ambient: shares of the irradiance), from the raster of solve_albedo().
void write_albedo_pictures(const std::filesystem::path& raster, const std::filesystem::path& folder);

/// For photographs that are the colour itself (solve.method = "none"): the same raster, albedo = pixel value, sigma from the noise.
void colour_as_albedo(const ObserveInput& photograph, const std::filesystem::path& raster, Reporter& report);

/// residual.exr (half RGB): photograph minus what the blended layer predicts under the same light, radiance. Returns the rms of residual over photograph.
double write_residual(const stream::Store& store, const stream::Layer& layer, const ObserveInput& photograph, const std::filesystem::path& albedo_raster,
                      const std::filesystem::path& picture, Reporter& report);

}  // namespace chiaro::optimize
