#include <algorithm>
#include <array>
#include <cmath>
#include <limits>

#include "stream/store/neighbour_walk.h"
#include "stream/store/plane_fit.h"
#include "stream/store/tangent_cell.h"

namespace chiaro::stream {
namespace {

class RadiusFitter {
 public:
  RadiusFitter(const HaloChunk& own, const FitOptions& options, std::vector<RadiusFit>& fits) : own_(own), options_(options), fits_(fits) {}

  static constexpr bool kNeedsNormals = true, kFitsGroups = false;
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

void fit_radii_of(Neighbourhood& around, const FitOptions& options, std::vector<RadiusFit>& fits) {
  fits.assign(around.own().size, {});
  RadiusFitter fitter(around.own(), options, fits);
  Walker<RadiusFitter>(around, options, fitter).run();
}

}  // namespace chiaro::stream
