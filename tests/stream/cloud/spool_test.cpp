#include "stream/cloud/spool.h"

#include <gtest/gtest.h>

#include "cloud_test_support.h"

namespace chiaro::stream {
namespace {

constexpr auto kFirst = PointSpool::Reading::kFirst, kSecond = PointSpool::Reading::kSecond;

/// A grid of centimetres with colours of 8 or 16 bits and normals; counts the points it decodes.
class SlowReader final : public PointReader {
 public:
  SlowReader(int& decoded, bool off_grid, bool wide_colours) : decoded_(decoded), off_grid_(off_grid), wide_colours_(wide_colours) {
    schema_.has_normal = schema_.has_colour = true;
    schema_.grid = PositionGrid{Vec3d(0.01, 0.01, 0.1), Vec3d(500000, -3, 0)};
    schema_.extras = {{"number", ScalarType::kU8}};
  }
  const PointSchema& schema() const override { return schema_; }
  bool decodes_slowly() const override { return true; }
  bool read(PointBlock& block, std::size_t max_points) override {
    block.clear();
    for (; block.size() < max_points && next_ < 1000; ++next_, ++decoded_) {
      const double x = (next_ * 37) * 0.01 + 500000 + (off_grid_ && next_ == 500 ? 1e-9 : 0);
      block.position.emplace_back(x, -next_ * 0.01 + -3, next_ == 77 ? std::nan("") : next_ * 0.1 + 0);
      block.normal.emplace_back(0.f, 0.6f, static_cast<float>(next_));
      const auto level = static_cast<std::uint16_t>(wide_colours_ ? next_ * 3 : next_ % 256 * 257);
      block.colour.push_back({level, 257, 0});
      block.extras.push_back(std::byte{1});
    }
    return block.size() > 0;
  }

 private:
  PointSchema schema_;
  int& decoded_;
  bool off_grid_, wide_colours_;
  int next_ = 0;
};

PointBlock read_points(PointReader& reader, std::size_t at_once) {
  PointBlock all, block;
  while (reader.read(block, at_once)) {
    all.position.insert(all.position.end(), block.position.begin(), block.position.end());
    all.normal.insert(all.normal.end(), block.normal.begin(), block.normal.end());
    all.colour.insert(all.colour.end(), block.colour.begin(), block.colour.end());
  }
  return all;
}

void expect_same(const PointBlock& a, const PointBlock& b) {
  ASSERT_EQ(a.size(), b.size());
  EXPECT_EQ(std::memcmp(a.position.data(), b.position.data(), a.size() * sizeof(Vec3d)), 0);
  EXPECT_EQ(a.normal, b.normal);
  EXPECT_EQ(a.colour, b.colour);
}

TEST(PointSpool, TheSecondReadingGivesTheSameBitsWithoutDecoding) {
  for (const bool off_grid : {false, true})
    for (const bool wide : {false, true}) {
      const ScratchFolder folder;
      PointSpool spool(folder.path());
      int decoded = 0;
      const auto open = [&] { return std::make_unique<SlowReader>(decoded, off_grid, wide); };
      const PointBlock first = read_points(*spool.open(0, kFirst, open), 64);
      int others = 0;
      SlowReader direct(others, off_grid, wide);
      expect_same(first, read_points(direct, 1000));
      const auto second = spool.open(0, kSecond, open);
      EXPECT_TRUE(second->schema().has_normal);
      expect_same(first, read_points(*second, 50));
      EXPECT_EQ(decoded, 1000);   // once
      expect_same(first, read_points(*spool.open(0, kSecond, open), 70));  // the kept points are spent
      EXPECT_EQ(decoded, 2000);
      EXPECT_TRUE(fs::is_empty(folder.path()));
    }
}

TEST(PointSpool, AReadingThatStoppedEarlyIsNotTaken) {
  const ScratchFolder folder;
  PointSpool spool(folder.path());
  int decoded = 0;
  const auto open = [&] { return std::make_unique<SlowReader>(decoded, false, false); };
  PointBlock block;
  spool.open(0, kFirst, open)->read(block, 10);
  EXPECT_EQ(read_points(*spool.open(0, kSecond, open), 100).size(), 1000u);
  EXPECT_EQ(read_points(*spool.open(0, kFirst, open), 100).size(), 1000u);
  spool.drop();
  EXPECT_EQ(read_points(*spool.open(0, kSecond, open), 100).size(), 1000u);
  EXPECT_EQ(decoded, 3010);
}

TEST(PointSpool, WithoutAFolderTheSourceIsReadAgain) {
  PointSpool spool("/nonexistent/folder");
  int decoded = 0;
  const auto open = [&] { return std::make_unique<SlowReader>(decoded, false, false); };
  for (const auto reading : {kFirst, kSecond}) EXPECT_EQ(read_points(*spool.open(0, reading, open), 100).size(), 1000u);
}

}  // namespace
}  // namespace chiaro::stream
