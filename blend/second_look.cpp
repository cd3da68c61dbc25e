#include "blend/second_look.h"

#include <algorithm>
#include <cmath>
#include <mutex>
#include <optional>

namespace chiaro::blend {

std::vector<Inspection> SecondLook::inspect(std::span<const std::uint32_t> which, const Vec2f& shift_px) const {
  std::vector<InspectionCounts> counts;
  std::vector<std::size_t> place(photographs.size());
  for (const std::uint32_t k : which) {
    place[k] = counts.size();
    counts.emplace_back(photographs[k]->camera.lens.width_px, photographs[k]->camera.lens.height_px);
  }
  std::mutex mutex;
  const int margin = kInspectMargin + static_cast<int>(std::ceil(std::abs(shift_px.y())));
  walk.look(which, margin, sizeof(Ballot), [&](const PhotoWalk::Visit& v) {
    if (!votes.is_written(v.leaf)) return;
    std::vector<InspectionCounts> own;
    for (const PhotoWalk::View& view : v.views) own.emplace_back(counts[place[view.photograph]].width, counts[place[view.photograph]].height);
    inspect_leaf(v, shift_px, own);
    const std::lock_guard lock(mutex);   // whole numbers: the order does not matter
    for (std::size_t i = 0; i < own.size(); ++i) counts[place[v.views[i].photograph]].merge(own[i]);
  }, [&](std::size_t taken) { if (which.size() > 1) report.progress(which[taken - 1] + 1); });
  std::vector<Inspection> results;
  for (const InspectionCounts& c : counts) {
    results.push_back(conclude(c));
    if (results.back().shift_px) *results.back().shift_px += shift_px;
  }
  return results;
}

Alignment SecondLook::align(std::uint32_t photograph, Inspection& found) const {
  constexpr int kMostRounds = 3;
  Alignment alignment = alignment_for(found);
  for (int round = 0; round < kMostRounds && alignment.shift_px != Vec2f::Zero(); ++round) {
    const Vec2f before = alignment.shift_px;
    const Inspection again = inspect(std::span(&photograph, 1), before).front();
    if (!again.shift_px) break;
    found = again;
    alignment = alignment_for(again);
    if ((alignment.shift_px - before).norm() < 0.05f) break;
  }
  return alignment;
}

// Of surfels enough of them, which is less where few pixels show all of them. A majority does not depend on who is inspected: it is found once for all.
void SecondLook::inspect_leaf(const PhotoWalk::Visit& v, const Vec2f& shift_px, std::vector<InspectionCounts>& counts) const {
  constexpr std::uint64_t kMostSurfels = 1 << 17, kSurfelsAPixel = 16;
  std::vector<SurfelReader> readers;
  std::vector<std::uint32_t> step;
  for (const PhotoWalk::View& view : v.views) {
    readers.push_back(reader_of(view, photographs[view.photograph]->camera, shift_px));
    const std::uint64_t pixels = static_cast<std::uint64_t>(view.window->width) * static_cast<std::uint64_t>(photographs[view.photograph]->camera.lens.height_px);
    step.push_back(1 + static_cast<std::uint32_t>(view.surfels_in_view / std::min(kMostSurfels, kSurfelsAPixel * pixels)));
  }
  const stream::Chunk chunk = store.read_chunk(store.leaves()[v.leaf]);
  const auto ballots = votes.read<Ballot>(v.leaf);
  for (std::uint32_t slot = 0; slot < chunk.count; ++slot) {
    std::optional<stream::Surfel> surfel;
    std::optional<Majority> majority;
    for (std::size_t i = 0; i < readers.size(); ++i) {
      if (slot % step[i] != static_cast<std::uint32_t>(v.leaf) % step[i]) continue;
      if (!surfel) {
        majority = majority_of(ballots.surfels[slot], agreement.log_gain, tolerance);
        if (!majority) break;
        surfel = chunk.surfel(slot);
      }
      const auto seen = readers[i].before(*surfel);
      if (!seen) continue;
      const auto sample = readers[i].read(*seen, readers[i].around(*seen));
      if (!sample) continue;
      const std::uint32_t k = v.views[i].photograph;
      const Vec3f gain = agreement.log_gain[k].array().exp();
      inspect_reading(ballots.surfels[slot], *majority, static_cast<std::uint16_t>(k), log_value(sample->low.cwiseProduct(gain), brightness), tolerance,
                      seen->pixel + shift_px.cast<double>(), *v.views[i].window, counts[i]);
    }
  }
}

}  // namespace chiaro::blend
