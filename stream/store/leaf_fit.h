/// Normals, then radii, of all leaves in Morton order. They rewrite the leaves in place: after an interruption all are repeated, from the normals on.
#pragma once
#include <vector>

#include "stream/base/budget.h"
#include "stream/base/file.h"
#include "stream/base/report.h"
#include "stream/store/store.h"

namespace chiaro::stream {

struct FitJob {
  File& geometry;
  const Manifest& manifest;             ///< frame of the root
  std::vector<ChunkEntry>& entries;     ///< the whole index; inner nodes need their links only
  const std::vector<std::uint32_t>& leaves;
  double typical_spacing = 0;
  double estimate_radius_spacings = 3.5;
};

/// Normals of surfels flagged kEstimated; those that are not flat around are marked.
void fit_normals(const FitJob& job, MemoryBudget& budget, Reporter& report);
/// Better ones for those that are marked. They wait (pending_normal.h), as neighbours still look at the first ones, and take their place in fit_radii().
void refine_normals(const FitJob& job, MemoryBudget& budget, Reporter& report);
/// Radii, radius_max, spacing and geometry CRC of every leaf.
void fit_radii(const FitJob& job, MemoryBudget& budget, Reporter& report);

/// Normals and radii of a leaf from nothing but the leaf, see NormalSource::kNone. Fills radius_max, spacing and geometry_crc of the entry.
void guess_surfels(ChunkEntry& entry, std::vector<SurfelBlock>& blocks, double step);

}  // namespace chiaro::stream
