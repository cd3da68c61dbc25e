#include "stream/store/count_grid.h"

#include <algorithm>
#include <cmath>

#include "stream/base/error.h"

namespace chiaro::stream {
namespace {

constexpr std::int64_t kHalfRange = 1 << 20;  // keys hold 21 bits an axis

std::uint64_t mix(std::uint64_t h) {
  h ^= h >> 32;
  h *= 0xd6e8feb86659fd93ull;
  h ^= h >> 32;
  return h;
}

double max_abs(const Box3d& b) { return std::max(b.min.cwiseAbs().maxCoeff(), b.max.cwiseAbs().maxCoeff()); }

// Exponent of the smallest power of two that is not below v (v > 0).
int ceil_log2(double v) {
  int e = 0;
  const double m = std::frexp(v, &e);
  return m == 0.5 ? e - 1 : e;
}

std::array<std::int64_t, 3> floor_cell(const Vec3d& p, double scale) {
  return {floor_integer(p.x() * scale), floor_integer(p.y() * scale), floor_integer(p.z() * scale)};
}

void merge_equal(std::vector<WeightedCell>& sorted) {
  std::size_t n = 0;
  for (std::size_t i = 0; i < sorted.size(); ++i) {
    if (n > 0 && sorted[n - 1].key == sorted[i].key) sorted[n - 1].count += sorted[i].count;
    else sorted[n++] = sorted[i];
  }
  sorted.resize(n);
}

std::uint64_t median_count(const std::vector<WeightedCell>& cells) {
  std::vector<std::uint64_t> counts;
  counts.reserve(cells.size());
  for (const WeightedCell& c : cells) counts.push_back(c.count);
  std::sort(counts.begin(), counts.end());
  const auto weight = [](std::uint64_t c) { return std::min<std::uint64_t>(c, 64); };
  std::uint64_t total = 0, sum = 0;
  for (const std::uint64_t c : counts) total += weight(c);
  for (const std::uint64_t c : counts)
    if (2 * (sum += weight(c)) >= total) return c;
  return 1;
}

}  // namespace

double RootCube::edge() const { return std::ldexp(1.0, exponent); }

Vec3d RootCube::origin() const {
  const double unit = std::ldexp(1.0, exponent - kAxisBits);
  return {static_cast<double>(corner[0]) * unit, static_cast<double>(corner[1]) * unit, static_cast<double>(corner[2]) * unit};
}

CountGrid::CountGrid(MemoryBudget& budget, std::uint64_t max_bytes) : budget_(budget), max_slots_(std::uint64_t{1} << 19) {
  while (2 * max_slots_ * sizeof(Slot) <= max_bytes) max_slots_ *= 2;
  resize(1 << 12);
}

void CountGrid::resize(std::uint64_t slots) {
  BudgetLease lease(budget_, slots * sizeof(Slot), "counting grid");
  std::vector<Slot> old(slots);
  old.swap(slots_);
  used_ = 0;
  for (const Slot& s : old)
    if (s.key != kEmpty) insert(s.key, s.count);
  std::vector<Slot>().swap(old);
  lease_ = std::move(lease);
}

void CountGrid::insert(std::uint64_t key, std::uint64_t count) {
  const std::uint64_t mask = slots_.size() - 1;
  for (std::uint64_t i = mix(key) & mask;; i = (i + 1) & mask) {
    Slot& s = slots_[i];
    if (s.key == key) {
      s.count += count;
      return;
    }
    if (s.key == kEmpty) {
      s = {key, count};
      ++used_;
      return;
    }
  }
}

std::array<std::int64_t, 3> CountGrid::cell_of_key(std::uint64_t key) const {
  const auto axis = [&](std::size_t a) { return base_[a] + static_cast<std::int64_t>(key >> (21 * a) & (2 * kHalfRange - 1)) - kHalfRange; };
  return {axis(0), axis(1), axis(2)};
}

// All bits set if the cell is further from the first one than keys reach.
std::uint64_t CountGrid::key_of_cell(const std::array<std::int64_t, 3>& cell) const {
  std::uint64_t key = 0, beyond = 0;
  for (std::size_t a = 0; a < 3; ++a) {
    const auto offset = static_cast<std::uint64_t>(cell[a] - base_[a] + kHalfRange);
    key |= offset << (21 * a);
    beyond |= offset >> 21;
  }
  return beyond == 0 ? key : kEmpty;
}

void CountGrid::coarsen() {
  std::vector<Slot> cells;
  const BudgetLease lease(budget_, used_ * sizeof(Slot), "counting grid");
  cells.reserve(used_);
  for (const Slot& s : slots_)
    if (s.key != kEmpty) cells.push_back(s);
  std::fill(slots_.begin(), slots_.end(), Slot{});
  used_ = 0;
  const auto old_base = base_;
  for (auto& b : base_) b >>= 1;
  ++k_;
  for (const Slot& s : cells) {
    std::array<std::int64_t, 3> cell;
    for (std::size_t a = 0; a < 3; ++a) cell[a] = (old_base[a] + static_cast<std::int64_t>(s.key >> (21 * a) & (2 * kHalfRange - 1)) - kHalfRange) >> 1;
    insert(key_of_cell(cell), s.count);
  }
}

// At most half of the slots are used: more memory while there is some, larger cells after that.
void CountGrid::make_room(std::uint64_t cells) {
  while (2 * (used_ + cells) > slots_.size()) {
    if (slots_.size() < max_slots_) resize(2 * slots_.size());
    else coarsen();
  }
}

// The finest cell: a 256th of the extent of most of the first points (outliers aside), within what integers and doubles hold. Finer ones would tell nothing that
// partitions need, and the table would not fit the processor's caches.
void CountGrid::start(std::span<const Vec3d> points) {
  Box3d box;
  for (const Vec3d& p : points) box.extend(p);
  double extent = 0;
  std::vector<double> values(points.size());
  for (int axis = 0; axis < 3; ++axis) {
    for (std::size_t i = 0; i < points.size(); ++i) values[i] = points[i][axis];
    const auto low = values.begin() + static_cast<std::ptrdiff_t>(values.size() / 10), high = values.end() - 1 - static_cast<std::ptrdiff_t>(values.size() / 10);
    std::nth_element(values.begin(), low, values.end());
    const double low_value = *low;
    std::nth_element(values.begin(), high, values.end());
    extent = std::max(extent, *high - low_value);
  }
  if (extent == 0) extent = (box.max - box.min).maxCoeff();
  int k = std::max(-30, max_abs(box) > 0 ? ceil_log2(max_abs(box)) - 45 : -30);
  if (extent > 0) k = std::max(k, ceil_log2(extent) - 8);
  k_ = k;
  base_ = floor_cell(points[0], std::ldexp(1.0, -k_));
  started_ = true;
}

void CountGrid::add(std::span<const Vec3d> points) {
  if (points.empty()) return;
  if (!started_) start(points);
  constexpr std::size_t kBatch = 256;
  std::array<std::uint64_t, kBatch> keys;
  for (std::size_t first = 0; first < points.size(); first += kBatch) {
    const std::span batch(points.data() + first, std::min(kBatch, points.size() - first));
    for (const Vec3d& p : batch) bounds_.extend(p);
    make_room(batch.size());
    while (!make_keys(batch, keys.data())) coarsen();
    // Neighbours in the table are far apart: all are on their way to the cache before the first is needed.
    for (std::size_t i = 0; i < batch.size(); ++i) __builtin_prefetch(&slots_[mix(keys[i]) & (slots_.size() - 1)], 1);
    for (std::size_t i = 0; i < batch.size();) {
      std::size_t run = i + 1;
      while (run < batch.size() && keys[run] == keys[i]) ++run;
      insert(keys[i], run - i);
      i = run;
    }
  }
  points_ += points.size();
}

// False if a cell is out of reach: the grid must become coarser.
bool CountGrid::make_keys(std::span<const Vec3d> points, std::uint64_t* keys) const {
  const double scale = std::ldexp(1.0, -k_);
  bool all = true;
  for (std::size_t i = 0; i < points.size(); ++i) {
    keys[i] = key_of_cell(floor_cell(points[i], scale));
    all &= keys[i] != kEmpty;
  }
  return all;
}

RootCube CountGrid::root() const {
  if (points_ == 0) throw Error("no points to build a root cube from");
  const double extent = (bounds_.max - bounds_.min).maxCoeff();
  int e = std::max({-10, extent > 0 ? ceil_log2(extent) : -10, max_abs(bounds_) > 0 ? ceil_log2(max_abs(bounds_)) - 24 : -10});
  // The corner is a multiple of a 32nd of the edge, hence of every grid cell; the edge is the smallest that holds the bounds from there.
  for (;; ++e) {
    const double align = std::ldexp(1.0, e - 5), edge = std::ldexp(1.0, e);
    RootCube root;
    root.exponent = e;
    bool fits = true;
    for (int a = 0; a < 3; ++a) {
      const double corner = std::floor(bounds_.min[a] / align);
      fits = fits && std::floor(bounds_.max[a] / align) < corner + edge / align;
      root.corner[static_cast<std::size_t>(a)] = static_cast<std::int64_t>(corner) * (std::int64_t{1} << (kAxisBits - 5));
    }
    if (fits && e - k_ >= 5) return root;
  }
}

double CountGrid::typical_spacing() const {
  // Keys are offsets from a corner that is a multiple of 2^20 cells, so that halving them gives cells of the absolute grid again.
  std::array<std::int64_t, 3> low{INT64_MAX, INT64_MAX, INT64_MAX}, high{INT64_MIN, INT64_MIN, INT64_MIN};
  for (const Slot& s : slots_) {
    if (s.key == kEmpty) continue;
    const auto c = cell_of_key(s.key);
    for (std::size_t a = 0; a < 3; ++a) {
      low[a] = std::min(low[a], c[a] & ~(kHalfRange - 1));
      high[a] = std::max(high[a], c[a]);
    }
  }
  int shift = 0;
  for (std::size_t a = 0; a < 3; ++a)
    while ((high[a] - low[a]) >> shift >= 2 * kHalfRange) ++shift;
  const BudgetLease lease(budget_, used_ * sizeof(WeightedCell), "counting grid");
  std::vector<WeightedCell> cells;
  cells.reserve(used_);
  for (const Slot& s : slots_) {
    if (s.key == kEmpty) continue;
    const auto c = cell_of_key(s.key);
    cells.push_back({morton_encode(static_cast<std::uint64_t>(c[0] - low[0]) >> shift, static_cast<std::uint64_t>(c[1] - low[1]) >> shift,
                                   static_cast<std::uint64_t>(c[2] - low[2]) >> shift), s.count});
  }
  std::sort(cells.begin(), cells.end(), [](const WeightedCell& a, const WeightedCell& b) { return a.key < b.key; });
  merge_equal(cells);
  int k = k_ + shift;
  std::uint64_t count = median_count(cells);
  while (cells.size() > 1 && (cells.size() > 4096 || count < 8)) {
    for (WeightedCell& c : cells) c.key >>= 3;  // the next coarser cell; Morton order survives
    merge_equal(cells);
    count = cells.size() > 4096 ? 0 : median_count(cells);
    ++k;
  }
  return std::ldexp(1.0, k) / std::sqrt(static_cast<double>(count));
}

int CountGrid::level(const RootCube& root) const { return std::min(kMaxLevel, root.exponent - k_); }

std::vector<WeightedCell> CountGrid::cells(const RootCube& root) const {
  const int depth = root.exponent - k_, shift = std::max(0, depth - kMaxLevel);
  std::array<std::int64_t, 3> corner;
  for (std::size_t a = 0; a < 3; ++a) corner[a] = root.corner[a] >> (kAxisBits - depth);
  std::vector<WeightedCell> cells;
  cells.reserve(used_);
  for (const Slot& s : slots_) {
    if (s.key == kEmpty) continue;
    const auto c = cell_of_key(s.key);
    cells.push_back({morton_encode(static_cast<std::uint64_t>(c[0] - corner[0]) >> shift, static_cast<std::uint64_t>(c[1] - corner[1]) >> shift,
                                   static_cast<std::uint64_t>(c[2] - corner[2]) >> shift), s.count});
  }
  std::sort(cells.begin(), cells.end(), [](const WeightedCell& a, const WeightedCell& b) { return a.key < b.key; });
  merge_equal(cells);
  return cells;
}

std::vector<Partition> make_partitions(const std::vector<WeightedCell>& cells, int level, std::uint64_t chunk_surfels, std::uint64_t capacity) {
  std::vector<Partition> partitions{{0, 0}};
  const auto emit = [&](std::uint64_t begin, std::uint64_t count) {
    if (partitions.back().count > 0 && partitions.back().count + count > capacity) partitions.push_back({begin, 0});
    partitions.back().count += count;
  };
  // Largest cells of at most chunk_surfels points, or cells of the grid itself, in Morton order.
  const auto visit = [&](const auto& self, std::size_t first, std::size_t last, std::uint64_t morton, int at) -> void {
    std::uint64_t total = 0;
    for (std::size_t i = first; i < last && (total <= chunk_surfels || at == level); ++i) total += cells[i].count;
    if (total <= chunk_surfels || at == level) return emit(morton << (3 * (kMaxLevel - at)), total);
    const int shift = 3 * (level - at - 1);
    for (std::size_t i = first; i < last;) {
      const std::uint64_t child = cells[i].key >> shift;
      std::size_t end = i + 1;
      while (end < last && cells[end].key >> shift == child) ++end;
      self(self, i, end, child, at + 1);
      i = end;
    }
  };
  visit(visit, 0, cells.size(), 0, 0);
  return partitions;
}

}  // namespace chiaro::stream
