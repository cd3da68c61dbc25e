/// What is certainly hidden: coarse distances from several viewpoints, found with coarse levels of the store.
#pragma once
#include <cstdint>
#include <span>
#include <vector>

#include "stream/base/budget.h"
#include "stream/base/report.h"
#include "stream/store/store.h"
#include "surfels/frustum.h"

namespace chiaro::surfels {

/// A grid of rays from one viewpoint and how far each one certainly sees. Infinite at first.
class DepthMap {
 public:
  /// step: between rays, in slope. The frustum must bound something (`inward` not empty), and outlive this. The budget is charged as long as this lives. throws Error.
  DepthMap(const Frustum& frustum, double step, MemoryBudget& budget);
  /// Without rays: hides what lies outside the frustum, and nothing else.
  explicit DepthMap(const Frustum& frustum) : frustum_(&frustum) {}
  /// Of a map with rays; and what shorten() takes besides while it works.
  static std::uint64_t bytes_of(const Frustum& frustum, double step);
  static std::uint64_t working_bytes_of(const Frustum& frustum, double step);

  /// Casts the rays that can still be shortened: `nearest` is the least distance of what the tracer holds.
  void shorten(const class Tracer& tracer, double nearest);
  /// Everything in the box lies outside the frustum or behind what was found.
  bool hides(const Box3d& box) const;

 private:
  /// Rays along each axis of a cell. A cell knows the longest of its rays and of their neighbours, so that an edge stays open.
  static constexpr int kCell = 4;
  static int cells_along(double width, double step);

  Vec3d direction(int column, int row) const;
  std::vector<float> without_pinholes() const;
  void gather();

  BudgetLease lease_;
  const Frustum* frustum_;
  int columns_ = 0, rows_ = 0, cell_columns_ = 0, cell_rows_ = 0;
  std::vector<float> reach_, cells_;
};

struct OcclusionOptions {
  double step = 0;                          ///< between rays, in slope
  std::uint64_t batch_surfels = 2'000'000;  ///< held at a time
};

/// One map for each frustum. `occluders`: chunks of a cut of the store, any order. They are taken front to back as seen from the first frustum, in batches of which each
/// has an acceleration structure of its own and is dropped again; what earlier ones hide is not loaded. Where the budget does not hold a chunk the maps end
/// there, and those that it does not hold themselves have no rays: they hide less.
std::vector<DepthMap> find_occlusion(const stream::Store& store, std::span<const std::uint32_t> occluders, const std::vector<Frustum>& frusta, const OcclusionOptions& options, MemoryBudget& budget,
                                     Reporter& report);

/// Bytes of `surfels` with their acceleration structure, at the peak of its building.
std::uint64_t resident_bytes_of(std::uint64_t surfels);

}  // namespace chiaro::surfels
