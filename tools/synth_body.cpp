#include "tools/synth_body.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdint>
#include <vector>

#include "stream/base/parallel.h"
#include "tools/synth_surfaces.h"

namespace chiaro::tools {
namespace {

constexpr double kFinestStep = 5e-4;   ///< metres: no detail of statue and wall is smaller, and steps must not die out along a grazing ray
constexpr double kCrossing = 1e-7;     ///< metres: how well a crossing is found

struct Span {
  double from, to;
  bool empty() const { return !(from < to); }
};

/// Part of the ray, from 0 to max_distance, within the ellipsoid of these half axes about the origin.
Span within_ellipsoid(const Vec3d& origin, const Vec3d& direction, const Vec3d& axes, double max_distance) {
  const Vec3d o = origin.cwiseQuotient(axes), d = direction.cwiseQuotient(axes);
  const double a = d.squaredNorm(), b = o.dot(d), c = o.squaredNorm() - 1, root2 = b * b - a * c;
  if (!(root2 > 0)) return {1, 0};
  const double root = std::sqrt(root2);
  return {std::max(0.0, (-b - root) / a), std::min(max_distance, (-b + root) / a)};
}

Span within_box(const Vec3d& origin, const Vec3d& direction, const Vec3d& min, const Vec3d& max, double max_distance) {
  Span span{0, max_distance};
  for (int c = 0; c < 3; ++c) {
    if (direction[c] == 0) {
      if (origin[c] < min[c] || origin[c] > max[c]) return {1, 0};
      continue;
    }
    const double a = (min[c] - origin[c]) / direction[c], b = (max[c] - origin[c]) / direction[c];
    span.from = std::max(span.from, std::min(a, b));
    span.to = std::min(span.to, std::max(a, b));
  }
  return span;
}

/// Height over the surface, and how fast it can fall from here on, a metre of the ray; not positive: it never will.
struct Clearance {
  double height, falls;
};

/// Where the height falls below 0 on the span; < 0: nowhere. Steps never pass over a crossing but for details under kFinestStep; the crossing is then bisected.
template <class F>
double march(const Span& span, const F& clearance) {
  double t = span.from, before = t;
  while (true) {
    const Clearance here = clearance(t);
    if (here.height < 0) break;
    if (t >= span.to || !(here.falls > 0)) return -1;
    before = t;
    t = std::min(span.to, t + std::max(here.height / here.falls, kFinestStep));
  }
  double outside = before, inside = t;
  while (inside - outside > kCrossing) {
    const double middle = (outside + inside) / 2;
    (clearance(middle).height < 0 ? inside : outside) = middle;
  }
  return outside;
}

class SphereBody final : public SynthBody {
 public:
  std::optional<BodyHit> hit(const Vec3d& origin, const Vec3d& direction, double max_distance) const override {
    const double b = origin.dot(direction), root2 = b * b - origin.squaredNorm() + kSphereRadius * kSphereRadius;
    if (!(root2 > 0)) return std::nullopt;
    const double t = -b - std::sqrt(root2);
    if (!(t > 0 && t < max_distance)) return std::nullopt;
    const Vec3d p = origin + t * direction;
    return BodyHit{t, p, p.normalized()};
  }
};

/// statue_radius() over the faces of a cube, interpolated: some hundred sines for every step of a ray would be slow. The error is far below kLift (the test
/// measures it), and what a ray meets is put on the true surface.
class RadiusTable {
 public:
  RadiusTable() : radius_(6 * kNodes * kNodes) {
    std::vector<double> slopes(6 * kNodes), factors(6 * kNodes);
    parallel_blocks(slopes.size(), 8, [&](std::size_t begin, std::size_t end) {
      for (std::size_t row = begin; row < end; ++row)
        for (std::size_t column = 0; column < kNodes; ++column) {
          const Vec3d d = direction(row / kNodes, column, row % kNodes);
          const StarRadius s = statue_radius(d);
          radius_[row * kNodes + column] = static_cast<float>(s.radius);
          slopes[row] = std::max(slopes[row], (s.gradient - s.gradient.dot(d) * d).norm() / s.radius);
          factors[row] = std::max(factors[row], (s.radius * d).cwiseQuotient(Vec3d(0.5, 0.45, 0.9)).norm());
        }
    });
    steepest_ = 1.05 * *std::max_element(slopes.begin(), slopes.end());
    axes_ = 1.01 * *std::max_element(factors.begin(), factors.end()) * Vec3d(0.5, 0.45, 0.9);
  }

