#include "surfels/working_set.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <queue>

#include "stream/base/error.h"
#include "stream/base/parallel.h"
#include "surfels/tracer.h"

namespace chiaro::surfels {
namespace {

/// Bytes of Embree's structure per block of 16 surfels (measured 5.2 B a surfel after the build, 8.5 at its peak).
constexpr double kEmbreeBytesPerSurfel = 8.5;

double distance_to_box(const Vec3d& p, const Box3d& box) { return (box.min - p).cwiseMax(p - box.max).cwiseMax(0.0).norm(); }

/// Conservative: five half-spaces through the camera centre. The rectangle's outline is unprojected densely, since lenses bend straight edges.
struct Frustum {
  Vec3d centre;
  std::vector<Vec3d> inward;  ///< unit normals of planes through the centre; empty: nothing is culled
  Mat3d camera_from_world;
  double x0 = 0, x1 = 0, y0 = 0, y1 = 0;   ///< slopes x/z and y/z that bound it

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
  f.camera_from_world = view.pose.rotation_camera_from_world;
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
  f.x0 = x0;
  f.x1 = x1;
  f.y0 = y0;
  f.y1 = y1;
  return f;
}

/// Coarse distances from one viewpoint: what is certainly covered. Each cell holds the largest distance found in it and its neighbours, so that a gap
/// narrower than a cell is not taken for a wall; infinite where a ray escapes.
class DepthPyramid {
 public:
  explicit DepthPyramid(const Frustum& f) : f_(f), far_(kCells * kCells, kOpen) {}

  void cast(const Tracer& tracer) {
    std::vector<float> at(kCells * kCells, kOpen);
    const Vec3f origin = tracer.scene_from_world(f_.centre);
    parallel_blocks(kCells, 4, [&](std::size_t b, std::size_t e) {
      for (std::size_t j = b; j < e; ++j)
        for (std::size_t i = 0; i < kCells; ++i) {
          const Vec3d d(f_.x0 + (f_.x1 - f_.x0) * (static_cast<double>(i) + 0.5) / kCells, f_.y0 + (f_.y1 - f_.y0) * (static_cast<double>(j) + 0.5) / kCells, 1);
          Hit hit;
          if (tracer.closest({origin, (f_.camera_from_world.transpose() * d).normalized().cast<float>(), 0, 1e30f}, hit)) at[j * kCells + i] = hit.t;
        }
    });
    for (int j = 0; j < kCells; ++j)
      for (int i = 0; i < kCells; ++i) {
        float most = 0;
        for (int y = std::max(0, j - 1); y <= std::min(kCells - 1, j + 1); ++y)
          for (int x = std::max(0, i - 1); x <= std::min(kCells - 1, i + 1); ++x) most = std::max(most, at[static_cast<std::size_t>(y * kCells + x)]);
        far_[static_cast<std::size_t>(j * kCells + i)] = most;
      }
  }

  /// Everything in the box lies behind what was found.
  bool hides(const Box3d& box) const {
    if (f_.misses(box)) return true;
    double u0 = 1e9, u1 = -1e9, v0 = 1e9, v1 = -1e9;
    for (int corner = 0; corner < 8; ++corner) {
      const Vec3d p(corner & 1 ? box.max.x() : box.min.x(), corner & 2 ? box.max.y() : box.min.y(), corner & 4 ? box.max.z() : box.min.z());
      const Vec3d c = f_.camera_from_world * (p - f_.centre);
      if (c.z() < 1e-6) return false;
      u0 = std::min(u0, c.x() / c.z());
      u1 = std::max(u1, c.x() / c.z());
      v0 = std::min(v0, c.y() / c.z());
      v1 = std::max(v1, c.y() / c.z());
    }
    const auto cell = [](double v, double low, double high) { return std::clamp(static_cast<int>(std::floor((v - low) / (high - low) * kCells)), 0, kCells - 1); };
    const double distance = distance_to_box(f_.centre, box);
    for (int j = cell(v0, f_.y0, f_.y1); j <= cell(v1, f_.y0, f_.y1); ++j)
      for (int i = cell(u0, f_.x0, f_.x1); i <= cell(u1, f_.x0, f_.x1); ++i)
        if (!(static_cast<double>(far_[static_cast<std::size_t>(j * kCells + i)]) < distance)) return false;
    return true;
  }

 private:
  static constexpr int kCells = 96;
  static constexpr float kOpen = std::numeric_limits<float>::infinity();
  const Frustum& f_;
  std::vector<float> far_;
};

/// Below this the test costs more than it saves.
constexpr std::size_t kCullFrom = 24;

std::uint64_t resident_bytes_of(std::uint64_t surfels) {
  return static_cast<std::uint64_t>(static_cast<double>(surfels) * (sizeof(stream::SurfelBlock) / 16.0 + kEmbreeBytesPerSurfel));
}

/// Front to back in batches: each batch is loaded unless what came before it hides it from the camera and from every light.
void cull_hidden(const stream::Store& store, const std::vector<Frustum>& frusta, std::uint64_t max_bytes, MemoryBudget& budget, Reporter& report, WorkingSet& set) {
  if (set.chunks.size() < kCullFrom || std::any_of(frusta.begin(), frusta.end(), [](const Frustum& f) { return f.inward.empty(); })) return;
  std::vector<std::pair<double, std::uint32_t>> order;
  for (const std::uint32_t c : set.chunks) order.emplace_back(distance_to_box(frusta[0].centre, store.bounds(c)), c);
  std::sort(order.begin(), order.end());
  Tracer tracer(frusta[0].centre, budget);
  std::vector<DepthPyramid> pyramids(frusta.begin(), frusta.end());
  WorkingSet kept;
  kept.chunks_outside = set.chunks_outside;
  const std::size_t batch = std::max<std::size_t>(8, order.size() / 12);
  for (std::size_t at = 0; at < order.size(); at += batch) {
    report.check();
    bool added = false;
    for (std::size_t i = at; i < std::min(at + batch, order.size()); ++i) {
      const std::uint32_t c = order[i].second;
      const Box3d box = store.ray_bounds(c);
      if (at > 0 && std::all_of(pyramids.begin(), pyramids.end(), [&](const DepthPyramid& p) { return p.hides(box); })) {
        ++kept.chunks_hidden;
        continue;
      }
      kept.chunks.push_back(c);
      kept.surfels += store.chunks()[c].count;
      if (max_bytes > 0 && resident_bytes_of(kept.surfels) > max_bytes) {
        kept.complete = false;   // the caller splits the picture
        set = kept;
        return;
      }
      tracer.add(store.read_chunk(c));
      added = true;
    }
    if (!added || at + batch >= order.size()) continue;
    tracer.commit();
    for (DepthPyramid& p : pyramids) p.cast(tracer);
  }
  set = kept;
}

double focal_px(const stream::Lens& lens) { return 0.5 * (lens.fx + lens.fy); }

}  // namespace

WorkingSet select_visible(const stream::Store& store, const View& view, const CutOptions& options, MemoryBudget& budget, Reporter& report) {
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
  if (options.cull_hidden) cull_hidden(store, frusta, options.max_bytes, budget, report, set);
  std::sort(set.chunks.begin(), set.chunks.end());
  set.bytes = resident_bytes_of(set.surfels);
  set.complete = set.complete && (options.max_bytes == 0 || set.bytes <= options.max_bytes);
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
