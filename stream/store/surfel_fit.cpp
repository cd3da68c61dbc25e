#include "stream/store/surfel_fit.h"

#include <Eigen/Eigenvalues>
#include <algorithm>
#include <array>
#include <cmath>
#include <limits>

namespace chiaro::stream {
namespace {

using FlatBox = HaloChunk::FlatBox;

// In a random sample of a surface with one point per spacing^2 the sixth neighbour lies at sqrt(6 / pi) spacings.
constexpr float kSixthInSpacings = 1.3820f;
constexpr std::size_t kNearest = 6;
constexpr int kMostGrowth = 3;

// Eight points of a group are worked on at once, one in each lane. A GCC and Clang extension: two halves on processors with 16-byte vectors, one piece with
// AVX2. Lanes never meet and each adds in the order of the candidates, so that both give the same bits.
constexpr std::uint32_t kLanes = 8;
typedef float Lanes __attribute__((vector_size(32)));
typedef std::int32_t LaneMask __attribute__((vector_size(32)));

#if defined(__x86_64__)
#define CHIARO_AVX2 __attribute__((target("avx2")))
const bool kHasAvx2 = __builtin_cpu_supports("avx2");
#endif
#define CHIARO_INLINE inline __attribute__((always_inline))

struct EightPoints {
  std::array<float, kLanes> x, y, z;
};

struct Nearest {
  float squared[kNearest][kLanes];
};

struct CandidateView {
  const float *x, *y, *z;
  std::size_t num;
};

/// Sums over the neighbours within a radius: x y z, xx xy xz yy yz zz, count.
constexpr std::size_t kTerms = 10;

CHIARO_INLINE void load(const float* from, Lanes& to) { __builtin_memcpy(&to, from, sizeof to); }
CHIARO_INLINE void store(const Lanes& from, float* to) { __builtin_memcpy(to, &from, sizeof from); }

// Squared distances of the six nearest of each lane, nearest first; what lies on the spot is left out.
CHIARO_INLINE void nearest_body(const CandidateView& c, const EightPoints& p, Nearest& out) {
  Lanes px, py, pz, best[kNearest];
  load(p.x.data(), px);
  load(p.y.data(), py);
  load(p.z.data(), pz);
  const Lanes far = Lanes{} + std::numeric_limits<float>::infinity();
  for (Lanes& b : best) b = far;
  for (std::size_t k = 0; k < c.num; ++k) {
    const Lanes dx = c.x[k] - px, dy = c.y[k] - py, dz = c.z[k] - pz;
    Lanes d = dx * dx + dy * dy + dz * dz;
    d = d > Lanes{} ? d : far;
    for (Lanes& b : best) {
      const Lanes low = b < d ? b : d;
      d = b < d ? d : b;
      b = low;
    }
  }
  for (std::size_t i = 0; i < kNearest; ++i) store(best[i], out.squared[i]);
}

// Sums over the candidates within each of `num_scales` radii, widest first.
template <std::size_t num_scales>
CHIARO_INLINE void moments_body(const CandidateView& c, const EightPoints& p, const float (&limits)[num_scales][kLanes], float (&out)[num_scales][kTerms][kLanes]) {
  Lanes px, py, pz, limit[num_scales], sums[num_scales][kTerms];
  load(p.x.data(), px);
  load(p.y.data(), py);
  load(p.z.data(), pz);
  for (std::size_t s = 0; s < num_scales; ++s) {
    load(limits[s], limit[s]);
    for (Lanes& sum : sums[s]) sum = Lanes{};
  }
  const Lanes one = Lanes{} + 1.0f;
  for (std::size_t k = 0; k < c.num; ++k) {
    const Lanes dx = c.x[k] - px, dy = c.y[k] - py, dz = c.z[k] - pz;
    const Lanes terms[kTerms] = {dx, dy, dz, dx * dx, dx * dy, dx * dz, dy * dy, dy * dz, dz * dz, one};
    const Lanes d = terms[3] + terms[6] + terms[8];
    for (std::size_t s = 0; s < num_scales; ++s) {
      const LaneMask inside = (d <= limit[s]) & (d > Lanes{});
      std::uint64_t any[4];
      __builtin_memcpy(any, &inside, sizeof inside);
      if ((any[0] | any[1] | any[2] | any[3]) == 0) break;  // nor is it within the narrower radii
      for (std::size_t t = 0; t < kTerms; ++t) sums[s][t] += inside ? terms[t] : Lanes{};
    }
  }
  for (std::size_t s = 0; s < num_scales; ++s)
    for (std::size_t t = 0; t < kTerms; ++t) store(sums[s][t], out[s][t]);
}

#if defined(CHIARO_AVX2)
CHIARO_AVX2 void nearest_avx2(const CandidateView& c, const EightPoints& p, Nearest& out) { nearest_body(c, p, out); }
template <std::size_t n>
CHIARO_AVX2 void moments_avx2(const CandidateView& c, const EightPoints& p, const float (&limits)[n][kLanes], float (&out)[n][kTerms][kLanes]) {
  moments_body(c, p, limits, out);
}
#endif

void nearest_of(const CandidateView& c, const EightPoints& p, Nearest& out) {
#if defined(CHIARO_AVX2)
  if (kHasAvx2) return nearest_avx2(c, p, out);
#endif
  nearest_body(c, p, out);
}

template <std::size_t n>
void moments_of(const CandidateView& c, const EightPoints& p, const float (&limits)[n][kLanes], float (&out)[n][kTerms][kLanes]) {
#if defined(CHIARO_AVX2)
  if (kHasAvx2) return moments_avx2(c, p, limits, out);
#endif
  moments_body(c, p, limits, out);
}

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

/// Goes through a chunk in groups of consecutive points that share a search. Fit answers: fit_lanes() fits up to eight points from the candidates and tells
/// the radius it used, or 0 for a point that needs the careful search; fit_one() fits one from a complete list, or refuses and gets a larger one.
template <class Fit>
class Walker {
 public:
  Walker(Neighbourhood& around, const FitOptions& options, Fit& fit) : around_(around), own_(around.own()), options_(options), fit_(fit) {}

