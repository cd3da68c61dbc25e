#include "stream/store/tangent_kernels.h"

#include <gtest/gtest.h>

#include <cmath>
#include <vector>

#include "stream/base/vector_width.h"

namespace chiaro::stream {
namespace {

TangentLines lines_at(const std::vector<std::pair<float, float>>& w) {
  TangentLines lines;
  lines.make_room(w.size());
  for (const auto& [x, y] : w) {
    lines.wx[lines.num] = x;
    lines.wy[lines.num++] = y;
  }
  return lines;
}

std::size_t open_corners(const CellCorners& c) {
  std::size_t n = 0;
  for (std::size_t k = 0; k < c.size; ++k) n += c.squared[k] >= 0;
  return n;
}

TEST(TangentKernels, ALineMayCutOffTwoCorners) {
  for (const VectorWidth width : {VectorWidth::kPlain, VectorWidth::kAvx2, VectorWidth::kAvx512}) {
    limit_vectors(width);
    CellCorners cell;
    start_cell(lines_at({{1, 0}, {0, 1}, {-1, 0}, {0, -1}}), 10, cell);   // a square of half size 1
    ASSERT_EQ(open_corners(cell), 4u);
    std::size_t right = 0;
    while (!(cell.squared[right] >= 0 && cell.x[right] > 0)) ++right;
    ASSERT_TRUE(cell.cut(right, 2, 0));   // x <= 1/2
    EXPECT_EQ(open_corners(cell), 4u);
    for (std::size_t k = 0; k < cell.size; ++k) {
      if (cell.squared[k] < 0) continue;
      EXPECT_LE(cell.x[k], 0.5f);
      EXPECT_FLOAT_EQ(std::abs(cell.y[k]), 1);
    }
  }
  limit_vectors(VectorWidth::kAvx512);
}

// On a flat grid of step 1 the cell is a square whose corners are sqrt(1/2) away, whoever finds them.
TEST(TangentKernels, CornersOfAGridAreFoundInRegistersAndInMemory) {
  std::vector<float> x, y, z;
  for (int i = -3; i <= 3; ++i)
    for (int j = -3; j <= 3; ++j) {
      x.push_back(static_cast<float>(i) + 0.01f * static_cast<float>(j));   // no two corners alike
      y.push_back(static_cast<float>(j));
      z.push_back(0);
    }
  const std::size_t num = x.size();
  for (std::vector<float>* v : {&x, &y, &z}) v->resize(num + kLanes, 1e30f);
  const CandidateView view{x.data(), y.data(), z.data(), num};
  for (const VectorWidth width : {VectorWidth::kPlain, VectorWidth::kAvx512}) {
    limit_vectors(width);
    SmoothPoint point;
    point.wanted = true;
    point.place = {0, 0, 0};
    point.frame = {{0, 0, 1}, {1, 0, 0}, {0, 1, 0}};
    point.reach = 2.5f;
    point.half = 3;
    point.scale = 1;
    std::vector<TangentLines> lines(1);
    std::vector<CellCorners> corners(1);
    nearest_corners(view, std::span(&point, 1), lines, corners);
    EXPECT_EQ(lines[0].num, 20u);   // within 2.5 steps, without the point
    if (point.distance > 0) EXPECT_NEAR(point.distance, std::sqrt(0.5), 0.02);
    else EXPECT_NEAR(std::sqrt(corners[0].squared[corners[0].farthest()]), std::sqrt(0.5), 0.02);
  }
  limit_vectors(VectorWidth::kAvx512);
}

}  // namespace
}  // namespace chiaro::stream
