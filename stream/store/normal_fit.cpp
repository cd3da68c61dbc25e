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
constexpr double kSurprise = 2.7;       // standard deviations by which the residuals of a wider plane may stand out over the narrowest one's

/// A dozen points tell the noise of a scan to within a third: one narrow plane in four seems flatter by chance than its surroundings are, and none of the wider ones
/// would be taken then. How noisy the scan is can be told much better from a whole leaf: the lower part of the narrow planes lie on flat ground.
constexpr std::size_t kNoiseGroups = 32;    // of a leaf, evenly spread, that are asked
constexpr double kFlatShare = 0.3;          // of their points, the flattest
constexpr double kOfVariance = 0.70;        // that quantile of the variance of residuals, over the true one: nine degrees of freedom

/// The variance of residuals up to which a plane through so many neighbours is as flat as noise lets it be.
double flat_limit(double narrow_variance, double noise_variance, double neighbours) {
  return (1 + kSurprise * std::sqrt(2 / std::max(1.0, neighbours - 2))) * std::max(narrow_variance, noise_variance);
}

LaneFloats limits_of(const SearchGroup& group, std::size_t scale) {
  LaneFloats limit;
  for (std::size_t lane = 0; lane < kLanes; ++lane) {
    const float radius = kScaleOfRadius[scale] * group.radius[lane];
    limit[lane] = radius > 0 ? radius * radius : -1;
  }
  return limit;
}

/// What all that looks for planes here asks of a walk.
struct PlaneWalk {
  static constexpr bool kNeedsNormals = false, kFitsGroups = true;
  // The sixth neighbour is at 0.39 of the radius; this finds it for all but few points whose surroundings are sparser than the mean.
  static constexpr float kNearShare = 0.7f, kRunShare = 1.4f, kInnerShare = kScaleOfRadius[kScales - 1];
};

/// Residuals of narrow planes in some groups of a leaf.
class NoiseSampler : public PlaneWalk {
 public:
  explicit NoiseSampler(const HaloChunk& own) : stride_(std::max<std::size_t>(1, own.size / (kLanes * kNoiseGroups)) * kLanes) {}

  /// Groups that begin at a multiple of the stride. Runs of groups are asked, too.
  bool wants(std::uint32_t begin, std::uint32_t end) const { return (begin + stride_ - 1) / stride_ * stride_ < end; }
  void fit_group(const SearchGroup& group, const CandidateView& nearer, const CandidateView&, std::array<bool, kLanes>& fitted) {
    LaneMoments sums;
    add_moments(nearer, group.points, limits_of(group, kScales - 1), sums);
    planes_of(sums, planes_);
    for (std::size_t lane = 0; lane < group.size(); ++lane)
      if (group.radius[lane] > 0 && planes_.sure[lane]) variances_.push_back(planes_.variance_off[lane]);
    fitted.fill(true);
  }
  bool fit_near(const SearchGroup&, std::size_t, const CandidateView&, const Selection&) { return true; }
  bool fit_one(std::uint32_t, const NeighbourList&, const Selection&, bool) { return true; }

  /// 0 where too few tell.
  double noise_variance() {
    constexpr std::size_t kEnough = 64;
    if (variances_.size() < kEnough) return 0;
    const auto at = variances_.begin() + static_cast<std::ptrdiff_t>(kFlatShare * static_cast<double>(variances_.size()));
    std::nth_element(variances_.begin(), at, variances_.end());
    return *at / kOfVariance;
  }

 private:
  std::size_t stride_;
  LanePlanes planes_;
  std::vector<double> variances_;
};

/// The moments at each of the scales; only those that are asked for are summed. Floats lose a millionth, but products of two need care where the plane is
/// thin: at worst some 0.001 degrees.
template <class MomentsAt>
Plane plane_of_scales(const MomentsAt& moments_at, double noise_variance, bool& rough) {
  std::size_t narrowest = kScales;
  Moments m;
  do m = moments_at(--narrowest);
  while (narrowest > 0 && m[9] < kEnoughForPlane);
  Plane best = plane_of(m);
  rough = false;
  if (narrowest == 0) return best;
  if (best.line || best.isolated) return plane_of(moments_at(0));
  for (std::size_t s = 0; s < narrowest; ++s) {  // the widest first: on flat ground it is the answer
    const Moments sums = moments_at(s);
    const Plane wider = plane_of(sums);
    if (!wider.line && !wider.isolated && wider.variance_off <= flat_limit(best.variance_off, noise_variance, sums[9])) return wider;
    rough = true;
  }
  return best;
}

