/// New points on the surface that the discs of a cloud make up: where, and with which normal.
///
/// New points lie on lattices that the whole cloud shares, one for each of the three axes (a disc takes the axis that its normal is nearest to), each
/// level twice as dense as the one before and containing it. So what one disc inserts fits what its neighbour inserts, also where they lie in different
/// chunks and where one is refined more than the other. A lattice point belongs to the disc whose centre is nearest, and is lifted onto the mean of the discs around.
#pragma once
#include <cstdint>
#include <vector>

#include "stream/base/types.h"

namespace chiaro::blend {

/// A disc near the one that is refined: offsets from its centre, project units.
struct NearDisc {
  Vec3f offset = Vec3f::Zero();
  Vec3f normal = Vec3f::UnitZ();
};

/// The disc that is refined.
struct RefinedDisc {
  Vec3d from_anchor = Vec3d::Zero();   ///< its centre, from the lattices' common origin
  Vec3f normal = Vec3f::UnitZ();
  bool oriented = false;               ///< the sign of the normals is known
  float spacing = 0;                   ///< of the cloud here
};

struct NewPoint {
  Vec3d from_anchor;
  Vec3f normal;
};

/// Side of the square of surface that a point of a lattice stands for, where the lattice's axis is `along` (the largest component of the normal, absolute).
/// edge: length on which level 0 has one point.
double lattice_spacing(double edge, int level, float along);
/// The level whose spacing is nearest to `wanted`, by ratio.
int lattice_level(double edge, double wanted, float along);
/// Beyond this part of the cloud's spacing a lattice adds too little.
inline constexpr double kWorthRefining = 0.72;

/// Appends the lattice points of a level that belong to the disc and lie on its surface; none nearer to its centre than half the lattice's spacing, and none
/// where the discs around do not surround them (borders, edges of a face). around: all within kReachSpacings, without itself, in any order.
inline constexpr float kReachSpacings = 2.6f;
void insert_around(const RefinedDisc& disc, const std::vector<NearDisc>& around, double edge, int level, std::vector<NewPoint>& points);

}  // namespace chiaro::blend
