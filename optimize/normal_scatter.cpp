#include "optimize/normal_scatter.h"

#include <algorithm>
#include <cmath>
#include <vector>

namespace chiaro::optimize {
namespace {

constexpr std::size_t kNeighbours = 9;   // with the surfel itself
constexpr std::size_t kMostSurfels = 20000;
constexpr double kRmsOfMedian = 1.2011;  // of the length of a vector with two independent normal coordinates: sqrt(2) / sqrt(2 ln 2)

}  // namespace

double normal_scatter_rad(const Proxy& proxy, const NearestPoints& nearest) {
  std::vector<double> angles;
  const std::size_t stride = std::max<std::size_t>(1, proxy.size() / kMostSurfels);
  std::uint32_t index[kNeighbours];
  float distance2[kNeighbours];
  for (std::size_t i = 0; i < proxy.size(); i += stride) {
    const std::size_t n = nearest.find(proxy.position[i], kNeighbours, index, distance2);
    Vec3d mean = Vec3d::Zero();
    for (std::size_t j = 0; j < n; ++j)
      if (index[j] != i) mean += proxy.normal[index[j]].cast<double>();
    if (n < kNeighbours || !(mean.norm() > 0)) continue;
    mean.normalize();
    angles.push_back(std::atan2(mean.cross(proxy.normal[i].cast<double>()).norm(), mean.dot(proxy.normal[i].cast<double>())));
  }
  if (angles.empty()) return 0;
  const auto mid = angles.begin() + static_cast<std::ptrdiff_t>(angles.size() / 2);
  std::nth_element(angles.begin(), mid, angles.end());
  // The neighbours' mean errs too, by an eighth of the variance.
  return kRmsOfMedian * *mid / std::sqrt(1 + 1.0 / (kNeighbours - 1));
}

}  // namespace chiaro::optimize
