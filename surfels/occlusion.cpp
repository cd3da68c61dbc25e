#include "surfels/occlusion.h"

#include <algorithm>
#include <cmath>
#include <limits>

#include "stream/base/parallel.h"
#include "surfels/tracer.h"

namespace chiaro::surfels {
namespace {

constexpr float kOpen = std::numeric_limits<float>::infinity();
/// Bytes of Embree's structure per surfel, in blocks of 16 (measured 5.2 after the build, 8.5 at its peak).
constexpr double kEmbreeBytesPerSurfel = 8.5;
/// Coarse surfels lie off the finer ones that they stand for by up to their size: what is hidden lies this many radii behind, measured along the normal.
constexpr float kBehindRadii = 2;
constexpr float kBehindMinCosine = 0.1f;

}  // namespace

std::uint64_t resident_bytes_of(std::uint64_t surfels) {
  return static_cast<std::uint64_t>(static_cast<double>(surfels) * (sizeof(stream::SurfelBlock) / 16.0 + kEmbreeBytesPerSurfel));
}

/// Of a map: along one side of the frustum.
int DepthMap::cells_along(double width, double step) { return static_cast<int>(std::clamp(std::ceil(width / step / kCell), 2.0, 256.0)); }

std::uint64_t DepthMap::bytes_of(const Frustum& f, double step) {
  const std::uint64_t cells = static_cast<std::uint64_t>(cells_along(f.x1 - f.x0, step)) * static_cast<std::uint64_t>(cells_along(f.y1 - f.y0, step));
  return cells * (kCell * kCell + 1) * sizeof(float);
}

std::uint64_t DepthMap::working_bytes_of(const Frustum& f, double step) { return bytes_of(f, step) / (kCell * kCell + 1) * (kCell * kCell); }

DepthMap::DepthMap(const Frustum& frustum, double step, MemoryBudget& budget)
    : lease_(budget, bytes_of(frustum, step), "depths of what hides"), frustum_(&frustum), cell_columns_(cells_along(frustum.x1 - frustum.x0, step)), cell_rows_(cells_along(frustum.y1 - frustum.y0, step)) {
  columns_ = cell_columns_ * kCell;
  rows_ = cell_rows_ * kCell;
  reach_.assign(static_cast<std::size_t>(columns_) * static_cast<std::size_t>(rows_), kOpen);
  cells_.assign(static_cast<std::size_t>(cell_columns_) * static_cast<std::size_t>(cell_rows_), kOpen);
}

Vec3d DepthMap::direction(int column, int row) const {
  const Frustum& f = *frustum_;
  return (f.camera_from_world.transpose() * Vec3d(f.x0 + (f.x1 - f.x0) * (column + 0.5) / columns_, f.y0 + (f.y1 - f.y0) * (row + 0.5) / rows_, 1)).normalized();
}

void DepthMap::shorten(const Tracer& tracer, double nearest) {
  if (reach_.empty()) return;
  const Vec3f origin = tracer.scene_from_world(frustum_->centre);
  parallel_blocks(static_cast<std::size_t>(rows_), 4, [&](std::size_t begin, std::size_t end) {
    for (std::size_t row = begin; row < end; ++row)
      for (int column = 0; column < columns_; ++column) {
        float& reach = reach_[row * static_cast<std::size_t>(columns_) + static_cast<std::size_t>(column)];
        if (static_cast<double>(reach) < nearest) continue;
        const Vec3f d = direction(column, static_cast<int>(row)).cast<float>();
        Hit hit;
        if (!tracer.closest({origin, d, 0, std::min(reach, 1e30f)}, hit)) continue;
        reach = std::min(reach, hit.t + kBehindRadii * hit.radius / std::max(kBehindMinCosine, -hit.normal.dot(d)));
      }
  });
  gather();
}

// A single long ray among short ones slipped between two discs: only what is open over two by two rays counts.
std::vector<float> DepthMap::without_pinholes() const {
  const auto at = [&](int x, int y) { return reach_[static_cast<std::size_t>(y) * static_cast<std::size_t>(columns_) + static_cast<std::size_t>(x)]; };
  std::vector<float> open(reach_.size(), 0.0f);
  for (int y = 0; y + 1 < rows_; ++y)
    for (int x = 0; x + 1 < columns_; ++x) {
      const float least = std::min(std::min(at(x, y), at(x + 1, y)), std::min(at(x, y + 1), at(x + 1, y + 1)));
      for (int k = 0; k < 4; ++k) {
        float& o = open[static_cast<std::size_t>(y + k / 2) * static_cast<std::size_t>(columns_) + static_cast<std::size_t>(x + k % 2)];
        o = std::max(o, least);
      }
    }
  return open;
}

void DepthMap::gather() {
  const std::vector<float> open = without_pinholes();
  for (int j = 0; j < cell_rows_; ++j)
    for (int i = 0; i < cell_columns_; ++i) {
      float most = 0;
      for (int y = std::max(0, j * kCell - 1); y <= std::min(rows_ - 1, (j + 1) * kCell); ++y)
        for (int x = std::max(0, i * kCell - 1); x <= std::min(columns_ - 1, (i + 1) * kCell); ++x)
          most = std::max(most, open[static_cast<std::size_t>(y) * static_cast<std::size_t>(columns_) + static_cast<std::size_t>(x)]);
      cells_[static_cast<std::size_t>(j) * static_cast<std::size_t>(cell_columns_) + static_cast<std::size_t>(i)] = most;
    }
}

bool DepthMap::hides(const Box3d& box) const {
  const Frustum& f = *frustum_;
  if (f.misses(box)) return true;
  if (cells_.empty()) return false;
  double u0 = 1e9, u1 = -1e9, v0 = 1e9, v1 = -1e9;
  for (int corner = 0; corner < 8; ++corner) {
    const Vec3d p(corner & 1 ? box.max.x() : box.min.x(), corner & 2 ? box.max.y() : box.min.y(), corner & 4 ? box.max.z() : box.min.z());
    const Vec3d c = f.camera_from_world * (p - f.centre);
    if (c.z() < 1e-6) return false;
    u0 = std::min(u0, c.x() / c.z());
    u1 = std::max(u1, c.x() / c.z());
    v0 = std::min(v0, c.y() / c.z());
    v1 = std::max(v1, c.y() / c.z());
  }
  const auto cell = [](double v, double low, double high, int cells) { return static_cast<int>(std::clamp(std::floor((v - low) / (high - low) * cells), 0.0, cells - 1.0)); };
  const double distance = distance_to_box(f.centre, box);
  const int i0 = cell(u0, f.x0, f.x1, cell_columns_), i1 = cell(u1, f.x0, f.x1, cell_columns_);
  for (int j = cell(v0, f.y0, f.y1, cell_rows_), j1 = cell(v1, f.y0, f.y1, cell_rows_); j <= j1; ++j)
    for (int i = i0; i <= i1; ++i)
      if (!(static_cast<double>(cells_[static_cast<std::size_t>(j) * static_cast<std::size_t>(cell_columns_) + static_cast<std::size_t>(i)]) < distance)) return false;
  return true;
}

namespace {

/// Of all frusta, in their order, with rays as long as half of what is free holds them. working_bytes: of the largest of them.
std::vector<DepthMap> empty_maps(const std::vector<Frustum>& frusta, double step, MemoryBudget& budget, std::uint64_t& working_bytes) {
  std::vector<DepthMap> maps;
  const std::uint64_t most = budget.free_bytes() / 2;
  std::uint64_t held = 0;
  for (const Frustum& f : frusta) {
    const std::uint64_t bytes = DepthMap::bytes_of(f, step), working = std::max(working_bytes, DepthMap::working_bytes_of(f, step));
    if (held + bytes + working > most) {
      maps.emplace_back(f);
      continue;
    }
    maps.emplace_back(f, step, budget);
    held += bytes;
    working_bytes = working;
  }
  return maps;
}

}  // namespace

std::vector<DepthMap> find_occlusion(const stream::Store& store, std::span<const std::uint32_t> occluders, const std::vector<Frustum>& frusta, const OcclusionOptions& options, MemoryBudget& budget,
                                     Reporter& report) {
  std::uint64_t working_bytes = 0;
  std::vector<DepthMap> maps = empty_maps(frusta, options.step, budget, working_bytes);
  if (working_bytes == 0) return maps;   // no rays at all
  const BudgetLease working(budget, working_bytes, "depths of what hides");
  std::vector<std::pair<double, std::uint32_t>> order;
  for (const std::uint32_t c : occluders) order.emplace_back(distance_to_box(frusta[0].centre, store.ray_bounds(c)), c);
  std::sort(order.begin(), order.end());
  const std::uint64_t most_bytes = budget.free_bytes() / 2;
  for (std::size_t at = 0; at < order.size();) {
    report.check();
    Tracer tracer(frusta[0].centre, budget);
    std::vector<double> nearest(frusta.size(), std::numeric_limits<double>::infinity());
    std::uint64_t surfels = 0;
    for (; at < order.size() && surfels < options.batch_surfels; ++at) {
      const std::uint32_t c = order[at].second;
      const Box3d box = store.ray_bounds(c);
      if (std::all_of(maps.begin(), maps.end(), [&](const DepthMap& m) { return m.hides(box); })) continue;
      const std::uint64_t with = surfels + store.chunks()[c].count;
      if (resident_bytes_of(with) > most_bytes) break;
      tracer.add(store.read_chunk(c));
      surfels = with;
      for (std::size_t k = 0; k < frusta.size(); ++k) nearest[k] = std::min(nearest[k], distance_to_box(frusta[k].centre, box));
    }
    if (surfels == 0) break;   // nothing is left, or the next chunk does not fit
    tracer.commit();
    for (std::size_t k = 0; k < frusta.size(); ++k) maps[k].shorten(tracer, nearest[k]);
  }
  return maps;
}

}  // namespace chiaro::surfels
