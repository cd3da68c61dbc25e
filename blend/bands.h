/// The split of an image into a low and a high band at a fixed scale on the surface, not in the image.
///
/// The low band is a mean over about the same piece of surface in every photograph: two photographs at different distances or angles split at the same
/// detail. Filter: two box passes a direction (together a tent), whose half-width follows the footprint and slant of each pixel, and which stop at depth
/// discontinuities. Running sums make the cost independent of the radius; they are integers, so the result of a pixel does not depend on where
/// the window of rows begins.
#pragma once
#include <cstdint>
#include <span>
#include <vector>

#include "stream/base/types.h"

namespace chiaro::blend {

inline constexpr float kMaxLowRadiusPx = 64;   ///< beyond it the low band of a very near photograph is split finer than on the others

/// A value per pixel with its weight; channels are premultiplied by it while they are filtered.
struct FilterPixel {
  static constexpr int kChannels = 5;
  float value[kChannels] = {0, 0, 0, 0, 0};   ///< r g b, quality, weight (0 or 1: takes part or not)
};

/// How far the filter reaches from a pixel, and where it must stop.
struct FilterStep {
  float half_x = 0, half_y = 0;  ///< half-widths of the boxes, pixels
  bool stop_right = true;        ///< discontinuity between this pixel and the next in the row
  bool stop_below = true;        ///< and the next in the column
};

/// Half-widths of the boxes that cover a disc of `radius` (project units) on a surface with this normal (camera frame) and footprint.
Vec2f box_half_widths(float radius, float footprint, const Vec3f& normal_in_camera);

/// Whether the surface is interrupted between two neighbouring pixels. Only local lengths decide: footprint, slant and surfel radius.
struct DepthSample {
  float depth = 0, footprint = 0, cosv = 0, radius = 0;
};
bool depth_breaks(const DepthSample& a, const DepthSample& b);

/// Filters in place; row-major, width * rows pixels. Afterwards value / weight is the mean. Same bits for any thread count.
/// A row's result is final where all rows within 2 * half_y exist above and below it.
void smooth_surface(std::span<FilterPixel> pixels, std::span<const FilterStep> steps, int width, int rows);

/// Euclidean distance to the nearest marked pixel, at most `cap` (pixels). Rows nearer than cap to the window's end see only what is inside it.
std::vector<float> distance_to_marked(std::span<const std::uint8_t> marked, int width, int rows, float cap);

}  // namespace chiaro::blend
