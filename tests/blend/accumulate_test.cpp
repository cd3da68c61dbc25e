#include "blend/accumulate.h"

#include <gtest/gtest.h>

#include <cmath>

#include "stream/base/error.h"
#include "stream/base/file.h"

namespace chiaro::blend {
namespace {

Sample sample(float weight, float low, float high, float sigma) { return {0, weight, sigma, 0, Vec3f::Constant(low), Vec3f::Constant(high)}; }

TEST(Accumulate, TwoPhotographsByHand) {
  Accumulator sum;
  add_sample(sum, sample(1, 0.4f, 0.1f, 0.02f), 2);
  add_sample(sum, sample(3, 0.6f, -0.1f, 0.04f), 2);
  const BlendedSurfel s = resolve(sum, 0.03f);
  EXPECT_NEAR(s.albedo[0], (0.4f + 3 * 0.6f) / 4 + (0.1f - 9 * 0.1f) / 10, 1e-6f);
  EXPECT_EQ(s.photographs, 2);
  const float low = std::hypot(0.02f, 3 * 0.04f) / 4, high = std::hypot(0.02f, 9 * 0.04f) / 10;
  EXPECT_NEAR(s.sigma, std::hypot(std::max(low, high), 0.03f), 1e-6f);
}

TEST(Accumulate, WhatPhotographsHaveInCommonDoesNotAverageOut) {
  Accumulator sum;
  for (int k = 0; k < 100; ++k) {
    Sample s = sample(1, 0.5f, 0, 0.1f);
    s.shared = 0.04f;
    add_sample(sum, s, 4);
  }
  EXPECT_NEAR(resolve(sum, 0).sigma, std::hypot(0.01f, 0.04f), 1e-5f);
}

TEST(Accumulate, UnseenIsNaN) {
  const BlendedSurfel s = resolve({}, 0.1f);
  EXPECT_TRUE(std::isnan(s.albedo[1]));
  EXPECT_TRUE(std::isnan(s.sigma));
  EXPECT_EQ(s.photographs, 0);
}

TEST(Accumulate, OnePhotographGivesItsAlbedoBackAtAnyWeight) {
  for (const float weight : {1e-12f, 1e-3f, 1.0f, 1e4f}) {
    Accumulator sum;
    add_sample(sum, sample(weight, 0.42f, 0.0137f, 0.05f), 4);
    EXPECT_NEAR(resolve(sum, 0).sigma, 0.05f, 1e-6f) << weight;
    EXPECT_NEAR(resolve(sum, 0).albedo[2], 0.42f + 0.0137f, 1e-6f) << weight;
  }
}

AccumulatorFile::Record record_of(std::uint32_t surfels, std::uint32_t photographs, float value) {
  AccumulatorFile::Record r;
  r.samples_of_photograph.assign(photographs, 3);
  r.surfels.resize(surfels);
  for (Accumulator& a : r.surfels) a.low_weight = value;
  return r;
}

class AccumulatorFileTest : public ::testing::Test {
 protected:
  ScratchFolder folder;
  std::filesystem::path path = folder.path() / "blend.sums";
  AccumulatorFile open(const std::string& key = "key") { return AccumulatorFile(path, key, {100, 7, 2000}, 5); }
};

TEST_F(AccumulatorFileTest, KeepsTheNewestStateOfEachLeaf) {
  {
    auto file = open();
    EXPECT_FALSE(file.is_written(1));
    EXPECT_EQ(file.read(1).surfels.size(), 7u);
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
  EXPECT_EQ(file.read(1).surfels[6].low_weight, 4);
  EXPECT_EQ(file.read(2).surfels[1999].low_weight, 3);
  EXPECT_EQ(file.read(2).samples_of_photograph[4], 3u);
}

TEST_F(AccumulatorFileTest, ATornWriteFallsBackToTheStateBefore) {
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
  EXPECT_EQ(file.read(2).surfels[0].low_weight, 1);
}

TEST_F(AccumulatorFileTest, AnotherKeyStartsAnew) {
  {
    auto file = open();
    file.write(0, {0, 1}, record_of(100, 5, 1));
    file.set_photographs_done(1);
  }
  auto file = open("other");
  EXPECT_EQ(file.photographs_done(), 0u);
  EXPECT_FALSE(file.is_written(0));
}

TEST_F(AccumulatorFileTest, DamageInASyncedStateIsAnErrorAndNotAResult) {
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
  EXPECT_THROW(file.read(2), Error);
}

TEST_F(AccumulatorFileTest, RubbishIsReplaced) {
  write_text(path, "not a blend at all");
  EXPECT_EQ(open().photographs_done(), 0u);
}

}  // namespace
}  // namespace chiaro::blend
