#include "stream/store/surfel_fit.h"

#include <Eigen/Eigenvalues>
#include <algorithm>
#include <array>
#include <cmath>
#include <limits>

#include "stream/store/near_kernels.h"

namespace chiaro::stream {
namespace {

using FlatBox = HaloChunk::FlatBox;

// In a random sample of a surface with one point per spacing^2 the sixth neighbour lies at sqrt(6 / pi) spacings.
constexpr float kSixthInSpacings = 1.3820f;
constexpr int kMostGrowth = 3;

CandidateView view_of(const Candidates& c) { return {c.x.data(), c.y.data(), c.z.data(), c.num}; }

float mean_distance(const std::array<float, kNearest>& nearest_squared) {
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

/// Goes through a chunk in groups of consecutive points that share a search. Fit answers: fit_nearest() fits a point from a view that holds all points up to a
/// distance, kNearShare of the usual radius of the neighbourhood, or refuses; fit_near() from a view that holds all its neighbours, with their numbers among
/// the candidates, or refuses; fit_one() fits one from a complete list, or refuses and gets a larger one.
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
    const FlatBox& b = own_.bounds;
    float edges[3] = {b.max[0] - b.min[0], b.max[1] - b.min[1], b.max[2] - b.min[2]};
    std::sort(edges, edges + 3);
    const float spacing = std::sqrt(edges[2] * std::max(edges[1], edges[2] * 0.01f) / static_cast<float>(own_.size));
    return clamped(spacing * static_cast<float>(options_.radius_spacings));
  }

