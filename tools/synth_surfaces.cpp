#include "tools/synth_surfaces.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <numbers>
#include <vector>

#include "stream/base/rng.h"

namespace chiaro::tools {
namespace {

constexpr double kPi = std::numbers::pi;

/// Lambert's cylindrical map: equal areas of the square are equal solid angles. u: longitude, v: from the south pole to the north.
Vec3d direction_at(double u, double v) {
  const double z = 2 * v - 1, r = std::sqrt(std::max(0.0, 1 - z * z)), phi = 2 * kPi * u;
  return {r * std::cos(phi), r * std::sin(phi), z};
}

class Sphere final : public Sheet {
 public:
  SheetPoint at(double u, double v) const override {
    const Vec3d d = direction_at(u, v);
    return {kSphereRadius * d, d, 4 * kPi * kSphereRadius * kSphereRadius};
  }
  int probes() const override { return 1; }
};

class Statue final : public Sheet {
 public:
  SheetPoint at(double u, double v) const override {
    const Vec3d d = direction_at(u, v);
    const StarRadius s = statue_radius(d);
    const Vec3d along = s.gradient - s.gradient.dot(d) * d;   // over the unit sphere
    // The surface is r(d) d: its normal is r d - grad r, and its area over solid angle r sqrt(r^2 + |grad r|^2).
    const Vec3d n = s.radius * d - along;
    return {s.radius * d, n.normalized(), 4 * kPi * s.radius * n.norm()};
  }
  int cells() const override { return 128; }
};

class Wall final : public Sheet {
 public:
  SheetPoint at(double u, double v) const override {
    const double x = (u - 0.5) * kWallWidth, y = (v - 0.5) * kWallHeight;
    const ReliefHeight h = wall_relief(x, y);
    const Vec3d n(-h.dx, -h.dy, 1);
    return {{x, y, h.height}, n.normalized(), kWallWidth * kWallHeight * n.norm()};
  }
  int cells() const override { return 128; }
  int probes() const override { return 16; }
};

class Rectangle final : public Sheet {
 public:
  Rectangle(const Vec3d& corner, const Vec3d& along_u, const Vec3d& along_v, bool columns_stand_here)
      : corner_(corner), u_(along_u), v_(along_v), cross_(along_u.cross(along_v)), holes_(columns_stand_here ? room_columns() : std::vector<Vec2d>{}) {}
  SheetPoint at(double u, double v) const override {
    SheetPoint p{corner_ + u * u_ + v * v_, cross_.normalized(), cross_.norm()};
    for (const Vec2d& c : holes_)
      if ((p.position.head<2>() - c).squaredNorm() < kColumnRadius * kColumnRadius) p.stretch = 0;
    return p;
  }
  int cells() const override { return holes_.empty() ? 32 : 64; }
  int probes() const override { return holes_.empty() ? 1 : 8; }

 private:
  Vec3d corner_, u_, v_, cross_;
  std::vector<Vec2d> holes_;
};

class Column final : public Sheet {
 public:
  explicit Column(const Vec2d& centre) : centre_(centre) {}
  SheetPoint at(double u, double v) const override {
    const Vec3d n(std::cos(2 * kPi * u), std::sin(2 * kPi * u), 0);
    return {Vec3d(centre_.x(), centre_.y(), (v - 0.5) * kRoomHeight) + kColumnRadius * n, n, 2 * kPi * kColumnRadius * kRoomHeight};
  }
  int probes() const override { return 1; }

