#include "stream/store/leaf_build.h"

#include <algorithm>
#include <cmath>
#include <cstring>
#include <span>
#include <unordered_map>

#include "stream/base/error.h"
#include "stream/base/hash.h"
#include "stream/base/parallel.h"
#include "stream/store/leaf_fit.h"
#include "stream/store/place_kernels.h"
#include "stream/store/store_format.h"
#include "stream/store/surfel_order.h"

namespace chiaro::stream {
namespace {

constexpr std::uint64_t kBytesPerPoint = 136;  // records, sorting, encoded leaves
constexpr int kSubLevels = 6;                  // an oversized partition is counted this many levels deeper

struct KeyRange {
  MortonKey begin = 0, end = 0;
  bool contains(MortonKey first, MortonKey last) const { return begin <= first && last <= end; }
};

struct LeafData {
  ChunkEntry entry;
  std::vector<SurfelBlock> blocks;
  std::vector<std::byte> sources;
  std::vector<std::uint16_t> colours;
  std::vector<SpillRecord> open;  ///< instead of the above: points of a level-21 cell that may go on in the next range
};

/// Room for encoding one leaf after the other.
struct EncodeRoom {
  std::vector<std::uint64_t> codes;
  AxisColumns<std::uint16_t> places;
  std::vector<StoredPosition> positions;
  PatchOrder patches;
};

// In Morton order a leaf is cheaper to make, in patches cheaper to use: a guessed surfel is a preview.
std::span<const std::uint16_t> order_of(std::size_t count, const LeafRules& rules, EncodeRoom& room) {
  if (rules.guess_surfels) return {};
  room.positions.resize(count);
  for (std::size_t i = 0; i < count; ++i) room.positions[i] = {room.places.of[0][i], room.places.of[1][i], room.places.of[2][i]};
  return room.patches.of(room.positions);
}

LeafData encode_leaf(const SpillRecord* records, std::size_t count, std::uint64_t morton, int level, int part, const LeafRules& rules, bool has_colour, EncodeRoom& room) {
  LeafData leaf;
  leaf.entry.morton = morton;
  leaf.entry.level = static_cast<std::uint8_t>(level);
  leaf.entry.part = static_cast<std::uint8_t>(part);
  leaf.entry.count = static_cast<std::uint32_t>(count);
  leaf.blocks.resize((count + 15) / 16);
  std::vector<std::uint64_t> sources(count);
  if (has_colour) leaf.colours.resize(3 * count);
  room.codes.resize(count);
  for (std::size_t i = 0; i < count; ++i) room.codes[i] = local_of(records[i].key(), level);
  places_of_codes(room.codes, room.places);
  for (std::size_t a = 0; a < 3; ++a) {
    const ValueRange range = range_of(room.places.of[a]);
    leaf.entry.tight_min[a] = range.low;
    leaf.entry.tight_max[a] = range.high;
  }
  const std::span<const std::uint16_t> order = order_of(count, rules, room);
  const std::uint8_t with_normal = rules.normals_have_sign ? SurfelBlock::kOriented : std::uint8_t{0};
  for (std::size_t i = 0; i < leaf.blocks.size() * 16; ++i) {
    const std::size_t last = std::min(i, count - 1), from = order.empty() ? last : order[last];
    const SpillRecord& r = records[from];
    SurfelBlock& b = leaf.blocks[i / 16];
    const std::size_t lane = i % 16;
    b.x[lane] = room.places.of[0][from];
    b.y[lane] = room.places.of[1][from];
    b.z[lane] = room.places.of[2][from];
    b.normal_u[lane] = r.normal[0];
    b.normal_v[lane] = r.normal[1];
    if (i >= count) {
      b.flags[lane] = SurfelBlock::kPadding;
      continue;
    }
    b.flags[lane] = r.has_normal() ? with_normal : SurfelBlock::kEstimated;
    if (has_colour)
      for (std::size_t a = 0; a < 3; ++a) leaf.colours[a * count + i] = r.colour[a];
    sources[i] = r.source();
  }
  pack_sources(sources, leaf.sources);
  leaf.entry.source_crc = crc32c(leaf.sources);
  if (rules.guess_surfels) guess_surfels(leaf.entry, leaf.blocks, std::ldexp(rules.edge, -level - kLocalBits));
  return leaf;
}

class RangeBuilder {
 public:
  RangeBuilder(const std::vector<SpillRecord>& records, KeyRange range, const LeafRules& rules, bool has_colour, EncodeRoom& room)
      : records_(records), range_(range), rules_(rules), has_colour_(has_colour), room_(room) {
    if (!records.empty()) split(0, records.size(), 0, 0);
  }
  std::vector<LeafData> take() { return std::move(leaves_); }

