/// What a photograph says about each surfel of the proxy: radiosity and flash irradiance, both averaged over the same pixels (like with like).
#pragma once
#include <cstdint>
#include <filesystem>
#include <optional>
#include <vector>

#include "optimize/photo_band.h"
#include "optimize/proxy.h"
#include "stream/base/report.h"
#include "stream/photo/camera.h"

namespace chiaro::optimize {

struct ObserveInput {
  stream::Camera camera;
  std::filesystem::path radiance, gbuffer;   ///< rasters of stream/photo/develop.h and surfels/gbuffer.h
  PixelNoise noise;
  std::optional<Vec3d> flash_in_camera;      ///< project units; absent: taken without flash
  double ambient_scale = 1;                  ///< exposure to the ambient light beside the acquisition's: ratio of the shutter times
};

/// One photograph on the proxy; arrays of N (colour: 3 N interleaved).
struct Observation {
  std::vector<std::uint8_t> seen;      ///< 1: measured in this photograph
  std::vector<float> radiosity;        ///< seen: pi * mean radiance of the pixels that the surfel covers. Unseen: what the solution says
  std::vector<float> flash;            ///< flash irradiance per unit intensity, 1/unit^2: mean of the same pixels, or at the surfel where unseen
  std::vector<float> spread;           ///< relative standard deviation of the flash irradiance in those pixels
  std::vector<float> variance;         ///< of ln radiosity: pixel noise and what registration does (gradient), mean of the channels
  std::vector<float> noise;            ///< of `variance`, pixel noise alone
  std::vector<float> gradient;         ///< relative change of the image at the surfel's middle, 1/px, pixel noise taken off
  std::vector<float> tan_flash;        ///< tangent of the flash's angle of incidence
  std::vector<float> floor_flash;      ///< flash_by_floor() (optimize/floor.h), or empty; kept in a file of its own
};

/// +1 where the camera sees the surfel's front as stored, -1 where it sees the back, 0 unseen: votes for orient().
std::vector<float> visibility_votes(const Proxy& proxy, const ObserveInput& input);

/// Reads the photograph by bands of rows. `flash` and `tan_flash` of unseen surfels are filled by cast_flash().
Observation observe(const Proxy& proxy, const ObserveInput& input);

/// Flash irradiance at the surfels that the photograph does not see: shadow rays through the proxy's tracer.
void cast_flash(const Proxy& proxy, const surfels::Tracer& tracer, const Vec3d& flash_in_world, Observation& observation);

/// State files: an observation between iterations. Neither synced nor checked beyond size: they live and die with one run of the solver, which goes over all of them again and again.
std::uint64_t observation_bytes(std::size_t num_surfels);
void write_observation(const Observation& observation, const std::filesystem::path& path);
/// Into an observation's file, which is there: its radiosity, all that an iteration changes.
void write_radiosity(const Observation& observation, const std::filesystem::path& path);
Observation read_observation(const std::filesystem::path& path, std::size_t num_surfels);

}  // namespace chiaro::optimize
