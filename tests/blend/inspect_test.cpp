#include "blend/inspect.h"

#include <gtest/gtest.h>

#include <cmath>
#include <functional>

#include "stream/base/rng.h"

namespace chiaro::blend {
namespace {

constexpr int kWidth = 120, kHeight = 90;

/// Band-limited detail on the surface, in pixels.
float detail(double x, double y) {
  double sum = 0;
  for (std::uint64_t i = 0; i < 24; ++i) {
    const auto u = uniform01x4(21, Purpose::kTest, i, 0);
    sum += 0.04 * std::sin((0.3 + static_cast<double>(u[0])) * x + (static_cast<double>(u[1]) * 2 - 1) * y + 6.28 * static_cast<double>(u[2]));
  }
  return static_cast<float>(sum);
}

/// A photograph that shows the surface (dx, dy) pixels beside where it is.
PhotoWindow window_of(double dx, double dy) {
  PhotoWindow window{kWidth, 0, kHeight, std::vector<WindowPixel>(kWidth * kHeight), 0, {}};
  for (int y = 0; y < kHeight; ++y)
    for (int x = 0; x < kWidth; ++x) {
      WindowPixel& p = window.pixels[static_cast<std::size_t>(y * kWidth + x)];
      p.weight = 1;
      p.low = Vec3f::Constant(0.5f);
      p.high = Vec3f::Constant(0.5f * detail(x + 0.5 - dx, y + 0.5 - dy));
    }
  return window;
}

/// Three others agree on each point; photograph 0 reads `value` there.
InspectionCounts inspected(const PhotoWindow& window, const std::function<float(const Vec2d&)>& value, double others_dx = 0) {
  InspectionCounts counts(kWidth, kHeight);
  const std::vector<Vec3f> no_gains(4, Vec3f::Zero());
  for (std::uint64_t i = 0; i < 4000; ++i) {
    const auto u = uniform01x4(22, Purpose::kTest, i, 0);
    const Vec2d pixel(static_cast<double>(u[0]) * kWidth, static_cast<double>(u[1]) * kHeight);
    Ballot ballot;
    for (std::uint16_t k = 0; k < 4; ++k)
      cast_vote(ballot, k, {1, 0.01f, 0, Vec3f::Constant(0.5f), Vec3f::Constant(0.5f * detail(pixel.x() - (k == 3 ? others_dx : 0), pixel.y()))}, 0.5f);
    const auto majority = majority_of(ballot, no_gains, 0.05f);
    inspect_reading(ballot, *majority, 0, log_value(Vec3f::Constant(value(pixel)), 0.5f), 0.05f, pixel, window, counts);
  }
  return counts;
}
float agrees(const Vec2d&) { return 0.5f; }

TEST(Inspect, FindsShiftsToAFractionOfAPixel) {
  for (const Vec2f& shift : {Vec2f(0, 0), Vec2f(2, 0), Vec2f(-1.5f, 0.75f), Vec2f(0.3f, -2.6f)}) {
    const Inspection i = conclude(inspected(window_of(static_cast<double>(shift.x()), static_cast<double>(shift.y())), agrees));
    ASSERT_TRUE(i.shift_px);
    EXPECT_NEAR((*i.shift_px - shift).norm(), 0, 0.1f) << shift.transpose();
    EXPECT_LT(i.shift_spread_px, 0.15f);
    EXPECT_GT(i.correlation, 0.9f);
    EXPECT_FALSE(i.disturbed);
  }
}

TEST(Inspect, OneShiftedPhotographAmongTheOthersIsNotTakenForTheTruth) {
  const Inspection i = conclude(inspected(window_of(0, 0), agrees, 3));
  ASSERT_TRUE(i.shift_px);
  EXPECT_LT(i.shift_px->norm(), 0.3f);
}

/// Three photographs overlap on a strip, elsewhere there is one other: what the strip says holds for the picture only where it is a good part of it.
TEST(Inspect, ANarrowStripDoesNotMoveThePicture) {
  const PhotoWindow window = window_of(2, 1);
  const std::vector<Vec3f> no_gains(4, Vec3f::Zero());
  for (const double share : {0.06, 0.3}) {
    InspectionCounts counts(kWidth, kHeight);
    for (std::uint64_t i = 0; i < 8000; ++i) {
      const auto u = uniform01x4(22, Purpose::kTest, i, 0);
      const Vec2d pixel(static_cast<double>(u[0]) * kWidth, static_cast<double>(u[1]) * kHeight);
      const bool strip = pixel.x() < share * kWidth && (share > 0.1 || pixel.y() < kHeight / 2.0);
      Ballot ballot;
      for (std::uint16_t k = 0; k < (strip ? 4 : 2); ++k) cast_vote(ballot, k, {1, 0.01f, 0, Vec3f::Constant(0.5f), Vec3f::Constant(0.5f * detail(pixel.x(), pixel.y()))}, 0.5f);
      const auto majority = majority_of(ballot, no_gains, 0.05f);
      ASSERT_TRUE(majority);
      inspect_reading(ballot, *majority, 0, log_value(Vec3f::Constant(0.5f), 0.5f), 0.05f, pixel, window, counts);
    }
    const Inspection found = conclude(counts);
    EXPECT_EQ(found.shift_px.has_value(), share > 0.1) << share;
    if (found.shift_px) EXPECT_NEAR((*found.shift_px - Vec2f(2, 1)).norm(), 0, 0.15f);
  }
}

TEST(Inspect, SurfacesWithoutDetailHaveNoShift) {
  PhotoWindow flat = window_of(0, 0);
  for (WindowPixel& p : flat.pixels) p.high.setZero();
  EXPECT_FALSE(conclude(inspected(flat, agrees)).shift_px);
  EXPECT_FALSE(conclude(InspectionCounts(kWidth, kHeight)).shift_px);
}

/// Colours that change over a hundred pixels, and what two photographs do not have in common changes as slowly.
TEST(Inspect, APeakThatIsFlatIsNoShift) {
  const auto smooth = [](double x, double y) { return static_cast<float>(0.1 * std::sin(0.05 * x + 0.02 * y) + 0.1 * std::cos(0.06 * y)); };
  PhotoWindow window = window_of(0, 0);
  for (int y = 0; y < kHeight; ++y)
    for (int x = 0; x < kWidth; ++x)
      window.pixels[static_cast<std::size_t>(y * kWidth + x)].high = Vec3f::Constant(0.5f * (smooth(x + 0.5, y + 0.5) + 0.08f * static_cast<float>(std::sin(0.09 * x + 0.5) * std::cos(0.11 * y))));
  InspectionCounts counts(kWidth, kHeight);
  const std::vector<Vec3f> no_gains(4, Vec3f::Zero());
  for (std::uint64_t i = 0; i < 4000; ++i) {
    const auto u = uniform01x4(22, Purpose::kTest, i, 0);
    const Vec2d pixel(static_cast<double>(u[0]) * kWidth, static_cast<double>(u[1]) * kHeight);
    Ballot ballot;
    for (std::uint16_t k = 0; k < 4; ++k) cast_vote(ballot, k, {1, 0.01f, 0, Vec3f::Constant(0.5f), Vec3f::Constant(0.5f * smooth(pixel.x(), pixel.y()))}, 0.5f);
    inspect_reading(ballot, *majority_of(ballot, no_gains, 0.05f), 0, log_value(Vec3f::Constant(0.5f), 0.5f), 0.05f, pixel, window, counts);
  }
  const Inspection i = conclude(counts);
  EXPECT_GT(i.correlation, 0.8f);
  EXPECT_GT(i.shift_sd_px, 0.2f);
  EXPECT_FALSE(i.shift_px);
  EXPECT_LT(conclude(inspected(window_of(2, 0), agrees)).shift_sd_px, 0.05f);
}

/// Smooth paint on a part of the picture, and errors of light as strong and nearly as smooth: somewhere beside the place the two fit together better than at it.
TEST(Inspect, AFewPiecesOfSmoothPaintDoNotMoveThePicture) {
  const auto waves = [](std::uint64_t seed, double x, double y) {
    double sum = 0;
    for (std::uint64_t i = 0; i < 12; ++i) {
      const auto u = uniform01x4(seed, Purpose::kTest, i, 0);
      const double turn = 6.28 * static_cast<double>(u[0]), wave = 0.3 + 0.3 * static_cast<double>(u[1]);
      sum += 0.03 * std::sin(wave * (std::cos(turn) * x + std::sin(turn) * y) + 6.28 * static_cast<double>(u[2]));
    }
    return static_cast<float>(sum);
  };
  const std::vector<Vec3f> no_gains(4, Vec3f::Zero());
  int peaks = 0;
  for (std::uint64_t seed = 124; seed < 136; ++seed) {
    PhotoWindow window = window_of(0, 0);
    for (int y = 0; y < kHeight; ++y)
      for (int x = 0; x < kWidth; ++x)
        window.pixels[static_cast<std::size_t>(y * kWidth + x)].high = Vec3f::Constant(0.5f * (waves(seed, x + 0.5, y + 0.5) + 1.7f * waves(seed + 1000, x + 0.5, y + 0.5)));
    InspectionCounts counts(kWidth, kHeight);
    for (std::uint64_t i = 0; i < 1500; ++i) {
      const auto u = uniform01x4(23, Purpose::kTest, i, 0);
      const Vec2d pixel(static_cast<double>(u[0]) * 48 + 20, static_cast<double>(u[1]) * 36 + 20);
      Ballot ballot;
      for (std::uint16_t k = 0; k < 4; ++k) cast_vote(ballot, k, {1, 0.01f, 0, Vec3f::Constant(0.5f), Vec3f::Constant(0.5f * waves(seed, pixel.x(), pixel.y()))}, 0.5f);
      inspect_reading(ballot, *majority_of(ballot, no_gains, 0.05f), 0, log_value(Vec3f::Constant(0.5f), 0.5f), 0.05f, pixel, window, counts);
    }
    const Inspection found = conclude(counts);
    peaks += found.correlation > 0;
    if (found.shift_px) EXPECT_LT(found.shift_px->norm(), 0.5f) << "seed " << seed << ", " << found.shift_px->transpose() << ", sd " << found.shift_sd_px;
  }
  EXPECT_GE(peaks, 6) << "there is something in common";
}

TEST(Inspect, NamesThePartThatShowsSomethingElse) {
  const auto disc = [](const Vec2d& p) { return (p - Vec2d(80, 30)).norm() < 18 ? 0.1f : 0.5f; };
  const Inspection i = conclude(inspected(window_of(0, 0), disc));
  ASSERT_TRUE(i.disturbed);
  EXPECT_NEAR(i.disturbed->x0, 62, 12);
  EXPECT_NEAR(i.disturbed->x1, 98, 12);
  EXPECT_NEAR(i.disturbed->y0, 12, 12);
  EXPECT_NEAR(i.disturbed->y1, 48, 12);
  EXPECT_GT(i.disturbed->outvoted, 250u);
  ASSERT_TRUE(i.shift_px);   // what agrees still says where the photograph lies
  EXPECT_LT(i.shift_px->norm(), 0.1f);
}

/// Edges of shadows and relief: small clusters all over the image, of which one is a little larger than the others.
TEST(Inspect, WhereClustersAreEverywhereTheLargestOneIsChance) {
  InspectionCounts counts(640, 480);
  const auto outvote = [&](int x, int y, int cells_x, int cells_y) {
    for (int v = y; v < y + cells_y; ++v)
      for (int u = x; u < x + cells_x; ++u) counts.outvoted[static_cast<std::size_t>(v * counts.cells_x + u)] = 30;
  };
  std::fill(counts.judged.begin(), counts.judged.end(), 32u);
  for (int k = 0; k < 10; ++k) outvote(2 + 5 * k, 3, 1 + k % 2, 1);
  outvote(10, 20, 3, 2);
  EXPECT_FALSE(conclude(counts).disturbed);
  outvote(10, 20, 4, 4);   // a disc of 40 pixels and more
  const auto disturbed = conclude(counts).disturbed;
  ASSERT_TRUE(disturbed);
  EXPECT_EQ(disturbed->x0, 10 * counts.cell_px);
  EXPECT_EQ(disturbed->y1, 24 * counts.cell_px);
  EXPECT_LT(disturbed->chance, 0.003f);
  InspectionCounts alone(640, 480);   // nothing else in the picture: less is enough
  std::fill(alone.judged.begin(), alone.judged.end(), 32u);
  counts = alone;
  outvote(10, 20, 4, 2);
  EXPECT_TRUE(conclude(counts).disturbed);
}

/// Correlations of 0.95 at (2, 0), less by `drop` times the squared distance.
InspectionCounts with_peak(double drop, std::size_t cells_compared, std::size_t cells_judged) {
  InspectionCounts counts(640, 480);
  std::fill_n(counts.compared.begin(), cells_compared, 1u);
  std::fill_n(counts.judged.begin(), cells_judged, 1u);
  ShiftCounts& s = counts.parts[4];
  s.n = 1000;
  s.rr = 1000000000;
  s.dd.fill(1000000000);
  for (int v = -kSearchPx; v <= kSearchPx; ++v)
    for (int u = -kSearchPx; u <= kSearchPx; ++u)
      s.rd[static_cast<std::size_t>((v + kSearchPx) * kOffsets + u + kSearchPx)] = std::llround(1e9 * std::max(-0.9, 0.95 - drop * ((u - 2) * (u - 2) + v * v)));
  return counts;
}

TEST(Inspect, APeakHasToBeSharpAndOfMoreThanACornerOfThePicture) {
  const Inspection sharp = conclude(with_peak(0.1, 28, 28));
  ASSERT_TRUE(sharp.shift_px);
  EXPECT_NEAR((*sharp.shift_px - Vec2f(2, 0)).norm(), 0, 1e-4);
  EXPECT_NEAR(sharp.shift_sd_px, std::sqrt((1 - 0.95 * 0.95) / (28 * 0.95 * 0.2)), 1e-4);
  EXPECT_FALSE(conclude(with_peak(0.02, 28, 28)).shift_px) << "wider than what is searched, though three deviations are less than the shift";
  EXPECT_FALSE(conclude(with_peak(0.1, 28, 400)).shift_px) << "others show less than a tenth of it";
}

TEST(Inspect, WhatIsDisturbedLiesInThePictureAndIsMoreThanAFewPoints) {
  const auto outvoted = [](std::uint32_t judged, std::uint32_t against) {
    InspectionCounts counts(130, 100);   // cells of 12: the last ones are cut off
    std::fill(counts.judged.begin(), counts.judged.end(), judged);
    for (int v = counts.cells_y - 3; v < counts.cells_y; ++v)
      for (int u = counts.cells_x - 3; u < counts.cells_x; ++u) counts.outvoted[static_cast<std::size_t>(v * counts.cells_x + u)] = against;
    return conclude(counts).disturbed;
  };
  ASSERT_TRUE(outvoted(20, 15));
  EXPECT_EQ(outvoted(20, 15)->x1, 130);
  EXPECT_EQ(outvoted(20, 15)->y1, 100);
  EXPECT_EQ(outvoted(20, 15)->x0, 96);
  EXPECT_EQ(outvoted(20, 15)->outvoted, 135u);
  EXPECT_FALSE(outvoted(20, 10)) << "half of them is not most of them";
  EXPECT_FALSE(outvoted(7, 7)) << "too few are judged in each cell";
  InspectionCounts large(640, 480);
  std::fill(large.judged.begin(), large.judged.end(), 300u);
  for (const int v : {5, 6})
    for (int u = 5; u < 9; ++u) large.outvoted[static_cast<std::size_t>(v * large.cells_x + u)] = 155;
  EXPECT_FALSE(conclude(large).disturbed) << "of 650 000 readings 1240 are a few behind a corner";
}

TEST(Inspect, WhatIsDoneAboutAShift) {
  Inspection i;
  EXPECT_EQ(alignment_for(i).trust, 1);
  i.shift_px = Vec2f(0.2f, 0.1f);
  EXPECT_EQ(alignment_for(i).shift_px, Vec2f(0, 0));
  EXPECT_EQ(alignment_for(i).trust, 1);
  i.shift_px = Vec2f(2, 0);
  EXPECT_EQ(alignment_for(i).shift_px, Vec2f(2, 0));
  EXPECT_EQ(alignment_for(i).trust, 1);
  i.shift_spread_px = 1.5f;   // not a shift of the whole
  EXPECT_EQ(alignment_for(i).shift_px, Vec2f(0, 0));
  EXPECT_LT(alignment_for(i).trust, 0.1f);
  i = {};
  i.shift_px = Vec2f(4, 0);   // or more
  EXPECT_EQ(alignment_for(i).shift_px, Vec2f(0, 0));
  EXPECT_LT(alignment_for(i).trust, 0.05f);
}

}  // namespace
}  // namespace chiaro::blend
