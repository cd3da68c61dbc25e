#include <algorithm>
#include <array>
#include <cmath>

#include "stream/store/neighbour_walk.h"
#include "stream/store/plane_fit.h"

namespace chiaro::stream {
namespace {

// Chosen on the rendered tower (0.8 mm of noise, 9 mm spacing). A second round, other starts (the direction that most neighbours agree on) and weights by how
// flat a neighbour's surroundings are gained nothing there.
constexpr float kAlike = 0.29289f;       // 1 - cos 45 degrees: neighbours turned further away are on another face
constexpr double kOffPlane = 4;          // standard deviations off the plane; what is further off it is on another face
constexpr double kLeastOff = 0.02;       // of the spacing: coordinates are rounded
constexpr double kLeastNeighbours = 5;   // that count; with fewer the first normal stays

float square(float v) { return v * v; }
double square(double v) { return v * v; }

class NormalRefiner {
 public:
  static constexpr bool kNeedsNormals = true, kFitsGroups = false;
  static constexpr float kNearShare = 0.7f, kWideShare = kNearShare, kRunShare = 1.4f;
  NormalRefiner(const HaloChunk& own, const FitOptions& options, const std::vector<std::uint8_t>& wanted, std::vector<Vec3f>& normals)
      : own_(own), options_(options), wanted_(wanted), normals_(normals) {}

  bool wants(std::uint32_t begin, std::uint32_t end) const {
    return std::any_of(wanted_.begin() + begin, wanted_.begin() + end, [](std::uint8_t w) { return w != 0; });
  }

  static bool positions_tell_all(std::uint32_t, const CandidateView&) { return true; }   // the nearest, who they are
  void fit_nearest(const SearchGroup& group, const CandidateView&, float, const CandidateView&, float, std::array<bool, kLanes>& fitted) const {
    for (std::size_t at = 0; at < group.size(); ++at) fitted[at] = wanted_[group.begin + at] == 0;
  }

  bool fit_near(const SearchGroup& group, std::size_t at, const CandidateView& view, const Selection& c) {
    const std::size_t i = group.begin + at;
    const float radius = group.radius[at];
    collect_within(view, own_.x[i], own_.y[i], own_.z[i], radius * radius, row_);
    if (row_.num > options_.most) return false;
    refine(i, radius, row_, row_.num, c);
    return true;
  }

  bool fit_one(std::uint32_t i, const NeighbourList& list, const Selection& c, bool) {
    refine(i, list.radius, list, list.size(), c);
    return true;
  }

 private:
  // The plane through the neighbours that are turned alike, near ones more; then again without those that lie off it.
  template <class Neighbours>
  void refine(std::size_t i, float radius, const Neighbours& near, std::size_t num, const Selection& c) {
    const Vec3f first(own_.nx[i], own_.ny[i], own_.nz[i]);
    normals_[i] = first;
    weights_.resize(num);
    for (std::size_t k = 0; k < num; ++k) {
      const std::uint32_t j = near.candidate[k];
      const float turned = 1 - std::abs(first.x() * c.nx[j] + first.y() * c.ny[j] + first.z() * c.nz[j]);
      weights_[k] = square(std::max(0.0f, 1 - near.distance_squared[k] / (radius * radius))) * square(std::max(0.0f, 1 - turned / kAlike));
    }
    const Plane plane = plane_of(moments(near, num));
    if (plane.isolated || plane.line) return;
    const Vec3d normal = normal_of(plane).normal.template cast<double>();
    const double spacing = static_cast<double>(radius) / options_.radius_spacings;
    const double limit = std::max(kOffPlane * std::sqrt(std::max(0.0, plane.values[0]) * plane.scale), kLeastOff * spacing);
    double sum = 1, sum_of_squares = 1;
    for (std::size_t k = 0; k < num; ++k) {
      const double off = normal.dot(Vec3d(static_cast<double>(near.x[k]), static_cast<double>(near.y[k]), static_cast<double>(near.z[k])) - plane.mean);
      weights_[k] *= static_cast<float>(square(std::max(0.0, 1 - square(off / limit))));
      sum += static_cast<double>(weights_[k]);
      sum_of_squares += square(static_cast<double>(weights_[k]));
    }
    if (sum * sum < kLeastNeighbours * sum_of_squares) return;
    const Plane again = plane_of(moments(near, num));
    if (again.isolated || again.line) return;
    const Vec3f better = normal_of(again).normal;
    normals_[i] = better.dot(first) < 0 ? Vec3f(-better) : better;
  }

  template <class Neighbours>
  Moments moments(const Neighbours& near, std::size_t num) const {
    Moments m{};
    for (std::size_t k = 0; k < num; ++k) {
      const double w = static_cast<double>(weights_[k]), x = static_cast<double>(near.x[k]), y = static_cast<double>(near.y[k]), z = static_cast<double>(near.z[k]);
      const double terms[kTerms] = {x, y, z, x * x, x * y, x * z, y * y, y * z, z * z, 1};
      for (std::size_t t = 0; t < kTerms; ++t) m[t] += w * terms[t];
    }
    return m;
  }

  const HaloChunk& own_;
  const FitOptions& options_;
  const std::vector<std::uint8_t>& wanted_;
  std::vector<Vec3f>& normals_;
  NeighbourRow row_;
  std::vector<float> weights_;
};

}  // namespace

void refine_normals_of(Neighbourhood& around, const FitOptions& options, const std::vector<std::uint8_t>& wanted, std::vector<Vec3f>& normals) {
  normals.assign(around.own().size, Vec3f::UnitZ());
  NormalRefiner refiner(around.own(), options, wanted, normals);
  Walker<NormalRefiner>(around, options, refiner).run();
}

}  // namespace chiaro::stream
