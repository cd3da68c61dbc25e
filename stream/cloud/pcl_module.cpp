// Everything that uses PCL, behind the C interface of pcl_module_abi.h. Built as a module of its own and loaded when first needed: PCL's
// I/O library brings VTK along, which costs start-up time and memory in every process that links it.
#include <pcl/console/print.h>
#include <pcl/filters/statistical_outlier_removal.h>
#include <pcl/io/pcd_io.h>
#include <pcl/kdtree/kdtree_flann.h>
#include <pcl/PCLPointCloud2.h>
#include <pcl/point_cloud.h>
#include <pcl/point_types.h>
#include <pcl/registration/icp.h>
#include <pcl/registration/transformation_estimation_point_to_plane_lls.h>

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstdio>
#include <cstring>
#include <Eigen/Eigenvalues>
#include <Eigen/Geometry>
#include <exception>
#include <limits>
#include <memory>
#include <stdexcept>
#include <string>
#include <type_traits>
#include <vector>

#include "stream/cloud/pcl_module_abi.h"

namespace {

using Points = pcl::PointCloud<pcl::PointXYZ>;
using Tree = pcl::KdTreeFLANN<pcl::PointXYZ>;

// No exception leaves the module: the caller may have been built with another library of exceptions in mind.
template <class Work>
int guarded(char* message, const Work& work) {
  const auto fail = [message](const char* why) {
    std::snprintf(message, CHIARO_PCL_MESSAGE_BYTES, "%s", why);
    return 1;
  };
  try {
    work();
    return 0;
  } catch (const std::bad_alloc&) {
    return fail("out of memory in PCL");
  } catch (const std::exception& error) {
    return fail(error.what());
  } catch (...) {
    return fail("unknown failure in PCL");
  }
}

Points::Ptr cloud_of(const float* points, std::size_t count) {
  auto cloud = std::make_shared<Points>();
  cloud->resize(count);
  for (std::size_t i = 0; i < count; ++i) (*cloud)[i] = pcl::PointXYZ(points[3 * i], points[3 * i + 1], points[3 * i + 2]);
  return cloud;
}

// ---- PCD ----

int read_pcd(const char* path, void** out, char* message) {
  return guarded(message, [&] {
    auto cloud = std::make_unique<pcl::PCLPointCloud2>();
    pcl::PCDReader reader;
    if (reader.read(path, *cloud) < 0) throw std::runtime_error("PCL cannot read this PCD: header and content do not agree");
    *out = cloud.release();
  });
}

const pcl::PCLPointCloud2& cloud_at(const void* cloud) { return *static_cast<const pcl::PCLPointCloud2*>(cloud); }

void free_cloud(void* cloud) { delete static_cast<pcl::PCLPointCloud2*>(cloud); }
std::size_t num_fields(const void* cloud) { return cloud_at(cloud).fields.size(); }

void field(const void* cloud, std::size_t index, ChiaroPclField* out) {
  const pcl::PCLPointField& f = cloud_at(cloud).fields[index];
  *out = {};
  std::snprintf(out->name, sizeof out->name, "%s", f.name.c_str());
  out->offset = f.offset;
  out->count = f.count;
  out->bytes = static_cast<std::size_t>(pcl::getFieldSize(f.datatype));
  out->type = pcl::getFieldType(f.datatype);
}

void rows(const void* cloud, const void** data, std::size_t* bytes, std::size_t* row_bytes, std::size_t* num_points) {
  const pcl::PCLPointCloud2& c = cloud_at(cloud);
  *data = c.data.data();
  *bytes = c.data.size();
  *row_bytes = c.point_step;
  *num_points = static_cast<std::size_t>(c.width) * c.height;
}

// ---- outliers and neighbours ----

int statistical_inliers(const float* points, std::size_t count, int neighbours, double multiplier, std::uint8_t* keep, char* message) {
  return guarded(message, [&] {
    pcl::StatisticalOutlierRemoval<pcl::PointXYZ> filter;
    filter.setInputCloud(cloud_of(points, count));
    filter.setMeanK(neighbours);
    filter.setStddevMulThresh(multiplier);
    pcl::Indices kept;
    filter.filter(kept);
    std::fill(keep, keep + count, std::uint8_t{0});
    for (const pcl::index_t i : kept) keep[i] = 1;
  });
}

int tree_new(const float* points, std::size_t count, void** out, char* message) {
  return guarded(message, [&] {
    auto tree = std::make_unique<Tree>();
    tree->setInputCloud(cloud_of(points, count));
    *out = tree.release();
  });
}

void tree_free(void* tree) { delete static_cast<Tree*>(tree); }

std::size_t tree_search(const void* tree_handle, const float* queries, std::size_t num_queries, std::size_t k, std::uint32_t* indices,
                        float* squared) {
  const Tree& tree = *static_cast<const Tree*>(tree_handle);
  const std::size_t found = std::min<std::size_t>(k, tree.getInputCloud()->size());
  if (found == 0) return 0;
  pcl::Indices neighbours;
  std::vector<float> distances;
  for (std::size_t q = 0; q < num_queries; ++q) {
    tree.nearestKSearch(pcl::PointXYZ(queries[3 * q], queries[3 * q + 1], queries[3 * q + 2]), static_cast<unsigned>(found), neighbours,
                        distances);
    for (std::size_t j = 0; j < found; ++j) {
      indices[q * k + j] = static_cast<std::uint32_t>(neighbours[j]);
      squared[q * k + j] = distances[j];
    }
  }
  return found;
}

// ---- ICP ----

using Oriented = pcl::PointCloud<pcl::PointNormal>;

// Normals by the plane through the nearest points. Their sign does not matter to point-to-plane distances.
Oriented::Ptr with_normals(const Points& cloud, const Tree& tree) {
  constexpr unsigned kNeighbours = 16;
  auto oriented = std::make_shared<Oriented>();
  oriented->resize(cloud.size());
  pcl::Indices neighbours;
  std::vector<float> distances;
  for (std::size_t i = 0; i < cloud.size(); ++i) {
    const unsigned k = static_cast<unsigned>(std::min<std::size_t>(kNeighbours, cloud.size()));
    tree.nearestKSearch(cloud[i], k, neighbours, distances);
    Eigen::Vector3f mean = Eigen::Vector3f::Zero();
    for (const pcl::index_t j : neighbours) mean += cloud[static_cast<std::size_t>(j)].getVector3fMap();
    mean /= static_cast<float>(neighbours.size());
    Eigen::Matrix3f scatter = Eigen::Matrix3f::Zero();
    for (const pcl::index_t j : neighbours) {
      const Eigen::Vector3f d = cloud[static_cast<std::size_t>(j)].getVector3fMap() - mean;
      scatter += d * d.transpose();
    }
    const Eigen::Vector3f normal = Eigen::SelfAdjointEigenSolver<Eigen::Matrix3f>(scatter).eigenvectors().col(0);
    pcl::PointNormal& p = (*oriented)[i];
    p.getVector3fMap() = cloud[i].getVector3fMap();
    p.getNormalVector3fMap() = normal;
  }
  return oriented;
}

Points::Ptr thinned(const Points::Ptr& cloud, std::size_t at_most) {
  if (cloud->size() <= at_most) return cloud;
  const std::size_t stride = (cloud->size() + at_most - 1) / at_most;
  auto kept = std::make_shared<Points>();
  for (std::size_t i = 0; i < cloud->size(); i += stride) kept->push_back((*cloud)[i]);
  return kept;
}

struct Fit {
  double rms = std::numeric_limits<double>::infinity();
  std::size_t pairs = 0;
};

// Distance to the nearest target point over the source points that have one within max_distance.
Fit fit_of(const Points& source, const Tree& target, const Eigen::Matrix4f& transform, double max_distance) {
  Fit fit;
  double sum = 0;
  pcl::Indices neighbour;
  std::vector<float> distance;
  for (const pcl::PointXYZ& point : source) {
    pcl::PointXYZ moved;
    moved.getVector3fMap() = transform.topLeftCorner<3, 3>() * point.getVector3fMap() + transform.topRightCorner<3, 1>();
    if (!moved.getVector3fMap().allFinite() || target.nearestKSearch(moved, 1, neighbour, distance) == 0) continue;
    if (static_cast<double>(distance[0]) > max_distance * max_distance) continue;
    sum += static_cast<double>(distance[0]);
    ++fit.pairs;
  }
  if (fit.pairs > 0) fit.rms = std::sqrt(sum / static_cast<double>(fit.pairs));
  return fit;
}

struct IcpState {
  Eigen::Matrix4f transform = Eigen::Matrix4f::Identity();
  bool converged = false;
  int iterations = 0;
};

template <class Registration>
class Counting : public Registration {
 public:
  int iterations() const { return this->nr_iterations_; }
};

/// Point-to-plane step that leaves alone what the pairs do not determine (sliding along a plane, turning about an axis). PCL's own
/// estimator divides by the vanishing eigenvalue there, and its neighbour search then ends the process at the first coordinate that is not
/// a number.
class DeterminedPointToPlane : public pcl::registration::TransformationEstimationPointToPlaneLLS<pcl::PointNormal, pcl::PointNormal> {
  using Base = pcl::registration::TransformationEstimationPointToPlaneLLS<pcl::PointNormal, pcl::PointNormal>;

