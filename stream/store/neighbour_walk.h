/// Goes through a chunk's points with their neighbours, searching once for groups of consecutive points. Internal to stream/store.
#pragma once
#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <utility>
#include <vector>

#include "stream/store/near_select.h"
#include "stream/store/neighbours.h"
#include "stream/store/surfel_fit.h"

namespace chiaro::stream {

// In a random sample of a surface with one point per spacing^2 the sixth neighbour lies at sqrt(6 / pi) spacings.
inline constexpr float kSixthInSpacings = 1.3820f;
inline constexpr int kMostGrowth = 3;

using NearestSquared = std::array<float, kNearest>;

inline float mean_distance(const NearestSquared& nearest_squared) {
  float sum = 0;
  int n = 0;
  for (const float d : nearest_squared) {
    if (!std::isfinite(d)) break;
    sum += std::sqrt(d);
    ++n;
  }
  return n > 0 ? sum / static_cast<float>(n) : 0;
}

/// Neighbours of one point as offsets from it; points on the same spot are not among them.
struct NeighbourList {
  std::vector<float> x, y, z;
  std::vector<float> distance_squared;
  std::vector<std::uint32_t> candidate;
  NearestSquared nearest_squared{};
  float radius = 0;       ///< all neighbours within it are here, up to the maximum number
  std::size_t total = 0;  ///< how many lie within it
  std::size_t size() const { return x.size(); }
  Vec3f offset(std::size_t k) const { return {x[k], y[k], z[k]}; }
  void resize(std::size_t n) {
    x.resize(n);
    y.resize(n);
    z.resize(n);
    distance_squared.resize(n);
    candidate.resize(n);
  }
  void set(std::size_t at, float dx, float dy, float dz, float d, std::uint32_t k) {
    x[at] = dx;
    y[at] = dy;
    z[at] = dz;
    distance_squared[at] = d;
    candidate[at] = k;
  }
};

/// Consecutive points begin ... end that are fitted together.
struct SearchGroup {
  std::uint32_t begin = 0, end = 0;
  HaloChunk::FlatBox box{};
  LanePoints points;     ///< the last one repeated
  Nearest nearest;       ///< those that the first search found
  LaneFloats sixth{}, mean{};   ///< distance of the last and of all of these
  LaneFloats radius{};   ///< within which each one's neighbours lie; 0 if that is not known
  float most = 0;        ///< largest radius
  std::size_t size() const { return end - begin; }
  NearestSquared nearest_of(std::size_t lane) const {
    NearestSquared d;
    for (std::size_t k = 0; k < kNearest; ++k) d[k] = nearest.squared[k][lane];
    return d;
  }
};
static_assert(HaloChunk::kGroup == kLanes);

/// Goes through a chunk in groups of consecutive points that share a search. The six nearest are looked for within kNearShare of the usual radius of the
/// neighbourhood; they say how far each point looks. Fit answers: if kFitsGroups, fit_group() fits what it can of a group from two views, of all points within
/// kInnerShare of the largest radius at least, and of the others within it; else fit_nearest() from a view of all points up to a distance, and one of the others up
/// to kWideShare of the usual radius, both without normals where positions_tell_all().
/// A Fit with wants() is asked before each search. Where these refuse, fit_near() fits a point from a view of all its neighbours, with their numbers among the candidates; then fit_one() from a complete
/// list, or it refuses too and gets a larger one.
template <class Fit>
class Walker {
 public:
  Walker(Neighbourhood& around, const FitOptions& options, Fit& fit) : around_(around), own_(around.own()), options_(options), fit_(fit) {}

  void run() {
    guess_ = first_guess();
    for (std::uint32_t begin = 0; begin < own_.size;) {
      const std::uint32_t end = run_end(begin, kRun, 8 * guess_, group_.box);
      if (!wanted(begin, end)) {
        begin = end;
        continue;
      }
      run_radius_ = clamped(kRunShare * guess_);
      around_.gather(group_.box, run_radius_, Fit::kNeedsNormals, of_run_);
      if constexpr (!Fit::kFitsGroups) positions_tell_all_ = fit_.positions_tell_all(begin, of_run_.renumbered());
      while (begin < end) {
        const std::uint32_t group_end = std::min(end, run_end(begin, kLanes, 3 * guess_, group_.box));
        if (wanted(begin, group_end)) run_group(begin, group_end);
        begin = group_end;
      }
    }
  }

 private:
  bool wanted(std::uint32_t begin, std::uint32_t end) const {
    if constexpr (requires { fit_.wants(begin, end); }) return fit_.wants(begin, end);
    else return true;
  }

  float clamped(float radius) const { return std::clamp(radius, options_.max_radius * 1e-6f, options_.max_radius); }

  float first_guess() const {
    const HaloChunk::FlatBox& b = own_.bounds;
    float edges[3] = {b.max[0] - b.min[0], b.max[1] - b.min[1], b.max[2] - b.min[2]};
    std::sort(edges, edges + 3);
    const float spacing = std::sqrt(edges[2] * std::max(edges[1], edges[2] * 0.01f) / static_cast<float>(own_.size));
    return clamped(spacing * static_cast<float>(options_.radius_spacings));
  }

