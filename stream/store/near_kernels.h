/// Sums over candidates and neighbours: the inner loops of fitting planes, many numbers at a time (see lanes.h). Internal to stream/store.
#pragma once
#include <array>
#include <cstddef>
#include <cstdint>
#include <vector>

namespace chiaro::stream {

/// Points that are worked on together, and what arrays are padded to.
inline constexpr std::uint32_t kLanes = 16;
inline constexpr std::size_t kNearest = 6;

/// Positions to search in; `num` counts, and the arrays are readable up to the next multiple of kLanes.
struct CandidateView {
  const float *x = nullptr, *y = nullptr, *z = nullptr;
  std::size_t num = 0;
  const std::uint32_t* index = nullptr;  ///< numbers by which they are known; null: 0, 1, 2, ...
  const float *nx = nullptr, *ny = nullptr, *nz = nullptr;  ///< unit normals, or null
  const std::uint32_t* oriented = nullptr;                  ///< with normals: all bits set where the sign of the normal is known; or null
};

using LaneFloats = std::array<float, kLanes>;
struct LanePoints {
  LaneFloats x, y, z;
};

/// Squared distances of the six nearest of each lane, nearest first; infinite where there are fewer. What lies on the spot is left out.
struct Nearest {
  std::array<LaneFloats, kNearest> squared;
};
void nearest_of(const CandidateView& candidates, const LanePoints& points, Nearest& out);
/// Distance of the sixth, and the mean of the six or fewer; 0 where there is none.
void distances_of(const Nearest& nearest, LaneFloats& sixth, LaneFloats& mean);

/// Neighbours of one point as offsets from it. What follows the last neighbour, up to a multiple of kLanes, is zero, its distance infinite.
struct NeighbourRow {
  std::vector<float> x, y, z, distance_squared;
  std::vector<std::uint32_t> candidate;  ///< index of the candidate
  std::size_t num = 0;
  std::size_t size() const { return num; }
  void reserve(std::size_t most);
  void pad();
};

/// Sums over the neighbours within sqrt(limit): x y z, xx xy xz yy yz zz, number.
inline constexpr std::size_t kTerms = 10;
using Moments = std::array<double, kTerms>;
Moments moments_within(const NeighbourRow& row, float limit);

/// The same for many points at once, whose own spot is counted too: among the candidates within sqrt(limits), one limit a point; a negative one finds none.
struct LaneMoments {
  std::array<LaneFloats, kTerms> sum{};
};
void add_moments(const CandidateView& candidates, const LanePoints& points, const LaneFloats& limits, LaneMoments& out);

}  // namespace chiaro::stream
