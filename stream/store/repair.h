/// Rebuilds of a damaged store what follows from what is whole. Nothing is taken for repaired that is not proven to be the original: the bytes made anew
/// must have the checksum that the store keeps of them. So damaged leaves are never blessed with a new checksum.
///
/// Rebuilt: inner levels, from leaves whose checksums hold; records of the index; inner means of layers; totals of the manifest; single damaged bytes of
/// manifest.json, layer.json and the indexes. Not kept twice, and so lost: geometry, source indices and layer values of leaves.
///
/// Files are replaced whole, one by one, through NAME.part: a file is as damaged as before or repaired, and a repair that was killed is repeated.
#pragma once
#include <cstdint>
#include <filesystem>
#include <string>
#include <vector>

#include "stream/base/budget.h"
#include "stream/base/report.h"

namespace chiaro::stream {

struct RepairResult {
  std::vector<std::string> repaired;   ///< what was rebuilt, by file
  std::vector<std::string> lost;       ///< what could not be, and what it holds; the first kMostLines of a kind
  std::vector<std::string> advice;     ///< what to do about what is lost
  std::uint64_t points_lost = 0;       ///< points of leaves whose geometry or source indices are damaged
  static constexpr std::size_t kMostLines = 1000;
};

/// Repairs the store at `path` as far as it goes; verify_store() afterwards tells whether it is whole.
/// Disk: a second copy of each file that is changed, one at a time. throws Error (no folder, no space, I/O), Cancelled.
RepairResult repair_store(const std::filesystem::path& path, MemoryBudget& budget, Reporter& report);

}  // namespace chiaro::stream