  static float extent(const HaloChunk::FlatBox& box) { return std::max({box.max[0] - box.min[0], box.max[1] - box.min[1], box.max[2] - box.min[2]}); }

  static HaloChunk::FlatBox joined(const HaloChunk::FlatBox& a, const HaloChunk::FlatBox& b) {
    HaloChunk::FlatBox box;
    for (std::size_t i = 0; i < 3; ++i) {
      box.min[i] = std::min(a.min[i], b.min[i]);
      box.max[i] = std::max(a.max[i], b.max[i]);
    }
    return box;
  }

  // Consecutive points share one search while they stay within a few search radii: at most `most` of them, up to the next multiple of it.
  std::uint32_t run_end(std::uint32_t begin, std::uint32_t most, float most_extent, HaloChunk::FlatBox& box) const {
    const std::uint32_t last = std::min(own_.size, (begin / most + 1) * most);
    box = {{own_.x[begin], own_.y[begin], own_.z[begin]}, {own_.x[begin], own_.y[begin], own_.z[begin]}};
    for (std::uint32_t end = begin;;) {
      // The boxes of whole groups are known.
      const bool whole = end % kLanes == 0 && end + kLanes <= last;
      const HaloChunk::FlatBox next = whole ? own_.box_of_group(end / kLanes) : HaloChunk::FlatBox{{own_.x[end], own_.y[end], own_.z[end]}, {own_.x[end], own_.y[end], own_.z[end]}};
      HaloChunk::FlatBox grown = joined(box, next);
      if (extent(grown) <= most_extent) {
        box = grown;
        end += whole ? kLanes : 1;
        if (end == last) return end;
        continue;
      }
      if (!whole) return std::max(end, begin + 1);
      for (;; ++end) {
        grown = joined(box, {{own_.x[end], own_.y[end], own_.z[end]}, {own_.x[end], own_.y[end], own_.z[end]}});
        if (extent(grown) > most_extent) return std::max(end, begin + 1);
        box = grown;
      }
    }
  }

  // All points within the radius of the group's box, and more: those around the run where these reach as far.
  const Selection& around_group(float radius) {
    if (radius <= run_radius_) return of_run_;
    around_.gather(group_.box, radius, Fit::kNeedsNormals, of_group_);
    return of_group_;
  }

  /// The same, without their normals if these tell nothing.
  CandidateView candidates(float radius) {
    const Selection& around = around_group(radius);
    CandidateView view = around.renumbered();
    if (&around == &of_run_ ? positions_tell_all_ : fit_.positions_tell_all(group_.begin, view)) view.nx = view.ny = view.nz = nullptr;
    return view;
  }

  void run_group(std::uint32_t begin, std::uint32_t end) {
    group_.begin = begin;
    group_.end = end;
    set_points();
    const float near = Fit::kNearShare * guess_;
    const HaloChunk::FlatBox& box = group_.box;
    std::array<bool, kLanes> fitted{};
    if constexpr (Fit::kFitsGroups) {
      // Nearly all points will need all their neighbours.
      const float mostly = kMostlyEnough * guess_;
      split_near_box(around_group(mostly).renumbered(), box.min, box.max, near * near, mostly * mostly, nearer_, farther_);
      look_at_nearest(near);
      if (group_.most > 0) {
        const float inner = Fit::kInnerShare * group_.most;
        if (group_.most > mostly || inner > near) split_near_box(around_group(group_.most).renumbered(), box.min, box.max, inner * inner, group_.most * group_.most, nearer_, farther_);
        else {
          std::swap(farther_, all_);
          select_near_box(all_.view(), box.min, box.max, group_.most * group_.most, false, farther_);
        }
        fit_.fit_group(group_, nearer_.view(), farther_.view(), fitted);
      }
    } else {
      const float wide = Fit::kWideShare * guess_;
      split_near_box(candidates(wide), box.min, box.max, near * near, wide * wide, nearer_, farther_);
      look_at_nearest(near);
      fit_.fit_nearest(group_, nearer_.view(), near, farther_.view(), wide, fitted);
      group_.most = 0;
      for (std::size_t at = 0; at < group_.size(); ++at)
        if (!fitted[at]) group_.most = std::max(group_.most, group_.radius[at]);
    }
    fit_others(fitted, near);
  }

  void set_points() {
    const auto copy = [&](const std::vector<float>& from, LaneFloats& to) {
      if (group_.size() == kLanes) return static_cast<void>(std::copy_n(&from[group_.begin], kLanes, to.begin()));
      for (std::uint32_t lane = 0; lane < kLanes; ++lane) to[lane] = from[std::min(group_.begin + lane, group_.end - 1)];
    };
    copy(own_.x, group_.points.x);
    copy(own_.y, group_.points.y);
    copy(own_.z, group_.points.z);
  }

