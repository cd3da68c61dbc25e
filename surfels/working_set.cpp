#include "surfels/working_set.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <optional>
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

/// From where a level is chosen. A light throws the edges of near things magnified: they are as fine as if the camera stood there.
struct Eyes {
  double focal_px;
  Vec3d camera;
  std::vector<Vec3d> lights;
  double light_farther = 2;   ///< than it is: so much coarser may be what a light alone is near to. A flash beside the camera decides nothing then

  double distance(const Box3d& box) const {
    double nearest = distance_to_box(camera, box);
    for (const Vec3d& light : lights) nearest = std::min(nearest, light_farther * distance_to_box(light, box));
    return std::max(nearest, 1e-9);
  }
};

/// A cut through what the frusta see: chunks whose surfels lie `spacing_px` apart at most, or leaves.
struct Cut {
  std::vector<std::uint32_t> chunks;
  std::uint64_t outside = 0;
};

Cut cut_at(const stream::Store& store, const std::vector<Frustum>& frusta, const Eyes& eyes, double spacing_px) {
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
    if (entry.is_leaf() || spacing_of(entry) * eyes.focal_px / eyes.distance(box) <= spacing_px) {
      cut.chunks.push_back(c);
      continue;
    }
    for (std::uint32_t i = 0; i < entry.num_children; ++i) stack.push_back(entry.first_child + i);
  }
  return cut;
}

/// Least depth along the view of anything in the box.
double nearest_depth(const Box3d& box, const Frustum& frustum) {
  const Vec3d forward = frustum.camera_from_world.row(2);
  const Vec3d corner = (forward.array() > 0).select(box.min, box.max);
  return forward.dot(corner - frustum.centre);
}

/// The same of the chunk's own surfels within the frustum.
double nearest_depth(const stream::Chunk& chunk, const Frustum& frustum) {
  double nearest = std::numeric_limits<double>::infinity();
  for (std::uint32_t i = 0; i < chunk.count; ++i) {
    const stream::Surfel s = chunk.surfel(i);
    const double r = static_cast<double>(s.radius);
    const Vec3d p = s.position_in_world - frustum.centre;
    if (std::any_of(frustum.inward.begin(), frustum.inward.end(), [&](const Vec3d& n) { return n.dot(p) < -r; })) continue;
    nearest = std::min(nearest, frustum.camera_from_world.row(2).dot(p) - r);
  }
  return nearest;
}

/// By how many pixels what the picture shows at `nearest` or beyond appears shifted from the light, at most. Nothing where that is more than a quarter of the picture, or not
/// bounded: the light is not beside the camera then.
std::optional<double> light_shift_px(const View& view, const Frustum& frustum, const Vec3d& light, double nearest) {
  const Vec3d l = frustum.camera_from_world * (light - frustum.centre);
  if (!(nearest > 0 && nearest > 2 * l.z())) return std::nullopt;
  // Slopes from the light of a point at slope s and depth z: (s z - x) / (z - l_z). It goes from s, far away, to one side only.
  const auto shift = [&](double s, double x) { return std::abs((s * nearest - x) / (nearest - l.z()) - s); };
  const double slope = std::max({shift(frustum.x0, l.x()), shift(frustum.x1, l.x()), shift(frustum.y0, l.y()), shift(frustum.y1, l.y())});
  constexpr double kBentLens = 1.5;   // pixels of a lens are not everywhere equally many for a slope
  const double shift_px = kBentLens * slope * std::max(view.lens.fx, view.lens.fy);
  return shift_px <= 0.25 * view.rect.width() ? std::optional(shift_px) : std::nullopt;
}

