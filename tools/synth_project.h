/// A whole project with a known answer: cloud, flash photographs, cameras and project file of a synthetic scene.
#pragma once
#include <cstdint>
#include <filesystem>
#include <string>
#include <vector>

#include "stream/base/report.h"
#include "tools/synth_render.h"
#include "tools/synth_write.h"

namespace chiaro::tools {

struct SynthProjectOptions {
  int photographs = 20;
  int width_px = 640, height_px = 480;
  double focal = 0;                 ///< focal length over the shorter side of a photograph; 0: what shows nearly all of the scene
  int samples = 4;                  ///< samples^2 rays and paths a pixel
  int bounces = 11;
  double ambient_radiance = 0.15;   ///< W/(sr m^2); 0 in a closed scene, whatever stands here
  double gain = 1e-4, read_sigma = 4e-4;   ///< noise of the photographs, declared in the project file
  std::string cloud = "cloud.ply";  ///< file name, .ply, .las or .pcd
  bool with_albedo = false;         ///< in the cloud
  double gloss_roughness = 0;       ///< of a clear coat of reflectance 0.04 all over (optimize/gloss.h); 0: none
  bool without_flash = false;       ///< each view once more without flash, at a longer shutter time, as an acquisition of its own
  /// throws UsageError naming the option and its range.
  void validate() const;
};

inline constexpr double kFlashExposureS = 0.01, kDarkExposureS = 0.04;   ///< shutter times; ambient light counts in proportion

struct SynthProjectResult {
  SynthResult cloud;
  int photographs = 0;
  double flash_intensity = 0, ambient_radiance = 0;   ///< W/sr, W/(sr m^2)
};

/// Lights and cameras of a scene, before scale and offset. throws UsageError for scenes without a surface to photograph.
SynthLights synth_lights(SynthKind kind, const SynthProjectOptions& options);
std::vector<SynthView> synth_views(SynthKind kind, const SynthProjectOptions& options);

/// Writes `folder`: the cloud, photos/photo_K.exr (half, linear), masks/photo_K.png (not for the room, which fills every picture), dark/photo_K.exr where asked for, sparse/ (COLMAP text),
/// truth/lights.json, and project.toml, which `chiaro run` takes as it is. The same bytes for any number of threads. Memory: a block of points, then rows of one
/// photograph and its mask. Nothing appears at `folder` before all is written.
/// throws Error (`folder` exists and is not empty; no space: cloud and photographs are each checked before they are written), UsageError, Cancelled.
SynthProjectResult write_synth_project(const SynthScene& scene, const std::filesystem::path& folder, const SynthProjectOptions& options, Reporter& report);

}  // namespace chiaro::tools
