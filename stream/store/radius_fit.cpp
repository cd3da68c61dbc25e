#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <optional>
#include <span>

#include "stream/store/border_line.h"
#include "stream/store/neighbour_walk.h"
#include "stream/store/plane_fit.h"
#include "stream/store/tangent_cell.h"
#include "stream/store/tangent_kernels.h"

namespace chiaro::stream {
namespace {

class RadiusFitter {
 public:
  RadiusFitter(const HaloChunk& own, const FitOptions& options, std::vector<RadiusFit>& fits) : own_(own), options_(options), fits_(fits) {}

  static constexpr bool kNeedsNormals = true, kFitsGroups = false;
  static constexpr float kNearShare = 0.7f, kWideShare = 1.05f, kRunShare = 1.2f;

  /// Whether all of the candidates are turned like the point: no two of them are on different faces then.
  bool positions_tell_all(std::uint32_t i, const CandidateView& candidates) const { return all_alike(candidates, {own_.nx[i], own_.ny[i], own_.nz[i]}, kOneFace); }

  // The nearest of the neighbours settle most cells: what is further than twice the farthest corner cuts nothing. The others are looked at where they do not.
  void fit_nearest(const SearchGroup& group, const CandidateView& nearer, float near, const CandidateView& farther, float wide, std::array<bool, kLanes>& fitted) {
    const std::array<const CandidateView*, 2> both{&nearer, &farther};
    if (!nearer.nx) return fit_smooth(group, both, near, wide, fitted);
    // All lines first, then all cells: what has just been written in pieces is slow to read as a whole.
    for (std::size_t at = 0; at < group.size(); ++at) fitted[at] = start_lines(group, at, both, near, wide);
    for (std::size_t at = 0; at < group.size(); ++at)
      if (fitted[at]) start_cell(lines_[at], 3 * scale_of(group, at), cells_[at]);
    for (std::size_t at = 0; at < group.size(); ++at) fitted[at] = fitted[at] && fit_inside(group, at, both);
  }

  bool fit_near(const SearchGroup& group, std::size_t at, const CandidateView& view, const Selection& c) {
    const std::size_t i = group.begin + at;
    const float radius = group.radius[at];
    collect_within(view, own_.x[i], own_.y[i], own_.z[i], radius * radius, row_);
    if (row_.num > options_.most) return false;
    const std::array<const CandidateView*, 1> views{&view};
    if (!reaches_[at].saw_all() && start_lines(group, at, views, radius, radius)) {
      start_cell(lines_[at], 3 * scale_of(group, at), cells_[at]);
      if (fit_inside(group, at, views)) return true;
    }
    make_list(group, at);
    return fit_one(static_cast<std::uint32_t>(i), list_, c, false);
  }

