/// Planes through a point and its neighbours. Internal to stream/store.
#pragma once
#include <array>
#include <cstddef>

#include "stream/base/types.h"
#include "stream/store/near_kernels.h"
#include "stream/store/surfel_fit.h"

namespace chiaro::stream {

/// Any unit vector across v.
Vec3f across(const Vec3f& v);

/// The plane through neighbours and point, as far as its fit must be known to be judged.
struct Plane {
  bool isolated = true;            ///< fewer than 3 neighbours, or all on a line
  bool line = false;
  double variance_off = 0;         ///< with the plane's three degrees of freedom taken off
  double scale = 0;
  Mat3d covariance;                ///< over scale
  Vec3d values, mean;
};
/// From the sums over the neighbours, as offsets from the point.
Plane plane_of(const Moments& sums);
/// Its normal, away from the neighbours' centroid.
NormalFit normal_of(const Plane& plane);

/// Planes through each of many points and its neighbours.
struct LanePlanes {
  using Row = std::array<double, kLanes>;
  std::array<bool, kLanes> sure;   ///< enough neighbours, and not on a line
  Row variance_off, root, scale;   ///< root: smallest eigenvalue of the covariance over its trace, scale
  std::array<Row, 3> mean;
  std::array<Row, 6> covariance;   ///< over scale: xx xy xz yy yz zz
  void take(std::size_t lane, const LanePlanes& from);
};
inline constexpr double kEnoughForPlane = 6;
void planes_of(const LaneMoments& sums, LanePlanes& planes);
/// Where it is not clear, which is rare, the general solver has to decide.
struct LaneNormals {
  std::array<double, kLanes> x, y, z;   ///< of any length where clear
  std::array<bool, kLanes> clear;
};
void normals_of(const LanePlanes& planes, LaneNormals& normals);

}  // namespace chiaro::stream
