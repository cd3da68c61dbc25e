/// What a view can see at all: a cone of directions from one point, against boxes.
#pragma once
#include <limits>
#include <span>
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
  Box3d within{Vec3d::Constant(-std::numeric_limits<double>::infinity()), Vec3d::Constant(std::numeric_limits<double>::infinity())};   ///< what lies beyond does not matter

  bool misses(const Box3d& box) const;
};

/// The view's rectangle grown by margin_px, seen from `centre` along the camera's axes. The rectangle's outline is unprojected densely, since lenses bend
/// straight edges. A lens wider than a half-space gives a frustum that culls nothing.
Frustum make_frustum(const View& view, double margin_px, const Vec3d& centre);

/// What a point light has to see for everything that may cast a shadow on the boxes: pyramids through the faces of a cube around it, of which one looks at the boxes. Each is
/// as wide as the boxes that it meets, and none reaches beyond them; a face that meets none has no pyramid. The light may stand among the boxes.
std::vector<Frustum> frusta_of_light(const Vec3d& light, std::span<const Box3d> boxes);

/// 0 inside the box.
double distance_to_box(const Vec3d& p, const Box3d& box);

}  // namespace chiaro::surfels
