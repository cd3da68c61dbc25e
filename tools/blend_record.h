/// What the blend found out about each photograph, for run.json and in sentences.
#pragma once
#include <span>
#include <string>

#include "blend/blend.h"

namespace chiaro::tools {

/// {"points", "points_seen", "points_disputed", "samples", "scatter", "leaves", "leaves_kept", "photographs_read", "scratch_bytes", "weights": {"footprint", "low_radius", "border_px"}, "denoising": {"points", "points_changed", "mean_sigma_before", "mean_sigma_after"} or null, "photographs": [{"photograph", "samples", "rejected", "gain", "shift_px", …}], "notes": [sentences]}
/// photographs: those of the stats, in the same order. cells_px: sides of the cells of pixels that each was read by, which the sentences count in; all other numbers are of the working images.
std::string blend_record_json(const blend::BlendStats& stats, std::span<const blend::BlendPhotograph> photographs, std::span<const int> cells_px);

}  // namespace chiaro::tools
