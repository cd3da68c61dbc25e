#include "stream/photo/plateau.h"

#include <algorithm>
#include <bit>
#include <cmath>

namespace chiaro::stream {
namespace {

constexpr int kDroppedBits = 13;
constexpr std::uint32_t kInfinity = 0x7f800000u;
constexpr float kSame = 1 - 8 * 1.2e-7f;   ///< a factor after clipping rounds
constexpr float kBelow = 0.99f;            ///< the values that a plateau is compared with
constexpr std::uint64_t kLeastPixels = 32, kHeap = 3;   ///< pixels, and times those just below; 20 and more where a tenth of a picture or more is clipped, a tenth at the top of a smooth highlight in half floats

std::size_t bin(float positive) { return std::bit_cast<std::uint32_t>(positive) >> kDroppedBits; }

}  // namespace

PlateauFinder::PlateauFinder() : histogram_((kInfinity >> kDroppedBits) + 1, 0) {}

void PlateauFinder::add(std::span<const float> values, std::span<const std::uint8_t> usable) {
  for (std::size_t i = 0; i < values.size(); ++i) {
    const float v = values[i];
    if (!usable[i] || !std::isfinite(v)) continue;
    ++all_;
    if (!(v > 0)) continue;
    ++histogram_[bin(v)];
    if (v < kSame * top_) continue;
    at_top_ = v * kSame > top_ ? 1 : at_top_ + 1;
    top_ = std::max(top_, v);
  }
}

std::optional<float> PlateauFinder::level() const {
  if (at_top_ < kLeastPixels || at_top_ == all_) return std::nullopt;   // a picture of one value is none
  std::uint64_t near = 0;
  for (std::size_t b = bin(kBelow * top_); b <= bin(top_); ++b) near += histogram_[b];
  if (at_top_ < kHeap * (near - std::min(near, at_top_))) return std::nullopt;
  return kSame * top_;
}

std::optional<std::size_t> plateau_of_counts(std::span<const std::uint32_t> count_of_value) {
  constexpr double kScatter = 1e-3;
  std::uint64_t reached = 0, all = 0;
  std::size_t top = count_of_value.size();
  while (top > 0 && reached < kLeastPixels) reached += count_of_value[--top];
  const auto share = [&](double factor) { return static_cast<std::size_t>(factor * static_cast<double>(top)); };
  std::uint64_t heap = 0, near = 0;
  for (std::size_t v = 0; v < count_of_value.size(); ++v) {
    all += count_of_value[v];
    if (v >= share(1 - kScatter) && v <= share(1 + kScatter)) heap += count_of_value[v];
    else if (v >= share(static_cast<double>(kBelow))) near += count_of_value[v];   // those above, too: a few highlights spread
  }
  if (heap < kLeastPixels || heap == all || heap < kHeap * near) return std::nullopt;
  return share(1 - kScatter);
}

}  // namespace chiaro::stream
