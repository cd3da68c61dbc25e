#include <algorithm>
#include <array>
#include <cmath>

#include "stream/store/neighbour_walk.h"
#include "stream/store/plane_fit.h"

namespace chiaro::stream {
namespace {

/// Normals are fitted at three nested radii. The widest one that still fits a plane as well as the narrowest does is taken: wide on flat ground, where it
/// averages noise, narrow at edges and joints, which a wide one would round off (measured on the rendered tower, 0.8 mm of noise at 9 mm spacing, against
/// one radius of 3.5 spacings: 95 % of errors below 18 instead of 26 degrees, median 1.5 instead of 1.4).
constexpr std::size_t kScales = 3;
constexpr float kScaleOfRadius[kScales] = {1.0f, 0.74f, 0.57f};
constexpr double kPlaneGrowth = 1.35;   // residual of the wider plane over the narrowest one's that sampling alone explains

/// The moments at each of the scales; only those that are asked for are summed. Floats lose a millionth, but products of two need care where the plane is
/// thin: at worst some 0.001 degrees.
template <class MomentsAt>
Plane plane_of_scales(const MomentsAt& moments_at, bool& rough) {
  std::size_t narrowest = kScales;
  Moments m;
  do m = moments_at(--narrowest);
  while (narrowest > 0 && m[9] < kEnoughForPlane);
  Plane best = plane_of(m);
  rough = false;
  if (narrowest == 0) return best;
  if (best.line || best.isolated) return plane_of(moments_at(0));
  const double limit = kPlaneGrowth * kPlaneGrowth * best.variance_off;
  for (std::size_t s = 0; s < narrowest; ++s) {  // the widest first: on flat ground it is the answer
    const Plane wider = plane_of(moments_at(s));
    if (!wider.line && !wider.isolated && wider.variance_off <= limit) return wider;
    rough = true;
  }
  return best;
}

class NormalFitter {
 public:
  static constexpr bool kNeedsNormals = false, kFitsGroups = true;
  // The sixth neighbour is at 0.39 of the radius; this finds it for all but few points whose surroundings are sparser than the mean.
  static constexpr float kNearShare = 0.7f, kRunShare = 1.4f, kInnerShare = kScaleOfRadius[kScales - 1];
  NormalFitter(const HaloChunk& own, const FitOptions& options, std::vector<NormalFit>& fits) : own_(own), options_(options), fits_(fits) {}

  /// What plane_of_scales() does, for the points of a group that have enough neighbours around them. Only `nearer` has those of the narrowest scale.
  void fit_group(const SearchGroup& group, const CandidateView& nearer, const CandidateView& farther, std::array<bool, kLanes>& fitted) {
    LaneMoments wide_sums, narrow_sums;
    const LaneFloats wide_limits = limits(group, 0);
    add_moments(nearer, group.points, wide_limits, limits(group, kScales - 1), wide_sums, narrow_sums);
    add_moments(farther, group.points, wide_limits, wide_sums);
    planes_of(narrow_sums, narrow_);
    planes_of(wide_sums, planes_);
    const auto as_flat = [&](std::size_t lane) { return planes_.sure[lane] && planes_.variance_off[lane] <= kPlaneGrowth * kPlaneGrowth * narrow_.variance_off[lane]; };
    unsigned rough = 0;
    for (std::size_t lane = 0; lane < kLanes; ++lane) rough |= static_cast<unsigned>(!as_flat(lane)) << lane;
    if (rough != 0) {
      LaneMoments sums;
      const LaneFloats middle_limits = limits(group, 1);
      add_moments(nearer, group.points, middle_limits, sums);
      add_moments(farther, group.points, middle_limits, sums);
      planes_of(sums, middle_);
      for (std::size_t lane = 0; lane < kLanes; ++lane) {
        if ((rough >> lane & 1) == 0) continue;
        planes_.take(lane, middle_);
        if (!as_flat(lane)) planes_.take(lane, narrow_);
      }
    }
    normals_of(planes_, normals_);
    for (std::size_t lane = 0; lane < group.size(); ++lane) {
      const bool all = group.radius[lane] > 0 && wide_sums.sum[kTerms - 1][lane] <= static_cast<float>(options_.most + 1);
      if (!all || !narrow_.sure[lane] || !normals_.clear[lane]) continue;
      fits_[group.begin + lane] = {Vec3d(normals_.x[lane], normals_.y[lane], normals_.z[lane]).cast<float>(), false, (rough >> lane & 1) != 0};
      fitted[lane] = true;
    }
  }

  bool fit_near(const SearchGroup& group, std::size_t at, const CandidateView& view, const Selection&) {
    const std::size_t i = group.begin + at;
    const float radius = group.radius[at];
    collect_within(view, own_.x[i], own_.y[i], own_.z[i], radius * radius, row_);
    if (row_.num > options_.most) return false;
    bool rough = false;
    const Plane plane = plane_of_scales([&](std::size_t s) { return moments_within(row_, radius * radius * kScaleOfRadius[s] * kScaleOfRadius[s]); }, rough);
    if (plane.line) return false;
    set(i, plane, rough);
    return true;
  }

  bool fit_one(std::uint32_t i, const NeighbourList& list, const Selection&, bool last) {
    bool rough = false;
    const auto moments_at = [&](std::size_t s) {
      Moments m{};
      for (std::size_t k = 0; k < list.size(); ++k) {
        const double x = static_cast<double>(list.x[k]), y = static_cast<double>(list.y[k]), z = static_cast<double>(list.z[k]);
        const double terms[10] = {x, y, z, x * x, x * y, x * z, y * y, y * z, z * z, 1};
        if (list.distance_squared[k] > list.radius * list.radius * kScaleOfRadius[s] * kScaleOfRadius[s] && s > 0) continue;
        for (std::size_t t = 0; t < 10; ++t) m[t] += terms[t];
      }
      return m;
    };
    const Plane plane = plane_of_scales(moments_at, rough);
    if (plane.line && !last) return false;
    set(i, plane, rough);
    return true;
  }

 private:
  void set(std::size_t i, const Plane& plane, bool rough) {
    fits_[i] = normal_of(plane);
    fits_[i].rough = rough && !fits_[i].isolated;
  }

  static LaneFloats limits(const SearchGroup& group, std::size_t scale) {
    LaneFloats limit;
    for (std::size_t lane = 0; lane < kLanes; ++lane) {
      const float radius = kScaleOfRadius[scale] * group.radius[lane];
      limit[lane] = radius > 0 ? radius * radius : -1;
    }
    return limit;
  }

  const HaloChunk& own_;
  const FitOptions& options_;
  std::vector<NormalFit>& fits_;
  LanePlanes narrow_, middle_, planes_;
  LaneNormals normals_;
  NeighbourRow row_;
};

}  // namespace

void fit_normals_of(Neighbourhood& around, const FitOptions& options, std::vector<NormalFit>& fits) {
  fits.assign(around.own().size, {});
  NormalFitter fitter(around.own(), options, fits);
  Walker<NormalFitter>(around, options, fitter).run();
}

Vec3f plane_normal(const SurfelBlock& b, std::size_t count) {
  Moments m{};
  m[9] = static_cast<double>(count) - 1;
  for (std::size_t i = 1; i < count; ++i) {
    const double x = b.x[i] - b.x[0], y = b.y[i] - b.y[0], z = b.z[i] - b.z[0];
    const double terms[9] = {x, y, z, x * x, x * y, x * z, y * y, y * z, z * z};
    for (std::size_t t = 0; t < 9; ++t) m[t] += terms[t];
  }
  return normal_of(plane_of(m)).normal;
}

}  // namespace chiaro::stream
