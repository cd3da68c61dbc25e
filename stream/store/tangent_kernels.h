/// The inner loops of fitting radii: the Voronoi cell of a point in its tangent plane, many numbers at a time (see lanes.h). Internal to stream/store.
///
/// Lines of the plane are given as w, the point w / |w|^2 being the foot of the origin on the line: p is beyond it if w . p > 1. Lines half-way to neighbours
/// bound the Voronoi cell of the origin.
#pragma once
#include <array>
#include <cstddef>
#include <span>
#include <vector>

#include "stream/store/near_kernels.h"

namespace chiaro::stream {

using Place = std::array<float, 3>;

/// A point's tangent plane and what counts as another face there.
struct TangentFrame {
  std::array<float, 3> normal, u, v;
  bool oriented = false;
  float edge_reach = 0, other_face = 0;  ///< a neighbour within this distance, the cosine of whose normal is below this, is on another face
};

/// The neighbours of a point in its tangent plane. The arrays hold room for whole lanes, zero behind the last one.
struct TangentLines {
  std::vector<float> u, v;    ///< of the neighbour
  std::vector<float> wx, wy;  ///< where the tangent plane meets the plane half-way to the neighbour; 0 for neighbours on other faces: normals more than
                              ///< 60 degrees apart, or more than 30 degrees off the plane
  std::size_t num = 0;
  void clear() { num = 0; }
  void make_room(std::size_t most);
  /// Appends the candidates whose squared distance from the point is above `above`, 0 or more, and at most `limit`. False if another face begins near; the lines are not right then. Candidates without
  /// normals are all on the point's own face.
  bool add(const CandidateView& candidates, const Place& point, float above, float limit, const TangentFrame& frame);
  /// Is a neighbour beyond `distance` in the direction (x, y), at most `distance` off it to the side?
  bool is_beyond(float x, float y, float distance) const;
  /// The line that the point (x, y) is furthest beyond; num if it is beyond none. Of equals the first by (number modulo kLanes, number).
  std::size_t line_before(float x, float y) const;
};

/// Are the normals of all candidates turned like this one, the cosine being `least` or more? Either way round where the sign is not known.
bool all_alike(const CandidateView& candidates, const Place& normal, float least);

/// Corners of a cell that only shrinks: the two lines that meet, counter-clockwise, where, and the squared distance; negative for one that is settled, infinite
/// where the lines do not meet.
struct CellCorners {
  static constexpr std::size_t kMost = 64, kDirections = 16;
  alignas(64) std::array<float, kMost> ax, ay, bx, by, x, y, squared;
  std::size_t size = 0;
  void set(std::size_t at, float ax_, float ay_, float bx_, float by_);
  /// Cuts off what is beyond the line: corner `at`, and others that are. False if there is no room for one more.
  bool cut(std::size_t at, float wx, float wy);
  /// Of equals as line_before().
  std::size_t farthest() const;
};
/// The cell of those lines, and of a square of the half size `half`, that are met first in each of kDirections directions.
void start_cell(const TangentLines& lines, float half, CellCorners& corners);

/// A point whose candidates are all on its own face.
struct SmoothPoint {
  bool wanted = false;
  Place place;
  TangentFrame frame;
  float reach = 0;         ///< within which its neighbours are looked at
  float half = 0, scale = 0;
  bool started = false;    ///< used inside
  float distance = 0;      ///< of the cell's farthest corner, where it is within `scale` or has a neighbour beyond, and nothing further away than `reach` can cut it; else 0
};
/// The lines of each point and, where the distance remains 0, the cell as start_cell() leaves it or further. At most kLanes points; candidates have no normals.
void nearest_corners(const CandidateView& candidates, std::span<SmoothPoint> points, std::span<TangentLines> lines, std::span<CellCorners> corners);

}  // namespace chiaro::stream
