#include "stream/store/surfel_order.h"

#include <algorithm>
#include <bit>
#include <numeric>
#include <utility>

#include "stream/store/morton.h"

namespace chiaro::stream {
namespace {

StoredPosition position_of(const std::vector<SurfelBlock>& blocks, std::uint32_t slot) {
  const SurfelBlock& b = blocks[slot / kBlockSurfels];
  const std::size_t lane = slot % kBlockSurfels;
  return {b.x[lane], b.y[lane], b.z[lane]};
}

/// Not 0 if, of `count` pairs of positions, a second one comes before its first in Morton order. Without branches, so that the compiler takes eight at once.
std::uint16_t any_out_of_order(const std::uint16_t* ax, const std::uint16_t* ay, const std::uint16_t* az, const std::uint16_t* bx, const std::uint16_t* by, const std::uint16_t* bz, int count) {
  std::uint16_t wrong = 0;
  for (int i = 0; i < count; ++i) {
    // The axis with the highest bit that differs decides; of two with the same one the later.
    const auto dx = static_cast<std::uint16_t>(ax[i] ^ bx[i]), dy = static_cast<std::uint16_t>(ay[i] ^ by[i]), dz = static_cast<std::uint16_t>(az[i] ^ bz[i]);
    const std::uint16_t less_z = az[i] > bz[i], less_y = ay[i] > by[i], less_x = ax[i] > bx[i];
    const bool y = (dz < dy) & (dz < static_cast<std::uint16_t>(dz ^ dy));
    const std::uint16_t most = y ? dy : dz, less = y ? less_y : less_z;
    const bool x = (most < dx) & (most < static_cast<std::uint16_t>(most ^ dx));
    wrong = static_cast<std::uint16_t>(wrong | (x ? less_x : less));
  }
  return wrong;
}

bool is_in_morton_order(const std::vector<SurfelBlock>& blocks, std::uint32_t count) {
  for (std::size_t k = 0; k < (count + 15) / 16; ++k) {
    const SurfelBlock& b = blocks[k];   // what pads it repeats the last position
    if (any_out_of_order(b.x.data(), b.y.data(), b.z.data(), b.x.data() + 1, b.y.data() + 1, b.z.data() + 1, 15) != 0) return false;
    if (k == 0) continue;
    const SurfelBlock& a = blocks[k - 1];
    if (any_out_of_order(&a.x[15], &a.y[15], &a.z[15], b.x.data(), b.y.data(), b.z.data(), 1) != 0) return false;
  }
  return true;
}

/// differences[i] of the surfels in the order of their slots; room for whole blocks.
void compare_slots(const std::vector<SurfelBlock>& blocks, std::size_t used, std::uint16_t* differences) {
  for (std::size_t k = 0; k < used; ++k) {
    const SurfelBlock &b = blocks[k], &before = blocks[k > 0 ? k - 1 : 0];
    std::uint16_t* const to = differences + 16 * k;
    to[0] = static_cast<std::uint16_t>(k == 0 ? 0 : (b.x[0] ^ before.x[15]) | (b.y[0] ^ before.y[15]) | (b.z[0] ^ before.z[15]));
    for (std::size_t i = 1; i < 16; ++i) to[i] = static_cast<std::uint16_t>((b.x[i] ^ b.x[i - 1]) | (b.y[i] ^ b.y[i - 1]) | (b.z[i] ^ b.z[i - 1]));
  }
}

/// By the 48 bits above the lowest 16.
void sort_by_code(std::vector<std::uint64_t>& items, std::vector<std::uint64_t>& other) {
  constexpr int kDigit = 12, kPasses = 4;
  other.resize(items.size());
  std::vector<std::array<std::uint32_t, 1 << kDigit>> counts(kPasses);
  const auto digit = [](std::uint64_t item, int pass) { return item >> (16 + kDigit * pass) & ((1 << kDigit) - 1); };
  for (const std::uint64_t item : items)
    for (int pass = 0; pass < kPasses; ++pass) ++counts[static_cast<std::size_t>(pass)][digit(item, pass)];
  for (int pass = 0; pass < kPasses; ++pass) {
    std::array<std::uint32_t, 1 << kDigit>& start = counts[static_cast<std::size_t>(pass)];
    std::uint32_t sum = 0;
    for (std::uint32_t& c : start) sum += std::exchange(c, sum);
    for (const std::uint64_t item : items) other[start[digit(item, pass)]++] = item;
    items.swap(other);
  }
}

}  // namespace

std::span<const std::uint16_t> PatchOrder::of(std::span<const StoredPosition> positions) {
  const std::size_t n = positions.size();
  items_.make_room(n);
  other_.make_room(n);
  has_spots_ = false;
  for (std::size_t i = 0; i < n; ++i) {
    for (std::size_t a = 0; a < 3; ++a) items_.of[a][i] = positions[i][a];
    items_.of[PatchColumns::kNumber][i] = static_cast<std::uint16_t>(i);
    has_spots_ = has_spots_ || (i > 0 && same_spot(i, i - 1));
  }
  halve(0, n);
  return std::span(items_.of[PatchColumns::kNumber]).first(n);
}

bool PatchOrder::same_spot(std::size_t i, std::size_t j) const {
  return items_.of[0][i] == items_.of[0][j] && items_.of[1][i] == items_.of[1][j] && items_.of[2][i] == items_.of[2][j];
}

void PatchOrder::halve(std::size_t first, std::size_t last) {
  while (last - first > kBlockSurfels) {
    // Between two blocks, in the middle of those that the range meets.
    const std::size_t begin = first / kBlockSurfels, end = (last + kBlockSurfels - 1) / kBlockSurfels, wanted = (begin + end) / 2 * kBlockSurfels;
    PatchCut cut;
    if (!choose_cut(first, last, wanted - first, cut)) return;
    const std::size_t middle = divide(items_, first, last, cut, other_);
    halve(first, middle);
    first = middle;
  }
}

bool PatchOrder::choose_cut(std::size_t first, std::size_t last, std::size_t wanted, PatchCut& cut) const {
  const std::size_t n = last - first;
  std::array<ValueRange, 3> range;
  for (std::size_t a = 0; a < 3; ++a) range[a] = range_of(std::span(items_.of[a]).subspan(first, n));
  for (std::size_t a = 1; a < 3; ++a)
    if (range[a].extent() > range[cut.axis].extent()) cut.axis = a;
  if (range[cut.axis].extent() == 0) return false;
  // The value with at most `wanted` smaller ones and more than that up to it.
  const auto values = std::span(items_.of[cut.axis]).subspan(first, n);
  std::uint32_t low = range[cut.axis].low, above = range[cut.axis].high + 1u, below = 0;
  while (above - low > 1) {
    const std::uint32_t middle = (low + above) / 2, count = count_below(values, static_cast<std::uint16_t>(middle));
    if (count <= wanted) {
      low = middle;
      below = count;
    } else {
      above = middle;
    }
  }
  cut.value = static_cast<std::uint16_t>(low);
  cut.equals = static_cast<std::uint32_t>(wanted) - below;
  if (has_spots_) keep_spots_together(first, last, cut);
  return true;
}

// Positions on one spot follow each other among those at the value: all go where the first or the last of them goes, whichever leaves something on both sides.
void PatchOrder::keep_spots_together(std::size_t first, std::size_t last, PatchCut& cut) const {
  std::uint32_t seen = 0, begin = 0, end = 0;
  std::size_t spot = first, before = first;
  bool above = false;
  for (std::size_t i = first; i < last; ++i) {
    const std::uint32_t v = items_.of[cut.axis][i];
    above = above || v > cut.value;
    if (v != cut.value) continue;
    if (seen == 0 || !same_spot(i, before)) {
      if (seen <= cut.equals) begin = seen, spot = i;
      else above = true;
    }
    before = i;
    ++seen;
    if (same_spot(spot, before)) end = seen;
  }
  if (begin == cut.equals) return;
  cut.equals = above ? end : begin;
}

std::span<const std::uint16_t> MortonOrder::of(const std::vector<SurfelBlock>& blocks, std::uint32_t count) {
  order_.resize(count);
  if (is_in_morton_order(blocks, count)) {
    std::iota(order_.begin(), order_.end(), std::uint16_t{0});
    const std::size_t used = (count + 15) / 16;
    differences_.resize(16 * used);
    compare_slots(blocks, used, differences_.data());
    differences_.resize(count);
    return order_;
  }
  items_.resize(count);
  for (std::uint32_t slot = 0; slot < count; ++slot) {
    const auto [x, y, z] = position_of(blocks, slot);
    items_[slot] = morton_encode(x, y, z) << 16 | slot;
  }
  if (count < 2048) std::sort(items_.begin(), items_.end());
  else sort_by_code(items_, other_);
  for (std::uint32_t i = 0; i < count; ++i) order_[i] = static_cast<std::uint16_t>(items_[i]);
  compare(blocks);
  return order_;
}

void MortonOrder::compare(const std::vector<SurfelBlock>& blocks) {
  differences_.resize(order_.size());
  StoredPosition last = position_of(blocks, order_[0]);
  for (std::size_t i = 0; i < order_.size(); ++i) {
    const StoredPosition p = position_of(blocks, order_[i]);
    differences_[i] = static_cast<std::uint16_t>((p[0] ^ last[0]) | (p[1] ^ last[1]) | (p[2] ^ last[2]));
    last = p;
  }
}

}  // namespace chiaro::stream
