#include "stream/store/spill.h"

#include <algorithm>
#include <bit>
#include <cmath>
#include <cstring>
#include <span>
#include <stdexcept>
#include <utility>

#include "stream/base/error.h"
#include "stream/base/hash.h"

namespace chiaro::stream {
namespace {

enum Column : std::size_t { kX, kY, kZ, kSource, kRed, kGreen, kBlue, kNormalU, kNormalV, kHasNormal, kNumColumns };

/// A column holds min + (bits of the row << shift) * factor.
struct ColumnHeader {
  std::int64_t min = 0;
  std::uint8_t bits = 0, shift = 0;
  std::uint16_t factor = 1;
  std::uint32_t unused = 0;
};

struct PageHeader {
  std::uint32_t crc = 0, bytes = 0;  // of all that follows `bytes`; of the page
  std::uint32_t partition = 0, count = 0;
  std::uint32_t on_grid = 0, unused = 0;
  std::array<double, 3> scale{}, add{};
  std::array<ColumnHeader, kNumColumns> columns;
};
static_assert(sizeof(PageHeader) == 72 + 16 * kNumColumns);
constexpr std::size_t kCheckedFrom = 8;
constexpr std::uint32_t kMostPagePoints = 1 << 16;
constexpr std::uint64_t kColourStep = 257;  // 8-bit colours are stored times this

std::size_t packed_bytes(std::uint32_t count, int bits) { return (static_cast<std::size_t>(count) * static_cast<std::size_t>(bits) + 63) / 64 * 8; }

using Values = std::vector<std::int64_t>;

// 257 times a byte: the same byte twice.
bool is_byte_twice(std::int64_t v) { return (v >> 8) == (v & 255); }

ColumnHeader header_of(const Values& values, bool colour) {
  ColumnHeader h;
  std::int64_t low = values[0], high = low;
  bool bytes = colour;
  for (const std::int64_t v : values) {
    low = std::min(low, v);
    high = std::max(high, v);
    bytes &= is_byte_twice(v);
  }
  h.min = low;
  if (low == high) return h;
  std::uint64_t differ = 0;
  if (bytes) {
    h.min = 0;
    h.factor = kColourStep;
    differ = static_cast<std::uint64_t>(high) >> 8;
  } else {
    for (const std::int64_t v : values) differ |= static_cast<std::uint64_t>(v - low);
    h.shift = static_cast<std::uint8_t>(std::countr_zero(differ));
  }
  h.bits = static_cast<std::uint8_t>(std::bit_width(differ) - h.shift);
  return h;
}

void pack(const Values& values, const ColumnHeader& h, std::vector<std::byte>& out) {
  std::uint64_t word = 0;
  int filled = 0;
  const std::size_t begin = out.size();
  out.resize(begin + packed_bytes(static_cast<std::uint32_t>(values.size()), h.bits));
  std::byte* at = out.data() + begin;
  if (h.bits == 0) return;
  const int shift = h.factor != 1 ? 8 : h.shift;   // of the two bytes alike
  for (const std::int64_t v : values) {
    const std::uint64_t row = static_cast<std::uint64_t>(v - h.min) >> shift;
    word |= row << filled;
    filled += h.bits;
    if (filled < 64) continue;
    std::memcpy(at, &word, 8);
    at += 8;
    filled -= 64;
    word = filled > 0 ? row >> (h.bits - filled) : 0;
  }
  if (filled > 0) std::memcpy(at, &word, 8);
}

// bits <= 56; eight bytes behind the column are readable.
void unpack(const std::byte* from, const ColumnHeader& h, std::size_t count, Values& values) {
  values.resize(count);
  if (h.bits == 0) return std::fill(values.begin(), values.end(), h.min);
  const std::uint64_t mask = (std::uint64_t{1} << h.bits) - 1;
  for (std::size_t i = 0; i < count; ++i) {
    const std::size_t bit = i * h.bits;
    std::uint64_t word;
    std::memcpy(&word, from + bit / 8, 8);
    values[i] = h.min + static_cast<std::int64_t>(((word >> (bit % 8) & mask) << h.shift) * h.factor);
  }
}

std::array<std::uint64_t, 3> place_in_root(const RootCube& root, const PositionGrid* grid, const std::array<std::int64_t, 3>& place) {
  if (!grid) return {static_cast<std::uint64_t>(place[0]), static_cast<std::uint64_t>(place[1]), static_cast<std::uint64_t>(place[2])};
  return root.quantise(grid->position(place));
}

// Stable; nearly always there are two or three.
void sort_few(std::span<SpillRecord> records) {
  const auto before = [](const SpillRecord& a, const SpillRecord& b) { return a.key() < b.key(); };
  if (records.size() > 32) return std::stable_sort(records.begin(), records.end(), before);
  for (std::size_t i = 1; i < records.size(); ++i)
    for (std::size_t k = i; k > 0 && before(records[k], records[k - 1]); --k) std::swap(records[k], records[k - 1]);
}

[[noreturn]] void damaged(const File& file, std::uint64_t offset) { throw Error(concat(file.path().string(), ": the page at byte ", offset, " is damaged")); }

bool is_plausible(const PageHeader& h) {
  std::size_t bytes = sizeof(PageHeader);
  if (h.count == 0 || h.count > kMostPagePoints) return false;
  for (const ColumnHeader& c : h.columns) {
    if (c.bits > 56 || c.shift > 56) return false;
    bytes += packed_bytes(h.count, c.bits);
  }
  return bytes == h.bytes;
}

}  // namespace

SpillPoint spill_point(const SpillRecord& r) {
  SpillPoint p;
  const auto cell = morton_decode(r.cells), local = morton_decode(r.local_flags & 0xffffffffffffull);
  for (std::size_t a = 0; a < 3; ++a) p.place[a] = static_cast<std::int64_t>(std::uint64_t{cell[a]} << kLocalBits | local[a]);
  p.source = r.source();
  p.colour = r.colour;
  p.normal = r.normal;
  p.has_normal = r.has_normal();
  return p;
}

SpillWriter::SpillWriter(File& file, const RootCube& root, const std::vector<Partition>& partitions, std::uint64_t offset, MemoryBudget& budget, std::uint64_t buffer_bytes)
    : file_(file), root_(root), out_offset_(offset) {
  const std::uint64_t per_partition = std::clamp<std::uint64_t>(buffer_bytes / partitions.size(), 4096, 1 << 15);
  out_bytes_ = std::clamp<std::uint64_t>(buffer_bytes / 4, 1 << 14, 1 << 20);
  buffer_points_ = static_cast<std::uint32_t>(per_partition / sizeof(SpillPoint));
  lease_ = BudgetLease(budget, partitions.size() * (buffer_points_ * sizeof(SpillPoint) + 64) + out_bytes_ + per_partition, "spill buffers");
  buffers_.resize(partitions.size() * buffer_points_);
  buffered_.resize(partitions.size());
  pages_.resize(partitions.size());
  for (const Partition& p : partitions) {
    starts_.push_back(p.begin);
    left_.push_back(p.count);
  }
  first_of_cell_.resize(std::size_t{1} << (3 * kStartLevel));
  for (std::size_t cell = 0; cell < first_of_cell_.size(); ++cell) {
    const std::uint64_t begin = static_cast<std::uint64_t>(cell) << (3 * (kMaxLevel - kStartLevel));
    const auto after = std::upper_bound(starts_.begin(), starts_.end(), begin);
    first_of_cell_[cell] = static_cast<std::uint32_t>(std::max<std::ptrdiff_t>(1, after - starts_.begin()) - 1);
  }
}

std::size_t SpillWriter::partition_of(std::uint64_t cells) const {
  std::size_t p = first_of_cell_[cells >> (3 * (kMaxLevel - kStartLevel))];
  while (p + 1 < starts_.size() && starts_[p + 1] <= cells) ++p;
  return p;
}

void SpillWriter::append(std::size_t partition, const SpillPoint& point) {
  std::uint32_t& n = buffered_[partition];
  if (left_[partition] == 0) throw Error("an input file changed while it was read: more points than counted before in one region");
  --left_[partition];
  buffers_[partition * buffer_points_ + n] = point;
  if (++n == buffer_points_) flush(partition);
}

void SpillWriter::flush(std::size_t partition) {
  const std::uint32_t n = buffered_[partition];
  if (n == 0) return;
  buffered_[partition] = 0;
  SpillPoint* const points = &buffers_[partition * buffer_points_];
  PageHeader h;
  h.partition = static_cast<std::uint32_t>(partition);
  h.count = n;
  const PositionGrid* grid = points[0].grid;
  if (!std::all_of(points, points + n, [&](const SpillPoint& p) { return p.grid == grid; })) {
    for (std::uint32_t i = 0; i < n; ++i) {
      const auto q = place_in_root(root_, points[i].grid, points[i].place);
      for (std::size_t a = 0; a < 3; ++a) points[i].place[a] = static_cast<std::int64_t>(q[a]);
    }
    grid = nullptr;
  }
  if (grid) {
    h.on_grid = 1;
    for (std::size_t a = 0; a < 3; ++a) {
      h.scale[a] = grid->scale[static_cast<int>(a)];
      h.add[a] = grid->add[static_cast<int>(a)];
    }
  }
  const std::size_t begin = out_.size();
  out_.resize(begin + sizeof h);
  Values values(n);
  const auto add_column = [&](std::size_t column, const auto& value) {
    for (std::uint32_t i = 0; i < n; ++i) values[i] = static_cast<std::int64_t>(value(points[i]));
    h.columns[column] = header_of(values, column >= kRed && column <= kBlue);
    pack(values, h.columns[column], out_);
  };
  for (std::size_t a = 0; a < 3; ++a) add_column(kX + a, [a](const SpillPoint& p) { return p.place[a]; });
  add_column(kSource, [](const SpillPoint& p) { return p.source; });
  for (std::size_t c = 0; c < 3; ++c) add_column(kRed + c, [c](const SpillPoint& p) { return p.colour[c]; });
  if (std::any_of(points, points + n, [](const SpillPoint& p) { return p.has_normal; })) {
    for (std::size_t c = 0; c < 2; ++c) add_column(kNormalU + c, [c](const SpillPoint& p) { return p.normal[c]; });
    add_column(kHasNormal, [](const SpillPoint& p) { return p.has_normal; });
  }
  h.bytes = static_cast<std::uint32_t>(out_.size() - begin);
  std::memcpy(out_.data() + begin, &h, sizeof h);
  h.crc = crc32c(out_.data() + begin + kCheckedFrom, h.bytes - kCheckedFrom);
  std::memcpy(out_.data() + begin, &h, sizeof h);
  pages_[partition].push_back({out_offset_ + begin, h.bytes, n});
  if (out_.size() >= out_bytes_) write_out();
}

void SpillWriter::write_out() {
  file_.write_at(out_offset_, out_.data(), out_.size());
  out_offset_ += out_.size();
  out_.clear();
}

std::uint64_t SpillWriter::finish() {
  for (std::size_t p = 0; p < left_.size(); ++p) {
    flush(p);
    if (left_[p] != 0) throw Error(concat("an input file changed while it was read: ", left_[p], " points fewer than counted before in one region"));
  }
  write_out();
  return out_offset_;
}

SpillPages find_pages(const File& file, std::uint64_t end, const std::vector<Partition>& partitions) {
  SpillPages pages(partitions.size());
  std::vector<std::uint64_t> points(partitions.size());
  constexpr std::uint64_t kAhead = 8 << 20;   // headers lie 16 KiB apart: read along with what is between, they come at the disk's pace and not at its latency's
  std::uint64_t fetched = 0;
  for (std::uint64_t at = 0; at < end;) {
    for (; fetched < std::min(end, at + kAhead); fetched += kAhead) file.will_need(fetched, kAhead);
    PageHeader h;
    file.read_at(at, &h, sizeof h);
    if (!is_plausible(h) || h.partition >= partitions.size() || h.bytes > end - at) damaged(file, at);
    pages[h.partition].push_back({at, h.bytes, h.count});
    points[h.partition] += h.count;
    at += h.bytes;
  }
  for (std::size_t p = 0; p < partitions.size(); ++p)
    if (points[p] != partitions[p].count) throw Error(concat(file.path().string(), ": ", points[p], " points of partition ", p, ", expected ", partitions[p].count));
  return pages;
}

void PageReader::read(const File& file, const SpillPage& page, const RootCube& root, std::vector<SpillRecord>& records) {
  bytes_.resize(page.bytes + 8);
  file.read_at(page.offset, bytes_.data(), page.bytes);
  PageHeader h;
  if (page.bytes < sizeof h) damaged(file, page.offset);
  std::memcpy(&h, bytes_.data(), sizeof h);
  if (!is_plausible(h) || h.bytes != page.bytes || h.count != page.count || h.crc != crc32c(bytes_.data() + kCheckedFrom, page.bytes - kCheckedFrom)) damaged(file, page.offset);
  const std::size_t first = records.size();
  records.resize(first + h.count);
  const std::span<SpillRecord> to(records.data() + first, h.count);
  const std::byte* at = bytes_.data() + sizeof h;
  const auto next = [&](std::size_t column, Values& values) {
    unpack(at, h.columns[column], h.count, values);
    at += packed_bytes(h.count, h.columns[column].bits);
  };
  for (std::size_t axis = 0; axis < 3; ++axis) next(kX + axis, places_.of[axis]);
  const auto each = [&](std::size_t column, const auto& put) {
    next(column, values_);
    for (std::size_t i = 0; i < to.size(); ++i) put(to[i], values_[i]);
  };
  each(kSource, [](SpillRecord& r, std::int64_t v) {
    r.source_low = static_cast<std::uint32_t>(v);
    r.source_high = static_cast<std::uint8_t>(v >> 32);
  });
  for (std::size_t c = 0; c < 3; ++c) each(kRed + c, [c](SpillRecord& r, std::int64_t v) { r.colour[c] = static_cast<std::uint16_t>(v); });
  for (std::size_t c = 0; c < 2; ++c) each(kNormalU + c, [c](SpillRecord& r, std::int64_t v) { r.normal[c] = static_cast<std::int16_t>(v); });
  next(kHasNormal, values_);
  if (h.on_grid) quantise_places(h.scale, h.add, root);
  cells_.resize(h.count);
  local_.resize(h.count);
  morton_codes(places_, {kLocalBits, kMaxLevel}, cells_);
  morton_codes(places_, {0, kLocalBits}, local_);
  for (std::size_t i = 0; i < to.size(); ++i) {
    to[i].cells = cells_[i];
    to[i].local_flags = local_[i] | (values_[i] ? SpillRecord::kHasNormal : 0);
  }
}

void PageReader::quantise_places(const std::array<double, 3>& scale, const std::array<double, 3>& add, const RootCube& root) {
  for (std::size_t axis = 0; axis < 3; ++axis) {
    std::vector<std::int64_t>& places = places_.of[axis];
    positions_.resize(places.size());
    positions_of(places, {scale[axis], add[axis]}, positions_.data());
    quantise(positions_, root, axis, places.data());
  }
}

std::uint64_t spill_bytes_per_point(int axis_bits, std::uint64_t points, bool has_colour, bool colour_is_16_bit, bool has_normal) {
  const int bits = axis_bits + static_cast<int>(std::bit_width(points)) + (has_colour ? colour_is_16_bit ? 48 : 24 : 0) + (has_normal ? 25 : 0);
  return static_cast<std::uint64_t>((bits + 7) / 8);
}

void sort_by_key(std::vector<SpillRecord>& records, SortRoom& room) {
  const std::size_t n = records.size();
  if (n < 2) return;
  MortonKey low = records[0].key(), high = low;
  for (const SpillRecord& r : records) {
    low = std::min(low, r.key());
    high = std::max(high, r.key());
  }
  // The 33 bits below the common prefix settle nearly every pair; the rest is sorted by the whole key. An item is those bits above the record's number.
  constexpr int kDigit = 11, kPasses = 3;
  const int number_bits = std::bit_width(n - 1);
  if (number_bits + kDigit * kPasses > 64) throw std::length_error("too many points to sort at once");
  const MortonKey differ = low ^ high;
  const auto differ_high = static_cast<std::uint64_t>(differ >> 64), differ_low = static_cast<std::uint64_t>(differ);
  const int top = differ_high != 0 ? 128 - std::countl_zero(differ_high) : 64 - std::countl_zero(differ_low);
  const int shift = std::max(0, top - kDigit * kPasses);
  std::vector<std::uint64_t>&items = room.items, &other = room.other;
  items.resize(n);
  other.resize(n);
  std::array<std::array<std::uint32_t, 1 << kDigit>, kPasses> counts{};
  for (std::size_t i = 0; i < n; ++i) {
    const std::uint64_t window = static_cast<std::uint64_t>(records[i].key() >> shift) & ((std::uint64_t{1} << (kDigit * kPasses)) - 1);
    items[i] = window << number_bits | i;
    for (int pass = 0; pass < kPasses; ++pass) ++counts[static_cast<std::size_t>(pass)][window >> (kDigit * pass) & ((1 << kDigit) - 1)];
  }
  for (int pass = 0; pass < kPasses; ++pass) {
    std::array<std::uint32_t, 1 << kDigit>& start = counts[static_cast<std::size_t>(pass)];
    if (std::any_of(start.begin(), start.end(), [&](std::uint32_t c) { return c == n; })) continue;
    std::uint32_t sum = 0;
    for (std::uint32_t& c : start) sum += std::exchange(c, sum);
    const int digit_at = number_bits + kDigit * pass;
    for (const std::uint64_t item : items) other[start[item >> digit_at & ((1 << kDigit) - 1)]++] = item;
    items.swap(other);
  }
  std::vector<SpillRecord>& sorted = room.sorted;
  sorted.resize(n);
  const std::uint64_t number = (std::uint64_t{1} << number_bits) - 1;
  constexpr std::size_t kAhead = 16;   // records are fetched from all over
  for (std::size_t i = 0; i < n; ++i) {
    __builtin_prefetch(&records[items[std::min(n - 1, i + kAhead)] & number]);
    sorted[i] = records[items[i] & number];
  }
  for (std::size_t i = 0; i < n && shift > 0;) {
    std::size_t end = i + 1;
    while (end < n && (items[end] ^ items[i]) <= number) ++end;
    if (end > i + 1) sort_few(std::span(sorted).subspan(i, end - i));
    i = end;
  }
  records.swap(sorted);
}

}  // namespace chiaro::stream
