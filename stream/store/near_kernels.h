/// The inner loops of fitting surfels, eight numbers at a time (see lanes.h). Internal to stream/store.
#pragma once
#include <array>
#include <cstdint>
#include <vector>

namespace chiaro::stream {

/// For tests: false takes the way of processors without AVX2.
void use_wide_vectors(bool use);

inline constexpr std::uint32_t kLanes = 8;
inline constexpr std::size_t kNearest = 6;

/// Positions to search in; `num` counts, and the arrays are readable up to the next multiple of eight.
struct CandidateView {
  const float *x = nullptr, *y = nullptr, *z = nullptr;
  std::size_t num = 0;
  const std::uint32_t* index = nullptr;  ///< numbers by which they are known; null: 0, 1, 2, ...
};

/// Some of the candidates, in their order.
struct Selection {
  std::vector<float> x, y, z;
  std::vector<std::uint32_t> index;
  std::size_t num = 0;
  CandidateView view() const { return {x.data(), y.data(), z.data(), num, index.data()}; }
};
/// Those within sqrt(limit) of a box.
void select_near_box(const CandidateView& candidates, const std::array<float, 3>& min, const std::array<float, 3>& max, float limit, Selection& out);

/// A tree over points in groups of sixteen: level 0 holds the boxes of groups 8 i .. 8 i + 7 in its element i, each further level those of the elements below.
/// The last level has one element. Boxes that nothing fills are turned inside out.
struct EightBoxes {
  float min[3][8], max[3][8];
};
using BoxLevels = std::vector<std::vector<EightBoxes>>;
inline constexpr std::size_t kBoxedPoints = 16;
/// Appends the points within sqrt(limit) of a box, in their order. points: whole groups, padded with far ones.
void select_from_tree(const CandidateView& points, const BoxLevels& levels, const std::array<float, 3>& min, const std::array<float, 3>& max, float limit, Selection& out);

struct EightPoints {
  std::array<float, kLanes> x, y, z;
};

/// Squared distances of the six nearest of each lane, nearest first; infinite where there are fewer. What lies on the spot is left out.
struct Nearest {
  float squared[kNearest][kLanes];
};
void nearest_of(const CandidateView& candidates, const EightPoints& points, Nearest& out);

/// Neighbours of one point as offsets from it. The arrays hold room for whole lanes of eight; what follows the last neighbour there is zero, its distance
/// infinite.
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

/// The same for eight points at once, whose own spot is counted too: among the candidates within sqrt(limits), one limit a point; a negative one finds none.
struct EightMoments {
  std::array<std::array<float, kLanes>, kTerms> sum;
};
void moments_of(const CandidateView& candidates, const EightPoints& points, const std::array<float, kLanes>& limits, EightMoments& out);

/// Lines of the plane are given as w, the point w / |w|^2 being the foot of the origin on the line: p is beyond it if w . p > 1. Lines half-way to neighbours
/// bound the Voronoi cell of the origin. Here the first line that is met in each of eight directions, 45 degrees apart, the first repeated.
struct EightLines {
  std::array<float, 9> x, y;
  std::array<float, 8> corner_x, corner_y;   ///< where a line meets the next one
  std::array<float, 8> corner_squared;       ///< its squared distance; negative where both are the same line, infinite where they do not meet
};
/// Beside the given lines there is a square of the half size `half`. The arrays hold room for whole lanes of eight, zero behind the last line.
EightLines nearest_lines(const float* wx, const float* wy, std::size_t num, float half);
/// The line that the point (x, y) is furthest beyond; num if it is beyond none.
std::size_t line_before(const float* wx, const float* wy, std::size_t num, float x, float y);

/// Normals of the neighbours of a row.
struct NeighbourNormals {
  std::vector<float> x, y, z;
  std::vector<std::uint32_t> oriented;  ///< all bits set where the sign of the normal is known
  void take(const float* nx, const float* ny, const float* nz, const std::uint8_t* flags, const NeighbourRow& row);
};

/// A point's tangent plane and what counts as another face there.
struct TangentFrame {
  std::array<float, 3> normal, u, v;
  bool oriented = false;
  float edge_reach = 0, other_face = 0;  ///< a neighbour within this distance, the cosine of whose normal is below this, is on another face
};

/// The neighbours of a row in a tangent plane.
struct TangentLines {
  std::vector<float> u, v;    ///< of the neighbour
  std::vector<float> wx, wy;  ///< where the tangent plane meets the plane half-way to the neighbour (see EightLines); 0 for neighbours on other faces: normals
                              ///< more than 60 degrees apart, or more than 30 degrees off the plane
  /// False if another face begins near; the lines are not filled then.
  bool make(const NeighbourRow& row, const NeighbourNormals& normals, const TangentFrame& frame);
  /// Is a neighbour beyond `distance` in the direction (x, y), at most `distance` off it to the side?
  bool is_beyond(float x, float y, float distance, std::size_t num) const;
};

}  // namespace chiaro::stream
