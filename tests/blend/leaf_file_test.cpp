#include "blend/leaf_file.h"

#include <gtest/gtest.h>

#include "blend/accumulate.h"
#include "stream/base/error.h"
#include "stream/base/file.h"
#include "tests/support/sync_watch.h"

namespace chiaro::blend {
namespace {

LeafRecord<Accumulator> record_of(std::uint32_t surfels, std::uint32_t photographs, float value) {
  LeafRecord<Accumulator> r;
  r.counters.assign(photographs, 3);
  r.surfels.resize(surfels);
  for (Accumulator& a : r.surfels) a.low_weight = value;
  return r;
}

class LeafFileTest : public ::testing::Test {
 protected:
  ScratchFolder folder;
  std::filesystem::path path = folder.path() / "blend.sums";
  LeafFile open(const std::string& key = "key") { return LeafFile(path, key, {{100, 7, 2000}, 5, 5, sizeof(Accumulator), 0}); }
};

TEST_F(LeafFileTest, KeepsTheNewestStateOfEachLeaf) {
  {
    auto file = open();
    EXPECT_FALSE(file.is_written(1));
    EXPECT_EQ(file.read<Accumulator>(1).surfels.size(), 7u);
    file.write(1, {0, 40}, record_of(7, 5, 1));
    file.write(1, {0, 80}, record_of(7, 5, 2));
    file.write(2, {0, 80}, record_of(2000, 5, 3));
    file.write(1, {2, 10}, record_of(7, 5, 4));
    file.set_photographs_done(2);
  }
  auto file = open();
  EXPECT_EQ(file.photographs_done(), 2u);
  EXPECT_FALSE(file.is_written(0));
  EXPECT_EQ(file.mark(1), (Mark{2, 10}));
  EXPECT_EQ(file.read<Accumulator>(1).surfels[6].low_weight, 4);
  EXPECT_EQ(file.read<Accumulator>(2).surfels[1999].low_weight, 3);
  EXPECT_EQ(file.read<Accumulator>(2).counters[4], 3u);
}

TEST_F(LeafFileTest, ATornWriteFallsBackToTheStateBefore) {
  std::uint64_t size_before = 0;
  {
    auto file = open();
    file.write(2, {0, 80}, record_of(2000, 5, 1));
    file.set_photographs_done(1);
    size_before = File(path, File::Mode::kRead).size();
    file.write(2, {1, 80}, record_of(2000, 5, 2));
  }
  {
    File file(path, File::Mode::kReadWrite);
    ASSERT_GT(file.size(), size_before);
    const char wrong = 77;
    file.write_at(file.size() - 5000, &wrong, 1);   // inside the second slot's sums
  }
  auto file = open();
  EXPECT_EQ(file.mark(2), (Mark{0, 80}));
  EXPECT_EQ(file.read<Accumulator>(2).surfels[0].low_weight, 1);
}

TEST_F(LeafFileTest, APowerCutLeavesAStateThatIsWhole) {
  // A photograph in bands writes a leaf several times before anything is noted as done; the state of the photographs before it must outlive that.
  const SyncWatch watch(folder.path());
  for (const int writes : {0, 1, 2, 3}) {
    std::filesystem::remove(path);
    {
      auto file = open();
      file.write(2, {0, 80}, record_of(2000, 5, 1));
      file.set_photographs_done(1);
      for (int i = 1; i <= writes; ++i) file.write(2, {1, 20u * static_cast<std::uint32_t>(i)}, record_of(2000, 5, 1 + static_cast<float>(i)));
    }
    watch.cut_power(path);
    auto file = open();
    ASSERT_TRUE(file.is_written(2)) << writes;
    const Mark mark = file.mark(2);
    EXPECT_GE(mark, (Mark{0, 80})) << writes;
    EXPECT_EQ(file.read<Accumulator>(2).surfels[1999].low_weight, mark.photograph == 0 ? 1 : 1 + static_cast<float>(mark.row) / 20) << writes;
  }
}

TEST_F(LeafFileTest, AnotherKeyStartsAnew) {
  {
    auto file = open();
    file.write(0, {0, 1}, record_of(100, 5, 1));
    file.set_photographs_done(1);
  }
  auto file = open("other");
  EXPECT_EQ(file.photographs_done(), 0u);
  EXPECT_FALSE(file.is_written(0));
}

TEST_F(LeafFileTest, DamageInASyncedStateIsAnErrorAndNotAResult) {
  {
    auto file = open();
    file.write(2, {0, 80}, record_of(2000, 5, 1));
    file.set_photographs_done(1);
  }
  {
    File file(path, File::Mode::kReadWrite);
    const char wrong = 77;
    file.write_at(file.size() - 5000, &wrong, 1);
  }
  auto file = open();
  EXPECT_THROW(file.read<Accumulator>(2), Error);
}

TEST_F(LeafFileTest, WhatIsReplacedGoesBackToTheDisk) {
  const LeafShape shape{{2000, 2000}, 5, 5, sizeof(Accumulator), 0};
  const std::uint64_t one = LeafFile::disk_bytes(shape, 0);
  LeafFile file(path, "key", shape);
  for (std::uint32_t k = 0; k < 4; ++k) {
    for (const std::size_t leaf : {0u, 1u}) file.write(leaf, {k, 80}, record_of(2000, 5, static_cast<float>(k)));
    file.set_photographs_done(k + 1);
    EXPECT_LE(allocated_bytes(path), 2 * one + 4 * 4096) << k;   // and the headers
  }
  EXPECT_EQ(file.read<Accumulator>(0).surfels[5].low_weight, 3);
  EXPECT_EQ(LeafFile::spare_bytes(1000), 1000u);
  EXPECT_EQ(LeafFile::spare_bytes(std::uint64_t{8} << 30), std::uint64_t{1} << 30);
}

TEST_F(LeafFileTest, RoomRunsOutBeforeTheStateDoes) {
  // more than the room for second states (64 MiB), written again and again without anything noted as done
  const LeafShape shape{std::vector<std::uint32_t>(20, 65536), 5, 5, sizeof(Accumulator), 0};
  const std::uint64_t one = LeafFile::disk_bytes(shape, 0), all = 20 * one;
  ASSERT_GT(all, LeafFile::spare_bytes(all));
  {
    LeafFile file(path, "key", shape);
    for (std::uint32_t k = 0; k < 3; ++k)
      for (std::size_t leaf = 0; leaf < 20; ++leaf) {
        file.write(leaf, {k, 80}, record_of(65536, 5, static_cast<float>(k)));
        ASSERT_LE(allocated_bytes(path), all + LeafFile::spare_bytes(all) + 4 * 4096);
      }
  }
  const LeafFile file(path, "key", shape);   // as after a kill
  for (std::size_t leaf = 0; leaf < 20; ++leaf) ASSERT_EQ(file.read<Accumulator>(leaf).surfels[65535].low_weight, 2);
}

TEST_F(LeafFileTest, KeepsWhatBelongsToFurtherBands) {
  const LeafShape shape{{3, 4}, 5, 5, sizeof(Accumulator), 2};
  {
    LeafFile file(path, "key", shape);
    auto record = file.read<Accumulator>(1);
    ASSERT_EQ(record.more.size(), 8u);
    record.more[7] = {1, 2, 3, 4};
    file.write(1, {0, 80}, record);
    file.set_photographs_done(1);
  }
  EXPECT_FALSE(LeafFile::existing(path, "key", {{3, 4}, 5, 5, sizeof(Accumulator), 1}));
  EXPECT_EQ(LeafFile(path, "key", shape).read<Accumulator>(1).more[7], (FourFloats{1, 2, 3, 4}));
}

TEST_F(LeafFileTest, RubbishIsReplaced) {
  write_text(path, "not a blend at all");
  EXPECT_EQ(open().photographs_done(), 0u);
}

}  // namespace
}  // namespace chiaro::blend