/// The same over all that the cut shows. A box may reach nearer than what it holds, even behind the camera: only where it does too near are its surfels looked at.
std::optional<double> light_shift_px(const stream::Store& store, const Cut& cut, const View& view, const Frustum& frustum, const Vec3d& light) {
  double nearest = std::numeric_limits<double>::infinity();
  for (const std::uint32_t c : cut.chunks) {
    double depth = nearest_depth(store.ray_bounds(c), frustum);
    if (!light_shift_px(view, frustum, light, depth)) depth = nearest_depth(store.read_chunk(c), frustum);
    nearest = std::min(nearest, depth);
    if (nearest < std::numeric_limits<double>::infinity() && !light_shift_px(view, frustum, light, nearest)) return std::nullopt;
  }
  return nearest < std::numeric_limits<double>::infinity() ? light_shift_px(view, frustum, light, nearest) : 0;
}

/// Chunks of the cut that something nearer covers are taken out: returns how many. What covers is found with a coarser cut, in a small part of the time that
/// the cut itself would take.
std::uint64_t cull_hidden(const stream::Store& store, const std::vector<Frustum>& frusta, Eyes eyes, const View& view, const CutOptions& options, MemoryBudget& budget, Reporter& report, Cut& cut) {
  if (cut.chunks.size() < kCullFrom || frusta[0].inward.empty()) return 0;
  const double step_px = std::max(2 * options.pixel_error, std::max(view.rect.width(), view.rect.height()) / kRaysAcross);
  eyes.light_farther = 1;   // discs of the size of its rays for a light too
  const Cut coarse = cut_at(store, frusta, eyes, std::max(2 * options.pixel_error, step_px / 2));
  OcclusionOptions occlusion;
  occlusion.step = step_px / eyes.focal_px;
  const std::vector<DepthMap> maps = find_occlusion(store, coarse.chunks, frusta, occlusion, budget, report);
  return std::erase_if(cut.chunks, [&](std::uint32_t c) {
    const Box3d box = store.ray_bounds(c);
    return std::all_of(maps.begin(), maps.end(), [&](const DepthMap& m) { return m.hides(box); });
  });
}

/// Of the camera first, then of the lights. A flash beside the camera sees the same surface: its cone is that of the picture, taken wider by what its place makes. Any other
/// light has cones of its own, to all that the picture shows.
std::vector<Frustum> frusta_of(const stream::Store& store, const View& view, const Eyes& eyes, const CutOptions& options, MemoryBudget& budget, Reporter& report) {
  std::vector<Frustum> frusta{make_frustum(view, options.margin_px, eyes.camera)};
  const Frustum camera = frusta[0];
  if (camera.inward.empty() || view.lights_in_world.empty()) return frusta;   // all is kept, or there is no light
  Cut seen = cut_at(store, frusta, eyes, options.pixel_error);
  std::vector<Box3d> boxes;
  for (const Vec3d& light : view.lights_in_world) {
    if (const auto shift_px = light_shift_px(store, seen, view, camera, light)) {
      frusta.push_back(make_frustum(view, options.margin_px + *shift_px, light));
      continue;
    }
    if (boxes.empty()) {
      if (options.cull_hidden) cull_hidden(store, {camera}, eyes, view, options, budget, report, seen);
      for (const std::uint32_t c : seen.chunks) boxes.push_back(store.ray_bounds(c));
    }
    for (Frustum& f : frusta_of_light(light, boxes)) frusta.push_back(std::move(f));
  }
  return frusta;
}

}  // namespace

WorkingSet select_visible(const stream::Store& store, const View& view, const CutOptions& options, MemoryBudget& budget, Reporter& report) {
  const Eyes eyes{focal_px(view.lens), view.pose.centre_in_world(), view.lights_in_world};
  const std::vector<Frustum> frusta = frusta_of(store, view, eyes, options, budget, report);
  Cut cut = cut_at(store, frusta, eyes, options.pixel_error);
  WorkingSet set;
  set.chunks_outside = cut.outside;
  if (options.cull_hidden) set.chunks_hidden = cull_hidden(store, frusta, eyes, view, options, budget, report, cut);
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
