/// The spill file of a build: all points as quantised records, grouped by partition, each group in input order.
#pragma once
#include <vector>

#include "stream/base/budget.h"
#include "stream/base/file.h"
#include "stream/store/count_grid.h"

namespace chiaro::stream {

struct SpillRecord {
  std::uint64_t cells = 0;        ///< Morton code of the level-21 cell
  std::uint64_t local_flags = 0;  ///< low 48 bits: Morton code below the cell; bit 48: has a normal
  std::uint32_t source_low = 0;
  std::uint8_t source_high = 0, unused = 0;
  std::array<std::uint16_t, 3> colour{};
  std::array<std::int16_t, 2> normal{};

  static constexpr std::uint64_t kHasNormal = std::uint64_t{1} << 48;
  MortonKey key() const { return make_key(cells, local_flags & 0xffffffffffffull); }
  std::uint64_t source() const { return source_low | static_cast<std::uint64_t>(source_high) << 32; }
  bool has_normal() const { return (local_flags & kHasNormal) != 0; }
};
static_assert(sizeof(SpillRecord) == 32);

/// Appends records to the regions of partitions through one buffer a partition. Not thread-safe; keeps the order of the calls.
class SpillWriter {
 public:
  /// region_begin: first record of the first partition in the file. buffer_bytes is shared by all partitions.
  SpillWriter(File& file, const std::vector<Partition>& partitions, std::uint64_t region_begin, MemoryBudget& budget, std::uint64_t buffer_bytes);
  /// Partition that holds a cell of level 21.
  std::size_t partition_of(std::uint64_t cells) const;
  /// throws Error if the partition is full: the input changed since it was counted.
  void append(std::size_t partition, const SpillRecord& record);
  /// Writes what is buffered. throws Error if a partition got fewer records than counted.
  void finish();

 private:
  void flush(std::size_t partition);
  struct Region {
    std::uint64_t begin = 0, next = 0, end = 0;  ///< records
    std::uint32_t buffered = 0;
  };
  File& file_;
  BudgetLease lease_;
  std::vector<std::uint64_t> starts_;
  std::vector<Region> regions_;
  std::vector<SpillRecord> buffers_;
  std::uint32_t buffer_records_ = 0;
};

/// Sorts by key; equal keys keep their order. scratch memory: 32 B a record beside the result.
std::vector<SpillRecord> sorted_by_key(std::vector<SpillRecord> records);

}  // namespace chiaro::stream
