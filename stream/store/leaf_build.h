/// From the spill file to leaves: sort each partition, cut it into octree cells, quantise, append to the store's files.
#pragma once
#include <vector>

#include "stream/base/budget.h"
#include "stream/base/file.h"
#include "stream/base/report.h"
#include "stream/store/spill.h"
#include "stream/store/store.h"

namespace chiaro::stream {

struct LeafRules {
  std::uint32_t chunk_surfels = kMaxChunkSurfels;
  double edge = 1;       ///< of the root
  double max_step = 1;   ///< a leaf's step is at most this: an isolated point is stored as finely as its neighbourhood would be
  bool guess_surfels = false;  ///< normals and radii from the leaf itself, see NormalSource::kNone
  bool normals_have_sign = true;  ///< those that the points bring, see NormalSource::kAxes
};

struct LeafFiles {
  File& geometry;
  File& source;
  File* colour = nullptr;  ///< 6 bytes a point in the order of the leaves; null without colour
};

/// Writes the leaves of all partitions in Morton order and returns their entries (no radii, no CRC of the geometry yet: both come with the normals).
/// A leaf is a cell of at most chunk_surfels points whose step is fine enough: at most max_step, and at most 1 % of its distinct Morton neighbours
/// fall together at 12 bits. Cells of level 21 are leaves in any case and continue in parts. Neither the partitions nor threads change the result.
/// spill: `spill_end` bytes of pages; more is appended while partitions that do not fit are cut, and removed again.
std::vector<ChunkEntry> build_leaves(File& spill, std::uint64_t spill_end, const RootCube& root, const std::vector<Partition>& partitions, const LeafRules& rules, const LeafFiles& files, MemoryBudget& budget,
                                     Reporter& report);

/// Points that one worker sorts at once under the budget, and how many workers.
struct LeafWorkers {
  int workers = 1;
  std::uint64_t capacity = 0;
};
LeafWorkers leaf_workers(const MemoryBudget& budget, std::uint32_t chunk_surfels);

}  // namespace chiaro::stream
