/// Out-of-core build of a store from point files. Two passes over the input (count, distribute), one spill file, then chunks in Morton order,
/// then normals and radii with a halo, then the inner levels. Memory as the budget says, whatever the number of points.
#pragma once
#include <filesystem>
#include <functional>
#include <memory>
#include <string>
#include <vector>

#include "stream/base/budget.h"
#include "stream/base/report.h"
#include "stream/cloud/point_stream.h"
#include "stream/store/store.h"

namespace chiaro::stream {

/// kNone: no neighbours are looked for. Normals that the file does not bring are those of planes through runs of 16 points, and all radii of a leaf are 1.5 times
/// its mean spacing: a preview, made several times as fast. kAxes: as kFile, but nobody knows which side is the outer one.
enum class NormalSource { kAuto, kFile, kEstimate, kNone, kAxes };

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

/// Clouds that do not come straight from files: moved, filtered, generated. build_store() is this with open_points().
struct CloudInput {
  std::vector<std::filesystem::path> files;           ///< names for the manifest, one a cloud
  std::vector<std::string> fingerprints;              ///< one a cloud: must change whenever what `open` gives changes
  /// Opens cloud i from its beginning; called twice, the same points each time.
  std::function<std::unique_ptr<PointReader>(std::size_t cloud)> open;
  /// Optional: is the point of this running number (over all clouds, rejected ones included) left out? Counted under `rejected_reason`.
  std::function<bool(std::uint64_t running_number)> rejected;
  std::string rejected_reason = "outlier";
  std::string filter_key;                             ///< identity of `rejected`, part of the key
};
Manifest build_store_from(const CloudInput& input, const std::filesystem::path& out, const BuildOptions& options, MemoryBudget& budget, Reporter& report);
std::string build_key(const CloudInput& input, const BuildOptions& options);

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
