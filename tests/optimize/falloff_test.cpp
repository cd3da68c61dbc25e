#include "optimize/falloff.h"

#include <gtest/gtest.h>

#include <cmath>

namespace chiaro::optimize {
namespace {

stream::Lens pinhole() {
  stream::Lens lens;
  lens.width_px = 600;
  lens.height_px = 400;
  lens.fx = lens.fy = 500;
  lens.cx = 300;
  lens.cy = 200;
  return lens;
}

TEST(OffAxis, IsOneInTheFarthestCorner) {
  const double tangent = std::hypot(300, 200) / 500;
  EXPECT_NEAR(corner_sine(pinhole()), tangent / std::sqrt(1 + tangent * tangent), 1e-12);
  EXPECT_NEAR(off_axis(Vec3d(-300, 200, 500), corner_sine(pinhole())).norm(), 1, 1e-12);
  const Vec2d half = off_axis(Vec3d(-30, 20, 500), corner_sine(pinhole()));
  EXPECT_NEAR(half.x() / half.y(), -1.5, 1e-12);
  stream::Lens shifted = pinhole();
  shifted.cx = 200;
  EXPECT_GT(corner_sine(shifted), corner_sine(pinhole()));
}

TEST(OffAxis, NothingIsFartherOutThanATenthBeyondTheCorner) {
  const double sine = corner_sine(pinhole());
  EXPECT_NEAR(off_axis(Vec3d(900, 0, 1), sine).x(), 1.1, 1e-12);
  EXPECT_NEAR(off_axis(Vec3d(0.1, 0, -1), sine).x(), 1.1, 1e-12) << "behind";
  EXPECT_NEAR(off_axis(Vec3d(0, 0, -1), sine).norm(), 1.1, 1e-12);
  EXPECT_EQ(off_axis(Vec3d(0, 0, 1), sine).norm(), 0);
  EXPECT_EQ(off_axis(Vec3d(0, 0, 0), sine).norm(), 0);
}

TEST(Falloff, OfALensIsThatOfThePictureAlone) {
  Falloff f;
  f.lens = {-0.2, -0.1};
  EXPECT_NEAR(lens_factor(f, {0.6, 0.8}), std::exp(-0.3), 1e-12);
  EXPECT_NEAR(lens_factor(f, {0.5, 0}), std::exp(-0.2 * 0.25 - 0.1 * 0.0625), 1e-12);
  EXPECT_EQ(flash_pattern(f, {0.6, 0.8}), 1);
}

TEST(Falloff, OfAFlashMayLeanToASide) {
  Falloff f;
  f.flash = {0.05, -0.02, -0.3, 0.1};
  EXPECT_NEAR(flash_pattern(f, {1, 0}), std::exp(0.05 - 0.2), 1e-12);
  EXPECT_NEAR(flash_pattern(f, {0, -0.5}), std::exp(0.01 - 0.3 * 0.25 + 0.1 * 0.0625), 1e-12);
  EXPECT_EQ(lens_factor(f, {1, 0}), 1);
  f.flash[2] = -9;
  EXPECT_GT(flash_pattern(f, {1, 0}), 0.1) << "never nothing";
}

TEST(Falloff, InTheCornersIsWhatIsLeftThere) {
  Falloff f;
  EXPECT_EQ(kept_in_corners(f), 1);
  f.lens = {-0.2, -0.1};
  EXPECT_NEAR(kept_in_corners(f), std::exp(-0.3), 1e-12);
  f = {};
  f.flash = {0.3, 0.2, -0.4, 0.1};
  EXPECT_NEAR(kept_in_corners(f), std::exp(-0.3), 1e-12);
}

TEST(Falloff, ItsVarianceIsThatOfTheOneThatIsThere) {
  Falloff f;
  f.lens = {-0.2, 0};
  f.covariance(0, 0) = 4e-4;
  f.covariance(2, 2) = 1;
  EXPECT_NEAR(falloff_variance(f, {1, 0}, {0, 1}), 4e-4, 1e-15);
  EXPECT_NEAR(falloff_variance(f, {0.5, 0}, {0, 1}), 4e-4 / 16, 1e-15);
  f.lens.setZero();
  f.flash[2] = -0.2;
  EXPECT_NEAR(falloff_variance(f, {1, 0}, {0, 0.5}), 1.0 / 16, 1e-15);
}

}  // namespace
}  // namespace chiaro::optimize