  double operator()(const Vec3d& p) const {
    int axis = 0;
    const Vec3d size = p.cwiseAbs();
    size.maxCoeff(&axis);
    const std::size_t face = 2 * static_cast<std::size_t>(axis) + (p[axis] < 0);
    const double a = at(p[(axis + 1) % 3] / size[axis]), b = at(p[(axis + 2) % 3] / size[axis]);
    const auto i = std::min(static_cast<std::size_t>(a), kNodes - 2), j = std::min(static_cast<std::size_t>(b), kNodes - 2);
    const double x = a - static_cast<double>(i), y = b - static_cast<double>(j);
    const float* r = radius_.data() + (face * kNodes + j) * kNodes + i;
    const double low = static_cast<double>(r[0]) * (1 - x) + static_cast<double>(r[1]) * x;
    return low * (1 - y) + (static_cast<double>(r[kNodes]) * (1 - x) + static_cast<double>(r[kNodes + 1]) * x) * y;
  }
  /// Largest |grad r| / r over the unit sphere.
  double steepest() const { return steepest_; }
  /// Of an ellipsoid that holds the statue.
  const Vec3d& axes() const { return axes_; }

 private:
  static constexpr std::size_t kNodes = 513;
  static double at(double tangent) { return std::max(0.0, (tangent + 1) / 2 * (kNodes - 1)); }
  static Vec3d direction(std::size_t face, std::size_t i, std::size_t j) {
    Vec3d d;
    const int axis = static_cast<int>(face / 2);
    d[axis] = face % 2 ? -1 : 1;
    d[(axis + 1) % 3] = 2.0 * static_cast<double>(i) / (kNodes - 1) - 1;
    d[(axis + 2) % 3] = 2.0 * static_cast<double>(j) / (kNodes - 1) - 1;
    return d.normalized();
  }
  std::vector<float> radius_;
  double steepest_ = 0;
  Vec3d axes_;
};

class StatueBody final : public SynthBody {
 public:
  std::optional<BodyHit> hit(const Vec3d& origin, const Vec3d& direction, double max_distance) const override {
    const double t = first(origin, direction, max_distance);
    if (t < 0) return std::nullopt;
    const Vec3d p = origin + t * direction, d = p.normalized();
    const StarRadius s = statue_radius(d);
    const Vec3d n = (s.radius * d - (s.gradient - s.gradient.dot(d) * d)).normalized();
    // Along the radius onto the true surface: by the table's error, micrometres.
    return BodyHit{t, s.radius * d, n};
  }
  bool occluded(const Vec3d& origin, const Vec3d& direction, double max_distance) const override { return first(origin, direction, max_distance) >= 0; }

 private:
  double first(const Vec3d& origin, const Vec3d& direction, double max_distance) const {
    const Span span = within_ellipsoid(origin, direction, table_.axes(), max_distance);
    if (span.empty()) return -1;
    // |p| - r(p / |p|) grows by c along the radius, c being the cosine between ray and radius, and falls by at most s sqrt(1 - c^2) across it, s = max |grad r| / r,
    // as |p| >= r outside of the statue. c only grows along a ray: c = -1 / sqrt(1 + s^2), where the fall is steepest, may lie ahead or be passed.
    const double s = table_.steepest(), most = std::sqrt(1 + s * s);
    return march(span, [&](double t) {
      const Vec3d p = origin + t * direction;
      const double r = p.norm(), c = p.dot(direction) / r;
      return Clearance{r - table_(p), c * most > -1 ? s * std::sqrt(std::max(0.0, 1 - c * c)) - c : most};
    });
  }
  RadiusTable table_;
};

class WallBody final : public SynthBody {
 public:
  std::optional<BodyHit> hit(const Vec3d& origin, const Vec3d& direction, double max_distance) const override {
    const double t = first(origin, direction, max_distance);
    if (t < 0) return std::nullopt;
    const Vec3d p = origin + t * direction;
    const ReliefHeight h = wall_relief(p.x(), p.y());
    return BodyHit{t, {p.x(), p.y(), h.height}, Vec3d(-h.dx, -h.dy, 1).normalized()};
  }
  bool occluded(const Vec3d& origin, const Vec3d& direction, double max_distance) const override { return first(origin, direction, max_distance) >= 0; }