class NormalFitter : public PlaneWalk {
 public:
  NormalFitter(const HaloChunk& own, const FitOptions& options, double noise_variance, std::vector<NormalFit>& fits)
      : own_(own), options_(options), noise_variance_(noise_variance), fits_(fits) {}

  /// What plane_of_scales() does, for the points of a group that have enough neighbours around them. Only `nearer` has those of the narrowest scale.
  void fit_group(const SearchGroup& group, const CandidateView& nearer, const CandidateView& farther, std::array<bool, kLanes>& fitted) {
    LaneMoments wide_sums;
    const LaneFloats wide_limits = limits_of(group, 0);
    add_moments(nearer, group.points, wide_limits, wide_sums);
    add_moments(farther, group.points, wide_limits, wide_sums);
    planes_of(wide_sums, planes_);
    // Where the widest plane is as flat as the noise lets it be, it is the answer, whatever the narrower ones are like: nearly everywhere.
    unsigned open = 0, sure = 0xffff, rough = 0;
    for (std::size_t lane = 0; lane < kLanes; ++lane) open |= static_cast<unsigned>(!as_flat(lane, wide_sums, 0)) << lane;
    if (open != 0) rough = take_narrower(group, nearer, farther, wide_sums, open, sure);
    normals_of(planes_, normals_);
    for (std::size_t lane = 0; lane < group.size(); ++lane) {
      const bool all = group.radius[lane] > 0 && wide_sums.sum[kTerms - 1][lane] <= static_cast<float>(options_.most + 1);
      if (!all || (sure >> lane & 1) == 0 || !normals_.clear[lane]) continue;
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
    const Plane plane = plane_of_scales([&](std::size_t s) { return moments_within(row_, radius * radius * kScaleOfRadius[s] * kScaleOfRadius[s]); }, noise_variance_, rough);
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
    const Plane plane = plane_of_scales(moments_at, noise_variance_, rough);
    if (plane.line && !last) return false;
    set(i, plane, rough);
    return true;
  }

 private:
  bool as_flat(std::size_t lane, const LaneMoments& of, double narrow_variance) const {
    return planes_.sure[lane] && planes_.variance_off[lane] <= flat_limit(narrow_variance, noise_variance_, static_cast<double>(of.sum[kTerms - 1][lane]) - 1);
  }

  /// For the open lanes: the widest plane that is as flat as the narrowest. Returns those for which it is not the widest of all; clears in `sure` those without
  /// a narrowest one.
  unsigned take_narrower(const SearchGroup& group, const CandidateView& nearer, const CandidateView& farther, const LaneMoments& wide_sums, unsigned open, unsigned& sure) {
    LaneMoments sums;
    add_moments(nearer, group.points, limits_of(group, kScales - 1), sums);
    planes_of(sums, narrow_);
    unsigned rough = 0;
    for (std::size_t lane = 0; lane < kLanes; ++lane) {
      if ((open >> lane & 1) == 0) continue;
      if (!narrow_.sure[lane]) sure &= ~(1u << lane);
      rough |= static_cast<unsigned>(!as_flat(lane, wide_sums, narrow_.variance_off[lane])) << lane;
    }
    if (rough == 0) return rough;
    sums = {};
    const LaneFloats middle_limits = limits_of(group, 1);
    add_moments(nearer, group.points, middle_limits, sums);
    add_moments(farther, group.points, middle_limits, sums);
    planes_of(sums, middle_);
    for (std::size_t lane = 0; lane < kLanes; ++lane) {
      if ((rough >> lane & 1) == 0) continue;
      planes_.take(lane, middle_);
      if (!as_flat(lane, sums, narrow_.variance_off[lane])) planes_.take(lane, narrow_);
    }
    return rough;
  }

  void set(std::size_t i, const Plane& plane, bool rough) {
    fits_[i] = normal_of(plane);
    fits_[i].rough = rough && !fits_[i].isolated;
  }

  const HaloChunk& own_;
  const FitOptions& options_;
  double noise_variance_;
  std::vector<NormalFit>& fits_;
  LanePlanes narrow_, middle_, planes_;
  LaneNormals normals_;
  NeighbourRow row_;
};

}  // namespace

void fit_normals_of(Neighbourhood& around, const FitOptions& options, std::vector<NormalFit>& fits) {
  fits.assign(around.own().size, {});
  NoiseSampler noise(around.own());
  Walker<NoiseSampler>(around, options, noise).run();
  NormalFitter fitter(around.own(), options, noise.noise_variance(), fits);
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