  void run() {
    guess_ = first_guess();
    for (std::uint32_t begin = 0; begin < own_.size;) {
      const std::uint32_t end = group_end(begin);
      run_group(begin, end);
      begin = end;
    }
  }

 private:
  float clamped(float radius) const { return std::clamp(radius, options_.max_radius * 1e-6f, options_.max_radius); }

  float first_guess() const {
    const FlatBox& b = own_.levels.back()[0];
    float edges[3] = {b.max[0] - b.min[0], b.max[1] - b.min[1], b.max[2] - b.min[2]};
    std::sort(edges, edges + 3);
    const float spacing = std::sqrt(edges[2] * std::max(edges[1], edges[2] * 0.01f) / static_cast<float>(own_.size));
    return clamped(spacing * static_cast<float>(options_.radius_spacings));
  }

  // Consecutive points share one search while they stay within a few search radii.
  std::uint32_t group_end(std::uint32_t begin) {
    box_ = {{own_.x[begin], own_.y[begin], own_.z[begin]}, {own_.x[begin], own_.y[begin], own_.z[begin]}};
    const std::uint32_t last = std::min(own_.size, (begin / HaloChunk::kGroup + 1) * HaloChunk::kGroup);
    std::uint32_t end = begin + 1;
    for (; end < last; ++end) {
      FlatBox grown = box_;
      const float p[3] = {own_.x[end], own_.y[end], own_.z[end]};
      float extent = 0;
      for (std::size_t a = 0; a < 3; ++a) {
        grown.min[a] = std::min(grown.min[a], p[a]);
        grown.max[a] = std::max(grown.max[a], p[a]);
        extent = std::max(extent, grown.max[a] - grown.min[a]);
      }
      if (extent > 3 * guess_) break;
      box_ = grown;
    }
    return end;
  }

