#include "blend/leaf_file.h"

#include <gtest/gtest.h>

#include "blend/accumulate.h"
#include "stream/base/error.h"
#include "stream/base/file.h"

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
  LeafFile open(const std::string& key = "key") { return LeafFile(path, key, {{100, 7, 2000}, 5, 5, sizeof(Accumulator)}); }
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

TEST_F(LeafFileTest, RubbishIsReplaced) {
  write_text(path, "not a blend at all");
  EXPECT_EQ(open().photographs_done(), 0u);
}

}  // namespace
}  // namespace chiaro::blend
