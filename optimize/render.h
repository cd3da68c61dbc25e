/// Predicted photographs: the albedo of a layer under any flash, with all light terms (Eq. 1 of the paper, with its 1/r^2 and 1/pi written out).
#pragma once
#include <filesystem>
#include <string>

#include "optimize/acquisition.h"
#include "optimize/view_detail.h"
#include "stream/store/layer.h"

namespace chiaro::optimize {

struct RenderView {
  std::string name;
  stream::Lens lens;
  stream::Pose pose;
  Vec3d flash_in_camera = Vec3d::Zero();   ///< project units
  double flash_intensity = 1;              ///< W/sr
  double ambient_scale = 1;                ///< factor on the acquisition's sky
  Falloff falloff;                         ///< of the flash; what a lens loses is not shown
};

enum class RenderMode {
  kFull,     ///< flash, sky and bounces
  kDirect,   ///< flash only
  kAlbedo    ///< the albedo itself
};

struct RenderOptions {
  RenderMode mode = RenderMode::kFull;
  int subpixels = 4;
  int scatterings = 12;   ///< surface scatterings of the bounced light
  std::span<const DetailPhotograph> sharpen_by;   ///< none: the albedo of the points alone
  const stream::Store* inserted = nullptr;          ///< points between those of the store: where there are some, colour is theirs
  const stream::Layer* inserted_layer = nullptr;    ///< of that store
};

struct RenderStats {
  std::uint64_t pixels = 0, pixels_hit = 0, pixels_without_albedo = 0, pixels_sharpened = 0;
};

/// The lights that an acquisition's photographs were taken in.
struct RenderLights {
  Scene scene;
  std::vector<float> proxy_albedo;   ///< 3 a proxy surfel
  Lights lights;
};

/// Writes `picture` (EXR, half RGB, linear radiance; 0 where nothing is hit). Surfels that no photograph saw take the albedo of the proxy's nearest seen
/// surfel, without lights 0. lights: may be null for kAlbedo only. throws Error, Cancelled.
RenderStats render(const stream::Store& store, const stream::Layer& layer, const RenderLights* lights, const RenderView& view, const RenderOptions& options,
                   const std::filesystem::path& picture, MemoryBudget& budget, Reporter& report);

}  // namespace chiaro::optimize