 private:
  static constexpr double kHighest = 0.0151, kSteepest = 2.6;   // a brick's 15 mm over its edge of 9 mm, 1.5 times as steep in its middle
  static double first(const Vec3d& origin, const Vec3d& direction, double max_distance) {
    // A little below the mortar: a ray that leaves the slab there has met the wall.
    const Vec3d half(kWallWidth / 2, kWallHeight / 2, 0);
    const Span span = within_box(origin, direction, -half - Vec3d(0, 0, 1e-9), half + Vec3d(0, 0, kHighest), max_distance);
    if (span.empty()) return -1;
    const double falls = kSteepest * direction.head<2>().norm() - direction.z();
    return march(span, [&](double t) {
      const Vec3d p = origin + t * direction;
      return Clearance{p.z() - wall_relief(p.x(), p.y()).height, falls};
    });
  }
};

class RoomBody final : public SynthBody {
 public:
  std::optional<BodyHit> hit(const Vec3d& origin, const Vec3d& direction, double max_distance) const override {
    BodyHit found;
    found.distance = max_distance;
    const Vec3d half(kRoomLength / 2, kRoomWidth / 2, kRoomHeight / 2);
    for (int c = 0; c < 3; ++c) {
      if (direction[c] == 0) continue;
      const double t = (std::copysign(half[c], direction[c]) - origin[c]) / direction[c];
      if (t > 0 && t < found.distance) found = {t, origin + t * direction, std::copysign(1.0, -direction[c]) * Vec3d::Unit(c)};
    }
    const Vec2d along = direction.head<2>();
    const double a = along.squaredNorm();
    if (a > 0)
      for (const Vec2d& centre : columns_) {
        const Vec2d o = origin.head<2>() - centre;
        const double b = o.dot(along), root2 = b * b - a * (o.squaredNorm() - kColumnRadius * kColumnRadius);
        if (!(root2 > 0)) continue;
        const double t = (-b - std::sqrt(root2)) / a;
        if (!(t > 0 && t < found.distance)) continue;
        const Vec3d p = origin + t * direction;
        found = {t, p, {(p.x() - centre.x()) / kColumnRadius, (p.y() - centre.y()) / kColumnRadius, 0}};
      }
    if (!(found.distance < max_distance)) return std::nullopt;
    return found;
  }
  bool is_closed() const override { return true; }

 private:
  std::vector<Vec2d> columns_ = room_columns();
};

}  // namespace

bool has_body(SynthKind kind) { return kind == SynthKind::kSphere || kind == SynthKind::kStatue || kind == SynthKind::kWall || kind == SynthKind::kRoom; }

std::unique_ptr<SynthBody> make_body(SynthKind kind) {
  switch (kind) {
    case SynthKind::kSphere: return std::make_unique<SphereBody>();
    case SynthKind::kStatue: return std::make_unique<StatueBody>();
    case SynthKind::kWall: return std::make_unique<WallBody>();
    case SynthKind::kRoom: return std::make_unique<RoomBody>();
    case SynthKind::kDuplicates:
    case SynthKind::kOutlier:
    case SynthKind::kVolume:
    case SynthKind::kLine: break;
  }
  return nullptr;
}

}  // namespace chiaro::tools
