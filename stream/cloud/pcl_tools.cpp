#include "stream/cloud/pcl_tools.h"

#include <algorithm>
#include <cmath>
#include <stdexcept>

#include "stream/base/error.h"
#include "stream/cloud/pcl_module.h"

namespace chiaro::stream {
namespace {

// PCL squares distances in floats and ends the process at a coordinate that is not finite; nothing real is further away than this.
constexpr double kFarthest = 1e15;

std::vector<float> floats_of(std::span<const Vec3d> points, const Vec3d& origin) {
  std::vector<float> out;
  out.reserve(3 * points.size());
  for (const Vec3d& p : points)
    for (int axis = 0; axis < 3; ++axis) out.push_back(static_cast<float>(std::clamp(p[axis] - origin[axis], -kFarthest, kFarthest)));
  return out;
}

/// Median of a sample, axis by axis: the middle of the bounds would follow a single point far away.
Vec3d median_of(std::span<const Vec3d> points) {
  Vec3d median = Vec3d::Zero();
  if (points.empty()) return median;
  const std::size_t stride = std::max<std::size_t>(1, points.size() / 1024);
  std::vector<double> values;
  for (int axis = 0; axis < 3; ++axis) {
    values.clear();
    for (std::size_t i = 0; i < points.size(); i += stride) values.push_back(points[i][axis]);
    std::nth_element(values.begin(), values.begin() + static_cast<std::ptrdiff_t>(values.size() / 2), values.end());
    median[axis] = values[values.size() / 2];
  }
  return median;
}

std::vector<Vec3d> finite_ones(std::span<const Vec3d> points, std::vector<std::size_t>* indices = nullptr) {
  std::vector<Vec3d> finite;
  for (std::size_t i = 0; i < points.size(); ++i) {
    if (!points[i].allFinite()) continue;
    finite.push_back(points[i]);
    if (indices) indices->push_back(i);
  }
  return finite;
}

// Single precision may have bent the rotation a little.
Eigen::Isometry3d rigid(const double* rows) {
  Eigen::Matrix4d m;
  for (int r = 0; r < 4; ++r)
    for (int c = 0; c < 4; ++c) m(r, c) = rows[4 * r + c];
  Eigen::Isometry3d transform = Eigen::Isometry3d::Identity();
  transform.linear() = Eigen::Quaterniond(Mat3d(m.topLeftCorner<3, 3>())).normalized().toRotationMatrix();
  transform.translation() = m.topRightCorner<3, 1>();
  return transform;
}

}  // namespace

bool pcl_is_available() {
  try {
    pcl_functions();
    return true;
  } catch (const Error&) {
    return false;
  }
}

std::vector<std::uint8_t> statistical_inliers(std::span<const Vec3d> points, int neighbours, double multiplier) {
  if (neighbours < 1 || std::isnan(multiplier))
    throw std::invalid_argument("statistical_inliers: neighbours must be 1 or more and the multiplier a number");
  std::vector<std::uint8_t> keep(points.size(), 1);
  std::vector<std::size_t> indices;
  const std::vector<Vec3d> finite = finite_ones(points, &indices);
  if (finite.size() < 2) return keep;
  // PCL 1.13 reads behind its list of distances where the cloud has fewer points than neighbours are asked for.
  const int k = static_cast<int>(std::min<std::size_t>(static_cast<std::size_t>(neighbours), finite.size() - 1));
  const std::vector<float> floats = floats_of(finite, median_of(finite));
  std::vector<std::uint8_t> kept(finite.size());
  char message[CHIARO_PCL_MESSAGE_BYTES] = {};
  check_pcl(pcl_functions().statistical_inliers(floats.data(), finite.size(), k, multiplier, kept.data(), message), message,
            "statistical outlier removal");
  for (std::size_t i = 0; i < kept.size(); ++i) keep[indices[i]] = kept[i];
  return keep;
}

NeighbourTree::NeighbourTree(std::span<const Vec3d> points) : points_(points), origin_(median_of(points)) {
  if (points.empty()) return;
  const std::vector<float> floats = floats_of(points, origin_);
  char message[CHIARO_PCL_MESSAGE_BYTES] = {};
  void* tree = nullptr;
  check_pcl(pcl_functions().tree_new(floats.data(), points.size(), &tree, message), message, "neighbour search");
  tree_ = std::shared_ptr<void>(tree, pcl_functions().tree_free);
}

std::size_t NeighbourTree::search(std::span<const Vec3d> queries, std::size_t k, std::vector<std::uint32_t>& indices,
                                  std::vector<double>& distances) const {
  if (!tree_) return 0;
  const std::vector<float> floats = floats_of(queries, origin_);
  std::vector<float> squared(queries.size() * k);
  indices.resize(queries.size() * k);
  distances.resize(queries.size() * k);
  const std::size_t found = pcl_functions().tree_search(tree_.get(), floats.data(), queries.size(), k, indices.data(), squared.data());
  for (std::size_t q = 0; q < queries.size(); ++q) {
    for (std::size_t j = 0; j < found; ++j) distances[q * k + j] = std::min(kFarthest, (points_[indices[q * k + j]] - queries[q]).norm());
    std::sort(distances.begin() + static_cast<std::ptrdiff_t>(q * k), distances.begin() + static_cast<std::ptrdiff_t>(q * k + found));
  }
  return found;
}

IcpResult align_icp(std::span<const Vec3d> source, std::span<const Vec3d> target, double max_distance, int max_iterations) {
  if (!(max_distance > 0) || !std::isfinite(max_distance) || max_iterations < 1)
    throw std::invalid_argument("align_icp: max_distance and max_iterations must be positive");
  const std::vector<Vec3d> from = finite_ones(source), to = finite_ones(target);
  if (from.size() < 3 || to.size() < 3)
    throw Error(concat("ICP needs 3 points or more in each cloud, got ", from.size(), " and ", to.size()));
  const Vec3d origin = median_of(to);
  const std::vector<float> from_floats = floats_of(from, origin), to_floats = floats_of(to, origin);
  ChiaroPclIcp icp{};
  char message[CHIARO_PCL_MESSAGE_BYTES] = {};
  check_pcl(
      pcl_functions().align_icp(from_floats.data(), from.size(), to_floats.data(), to.size(), max_distance, max_iterations, &icp, message),
      message, "ICP");
  const Eigen::Translation3d to_middle(-origin), back(origin);
  IcpResult result;
  result.target_from_source = back * rigid(icp.target_from_source) * to_middle;
  result.rms_distance = icp.rms_distance;
  result.converged = icp.converged != 0;
  result.iterations = icp.iterations;
  return result;
}

}  // namespace chiaro::stream
