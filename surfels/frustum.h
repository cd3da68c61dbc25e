/// What a view can see at all: a cone of directions from one point, against boxes.
#pragma once
#include <vector>

#include "stream/base/types.h"
#include "surfels/working_set.h"

namespace chiaro::surfels {

/// Conservative: five half-spaces through the centre, and the slopes that they stand for.
struct Frustum {
  Vec3d centre;
  std::vector<Vec3d> inward;  ///< unit normals of planes through the centre; empty: nothing is culled
  Mat3d camera_from_world;
  double x0 = 0, x1 = 0, y0 = 0, y1 = 0;   ///< slopes x/z and y/z that bound it

  bool misses(const Box3d& box) const;
};

/// The view's rectangle grown by margin_px, seen from `centre` along the camera's axes. The rectangle's outline is unprojected densely, since lenses bend
/// straight edges. A lens wider than a half-space gives a frustum that culls nothing.
Frustum make_frustum(const View& view, double margin_px, const Vec3d& centre);

/// 0 inside the box.
double distance_to_box(const Vec3d& p, const Box3d& box);

}  // namespace chiaro::surfels
