#include "stream/store/surfel_order.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>

#include "memory_cloud.h"
#include "stream/store/morton.h"

namespace chiaro::stream {
namespace {

std::uint64_t code_of(const StoredPosition& p) { return morton_encode(p[0], p[1], p[2]); }

// A wavy sheet across the cell; every `twice`-th position is there several times.
std::vector<StoredPosition> sheet(std::size_t count, std::size_t twice = 0) {
  std::vector<StoredPosition> positions;
  while (positions.size() < count) {
    const std::uint64_t i = positions.size();
    const double x = uniform(i, 0), y = uniform(i, 1), z = 0.5 + 0.1 * std::sin(9 * x) * std::sin(7 * y);
    const StoredPosition p{static_cast<std::uint16_t>(65535 * x), static_cast<std::uint16_t>(65535 * y), static_cast<std::uint16_t>(65535 * z)};
    const std::size_t times = twice > 0 && i % twice == 0 ? 1 + i % 40 : 1;
    for (std::size_t k = 0; k < times && positions.size() < count; ++k) positions.push_back(p);
  }
  std::stable_sort(positions.begin(), positions.end(), [](const StoredPosition& a, const StoredPosition& b) { return code_of(a) < code_of(b); });
  return positions;
}

std::vector<std::uint16_t> numbers(std::span<const std::uint16_t> order) { return {order.begin(), order.end()}; }

void expect_permutation(std::vector<std::uint16_t> order, std::size_t count) {
  ASSERT_EQ(order.size(), count);
  std::sort(order.begin(), order.end());
  for (std::size_t i = 0; i < count; ++i) ASSERT_EQ(order[i], i);
}

double mean_area(const std::vector<StoredPosition>& positions, const std::vector<std::uint16_t>& order) {
  double sum = 0;
  for (std::size_t first = 0; first < order.size(); first += kBlockSurfels) {
    double edge[3];
    for (std::size_t a = 0; a < 3; ++a) {
      std::uint16_t low = 65535, high = 0;
      for (std::size_t i = first; i < std::min(order.size(), first + kBlockSurfels); ++i) {
        low = std::min(low, positions[order[i]][a]);
        high = std::max(high, positions[order[i]][a]);
      }
      edge[a] = high - low;
    }
    sum += edge[0] * edge[1] + edge[1] * edge[2] + edge[2] * edge[0];
  }
  return sum;
}

/// As stores have them: what pads the last block repeats the last position.
std::vector<SurfelBlock> blocks_of(const std::vector<StoredPosition>& positions, const std::vector<std::uint16_t>& order) {
  std::vector<SurfelBlock> blocks((order.size() + 15) / 16);
  for (std::size_t slot = 0; slot < 16 * blocks.size(); ++slot) {
    SurfelBlock& b = blocks[slot / 16];
    const StoredPosition& p = positions[order[std::min(slot, order.size() - 1)]];
    b.x[slot % 16] = p[0];
    b.y[slot % 16] = p[1];
    b.z[slot % 16] = p[2];
  }
  return blocks;
}

TEST(SurfelOrder, ALineIsCutIntoBlocksOfSixteen) {
  std::vector<StoredPosition> line;
  for (std::uint16_t i = 0; i < 40; ++i) line.push_back({static_cast<std::uint16_t>(100 * i), 7, 7});
  const auto order = numbers(PatchOrder().of(line));
  for (std::size_t i = 0; i < 40; ++i) EXPECT_EQ(order[i], i) << "cut along the line, each block in Morton order";
}

TEST(SurfelOrder, BlocksAreHalvesOfHalvesAcrossTheLongestAxis) {
  std::vector<StoredPosition> grid;   // 4 x 8 in the plane: two squares
  for (std::uint16_t y = 0; y < 8; ++y)
    for (std::uint16_t x = 0; x < 4; ++x) grid.push_back({static_cast<std::uint16_t>(1000 * x), static_cast<std::uint16_t>(1000 * y), 0});
  std::stable_sort(grid.begin(), grid.end(), [](const StoredPosition& a, const StoredPosition& b) { return code_of(a) < code_of(b); });
  const auto order = numbers(PatchOrder().of(grid));
  for (std::size_t i = 0; i < 32; ++i) EXPECT_EQ(grid[order[i]][1] >= 4000, i >= 16);
}

TEST(SurfelOrder, EachPositionHasOneSlotAndBlocksAreSmall) {
  PatchOrder patches;
  for (const std::size_t count : {0u, 1u, 16u, 17u, 1000u, 65536u}) {
    const auto positions = sheet(count);
    const auto order = numbers(patches.of(positions));
    expect_permutation(order, count);
    EXPECT_EQ(order, numbers(PatchOrder().of(positions))) << "what was done before does not matter";
    if (count < 1000) continue;
    std::vector<std::uint16_t> morton(count);
    for (std::size_t i = 0; i < count; ++i) morton[i] = static_cast<std::uint16_t>(i);
    EXPECT_LT(mean_area(positions, order), 0.5 * mean_area(positions, morton));
  }
}

TEST(SurfelOrder, PositionsOnOneSpotFollowEachOther) {
  for (const std::size_t twice : {1u, 2u, 7u, 50u}) {
    const auto positions = sheet(20000, twice);
    const auto order = numbers(PatchOrder().of(positions));
    expect_permutation(order, positions.size());
    std::vector<std::size_t> slot_of(order.size());
    for (std::size_t slot = 0; slot < order.size(); ++slot) slot_of[order[slot]] = slot;
    for (std::size_t i = 1; i < positions.size(); ++i)
      if (positions[i] == positions[i - 1]) ASSERT_EQ(slot_of[i], slot_of[i - 1] + 1) << "position " << i;
  }
  expect_permutation(numbers(PatchOrder().of(std::vector<StoredPosition>(70, {5, 6, 7}))), 70);
}

TEST(SurfelOrder, MortonOrderIsFoundAgain) {
  MortonOrder morton;
  for (const std::size_t count : {1u, 100u, 30000u}) {
    const auto positions = sheet(count, 5);
    const auto order = numbers(PatchOrder().of(positions));
    const auto slots = morton.of(blocks_of(positions, order), static_cast<std::uint32_t>(count));
    ASSERT_EQ(slots.size(), count);
    for (std::size_t i = 0; i < count; ++i) ASSERT_EQ(order[slots[i]], i);
  }
}

TEST(SurfelOrder, PairsThatShareTheirUpperBitsAreTold) {
  MortonOrder morton;
  for (std::uint64_t i = 0; i < 4000; ++i) {
    std::vector<StoredPosition> pair(2);
    for (std::size_t k = 0; k < 2; ++k)
      for (std::uint32_t a = 0; a < 3; ++a) {
        const int bits = static_cast<int>(17 * uniform(i, a, 3));
        pair[k][a] = static_cast<std::uint16_t>(0xa5a5 ^ static_cast<int>(std::ldexp(uniform(2 * i + k, a, 4), bits)));
      }
    const auto slots = morton.of(blocks_of(pair, {0, 1}), 2);
    ASSERT_EQ(slots[0], code_of(pair[1]) < code_of(pair[0])) << i;
    ASSERT_EQ(slots[1], 1 - slots[0]);
  }
}

}  // namespace
}  // namespace chiaro::stream
