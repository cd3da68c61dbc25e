#include "blend/insert.h"

#include <algorithm>
#include <cmath>

namespace chiaro::blend {
namespace {

constexpr float kOwnReach = 0.85f;     // spacings: a Voronoi cell rarely goes farther
constexpr float kKernel = 1.6f;        // spacings: discs that near take part in the mean
constexpr float kSameFace = 0.7f;      // cosine between normals of one face
constexpr float kLeastAlong = 0.3f;    // a plane seen at less than this says no height
constexpr float kAround = 2;           // spacings: discs that near bound what is surface

/// The axis of the lattice and the two that it spans.
struct Axes {
  int up = 2, u = 0, v = 1;
};
Axes axes_of(const Vec3f& normal) {
  int up = 0;
  normal.cwiseAbs().maxCoeff(&up);
  return {up, (up + 1) % 3, (up + 2) % 3};
}

/// Discs of the same face as the one that is refined, itself among them, normals turned alike.
std::vector<NearDisc> face_of(const RefinedDisc& disc, const std::vector<NearDisc>& around, const Axes& axes) {
  std::vector<NearDisc> face{{Vec3f::Zero(), disc.normal}};
  for (const NearDisc& d : around) {
    const float cosine = disc.normal.dot(d.normal);
    if ((disc.oriented ? cosine : std::abs(cosine)) < kSameFace || std::abs(d.normal[axes.up]) < kLeastAlong) continue;
    if (std::abs(disc.normal.dot(d.offset)) > disc.spacing) continue;   // another layer
    face.push_back({d.offset, cosine < 0 ? Vec3f(-d.normal) : d.normal});
  }
  return face;
}

/// Puts p on the mean of the discs' planes around it, along the lattice's axis; the mean of their normals is returned.
Vec3f lift(const std::vector<NearDisc>& face, const Axes& axes, float reach, Vec3f& p) {
  float weights = 0, height = 0;
  Vec3f normal = Vec3f::Zero();
  for (const NearDisc& d : face) {
    const Vec3f away = p - d.offset;
    const float k = 1 - away.squaredNorm() / (reach * reach);
    if (!(k > 0)) continue;
    weights += k * k;
    height += k * k * (d.offset[axes.up] - (d.normal[axes.u] * away[axes.u] + d.normal[axes.v] * away[axes.v]) / d.normal[axes.up]);
    normal += k * k * d.normal;
  }
  if (weights > 0) p[axes.up] = height / weights;
  return weights > 0 ? Vec3f(normal.normalized()) : face.front().normal;
}

/// Grows with the angle as that does, from 0 to 4; half a turn is 2.
float turn_of(float x, float y) {
  const float t = y / (std::abs(x) + std::abs(y));
  return x < 0 ? 2 - t : y < 0 ? 4 + t : t;
}

/// Discs of the same face lie around p, less than half a turn from one to the next: what lies beyond a border is not surrounded.
bool is_surrounded(const std::vector<NearDisc>& face, const Axes& axes, const Vec3f& p, float reach, std::vector<float>& turns) {
  turns.clear();
  for (const NearDisc& d : face)
    if (const Vec3f to = d.offset - p; to.squaredNorm() < reach * reach && std::abs(to[axes.u]) + std::abs(to[axes.v]) > 0) turns.push_back(turn_of(to[axes.u], to[axes.v]));
  if (turns.size() < 3) return false;
  std::sort(turns.begin(), turns.end());
  float widest = turns.front() + 4 - turns.back();
  for (std::size_t i = 1; i < turns.size(); ++i) widest = std::max(widest, turns[i] - turns[i - 1]);
  return widest < 2;
}

bool is_nearest(const std::vector<NearDisc>& around, const Vec3f& p, float squared) {
  return std::none_of(around.begin(), around.end(), [&](const NearDisc& d) { return (p - d.offset).squaredNorm() < squared; });
}

}  // namespace

double lattice_spacing(double edge, int level, float along) { return edge * std::exp2(-0.5 * level) / std::sqrt(static_cast<double>(along)); }

int lattice_level(double edge, double wanted, float along) {
  constexpr int kFinest = 80;   // 2^-40 of the edge
  const double level = 2 * std::log2(edge / (wanted * std::sqrt(static_cast<double>(along))));
  return static_cast<int>(std::lround(std::clamp(level, 0.0, static_cast<double>(kFinest))));
}

void insert_around(const RefinedDisc& disc, const std::vector<NearDisc>& around, double edge, int level, std::vector<NewPoint>& points) {
  const Axes axes = axes_of(disc.normal);
  const std::vector<NearDisc> face = face_of(disc, around, axes);
  // Odd levels are the even one below with every other point left out, as on a chessboard.
  const bool is_odd = level % 2 != 0;
  const double step = edge * std::exp2(-((level + 1) / 2)), reach = static_cast<double>(kOwnReach * disc.spacing);
  const auto least = static_cast<float>(0.5 * lattice_spacing(edge, level, std::abs(disc.normal[axes.up])));
  std::vector<float> turns;
  const double u = disc.from_anchor[axes.u], v = disc.from_anchor[axes.v];
  for (auto a = static_cast<std::int64_t>(std::ceil((u - reach) / step)); static_cast<double>(a) * step <= u + reach; ++a)
    for (auto b = static_cast<std::int64_t>(std::ceil((v - reach) / step)); static_cast<double>(b) * step <= v + reach; ++b) {
      if (is_odd && ((a + b) & 1) != 0) continue;
      Vec3f p = Vec3f::Zero();
      p[axes.u] = static_cast<float>(static_cast<double>(a) * step - u);
      p[axes.v] = static_cast<float>(static_cast<double>(b) * step - v);
      p[axes.up] = -(disc.normal[axes.u] * p[axes.u] + disc.normal[axes.v] * p[axes.v]) / disc.normal[axes.up];
      if (p.squaredNorm() > static_cast<float>(reach * reach)) continue;
      const Vec3f normal = lift(face, axes, kKernel * disc.spacing, p);
      const float squared = p.squaredNorm();
      if (squared < least * least || !is_nearest(around, p, squared) || !is_surrounded(face, axes, p, kAround * disc.spacing, turns)) continue;
      points.push_back({disc.from_anchor + p.cast<double>(), normal});
    }
}

}  // namespace chiaro::blend
