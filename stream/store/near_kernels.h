/// The inner loops of searching and of fitting planes, many numbers at a time (see lanes.h). Internal to stream/store.
#pragma once
#include <array>
#include <cstddef>
#include <cstdint>
#include <vector>

namespace chiaro::stream {

enum class VectorWidth { kPlain, kAvx2, kAvx512 };
/// For tests: nothing wider, even where the processor has it.
void limit_vectors(VectorWidth widest);

/// Points that are worked on together, and what arrays are padded to.
inline constexpr std::uint32_t kLanes = 16;
inline constexpr std::size_t kNearest = 6;

/// Positions to search in; `num` counts, and the arrays are readable up to the next multiple of kLanes.
struct CandidateView {
  const float *x = nullptr, *y = nullptr, *z = nullptr;
  std::size_t num = 0;
  const std::uint32_t* index = nullptr;  ///< numbers by which they are known; null: 0, 1, 2, ...
  const float *nx = nullptr, *ny = nullptr, *nz = nullptr;  ///< unit normals, or null
  const std::uint32_t* oriented = nullptr;                  ///< with normals: all bits set where the sign of the normal is known
};

/// Some of the candidates, in their order; behind the last one come far ones, up to a multiple of kLanes.
struct Selection {
  std::vector<float> x, y, z;
  std::vector<std::uint32_t> index;
  std::vector<float> nx, ny, nz;        ///< if the candidates have normals
  std::vector<std::uint32_t> oriented;  ///< likewise
  std::size_t num = 0;
  bool has_normals = false, has_index = false;
  std::size_t size() const { return num; }
  /// Makes room for `most` and whole lanes behind.
  void reserve(std::size_t most, bool with_index, bool with_normals);
  void pad();
  CandidateView view() const;
  /// Known by their place here.
  CandidateView renumbered() const;
};

/// Those within sqrt(limit) of a box, with what they are known by if asked for.
void select_near_box(const CandidateView& candidates, const std::array<float, 3>& min, const std::array<float, 3>& max, float limit, bool with_index, Selection& out);
/// Those within sqrt(near), and the others within sqrt(far); positions only.
void split_near_box(const CandidateView& candidates, const std::array<float, 3>& min, const std::array<float, 3>& max, float near, float far, Selection& nearer, Selection& farther);

/// A tree over points in groups of sixteen: level 0 holds the boxes of groups 8 i .. 8 i + 7 in its element i, each further level those of the elements below.
/// The last level has one element. Boxes that nothing fills are turned inside out.
struct EightBoxes {
  float min[3][8], max[3][8];
};
using BoxLevels = std::vector<std::vector<EightBoxes>>;
inline constexpr std::size_t kBoxedPoints = 16;
/// Appends the points within sqrt(limit) of a box, in their order, with their index, without normals. points: whole groups, padded with far ones.
void select_from_tree(const CandidateView& points, const BoxLevels& levels, const std::array<float, 3>& min, const std::array<float, 3>& max, float limit, Selection& out);

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

/// The candidates within sqrt(limit) of the point but not on its spot, in their order.
void collect_within(const CandidateView& candidates, float x, float y, float z, float limit, NeighbourRow& out);

/// Sums over the neighbours within sqrt(limit): x y z, xx xy xz yy yz zz, number.
inline constexpr std::size_t kTerms = 10;
using Moments = std::array<double, kTerms>;
Moments moments_within(const NeighbourRow& row, float limit);

/// The same for many points at once, whose own spot is counted too: among the candidates within sqrt(limits), one limit a point; a negative one finds none.
struct LaneMoments {
  std::array<LaneFloats, kTerms> sum{};
};
void add_moments(const CandidateView& candidates, const LanePoints& points, const LaneFloats& limits, LaneMoments& out);
/// Within two limits each, the narrow ones no larger.
void add_moments(const CandidateView& candidates, const LanePoints& points, const LaneFloats& wide_limits, const LaneFloats& narrow_limits, LaneMoments& wide, LaneMoments& narrow);

}  // namespace chiaro::stream
