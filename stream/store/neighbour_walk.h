/// Goes through a chunk's points with their neighbours, searching once for groups of consecutive points. Internal to stream/store.
#pragma once
#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <utility>
#include <vector>

#include "stream/store/near_kernels.h"
#include "stream/store/neighbours.h"
#include "stream/store/surfel_fit.h"

namespace chiaro::stream {

// In a random sample of a surface with one point per spacing^2 the sixth neighbour lies at sqrt(6 / pi) spacings.
inline constexpr float kSixthInSpacings = 1.3820f;
inline constexpr int kMostGrowth = 3;

inline CandidateView view_of(const Candidates& c) { return {c.x.data(), c.y.data(), c.z.data(), c.num}; }

inline float mean_distance(const std::array<float, kNearest>& nearest_squared) {
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
  std::array<float, kNearest> nearest_squared{};
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
  std::array<EightPoints, HaloChunk::kGroup / kLanes> points;   ///< the last one repeated
  std::array<HaloChunk::FlatBox, HaloChunk::kGroup / kLanes> boxes;   ///< of eight points each
  std::array<float, HaloChunk::kGroup> radius{};                ///< within which each one's neighbours lie; 0 if that is not known
  float most = 0;                                               ///< largest radius
};

/// Goes through a chunk in groups of consecutive points that share a search. Fit answers: fit_nearest() fits a point from a view that holds all points up to a
/// distance, kNearShare of the usual radius of the neighbourhood, or refuses; fit_group(), if kFitsGroups, fits what it can of a group from a view that holds
/// all neighbours; fit_near() a point from such a view, with their numbers among the candidates, or refuses; fit_one() fits one from a complete list, or
/// refuses and gets a larger one.
template <class Fit>
class Walker {
 public:
  Walker(Neighbourhood& around, const FitOptions& options, Fit& fit) : around_(around), own_(around.own()), options_(options), fit_(fit) {}

  void run() {
    guess_ = first_guess();
    for (std::uint32_t begin = 0; begin < own_.size;) {
      const std::uint32_t end = run_end(begin, kRun, 8 * guess_, run_box_);
      run_radius_ = clamped(kRunShare * guess_);
      around_.gather(run_box_, run_radius_, Fit::kNeedsNormals, of_run_);
      while (begin < end) {
        const std::uint32_t group_end = std::min(end, run_end(begin, HaloChunk::kGroup, 3 * guess_, box_));
        run_group(begin, group_end);
        begin = group_end;
      }
    }
  }

 private:
  float clamped(float radius) const { return std::clamp(radius, options_.max_radius * 1e-6f, options_.max_radius); }

  float first_guess() const {
    const HaloChunk::FlatBox& b = own_.bounds;
    float edges[3] = {b.max[0] - b.min[0], b.max[1] - b.min[1], b.max[2] - b.min[2]};
    std::sort(edges, edges + 3);
    const float spacing = std::sqrt(edges[2] * std::max(edges[1], edges[2] * 0.01f) / static_cast<float>(own_.size));
    return clamped(spacing * static_cast<float>(options_.radius_spacings));
  }

  // Consecutive points share one search while they stay within a few search radii: at most `most` of them, up to the next multiple of it.
  std::uint32_t run_end(std::uint32_t begin, std::uint32_t most, float most_extent, HaloChunk::FlatBox& box) const {
    box = {{own_.x[begin], own_.y[begin], own_.z[begin]}, {own_.x[begin], own_.y[begin], own_.z[begin]}};
    const std::uint32_t last = std::min(own_.size, (begin / most + 1) * most);
    std::uint32_t end = begin + 1;
    for (; end < last; ++end) {
      HaloChunk::FlatBox grown = box;
      const float p[3] = {own_.x[end], own_.y[end], own_.z[end]};
      float extent = 0;
      for (std::size_t a = 0; a < 3; ++a) {
        grown.min[a] = std::min(grown.min[a], p[a]);
        grown.max[a] = std::max(grown.max[a], p[a]);
        extent = std::max(extent, grown.max[a] - grown.min[a]);
      }
      if (extent > most_extent) break;
      box = grown;
    }
    return end;
  }

