#include "stream/store/leaf_build.h"

#include <gtest/gtest.h>

#include "memory_cloud.h"
#include "stream/base/error.h"
#include "stream/base/file.h"

namespace chiaro::stream {
namespace {

// Records of a unit cube: a surface, and many points on one spot.
std::vector<SpillRecord> records_with_duplicates(std::size_t surface, std::size_t duplicates) {
  RootCube cube;
  std::vector<SpillRecord> records;
  for (std::size_t i = 0; i < surface + duplicates; ++i) {
    const bool same = i % (1 + surface / std::max<std::size_t>(duplicates, 1)) == 0 || i >= surface;
    const auto q = cube.quantise(same ? Vec3d(0.3, 0.6, 0.9) : Vec3d(uniform(i, 0), uniform(i, 1), 0.25 + 0.001 * uniform(i, 2)));
    SpillRecord r;
    r.cells = morton_encode(q[0] >> kLocalBits, q[1] >> kLocalBits, q[2] >> kLocalBits);
    r.local_flags = morton_encode(q[0] & 0xffff, q[1] & 0xffff, q[2] & 0xffff);
    r.source_low = static_cast<std::uint32_t>(i);
    records.push_back(r);
  }
  return records;
}

struct Result {
  std::vector<ChunkEntry> entries;
  std::string geometry, source;
};

Result build_with(const std::vector<SpillRecord>& records, std::uint64_t memory) {
  const ScratchFolder scratch;
  {
    File spill(scratch.path() / "spill", File::Mode::kCreate), geometry(scratch.path() / "g", File::Mode::kCreate), source(scratch.path() / "s", File::Mode::kCreate);
    MemoryBudget large(64 << 20), budget(memory);
    const std::vector<Partition> partitions{{0, records.size()}};
    SpillWriter writer(spill, RootCube{}, partitions, 0, large, 1 << 20);
    for (const SpillRecord& r : records) writer.append(0, spill_point(r));
    const std::uint64_t end = writer.finish();
    LeafRules rules;
    rules.chunk_surfels = 500;
    Result r;
    r.entries = build_leaves(spill, end, RootCube{}, partitions, rules, {geometry, source, nullptr}, budget, silent_reporter());
    EXPECT_LE(budget.peak_bytes(), memory);
    EXPECT_EQ(spill.size(), end) << "what was added for sub-partitions is removed again";
    r.geometry = read_text(scratch.path() / "g");
    r.source = read_text(scratch.path() / "s");
    return r;
  }
}

TEST(LeafBuild, APartitionLargerThanMemoryGivesTheSameLeaves) {
  const auto records = records_with_duplicates(40000, 30000);
  const Result once = build_with(records, 256 << 20), pieces = build_with(records, 1 << 20);
  MemoryBudget small(1 << 20);
  ASSERT_LT(leaf_workers(small, 500).capacity, 10000u);
  ASSERT_EQ(once.entries.size(), pieces.entries.size());
  EXPECT_TRUE(once.geometry == pieces.geometry);
  EXPECT_TRUE(once.source == pieces.source);
  std::uint64_t points = 0;
  int parts = 0;
  for (std::size_t i = 0; i < once.entries.size(); ++i) {
    const ChunkEntry &a = once.entries[i], &b = pieces.entries[i];
    EXPECT_TRUE(a.morton == b.morton && a.level == b.level && a.part == b.part && a.count == b.count && a.offset == b.offset);
    points += a.count;
    parts = std::max<int>(parts, a.part);
  }
  EXPECT_EQ(points, records.size());
  EXPECT_GE(parts, 59);
}

TEST(LeafBuild, MorePointsOnOneSpotThanPartsIsAnError) {
  const auto records = records_with_duplicates(10, 129000);
  EXPECT_THROW(build_with(records, 256 << 20), Error);
  EXPECT_THROW(build_with(records, 1 << 20), Error);
}

TEST(LeafBuild, PartitionsNeverCutASmallCell) {
  std::vector<WeightedCell> cells;
  std::uint64_t total = 0;
  for (std::uint64_t i = 0; i < 4096; ++i) {
    if (uniform(i, 0) < 0.5) continue;
    cells.push_back({i, 1 + static_cast<std::uint64_t>(uniform(i, 1) * 40)});
    total += cells.back().count;
  }
  const auto partitions = make_partitions(cells, 4, 300, 1000);
  ASSERT_GT(partitions.size(), 10u);
  std::uint64_t sum = 0;
  for (const Partition& p : partitions) {
    EXPECT_LE(p.count, 1000u);
    sum += p.count;
  }
  EXPECT_EQ(sum, total);
  for (int level = 0; level <= 4; ++level)
    for (std::size_t i = 0; i < cells.size();) {
      const int shift = 3 * (4 - level);
      std::uint64_t count = 0;
      const std::uint64_t cell = cells[i].key >> shift;
      for (; i < cells.size() && cells[i].key >> shift == cell; ++i) count += cells[i].count;
      if (count > 300) continue;
      const std::uint64_t begin = cell << (3 * (kMaxLevel - level)), end = (cell + 1) << (3 * (kMaxLevel - level));
      for (const Partition& p : partitions) EXPECT_FALSE(p.begin > begin && p.begin < end);
    }
}

TEST(CountGrid, RootAndSpacingDoNotDependOnTheBudget) {
  std::vector<Vec3d> points;
  for (std::size_t i = 0; i < 700000; ++i) points.push_back(Vec3d(300, -20, 5) + 30 * sphere_direction(i));
  std::stable_partition(points.begin(), points.end(), [](const Vec3d& p) { return p.z() > 5 + 24; });   // a cap first: cells start smaller than suits the whole
  MemoryBudget large(1 << 30), small(64 << 20);
  CountGrid a(large, 256 << 20), b(small, 0);
  for (std::size_t i = 0; i < points.size(); i += 65536) {
    const std::vector<Vec3d> block(points.begin() + static_cast<std::ptrdiff_t>(i), points.begin() + static_cast<std::ptrdiff_t>(std::min(points.size(), i + 65536)));
    a.add(block);
    b.add(block);
  }
  EXPECT_LT(a.exponent(), b.exponent());
  EXPECT_EQ(a.root().exponent, b.root().exponent);
  EXPECT_EQ(a.root().corner, b.root().corner);
  EXPECT_EQ(a.typical_spacing(), b.typical_spacing());
  const double truth = std::sqrt(4 * 3.14159265 * 900 / 700000);
  EXPECT_GT(a.typical_spacing(), truth / 2);
  EXPECT_LT(a.typical_spacing(), truth * 2);
  std::uint64_t sum = 0;
  for (const WeightedCell& c : b.cells(b.root())) sum += c.count;
  EXPECT_EQ(sum, 700000u);
}

TEST(CountGrid, TheCellOfAPointIsTheSameInBothPasses) {
  MemoryBudget budget(1 << 28);
  CountGrid grid(budget, 0);
  std::vector<Vec3d> points{{-1e-20, 0, 0}, {100, 5, -7}, {-100, 3, 1e-300}};
  for (std::uint64_t i = 0; i < 2000; ++i) points.push_back({200 * uniform(i, 0) - 100, std::floor(uniform(i, 1) * 64) / 8, uniform(i, 2) * 1e-3});
  grid.add(points);
  const RootCube root = grid.root();
  std::map<std::uint64_t, std::uint64_t> counts;
  const int level = grid.level(root);
  for (const Vec3d& p : points) {
    const auto q = root.quantise(p);
    ++counts[morton_encode(q[0] >> (kAxisBits - level), q[1] >> (kAxisBits - level), q[2] >> (kAxisBits - level))];
    const Vec3d back = root.origin() + std::ldexp(root.edge(), -kAxisBits) * Vec3d(static_cast<double>(q[0]) + 0.5, static_cast<double>(q[1]) + 0.5, static_cast<double>(q[2]) + 0.5);
    EXPECT_LE((back - p).cwiseAbs().maxCoeff(), std::ldexp(root.edge(), -kAxisBits));
  }
  const auto cells = grid.cells(root);
  ASSERT_EQ(cells.size(), counts.size());
  for (const WeightedCell& c : cells) EXPECT_EQ(counts[c.key], c.count);
}

TEST(Spill, PagesGiveBackWhatWasWritten) {
  const ScratchFolder scratch;
  File file(scratch.path() / "spill", File::Mode::kCreate);
  MemoryBudget budget(64 << 20);
  RootCube root;
  root.exponent = 5;
  const PositionGrid grid{{0.001, 0.01, 1e-4}, {1, 2, 3}};
  std::vector<SpillPoint> points;
  for (std::uint64_t i = 0; i < 20000; ++i) {
    SpillPoint p;
    const bool on_grid = i < 9000 || i % 3 == 0;  // some pages are mixed
    for (std::size_t a = 0; a < 3; ++a) p.place[a] = static_cast<std::int64_t>(uniform(i, static_cast<std::uint32_t>(a)) * (on_grid ? 2000 : 0x1p37));
    if (on_grid) p.grid = &grid;
    p.source = i == 19999 ? std::uint64_t{1} << 39 : 7 * i;
    if (i >= 100) p.colour = {static_cast<std::uint16_t>(257 * (i % 256)), static_cast<std::uint16_t>(i), 9};
    p.has_normal = i % 5 != 0;
    p.normal = {static_cast<std::int16_t>(-16 * static_cast<int>(i % 2000)), 16};
    points.push_back(p);
  }
  const std::vector<Partition> partitions{{0, 10000}, {std::uint64_t{1} << 60, 10000}};
  SpillWriter writer(file, root, partitions, 0, budget, 1 << 20);
  for (std::size_t i = 0; i < points.size(); ++i) writer.append(i % 2, points[i]);
  const std::uint64_t end = writer.finish();
  EXPECT_EQ(end, file.size());
  const SpillPages pages = find_pages(file, end, partitions);
  for (std::size_t p = 0; p < 2; ++p) {
    std::vector<SpillRecord> records;
    for (const SpillPage& page : pages[p]) PageReader().read(file, page, root, records);
    ASSERT_EQ(records.size(), 10000u);
    for (std::size_t k = 0; k < records.size(); ++k) {
      const SpillPoint &in = points[2 * k + p], out = spill_point(records[k]);
      std::array<std::int64_t, 3> place = in.place;
      if (in.grid) {
        const auto q = root.quantise(grid.position(in.place));
        place = {static_cast<std::int64_t>(q[0]), static_cast<std::int64_t>(q[1]), static_cast<std::int64_t>(q[2])};
      }
      ASSERT_EQ(out.place, place);
      ASSERT_EQ(out.source, in.source);
      ASSERT_EQ(out.colour, in.colour);
      ASSERT_EQ(out.normal, in.normal);
      ASSERT_EQ(out.has_normal, in.has_normal);
    }
  }
  std::uint8_t byte = 0;
  file.read_at(end / 2, &byte, 1);
  byte ^= 4;
  file.write_at(end / 2, &byte, 1);
  const auto read_all = [&] {
    std::vector<SpillRecord> records;
    for (const auto& of_partition : find_pages(file, end, partitions))
      for (const SpillPage& page : of_partition) PageReader().read(file, page, root, records);
  };
  EXPECT_THROW(read_all(), Error);
}

TEST(Spill, SortingKeepsTheOrderOfEqualKeys) {
  auto records = records_with_duplicates(5000, 3000);
  std::vector<SpillRecord> sorted = records;
  SortRoom room;
  sort_by_key(sorted, room);
  for (std::size_t i = 1; i < sorted.size(); ++i) {
    ASSERT_TRUE(sorted[i - 1].key() <= sorted[i].key());
    ASSERT_TRUE(sorted[i - 1].key() != sorted[i].key() || sorted[i - 1].source() < sorted[i].source());
  }
}

}  // namespace
}  // namespace chiaro::stream