  bool fit_one(std::uint32_t i, const NeighbourList& list, const Selection& c, bool last) {
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
  static constexpr float kSameFace = 0.9f;
  static constexpr float kEdgeReach = 2.2f, kOtherFace = 0.82f;
  static constexpr float kOneFace = 0.954f;     // half the angle of kOtherFace, and a little less
  static constexpr float kFirstShare = 0.68f;   // of the radius of the search: what is looked at first
  static constexpr float kAllNeighbours = 1e30f;
  static constexpr float kBorderReach = 3, kMostToBorder = 1, kBeyondBorder = 0.4f;
  static constexpr float kRidgeShare = 0.45f, kMostBeyondAll = 1.4f, kLeastOnRidge = 0.8f, kOverFarEdge = 0.25f;

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

  using Views = std::span<const CandidateView* const>;

  // Within which distances a point's neighbours have been looked at.
  struct Reach {
    float now = 0, most = 0;   // the views have all up to `most`
    bool all = false;          // and there are no others
    bool saw_all() const { return all && now == most; }
    float seen() const { return saw_all() ? kAllNeighbours : now; }
  };

  // False for what fit_inside() is not for.
  bool begin(const SearchGroup& group, std::size_t at, float edge_reach, float wide) {
    const std::size_t i = group.begin + at;
    const float radius = group.radius[at];
    reaches_[at] = {0, std::min(wide, radius), radius <= wide};
    if (radius == 0 || (own_.flags[i] & SurfelBlock::kIsolated) || edge_reach > reaches_[at].most) return false;
    frames_[at] = frame_of(i, edge_reach);
    return true;
  }

  // There are so many within what has been looked at that of all probably not all count.
  bool is_crowded(const SearchGroup& group, std::size_t at) const {
    const float share = reaches_[at].now / group.radius[at];
    return static_cast<float>(lines_[at].num) > share * share * static_cast<float>(options_.most);
  }

  // Lines to the nearest, of which the first view has all up to `near`. False for other faces and crowds, too.
  bool start_lines(const SearchGroup& group, std::size_t at, Views views, float near, float wide) {
    const float edge_reach = kEdgeReach * group.mean[at];
    if (!begin(group, at, edge_reach, wide)) return false;
    lines_[at].clear();
    if (!add_lines(group, at, views.first(1), std::min({near, reaches_[at].most, std::max(kFirstShare * group.radius[at], edge_reach)}))) return false;
    if (edge_reach > reaches_[at].now && !add_lines(group, at, views, reaches_[at].most)) return false;
    return !is_crowded(group, at);
  }

  // The same and more where there are no other faces.
  void fit_smooth(const SearchGroup& group, Views views, float near, float wide, std::array<bool, kLanes>& fitted) {
    for (std::size_t at = 0; at < group.size(); ++at) {
      const std::size_t i = group.begin + at;
      SmoothPoint& p = smooth_[at];
      p.wanted = begin(group, at, 0, wide);
      p.started = false;
      p.distance = 0;
      if (!p.wanted) continue;
      p.place = {own_.x[i], own_.y[i], own_.z[i]};
      p.frame = frames_[at];
      p.scale = scale_of(group, at);
      p.half = 3 * p.scale;
      p.reach = reaches_[at].now = std::min({near, reaches_[at].most, kFirstShare * group.radius[at]});
    }
    nearest_corners(*views[0], std::span(smooth_).first(group.size()), lines_, cells_);
    for (std::size_t at = 0; at < group.size(); ++at) {
      fitted[at] = smooth_[at].wanted && !is_crowded(group, at);
      if (fitted[at] && smooth_[at].distance > 0) set_inside(group, at, smooth_[at].distance);
      else fitted[at] = fitted[at] && fit_inside(group, at, views);
    }
  }

  // Those further away than has been looked at. False if one is on another face.
  bool add_lines(const SearchGroup& group, std::size_t at, Views views, float distance) {
    const std::size_t i = group.begin + at;
    Reach& reach = reaches_[at];
    const float above = reach.now * reach.now;
    reach.now = distance;
    for (const CandidateView* view : views) {
      if (lines_[at].add(*view, {own_.x[i], own_.y[i], own_.z[i]}, above, distance * distance, frames_[at])) continue;
      reach = {reach.most, reach.most, true};   // no more need be known
      return false;
    }
    return true;
  }

  // Along scan lines the nearest are much closer than the next line: the search radius knows.
  float scale_of(const SearchGroup& group, std::size_t at) const {
    const float radius = group.radius[at];
    return std::max(group.mean[at], radius < options_.max_radius ? radius / static_cast<float>(options_.radius_spacings) : 0.0f);
  }

  // What nearly all points are: amid a smooth surface, their cell closed by neighbours on all sides, where the surface goes on behind its farthest corner. The cell
  // has been started. False for all others.
  bool fit_inside(const SearchGroup& group, std::size_t at, Views views) {
    const float scale = scale_of(group, at);
    const Reach& reach = reaches_[at];
    for (;;) {
      const Corner corner = farthest_corner(lines_[at], cells_[at], 3 * scale);
      const float d = corner.distance;
      if (d > 0 && 2 * d <= reach.seen() && (d <= scale || lines_[at].is_beyond(corner.x / d, corner.y / d, d))) {
        set_inside(group, at, d);
        return true;
      }
      if (reach.now == reach.most || !add_lines(group, at, views, reach.most) || lines_[at].num > options_.most) return false;
    }
  }

  void set_inside(const SearchGroup& group, std::size_t at, float corner_distance) {
    fits_[group.begin + at] = RadiusFit{};
    fits_[group.begin + at].mean_of_nearest = group.mean[at];
    fits_[group.begin + at].radius = disc_radius(corner_distance, scale_of(group, at), false);
  }

  // Two unit vectors across the normal. source: Duff et al., "Building an Orthonormal Basis, Revisited", JCGT 2017.
  TangentFrame frame_of(std::size_t i, float edge_reach) const {
    const float x = own_.nx[i], y = own_.ny[i], z = own_.nz[i], sign = std::copysign(1.0f, z), a = -1 / (sign + z), b = x * y * a;
    return {{x, y, z}, {1 + sign * x * x * a, sign * b, -sign * x}, {b, sign + y * y * a, -y}, (own_.flags[i] & SurfelBlock::kOriented) != 0, edge_reach, kOtherFace};
  }

  static float disc_radius(float within, float scale, bool open) {
    if (!open) return std::min(1.1f * within, 3 * scale);
    return std::clamp(1.1f * within, 0.75f * scale, std::max(1.1f * within, scale));
  }

  struct Corner {
    float x = 0, y = 0, distance = 0;
  };
  // The farthest corner of the cell that the lines make in the tangent plane; distance 0 if these do not close it. The cell as it stands is too large; its corners
  // are cut, the farthest first, until the farthest is right: all others are nearer then.
  static Corner farthest_corner(const TangentLines& lines, CellCorners& c, float half) {
    for (std::size_t cuts = 0; cuts < CellCorners::kMost; ++cuts) {
      const std::size_t at = c.farthest();
      const float squared = c.squared[at], x = c.x[at], y = c.y[at];
      if (!(squared >= 0 && std::isfinite(squared))) return {};
      const std::size_t cut = lines.line_before(x, y);
      if (cut < lines.num) {
        if (!c.cut(at, lines.wx[cut], lines.wy[cut])) return {};
        continue;
      }
      const float d = std::sqrt(squared);
      if (std::max(std::abs(x), std::abs(y)) >= 0.9999f * half) return {};
      return {x, y, d};
    }
    return {};
  }

  // The nearest first: they settle most of the cell.
  void make_list(const SearchGroup& group, std::size_t at_point) {
    list_.nearest_squared = group.nearest_of(at_point);
    list_.resize(row_.num);
    const float near = list_.nearest_squared[kNearest - 1];
    std::size_t at = 0;
    for (const bool first : {true, false})
      for (std::size_t k = 0; k < row_.num; ++k)
        if ((row_.distance_squared[k] <= near) == first) list_.set(at++, row_.x[k], row_.y[k], row_.z[k], row_.distance_squared[k], row_.candidate[k]);
    list_.radius = group.radius[at_point];
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
    bool holds(const Vec3f& offset, float distance_squared, std::uint32_t j, const Selection& c) const {
      const float height = normal.dot(offset);
      if (4 * height * height > distance_squared) return false;
      const float cosine = normal.dot(Vec3f(c.nx[j], c.ny[j], c.nz[j]));
      return (oriented && c.oriented[j] != 0 ? cosine : std::abs(cosine)) >= 0.5f;
    }
  };

  // Where a disc's plane meets that of another face, in the disc's plane: x . across = distance.
  struct EdgeLine {
    Vec3f across;
    float distance;
    Vec3f points;   // mean of the other face's
    void turn() {
      across = -across;
      distance = -distance;
    }
  };

  // Of the neighbours for which is_there() holds and that are turned away from the normal: the plane through those whose normals agree with the nearest one's.
  template <class IsThere>
  std::optional<EdgeLine> nearest_edge(const Vec3f& normal, const NeighbourList& list, const Selection& c, float mean, const IsThere& is_there) const {
    const auto is_turned = [&](std::size_t k) { return is_there(k) && std::abs(normal.dot(normal_of(list, k, c))) < kOtherFace; };
    std::size_t nearest = list.size();
    for (std::size_t k = 0; k < list.size(); ++k)
      if ((nearest == list.size() || list.distance_squared[k] < list.distance_squared[nearest]) && is_turned(k)) nearest = k;
    if (nearest == list.size()) return std::nullopt;
    const Vec3f first = normal_of(list, nearest, c);
    Vec3f other = Vec3f::Zero(), at = Vec3f::Zero();
    float weight = 0;
    for (std::size_t k = 0; k < list.size(); ++k) {
      if (!is_turned(k)) continue;
      const Vec3f n = normal_of(list, k, c);
      const float cosine = n.dot(first);
      if (std::abs(cosine) <= kSameFace) continue;
      const float w = std::exp(-list.distance_squared[k] / (mean * mean));
      other += (cosine < 0 ? -w : w) * n;
      at += w * list.offset(k);
      weight += w;
    }
    at /= weight;
    other.normalize();
    const Vec3f across = other - other.dot(normal) * normal;
    const float length = across.norm();
    if (!(length > 0.3f)) return std::nullopt;
    return EdgeLine{across / length, other.dot(at) / length, at};
  }

  // The disc ends where it meets the nearest other face within kEdgeReach mean distances, unless its own face goes on behind it.
  void clip_at_edge(std::uint32_t i, const NeighbourList& list, const Selection& c) {
    constexpr float kBehind = 0.6f, kMargin = 0.1f, kOpposite = -0.3f;
    far_edge_ = kAllNeighbours;
    const float mean = fits_[i].mean_of_nearest, reach = kEdgeReach * mean, reach2 = reach * reach;
    const Vec3f normal = own_normal(i);
    const auto is_near = [&](std::size_t k) { return list.distance_squared[k] <= reach2; };
    const auto is_own = [&](std::size_t k) { return is_near(k) && std::abs(normal.dot(normal_of(list, k, c))) > kSameFace; };
    auto edge = nearest_edge(normal, list, c, mean, is_near);
    if (!edge) return;
    Vec3f own_side = Vec3f::Zero();
    for (std::size_t k = 0; k < list.size(); ++k)
      if (is_own(k)) own_side += list.offset(k);
    if (own_side.dot(edge->across) > 0) edge->turn();
    if (edge->distance < -kBehind * mean) return;
    int behind = 0;
    for (std::size_t k = 0; k < list.size(); ++k) behind += is_own(k) && list.offset(k).dot(edge->across) > edge->distance + kBehind * mean;
    if (behind > 1) return;
    fits_[i].clip_across = edge->across;
    fits_[i].clip_distance = std::max(0.0f, edge->distance) + kMargin * mean;
    // A second face on the other side.
    auto far = nearest_edge(normal, list, c, mean, [&](std::size_t k) { return is_near(k) && list.offset(k).dot(edge->across) < 0; });
    if (!far) return;
    if (far->points.dot(far->across) < 0) far->turn();
    if (far->across.dot(edge->across) < kOpposite) far_edge_ = std::max(0.0f, far->distance);
  }

  Vec3f own_normal(std::uint32_t i) const { return {own_.nx[i], own_.ny[i], own_.nz[i]}; }

  static Vec3f normal_of(const NeighbourList& list, std::size_t k, const Selection& c) {
    const std::uint32_t j = list.candidate[k];
    return {c.nx[j], c.ny[j], c.nz[j]};
  }

  float fit(std::uint32_t i, const NeighbourList& list, const Selection& c) {
    const float mean = mean_distance(list.nearest_squared);
    if (list.size() == 0) return options_.lone_radius;
    if (list.size() < 3 || (own_.flags[i] & SurfelBlock::kIsolated)) return std::min(mean, options_.lone_radius);
    // Along scan lines the nearest are much closer than the next line: the search radius knows.
    const float scale = std::max(mean, list.radius < options_.max_radius ? list.radius / static_cast<float>(options_.radius_spacings) : 0.0f);
    const Face face{own_normal(i), (own_.flags[i] & SurfelBlock::kOriented) != 0};
    project(face, list);
    bool of_all = true;
    TangentCell cell = cell_of(face, list, c, scale, false, of_all);
    if (!of_all && (is_ridge(face, list, c, kEdgeReach * mean) || (!cell.bounded() && few_on_face(face, list, c)))) cell = cell_of(face, list, c, scale, true, of_all);
    const float farthest_of_all = of_all ? cell.farthest_squared() : -1;
    float within = 0;   // the farthest corner that lies inside the surface
    bool open = false;
    bool clipped = cut_cell(i, face, scale, cell, within, open);
    if (open && !clipped && find_border(i, face, scale)) cut_cell(i, face, scale, cell, within, open);
    // One line can be cut off. Where a second face begins on the other side, only a smaller disc keeps from standing out over it.
    const float radius = std::min(disc_radius(within, scale, open), std::max(kLeastOnRidge, far_edge_ / mean + kOverFarEdge) * mean);
    if (radius <= kMostBeyondAll * scale) return radius;
    // Near an edge the disc reaches over what belongs to points of the other face, but not as far as those that stand out of the surface would.
    const float farthest = farthest_of_all >= 0 ? farthest_of_all : cell_of(face, list, c, scale, true, of_all).farthest_squared();
    return std::min(radius, std::max(scale, kMostBeyondAll * 1.1f * std::sqrt(farthest)));
  }

  // Ends the cell where the disc ends; does it reach that far?
  bool cut_cell(std::uint32_t i, const Face& face, float scale, TangentCell& cell, float& within, bool& open) const {
    const Vec3f& across_edge = fits_[i].clip_across;
    const Vec3f axis = across(face.normal);
    const float edge_u = axis.dot(across_edge), edge_v = face.normal.cross(axis).dot(across_edge), edge_distance = fits_[i].clip_distance;
    const bool clipped = !across_edge.isZero() && cell.cuts(edge_u, edge_v, edge_distance);
    if (clipped) cell.clip(edge_u, edge_v, edge_distance);
    within = 0;
    open = false;
    cell.for_corners([&](float x, float y) {
      const float d = std::sqrt(x * x + y * y);
      const bool on_edge = clipped && d <= 2 * scale && edge_u * x + edge_v * y > edge_distance - 0.01f * scale;
      if (d <= scale || on_edge || is_inside(x / d, y / d, d)) within = std::max(within, d);
      else open = true;
    });
    return clipped;
  }

  // Where the surface ends with nothing behind it, the disc ends, too.
  bool find_border(std::uint32_t i, const Face& face, float scale) {
    const auto border = find_border_line(tangent_u_, tangent_v_, kBorderReach * scale, kMostToBorder * scale, kBeyondBorder * scale);
    if (!border) return false;
    const Vec3f axis = across(face.normal);
    fits_[i].clip_across = border->u * axis + border->v * face.normal.cross(axis);
    fits_[i].clip_distance = border->distance;
    return true;
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

  struct FaceCounts {
    int near = 0, on_face = 0;
  };
  static FaceCounts count_on(const Face& face, const NeighbourList& list, const Selection& c, float reach2) {
    FaceCounts counts;
    for (std::size_t k = 0; k < list.size(); ++k) {
      if (list.distance_squared[k] > reach2) continue;
      ++counts.near;
      counts.on_face += face.holds(list.offset(k), list.distance_squared[k], list.candidate[k], c);
    }
    return counts;
  }

  static bool few_on_face(const Face& face, const NeighbourList& list, const Selection& c) { return count_on(face, list, c, kAllNeighbours).on_face < 5; }

  // On a ridge or a corner few of the nearest are on the point's own face, as its normal belongs to none of the faces that meet there. The discs of these reach
  // the edge; one as large as a cell that they do not bound would stand out far into the air.
  static bool is_ridge(const Face& face, const NeighbourList& list, const Selection& c, float reach) {
    const FaceCounts counts = count_on(face, list, c, reach * reach);
    return static_cast<float>(counts.on_face) < kRidgeShare * static_cast<float>(counts.near);
  }

  // of_all: nobody was left out.
  TangentCell cell_of(const Face& face, const NeighbourList& list, const Selection& c, float scale, bool use_all, bool& of_all) const {
    TangentCell cell(3 * scale);
    of_all = true;
    for (std::size_t k = 0; k < list.size(); ++k) {
      const float distance_squared = list.distance_squared[k];
      if (distance_squared > 4 * cell.farthest_squared()) continue;
      // The tangent plane meets the plane half-way between the two points where offset . x = distance^2 / 2.
      if (!cell.cuts(tangent_u_[k], tangent_v_[k], 0.5f * distance_squared)) continue;
      if (!use_all && !face.holds(list.offset(k), distance_squared, list.candidate[k], c)) {
        of_all = false;
        continue;
      }
      cell.clip(tangent_u_[k], tangent_v_[k], 0.5f * distance_squared);
    }
    return cell;
  }

  const HaloChunk& own_;
  const FitOptions& options_;
  std::vector<RadiusFit>& fits_;
  NeighbourRow row_;
  std::array<Reach, kLanes> reaches_;
  std::array<SmoothPoint, kLanes> smooth_;
  std::array<TangentFrame, kLanes> frames_;
  std::array<TangentLines, kLanes> lines_;
  std::array<CellCorners, kLanes> cells_;
  NeighbourList list_;
  float far_edge_ = 0;   // where a second face begins on the other side of the point; kAllNeighbours if none does
  std::vector<float> tangent_u_, tangent_v_;
};

}  // namespace

void fit_radii_of(Neighbourhood& around, const FitOptions& options, std::vector<RadiusFit>& fits) {
  fits.assign(around.own().size, {});
  RadiusFitter fitter(around.own(), options, fits);
  Walker<RadiusFitter>(around, options, fitter).run();
}

}  // namespace chiaro::stream
