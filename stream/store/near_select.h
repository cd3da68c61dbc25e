/// Which candidates are near: the inner loops of searching, many numbers at a time (see lanes.h). Internal to stream/store.
#pragma once
#include <array>
#include <cstddef>
#include <cstdint>
#include <vector>

#include "stream/store/near_kernels.h"

namespace chiaro::stream {

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
/// Those within sqrt(near), and the others within sqrt(far); with normals if the candidates have them.
void split_near_box(const CandidateView& candidates, const std::array<float, 3>& min, const std::array<float, 3>& max, float near, float far, Selection& nearer, Selection& farther);

/// A tree over points in groups of sixteen: level 0 holds the boxes of groups 8 i .. 8 i + 7 in its element i, each further level those of the elements below.
/// The last level has one element. Boxes that nothing fills are turned inside out.
struct EightBoxes {
  float min[3][8], max[3][8];
};
using BoxLevels = std::vector<std::vector<EightBoxes>>;
inline constexpr std::size_t kBoxedPoints = 16;
/// Appends the points within sqrt(limit) of a box, in their order, with their index and normals if the selection has them; the signs of these only if the points tell.
/// points: whole groups, padded with far ones.
void select_from_tree(const CandidateView& points, const BoxLevels& levels, const std::array<float, 3>& min, const std::array<float, 3>& max, float limit, Selection& out);

/// The candidates within sqrt(limit) of the point but not on its spot, in their order.
void collect_within(const CandidateView& candidates, float x, float y, float z, float limit, NeighbourRow& out);

}  // namespace chiaro::stream
