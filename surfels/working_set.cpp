#include "surfels/working_set.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <queue>

#include "surfels/frustum.h"
#include "surfels/occlusion.h"

namespace chiaro::surfels {
namespace {

/// Below this the test costs more than it saves.
constexpr std::size_t kCullFrom = 24;
/// Rays along the longer side of the picture that look for what covers it, at most: gaps narrower than two of them may count as closed.
constexpr double kRaysAcross = 384;

double focal_px(const stream::Lens& lens) { return 0.5 * (lens.fx + lens.fy); }

/// Mean distance of a chunk's surfels. Inner chunks say the edge of their voxels instead, and a surface turned at random meets 1.5 of them for each square
/// of that edge.
double spacing_of(const stream::ChunkEntry& entry) { return static_cast<double>(entry.spacing) * (entry.is_leaf() ? 1.0 : std::sqrt(1 / 1.5)); }

/// A cut through what the frusta see: chunks whose surfels lie `spacing_px` apart at most, or leaves.
struct Cut {
  std::vector<std::uint32_t> chunks;
  std::uint64_t outside = 0;
};

Cut cut_at(const stream::Store& store, const std::vector<Frustum>& frusta, double focal, double spacing_px) {
  Cut cut;
  std::vector<std::uint32_t> stack{0};
  while (!stack.empty()) {
    const std::uint32_t c = stack.back();
    stack.pop_back();
    const stream::ChunkEntry& entry = store.chunks()[c];
    const Box3d box = store.ray_bounds(c);
    if (std::all_of(frusta.begin(), frusta.end(), [&](const Frustum& f) { return f.misses(box); })) {
      ++cut.outside;
      continue;
    }
    const double distance = std::max(distance_to_box(frusta[0].centre, box), 1e-9);
    if (entry.is_leaf() || spacing_of(entry) * focal / distance <= spacing_px) {
      cut.chunks.push_back(c);
      continue;
    }
    for (std::uint32_t i = 0; i < entry.num_children; ++i) stack.push_back(entry.first_child + i);
  }
  return cut;
}

/// Least depth along the view of what the cut may show.
double nearest_depth(const stream::Store& store, const Cut& cut, const Frustum& frustum) {
  const Vec3d forward = frustum.camera_from_world.row(2);
  double nearest = std::numeric_limits<double>::infinity();
  for (const std::uint32_t c : cut.chunks) {
    const Box3d box = store.ray_bounds(c);
    const Vec3d corner = (forward.array() > 0).select(box.min, box.max);
    nearest = std::min(nearest, forward.dot(corner - frustum.centre));
  }
  return nearest;
}

/// By how many pixels what the picture shows at `nearest` or beyond appears shifted from the light, at most. Never more than a quarter of the picture: very
/// near things would ask for everything.
double light_shift_px(const View& view, const Frustum& frustum, const Vec3d& light, double nearest) {
  const double most = 0.25 * view.rect.width();
  const Vec3d l = frustum.camera_from_world * (light - frustum.centre);
  if (frustum.inward.empty() || !(nearest > 0 && nearest > 2 * l.z())) return most;
  // Slopes from the light of a point at slope s and depth z: (s z - x) / (z - l_z). It goes from s, far away, to one side only.
  const auto shift = [&](double s, double x) { return std::abs((s * nearest - x) / (nearest - l.z()) - s); };
  const double slope = std::max({shift(frustum.x0, l.x()), shift(frustum.x1, l.x()), shift(frustum.y0, l.y()), shift(frustum.y1, l.y())});
  constexpr double kBentLens = 1.5;   // pixels of a lens are not everywhere equally many for a slope
  return std::min(most, kBentLens * slope * std::max(view.lens.fx, view.lens.fy));
}

/// Chunks of the cut that something nearer covers are taken out: returns how many. What covers is found with a coarser cut, in a small part of the time that
/// the cut itself would take.
std::uint64_t cull_hidden(const stream::Store& store, const std::vector<Frustum>& frusta, const View& view, const CutOptions& options, MemoryBudget& budget, Reporter& report, Cut& cut) {
  if (cut.chunks.size() < kCullFrom || std::any_of(frusta.begin(), frusta.end(), [](const Frustum& f) { return f.inward.empty(); })) return 0;
  const double focal = focal_px(view.lens);
  const double step_px = std::max(2 * options.pixel_error, std::max(view.rect.width(), view.rect.height()) / kRaysAcross);
  const Cut coarse = cut_at(store, frusta, focal, std::max(2 * options.pixel_error, step_px / 2));
  OcclusionOptions occlusion;
  occlusion.step = step_px / focal;
  const std::vector<DepthMap> maps = find_occlusion(store, coarse.chunks, frusta, occlusion, budget, report);
  return std::erase_if(cut.chunks, [&](std::uint32_t c) {
    const Box3d box = store.ray_bounds(c);
    return std::all_of(maps.begin(), maps.end(), [&](const DepthMap& m) { return m.hides(box); });
  });
}

}  // namespace

WorkingSet select_visible(const stream::Store& store, const View& view, const CutOptions& options, MemoryBudget& budget, Reporter& report) {
  std::vector<Frustum> frusta{make_frustum(view, options.margin_px, view.pose.centre_in_world())};
  // The flash sees the same surface from beside the camera: its cone is taken wider by what that makes.
  const double nearest = view.lights_in_world.empty() ? 0 : nearest_depth(store, cut_at(store, frusta, focal_px(view.lens), options.pixel_error), frusta[0]);
  for (const Vec3d& light : view.lights_in_world) frusta.push_back(make_frustum(view, options.margin_px + light_shift_px(view, frusta[0], light, nearest), light));
  Cut cut = cut_at(store, frusta, focal_px(view.lens), options.pixel_error);
  WorkingSet set;
  set.chunks_outside = cut.outside;
  if (options.cull_hidden) set.chunks_hidden = cull_hidden(store, frusta, view, options, budget, report, cut);
  set.chunks = std::move(cut.chunks);
  std::sort(set.chunks.begin(), set.chunks.end());
  for (const std::uint32_t c : set.chunks) set.surfels += store.chunks()[c].count;
  set.bytes = resident_bytes_of(set.surfels);
  set.complete = options.max_bytes == 0 || set.bytes <= options.max_bytes;
  return set;
}

WorkingSet select_proxy(const stream::Store& store, std::span<const View> views, std::uint64_t wanted, std::uint64_t most) {
  // Best first: the chunk whose surfels look largest to some camera is split next, while its children fit.
  struct Node {
    double size_px;
    std::uint32_t chunk;
    bool operator<(const Node& o) const { return size_px < o.size_px || (size_px == o.size_px && chunk > o.chunk); }
  };
  std::vector<Frustum> frusta;
  for (const View& v : views) frusta.push_back(make_frustum(v, 16, v.pose.centre_in_world()));
  const auto size_px = [&](std::uint32_t c) {
    const Box3d box = store.ray_bounds(c);
    double best = 0;
    for (std::size_t i = 0; i < views.size(); ++i) {
      const double distance = std::max(distance_to_box(frusta[i].centre, box), static_cast<double>(store.chunks()[c].spacing));
      // What no photograph looks at only reflects: a quarter of the resolution serves.
      const double share = frusta[i].misses(box) ? 0.25 : 1.0;
      best = std::max(best, share * static_cast<double>(store.chunks()[c].spacing) * focal_px(views[i].lens) / distance);
    }
    return best;
  };
  WorkingSet set;
  std::priority_queue<Node> queue;
  queue.push({size_px(0), 0});
  std::uint64_t total = store.chunks()[0].count;
  while (!queue.empty()) {
    const Node node = queue.top();
    queue.pop();
    const stream::ChunkEntry& entry = store.chunks()[node.chunk];
    std::uint64_t children = 0;
    for (std::uint32_t i = 0; i < entry.num_children; ++i) children += store.chunks()[entry.first_child + i].count;
    const std::uint64_t split = total - entry.count + children;
    const bool nearer = split <= wanted || static_cast<double>(split) * static_cast<double>(total) <= static_cast<double>(wanted) * static_cast<double>(wanted);
    if (entry.is_leaf() || split > most || !nearer) {
      set.chunks.push_back(node.chunk);
      continue;
    }
    total = split;
    for (std::uint32_t i = 0; i < entry.num_children; ++i) queue.push({size_px(entry.first_child + i), entry.first_child + i});
  }
  std::sort(set.chunks.begin(), set.chunks.end());
  set.surfels = total;
  set.bytes = resident_bytes_of(total);
  return set;
}

}  // namespace chiaro::surfels
