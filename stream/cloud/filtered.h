/// Point readers on top of point readers: moved clouds, and clouds without outliers.
#pragma once
#include <cstdint>
#include <filesystem>
#include <functional>
#include <memory>
#include <vector>

#include "stream/base/report.h"
#include "stream/base/types.h"
#include "stream/cloud/pcl_tools.h"
#include "stream/cloud/point_stream.h"

namespace chiaro::stream {

/// The same points, moved: positions and normals are transformed, everything else passes.
std::unique_ptr<PointReader> transformed(std::unique_ptr<PointReader> reader, const Eigen::Isometry3d& target_from_source);

struct AlignOptions {
  double max_distance = 0;           ///< project units a point may be away from its place at the start; 0 = 2 % of the target's diagonal
  int max_iterations = 100;          ///< per level
  std::size_t max_points = 200'000;  ///< of each cloud that ICP works on
  std::uint64_t memory_bytes = std::uint64_t{1} << 32;  ///< for formats that a library reads whole
};

/// Finite positions of at most max_points points, evenly spread over the stream (every 2^k-th). Memory: twice max_points positions.
std::vector<Vec3d> subsample(PointReader& reader, std::size_t max_points, Reporter& report);

/// Rigid motion that lays the second scan onto the first (see align_icp); reads both files once. throws Error as open_points and align_icp
/// do.
IcpResult align_files(const std::filesystem::path& target_path, const std::filesystem::path& source_path, const AlignOptions& options,
                      Reporter& report);

struct OutlierOptions {
  int neighbours = 16;                                    ///< nearest points whose mean distance counts
  double multiplier = 2.0;                                ///< standard deviations above the cloud's mean that are still kept
  std::uint64_t memory_bytes = std::uint64_t{512} << 20;  ///< for the search; at least 16 MiB is used
  std::filesystem::path scratch_folder;                   ///< for 68 bytes of disk per point; empty: the system's temporary folder
};

/// Which points of a stream are outliers, by their running number.
struct OutlierMarks {
  std::uint64_t num_points = 0, num_rejected = 0;
  double mean_distance = 0, threshold = 0;  ///< of the mean neighbour distance, project units
  std::vector<std::uint64_t> bits;          ///< 1 = rejected; num_points / 8 bytes of memory, beside OutlierOptions::memory_bytes
  bool rejected(std::uint64_t point) const { return (bits[point >> 6] >> (point & 63)) & 1u; }
  static constexpr const char* kReason = "statistical outlier";
};

/// pcl::StatisticalOutlierRemoval over a whole stream in bounded memory: points go to a scratch file, are split into boxes that fit, and
/// every box is searched with a halo; the few points whose neighbours may lie beyond the halo are then searched in all boxes they could
/// reach. So the mean and the threshold are those of the whole cloud, whatever the memory. Positions that are not finite are not marked:
/// the caller rejects them for that. Reads the stream to its end. The same marks for any number of threads.
OutlierMarks mark_outliers(PointReader& reader, const OutlierOptions& options, Reporter& report);

/// The stream without the marked points; `reader` must give the points in the order in which they were marked. throws Error if it gives
/// more of them.
std::unique_ptr<PointReader> without_marked(std::unique_ptr<PointReader> reader, std::shared_ptr<const OutlierMarks> marks);

/// Marks in a first pass over open(), then reads a second open() without the marked points. `marks` tells how many were rejected.
std::unique_ptr<PointReader> remove_outliers(const std::function<std::unique_ptr<PointReader>()>& open, const OutlierOptions& options,
                                             Reporter& report, std::shared_ptr<const OutlierMarks>* marks = nullptr);

}  // namespace chiaro::stream
