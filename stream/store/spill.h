/// The spill file of a build: all points, grouped by partition, in pages that follow each other. A page holds points of one partition in input order, its
/// columns packed to the bits that differ: about 12 to 16 bytes a point.
#pragma once
#include <vector>

#include "stream/base/budget.h"
#include "stream/base/file.h"
#include "stream/cloud/point_stream.h"
#include "stream/store/count_grid.h"
#include "stream/store/place_kernels.h"

namespace chiaro::stream {

/// A point while leaves are made from it.
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

/// A point on its way to the spill file. Where a file stores integers of a grid these are kept, since they need fewer bits; else the coordinates in the root.
struct SpillPoint {
  std::array<std::int64_t, 3> place{};  ///< on `grid`, or root coordinates of 37 bits
  const PositionGrid* grid = nullptr;   ///< must outlive the writer
  std::uint64_t source = 0;
  std::array<std::uint16_t, 3> colour{};
  std::array<std::int16_t, 2> normal{};
  bool has_normal = false;
};
SpillPoint spill_point(const SpillRecord& record);

/// Where a page lies.
struct SpillPage {
  std::uint64_t offset = 0;
  std::uint32_t bytes = 0, count = 0;
};
/// Pages of each partition in the order in which they were written.
using SpillPages = std::vector<std::vector<SpillPage>>;

/// Appends points to partitions through one buffer a partition. Not thread-safe; keeps the order of the calls.
class SpillWriter {
 public:
  /// Pages are written from `offset` on. buffer_bytes is shared by all partitions.
  SpillWriter(File& file, const RootCube& root, const std::vector<Partition>& partitions, std::uint64_t offset, MemoryBudget& budget, std::uint64_t buffer_bytes);
  /// Partition that holds a cell of level 21.
  std::size_t partition_of(std::uint64_t cells) const;
  /// throws Error if the partition is full: the input changed since it was counted.
  void append(std::size_t partition, const SpillPoint& point);
  /// Writes what is buffered and returns where the pages end. throws Error if a partition got fewer points than counted.
  std::uint64_t finish();
  const SpillPages& pages() const { return pages_; }

 private:
  void flush(std::size_t partition);
  void write_out();
  static constexpr int kStartLevel = 5;  ///< cells whose first partition is looked up
  File& file_;
  RootCube root_;
  BudgetLease lease_;
  std::vector<std::uint64_t> starts_, left_;
  std::vector<std::uint32_t> first_of_cell_, buffered_;
  std::vector<SpillPoint> buffers_;
  std::uint32_t buffer_points_ = 0;
  std::vector<std::byte> out_;  ///< pages that are not in the file yet
  std::uint64_t out_offset_ = 0, out_bytes_ = 0;
  SpillPages pages_;
};

/// Finds the pages of a finished spill file of `end` bytes. throws Error if they are not those of the partitions.
SpillPages find_pages(const File& file, std::uint64_t end, const std::vector<Partition>& partitions);
/// Reads pages, one after the other through the same room. One object a thread.
class PageReader {
 public:
  /// Appends the points of a page. throws Error if it is damaged.
  void read(const File& file, const SpillPage& page, const RootCube& root, std::vector<SpillRecord>& records);

 private:
  void quantise_places(const std::array<double, 3>& scale, const std::array<double, 3>& add, const RootCube& root);
  std::vector<std::byte> bytes_;
  AxisColumns<std::int64_t> places_;
  std::vector<std::int64_t> values_;
  std::vector<double> positions_;
  std::vector<std::uint64_t> cells_, local_;
};

/// Bytes that pages of many points need at most for each, headers aside: `axis_bits` of the three coordinates together.
std::uint64_t spill_bytes_per_point(int axis_bits, std::uint64_t points, bool has_colour, bool colour_is_16_bit, bool has_normal);

/// Room that sorting needs beside the records, 48 B each; kept from one call to the next, since fresh pages cost as much as the sorting.
struct SortRoom {
  std::vector<std::uint64_t> items, other;
  std::vector<SpillRecord> sorted;
};
/// Sorts by key; equal keys keep their order.
void sort_by_key(std::vector<SpillRecord>& records, SortRoom& room);

}  // namespace chiaro::stream
