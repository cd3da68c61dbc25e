#include "blend/second_look.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <mutex>
#include <optional>

namespace chiaro::blend {

// Of surfels enough of them, which is less where few pixels show all of them. A majority does not depend on who is inspected: it is found once for all.
template <class Judge>
void SecondLook::for_judged(const PhotoWalk::Visit& v, const Vec2f& shift_px, std::uint64_t most_surfels, const Judge& judge) const {
  constexpr std::uint64_t kSurfelsAPixel = 16;
  std::vector<SurfelReader> readers;
  std::vector<std::uint32_t> step;
  for (const PhotoWalk::View& view : v.views) {
    readers.push_back(reader_of(view, photographs[view.photograph]->camera, shift_px));
    const std::uint64_t pixels = static_cast<std::uint64_t>(view.window->width) * static_cast<std::uint64_t>(photographs[view.photograph]->camera.lens.height_px);
    step.push_back(1 + static_cast<std::uint32_t>(view.surfels_in_view / std::min(most_surfels, kSurfelsAPixel * pixels)));
  }
  const stream::Chunk chunk = store.read_chunk(store.leaves()[v.leaf]);
  const auto ballots = votes.read<Ballot>(v.leaf);
  for (std::uint32_t slot = 0; slot < chunk.count; ++slot) {
    std::optional<stream::Surfel> surfel;
    std::optional<Majority> majority;
    for (std::size_t i = 0; i < readers.size(); ++i) {
      if (slot % step[i] != static_cast<std::uint32_t>(v.leaf) % step[i]) continue;
      if (!surfel) {
        majority = majority_of(ballots.surfels[slot], agreement.log_gain, tolerance.of_votes());
        if (!majority) break;
        surfel = chunk.surfel(slot);
      }
      const auto seen = readers[i].before(*surfel);
      if (!seen) continue;
      auto sample = readers[i].read(*seen, readers[i].around(*seen));
      if (!sample) continue;
      sample->low = sample->low.cwiseProduct(Vec3f(agreement.log_gain[v.views[i].photograph].array().exp()));
      judge(i, *seen, *sample, *majority, ballots.surfels[slot]);
    }
  }
}

std::vector<ReadingDistances> SecondLook::distances(std::span<const std::uint32_t> which) const {
  constexpr std::uint64_t kMostSurfels = 1 << 13;
  using Histograms = std::array<OctaveHistogram, Tolerance::kClasses>;
  std::vector<Histograms> histograms(which.size());
  struct Distance {
    std::uint32_t photograph;
    std::size_t in_class;
    float value;
  };
  std::mutex mutex;
  walk.look(which, 1, sizeof(Ballot), [&](const PhotoWalk::Visit& v) {
    if (!votes.is_written(v.leaf)) return;
    std::vector<Distance> found;
    for_judged(v, Vec2f::Zero(), kMostSurfels, [&](std::size_t i, const SurfelView&, const Sample& sample, const Majority& majority, const Ballot& ballot) {
      constexpr float kLeast = 1e-6f;   // equal ones count too
      found.push_back({v.views[i].photograph, Tolerance::class_of(sample.weight, least_weight(ballot)), std::max(kLeast, (log_value(sample.low, brightness) - majority.log_low).cwiseAbs().maxCoeff())});
    });
    const std::lock_guard lock(mutex);   // whole numbers: the order does not matter
    for (const Distance& d : found) histograms[static_cast<std::size_t>(std::lower_bound(which.begin(), which.end(), d.photograph) - which.begin())][d.in_class].add(d.value);
  });
  std::vector<ReadingDistances> result;
  for (const Histograms& h : histograms) {
    ReadingDistances d;
    for (std::size_t c = 0; c < h.size(); ++c) {
      d.median[c] = h[c].median();
      d.readings[c] = static_cast<std::uint32_t>(h[c].count());
    }
    result.push_back(d);
  }
  return result;
}

std::vector<Inspection> SecondLook::inspect(std::span<const std::uint32_t> which, const Vec2f& shift_px) const {
  constexpr std::uint64_t kMostSurfels = 1 << 17;
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
    for_judged(v, shift_px, kMostSurfels, [&](std::size_t i, const SurfelView& seen, const Sample& sample, const Majority& majority, const Ballot& ballot) {
      inspect_reading(ballot, majority, static_cast<std::uint16_t>(v.views[i].photograph), log_value(sample.low, brightness), tolerance.of(sample.weight, least_weight(ballot)),
                      seen.pixel + shift_px.cast<double>(), *v.views[i].window, own[i]);
    });
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

}  // namespace chiaro::blend