  // How far each point of the group looks, where six others lie within `near`.
  void look_at_nearest(float near) {
    nearest_of(nearer_.view(), group_.points, group_.nearest);
    distances_of(group_.nearest, group_.sixth, group_.mean);
    const float share = static_cast<float>(options_.radius_spacings) / kSixthInSpacings;
    for (std::size_t lane = 0; lane < kLanes; ++lane) {
      const float radius = group_.sixth[lane] * share;
      group_.radius[lane] = group_.sixth[lane] <= near && radius <= options_.max_radius ? radius : 0;
    }
    group_.most = *std::max_element(group_.radius.begin(), group_.radius.end());
  }

  void fit_others(const std::array<bool, kLanes>& fitted, float near) {
    const Selection* numbered = nullptr;
    float sum = 0;
    for (std::uint32_t at = 0; at < group_.size(); ++at) {
      float radius = group_.radius[at];
      if (!fitted[at]) {
        if (radius > 0 && !numbered) {
          numbered = &around_group(group_.most);
          select_near_box(numbered->renumbered(), group_.box.min, group_.box.max, group_.most * group_.most, true, all_);
        }
        if (radius == 0 || !fit_.fit_near(group_, at, all_.view(), *numbered)) radius = search_carefully(group_.begin + at, group_.sixth[at], near);
      }
      sum += radius;
    }
    guess_ = clamped(sum / static_cast<float>(group_.size()));  // the next group is probably as dense as this one
  }

  // The search radius grows until the wanted neighbours are certain. Returns that radius. sixth: distance of the sixth neighbour if that is within `near`.
  float search_carefully(std::uint32_t i, float sixth, float near) {
    const HaloChunk::FlatBox box{{own_.x[i], own_.y[i], own_.z[i]}, {own_.x[i], own_.y[i], own_.z[i]}};
    float radius = 2 * guess_;
    if (sixth <= near) radius = 1.001f * sixth / kSixthInSpacings * static_cast<float>(options_.radius_spacings);
    for (int growth = 0;;) {
      radius = std::min(radius, options_.max_radius);
      const bool at_limit = radius >= options_.max_radius;
      around_.gather(box, radius, Fit::kNeedsNormals, single_);
      collect(i, radius);
      if (near_.size() < kNearest && !at_limit) {
        radius *= 2;
        continue;
      }
      const std::size_t found = std::min(kNearest, near_.size());
      std::partial_sort(near_.begin(), near_.begin() + static_cast<std::ptrdiff_t>(found), near_.end());
      list_.nearest_squared.fill(std::numeric_limits<float>::infinity());
      for (std::size_t k = 0; k < found; ++k) list_.nearest_squared[k] = near_[k].first;
      float wanted = options_.max_radius;
      if (found == kNearest) wanted = std::ldexp(std::sqrt(near_[kNearest - 1].first) / kSixthInSpacings * static_cast<float>(options_.radius_spacings), growth);
      if (wanted > radius && !at_limit) {
        radius = wanted;
        continue;
      }
      fill(std::min(wanted, options_.max_radius), i);
      if (fit_.fit_one(i, list_, single_, growth == kMostGrowth || at_limit)) return list_.radius;
      ++growth;
      radius = 2 * wanted;
    }
  }

  void collect(std::uint32_t i, float radius) {
    near_.clear();
    for (std::size_t k = 0; k < single_.num; ++k) {
      const float dx = single_.x[k] - own_.x[i], dy = single_.y[k] - own_.y[i], dz = single_.z[k] - own_.z[i];
      const float d = dx * dx + dy * dy + dz * dz;
      if (d > 0 && d <= radius * radius) near_.emplace_back(d, static_cast<std::uint32_t>(k));
    }
  }

  void fill(float wanted, std::uint32_t i) {
    const auto end = std::partition(near_.begin(), near_.end(), [&](const auto& item) { return item.first <= wanted * wanted; });
    near_.erase(end, near_.end());
    list_.total = near_.size();
    if (near_.size() > options_.most) {
      std::nth_element(near_.begin(), near_.begin() + static_cast<std::ptrdiff_t>(options_.most), near_.end());
      near_.resize(options_.most);
    }
    list_.resize(near_.size());
    for (std::size_t at = 0; at < near_.size(); ++at) {
      const auto [d, k] = near_[at];
      list_.set(at, single_.x[k] - own_.x[i], single_.y[k] - own_.y[i], single_.z[k] - own_.z[i], d, k);
    }
    list_.radius = wanted;
  }

  Neighbourhood& around_;
  const HaloChunk& own_;
  const FitOptions& options_;
  Fit& fit_;
  static constexpr std::uint32_t kRun = 64;     // points that share a search in the leaves; groups then search in what it found
  static constexpr float kRunShare = Fit::kRunShare, kMostlyEnough = 1.2f;
  float guess_ = 0, run_radius_ = 0;
  bool positions_tell_all_ = false;        // the normals around the run can be left out
  Selection of_run_, of_group_, single_;   // as gathered: known by their place here
  Selection nearer_, farther_, all_;
  SearchGroup group_;
  std::vector<std::pair<float, std::uint32_t>> near_;
  NeighbourList list_;
};

}  // namespace chiaro::stream
