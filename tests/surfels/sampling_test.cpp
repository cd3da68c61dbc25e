#include "surfels/sampling.h"

#include <gtest/gtest.h>

#include "stream/base/file.h"
#include "tests/support/sampled_surface.h"

namespace chiaro::surfels {
namespace {

/// Looks along -z from (0, 0, height), 400 x 300 pixels.
stream::Camera camera_above(double height, double focal_px) {
  stream::Camera c;
  c.lens.width_px = 400;
  c.lens.height_px = 300;
  c.lens.fx = c.lens.fy = focal_px;
  c.lens.cx = 200;
  c.lens.cy = 150;
  c.pose.rotation_camera_from_world << 1, 0, 0, 0, -1, 0, 0, 0, -1;
  c.pose.translation_camera_from_world = -c.pose.rotation_camera_from_world * Vec3d(0, 0, height);
  return c;
}

TEST(Sampling, IsTheSpacingInPixels) {
  const ScratchFolder scratch;
  // 0.01 apart on a square; nearest neighbours of a jittered grid are about that.
  const stream::Store store = tests::build_test_store(tests::square_points(200, 2.0, {0, 0, 0}, {0, 0, 1}, 1), scratch.path(), 1024);
  EXPECT_NEAR(SpacingSamples(store).spacing_px(camera_above(2, 1000)), 1000 * 0.01 / 2, 1);
  EXPECT_NEAR(SpacingSamples(store).spacing_px(camera_above(4, 1000)) / SpacingSamples(store).spacing_px(camera_above(2, 1000)), 0.5, 0.05);
  EXPECT_NEAR(SpacingSamples(store).spacing_px(camera_above(2, 3000)) / SpacingSamples(store).spacing_px(camera_above(2, 1000)), 3, 0.3);
}

TEST(Sampling, IsThatOfTheDenserPart) {
  const ScratchFolder scratch;
  // A fifth of the points lies on a third of the picture, four times as dense a way.
  auto points = tests::square_points(100, 2.0, {0, 0, 0}, {0, 0, 1}, 1);
  const auto dense = tests::square_points(50, 0.25, {0.5, 0, 1e-3}, {0, 0, 1}, 2);
  points.insert(points.end(), dense.begin(), dense.end());
  const stream::Store store = tests::build_test_store(points, scratch.path(), 256);
  EXPECT_LT(SpacingSamples(store).spacing_px(camera_above(2, 300)), 0.5 * 300 * 0.02 / 2);
}

TEST(Sampling, IsNothingWhereNothingIsSeen) {
  const ScratchFolder scratch;
  const stream::Store store = tests::build_test_store(tests::square_points(50, 2.0, {0, 0, 0}, {0, 0, 1}, 1), scratch.path());
  EXPECT_EQ(SpacingSamples(store).spacing_px(camera_above(-1, 1000)), 0) << "behind the camera";
}

TEST(Sampling, CellsAreAQuarterOfTheSpacingInLargePictures) {
  EXPECT_EQ(cell_for(16.5, 8688, 5792), 3) << "50 million pixels: four million cells stay";
  EXPECT_EQ(cell_for(11.9, 8688, 5792), 2);
  EXPECT_EQ(cell_for(7.9, 8688, 5792), 1);
  EXPECT_EQ(cell_for(100, 4000, 3000), 1) << "12 million pixels";
  EXPECT_EQ(cell_for(100, 4000, 4000), 2);
  EXPECT_EQ(cell_for(0, 8688, 5792), 1) << "nothing seen";
  EXPECT_EQ(cell_for(1e9, 1 << 20, 1 << 20), 64);
}

}  // namespace
}  // namespace chiaro::surfels
