/// Flash photographs of synthetic scenes, with every term of the light: by tracing paths on the true surfaces.
///
/// Radiometry, as everywhere in chiaro: a pixel is radiance; a flash of I W/sr at distance r gives irradiance I cos / r^2; reflected radiance is
/// albedo / pi * irradiance; a sky of radiance La that is all seen gives irradiance pi La.
#pragma once
#include <cstdint>
#include <span>
#include <vector>

#include "optimize/gloss.h"
#include "stream/photo/camera.h"
#include "tools/synth_body.h"

namespace chiaro::tools {

struct SynthLights {
  double flash_intensity = 0;    ///< W/sr
  double ambient_radiance = 0;   ///< of every direction that meets no surface, grey; W/(sr m^2)
  int bounces = 11;              ///< how often light goes from surface to surface; 0: surfaces do not light each other. At most kMostBounces
  optimize::Gloss gloss{};       ///< of all surfaces; what they throw on each other is spread evenly
};
inline constexpr int kMostBounces = 60;

struct SynthView {
  stream::Lens lens;
  stream::Pose pose;             ///< in the frame of the scene before scale and offset
  Vec3d flash_in_camera = Vec3d::Zero();   ///< in the same unit
  Vec3d flash_in_scene() const { return pose.world_from_camera(flash_in_camera); }
};

struct SynthPixels {
  int samples = 4;               ///< samples^2 rays a pixel, evenly spread over it, each with one path
  double gain = 0, read_sigma = 0;   ///< variance of a value = gain * value + read_sigma^2; 0: no noise
  std::uint64_t seed = 1;        ///< of paths and noise; another one for every photograph
};

/// Irradiance by the flash where the surface is `hit`, shadow ray included.
double flash_irradiance(const SynthBody& body, const SynthLights& lights, const Vec3d& flash, const BodyHit& hit);

/// Radiance that reaches the surface at `from` over its hemisphere, from sky and from other surfaces, by one path: its mean over the square (u, v) and over
/// `draw` is irradiance / pi. u, v: 0..1. seed, element, draw: what the path's random numbers hang on.
Vec3d incoming_by_one_path(const SynthBody& body, const SynthLights& lights, const Vec3d& flash, const BodyHit& from, double u, double v, std::uint64_t seed, std::uint64_t element,
                           std::uint32_t draw);

/// Rows y0 .. y1-1 of a photograph. rgb: 3 floats a pixel, radiance, 0 (but for noise) where nothing is hit; covered: 255 where every ray of the pixel hits the
/// surface, else 0. Rows are computed in parallel; the same bytes for any thread count and any choice of rows.
void render_synth_rows(const SynthBody& body, const SynthLights& lights, const SynthView& view, const SynthPixels& pixels, int y0, int y1, std::span<float> rgb,
                       std::span<std::uint8_t> covered);

}  // namespace chiaro::tools
