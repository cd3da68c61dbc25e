/// Out-of-core build of a store from point files. Two passes over the input (count, distribute), one spill file, then chunks in Morton order,
/// then normals and radii with a halo, then the inner levels. Memory as the budget says, whatever the number of points.
#pragma once
#include <filesystem>
#include <string>
#include <vector>

#include "stream/base/budget.h"
#include "stream/base/report.h"
#include "stream/store/store.h"

namespace chiaro::stream {

enum class NormalSource { kAuto, kFile, kEstimate };

struct BuildOptions {
  std::string unit = "m";
  NormalSource normals = NormalSource::kAuto;  ///< kAuto: the file's where it has them, else estimated
  double estimate_radius_spacings = 3.5;       ///< PCA radius in local spacings
  std::uint32_t chunk_surfels = kMaxChunkSurfels;
  void validate() const;                       ///< throws std::invalid_argument
};

/// Builds `out` (NAME.chiaro). Points with positions that are not finite are rejected and counted. Order and bits do not depend on threads.
/// A killed build leaves out.part and resumes from its journal; an older finished store at `out` stays readable until the new one is published.
/// throws Error (unreadable input, no space, no usable point), Cancelled.
Manifest build_store(const std::vector<std::filesystem::path>& files, const std::filesystem::path& out, const BuildOptions& options,
                     MemoryBudget& budget, Reporter& report);

/// The key that build_store would record: hash of the files' fingerprints and the options.
std::string build_key(const std::vector<std::filesystem::path>& files, const BuildOptions& options);

struct VerifyResult {
  std::uint64_t chunks = 0, surfels = 0;
  std::vector<std::string> problems;   ///< empty = whole
};
/// Checks every CRC, the counts against the manifest, the conservation law (read = stored + rejected), each source index exactly once (bitmap or
/// bucketed when too large), parent/child links, tight bounds, and all layers.
VerifyResult verify_store(const std::filesystem::path& path, MemoryBudget& budget, Reporter& report);

}  // namespace chiaro::stream
