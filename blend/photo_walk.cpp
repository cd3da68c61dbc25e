#include "blend/photo_walk.h"

#include <algorithm>
#include <atomic>

#include "stream/base/error.h"
#include "stream/base/parallel.h"

namespace chiaro::blend {
namespace {

constexpr int kLeastWindowRows = 16;

}  // namespace

PhotoWalk::PhotoWalk(const stream::Store& store, std::vector<const BlendPhotograph*> photographs, const WindowOptions& options, MemoryBudget& budget, Reporter& report)
    : store_(store), photographs_(std::move(photographs)), options_(options), budget_(budget), report_(report), read_(photographs_.size()) {
  for (const std::uint32_t leaf : store.leaves()) largest_leaf_ = std::max(largest_leaf_, store.chunks()[leaf].count);
}

void PhotoWalk::look(std::uint32_t k, int margin, std::uint64_t state_bytes, const std::function<void(const Visit&)>& visit) { take(k, nullptr, margin, state_bytes, visit, {}); }

void PhotoWalk::into(LeafFile& file, std::string_view title, int margin, std::uint64_t state_bytes, const std::function<void(const Visit&)>& visit, std::span<const std::uint32_t> first) {
  report_.begin(title, photographs_.size(), "photographs");
  for (std::uint32_t k = file.photographs_done(); k < photographs_.size(); ++k) {
    report_.check();
    report_.progress(k);
    take(k, &file, margin, state_bytes, visit, first);
    file.set_photographs_done(k + 1);
  }
  report_.end();
}

void PhotoWalk::for_leaves(std::size_t count, std::uint64_t state_bytes, const std::function<void(std::size_t)>& task) {
  const std::uint64_t leaf_bytes = stream::geometry_bytes(largest_leaf_) + largest_leaf_ * (state_bytes + sizeof(Sample)) + 2 * photographs_.size() * sizeof(std::uint32_t);
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

/// Rows of a band so that the window with its halo takes at most two thirds of what is left.
int PhotoWalk::band_rows(int width, int height, int beyond) const {
  const std::uint64_t row_bytes = static_cast<std::uint64_t>(width) * window_bytes_per_pixel();
  const auto fit = static_cast<std::int64_t>(budget_.free_bytes() / 3 * 2 / row_bytes) - 2 * beyond;
  return static_cast<int>(std::clamp<std::int64_t>(fit, std::min(kLeastWindowRows, height), height));
}

void PhotoWalk::take(std::uint32_t k, const LeafFile* file, int margin, std::uint64_t state_bytes, const std::function<void(const Visit&)>& visit, std::span<const std::uint32_t> first) {
  const BlendPhotograph& photograph = *photographs_[k];
  const std::vector<RowSpan> rows = leaf_rows(photograph.camera);
  const auto is_wanted = [&](std::size_t leaf, int y0, int y1) {
    return rows[leaf].overlaps(y0, y1) && (first.empty() || first[leaf] <= k) && (!file || file->mark(leaf) < Mark{k, static_cast<std::uint32_t>(y1)});
  };
  bool any = false;
  for (std::size_t i = 0; i < rows.size() && !any; ++i) any = is_wanted(i, 0, photograph.camera.lens.height_px);
  if (!any) return;
  read_[k] = true;
  const PhotographRasters rasters(photograph.camera.lens, photograph.gbuffer, photograph.albedo, photograph.radiance);
  std::uint64_t surfels_in_view = 0;
  for (std::size_t i = 0; i < rows.size(); ++i)
    if (rows[i].overlaps(0, rasters.height())) surfels_in_view += store_.chunks()[store_.leaves()[i]].count;
  const int halo = halo_rows(options_, footprints(rasters).smallest());
  const int band = band_rows(rasters.width(), rasters.height(), halo + margin);
  for (int y0 = 0; y0 < rasters.height(); y0 += band) {
    const int y1 = std::min(rasters.height(), y0 + band);
    std::vector<std::size_t> visited;
    for (std::size_t i = 0; i < rows.size(); ++i)
      if (is_wanted(i, y0, y1)) visited.push_back(i);
    if (visited.empty()) continue;
    const int held = std::min(rasters.height(), y1 + margin + halo) - std::max(0, y0 - margin - halo);
    const BudgetLease window_lease(budget_, static_cast<std::uint64_t>(held) * static_cast<std::uint64_t>(rasters.width()) * window_bytes_per_pixel(),
                                   concat("rows of photograph ", photograph.name));
    const PhotoWindow window = load_window(rasters, photograph.camera, y0, y1, margin, halo, options_);
    for_leaves(visited.size(), state_bytes, [&](std::size_t i) {
      const std::size_t leaf = visited[i];
      const Mark mark = file ? file->mark(leaf) : Mark{};   // rows that an interrupted run has added already are left out
      visit({leaf, k, &window, surfels_in_view, file && mark.photograph == k ? std::max(y0, static_cast<int>(mark.row)) : y0, y1});
    });
    chunks_visited_ += visited.size();
  }
}

}  // namespace chiaro::blend
