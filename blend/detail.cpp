#include "blend/detail.h"

#include <algorithm>
#include <cmath>

#include "blend/identity.h"
#include "blend/photo_walk.h"
#include "stream/base/hash.h"

namespace chiaro::blend {
namespace {

/// Of two readings with the same weight the finer one, so that the order of photographs does not matter.
bool counts_more(const Detail& a, const Detail& b) { return a.weight != b.weight ? a.weight > b.weight : a.footprint < b.footprint; }

}  // namespace

LeafFile collect_detail(const stream::Store& store, std::span<const BlendPhotograph> photographs, const BlendOptions& options, const std::filesystem::path& path,
                        MemoryBudget& budget, Reporter& report) {
  const std::vector<const BlendPhotograph*> ordered = in_order_of_names(photographs);
  std::vector<Alignment> alignment;
  LeafShape shape{{}, static_cast<std::uint32_t>(ordered.size()), 0, sizeof(Detail), 0};
  for (const std::uint32_t leaf : store.leaves()) shape.surfels_of_leaf.push_back(store.chunks()[leaf].count);
  Hasher key;
  key.add("blend detail 1").add(options_key(store, options));
  float farthest = 0;
  for (const BlendPhotograph* p : ordered) {
    alignment.push_back(options.known ? options.known->alignment[static_cast<std::size_t>(p - photographs.data())] : Alignment{});
    const Alignment& a = alignment.back();
    farthest = std::max(farthest, std::abs(a.shift_px.y()));
    key.add(photograph_key(*p));
    for (const float v : {a.shift_px.x(), a.shift_px.y(), a.trust}) key.add(static_cast<double>(v));
  }
  LeafFile file(path, key.hex(), std::move(shape));
  WindowCache windows(window_options(options, scale_of(ordered, report)), budget);
  PhotoWalk walk(store, ordered, windows, budget, report);
  walk.into(file, "refine: look for detail", 1 + static_cast<int>(std::ceil(farthest)), sizeof(Detail), [&](const PhotoWalk::Visit& v) {
    std::vector<SurfelReader> readers;
    for (const PhotoWalk::View& view : v.views) readers.push_back(reader_of(view, ordered[view.photograph]->camera, alignment[view.photograph].shift_px));
    auto record = file.read<Detail>(v.leaf);
    bool changed = false;
    for_readings(store.read_chunk(store.leaves()[v.leaf]), readers, [&](std::uint32_t slot, std::size_t i, const Sample& s) {
      const Detail detail{s.weight * alignment[v.views[i].photograph].trust, s.footprint};
      if (!counts_more(detail, record.surfels[slot])) return;
      record.surfels[slot] = detail;
      changed = true;
    });
    if (changed) file.write(v.leaf, v.reached(), record);
  });
  return file;
}

}  // namespace chiaro::blend
