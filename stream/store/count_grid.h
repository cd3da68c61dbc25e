/// Pass 1 of a build: where the points are. Counts in cells of an absolute power-of-two grid, from which the root cube, the typical spacing and
/// the partitions of the spill file follow. Root and spacing depend on the points and their order in the files only, never on the budget.
#pragma once
#include <algorithm>
#include <bit>
#include <cstdint>
#include <span>
#include <vector>

#include "stream/base/budget.h"
#include "stream/base/types.h"
#include "stream/store/morton.h"

namespace chiaro::stream {

/// As std::floor, which is a call on processors without SSE4.1. |v| < 2^62.
inline std::int64_t floor_integer(double v) {
  const auto cut = static_cast<std::int64_t>(v);
  return cut - static_cast<std::int64_t>(static_cast<double>(cut) > v);
}

/// The root cell as integers: a coordinate p is floor(p / unit) - corner, 37 bits, where unit = 2^exponent / 2^37. Scaling by a power of two and
/// flooring are exact, so both passes and all levels agree on the cell of every point.
struct RootCube {
  int exponent = 0;                          ///< edge = 2^exponent project units
  std::array<std::int64_t, 3> corner{};      ///< of the lower corner, in units
  double edge() const;
  Vec3d origin() const;
  /// Units to a project unit: 2^(37 - exponent).
  double per_unit() const { return std::bit_cast<double>(static_cast<std::uint64_t>(1023 + kAxisBits - exponent) << 52); }
  /// Clamped to the cube.
  std::array<std::uint64_t, 3> quantise(const Vec3d& p) const {
    const double per_project_unit = per_unit();
    constexpr std::int64_t kLast = (std::int64_t{1} << kAxisBits) - 1;
    std::array<std::uint64_t, 3> q;
    for (std::size_t a = 0; a < 3; ++a)
      q[a] = static_cast<std::uint64_t>(std::clamp<std::int64_t>(floor_integer(p[static_cast<int>(a)] * per_project_unit) - corner[a], 0, kLast));
    return q;
  }
};

struct WeightedCell {
  std::uint64_t key = 0;    ///< Morton code
  std::uint64_t count = 0;  ///< points
};

/// Occupied cells (edge 2^k) and their counts; becomes coarser whenever it would exceed its number of cells.
class CountGrid {
 public:
  /// Uses up to max_bytes, but at least 8 MiB: the root cube is aligned to cells, which needs the extent to be some 32 of them.
  CountGrid(MemoryBudget& budget, std::uint64_t max_bytes);
  /// Adds finite points, |coordinate| <= 1e9. The first call decides the finest cell.
  void add(std::span<const Vec3d> points);
  const Box3d& bounds() const { return bounds_; }
  std::uint64_t points() const { return points_; }
  std::uint64_t num_cells() const { return used_; }
  int exponent() const { return k_; }
  RootCube root() const;
  /// Typical distance between neighbouring points if they lie on surfaces: the median over the cells of a coarse grid (each cell weighs at most
  /// 64 points, so that neither a heap of duplicates nor single outliers decide).
  double typical_spacing() const;

  /// Occupied cells at level() of the root cube, sorted by Morton code. level() is at most 21.
  std::vector<WeightedCell> cells(const RootCube& root) const;
  int level(const RootCube& root) const;

 private:
  struct Slot {
    std::uint64_t key = kEmpty, count = 0;
  };
  static constexpr std::uint64_t kEmpty = ~std::uint64_t{0};
  std::array<std::int64_t, 3> cell_of_key(std::uint64_t key) const;
  std::uint64_t key_of_cell(const std::array<std::int64_t, 3>& cell) const;
  void start(std::span<const Vec3d> points);
  void make_room(std::uint64_t cells);
  bool make_keys(std::span<const Vec3d> points, std::uint64_t* keys) const;
  void insert(std::uint64_t key, std::uint64_t count);
  void coarsen();
  void resize(std::uint64_t slots);

  MemoryBudget& budget_;
  std::uint64_t max_slots_;
  BudgetLease lease_;
  std::vector<Slot> slots_;
  std::uint64_t used_ = 0, points_ = 0;
  int k_ = 0;
  bool started_ = false;
  std::array<std::int64_t, 3> base_{};  ///< cell of the first point: keys are 21-bit offsets from it
  Box3d bounds_;
};

/// A run of the Morton order whose points lie together in the spill file; ends where the next one begins.
struct Partition {
  std::uint64_t begin = 0;   ///< first cell of level 21
  std::uint64_t count = 0;
};

/// Cuts the cells into runs of at most `capacity` points without cutting any octree cell of at most `chunk_surfels` points, so that what becomes a
/// leaf does not depend on the capacity. One cell of more points than that becomes a partition of its own.
std::vector<Partition> make_partitions(const std::vector<WeightedCell>& cells, int level, std::uint64_t chunk_surfels, std::uint64_t capacity);

}  // namespace chiaro::stream
