/// The two passes of a build over its clouds: where the points are, then each point to its partition of the spill file.
#pragma once
#include <filesystem>

#include "stream/base/budget.h"
#include "stream/base/report.h"
#include "stream/store/build_journal.h"
#include "stream/store/octree_build.h"

namespace chiaro::stream {

/// Fills part/spill.bin, and `journal` with what the passes found: manifest (as far as points tell), root, spacing, partitions. `out` is where the store will be, for its disk
/// space. throws Error (unreadable input, no space, no usable point, an input that changed between the passes), Cancelled.
void spill_points(const CloudInput& input, const std::filesystem::path& part, const std::filesystem::path& out, const BuildOptions& options, MemoryBudget& budget, Reporter& report,
                  BuildJournal& journal);

}  // namespace chiaro::stream
