#include "stream/store/surfel_fit.h"

#include <Eigen/Eigenvalues>
#include <algorithm>
#include <cmath>

namespace chiaro::stream {
namespace {

using FlatBox = HaloChunk::FlatBox;

// In a random sample of a surface with one point per spacing^2 the sixth neighbour lies at sqrt(6 / pi) spacings.
constexpr float kSixthInSpacings = 1.3820f;
constexpr std::size_t kNearest = 6;

class Walker {
 public:
  Walker(Neighbourhood& around, const FitOptions& options, const std::function<void(std::uint32_t, NeighbourList&, const Candidates&)>& body)
      : around_(around), own_(around.own()), options_(options), body_(body) {}

  void run() {
    guess_ = first_guess();
    for (std::uint32_t begin = 0; begin < own_.size;) {
      const std::uint32_t end = group_end(begin);
      run_group(begin, end);
      begin = end;
    }
  }

 private:
  float first_guess() const {
    const FlatBox& b = own_.levels.back()[0];
    float edges[3] = {b.max[0] - b.min[0], b.max[1] - b.min[1], b.max[2] - b.min[2]};
    std::sort(edges, edges + 3);
    const float spacing = std::sqrt(std::max(edges[2] * std::max(edges[1], edges[2] * 0.01f), 0.0f) / static_cast<float>(own_.size));
    return std::clamp(spacing * static_cast<float>(options_.radius_spacings), options_.max_radius * 1e-6f, options_.max_radius);
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
    const float guess = guess_;
    around_.gather(box_, guess, candidates_);
    float sum = 0;
    retry_.clear();
    for (std::uint32_t i = begin; i < end; ++i) {
      const float needed = try_point(i, guess, candidates_);
      if (needed > 0) retry_.push_back({i, needed});
      else sum += list_.radius;
    }
    for (const auto& [i, needed] : retry_) {
      const FlatBox box{{own_.x[i], own_.y[i], own_.z[i]}, {own_.x[i], own_.y[i], own_.z[i]}};
      for (float radius = needed; radius > 0;) {
        around_.gather(box, radius, single_);
        radius = try_point(i, radius, single_);
      }
      sum += list_.radius;
    }
    // The next group is probably as dense as this one.
    guess_ = std::clamp(1.3f * sum / static_cast<float>(end - begin), options_.max_radius * 1e-6f, options_.max_radius);
  }

  // Returns 0 when done, else the radius that the search needs. All candidates within `radius` of the point are there.
  float try_point(std::uint32_t i, float radius, const Candidates& c) {
    const std::size_t n = c.size();
    distance_.resize(n);
    const float px = own_.x[i], py = own_.y[i], pz = own_.z[i];
    const float *cx = c.x.data(), *cy = c.y.data(), *cz = c.z.data();
    float* d = distance_.data();
    for (std::size_t k = 0; k < n; ++k) {
      const float dx = cx[k] - px, dy = cy[k] - py, dz = cz[k] - pz;
      d[k] = dx * dx + dy * dy + dz * dz;
    }
    near_.resize(n);
    const float limit = radius * radius;
    std::size_t m = 0;
    for (std::size_t k = 0; k < n; ++k) {
      near_[m] = {d[k], static_cast<std::uint32_t>(k)};
      m += d[k] <= limit && d[k] > 0;
    }
    near_.resize(m);
    const bool at_limit = radius >= options_.max_radius;
    if (m < kNearest && !at_limit) return std::min(2 * radius, options_.max_radius);
    return select(i, radius, at_limit, c, px, py, pz);
  }

  float select(std::uint32_t i, float radius, bool at_limit, const Candidates& c, float px, float py, float pz) {
    const std::size_t nearest = std::min(kNearest, near_.size());
    std::partial_sort(near_.begin(), near_.begin() + static_cast<std::ptrdiff_t>(nearest), near_.end());
    float sum = 0;
    for (std::size_t k = 0; k < nearest; ++k) sum += std::sqrt(near_[k].distance_squared);
    list_.mean_of_nearest = nearest > 0 ? sum / static_cast<float>(nearest) : 0;
    float wanted = options_.max_radius;
    if (nearest == kNearest)
      wanted = std::min(options_.max_radius, std::sqrt(near_[kNearest - 1].distance_squared) / kSixthInSpacings * static_cast<float>(options_.radius_spacings));
    for (int growth = 0;; ++growth) {
      if (wanted > radius && !at_limit) return wanted;
      fill(wanted, c, px, py, pz);
      // Scan lines: the nearest all lie on one line. Look further until the next lines come in.
      if (growth == 3 || wanted >= options_.max_radius || list_.items.size() < 3 || !is_line()) break;
      wanted = std::min(2 * wanted, options_.max_radius);
    }
    list_.radius = wanted;
    body_(i, list_, c);
    return 0;
  }

