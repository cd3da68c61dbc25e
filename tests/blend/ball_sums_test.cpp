/// Means over balls against the same sums taken one block after the other: the same bits, whatever the processor takes at a time.
#include "blend/ball_sums.h"

#include <gtest/gtest.h>

#include <cmath>

#include "blend/bands.h"
#include "stream/base/rng.h"
#include "stream/base/vector_width.h"

namespace chiaro::blend {
namespace {

struct Image {
  int width = 0, rows = 0;
  std::vector<SurfacePixel> pixels;
  const SurfacePixel& at(int x, int y) const { return pixels[static_cast<std::size_t>(y * width + x)]; }
};

/// A wavy surface with a step, holes, and albedo, normals and areas of noise.
Image noisy_image(int width, int rows) {
  Image image{width, rows, std::vector<SurfacePixel>(static_cast<std::size_t>(width * rows))};
  for (int y = 0; y < rows; ++y)
    for (int x = 0; x < width; ++x) {
      const auto i = static_cast<std::uint64_t>(y * width + x);
      const auto u = uniform01x4(3, Purpose::kTest, i, 0), v = uniform01x4(3, Purpose::kTest, i, 1);
      SurfacePixel& p = image.pixels[i];
      if (v[3] < 0.05f || (x > 20 && x < 27 && y > 9)) continue;
      const float depth = 2 + 0.02f * std::sin(0.3f * static_cast<float>(x)) + (x > 2 * y ? 0.08f : 0.0f);
      p = {Vec3f(0.005f * depth * (static_cast<float>(x) + u[3]), 0.005f * depth * static_cast<float>(y), depth), 0.5f + v[0], Vec3f(u[0], u[1], u[2]), Vec3f(v[1] - 0.5f, v[2] - 0.5f, -1).normalized(), 0.3f + 0.7f * v[1]};
    }
  return image;
}

SurfacePixel merged(const std::vector<SurfacePixel>& children, float radius) {
  const SurfacePixel* largest = &children[0];
  for (const SurfacePixel& c : children)
    if (c.area > largest->area) largest = &c;
  SurfacePixel sum;
  if (!(largest->area > 0)) return sum;
  for (const SurfacePixel& c : children) {
    if (!(c.area > 0) || (c.position - largest->position).squaredNorm() > 0.25f * radius * radius) continue;
    sum.area += c.area;
    sum.position += c.area * c.position;
    sum.albedo += c.area * c.albedo;
    sum.normal += c.area * c.normal;
    sum.cosv += c.area * c.cosv;
  }
  const float scale = 1 / sum.area;
  sum.position *= scale;
  sum.albedo *= scale;
  sum.normal *= scale;
  sum.cosv *= scale;
  return sum;
}

Image halved(const Image& fine, float radius) {
  Image coarse{(fine.width + 1) / 2, (fine.rows + 1) / 2, {}};
  for (int y = 0; y < coarse.rows; ++y)
    for (int x = 0; x < coarse.width; ++x) {
      std::vector<SurfacePixel> children;
      for (int v = 2 * y; v < std::min(fine.rows, 2 * y + 2); ++v)
        for (int u = 2 * x; u < std::min(fine.width, 2 * x + 2); ++u) children.push_back(fine.at(u, v));
      coarse.pixels.push_back(merged(children, radius));
    }
  return coarse;
}

/// Blocks in four lanes from the first column on, up to three beyond the last.
SurfaceMean mean_by_hand(const std::vector<Image>& levels, float radius, int x, int y, float footprint) {
  const SurfacePixel& centre = levels[0].at(x, y);
  if (!(centre.area > 0) || !(footprint > 0)) return {};
  const float radius_px = std::min(kMaxLowRadiusPx, radius / footprint), inverse_squared = 1 / (radius_px * footprint * radius_px * footprint);
  int level = 0;
  while (level < 4 && radius_px >= 8 * static_cast<float>(1 << level)) ++level;
  const Image& blocks = levels[static_cast<std::size_t>(level)];
  const int reach = static_cast<int>(std::ceil(radius_px / static_cast<float>(1 << level))) + 1, column = x >> level, row = y >> level, x0 = std::max(0, column - reach);
  std::array<std::array<float, 4>, 6> lanes{};
  for (int v = std::max(0, row - reach); v <= std::min(blocks.rows - 1, row + reach); ++v)
    for (int u = x0; u < std::min(blocks.width, x0 + (std::min(blocks.width - 1, column + reach) - x0 + 4) / 4 * 4); ++u) {
      const SurfacePixel& b = blocks.at(u, v);
      const Vec3f d = b.position - centre.position;
      const float w = std::max(1 - (d.x() * d.x() + d.y() * d.y() + d.z() * d.z()) * inverse_squared, 0.0f) * b.area;
      const float facing = w * std::max(b.normal.x() * centre.normal.x() + b.normal.y() * centre.normal.y() + b.normal.z() * centre.normal.z(), 0.0f);
      const float terms[] = {w, w * b.albedo[0], w * b.albedo[1], w * b.albedo[2], facing, facing * b.cosv};
      for (std::size_t t = 0; t < 6; ++t) lanes[t][static_cast<std::size_t>((u - x0) % 4)] += terms[t];
    }
  std::array<float, 6> sum;
  for (std::size_t t = 0; t < 6; ++t) sum[t] = (lanes[t][0] + lanes[t][2]) + (lanes[t][1] + lanes[t][3]);
  if (!(sum[0] > 0)) return {centre.albedo, centre.cosv, true};
  return {Vec3f(sum[1], sum[2], sum[3]) / sum[0], sum[4] > 0 ? sum[5] / sum[4] : centre.cosv, true};
}

void expect_same(const SurfaceMean& a, const SurfaceMean& b, int x, int y) {
  ASSERT_EQ(a.valid, b.valid) << x << " " << y;
  for (int c = 0; c < 3; ++c) ASSERT_EQ(a.albedo[c], b.albedo[c]) << x << " " << y;
  ASSERT_EQ(a.cosv, b.cosv) << x << " " << y;
}

class BallSums : public ::testing::TestWithParam<VectorWidth> {
 protected:
  void SetUp() override { limit_vectors(GetParam()); }
  void TearDown() override { limit_vectors(VectorWidth::kAvx512); }
  /// All rows at once, and pixels alone. Footprints differ, so that levels and reaches do within a row.
  void compare(int width, int rows, float radius) {
    std::vector<Image> levels{noisy_image(width, rows)};
    SurfacePlanes planes(width, rows);
    for (int y = 0; y < rows; ++y)
      for (int x = 0; x < width; ++x) planes.set(x, y, levels[0].at(x, y));
    while (levels.size() < 5) levels.push_back(halved(levels.back(), radius));
    const SurfacePyramid surface(std::move(planes), radius);
    std::vector<float> footprints(static_cast<std::size_t>(width));
    std::vector<SurfaceMean> means(footprints.size());
    for (int y = 0; y < rows; ++y) {
      for (int x = 0; x < width; ++x) footprints[static_cast<std::size_t>(x)] = x % 13 == 5 ? 0 : 0.01f * (1 + 0.8f * std::sin(0.2f * static_cast<float>(x + y / 8)));
      surface.means(y, footprints, means);
      for (int x = 0; x < width; ++x) {
        const float footprint = footprints[static_cast<std::size_t>(x)];
        const SurfaceMean expected = mean_by_hand(levels, radius, x, y, footprint);
        expect_same(means[static_cast<std::size_t>(x)], expected, x, y);
        expect_same(surface.mean(x, y, footprint), expected, x, y);
      }
    }
  }
};

TEST_P(BallSums, AreThoseOfOneBlockAfterTheOther) {
  for (const float radius : {0.004f, 0.03f, 0.079f, 0.15f, 0.5f, 2.0f}) compare(61, 48, radius);
}

TEST_P(BallSums, ImagesOfAFewPixels) {
  for (const int width : {1, 2, 3, 4, 5, 7, 8, 9}) compare(width, 5, 0.05f);
}

INSTANTIATE_TEST_SUITE_P(Widths, BallSums, ::testing::Values(VectorWidth::kPlain, VectorWidth::kAvx2, VectorWidth::kAvx512));

}  // namespace
}  // namespace chiaro::blend
