#include "blend/photo_walk.h"

#include <algorithm>
#include <atomic>
#include <numeric>
#include <utility>

#include "stream/base/error.h"
#include "stream/base/parallel.h"

namespace chiaro::blend {
namespace {

constexpr int kLeastWindowRows = 16;
constexpr std::size_t kMostTogether = 64;

/// Rows of a band so that its window with the halo takes at most two thirds of what is free.
int band_rows(const MemoryBudget& budget, std::uint64_t row_bytes, int height, int beyond) {
  const auto fit = static_cast<std::int64_t>(budget.free_bytes() / 3 * 2 / row_bytes) - 2 * beyond;
  return static_cast<int>(std::clamp<std::int64_t>(fit, std::min(kLeastWindowRows, height), height));
}

}  // namespace

/// A photograph of a group, with the rows [y0, y1) of it that are at hand.
struct PhotoWalk::Member {
  BudgetLease lease;           // of the rows
  std::uint32_t k = 0;
  std::vector<RowSpan> rows;   // by leaf
  std::uint64_t surfels_in_view = 0;
  int y0 = 0, y1 = 0;
  std::shared_ptr<const PhotoWindow> window;
};

PhotoWalk::PhotoWalk(const stream::Store& store, std::vector<const BlendPhotograph*> photographs, WindowCache& windows, MemoryBudget& budget, Reporter& report)
    : store_(store), photographs_(std::move(photographs)), windows_(windows), budget_(budget), report_(report), read_(photographs_.size()) {
  for (const std::uint32_t leaf : store.leaves()) largest_leaf_ = std::max(largest_leaf_, store.chunks()[leaf].count);
}

void PhotoWalk::look(std::span<const std::uint32_t> photographs, int margin, std::uint64_t state_bytes, const Visitor& visit, const std::function<void(std::size_t)>& taken) {
  const std::size_t all = photographs.size();
  while (!photographs.empty()) {
    report_.check();
    photographs = photographs.subspan(take(photographs, {nullptr, {}, margin, state_bytes, visit, {}}));
    if (taken) taken(all - photographs.size());
  }
}

void PhotoWalk::into(LeafFile& file, std::string_view title, int margin, std::uint64_t state_bytes, const Visitor& visit, std::span<const std::uint32_t> first) {
  report_.begin(title, photographs_.size(), "photographs");
  std::vector<std::uint32_t> all(photographs_.size());
  std::iota(all.begin(), all.end(), 0u);
  for (std::size_t k = file.photographs_done(); k < all.size();) {
    report_.check();
    report_.progress(k);
    k += take(std::span(all).subspan(k), {&file, title, margin, state_bytes, visit, first});
    file.set_photographs_done(static_cast<std::uint32_t>(k));
  }
  report_.end();
}

void PhotoWalk::for_leaves(std::size_t count, std::uint64_t state_bytes, const std::function<void(std::size_t)>& task) {
  const std::uint64_t leaf_bytes = stream::geometry_bytes(largest_leaf_) + largest_leaf_ * state_bytes + 2 * photographs_.size() * sizeof(std::uint32_t);
  const std::uint64_t fit = budget_.free_bytes() / 2 / std::max<std::uint64_t>(1, leaf_bytes), threads = static_cast<std::uint64_t>(ThreadLimit::current());
  const auto at_once = static_cast<std::size_t>(std::clamp<std::uint64_t>(fit, 1, std::min<std::uint64_t>(std::max<std::size_t>(count, 1), threads)));
  const BudgetLease lease(budget_, at_once * leaf_bytes, "leaves of the blend");
  std::atomic<std::size_t> next{0};
  parallel_blocks(at_once, 1, [&](std::size_t, std::size_t) {
    for (std::size_t i = next++; i < count; i = next++) {
      report_.check();
      task(i);
    }
  });
}

std::vector<RowSpan> PhotoWalk::leaf_rows(const stream::Camera& camera) const {
  const auto& leaves = store_.leaves();
  std::vector<RowSpan> rows(leaves.size());
  parallel_blocks(leaves.size(), 256, [&](std::size_t begin, std::size_t end) {
    for (std::size_t i = begin; i < end; ++i) rows[i] = rows_of_box(camera, store_.bounds(leaves[i]));
  });
  return rows;
}

PhotoWalk::Member PhotoWalk::member_for(std::uint32_t k) const {
  const stream::Camera& camera = photographs_[k]->camera;
  BudgetLease lease(budget_, rows_bytes(), concat("rows of the leaves that photograph ", photographs_[k]->name, " may see"));
  Member m{std::move(lease), k, leaf_rows(camera), 0, 0, camera.lens.height_px, nullptr};
  for (std::size_t i = 0; i < m.rows.size(); ++i)
    if (m.rows[i].overlaps(0, m.y1)) m.surfels_in_view += store_.chunks()[store_.leaves()[i]].count;
  return m;
}

bool PhotoWalk::is_wanted(const Member& m, std::size_t leaf, const Task& task) const {
  return m.rows[leaf].overlaps(m.y0, m.y1) && (task.first.empty() || task.first[leaf] <= m.k) && (!task.file || task.file->mark(leaf) < Mark{m.k, static_cast<std::uint32_t>(m.y1)});
}

bool PhotoWalk::is_wanted_anywhere(const Member& m, const Task& task) const {
  for (std::size_t i = 0; i < m.rows.size(); ++i)
    if (is_wanted(m, i, task)) return true;
  return false;
}

std::size_t PhotoWalk::take(std::span<const std::uint32_t> photographs, const Task& task) {
  std::vector<Member> group;
  const std::uint64_t held_before = budget_.used_bytes(), most = budget_.free_bytes() / 3;   // the rest is for preparing windows, and for leaves
  std::size_t taken = 0;
  for (; taken < photographs.size() && group.size() < kMostTogether; ++taken) {
    const auto held = [&] { return budget_.used_bytes() - held_before - windows_.room_bytes(); };
    if (!group.empty() && held() + rows_bytes() > most) break;   // windows that the cache holds take nothing more, rows do
    Member m = member_for(photographs[taken]);
    if (!is_wanted_anywhere(m, task)) continue;
    m.window = windows_.whole(*photographs_[m.k], held(), most);
    if (!m.window && !group.empty()) break;
    read_[m.k] = true;
    if (!m.window) {
      windows_.give_room_back();
      take_in_bands(m, task);
      return taken + 1;
    }
    group.push_back(std::move(m));
  }
  windows_.give_room_back();
  if (!group.empty()) visit_leaves(group, task);
  return taken;
}

void PhotoWalk::take_in_bands(Member& m, const Task& task) {
  const BlendPhotograph& photograph = *photographs_[m.k];
  const PhotographRasters rasters(photograph.camera.lens, photograph.gbuffer, photograph.albedo, photograph.radiance);
  const WindowOptions& options = windows_.options();
  const int height = rasters.height(), halo = halo_rows(options, footprints(rasters).smallest());
  const std::uint64_t row_bytes = static_cast<std::uint64_t>(rasters.width()) * window_bytes_per_pixel(options.wider);
  const int band = band_rows(budget_, row_bytes, height, halo + task.margin);
  WindowRoom room;
  int room_rows = 0;
  for (m.y0 = 0; m.y0 < height; m.y0 += band) {
    m.y1 = std::min(height, m.y0 + band);
    if (!is_wanted_anywhere(m, task)) continue;
    const int held = std::min(height, m.y1 + task.margin + halo) - std::max(0, m.y0 - task.margin - halo);
    if (held < std::exchange(room_rows, held)) room = {};   // is not charged for any more
    const BudgetLease lease(budget_, static_cast<std::uint64_t>(held) * row_bytes, concat("rows of photograph ", photograph.name));
    m.window = std::make_shared<const PhotoWindow>(load_window(rasters, photograph.camera, m.y0, m.y1, task.margin, halo, options, room));
    visit_leaves(std::span(&m, 1), task);
    m.window.reset();
  }
}

void PhotoWalk::visit_leaves(std::span<const Member> group, const Task& task) {
  std::vector<std::size_t> visited;
  for (std::size_t i = 0; i < store_.leaves().size(); ++i)
    if (std::any_of(group.begin(), group.end(), [&](const Member& m) { return is_wanted(m, i, task); })) visited.push_back(i);
  std::atomic<std::size_t> done{0};
  for_leaves(visited.size(), task.state_bytes, [&](std::size_t i) {
    const std::size_t leaf = visited[i];
    std::vector<View> views;
    for (const Member& m : group) {
      if (!is_wanted(m, leaf, task)) continue;
      const Mark mark = task.file ? task.file->mark(leaf) : Mark{};   // rows that an interrupted run has added already are left out
      views.push_back({m.k, m.window.get(), m.surfels_in_view, task.file && mark.photograph == m.k ? std::max(m.y0, static_cast<int>(mark.row)) : m.y0, m.y1});
    }
    task.visit({leaf, views});
    if (task.file) report_.progress(group.front().k + group.size() * ++done / visited.size());
  });
  chunks_visited_ += visited.size();
}

}  // namespace chiaro::blend