  void fill(float wanted, const Candidates& c, float px, float py, float pz) {
    list_.items.clear();
    for (const auto& item : near_)
      if (item.distance_squared <= wanted * wanted) list_.items.push_back(item);
    if (list_.items.size() > options_.most) {
      std::nth_element(list_.items.begin(), list_.items.begin() + static_cast<std::ptrdiff_t>(options_.most), list_.items.end());
      list_.items.resize(options_.most);
    }
    if (options_.sorted) std::sort(list_.items.begin(), list_.items.end());
    list_.offset.resize(list_.items.size());
    for (std::size_t k = 0; k < list_.items.size(); ++k) {
      const std::uint32_t j = list_.items[k].candidate;
      list_.offset[k] = {c.x[j] - px, c.y[j] - py, c.z[j] - pz};
    }
  }

  // Off the line through the point and its farthest neighbour nothing lies further than a 16th of the length.
  bool is_line() const {
    std::size_t far = 0;
    for (std::size_t k = 1; k < list_.items.size(); ++k)
      if (list_.items[far].distance_squared < list_.items[k].distance_squared) far = k;
    const Vec3f axis = list_.offset[far];
    const float length_squared = axis.squaredNorm(), limit = length_squared * length_squared / 256;
    for (const Vec3f& o : list_.offset)
      if (o.cross(axis).squaredNorm() > limit) return false;
    return true;
  }

 private:
  Neighbourhood& around_;
  const HaloChunk& own_;
  const FitOptions& options_;
  const std::function<void(std::uint32_t, NeighbourList&, const Candidates&)>& body_;
  float guess_ = 0;
  FlatBox box_{};
  Candidates candidates_, single_;
  std::vector<float> distance_;
  std::vector<NeighbourList::Item> near_;
  std::vector<std::pair<std::uint32_t, float>> retry_;
  NeighbourList list_;
};

// Any unit vector across v.
Vec3f across(const Vec3f& v) {
  const Vec3f axis = std::abs(v.z()) < 0.9f * v.norm() ? Vec3f::UnitZ() : Vec3f::UnitX();
  return v.cross(axis).normalized();
}

// A convex polygon around the origin of the tangent plane, clipped by half-planes. Fixed room: each cut adds at most one corner.
class TangentCell {
 public:
  explicit TangentCell(float half_size) : box_(half_size * 0.9999f) {
    corner_[0] = {-half_size, -half_size};
    corner_[1] = {half_size, -half_size};
    corner_[2] = {half_size, half_size};
    corner_[3] = {-half_size, half_size};
    size_ = 4;
    measure();
  }
  float farthest_squared() const { return farthest_squared_; }
  bool bounded() const { return bounded_; }
  float farthest_bounded_squared() const { return farthest_bounded_squared_; }

  // Keeps x with direction . x <= distance.
  void clip(const Vec2f& direction, float distance) {
    std::array<float, kMost> side;
    bool cuts = false;
    for (int i = 0; i < size_; ++i) {
      side[i] = direction.dot(corner_[i]) - distance;
      cuts = cuts || side[i] > 0;
    }
    if (!cuts || size_ + 1 >= kMost) return;
    std::array<Vec2f, kMost> kept;
    int n = 0;
    for (int i = 0; i < size_; ++i) {
      const int j = i + 1 == size_ ? 0 : i + 1;
      if (side[i] <= 0) kept[n++] = corner_[i];
      if ((side[i] <= 0) != (side[j] <= 0)) kept[n++] = corner_[i] + (side[i] / (side[i] - side[j])) * (corner_[j] - corner_[i]);
    }
    corner_ = kept;
    size_ = n;
    measure();
  }

