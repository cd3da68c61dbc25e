#include "stream/store/spill.h"

#include <algorithm>
#include <bit>

#include "stream/base/error.h"

namespace chiaro::stream {

SpillWriter::SpillWriter(File& file, const std::vector<Partition>& partitions, std::uint64_t region_begin, MemoryBudget& budget, std::uint64_t buffer_bytes) : file_(file) {
  const std::uint64_t per_partition = std::clamp<std::uint64_t>(buffer_bytes / partitions.size(), 2048, 1 << 18);
  buffer_records_ = static_cast<std::uint32_t>(per_partition / sizeof(SpillRecord));
  lease_ = BudgetLease(budget, partitions.size() * (buffer_records_ * sizeof(SpillRecord) + sizeof(Region) + 8), "spill buffers");
  buffers_.resize(partitions.size() * buffer_records_);
  std::uint64_t at = region_begin;
  for (const Partition& p : partitions) {
    starts_.push_back(p.begin);
    regions_.push_back({at, at, at + p.count, 0});
    at += p.count;
  }
}

std::size_t SpillWriter::partition_of(std::uint64_t cells) const {
  return static_cast<std::size_t>(std::upper_bound(starts_.begin(), starts_.end(), cells) - starts_.begin()) - 1;
}

void SpillWriter::append(std::size_t partition, const SpillRecord& record) {
  Region& r = regions_[partition];
  if (r.next + r.buffered == r.end) throw Error("an input file changed while it was read: more points than counted before in one region");
  buffers_[partition * buffer_records_ + r.buffered] = record;
  if (++r.buffered == buffer_records_) flush(partition);
}

void SpillWriter::flush(std::size_t partition) {
  Region& r = regions_[partition];
  file_.write_at(r.next * sizeof(SpillRecord), &buffers_[partition * buffer_records_], r.buffered * sizeof(SpillRecord));
  r.next += r.buffered;
  r.buffered = 0;
}

void SpillWriter::finish() {
  for (std::size_t p = 0; p < regions_.size(); ++p) {
    flush(p);
    if (regions_[p].next != regions_[p].end)
      throw Error(concat("an input file changed while it was read: ", regions_[p].end - regions_[p].next, " points fewer than counted before in one region"));
  }
}

std::vector<SpillRecord> sorted_by_key(std::vector<SpillRecord> records) {
  struct Item {
    std::uint64_t window;
    std::uint32_t index, unused;
  };
  const std::size_t n = records.size();
  if (n < 2) return records;
  MortonKey low = records[0].key(), high = low;
  for (const SpillRecord& r : records) {
    low = std::min(low, r.key());
    high = std::max(high, r.key());
  }
  // The 44 bits below the common prefix settle nearly every pair; the rest is sorted by the whole key.
  const MortonKey differ = low ^ high;
  const auto differ_high = static_cast<std::uint64_t>(differ >> 64), differ_low = static_cast<std::uint64_t>(differ);
  const int top = differ_high != 0 ? 128 - std::countl_zero(differ_high) : 64 - std::countl_zero(differ_low);
  const int shift = std::max(0, top - 44);
  std::vector<Item> items(n), other(n);
  for (std::size_t i = 0; i < n; ++i) items[i] = {static_cast<std::uint64_t>(records[i].key() >> shift) & ((std::uint64_t{1} << 44) - 1), static_cast<std::uint32_t>(i), 0};
  for (int pass = 0; pass < 4; ++pass) {
    std::array<std::uint32_t, 2049> start{};
    for (const Item& item : items) ++start[1 + ((item.window >> (11 * pass)) & 2047)];
    if (std::any_of(start.begin(), start.end(), [&](std::uint32_t c) { return c == n; })) continue;
    for (std::size_t d = 1; d < start.size(); ++d) start[d] += start[d - 1];
    for (const Item& item : items) other[start[(item.window >> (11 * pass)) & 2047]++] = item;
    items.swap(other);
  }
  std::vector<Item>().swap(other);
  std::vector<SpillRecord> sorted(n);
  for (std::size_t i = 0; i < n; ++i) sorted[i] = records[items[i].index];
  for (std::size_t i = 0; i < n;) {
    std::size_t end = i + 1;
    while (end < n && items[end].window == items[i].window) ++end;
    if (end - i > 1 && shift > 0)
      std::stable_sort(sorted.begin() + static_cast<std::ptrdiff_t>(i), sorted.begin() + static_cast<std::ptrdiff_t>(end),
                       [](const SpillRecord& a, const SpillRecord& b) { return a.key() < b.key(); });
    i = end;
  }
  return sorted;
}

}  // namespace chiaro::stream
