/// Albedo of every pixel of a photograph, closed form on cached transport: rho = B / H (physics.md 0.2), with its uncertainty (E.6).
#pragma once
#include <filesystem>
#include <string>
#include <vector>

#include "optimize/acquisition.h"
#include "stream/photo/raster.h"

namespace chiaro::optimize {

struct AlbedoOptions {
  ErrorModel errors;
  bool direct_only = false;                ///< the standard pipeline: no ambient, no bounces
};

/// What the light stage left for a photograph.
struct AlbedoInputs {
  std::filesystem::path gathered, floor_flash;   ///< floor_flash is read where the lights have a floor
  LightPattern pattern;                          ///< where the flash was found, from where rays were cast to, and how light falls off over the picture
  OwnLight own;                                  ///< factors on the photograph's ambient light, and of its brightness to take out
};

struct AlbedoStats {
  std::uint64_t pixels = 0, pixels_solved = 0, pixels_dark = 0, pixels_above_one = 0, pixels_impossible = 0;   ///< impossible: an albedo above 2, or a radiance below zero by more than its noise, given no value
  double median_sigma = 0;
};

/// Of a photograph's albedo raster.
std::vector<stream::PlaneInfo> albedo_planes();

/// Writes `raster` with f32 planes r g b (albedo; NaN = no value), sigma (independent between photographs), shared (what all photographs of a surfel
/// share: lights, normals, gather), direct, indirect, ambient (shares of the irradiance, sum 1). By bands of rows, in bounded memory.
AlbedoStats solve_albedo(const Scene& scene, const ObserveInput& photograph, const LightSolution& lights, const Vec3d& flash_in_world,
                         const AlbedoInputs& inputs, const AlbedoOptions& options, const std::filesystem::path& raster, Reporter& report);

}  // namespace chiaro::optimize