 private:
  static constexpr int kMost = 40;
  void measure() {
    farthest_squared_ = farthest_bounded_squared_ = 0;
    bounded_ = true;
    for (int i = 0; i < size_; ++i) {
      const float d = corner_[i].squaredNorm();
      farthest_squared_ = std::max(farthest_squared_, d);
      if (corner_[i].cwiseAbs().maxCoeff() >= box_) bounded_ = false;
      else farthest_bounded_squared_ = std::max(farthest_bounded_squared_, d);
    }
  }
  float box_;
  std::array<Vec2f, kMost> corner_;
  int size_ = 0;
  float farthest_squared_ = 0, farthest_bounded_squared_ = 0;
  bool bounded_ = false;
};

// Neighbours on another face of an edge, on the other side of a thin wall, or far off the plane do not bound the disc.
bool on_same_face(const Vec3f& offset, const Vec3f& other_normal, const Vec3f& normal, bool signs_known) {
  const float cosine = normal.dot(other_normal);
  if ((signs_known ? cosine : std::abs(cosine)) < 0.5f) return false;
  const float height = normal.dot(offset);
  return 4 * height * height <= offset.squaredNorm();
}

}  // namespace

void for_each_neighbourhood(Neighbourhood& around, const FitOptions& options,
                            const std::function<void(std::uint32_t, NeighbourList&, const Candidates&)>& body) {
  Walker(around, options, body).run();
}

NormalFit fit_normal(const NeighbourList& list) {
  NormalFit fit;
  const std::size_t n = list.offset.size();
  if (n < 3) {
    fit.isolated = true;
    return fit;
  }
  Vec3d sum = Vec3d::Zero();
  Mat3d second = Mat3d::Zero();
  for (const Vec3f& o : list.offset) {
    const Vec3d p = o.cast<double>();
    sum += p;
    second += p * p.transpose();
  }
  const Vec3d centroid = sum / static_cast<double>(n + 1);  // the point itself is the origin
  const Mat3d covariance = second / static_cast<double>(n + 1) - centroid * centroid.transpose();
  const double scale = covariance.trace();
  if (!(scale > 0)) {
    fit.isolated = true;
    return fit;
  }
  Eigen::SelfAdjointEigenSolver<Mat3d> solver;
  solver.computeDirect(covariance / scale);
  const Vec3d values = solver.eigenvalues();
  if (values[1] < 1e-4 * values[2]) {
    fit.isolated = true;
    fit.normal = across(solver.eigenvectors().col(2).cast<float>());
    return fit;
  }
  Vec3d normal = solver.eigenvectors().col(0);
  const double outwards = -normal.dot(centroid);
  const bool flip = std::abs(outwards) > 1e-9 * std::sqrt(scale) ? outwards < 0 : normal.z() < 0;
  fit.normal = (flip ? -normal : normal).normalized().cast<float>();
  return fit;
}

float fit_radius(const NeighbourList& list, const Candidates& candidates, const Vec3f& normal, std::uint8_t flags, const FitOptions& options) {
  if (list.items.empty()) return options.lone_radius;
  const float mean = list.mean_of_nearest;
  if (list.items.size() < 3) return std::min(mean, options.lone_radius);
  // Along scan lines the nearest are much closer than the next line: the search radius knows.
  const float scale = std::max(mean, list.radius < options.max_radius ? list.radius / static_cast<float>(options.radius_spacings) : 0.0f);
  const bool oriented = (flags & SurfelBlock::kOriented) != 0;
  std::array<bool, 256> used{};
  std::size_t on_face = 0;
  const std::size_t n = std::min<std::size_t>(list.items.size(), used.size());
  for (std::size_t k = 0; k < n; ++k) {
    const std::uint32_t j = list.items[k].candidate;
    const bool signs_known = oriented && (candidates.flags[j] & SurfelBlock::kOriented) != 0;
    used[k] = on_same_face(list.offset[k], decode_normal(candidates.normal[j][0], candidates.normal[j][1]), normal, signs_known);
    on_face += used[k];
  }
  const bool use_all = on_face < 5;
  const Vec3f u = across(normal), v = normal.cross(u);
  TangentCell cell(3 * scale);
  for (std::size_t k = 0; k < n; ++k) {
    if (!use_all && !used[k]) continue;
    const float distance_squared = list.items[k].distance_squared;
    if (distance_squared > 4 * cell.farthest_squared()) break;  // sorted: nothing further can cut
    const Vec2f t(u.dot(list.offset[k]), v.dot(list.offset[k]));
    const float length = t.norm();
    if (length * length < 1e-4f * distance_squared) continue;
    // Where the tangent plane meets the plane half-way between the two points.
    cell.clip(t / length, 0.5f * distance_squared / length);
  }
  if (cell.bounded()) return std::min(1.1f * std::sqrt(cell.farthest_squared()), 3 * scale);
  return std::clamp(1.1f * std::sqrt(cell.farthest_bounded_squared()), 0.75f * scale, 1.5f * scale);
}

}  // namespace chiaro::stream
