/// Writes a synthetic scene to a point file, as a stream.
#pragma once
#include <cstdint>
#include <filesystem>

#include "stream/base/report.h"
#include "tools/synth_scene.h"

namespace chiaro::tools {

struct SynthResult {
  std::uint64_t points = 0, bytes = 0;
  double area_m2 = 0;
  double spacing_m = 0;   ///< sqrt(area / points); 0 for scenes without a surface
};

/// .ply, .las or .pcd with x y z (float, or double where offset, size or noise ask for it), nx ny nz unless the spec says otherwise, and, with_albedo,
/// albedo_r albedo_g albedo_b (float, linear). The same bytes for any number of threads. Memory: a block of points.
/// throws Error (unknown extension, no space: checked before anything is written), Cancelled.
SynthResult write_synth(const SynthScene& scene, const std::filesystem::path& file, bool with_albedo, Reporter& report);

}  // namespace chiaro::tools
