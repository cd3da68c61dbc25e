/// Normals and radii of leaves from their neighbours, across chunk borders.
#pragma once
#include <span>
#include <vector>

#include "stream/base/types.h"
#include "stream/store/neighbours.h"

namespace chiaro::stream {

/// Neighbours of one point and their offsets from it; points on the same spot are not among them. The 6 nearest come first.
struct NeighbourList {
  struct Item {
    float distance_squared;
    std::uint32_t candidate;
    friend bool operator<(const Item& a, const Item& b) { return a.distance_squared < b.distance_squared || (a.distance_squared == b.distance_squared && a.candidate < b.candidate); }
  };
  std::vector<Item> items;
  std::vector<Vec3f> offset;
  float radius = 0;          ///< all neighbours within it are here, up to the maximum number
  float mean_of_nearest = 0; ///< mean distance of the (up to) 6 nearest, project units
};

struct FitOptions {
  double radius_spacings = 3.5;  ///< neighbours within this many local spacings
  std::size_t most = 96;         ///< of these, the nearest so many
  bool sorted = false;           ///< nearest first
  float max_radius = 0;          ///< beyond it nothing is a neighbour
  float lone_radius = 0;         ///< radius of a disc without neighbours
};

struct NormalFit {
  Vec3f normal = Vec3f::UnitZ();
  bool isolated = false;         ///< fewer than 3 neighbours, or all on a line: the normal is a guess
};

/// Calls body(i, neighbours, candidates) for every distinct position of the chunk.
void for_each_neighbourhood(Neighbourhood& around, const FitOptions& options,
                            const std::function<void(std::uint32_t i, NeighbourList& list, const Candidates& candidates)>& body);

/// Plane through the neighbours and the point; the normal points away from their centroid.
NormalFit fit_normal(const NeighbourList& list);

/// Radius of the disc that covers the point's Voronoi cell in its tangent plane; bounded for points on a border. the list must be sorted.
float fit_radius(const NeighbourList& list, const Candidates& candidates, const Vec3f& normal, std::uint8_t flags, const FitOptions& options);

}  // namespace chiaro::stream
