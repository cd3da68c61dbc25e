#include "surfels/working_set.h"

#include <algorithm>
#include <cmath>
#include <queue>

#include "stream/base/error.h"

namespace chiaro::surfels {
namespace {

/// Bytes of Embree's structure per block of 16 surfels (measured 5.2 B a surfel after the build, 8.5 at its peak).
constexpr double kEmbreeBytesPerSurfel = 8.5;

double distance_to_box(const Vec3d& p, const Box3d& box) { return (box.min - p).cwiseMax(p - box.max).cwiseMax(0.0).norm(); }

/// Conservative: five half-spaces through the camera centre. The rectangle's outline is unprojected densely, since lenses bend straight edges.
struct Frustum {
  Vec3d centre;
  std::vector<Vec3d> inward;  ///< unit normals of planes through the centre
  Vec3d forward;

  bool misses(const Box3d& box) const {
    for (const Vec3d& n : inward) {
      const Vec3d corner(n.x() > 0 ? box.max.x() : box.min.x(), n.y() > 0 ? box.max.y() : box.min.y(), n.z() > 0 ? box.max.z() : box.min.z());
      if (n.dot(corner - centre) < 0) return true;
    }
    return false;
  }
};

Frustum make_frustum(const View& view, double margin_px, const Vec3d& centre) {
  Frustum f;
  f.centre = centre;
  const Mat3d world_from_camera = view.pose.rotation_camera_from_world.transpose();
  f.forward = world_from_camera * Vec3d(0, 0, 1);
  // The cone of directions is bounded by slopes in camera axes.
  double x0 = 1e9, x1 = -1e9, y0 = 1e9, y1 = -1e9;
  const PixelRect r = view.rect;
  constexpr int kSteps = 16;
  bool wide = false;
  const auto visit = [&](double u, double v) {
    const auto d = stream::unproject(view.lens, {u, v});
    if (!d || d->z() < 0.05) {
      wide = true;
      return;
    }
    x0 = std::min(x0, d->x() / d->z());
    x1 = std::max(x1, d->x() / d->z());
    y0 = std::min(y0, d->y() / d->z());
    y1 = std::max(y1, d->y() / d->z());
  };
  for (int i = 0; i <= kSteps; ++i) {
    const double u = r.x0 - margin_px + (r.width() + 2 * margin_px) * i / kSteps, v = r.y0 - margin_px + (r.height() + 2 * margin_px) * i / kSteps;
    visit(u, r.y0 - margin_px);
    visit(u, r.y1 + margin_px);
    visit(r.x0 - margin_px, v);
    visit(r.x1 + margin_px, v);
  }
  if (wide) return f;  // a fisheye wider than a half-space: nothing is culled
  const Vec3d planes[] = {{1, 0, -x0}, {-1, 0, x1}, {0, 1, -y0}, {0, -1, y1}, {0, 0, 1}};
  for (const Vec3d& p : planes) f.inward.push_back((world_from_camera * p).normalized());
  return f;
}

double focal_px(const stream::Lens& lens) { return 0.5 * (lens.fx + lens.fy); }

}  // namespace

WorkingSet select_visible(const stream::Store& store, const View& view, const CutOptions& options, MemoryBudget&, Reporter&) {
  WorkingSet set;
  const Vec3d centre = view.pose.centre_in_world();
  std::vector<Frustum> frusta{make_frustum(view, options.margin_px, centre)};
  // The flash sees the same surface from beside the camera: its cone is taken wider by a quarter of the picture.
  for (const Vec3d& light : view.lights_in_world) frusta.push_back(make_frustum(view, options.margin_px + 0.25 * view.rect.width(), light));
  const double focal = focal_px(view.lens);
  std::vector<std::uint32_t> stack{0};
  while (!stack.empty()) {
    const std::uint32_t c = stack.back();
    stack.pop_back();
    const stream::ChunkEntry& entry = store.chunks()[c];
    const Box3d box = store.ray_bounds(c);
    if (std::all_of(frusta.begin(), frusta.end(), [&](const Frustum& f) { return f.misses(box); })) {
      ++set.chunks_outside;
      continue;
    }
    const double distance = std::max(distance_to_box(centre, box), 1e-9);
    if (entry.is_leaf() || static_cast<double>(entry.spacing) * focal / distance <= options.pixel_error) {
      set.chunks.push_back(c);
      set.surfels += entry.count;
      continue;
    }
    for (std::uint32_t i = 0; i < entry.num_children; ++i) stack.push_back(entry.first_child + i);
  }
  std::sort(set.chunks.begin(), set.chunks.end());
  set.bytes = static_cast<std::uint64_t>(static_cast<double>(set.surfels) * (sizeof(stream::SurfelBlock) / 16.0 + kEmbreeBytesPerSurfel));
  set.complete = options.max_bytes == 0 || set.bytes <= options.max_bytes;
  return set;
}

WorkingSet select_proxy(const stream::Store& store, std::span<const View> views, std::uint64_t max_surfels) {
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
    if (entry.is_leaf() || total - entry.count + children > max_surfels) {
      set.chunks.push_back(node.chunk);
      continue;
    }
    total += children - entry.count;
    for (std::uint32_t i = 0; i < entry.num_children; ++i) queue.push({size_px(entry.first_child + i), entry.first_child + i});
  }
  std::sort(set.chunks.begin(), set.chunks.end());
  set.surfels = total;
  set.bytes = static_cast<std::uint64_t>(static_cast<double>(total) * (sizeof(stream::SurfelBlock) / 16.0 + kEmbreeBytesPerSurfel));
  return set;
}

}  // namespace chiaro::surfels