  // All points within the radius of the group's box, from those around the run where these reach as far; and what their numbers count.
  CandidateView near_group(float radius, const Candidates*& numbered) {
    if (radius <= run_radius_) {
      select_near_box(view_of(of_run_), box_.min, box_.max, radius * radius, selection_);
      numbered = &of_run_;
      return selection_.view();
    }
    around_.gather(box_, radius, Fit::kNeedsNormals, of_group_);
    numbered = &of_group_;
    return view_of(of_group_);
  }

  // First the six nearest, which say how far each point looks; then the points within the largest of these distances, for the whole group.
  void run_group(std::uint32_t begin, std::uint32_t end) {
    const float near = Fit::kNearShare * guess_;
    const Candidates* numbered = nullptr;
    // Where all points will need them, all neighbours at once.
    const float at_once = Fit::kFitsGroups ? kMostlyEnough * guess_ : near;
    CandidateView view = near_group(at_once, numbered);
    group_.begin = begin;
    group_.end = end;
    group_.box = box_;
    group_.radius.fill(0);
    group_.most = 0;
    Nearest nearest;
    std::array<std::array<float, kNearest>, HaloChunk::kGroup> squared;
    std::array<bool, HaloChunk::kGroup> fitted{};
    float sum = 0;
    for (std::uint32_t first = begin; first < end; first += kLanes) {
      EightPoints& points = group_.points[(first - begin) / kLanes];
      HaloChunk::FlatBox& box = group_.boxes[(first - begin) / kLanes];
      points = eight_points(first, end);
      box = box_of(points);
      select_near_box(view, box.min, box.max, near * near, nearer_);
      nearest_of(nearer_.view(), points, nearest);
      for (std::uint32_t i = first; i < std::min(end, first + kLanes); ++i) {
        const std::uint32_t at = i - begin;
        for (std::size_t k = 0; k < kNearest; ++k) squared[at][k] = nearest.squared[k][i - first];
        const float sixth = squared[at][kNearest - 1];
        const float radius = std::sqrt(sixth) / kSixthInSpacings * static_cast<float>(options_.radius_spacings);
        if (!(sixth <= near * near) || !(radius <= options_.max_radius)) continue;
        group_.radius[at] = radius;
        fitted[at] = fit_.fit_nearest(i, squared[at], nearer_.view(), *numbered, radius, near);
        if (!fitted[at]) group_.most = std::max(group_.most, radius);
      }
    }
    if (group_.most > 0) {
      if (group_.most > at_once) view = near_group(group_.most, numbered);
      if constexpr (Fit::kFitsGroups) fit_.fit_group(group_, view, fitted);
    }
    for (std::uint32_t i = begin; i < end; ++i) {
      const std::uint32_t at = i - begin;
      float& radius = group_.radius[at];
      if (!fitted[at] && (radius == 0 || !fit_.fit_near(i, squared[at], view, *numbered, radius))) radius = search_carefully(i, std::sqrt(squared[at][kNearest - 1]), near);
      sum += radius;
    }
    guess_ = clamped(sum / static_cast<float>(end - begin));  // the next group is probably as dense as this one
  }

  EightPoints eight_points(std::uint32_t first, std::uint32_t end) const {
    EightPoints p;
    for (std::uint32_t lane = 0; lane < kLanes; ++lane) {
      const std::uint32_t i = std::min(first + lane, end - 1);
      p.x[lane] = own_.x[i];
      p.y[lane] = own_.y[i];
      p.z[lane] = own_.z[i];
    }
    return p;
  }

  static HaloChunk::FlatBox box_of(const EightPoints& p) {
    const auto [x0, x1] = std::minmax_element(p.x.begin(), p.x.end());
    const auto [y0, y1] = std::minmax_element(p.y.begin(), p.y.end());
    const auto [z0, z1] = std::minmax_element(p.z.begin(), p.z.end());
    return {{*x0, *y0, *z0}, {*x1, *y1, *z1}};
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
  static constexpr float kRunShare = 1.4f, kMostlyEnough = 1.2f;
  float guess_ = 0, run_radius_ = 0;
  HaloChunk::FlatBox run_box_{}, box_{};
  Candidates of_run_, of_group_, single_;
  Selection selection_, nearer_;
  SearchGroup group_;
  std::vector<std::pair<float, std::uint32_t>> near_;
  NeighbourList list_;
};

}  // namespace chiaro::stream