 private:
  Vec2d centre_;
};

struct Fold {
  Vec3d wave;      ///< radians over the unit sphere
  double phase, height;
};

/// Drawn once from a fixed seed: every statue has the same shape.
std::array<Fold, 28> make_folds() {
  constexpr std::uint64_t kShape = 20110707;
  std::array<Fold, 28> folds;
  for (std::size_t i = 0; i < folds.size(); ++i) {
    const auto a = uniform01x4(kShape, Purpose::kSynth, i, 0), b = uniform01x4(kShape, Purpose::kSynth, i, 1);
    const double frequency = 4 * std::pow(14.0, static_cast<double>(i) / (folds.size() - 1.0));   // 4 .. 56
    // Upright folds, as of a garment: little change with height.
    Vec3d wave = direction_at(a[0], a[1]);
    wave.z() *= 0.35;
    folds[i] = {wave * frequency, 2 * kPi * a[2], (0.5 + b[0]) * 0.14 / frequency};
  }
  return folds;
}

struct Cavity {
  Vec3d direction;
  double depth, width;
};

std::array<Cavity, 6> make_cavities() {
  std::array<Cavity, 6> cavities;
  for (std::size_t i = 0; i < cavities.size(); ++i) {
    const double k = static_cast<double>(i);
    cavities[i] = {direction_at(std::fmod(0.13 + 0.381966 * k, 1.0), 0.2 + 0.11 * k), 0.06 + 0.03 * std::fmod(0.7 * k, 1.0), 0.02 + 0.01 * std::fmod(0.45 * k, 1.0)};
  }
  return cavities;
}

/// 0 below, 1 above, and the slope between.
std::array<double, 2> smooth_step(double from, double to, double x) {
  const double t = std::clamp((x - from) / (to - from), 0.0, 1.0);
  return {t * t * (3 - 2 * t), t > 0 && t < 1 ? 6 * t * (1 - t) / (to - from) : 0.0};
}

constexpr std::int64_t kCourses = 24, kBricks = 12;   // of a table that holds the wall, to each side of its middle

double draw_proud(std::int64_t course, std::int64_t brick) {
  constexpr double kProud = 0.012;
  return kProud + 0.003 * (2 * static_cast<double>(uniform01(7, Purpose::kSynth, static_cast<std::uint64_t>(course * 4096 + brick), 0)) - 1);
}

std::vector<double> make_prouds() {
  std::vector<double> prouds;
  for (std::int64_t course = -kCourses; course < kCourses; ++course)
    for (std::int64_t brick = -kBricks; brick < kBricks; ++brick) prouds.push_back(draw_proud(course, brick));
  return prouds;
}

/// How far a brick stands out. Rays ask for it far more often than there are bricks.
double brick_proud(std::int64_t course, std::int64_t brick) {
  static const std::vector<double> kProuds = make_prouds();
  if (course < -kCourses || course >= kCourses || brick < -kBricks || brick >= kBricks) return draw_proud(course, brick);
  return kProuds[static_cast<std::size_t>((course + kCourses) * 2 * kBricks + brick + kBricks)];
}

}  // namespace

ReliefHeight wall_relief(double x, double y) {
  constexpr double kLength = 0.25, kCourse = 0.075, kJointHalf = 0.004, kEdge = 0.009;
  const double course = std::floor(y / kCourse), shifted = x / kLength + (course != 2 * std::floor(course / 2) ? 0.5 : 0.0), brick = std::floor(shifted);
  const double fx = (shifted - brick) * kLength, fy = y - course * kCourse;
  // Signed distance from the nearest joint's middle, both ways.
  const double ax = std::min(fx, kLength - fx), ay = std::min(fy, kCourse - fy), sx = fx < kLength / 2 ? 1 : -1, sy = fy < kCourse / 2 ? 1 : -1;
  const auto bx = smooth_step(kJointHalf, kJointHalf + kEdge, ax), by = smooth_step(kJointHalf, kJointHalf + kEdge, ay);
  const double proud = brick_proud(static_cast<std::int64_t>(course), static_cast<std::int64_t>(brick));
  return {proud * bx[0] * by[0], proud * bx[1] * sx * by[0], proud * bx[0] * by[1] * sy};
}

StarRadius statue_radius(const Vec3d& d) {
  static const auto kFolds = make_folds();
  static const auto kCavities = make_cavities();
  const Vec3d axes2(0.50 * 0.50, 0.45 * 0.45, 0.90 * 0.90);
  const Vec3d scaled = d.cwiseQuotient(axes2);
  const double base = 1 / std::sqrt(d.dot(scaled));
  const Vec3d base_gradient = -base * base * base * scaled;
  double factor = 1;
  Vec3d gradient = Vec3d::Zero();
  for (const Fold& f : kFolds) {
    const double angle = f.wave.dot(d) + f.phase;
    factor += f.height * std::sin(angle);
    gradient += f.height * std::cos(angle) * f.wave;
  }
  for (const Cavity& c : kCavities) {
    const double depth = c.depth * std::exp((c.direction.dot(d) - 1) / c.width);
    factor -= depth;
    gradient -= depth / c.width * c.direction;
  }
  return {base * factor, base_gradient * factor + base * gradient};
}

std::vector<Vec2d> room_columns() {
  std::vector<Vec2d> centres;
  for (const double x : {-2.5, 0.0, 2.5})
    for (const double y : {-2.0, 2.0}) centres.emplace_back(x, y);
  return centres;
}

std::vector<std::unique_ptr<Sheet>> sphere_sheets() {
  std::vector<std::unique_ptr<Sheet>> sheets;
  sheets.push_back(std::make_unique<Sphere>());
  return sheets;
}

std::vector<std::unique_ptr<Sheet>> statue_sheets() {
  std::vector<std::unique_ptr<Sheet>> sheets;
  sheets.push_back(std::make_unique<Statue>());
  return sheets;
}

std::vector<std::unique_ptr<Sheet>> wall_sheets() {
  std::vector<std::unique_ptr<Sheet>> sheets;
  sheets.push_back(std::make_unique<Wall>());
  return sheets;
}

std::vector<std::unique_ptr<Sheet>> room_sheets() {
  const double x = kRoomLength / 2, y = kRoomWidth / 2, z = kRoomHeight / 2;
  const Vec3d ex(kRoomLength, 0, 0), ey(0, kRoomWidth, 0), ez(0, 0, kRoomHeight);
  std::vector<std::unique_ptr<Sheet>> sheets;
  const auto add = [&](const Vec3d& corner, const Vec3d& u, const Vec3d& v, bool columns) { sheets.push_back(std::make_unique<Rectangle>(corner, u, v, columns)); };
  add({-x, -y, -z}, ex, ey, true);    // floor, normal up; all normals point into the room
  add({-x, -y, z}, ey, ex, true);     // ceiling
  add({-x, -y, -z}, ey, ez, false);
  add({x, -y, -z}, ez, ey, false);
  add({-x, -y, -z}, ez, ex, false);
  add({-x, y, -z}, ex, ez, false);
  for (const Vec2d& c : room_columns()) sheets.push_back(std::make_unique<Column>(c));
  return sheets;
}

}  // namespace chiaro::tools
