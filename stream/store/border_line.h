/// Where a surface ends, seen from a point near its border. Internal to stream/store.
#pragma once
#include <optional>
#include <vector>

namespace chiaro::stream {

/// In the tangent plane, the origin at the point: the surface lies where x * u + y * v <= distance.
struct BorderLine {
  float u, v;       ///< unit vector out of the surface
  float distance;   ///< 0 or more
};

/// The line that keeps all neighbours (x, y) within `reach` on one side and cuts off most of the disc of that size: for points drawn evenly from a half-plane the
/// likeliest border, which lies a little outside: `margin` is added. Several directions fit a point that stands out: the one in their middle. Nothing where
/// that line is further than `most_distance` away before the margin: amid a surface neighbours lie in all directions.
std::optional<BorderLine> find_border_line(const std::vector<float>& x, const std::vector<float>& y, float reach, float most_distance, float margin);

}  // namespace chiaro::stream
