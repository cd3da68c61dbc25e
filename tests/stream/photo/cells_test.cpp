#include "stream/photo/cells.h"

#include <gtest/gtest.h>

#include "stream/photo/develop.h"

namespace chiaro::stream {
namespace {

/// A picture with the same value in all channels, but for 10 more in green and 20 more in blue.
struct Picture {
  int width = 0;
  std::vector<float> values;
  std::vector<std::uint8_t> flags;
  int height() const { return static_cast<int>(values.size()) / width; }
};

/// Rows of cells: their red values and flags.
struct Result {
  std::vector<float> red;
  std::vector<int> flags;
};

Result cells_of(const Picture& p, int cell_px) {
  Cells cells(p.width, cell_px);
  Result out;
  for (int y = 0; y < p.height(); ++y) {
    const auto begin = p.values.begin() + y * p.width;
    const std::vector<float> red(begin, begin + p.width);
    std::vector<float> green = red, blue = red;
    for (float& v : green) v += 10;
    for (float& v : blue) v += 20;
    if (!cells.push({red, green, blue}, std::span(p.flags).subspan(static_cast<std::size_t>(y * p.width), static_cast<std::size_t>(p.width)))) continue;
    for (std::size_t i = 0; i < cells.flags().size(); ++i) {
      EXPECT_NEAR(cells.rgb(1)[i] - cells.rgb(0)[i], cells.rgb(0)[i] == 0 ? 0 : 10, 1e-5);
      EXPECT_NEAR(cells.rgb(2)[i] - cells.rgb(0)[i], cells.rgb(0)[i] == 0 ? 0 : 20, 1e-5);
      out.red.push_back(cells.rgb(0)[i]);
      out.flags.push_back(cells.flags()[i]);
    }
  }
  return out;
}

TEST(Cells, AreTheMeansOfTheirPixels) {
  // 5 x 5: two whole cells of 2 x 2 each way; the last column and row belong to none.
  Picture p{5, {}, std::vector<std::uint8_t>(25, kUsableByMask)};
  for (int i = 0; i < 25; ++i) p.values.push_back(static_cast<float>(i + 1));
  const Result r = cells_of(p, 2);
  EXPECT_EQ(r.red, (std::vector<float>{4, 6, 14, 16}));   // (1 + 2 + 6 + 7) / 4, …
  EXPECT_EQ(r.flags, std::vector<int>(4, kUsableByMask));
}

TEST(Cells, CountWhatCanBeUsedWhereThatIsHalf) {
  Picture p{2, {1, 2, 3, 100}, {1, 1, 1, kUsableByMask | kSaturated}};
  EXPECT_EQ(cells_of(p, 2).red, std::vector<float>{2});
  EXPECT_EQ(cells_of(p, 2).flags, std::vector<int>{kUsableByMask});
  p.flags[0] = 0;   // outside the mask
  EXPECT_EQ(cells_of(p, 2).red, std::vector<float>{2.5});
  EXPECT_EQ(cells_of(p, 2).flags, std::vector<int>{kUsableByMask});
}

TEST(Cells, SayWhyTheyCannotBeUsed) {
  Picture p{2, {1, 2, 3, 100}, {1, 1 | kSaturated, 1 | kSaturated, 1 | kSaturated}};
  EXPECT_EQ(cells_of(p, 2).flags, std::vector<int>{kUsableByMask | kSaturated});
  EXPECT_EQ(cells_of(p, 2).red, std::vector<float>{26.5});
  p.flags = {0, 0, 0, 1};
  EXPECT_EQ(cells_of(p, 2).flags, std::vector<int>{0}) << "mostly outside the mask";
  p.flags = {1, 0 | kSaturated, 0 | kNotFinite, 0};
  EXPECT_EQ(cells_of(p, 2).flags, std::vector<int>{kSaturated | kNotFinite});
  EXPECT_FLOAT_EQ(cells_of(p, 2).red[0], 103.0f / 3) << "what is not finite has no value";
  p.flags.assign(4, kUsableByMask | kNotFinite);
  EXPECT_EQ(cells_of(p, 2).red, std::vector<float>{0});
  EXPECT_EQ(cells_of(p, 2).flags, std::vector<int>{kUsableByMask | kNotFinite});
}

}  // namespace
}  // namespace chiaro::stream