 private:
  void split(std::size_t first, std::size_t last, std::uint64_t morton, int level) {
    const bool whole = range_.contains(cell_begin(morton, level), cell_begin(morton + 1, level));
    if (level == kMaxLevel && !whole) {
      LeafData leaf;
      leaf.entry.morton = morton;
      leaf.open.assign(records_.begin() + static_cast<std::ptrdiff_t>(first), records_.begin() + static_cast<std::ptrdiff_t>(last));
      leaves_.push_back(std::move(leaf));
      return;
    }
    if (level == kMaxLevel || (whole && is_leaf(first, last, level))) return emit(first, last, morton, level);
    for (std::uint64_t child = 8 * morton; first < last; ++child) {
      const MortonKey end_key = cell_begin(child + 1, level + 1);
      const auto end = std::lower_bound(records_.begin() + static_cast<std::ptrdiff_t>(first), records_.begin() + static_cast<std::ptrdiff_t>(last), end_key,
                                        [](const SpillRecord& r, MortonKey k) { return r.key() < k; });
      const auto next = static_cast<std::size_t>(end - records_.begin());
      if (next > first) split(first, next, child, level + 1);
      first = next;
    }
  }

  bool is_leaf(std::size_t first, std::size_t last, int level) const {
    if (last - first > rules_.chunk_surfels) return false;
    if (std::ldexp(rules_.edge, -level - kLocalBits) > rules_.max_step) return false;
    std::size_t distinct = 0, together = 0;
    const int shift = 3 * (kAxisBits - level - 12);
    for (std::size_t i = first + 1; i < last; ++i) {
      const MortonKey differ = records_[i].key() ^ records_[i - 1].key();
      distinct += differ != 0;
      together += differ != 0 && (differ >> shift) == 0;
    }
    return together * 100 <= distinct;
  }

  void emit(std::size_t first, std::size_t last, std::uint64_t morton, int level) {
    int part = 0;
    for (; first < last; first += rules_.chunk_surfels, ++part) {
      if (part > 255) too_many(rules_);
      leaves_.push_back(encode_leaf(&records_[first], std::min<std::size_t>(rules_.chunk_surfels, last - first), morton, level, part, rules_, has_colour_, room_));
    }
  }

 public:
  [[noreturn]] static void too_many(const LeafRules& rules) {
    throw Error(concat("more than ", 256ull * rules.chunk_surfels, " points within ", std::ldexp(rules.edge, -kMaxLevel), " project units: one cell of the deepest level is full"));
  }

 private:
  const std::vector<SpillRecord>& records_;
  KeyRange range_;
  const LeafRules& rules_;
  bool has_colour_;
  EncodeRoom& room_;
  std::vector<LeafData> leaves_;
};

class LeafAssembler {
 public:
  LeafAssembler(File& spill, std::uint64_t spill_end, const RootCube& root, const LeafRules& rules, const LeafFiles& files, MemoryBudget& budget, Reporter& report)
      : spill_(spill), spill_end_(spill_end), root_(root), rules_(rules), files_(files), budget_(budget), report_(report) {}

