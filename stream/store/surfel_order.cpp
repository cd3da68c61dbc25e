#include "stream/store/surfel_order.h"

#include <algorithm>
#include <bit>
#include <numeric>
#include <utility>

#include "stream/store/morton.h"

namespace chiaro::stream {
namespace {

constexpr std::size_t kFew = 64;        // positions of which each is compared with each
constexpr std::size_t kMostBins = 256;

std::uint32_t coordinate(std::uint64_t item, int axis) { return static_cast<std::uint32_t>(item >> (16 * axis)) & 0xffff; }
bool same_spot(std::uint64_t a, std::uint64_t b) { return ((a ^ b) & 0xffffffffffffull) == 0; }

struct Range {
  std::uint32_t low = 65535, high = 0;
  void add(std::uint32_t v) {
    low = std::min(low, v);
    high = std::max(high, v);
  }
};

/// The value with at most `rank` smaller ones and more than that up to it.
std::uint32_t value_at(std::span<const std::uint16_t> values, std::size_t rank) {
  std::uint32_t found = 0;
  for (const std::uint16_t v : values) {
    std::uint16_t below = 0;
    for (const std::uint16_t other : values) below = static_cast<std::uint16_t>(below + (other < v));
    if (below <= rank) found = std::max<std::uint32_t>(found, v);
  }
  return found;
}

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
  items_.resize(n);
  other_.resize(n);
  order_.resize(n);
  has_spots_ = false;
  for (std::size_t i = 0; i < n; ++i) {
    const auto [x, y, z] = positions[i];
    items_[i] = x | std::uint64_t{y} << 16 | std::uint64_t{z} << 32 | std::uint64_t{i} << 48;
    has_spots_ = has_spots_ || (i > 0 && same_spot(items_[i], items_[i - 1]));
  }
  halve(0, n);
  for (std::size_t i = 0; i < n; ++i) order_[i] = static_cast<std::uint16_t>(items_[i] >> 48);
  return order_;
}

void PatchOrder::halve(std::size_t first, std::size_t last) {
  while (last - first > kBlockSurfels) {
    // Between two blocks, in the middle of those that the range meets.
    const std::size_t begin = first / kBlockSurfels, end = (last + kBlockSurfels - 1) / kBlockSurfels, wanted = (begin + end) / 2 * kBlockSurfels;
    Cut cut;
    if (!choose_cut(first, last, wanted - first, cut)) return;
    const std::size_t middle = divide(first, last, cut);
    halve(first, middle);
    first = middle;
  }
}

bool PatchOrder::choose_cut(std::size_t first, std::size_t last, std::size_t wanted, Cut& cut) {
  Range range[3];
  for (std::size_t i = first; i < last; ++i)
    for (int a = 0; a < 3; ++a) range[a].add(coordinate(items_[i], a));
  for (int a = 1; a < 3; ++a)
    if (range[a].high - range[a].low > range[cut.axis].high - range[cut.axis].low) cut.axis = a;
  const auto [low, high] = range[cut.axis];
  if (low == high) return false;
  const std::size_t n = last - first;
  values_.clear();
  std::size_t below = 0;   // all that are below the values looked at
  if (n <= kFew) {
    for (std::size_t i = first; i < last; ++i) values_.push_back(static_cast<std::uint16_t>(coordinate(items_[i], cut.axis)));
    cut.value = value_at(values_, wanted);
  } else {
    const std::size_t bins = n <= 1024 ? kMostBins / 4 : kMostBins;
    const int shift = std::max(0, static_cast<int>(std::bit_width(high - low)) - std::countr_zero(bins));
    std::array<std::uint32_t, kMostBins> counts{};
    for (std::size_t i = first; i < last; ++i) ++counts[(coordinate(items_[i], cut.axis) - low) >> shift];
    std::uint32_t bin = 0;
    while (below + counts[bin] <= wanted) below += counts[bin++];
    for (std::size_t i = first; i < last; ++i)
      if (const std::uint32_t v = coordinate(items_[i], cut.axis); (v - low) >> shift == bin) values_.push_back(static_cast<std::uint16_t>(v));
    const auto nth = values_.begin() + static_cast<std::ptrdiff_t>(wanted - below);
    std::nth_element(values_.begin(), nth, values_.end());
    cut.value = *nth;
  }
  for (const std::uint16_t v : values_) below += v < cut.value;
  cut.equals = static_cast<std::uint32_t>(wanted - below);
  if (has_spots_) keep_spots_together(first, last, cut);
  return true;
}

// Positions on one spot follow each other among those at the value: all go where the first or the last of them goes, whichever leaves something on both sides.
void PatchOrder::keep_spots_together(std::size_t first, std::size_t last, Cut& cut) const {
  std::uint32_t seen = 0, begin = 0, end = 0;
  std::uint64_t spot = 0, before = 0;
  bool above = false;
  for (std::size_t i = first; i < last; ++i) {
    const std::uint32_t v = coordinate(items_[i], cut.axis);
    above = above || v > cut.value;
    if (v != cut.value) continue;
    if (seen == 0 || !same_spot(items_[i], before)) {
      if (seen <= cut.equals) begin = seen, spot = items_[i];
      else above = true;
    }
    before = items_[i];
    ++seen;
    if (same_spot(spot, before)) end = seen;
  }
  if (begin == cut.equals) return;
  cut.equals = above ? end : begin;
}

std::size_t PatchOrder::divide(std::size_t first, std::size_t last, const Cut& cut) {
  std::size_t kept = first, moved = 0;
  std::uint32_t equals = 0;
  for (std::size_t i = first; i < last; ++i) {
    const std::uint64_t item = items_[i];
    const std::uint32_t v = coordinate(item, cut.axis);
    const bool stays = (v < cut.value) | ((v == cut.value) & (equals < cut.equals));
    equals += v == cut.value;
    items_[kept] = item;
    other_[moved] = item;
    kept += stays;
    moved += !stays;
  }
  std::copy_n(other_.begin(), moved, items_.begin() + static_cast<std::ptrdiff_t>(kept));
  return kept;
}

std::span<const std::uint16_t> MortonOrder::of(const std::vector<SurfelBlock>& blocks, std::uint32_t count) {
  order_.resize(count);
  if (is_in_morton_order(blocks, count)) {
    std::iota(order_.begin(), order_.end(), std::uint16_t{0});
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
  return order_;
}

}  // namespace chiaro::stream
