/// Normals and radii of leaves from their neighbours, across chunk borders.
///
/// Local spacing of a point: the distance of its sixth neighbour over sqrt(6 / pi), what it would be on an evenly sampled surface. Neighbours are the
/// points within some spacings; while they all lie on one line (scan lines) the radius is doubled, up to three times. Everything depends on the points
/// around only, so that the borders of chunks do not show, but for how noisy the scan is, which is asked of a leaf as a whole.
#pragma once
#include <functional>
#include <vector>

#include "stream/base/types.h"
#include "stream/store/neighbours.h"

namespace chiaro::stream {

struct FitOptions {
  double radius_spacings = 3.5;  ///< neighbours within this many local spacings
  std::size_t most = 96;         ///< of these, the nearest so many
  float max_radius = 0;          ///< beyond it nothing is a neighbour
  float lone_radius = 0;         ///< radius of a disc without neighbours
};

struct NormalFit {
  Vec3f normal = Vec3f::UnitZ();  ///< of any length
  bool isolated = false;         ///< fewer than 3 neighbours, or all on a line: the normal is a guess
  bool rough = false;            ///< not flat around: refine_normals_of() may know better
};

struct RadiusFit {
  float radius = 0;
  float mean_of_nearest = 0;     ///< mean distance of the (up to) 6 nearest
  bool outlier = false;          ///< off a surface that is sampled much more densely than its own surroundings
  Vec3f clip_across = Vec3f::Zero();  ///< unit vector in the disc's plane towards the edge where the disc ends; 0 = no edge near
  float clip_distance = 0;            ///< of the edge from the centre
};

/// Normal of the plane through the neighbours and the point, for every distinct position of the chunk; it points away from their centroid. Fitted at
/// three nested radii, of which the widest is taken that fits as well as the narrowest, or as the noise of the leaf lets it: edges stay sharp where flat ground
/// is averaged.
void fit_normals_of(Neighbourhood& around, const FitOptions& options, std::vector<NormalFit>& fits);

/// Better normals for the distinct positions that are wanted (1; others 0): planes through those neighbours only that are turned alike and lie on the plane, which
/// edges of the surface do not round off. Neighbours are judged by the normals that fit_normals_of() gave them.
/// source: after the bilateral filter of Fleishman, Drori, Cohen-Or, SIGGRAPH 2003, and Tukey's biweight.
void refine_normals_of(Neighbourhood& around, const FitOptions& options, const std::vector<std::uint8_t>& wanted, std::vector<Vec3f>& normals);

/// Radius of the disc that covers the point's Voronoi cell in its tangent plane, for every distinct position of the chunk. Neighbours bound the cell by
/// the plane half-way to them; those on another face (normals more than 60 degrees apart, or far off the plane) do not, unless too few others exist.
/// Where another face begins beside the point, the disc ends at the line in which the two planes meet.
/// Points on a border, whose cell is open, get at most 1 and others at most 3 mean distances of their nearest; outliers no more than lone_radius.
void fit_radii_of(Neighbourhood& around, const FitOptions& options, std::vector<RadiusFit>& fits);

/// Normal of the plane through the first `count` points of a block; +z for fewer than four.
Vec3f plane_normal(const SurfelBlock& block, std::size_t count);

}  // namespace chiaro::stream