  std::vector<ChunkEntry> run(const std::vector<Partition>& partitions) {
    const std::uint64_t capacity = leaf_workers(budget_, rules_.chunk_surfels).capacity;
    SpillPages pages = find_pages(spill_, spill_end_, partitions);
    const auto job_of = [&](std::size_t i) {
      const MortonKey begin = cell_begin(partitions[i].begin, kMaxLevel);
      const MortonKey end = i + 1 < partitions.size() ? cell_begin(partitions[i + 1].begin, kMaxLevel) : cell_begin(1, 0);
      return Job{std::move(pages[i]), partitions[i].count, {begin, end}, {}};
    };
    for (std::size_t i = 0; i < partitions.size();) {
      if (partitions[i].count > capacity) {
        build_oversized(job_of(i++), capacity);
        continue;
      }
      std::vector<Job> jobs;
      for (; i < partitions.size() && partitions[i].count <= capacity; ++i) jobs.push_back(job_of(i));
      build(jobs);
    }
    close_open_leaf();
    return std::move(entries_);
  }

 private:
  struct Job {
    std::vector<SpillPage> pages;
    std::uint64_t count = 0;
    KeyRange range;
    std::vector<LeafData> leaves;
  };
  struct Room {
    PageReader pages;
    std::vector<SpillRecord> records;
    SortRoom sorting;
    EncodeRoom encoding;
  };

  // Some are sorted while the leaves of those before are written.
  void build(std::span<Job> jobs) {
    std::uint64_t largest = 0;
    for (const Job& job : jobs) largest = std::max(largest, job.count);
    const auto workers = static_cast<std::size_t>(leaf_workers(budget_, rules_.chunk_surfels).workers);
    const bool room_for_one_more = (workers + 1) * largest * kBytesPerPoint <= budget_.free_bytes() / 10 * 7;
    const std::size_t slots = std::min(jobs.size(), room_for_one_more ? workers + 1 : workers);
    const BudgetLease lease(budget_, slots * largest * kBytesPerPoint, "sorting of points");
    rooms_.resize(std::max(rooms_.size(), slots));
    std::vector<std::size_t> job_in(slots);
    std::size_t next = 0, fetched = 0;
    const auto begin = [&](std::size_t slot) {
      if (next == jobs.size()) return false;
      // A partition lies in hundreds of small pages all over the file: asked for one after the other they would come at the pace of the disk's latency.
      for (; fetched < std::min(jobs.size(), next + slots + 1); ++fetched)
        for (const SpillPage& page : jobs[fetched].pages) spill_.will_need(page.offset, page.bytes);
      job_in[slot] = next++;
      return true;
    };
    const auto work = [&](std::size_t slot) {
      report_.check();
      sort(jobs[job_in[slot]], rooms_[slot]);
    };
    const auto end = [&](std::size_t slot) {
      Job& job = jobs[job_in[slot]];
      for (LeafData& leaf : job.leaves) write(leaf);
      job.leaves = {};
      done_ += job.count;
      report_.progress(done_);
    };
    ordered_pipeline(slots, begin, work, end);
  }

  void sort(Job& job, Room& room) const {
    room.records.clear();
    room.records.reserve(job.count);
    for (const SpillPage& page : job.pages) room.pages.read(spill_, page, root_, room.records);
    job.pages = {};
    sort_by_key(room.records, room.sorting);
    job.leaves = RangeBuilder(room.records, job.range, rules_, files_.colour != nullptr, room.encoding).take();
  }

