#include "stream/base/nearest_points.h"

#include <nanoflann.hpp>

namespace chiaro {
namespace {

struct Adaptor {
  std::span<const Vec3f> points;
  std::size_t kdtree_get_point_count() const { return points.size(); }
  float kdtree_get_pt(std::size_t i, std::size_t axis) const { return points[i][static_cast<Eigen::Index>(axis)]; }
  template <class Box>
  bool kdtree_get_bbox(Box&) const { return false; }
};
using Tree = nanoflann::KDTreeSingleIndexAdaptor<nanoflann::L2_Simple_Adaptor<float, Adaptor>, Adaptor, 3, std::uint32_t>;

constexpr std::size_t kPointsPerNode = 16;

}  // namespace

struct NearestPoints::Impl {
  explicit Impl(std::span<const Vec3f> points) : adaptor{points}, tree(3, adaptor, nanoflann::KDTreeSingleIndexAdaptorParams(kPointsPerNode)) { tree.buildIndex(); }
  Adaptor adaptor;
  Tree tree;
};

NearestPoints::NearestPoints(std::span<const Vec3f> points) : impl_(std::make_unique<Impl>(points)) {}
NearestPoints::NearestPoints(NearestPoints&&) noexcept = default;
NearestPoints::~NearestPoints() = default;

std::size_t NearestPoints::find(const Vec3f& point, std::size_t k, std::uint32_t* index, float* distance2) const {
  nanoflann::KNNResultSet<float, std::uint32_t> result(k);
  result.init(index, distance2);
  impl_->tree.findNeighbors(result, point.data(), nanoflann::SearchParams());
  return result.size();
}

}  // namespace chiaro
