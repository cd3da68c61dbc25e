/// What PCL does for us beside reading PCD: statistical outliers and ICP. All of PCL lives in a module that is loaded on the first call.
#pragma once
#include <cstdint>
#include <memory>
#include <span>
#include <vector>

#include "stream/base/types.h"

namespace chiaro::stream {

/// True if the module with PCL can be loaded; never throws.
bool pcl_is_available();

/// pcl::StatisticalOutlierRemoval: a point is an outlier if the mean distance to its `neighbours` nearest points exceeds the cloud's mean
/// of that number by more than `multiplier` standard deviations.
///
/// points      any frame; positions that are not finite are kept (1) and take no part.
/// neighbours  >= 1; where the cloud has fewer, all of them.
/// returns     one flag per point, 1 = keep.
/// throws      Error if the module is missing; std::invalid_argument for neighbours < 1 or a multiplier that is not a number.
std::vector<std::uint8_t> statistical_inliers(std::span<const Vec3d> points, int neighbours, double multiplier);

/// Nearest neighbours in a copy of the points (pcl::KdTreeFLANN). Searching is safe from many threads.
class NeighbourTree {
 public:
  /// points: all finite, must outlive the tree; searched as floats relative to their median (one far point must not cost the others their
  /// digits).
  explicit NeighbourTree(std::span<const Vec3d> points);
  /// The `k` nearest points of each query: fills indices (PCL's order, by distance in float) and distances (sorted, in double from the
  /// given points), k per query, and returns how many of them each query got: min(k, points).
  std::size_t search(std::span<const Vec3d> queries, std::size_t k, std::vector<std::uint32_t>& indices,
                     std::vector<double>& distances) const;

 private:
  std::shared_ptr<void> tree_;
  std::span<const Vec3d> points_;  // the caller's
  Vec3d origin_ = Vec3d::Zero();
};

struct IcpResult {
  Eigen::Isometry3d target_from_source = Eigen::Isometry3d::Identity();
  double rms_distance = 0;  ///< of source points to their partners at the finest level, project units
  bool converged = false;
  int iterations = 0;  ///< of all levels together
};

/// Rigid motion that lays `source` onto `target` (pcl::IterativeClosestPoint coarse, then point to plane). Both clouds are taken relative
/// to the target's median, so that floats suffice. Positions that are not finite take no part.
///
/// max_distance    how far a source point may be from its partner at the start, project units; levels end at three times the target's point
/// spacing. max_iterations  per level. throws          Error if the module is missing or a cloud has fewer than 3 points;
/// std::invalid_argument for a distance or count that is not positive.
IcpResult align_icp(std::span<const Vec3d> source, std::span<const Vec3d> target, double max_distance, int max_iterations);

}  // namespace chiaro::stream