  // One cell with more points than fit: its records are distributed again, by the next bits of their keys, behind the others in the spill file.
  void build_oversized(const Job& job, std::uint64_t capacity) {
    report_.check();
    rooms_.clear();
    MortonKey low = ~MortonKey{0}, high = 0;
    for_each_record(job, [&](const SpillRecord& r) {
      low = std::min(low, r.key());
      high = std::max(high, r.key());
    });
    if (low == high) return stream_duplicates(job, low);
    int shared = 0;  // deepest level at which all points share a cell
    while (cell_of_any(low, shared + 1) == cell_of_any(high, shared + 1)) ++shared;
    const int depth = std::min(kAxisBits, shared + kSubLevels);
    const MortonKey base = cell_of_any(low, shared) << (3 * (depth - shared));
    std::unordered_map<std::uint64_t, std::uint64_t> counts;
    for_each_record(job, [&](const SpillRecord& r) { ++counts[static_cast<std::uint64_t>(cell_of_any(r.key(), depth) - base)]; });
    std::vector<WeightedCell> cells;
    for (const auto& [key, count] : counts) cells.push_back({key, count});
    std::sort(cells.begin(), cells.end(), [](const WeightedCell& x, const WeightedCell& y) { return x.key < y.key; });
    std::vector<Job> jobs;
    std::unordered_map<std::uint64_t, std::size_t> job_of;
    cut(cells, job, base, depth, depth - shared, capacity, jobs, job_of);
    const std::uint64_t saved = spill_end_;
    redistribute(job, base, depth, jobs, job_of);
    for (Job& j : jobs) {
      if (j.count > capacity) {
        build_oversized(j, capacity);
      } else {
        build(std::span(&j, 1));
      }
    }
    spill_end_ = saved;
    spill_.truncate(saved);
  }

  static MortonKey cell_of_any(MortonKey key, int level) { return key >> (3 * (kAxisBits - level)); }

  template <class F>
  void for_each_record(const Job& job, const F& body) {
    PageReader reader;
    std::vector<SpillRecord> records;
    for (const SpillPage& page : job.pages) {
      records.clear();
      reader.read(spill_, page, root_, records);
      for (const SpillRecord& r : records) body(r);
    }
  }

  // Sub-ranges of at most `capacity` points; see make_partitions, whose rule this repeats for keys below level 21.
  void cut(const std::vector<WeightedCell>& cells, const Job& job, MortonKey base, int depth, int num_levels, std::uint64_t capacity, std::vector<Job>& jobs,
           std::unordered_map<std::uint64_t, std::size_t>& job_of) const {
    const auto visit = [&](const auto& self, std::size_t first, std::size_t last, int below) -> void {
      std::uint64_t total = 0;
      for (std::size_t i = first; i < last; ++i) total += cells[i].count;
      if (total > rules_.chunk_surfels && below > 0) {
        const int shift = 3 * (below - 1);
        for (std::size_t i = first; i < last;) {
          std::size_t end = i + 1;
          while (end < last && cells[end].key >> shift == cells[i].key >> shift) ++end;
          self(self, i, end, below - 1);
          i = end;
        }
        return;
      }
      if (jobs.empty() || jobs.back().count + total > capacity) {
        const std::uint64_t start = (cells[first].key >> (3 * below)) << (3 * below);
        const MortonKey begin = jobs.empty() ? job.range.begin : (base + start) << (3 * (kAxisBits - depth));
        if (!jobs.empty()) jobs.back().range.end = begin;
        jobs.push_back({{}, 0, {begin, job.range.end}, {}});
      }
      jobs.back().count += total;
      for (std::size_t i = first; i < last; ++i) job_of[cells[i].key] = jobs.size() - 1;
    };
    visit(visit, 0, cells.size(), num_levels);
  }

  void redistribute(const Job& job, MortonKey base, int depth, std::vector<Job>& jobs, const std::unordered_map<std::uint64_t, std::size_t>& job_of) {
    std::vector<Partition> regions;
    for (const Job& j : jobs) regions.push_back({0, j.count});
    SpillWriter writer(spill_, root_, regions, spill_end_, budget_, std::min<std::uint64_t>(16 << 20, budget_.free_bytes() / 4));
    for_each_record(job, [&](const SpillRecord& r) { writer.append(job_of.at(static_cast<std::uint64_t>(cell_of_any(r.key(), depth) - base)), spill_point(r)); });
    spill_end_ = writer.finish();
    for (std::size_t i = 0; i < jobs.size(); ++i) jobs[i].pages = writer.pages()[i];
  }