 public:
  using Base::estimateRigidTransformation;
  void estimateRigidTransformation(const Oriented& source, const Oriented& target, const pcl::Correspondences& pairs,
                                   Matrix4& transform) const override {
    transform.setIdentity();
    if (pairs.empty()) return;
    const auto from = [&](const pcl::Correspondence& c) -> Eigen::Vector3d {
      return source[static_cast<std::size_t>(c.index_query)].getVector3fMap().cast<double>();
    };
    Eigen::Vector3d middle = Eigen::Vector3d::Zero();
    for (const auto& c : pairs) middle += from(c);
    middle /= static_cast<double>(pairs.size());
    double spread = 0;
    for (const auto& c : pairs) spread += (from(c) - middle).squaredNorm();
    const double size = std::sqrt(spread / static_cast<double>(pairs.size()));
    if (!(size > 0)) return;
    // Unknowns: turn about the middle times size, and shift: all six in units of length.
    Eigen::Matrix<double, 6, 6> normal_matrix = Eigen::Matrix<double, 6, 6>::Zero();
    Eigen::Matrix<double, 6, 1> right = Eigen::Matrix<double, 6, 1>::Zero();
    for (const auto& c : pairs) {
      const auto& partner = target[static_cast<std::size_t>(c.index_match)];
      const Eigen::Vector3d n = partner.getNormalVector3fMap().cast<double>(), p = from(c) - middle;
      Eigen::Matrix<double, 6, 1> row;
      row << p.cross(n) / size, n;
      normal_matrix += row * row.transpose();
      right += row * n.dot(partner.getVector3fMap().cast<double>() - from(c));
    }
    constexpr double kUndetermined = 1e-3;  // share of the largest eigenvalue; below, noise would decide
    const Eigen::SelfAdjointEigenSolver<Eigen::Matrix<double, 6, 6>> eigen(normal_matrix);
    Eigen::Matrix<double, 6, 1> motion = Eigen::Matrix<double, 6, 1>::Zero();
    for (int i = 0; i < 6; ++i) {
      if (!(eigen.eigenvalues()[i] > kUndetermined * eigen.eigenvalues()[5])) continue;
      const Eigen::Matrix<double, 6, 1> v = eigen.eigenvectors().col(i);
      motion += v * (v.dot(right) / eigen.eigenvalues()[i]);
    }
    if (!motion.allFinite()) return;
    const Eigen::Vector3d turn = motion.head<3>() / size;
    const double angle = turn.norm();
    Eigen::Matrix3d rotation = Eigen::Matrix3d::Identity();
    if (angle > 0) rotation = Eigen::AngleAxisd(angle, turn / angle).toRotationMatrix();
    transform.topLeftCorner<3, 3>() = rotation.cast<float>();
    transform.topRightCorner<3, 1>() = (middle - rotation * middle + motion.tail<3>()).cast<float>();
  }
};

// One run of PCL's ICP from `state`; false and no change if its result is not finite.
template <class Icp, class CloudPtr>
bool run_icp(const CloudPtr& source, const CloudPtr& target, double max_distance, int max_iterations, double step, IcpState& state) {
  Counting<Icp> icp;
  if constexpr (std::is_same_v<CloudPtr, Oriented::Ptr>) icp.setTransformationEstimation(std::make_shared<DeterminedPointToPlane>());
  icp.setInputSource(source);
  icp.setInputTarget(target);
  icp.setMaxCorrespondenceDistance(max_distance);
  icp.setMaximumIterations(max_iterations);
  icp.setTransformationEpsilon(step * step);
  icp.setEuclideanFitnessEpsilon(0);
  typename CloudPtr::element_type aligned;
  icp.align(aligned, state.transform);
  state.iterations += icp.iterations();
  const Eigen::Matrix4f transform = icp.getFinalTransformation();
  if (!transform.allFinite()) return false;
  state.transform = transform;
  state.converged = icp.hasConverged();
  return true;
}

double typical_spacing(const Points& cloud, const Tree& tree) {
  std::vector<float> distances, all;
  pcl::Indices neighbours;
  const std::size_t stride = std::max<std::size_t>(1, cloud.size() / 1000);
  for (std::size_t i = 0; i < cloud.size(); i += stride)
    if (tree.nearestKSearch(cloud[i], 2, neighbours, distances) == 2) all.push_back(distances[1]);
  if (all.empty()) return 0;
  std::nth_element(all.begin(), all.begin() + static_cast<std::ptrdiff_t>(all.size() / 2), all.end());
  return std::sqrt(static_cast<double>(all[all.size() / 2]));
}

Oriented::Ptr bare(const Points& cloud) {
  auto oriented = std::make_shared<Oriented>();
  oriented->resize(cloud.size());
  for (std::size_t i = 0; i < cloud.size(); ++i) (*oriented)[i].getVector3fMap() = cloud[i].getVector3fMap();
  return oriented;
}

/// Coarse to fine: thin clouds and far partners first, point to point; then all points against the planes of the target, with partners ever
/// closer.
void align(const Points::Ptr& source, const Points::Ptr& target, double max_distance, int max_iterations, ChiaroPclIcp& out) {
  Tree tree;
  tree.setInputCloud(target);
  const double spacing = typical_spacing(*target, tree);
  const double finest = std::min(max_distance, 3 * spacing);
  const double step = std::max(1e-7 * max_distance, 1e-4 * spacing);
  const Oriented::Ptr oriented = with_normals(*target, tree);

  IcpState state;
  constexpr std::size_t kCoarsePoints = 5000;
  const Points::Ptr thin = thinned(source, kCoarsePoints);
  run_icp<pcl::IterativeClosestPoint<pcl::PointXYZ, pcl::PointXYZ>>(thin, target, max_distance, max_iterations, step, state);
  Fit best = fit_of(*thin, tree, state.transform, max_distance);

  const Oriented::Ptr thin_oriented = bare(*thin), all_oriented = bare(*source);
  double distance = max_distance;
  for (bool last = false; !last; distance = std::max(finest, distance / 3)) {
    last = distance <= finest * 1.0000001;
    IcpState next = state;
    next.iterations = 0;
    const Oriented::Ptr& moving = last ? all_oriented : thin_oriented;
    const bool ran = run_icp<pcl::IterativeClosestPointWithNormals<pcl::PointNormal, pcl::PointNormal>>(moving, oriented, distance,
                                                                                                        max_iterations, step, next);
    state.iterations += next.iterations;
    const Fit fit = ran ? fit_of(*thin, tree, next.transform, max_distance) : Fit{};
    // A level that does not bring the clouds closer is not taken.
    if (ran && fit.pairs * 10 >= best.pairs * 9 && fit.rms <= best.rms * 1.001) {
      state.transform = next.transform;
      state.converged = next.converged;
      best = fit;
    }
  }
  // The last word: how far partners are that the finest level accepts.
  const Fit fit = fit_of(*source, tree, state.transform, std::max(finest, std::min(max_distance, 3 * best.rms)));
  out.rms_distance = fit.rms;
  out.converged = state.converged && fit.pairs >= 3;
  out.iterations = state.iterations;
  for (int r = 0; r < 4; ++r)
    for (int c = 0; c < 4; ++c) out.target_from_source[4 * r + c] = static_cast<double>(state.transform(r, c));
}

int align_icp(const float* source, std::size_t num_source, const float* target, std::size_t num_target, double max_distance,
              int max_iterations, ChiaroPclIcp* out, char* message) {
  return guarded(message, [&] { align(cloud_of(source, num_source), cloud_of(target, num_target), max_distance, max_iterations, *out); });
}

}  // namespace

extern "C" __attribute__((visibility("default"))) const ChiaroPclFunctions* chiaro_pcl_functions(void) {
  // PCL writes its complaints to the terminal; ours reach the user as messages.
  pcl::console::setVerbosityLevel(pcl::console::L_ALWAYS);
  static const ChiaroPclFunctions functions = {CHIARO_PCL_ABI,      read_pcd, free_cloud, num_fields,  field,    rows,
                                               statistical_inliers, tree_new, tree_free,  tree_search, align_icp};
  return &functions;
}
