/// Pictures of what the pixels of a photograph count in the blend: one a criterion of blend/view_weights.h, and one of their product.
#pragma once
#include <vector>

#include "blend/photo_window.h"
#include "tools/report_photo.h"

namespace chiaro::tools {

/// Value of a picture's pixel, 0 .. 1. Criteria that are ratios are drawn as w / (1 + w): half of the scale is a ratio of 1.
float shown_weight(float worth, bool is_ratio);

/// At most max_width pixels wide, one pixel of the photograph for each; no_value() where it does not show the cloud. By bands of rows: memory does not depend
/// on its size. camera: as the blend had it, camera.photograph is the key. throws Error naming the file if a raster is missing, damaged or lacks a plane; Cancelled.
std::vector<ReportPicture> draw_weights(const RunFolder& folder, const stream::Camera& camera, const blend::WindowOptions& options, int max_width, Reporter& report);

/// Name of the product's picture.
inline constexpr const char* kWeightProduct = "Weight";

}  // namespace chiaro::tools