  // More points on one spot than fit in memory: they are in input order already.
  void stream_duplicates(const Job& job, MortonKey key) {
    LeafData leaf;
    leaf.entry.morton = cell_of(key, kMaxLevel);
    for_each_record(job, [&](const SpillRecord& r) {
      leaf.open.assign(1, r);
      write(leaf);
    });
    done_ += job.count;
    report_.progress(done_);
  }

  void write(LeafData& leaf) {
    if (leaf.open.empty()) {
      close_open_leaf();
      return store(leaf);
    }
    if (!open_.empty() || open_part_ > 0)
      if (open_morton_ != leaf.entry.morton) close_open_leaf();
    open_morton_ = leaf.entry.morton;
    for (const SpillRecord& r : leaf.open) {
      open_.push_back(r);
      if (open_.size() == rules_.chunk_surfels) flush_open_leaf();
    }
  }

  void flush_open_leaf() {
    if (open_.empty()) return;
    if (open_part_ > 255) RangeBuilder::too_many(rules_);
    LeafData leaf = encode_leaf(open_.data(), open_.size(), open_morton_, kMaxLevel, open_part_++, rules_, files_.colour != nullptr, open_room_);
    open_.clear();
    store(leaf);
  }

  void close_open_leaf() {
    flush_open_leaf();
    open_part_ = 0;
  }

  void store(LeafData& leaf) {
    leaf.entry.offset = geometry_end_;
    leaf.entry.source_offset = source_end_;
    files_.geometry.write_at(geometry_end_, leaf.blocks.data(), leaf.blocks.size() * sizeof(SurfelBlock));
    files_.source.write_at(source_end_, leaf.sources.data(), leaf.sources.size());
    if (files_.colour) files_.colour->write_at(source_end_ / kSourceBytes * 6, leaf.colours.data(), leaf.colours.size() * 2);
    geometry_end_ += (geometry_bytes(leaf.entry.count) + kChunkAlignment - 1) / kChunkAlignment * kChunkAlignment;
    source_end_ += leaf.sources.size();
    entries_.push_back(leaf.entry);
  }

  File& spill_;
  std::uint64_t spill_end_;
  const RootCube& root_;
  const LeafRules& rules_;
  const LeafFiles& files_;
  MemoryBudget& budget_;
  Reporter& report_;
  std::uint64_t done_ = 0, geometry_end_ = 0, source_end_ = 0;
  std::vector<ChunkEntry> entries_;
  std::vector<SpillRecord> open_;
  std::uint64_t open_morton_ = 0;
  int open_part_ = 0;
  EncodeRoom open_room_;
  std::vector<Room> rooms_;   // one for each job at a time, used again by the next
};

}  // namespace

LeafWorkers leaf_workers(const MemoryBudget& budget, std::uint32_t chunk_surfels) {
  const std::uint64_t points = budget.free_bytes() / 10 * 7 / kBytesPerPoint;
  const std::uint64_t least = std::min<std::uint64_t>(2 * std::uint64_t{chunk_surfels}, 131072);
  LeafWorkers w;
  w.workers = static_cast<int>(std::clamp<std::uint64_t>(points / least, 1, static_cast<std::uint64_t>(std::clamp(ThreadLimit::current(), 1, 32))));
  w.capacity = std::max<std::uint64_t>(std::min<std::uint64_t>(points / static_cast<std::uint64_t>(w.workers), 4'000'000), chunk_surfels);
  return w;
}

std::vector<ChunkEntry> build_leaves(File& spill, std::uint64_t spill_end, const RootCube& root, const std::vector<Partition>& partitions, const LeafRules& rules,
                                     const LeafFiles& files, MemoryBudget& budget, Reporter& report) {
  return LeafAssembler(spill, spill_end, root, rules, files, budget, report).run(partitions);
}

}  // namespace chiaro::stream