  // Consecutive points share one search while they stay within a few search radii: at most `most` of them, up to the next multiple of it.
  std::uint32_t run_end(std::uint32_t begin, std::uint32_t most, float most_extent, FlatBox& box) const {
    box = {{own_.x[begin], own_.y[begin], own_.z[begin]}, {own_.x[begin], own_.y[begin], own_.z[begin]}};
    const std::uint32_t last = std::min(own_.size, (begin / most + 1) * most);
    std::uint32_t end = begin + 1;
    for (; end < last; ++end) {
      FlatBox grown = box;
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
    CandidateView view = near_group(near, numbered);
    std::array<Nearest, HaloChunk::kGroup / kLanes> nearest;
    std::array<float, HaloChunk::kGroup> wanted{};
    std::array<std::array<float, kNearest>, HaloChunk::kGroup> squared;
    std::array<bool, HaloChunk::kGroup> fitted{};
    float most = 0, sum = 0;
    for (std::uint32_t first = begin; first < end; first += kLanes) {
      Nearest& n = nearest[(first - begin) / kLanes];
      nearest_of(view, eight_points(first, end), n);
      for (std::uint32_t i = first; i < std::min(end, first + kLanes); ++i) {
        const std::uint32_t at = i - begin;
        for (std::size_t k = 0; k < kNearest; ++k) squared[at][k] = n.squared[k][i - first];
        const float sixth = squared[at][kNearest - 1];
        const float radius = std::sqrt(sixth) / kSixthInSpacings * static_cast<float>(options_.radius_spacings);
        if (!(sixth <= near * near) || !(radius <= options_.max_radius)) continue;
        wanted[at] = radius;
        fitted[at] = fit_.fit_nearest(i, squared[at], view, *numbered, radius, near);
        if (!fitted[at]) most = std::max(most, radius);
      }
    }
    if (most > 0) view = near_group(most, numbered);
    for (std::uint32_t i = begin; i < end; ++i) {
      const std::uint32_t at = i - begin;
      float& radius = wanted[at];
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

  // The search radius grows until the wanted neighbours are certain. Returns that radius. sixth: distance of the sixth neighbour if that is within `near`.
  float search_carefully(std::uint32_t i, float sixth, float near) {
    const FlatBox box{{own_.x[i], own_.y[i], own_.z[i]}, {own_.x[i], own_.y[i], own_.z[i]}};
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
  static constexpr std::uint32_t kRun = 128;     // points that share a search in the leaves; groups then search in what it found
  static constexpr float kRunShare = 1.4f;
  float guess_ = 0, run_radius_ = 0;
  FlatBox run_box_{}, box_{};
  Candidates of_run_, of_group_, single_;
  Selection selection_;
  std::vector<std::pair<float, std::uint32_t>> near_;
  NeighbourList list_;
};

// Any unit vector across v.
Vec3f across(const Vec3f& v) {
  const Vec3f axis = std::abs(v.z()) < 0.9f * v.norm() ? Vec3f::UnitZ() : Vec3f::UnitX();
  return v.cross(axis).normalized();
}

/// Eigenvalues of a symmetric matrix of trace 1 that has none below zero, smallest first.
///
/// The smallest root of the characteristic polynomial by Newton's method: the polynomial rises and is concave up to it, so steps from 0 never pass it.
Vec3d eigenvalues_of(const Mat3d& a) {
  const double c1 = a(0, 0) * a(1, 1) - a(0, 1) * a(0, 1) + a(0, 0) * a(2, 2) - a(0, 2) * a(0, 2) + a(1, 1) * a(2, 2) - a(1, 2) * a(1, 2);
  const double c0 = a.determinant();
  double root = 0;
  for (int i = 0; i < 30; ++i) {
    const double slope = c1 + root * (3 * root - 2);
    if (!(slope > 1e-12)) break;
    const double step = (c0 - root * (c1 + root * (root - 1))) / slope;
    root += step;
    if (!(step > 1e-5 * root)) break;  // the next one would be about the square of it
  }
  const double sum = 1 - root, product = std::max(0.0, c1 - root * sum);
  const double largest = 0.5 * (sum + std::sqrt(std::max(0.0, sum * sum - 4 * product)));
  return {root, product / largest, largest};
}

// Much faster than a general solver; where two roots fall together the axis is not defined well and the general solver decides.
Vec3d smallest_axis_of(const Mat3d& a, double root) {
  Mat3d b = a;
  for (int i = 0; i < 3; ++i) b(i, i) -= root;
  const Vec3d crosses[3] = {b.col(0).cross(b.col(1)), b.col(0).cross(b.col(2)), b.col(1).cross(b.col(2))};
  const double norms[3] = {crosses[0].squaredNorm(), crosses[1].squaredNorm(), crosses[2].squaredNorm()};
  const std::size_t best = norms[0] >= norms[1] ? (norms[0] >= norms[2] ? 0 : 2) : (norms[1] >= norms[2] ? 1 : 2);
  if (norms[best] > 1e-14) return crosses[best] / std::sqrt(norms[best]);
  return Eigen::SelfAdjointEigenSolver<Mat3d>(a).eigenvectors().col(0);
}

/// The plane through neighbours and point, as far as its fit must be known to be judged.
struct Plane {
  bool isolated = true;            ///< fewer than 3 neighbours, or all on a line
  bool line = false;
  double variance_off = 0;         ///< with the plane's three degrees of freedom taken off
  double scale = 0;
  Mat3d covariance;                ///< over scale
  Vec3d values, mean;
};

Plane plane_of(const Moments& sums) {
  Plane plane;
  const double n = sums[9];
  if (n < 3) return plane;
  std::array<double, 9> m;
  const double share = 1 / (n + 1);  // the point itself is the origin
  for (std::size_t i = 0; i < 9; ++i) m[i] = sums[i] * share;
  plane.covariance << m[3] - m[0] * m[0], m[4] - m[0] * m[1], m[5] - m[0] * m[2],
                      m[4] - m[0] * m[1], m[6] - m[1] * m[1], m[7] - m[1] * m[2],
                      m[5] - m[0] * m[2], m[7] - m[1] * m[2], m[8] - m[2] * m[2];
  plane.scale = plane.covariance.trace();
  if (!(plane.scale > 0)) return plane;
  plane.covariance *= 1 / plane.scale;
  plane.mean = {m[0], m[1], m[2]};
  plane.values = eigenvalues_of(plane.covariance);
  plane.line = plane.values[1] < 0.01 * plane.values[2];
  plane.isolated = plane.values[1] < 1e-4 * plane.values[2];
  plane.variance_off = std::max(0.0, plane.values[0]) * plane.scale * (n + 1) / std::max(1.0, n - 2);
  return plane;
}

NormalFit normal_of(const Plane& plane) {
  NormalFit fit;
  fit.isolated = plane.isolated;
  if (!(plane.scale > 0)) return fit;
  if (plane.isolated) {
    fit.normal = across(Eigen::SelfAdjointEigenSolver<Mat3d>(plane.covariance).eigenvectors().col(2).cast<float>());
    return fit;
  }
  const Vec3d normal = smallest_axis_of(plane.covariance, plane.values[0]);
  const double outwards = -normal.dot(plane.mean);
  const bool flip = std::abs(outwards) > 1e-9 * std::sqrt(plane.scale) ? outwards < 0 : normal.z() < 0;
  fit.normal = (flip ? -normal : normal).normalized().cast<float>();
  return fit;
}

/// Normals are fitted at three nested radii. The widest one that still fits a plane as well as the narrowest does is taken: wide on flat ground, where it
/// averages noise, narrow at edges and joints, which a wide one would round off (measured on the rendered tower, 0.8 mm of noise at 9 mm spacing, against
/// one radius of 3.5 spacings: 95 % of errors below 18 instead of 26 degrees, median 1.5 instead of 1.4).
constexpr std::size_t kScales = 3;
constexpr float kScaleOfRadius[kScales] = {1.0f, 0.74f, 0.57f};
constexpr double kPlaneGrowth = 1.35;   // residual of the wider plane over the narrowest one's that sampling alone explains
constexpr double kEnoughForPlane = 6;

/// The moments at each of the scales; only those that are asked for are summed. Floats lose a millionth, but products of two need care where the plane is
/// thin: at worst some 0.001 degrees.
template <class MomentsAt>
Plane plane_of_scales(const MomentsAt& moments_at) {
  std::size_t narrowest = kScales;
  Moments m;
  do m = moments_at(--narrowest);
  while (narrowest > 0 && m[9] < kEnoughForPlane);
  Plane best = plane_of(m);
  if (narrowest == 0) return best;
  if (best.line || best.isolated) return plane_of(moments_at(0));
  const double limit = kPlaneGrowth * kPlaneGrowth * best.variance_off;
  for (std::size_t s = 0; s < narrowest; ++s) {  // the widest first: on flat ground it is the answer
    const Plane wider = plane_of(moments_at(s));
    if (!wider.line && !wider.isolated && wider.variance_off <= limit) return wider;
  }
  return best;
}

class NormalFitter {
 public:
  static constexpr bool kNeedsNormals = false;
  // The sixth neighbour is at 0.39 of the radius; this finds it for all but few points whose surroundings are sparser than the mean.
  static constexpr float kNearShare = 0.6f;
  NormalFitter(const HaloChunk& own, const FitOptions& options, std::vector<NormalFit>& fits) : own_(own), options_(options), fits_(fits) {}

  bool fit_nearest(std::uint32_t, const std::array<float, kNearest>&, const CandidateView&, const Candidates&, float, float) { return false; }

  bool fit_near(std::uint32_t i, const std::array<float, kNearest>&, const CandidateView& view, const Candidates&, float radius) {
    collect_within(view, own_.x[i], own_.y[i], own_.z[i], radius * radius, row_);
    if (row_.num > options_.most) return false;
    const Plane plane = plane_of_scales([&](std::size_t s) { return moments_within(row_, radius * radius * kScaleOfRadius[s] * kScaleOfRadius[s]); });
    if (plane.line) return false;
    fits_[i] = normal_of(plane);
    return true;
  }

  bool fit_one(std::uint32_t i, const NeighbourList& list, const Candidates&, bool last) {
    const Plane plane = plane_of_scales([&](std::size_t s) {
      Moments m{};
      for (std::size_t k = 0; k < list.size(); ++k) {
        const double x = static_cast<double>(list.x[k]), y = static_cast<double>(list.y[k]), z = static_cast<double>(list.z[k]);
        const double terms[10] = {x, y, z, x * x, x * y, x * z, y * y, y * z, z * z, 1};
        if (list.distance_squared[k] > list.radius * list.radius * kScaleOfRadius[s] * kScaleOfRadius[s] && s > 0) continue;
        for (std::size_t t = 0; t < 10; ++t) m[t] += terms[t];
      }
      return m;
    });
    if (plane.line && !last) return false;
    fits_[i] = normal_of(plane);
    return true;
  }

 private:
  const HaloChunk& own_;
  const FitOptions& options_;
  std::vector<NormalFit>& fits_;
  NeighbourRow row_;
};

// A convex polygon around the origin of the tangent plane, clipped by half-planes. Fixed room: each cut adds at most one corner.
class TangentCell {
 public:
  explicit TangentCell(float half_size) : box_(half_size * 0.9999f) {
    corners_[0][0] = {-half_size, -half_size};
    corners_[0][1] = {half_size, -half_size};
    corners_[0][2] = {half_size, half_size};
    corners_[0][3] = {-half_size, half_size};
    size_ = 4;
    measure();
  }
  float farthest_squared() const { return farthest_squared_; }
  bool bounded() const { return bounded_; }
  float farthest_bounded_squared() const { return farthest_bounded_squared_; }
  /// Calls visit(x, y) for each corner of the cell.
  template <class Visit>
  void for_corners(const Visit& visit) const {
    for (int i = 0; i < size_; ++i) visit(corners_[now_][static_cast<std::size_t>(i)].x, corners_[now_][static_cast<std::size_t>(i)].y);
  }

  // Would clip() change anything?
  bool cuts(float u, float v, float distance) const {
    const Corner* corner = corners_[now_].data();
    float most = -1;
    for (int i = 0; i < size_; ++i) most = std::max(most, u * corner[i].x + v * corner[i].y);
    return most > distance;
  }

  // Keeps the points with x * u + y * v <= distance.
  void clip(float u, float v, float distance) {
    if (size_ + 1 >= kMost) return;
    std::array<float, kMost> side;
    const Corner* corner = corners_[now_].data();
    for (int i = 0; i < size_; ++i) side[i] = u * corner[i].x + v * corner[i].y - distance;
    Corner* kept = corners_[1 - now_].data();
    int n = 0;
    for (int i = 0; i < size_; ++i) {
      const int j = i + 1 == size_ ? 0 : i + 1;
      if (side[i] <= 0) kept[n++] = corner[i];
      if ((side[i] <= 0) != (side[j] <= 0)) {
        const float t = side[i] / (side[i] - side[j]);
        kept[n++] = {corner[i].x + t * (corner[j].x - corner[i].x), corner[i].y + t * (corner[j].y - corner[i].y)};
      }
    }
    now_ = 1 - now_;
    size_ = n;
    measure();
  }

 private:
  static constexpr int kMost = 40;
  struct Corner {
    float x, y;
  };
  void measure() {
    farthest_squared_ = farthest_bounded_squared_ = 0;
    bounded_ = true;
    const Corner* corner = corners_[now_].data();
    for (int i = 0; i < size_; ++i) {
      const float d = corner[i].x * corner[i].x + corner[i].y * corner[i].y;
      const bool open = std::max(std::abs(corner[i].x), std::abs(corner[i].y)) >= box_;
      farthest_squared_ = std::max(farthest_squared_, d);
      bounded_ &= !open;
      farthest_bounded_squared_ = std::max(farthest_bounded_squared_, open ? 0.0f : d);
    }
  }
  float box_;
  std::array<std::array<Corner, kMost>, 2> corners_;
  int now_ = 0, size_ = 0;
  float farthest_squared_ = 0, farthest_bounded_squared_ = 0;
  bool bounded_ = false;
};

class RadiusFitter {
 public:
  RadiusFitter(const HaloChunk& own, const FitOptions& options, std::vector<RadiusFit>& fits) : own_(own), options_(options), fits_(fits) {}

  static constexpr bool kNeedsNormals = true;
  static constexpr float kNearShare = 0.85f;

  // The nearest of the neighbours settle most cells: what is further than twice the farthest corner cuts nothing.
  bool fit_nearest(std::uint32_t i, const std::array<float, kNearest>& nearest_squared, const CandidateView& view, const Candidates& c, float radius, float near) {
    const float reach = std::min(near, kNearShare * radius);
    collect_within(view, own_.x[i], own_.y[i], own_.z[i], reach * reach, row_);
    return row_.num <= options_.most * 7 / 10 && fit_inside(i, nearest_squared, c, radius, reach);
  }

  bool fit_near(std::uint32_t i, const std::array<float, kNearest>& nearest_squared, const CandidateView& view, const Candidates& c, float radius) {
    collect_within(view, own_.x[i], own_.y[i], own_.z[i], radius * radius, row_);
    if (row_.num > options_.most) return false;
    if (fit_inside(i, nearest_squared, c, radius, kAllNeighbours)) return true;
    make_list(nearest_squared, radius);
    return fit_one(i, list_, c, false);
  }

  bool fit_one(std::uint32_t i, const NeighbourList& list, const Candidates& c, bool last) {
    if (!last && list.size() >= 3 && is_line(list)) return false;
    const float mean = mean_distance(list.nearest_squared);
    if (is_outlier(i, list)) fits_[i] = {std::min(mean, options_.lone_radius), mean, true};
    else {
      fits_[i].mean_of_nearest = mean;
      if (!(own_.flags[i] & SurfelBlock::kIsolated)) clip_at_edge(i, list, c);
      fits_[i].radius = fit(i, list, c);
    }
    return true;
  }

 private:
  static constexpr float kEdgeReach = 2.2f, kOtherFace = 0.82f;
  static constexpr float kAllNeighbours = 1e30f;

  // Near an evenly sampled surface the search finds pi * spacings^2 points. An outlier finds many more, all on one side of it.
  bool is_outlier(std::uint32_t i, const NeighbourList& list) const {
    constexpr double kCrowded = 4 * 3.14159;
    if (static_cast<double>(list.total) < kCrowded * options_.radius_spacings * options_.radius_spacings) return false;
    const Vec3f normal = own_normal(i);
    float height = 0;
    for (std::size_t k = 0; k < list.size(); ++k) height += normal.dot(list.offset(k));
    height /= static_cast<float>(list.size());
    return height * height > 0.1f * list.nearest_squared[kNearest - 1];
  }

  // What nearly all points are: amid a smooth surface, their cell closed by neighbours on all sides. False for all others, and if the neighbours within
  // `reach`, which are in the row, do not tell.
  bool fit_inside(std::uint32_t i, const std::array<float, kNearest>& nearest_squared, const Candidates& c, float radius, float reach) {
    if ((own_.flags[i] & SurfelBlock::kIsolated) || row_.num < kNearest) return false;
    const float mean = mean_distance(nearest_squared);
    if (kEdgeReach * mean > reach) return false;
    const float scale = std::max(mean, radius < options_.max_radius ? radius / static_cast<float>(options_.radius_spacings) : 0.0f);
    const Vec3f normal(own_.nx[i], own_.ny[i], own_.nz[i]), u = across(normal), v = normal.cross(u);
    TangentFrame frame{{normal.x(), normal.y(), normal.z()}, {u.x(), u.y(), u.z()}, {v.x(), v.y(), v.z()}, (own_.flags[i] & SurfelBlock::kOriented) != 0, kEdgeReach * mean, kOtherFace};
    normals_.take(c.nx.data(), c.ny.data(), c.nz.data(), c.flags.data(), row_);
    if (!lines_.make(row_, normals_, frame)) return false;  // an edge is near
    const float half = 3 * scale;
    bool open = false;
    const float within = farthest_corner(half, scale, reach, open);
    if (!(within > 0)) return false;
    if (open) {
      make_list(nearest_squared, radius);
      if (is_line(list_)) return false;
    }
    fits_[i] = RadiusFit{};
    fits_[i].mean_of_nearest = mean;
    fits_[i].radius = disc_radius(within, scale, open);
    return true;
  }

  static float disc_radius(float within, float scale, bool open) {
    if (!open) return std::min(1.1f * within, 3 * scale);
    return std::clamp(1.1f * within, 0.75f * scale, std::max(1.1f * within, scale));
  }

  // Corners of a cell: the two lines that meet, counter-clockwise, where, and the squared distance.
  struct CellCorners {
    static constexpr std::size_t kMost = 64;
    std::array<float, kMost> ax, ay, bx, by, x, y, squared;
    std::size_t size = 0;
    void set(std::size_t at, float ax_, float ay_, float bx_, float by_) {
      const float cross = ax_ * by_ - ay_ * bx_;
      ax[at] = ax_;
      ay[at] = ay_;
      bx[at] = bx_;
      by[at] = by_;
      x[at] = (by_ - ay_) / cross;
      y[at] = (ax_ - bx_) / cross;
      squared[at] = cross > 0 ? x[at] * x[at] + y[at] * y[at] : std::numeric_limits<float>::infinity();
    }
    std::size_t farthest() const {
      std::size_t at = 0;
      for (std::size_t i = 1; i < size; ++i) at = squared[i] > squared[at] ? i : at;
      return at;
    }
  };

  // Distance of the farthest corner of the Voronoi cell in the tangent plane, of those that lie inside the surface; open: there are others. 0 if the cell is not
  // closed by neighbours, or cannot be told from those within `reach`. Eight lines make a cell that is too large; its corners are cut, the farthest first,
  // until those that matter are right.
  float farthest_corner(float half, float scale, float reach, bool& open) {
    const EightLines lines = nearest_lines(lines_.wx.data(), lines_.wy.data(), row_.num, half);
    CellCorners c;
    for (std::size_t k = 0; k < 8; ++k) {
      c.ax[k] = lines.x[k];
      c.ay[k] = lines.y[k];
      c.bx[k] = lines.x[k + 1];
      c.by[k] = lines.y[k + 1];
      c.x[k] = lines.corner_x[k];
      c.y[k] = lines.corner_y[k];
      c.squared[k] = lines.corner_squared[k];
    }
    c.size = 8;
    float within = 0;
    for (;;) {
      const std::size_t at = c.farthest();
      if (c.squared[at] < 0 || (within > 0 && c.squared[at] <= scale * scale)) return within;
      if (!std::isfinite(c.squared[at])) return 0;
      const float x = c.x[at], y = c.y[at];
      const std::size_t cut = line_before(lines_.wx.data(), lines_.wy.data(), row_.num, x, y);
      if (cut < row_.num) {
        if (c.size == CellCorners::kMost) return 0;
        const float wx = lines_.wx[cut], wy = lines_.wy[cut];
        c.set(c.size++, wx, wy, c.bx[at], c.by[at]);
        c.set(at, c.ax[at], c.ay[at], wx, wy);
        continue;
      }
      const float d = std::sqrt(c.squared[at]);
      if (std::max(std::abs(x), std::abs(y)) >= 0.9999f * half || 2 * d > reach) return 0;
      if (d <= scale || lines_.is_beyond(x / d, y / d, d, row_.num)) within = std::max(within, d);
      else if (reach < kAllNeighbours) return 0;
      else open = true;
      c.squared[at] = -1;  // done
    }
  }

  // The nearest first: they settle most of the cell.
  void make_list(const std::array<float, kNearest>& nearest_squared, float radius) {
    list_.nearest_squared = nearest_squared;
    list_.resize(row_.num);
    const float near = nearest_squared[kNearest - 1];
    std::size_t at = 0;
    for (const bool first : {true, false})
      for (std::size_t k = 0; k < row_.num; ++k)
        if ((row_.distance_squared[k] <= near) == first) list_.set(at++, row_.x[k], row_.y[k], row_.z[k], row_.distance_squared[k], row_.candidate[k]);
    list_.radius = radius;
    list_.total = row_.num;
  }

  // Off the line through the point and its farthest neighbour nothing lies further than a 16th of the length.
  static bool is_line(const NeighbourList& list) {
    const auto far = static_cast<std::size_t>(std::max_element(list.distance_squared.begin(), list.distance_squared.end()) - list.distance_squared.begin());
    const Vec3f axis = list.offset(far);
    const float length_squared = axis.squaredNorm(), limit = length_squared * length_squared / 256;
    for (std::size_t k = 0; k < list.size(); ++k)
      if (list.offset(k).cross(axis).squaredNorm() > limit) return false;
    return true;
  }

  struct Face {
    Vec3f normal;
    bool oriented;
    // Not on another face of an edge, on the other side of a thin wall, or far off the plane.
    bool holds(const Vec3f& offset, float distance_squared, std::uint32_t j, const Candidates& c) const {
      const float height = normal.dot(offset);
      if (4 * height * height > distance_squared) return false;
      const float cosine = normal.dot(Vec3f(c.nx[j], c.ny[j], c.nz[j]));
      return (oriented && (c.flags[j] & SurfelBlock::kOriented) ? cosine : std::abs(cosine)) >= 0.5f;
    }
  };

  // The nearest other face: the plane through those neighbours, within kEdgeReach mean distances, whose normals agree with the nearest one's that is turned
  // away from the point's. The disc ends where it meets that plane, unless its own face goes on behind it.
  void clip_at_edge(std::uint32_t i, const NeighbourList& list, const Candidates& c) {
    constexpr float kSameFace = 0.9f, kBehind = 0.6f, kMargin = 0.1f;
    const float mean = fits_[i].mean_of_nearest;
    const Vec3f normal = own_normal(i);
    const float reach = kEdgeReach * mean, reach2 = reach * reach;
    std::size_t nearest = list.size();
    for (std::size_t k = 0; k < list.size(); ++k) {
      if (list.distance_squared[k] > reach2 || (nearest < list.size() && list.distance_squared[k] >= list.distance_squared[nearest])) continue;
      if (std::abs(normal.dot(normal_of(list, k, c))) < kOtherFace) nearest = k;
    }
    if (nearest == list.size()) return;
    const Vec3f first = normal_of(list, nearest, c);
    Vec3f other = Vec3f::Zero(), at = Vec3f::Zero(), own_side = Vec3f::Zero();
    float weight = 0;
    for (std::size_t k = 0; k < list.size(); ++k) {
      if (list.distance_squared[k] > reach2) continue;
      const Vec3f n = normal_of(list, k, c);
      const float cosine = n.dot(first);
      if (std::abs(cosine) > kSameFace && std::abs(normal.dot(n)) < kOtherFace) {
        const float w = std::exp(-list.distance_squared[k] / (mean * mean));
        other += (cosine < 0 ? -w : w) * n;
        at += w * list.offset(k);
        weight += w;
      }
      if (std::abs(normal.dot(n)) > kSameFace) own_side += list.offset(k);
    }
    at /= weight;
    other.normalize();
    Vec3f across = other - other.dot(normal) * normal;
    const float length = across.norm();
    if (!(length > 0.3f)) return;
    float distance = other.dot(at) / length;
    across /= length;
    if (own_side.dot(across) > 0) {
      across = -across;
      distance = -distance;
    }
    if (distance < -kBehind * mean) return;
    int behind = 0;
    for (std::size_t k = 0; k < list.size(); ++k)
      behind += list.distance_squared[k] <= reach2 && std::abs(normal.dot(normal_of(list, k, c))) > kSameFace && list.offset(k).dot(across) > distance + kBehind * mean;
    if (behind > 1) return;
    fits_[i].clip_across = across;
    fits_[i].clip_distance = std::max(0.0f, distance) + kMargin * mean;
  }

  Vec3f own_normal(std::uint32_t i) const { return {own_.nx[i], own_.ny[i], own_.nz[i]}; }

  static Vec3f normal_of(const NeighbourList& list, std::size_t k, const Candidates& c) {
    const std::uint32_t j = list.candidate[k];
    return {c.nx[j], c.ny[j], c.nz[j]};
  }

  float fit(std::uint32_t i, const NeighbourList& list, const Candidates& c) {
    const float mean = mean_distance(list.nearest_squared);
    if (list.size() == 0) return options_.lone_radius;
    if (list.size() < 3 || (own_.flags[i] & SurfelBlock::kIsolated)) return std::min(mean, options_.lone_radius);
    // Along scan lines the nearest are much closer than the next line: the search radius knows.
    const float scale = std::max(mean, list.radius < options_.max_radius ? list.radius / static_cast<float>(options_.radius_spacings) : 0.0f);
    const Face face{own_normal(i), (own_.flags[i] & SurfelBlock::kOriented) != 0};
    project(face, list);
    TangentCell cell = cell_of(face, list, c, scale, false);
    if (!cell.bounded() && few_on_face(face, list, c)) cell = cell_of(face, list, c, scale, true);
    const Vec3f& across_edge = fits_[i].clip_across;
    const Vec3f axis = across(face.normal);
    const float edge_u = axis.dot(across_edge), edge_v = face.normal.cross(axis).dot(across_edge), edge_distance = fits_[i].clip_distance;
    const bool clipped = !across_edge.isZero() && cell.cuts(edge_u, edge_v, edge_distance);
    if (clipped) cell.clip(edge_u, edge_v, edge_distance);
    float within = 0;   // the farthest corner that lies inside the surface
    bool open = false;
    cell.for_corners([&](float x, float y) {
      const float d = std::sqrt(x * x + y * y);
      const bool on_edge = clipped && d <= 2 * scale && edge_u * x + edge_v * y > edge_distance - 0.01f * scale;
      if (d <= scale || on_edge || is_inside(x / d, y / d, d)) within = std::max(within, d);
      else open = true;
    });
    return disc_radius(within, scale, open);
  }

  // A corner of the cell is inside the surface if points lie beyond it. On a border the half-way lines of the outermost points meet far outside, where
  // nothing is left to cover.
  bool is_inside(float x, float y, float distance) const {
    for (std::size_t k = 0; k < tangent_u_.size(); ++k) {
      const float tu = tangent_u_[k], tv = tangent_v_[k];
      if (tu * x + tv * y >= distance && std::abs(tv * x - tu * y) <= distance) return true;
    }
    return false;
  }

  // The neighbours in the tangent plane.
  void project(const Face& face, const NeighbourList& list) {
    const Vec3f u = across(face.normal), v = face.normal.cross(u);
    const std::size_t n = list.size();
    tangent_u_.resize(n);
    tangent_v_.resize(n);
    const float *x = list.x.data(), *y = list.y.data(), *z = list.z.data();
    float *tu = tangent_u_.data(), *tv = tangent_v_.data();
    for (std::size_t k = 0; k < n; ++k) {
      tu[k] = u.x() * x[k] + u.y() * y[k] + u.z() * z[k];
      tv[k] = v.x() * x[k] + v.y() * y[k] + v.z() * z[k];
    }
  }

  static bool few_on_face(const Face& face, const NeighbourList& list, const Candidates& c) {
    int on_face = 0;
    for (std::size_t k = 0; k < list.size(); ++k) on_face += face.holds(list.offset(k), list.distance_squared[k], list.candidate[k], c);
    return on_face < 5;
  }

  TangentCell cell_of(const Face& face, const NeighbourList& list, const Candidates& c, float scale, bool use_all) const {
    TangentCell cell(3 * scale);
    for (std::size_t k = 0; k < list.size(); ++k) {
      const float distance_squared = list.distance_squared[k];
      if (distance_squared > 4 * cell.farthest_squared()) continue;
      // The tangent plane meets the plane half-way between the two points where offset . x = distance^2 / 2.
      if (!cell.cuts(tangent_u_[k], tangent_v_[k], 0.5f * distance_squared)) continue;
      if (!use_all && !face.holds(list.offset(k), distance_squared, list.candidate[k], c)) continue;
      cell.clip(tangent_u_[k], tangent_v_[k], 0.5f * distance_squared);
    }
    return cell;
  }

  const HaloChunk& own_;
  const FitOptions& options_;
  std::vector<RadiusFit>& fits_;
  NeighbourRow row_;
  NeighbourNormals normals_;
  TangentLines lines_;
  NeighbourList list_;
  std::vector<float> tangent_u_, tangent_v_;
};

}  // namespace

void fit_normals_of(Neighbourhood& around, const FitOptions& options, std::vector<NormalFit>& fits) {
  fits.assign(around.own().size, {});
  NormalFitter fitter(around.own(), options, fits);
  Walker<NormalFitter>(around, options, fitter).run();
}

void fit_radii_of(Neighbourhood& around, const FitOptions& options, std::vector<RadiusFit>& fits) {
  fits.assign(around.own().size, {});
  RadiusFitter fitter(around.own(), options, fits);
  Walker<RadiusFitter>(around, options, fitter).run();
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
