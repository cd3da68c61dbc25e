#include "blend/bands.h"

#include <gtest/gtest.h>

#include <cmath>
#include <set>

#include "blend/view_weights.h"
#include "stream/base/parallel.h"
#include "stream/base/rng.h"

namespace chiaro::blend {
namespace {

/// A plane seen from the front, one pixel 0.01 wide, with the albedo of `paint`.
template <class Paint>
std::vector<SurfacePixel> flat_image(int width, int rows, const Paint& paint, int first_row = 0) {
  std::vector<SurfacePixel> pixels(static_cast<std::size_t>(width * rows));
  for (int y = 0; y < rows; ++y)
    for (int x = 0; x < width; ++x)
      pixels[static_cast<std::size_t>(y * width + x)] = {Vec3f(0.01f * static_cast<float>(x), 0.01f * static_cast<float>(y + first_row), 2), 1, paint(x, y + first_row),
                                                         Vec3f(0, 0, -1), 1};
  return pixels;
}
SurfacePyramid pyramid(const std::vector<SurfacePixel>& pixels, int width, int rows, float radius) {
  SurfacePlanes planes(width, rows);
  for (int y = 0; y < rows; ++y)
    for (int x = 0; x < width; ++x) planes.set(x, y, pixels[static_cast<std::size_t>(y * width + x)]);
  return {std::move(planes), radius};
}
Vec3f noise_at(int x, int y) {
  const auto u = uniform01x4(7, Purpose::kTest, static_cast<std::uint64_t>(y) * 4096 + static_cast<std::uint64_t>(x), 0);
  return {u[0], u[1], u[2]};
}

TEST(Bands, TheMeanOfABallOfTwoPixelsByHand) {
  // radius 2 pixels, weight 1 - (distance / radius)^2: the pixel counts 1, its four neighbours 3/4, the diagonal ones 1/2, together 6
  const SurfacePyramid surface = pyramid(flat_image(16, 16, [](int x, int y) { return Vec3f::Constant(x == 8 && y == 8 ? 1.0f : 0.0f); }), 16, 16, 0.02f);
  EXPECT_NEAR(surface.mean(8, 8, 0.01f).albedo[0], 1 / 6.0f, 1e-4f);
  EXPECT_NEAR(surface.mean(9, 8, 0.01f).albedo[0], 0.75f / 6, 1e-4f);
  EXPECT_NEAR(surface.mean(9, 9, 0.01f).albedo[0], 0.5f / 6, 1e-4f);
  EXPECT_EQ(surface.mean(11, 8, 0.01f).albedo[0], 0);
}

TEST(Bands, AConstantStaysConstantAtAnyRadius) {
  for (const float radius : {0.005f, 0.02f, 0.09f, 0.3f, 0.64f}) {
    const SurfacePyramid surface = pyramid(flat_image(80, 64, [](int, int) { return Vec3f::Constant(0.3f); }), 80, 64, radius);
    for (int y = 0; y < 64; y += 7)
      for (int x = 0; x < 80; x += 3) ASSERT_NEAR(surface.mean(x, y, 0.01f).albedo[1], 0.3f, 1e-6f);
  }
}

TEST(Bands, NothingComesFromSurfacesBeyondTheRadiusOrFromUnusedPixels) {
  auto pixels = flat_image(64, 64, [](int x, int y) { return Vec3f::Constant(x > 30 || y < 10 ? 1.0f : 0.2f); });
  for (int y = 0; y < 64; ++y)
    for (int x = 0; x < 64; ++x) {
      SurfacePixel& p = pixels[static_cast<std::size_t>(y * 64 + x)];
      if (x > 30) p.position.z() += 0.3f;   // another surface, behind
      if (y < 10) p.area = 0;               // masked
    }
  for (const float radius : {0.03f, 0.1f, 0.25f}) {
    const SurfacePyramid surface = pyramid(pixels, 64, 64, radius);
    for (int y = 10; y < 64; ++y)
      for (int x = 0; x <= 30; ++x) ASSERT_NEAR(surface.mean(x, y, 0.01f).albedo[0], 0.2f, 1e-6f) << radius;
    EXPECT_FALSE(surface.mean(5, 5, 0.01f).valid);
  }
}

TEST(Bands, APhotographFromAnotherDistanceAndAngleHasTheSameLowBand) {
  const auto paint = [](const Vec3f& p) { return static_cast<float>(0.5 + 0.3 * std::sin(25 * p.x()) * std::cos(31 * p.y())); };
  const auto image = [&](float step_x, float step_y, int n) {   // foreshortened in x: a pixel covers more surface along it
    std::vector<SurfacePixel> pixels(static_cast<std::size_t>(n * n));
    for (int y = 0; y < n; ++y)
      for (int x = 0; x < n; ++x) {
        const Vec3f at(step_x * static_cast<float>(x - n / 2), step_y * static_cast<float>(y - n / 2), 2);
        pixels[static_cast<std::size_t>(y * n + x)] = {at, step_x * step_y, Vec3f::Constant(paint(at)), Vec3f(0, 0, -1), step_y / step_x};
      }
    return pixels;
  };
  const float radius = 0.12f;
  const SurfacePyramid near = pyramid(image(0.005f, 0.005f, 96), 96, 96, radius), slanted = pyramid(image(0.02f, 0.01f, 96), 96, 96, radius);
  for (int k = -4; k <= 4; ++k) {
    const float a = near.mean(48 + 4 * k, 48 + 2 * k, 0.005f).albedo[0], b = slanted.mean(48 + k, 48 + k, 0.01f).albedo[0];
    EXPECT_NEAR(a, b, 0.01f);
  }
}

TEST(Bands, ARowsBitsDoNotDependOnWhereTheWindowBeginsOrOnThreads) {
  constexpr int kWidth = 70, kRows = 160, kFirst = 64, kLast = 96;
  for (const float radius : {0.05f, 0.13f, 0.2f}) {
    const int reach = (reach_rows(radius, 0.01f) + kPyramidRows - 1) / kPyramidRows * kPyramidRows;
    ASSERT_GE(kFirst, reach);
    const SurfacePyramid whole = pyramid(flat_image(kWidth, kRows, noise_at), kWidth, kRows, radius);
    const ThreadLimit one(1);
    const int part_rows = kLast - kFirst + 2 * reach;
    const SurfacePyramid part = pyramid(flat_image(kWidth, part_rows, noise_at, kFirst - reach), kWidth, part_rows, radius);
    for (int y = kFirst; y < kLast; ++y)
      for (int x = 0; x < kWidth; ++x)
        for (int c = 0; c < 3; ++c) ASSERT_EQ(whole.mean(x, y, 0.01f).albedo[c], part.mean(x, y - kFirst + reach, 0.01f).albedo[c]) << x << " " << y;
  }
}

TEST(Bands, TheOtherSideOfACreaseDoesNotChangeTheAngle) {
  auto pixels = flat_image(64, 16, [](int, int) { return Vec3f::Constant(0.5f); });
  for (int y = 0; y < 16; ++y)
    for (int x = 32; x < 64; ++x) {
      SurfacePixel& p = pixels[static_cast<std::size_t>(y * 64 + x)];
      p.normal = Vec3f(1, 0, 0);
      p.cosv = 0.2f;
    }
  const SurfacePyramid surface = pyramid(pixels, 64, 16, 0.1f);
  EXPECT_NEAR(surface.mean(31, 8, 0.01f).cosv, 1, 1e-2f);
  EXPECT_NEAR(surface.mean(33, 8, 0.01f).cosv, 0.2f, 1e-2f);
}

TEST(Bands, NoiseOfTheAngleIsAveraged) {
  auto pixels = flat_image(64, 32, [](int, int) { return Vec3f::Constant(0.5f); });
  for (std::size_t i = 0; i < pixels.size(); ++i) pixels[i].cosv = (i + i / 64) % 2 == 0 ? 0.4f : 0.8f;
  EXPECT_NEAR(pyramid(pixels, 64, 32, 0.1f).mean(32, 16, 0.01f).cosv, 0.6f, 1e-2f);
}

TEST(Bands, WhatIsMarkedAtABorderIsNearToItsNeighbours) {
  for (const int at : {0, 6}) {
    std::vector<std::uint8_t> marked(7 * 7);
    marked[static_cast<std::size_t>(7 * at + at)] = 1;
    EXPECT_EQ(distance_to_marked(marked, 7, 7, 20)[7 * 3 + 3], std::hypot(3.0f, 3.0f)) << at;
  }
}

TEST(Bands, DistancesAgreeWithThePlainSearch) {
  constexpr int kWidth = 37, kRows = 29;
  constexpr float kCap = 9;
  std::vector<std::uint8_t> marked(kWidth * kRows);
  for (const float share : {0.0f, 0.002f, 0.01f, 0.2f}) {
    for (std::size_t i = 0; i < marked.size(); ++i) marked[i] = uniform01(11, Purpose::kTest, i, 0) < share;
    const auto distance = distance_to_marked(marked, kWidth, kRows, kCap);
    for (int y = 0; y < kRows; ++y)
      for (int x = 0; x < kWidth; ++x) {
        float best = kCap;
        for (int v = 0; v < kRows; ++v)
          for (int u = 0; u < kWidth; ++u)
            if (marked[static_cast<std::size_t>(v * kWidth + u)]) best = std::min(best, std::hypot(static_cast<float>(u - x), static_cast<float>(v - y)));
        ASSERT_NEAR(distance[static_cast<std::size_t>(y * kWidth + x)], best, 1e-4f) << share;
      }
  }
}

TEST(ViewWeights, RampsStartAtZeroAndEndAtOneWithoutAStep) {
  EXPECT_EQ(smooth_ramp(0, 24), 0);
  EXPECT_EQ(smooth_ramp(24, 24), 1);
  EXPECT_EQ(smooth_ramp(64, 24), 1);
  EXPECT_EQ(smooth_ramp(std::nanf(""), 24), 0);
  for (int i = 0; i < 240; ++i) {
    const float a = smooth_ramp(static_cast<float>(i) / 10, 24), b = smooth_ramp(static_cast<float>(i + 1) / 10, 24);
    EXPECT_GE(b, a);
    EXPECT_LT(b - a, 0.01f);
  }
}

TEST(ViewWeights, EachCriterionByHand) {
  EXPECT_FLOAT_EQ(smooth_ramp(1, 4), 5.0f / 32);
  EXPECT_FLOAT_EQ(angle_weight(1), 1);
  EXPECT_FLOAT_EQ(angle_weight(0.5f), 0.25f);        // pixels that cover more by the square of the cosine
  EXPECT_FLOAT_EQ(sigma_weight(0.02f), 0.5f);        // 1 / variance, and as much again from other errors
  EXPECT_FLOAT_EQ(sigma_weight(0.06f), 0.1f);
  EXPECT_FLOAT_EQ(incidence_weight(0.1f), 0.5f);
  EXPECT_FLOAT_EQ(incidence_weight(0.3f), 0.1f);
  EXPECT_EQ(edge_weight(1, 12), 0);                  // pixels that mix two surfaces
  EXPECT_FLOAT_EQ(edge_weight(4, 12), 5.0f / 32);
  EXPECT_FLOAT_EQ(mask_weight(3, 12), 5.0f / 32);
  EXPECT_FLOAT_EQ(saturation_ramp_px(12), 3);
  EXPECT_FLOAT_EQ(saturation_ramp_px(4), 2);
}

TEST(ViewWeights, EachCriterionPrefersTheBetterPixelAndSurvivesBadInput) {
  EXPECT_GT(angle_weight(0.9f), angle_weight(0.5f));
  EXPECT_EQ(angle_weight(0.15f), 0);
  EXPECT_FLOAT_EQ(footprint_weight(0.5f, 1), 4);
  EXPECT_EQ(footprint_weight(0, 1), 0);
  EXPECT_EQ(focus_weight(0), 1);
  EXPECT_GT(focus_weight(1), 1.5f * focus_weight(2));
  EXPECT_GT(focus_weight(1e6f), 0);
  EXPECT_GT(sigma_weight(0.01f), sigma_weight(0.1f));
  EXPECT_EQ(sigma_weight(0), 1);
  EXPECT_EQ(sigma_weight(std::nanf("")), sigma_weight(1));
  EXPECT_GT(incidence_weight(0.01f), incidence_weight(0.3f));
  EXPECT_EQ(coverage_weight(0.5f), 0);
  EXPECT_EQ(coverage_weight(1), 1);
}

TEST(ViewWeights, TheProductHoldsEachCriterionOnce) {
  const WeightScale scale{.footprint = 0.5f, .border_px = 12};
  const PixelEvidence pixel{.footprint = 0.4f, .blur_px = 0.8f, .sigma = 0.03f, .spread = 0.05f, .coverage = 0.97f, .cosv = 0.6f, .edge_px = 7, .mask_px = 5, .saturated_px = 2};
  float product = 1;
  std::set<std::string_view> names;
  for (const Criterion& c : kCriteria) {
    const float worth = c.worth(pixel, scale);
    EXPECT_TRUE(worth > 0 && (c.is_ratio || worth < 1)) << c.name;   // each has something to say here
    product *= worth;
    names.insert(c.name);
  }
  EXPECT_EQ(names.size(), kCriteria.size());
  EXPECT_FLOAT_EQ(pixel_quality(pixel, scale) * surroundings_quality(pixel, scale), product);
}

}  // namespace
}  // namespace chiaro::blend