  void run_group(std::uint32_t begin, std::uint32_t end) {
    around_.gather(box_, guess_, candidates_);
    float sum = 0;
    for (std::uint32_t first = begin; first < end; first += kLanes) {
      const std::uint32_t count = std::min(kLanes, end - first);
      EightPoints p;
      for (std::uint32_t lane = 0; lane < kLanes; ++lane) {
        const std::uint32_t i = first + std::min(lane, count - 1);
        p.x[lane] = own_.x[i];
        p.y[lane] = own_.y[i];
        p.z[lane] = own_.z[i];
      }
      Nearest nearest;
      nearest_of(view_of(candidates_), p, nearest);
      const float* sixth = nearest.squared[kNearest - 1];
      std::array<float, kLanes> wanted;
      for (std::uint32_t lane = 0; lane < kLanes; ++lane) {
        wanted[lane] = std::sqrt(sixth[lane]) / kSixthInSpacings * static_cast<float>(options_.radius_spacings);
        if (lane >= count || !(wanted[lane] <= guess_) || !(sixth[lane] <= guess_ * guess_)) wanted[lane] = 0;
      }
      fit_.fit_lanes(first, p, nearest, candidates_, wanted);
      for (std::uint32_t lane = 0; lane < count; ++lane) sum += wanted[lane] > 0 ? wanted[lane] : search_carefully(first + lane, std::sqrt(sixth[lane]));
    }
    // The next group is probably as dense as this one.
    guess_ = clamped(1.35f * sum / static_cast<float>(end - begin));
  }

  // The search radius grows until the wanted neighbours are certain. Returns that radius.
  float search_carefully(std::uint32_t i, float sixth) {
    const FlatBox box{{own_.x[i], own_.y[i], own_.z[i]}, {own_.x[i], own_.y[i], own_.z[i]}};
    float radius = guess_;
    if (sixth <= guess_) radius = 1.001f * sixth / kSixthInSpacings * static_cast<float>(options_.radius_spacings);
    else radius = 2 * guess_;
    for (int growth = 0;;) {
      radius = std::min(radius, options_.max_radius);
      const bool at_limit = radius >= options_.max_radius;
      around_.gather(box, radius, single_);
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
  float guess_ = 0;
  FlatBox box_{};
  Candidates candidates_, single_;
  std::vector<std::pair<float, std::uint32_t>> near_;
  NeighbourList list_;
};

// Any unit vector across v.
Vec3f across(const Vec3f& v) {
  const Vec3f axis = std::abs(v.z()) < 0.9f * v.norm() ? Vec3f::UnitZ() : Vec3f::UnitX();
  return v.cross(axis).normalized();
}

using Moments = std::array<double, kTerms>;

// Floats lose a millionth, but products of two need care where the plane is thin: at worst some 0.001 degrees.
struct NormalAnswer {
  NormalFit fit;
  bool line = false;
  double variance_off_plane = 0;   ///< with the plane's three degrees of freedom taken off
};

/// Eigenvalues of a symmetric matrix of trace 1 that has none below zero, smallest first, and the axis of the smallest.
struct Principal {
  Vec3d values;
  Vec3d axis;
};

// The smallest root of the characteristic polynomial by Newton's method: the polynomial rises and is concave up to it, so steps from 0 never pass it.
// Much faster than a general solver; where two roots fall together the axis is not defined well and the general solver decides.
Principal principal_of(const Mat3d& a) {
  const double c1 = a(0, 0) * a(1, 1) - a(0, 1) * a(0, 1) + a(0, 0) * a(2, 2) - a(0, 2) * a(0, 2) + a(1, 1) * a(2, 2) - a(1, 2) * a(1, 2);
  const double c0 = a.determinant();
  double root = 0;
  for (int i = 0; i < 30; ++i) {
    const double slope = c1 + root * (3 * root - 2);
    if (!(slope > 1e-12)) break;
    const double step = (c0 - root * (c1 + root * (root - 1))) / slope;
    root += step;
    if (!(step > 1e-15)) break;
  }
  Principal p;
  p.values[0] = std::max(0.0, root);
  const double sum = 1 - root, product = std::max(0.0, c1 - root * sum);
  p.values[2] = 0.5 * (sum + std::sqrt(std::max(0.0, sum * sum - 4 * product)));
  p.values[1] = product / p.values[2];
  Mat3d b = a;
  for (int i = 0; i < 3; ++i) b(i, i) -= root;
  const Vec3d crosses[3] = {b.col(0).cross(b.col(1)), b.col(0).cross(b.col(2)), b.col(1).cross(b.col(2))};
  const double norms[3] = {crosses[0].squaredNorm(), crosses[1].squaredNorm(), crosses[2].squaredNorm()};
  const std::size_t best = norms[0] >= norms[1] ? (norms[0] >= norms[2] ? 0 : 2) : (norms[1] >= norms[2] ? 1 : 2);
  if (norms[best] > 1e-14) {
    p.axis = crosses[best] / std::sqrt(norms[best]);
    return p;
  }
  Eigen::SelfAdjointEigenSolver<Mat3d> solver(a);
  return {solver.eigenvalues(), solver.eigenvectors().col(0)};
}

NormalAnswer normal_from(const Moments& sums) {
  NormalAnswer answer;
  const double n = sums[9];
  if (n < 3) {
    answer.fit.isolated = true;
    return answer;
  }
  std::array<double, 9> m;
  for (std::size_t i = 0; i < 9; ++i) m[i] = sums[i] / (n + 1);  // the point itself is the origin
  Mat3d covariance;
  covariance << m[3] - m[0] * m[0], m[4] - m[0] * m[1], m[5] - m[0] * m[2],
                m[4] - m[0] * m[1], m[6] - m[1] * m[1], m[7] - m[1] * m[2],
                m[5] - m[0] * m[2], m[7] - m[1] * m[2], m[8] - m[2] * m[2];
  const double scale = covariance.trace();
  if (!(scale > 0)) {
    answer.fit.isolated = true;
    return answer;
  }
  const auto [values, normal] = principal_of(covariance / scale);
  answer.line = values[1] < 0.01 * values[2];
  if (values[1] < 1e-4 * values[2]) {
    answer.fit.isolated = true;
    Eigen::SelfAdjointEigenSolver<Mat3d> solver(covariance / scale);
    answer.fit.normal = across(solver.eigenvectors().col(2).cast<float>());
    return answer;
  }
  answer.variance_off_plane = std::max(0.0, values[0]) * scale * (n + 1) / std::max(1.0, n - 2);
  const double outwards = -normal.dot(Vec3d(m[0], m[1], m[2]));
  const bool flip = std::abs(outwards) > 1e-9 * std::sqrt(scale) ? outwards < 0 : normal.z() < 0;
  answer.fit.normal = (flip ? -normal : normal).normalized().cast<float>();
  return answer;
}

/// Normals are fitted at three nested radii. The widest one that still fits a plane as well as the narrowest does is taken: wide on flat ground, where it
/// averages noise, narrow at edges and joints, which a wide one would round off (measured on the rendered tower, 0.8 mm of noise at 9 mm spacing, against
/// one radius of 3.5 spacings: 95 % of errors below 18 instead of 26 degrees, median 1.5 instead of 1.4).
constexpr std::size_t kScales = 3;
constexpr float kScaleOfRadius[kScales] = {1.0f, 0.74f, 0.57f};
constexpr double kPlaneGrowth = 1.35;   // residual of the wider plane over the narrowest one's that sampling alone explains
constexpr double kEnoughForPlane = 6;

NormalAnswer normal_of_scales(const std::array<Moments, kScales>& scales) {
  std::size_t narrowest = kScales - 1;
  while (narrowest > 0 && scales[narrowest][9] < kEnoughForPlane) --narrowest;
  if (narrowest == 0) return normal_from(scales[0]);
  NormalAnswer best = normal_from(scales[narrowest]);
  if (best.line || best.fit.isolated) return normal_from(scales[0]);
  const double limit = kPlaneGrowth * kPlaneGrowth * best.variance_off_plane;
  for (std::size_t s = narrowest; s-- > 0;) {
    const NormalAnswer wider = normal_from(scales[s]);
    if (wider.line || wider.fit.isolated || wider.variance_off_plane > limit) break;
    best = wider;
  }
  return best;
}

class NormalFitter {
 public:
  NormalFitter(const FitOptions& options, std::vector<NormalFit>& fits) : options_(options), fits_(fits) {}

  void fit_lanes(std::uint32_t first, const EightPoints& p, const Nearest&, const Candidates& c, std::array<float, kLanes>& wanted) {
    float limits[kScales][kLanes], sums[kScales][kTerms][kLanes];
    for (std::size_t s = 0; s < kScales; ++s)
      for (std::uint32_t lane = 0; lane < kLanes; ++lane) limits[s][lane] = wanted[lane] * wanted[lane] * kScaleOfRadius[s] * kScaleOfRadius[s];
    moments_of(view_of(c), p, limits, sums);
    for (std::uint32_t lane = 0; lane < kLanes; ++lane) {
      if (wanted[lane] == 0) continue;
      std::array<Moments, kScales> m;
      for (std::size_t s = 0; s < kScales; ++s)
        for (std::size_t t = 0; t < kTerms; ++t) m[s][t] = static_cast<double>(sums[s][t][lane]);
      const NormalAnswer answer = normal_of_scales(m);
      if (answer.line || m[0][9] > static_cast<double>(options_.most)) wanted[lane] = 0;
      else fits_[first + lane] = answer.fit;
    }
  }

  bool fit_one(std::uint32_t i, const NeighbourList& list, const Candidates&, bool last) {
    std::array<Moments, kScales> m{};
    for (std::size_t k = 0; k < list.size(); ++k) {
      const double x = static_cast<double>(list.x[k]), y = static_cast<double>(list.y[k]), z = static_cast<double>(list.z[k]);
      const double terms[10] = {x, y, z, x * x, x * y, x * z, y * y, y * z, z * z, 1};
      for (std::size_t s = 0; s < kScales; ++s) {
        if (list.distance_squared[k] > list.radius * list.radius * kScaleOfRadius[s] * kScaleOfRadius[s] && s > 0) continue;
        for (std::size_t t = 0; t < 10; ++t) m[s][t] += terms[t];
      }
    }
    const NormalAnswer answer = normal_of_scales(m);
    if (answer.line && !last) return false;
    fits_[i] = answer.fit;
    return true;
  }

 private:
  const FitOptions& options_;
  std::vector<NormalFit>& fits_;
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

  void fit_lanes(std::uint32_t first, const EightPoints& p, const Nearest& nearest, const Candidates& c, std::array<float, kLanes>& wanted) {
    for (std::uint32_t lane = 0; lane < kLanes; ++lane) {
      if (wanted[lane] == 0) continue;
      for (std::size_t k = 0; k < kNearest; ++k) list_.nearest_squared[k] = nearest.squared[k][lane];
      collect(c, p.x[lane], p.y[lane], p.z[lane], wanted[lane]);
      if (list_.total > options_.most || !fit_one(first + lane, list_, c, false)) wanted[lane] = 0;
    }
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
  // Near an evenly sampled surface the search finds pi * spacings^2 points. An outlier finds many more, all on one side of it.
  bool is_outlier(std::uint32_t i, const NeighbourList& list) const {
    constexpr double kCrowded = 4 * 3.14159;
    if (static_cast<double>(list.total) < kCrowded * options_.radius_spacings * options_.radius_spacings) return false;
    const Vec3f normal = decode_normal(own_.normal[i][0], own_.normal[i][1]);
    float height = 0;
    for (std::size_t k = 0; k < list.size(); ++k) height += normal.dot(list.offset(k));
    height /= static_cast<float>(list.size());
    return height * height > 0.1f * list.nearest_squared[kNearest - 1];
  }

  void collect(const Candidates& c, float px, float py, float pz, float radius) {
    const std::size_t n = c.num;
    if (distance_.size() < n) {
      distance_.resize(n);
      index_.resize(n);
    }
    float* d = distance_.data();
    const float *cx = c.x.data(), *cy = c.y.data(), *cz = c.z.data();
    for (std::size_t k = 0; k < n; ++k) {
      const float dx = cx[k] - px, dy = cy[k] - py, dz = cz[k] - pz;
      d[k] = dx * dx + dy * dy + dz * dz;
    }
    const float limit = radius * radius;
    std::uint32_t* index = index_.data();
    std::size_t m = 0;
    for (std::size_t k = 0; k < n; ++k) {
      index[m] = static_cast<std::uint32_t>(k);
      m += d[k] <= limit;
    }
    // The nearest first: they settle most of the cell.
    list_.resize(m + 1);
    const float near = list_.nearest_squared[kNearest - 1];
    std::size_t at = 0;
    for (const bool first : {true, false})
      for (std::size_t k = 0; k < m; ++k) {
        const std::uint32_t j = index[k];
        list_.set(at, cx[j] - px, cy[j] - py, cz[j] - pz, d[j], j);
        at += static_cast<std::size_t>((d[j] <= near) == first) & static_cast<std::size_t>(d[j] > 0);
      }
    list_.resize(at);
    list_.radius = radius;
    list_.total = at;
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
      const float cosine = normal.dot(decode_normal(c.normal[j][0], c.normal[j][1]));
      return (oriented && (c.flags[j] & SurfelBlock::kOriented) ? cosine : std::abs(cosine)) >= 0.5f;
    }
  };

  // The nearest other face: the plane through those neighbours, within kEdgeReach mean distances, whose normals agree with the nearest one's that is turned
  // away from the point's. The disc ends where it meets that plane, unless its own face goes on behind it.
  void clip_at_edge(std::uint32_t i, const NeighbourList& list, const Candidates& c) {
    constexpr float kEdgeReach = 2.2f, kOtherFace = 0.82f, kSameFace = 0.9f, kBehind = 0.6f, kMargin = 0.1f;
    const float mean = fits_[i].mean_of_nearest;
    const Vec3f normal = decode_normal(own_.normal[i][0], own_.normal[i][1]);
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

  static Vec3f normal_of(const NeighbourList& list, std::size_t k, const Candidates& c) {
    const std::uint32_t j = list.candidate[k];
    return decode_normal(c.normal[j][0], c.normal[j][1]);
  }

  float fit(std::uint32_t i, const NeighbourList& list, const Candidates& c) {
    const float mean = mean_distance(list.nearest_squared);
    if (list.size() == 0) return options_.lone_radius;
    if (list.size() < 3 || (own_.flags[i] & SurfelBlock::kIsolated)) return std::min(mean, options_.lone_radius);
    // Along scan lines the nearest are much closer than the next line: the search radius knows.
    const float scale = std::max(mean, list.radius < options_.max_radius ? list.radius / static_cast<float>(options_.radius_spacings) : 0.0f);
    const Face face{decode_normal(own_.normal[i][0], own_.normal[i][1]), (own_.flags[i] & SurfelBlock::kOriented) != 0};
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
    if (!open) return std::min(1.1f * within, 3 * scale);
    return std::clamp(1.1f * within, 0.75f * scale, std::max(1.1f * within, scale));
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
  NeighbourList list_;
  std::vector<float> distance_, tangent_u_, tangent_v_;
  std::vector<std::uint32_t> index_;
};

}  // namespace

void fit_normals_of(Neighbourhood& around, const FitOptions& options, std::vector<NormalFit>& fits) {
  fits.assign(around.own().size, {});
  NormalFitter fitter(options, fits);
  Walker<NormalFitter>(around, options, fitter).run();
}

void fit_radii_of(Neighbourhood& around, const FitOptions& options, std::vector<RadiusFit>& fits) {
  fits.assign(around.own().size, {});
  RadiusFitter fitter(around.own(), options, fits);
  Walker<RadiusFitter>(around, options, fitter).run();
}

}  // namespace chiaro::stream
