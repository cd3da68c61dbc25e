#include "tools/camera_frame.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <vector>

namespace chiaro::tools {
namespace {

using testing::HasSubstr;

const Box3d kCloud{{-1, -1, 0}, {1, 1, 2}};

TEST(CameraFrame, ACameraAThousandTimesTooFarIsNamed) {
  const auto words = far_camera({0, -3200, 1}, kCloud, "m");
  ASSERT_TRUE(words);
  EXPECT_THAT(*words, HasSubstr("stands 3 199 m from it"));
  EXPECT_THAT(*words, HasSubstr("3.46 m across"));
}

TEST(CameraFrame, ACameraThatOnlyLooksAwayIsNot) {
  EXPECT_FALSE(far_camera({0, -3.2, 1}, kCloud, "m"));
  EXPECT_FALSE(far_camera({0, 0, 1}, kCloud, "m"));
}

TEST(CameraFrame, CamerasInOneSpotInsideAreNamed) {
  const std::vector<Vec3d> ring{{0.003, 0, 0.001}, {0, 0.003, 0.001}, {-0.003, 0, 0.001}};
  const auto note = cameras_in_one_spot(ring, kCloud, "m");
  ASSERT_TRUE(note);
  EXPECT_THAT(*note, HasSubstr("all 3 cameras stand within 0.00671 m of each other"));
}

TEST(CameraFrame, CamerasApartOutsideOrAloneAreNot) {
  const std::vector<Vec3d> apart{{0.3, 0, 1}, {0, 0.3, 1}, {-0.3, 0, 1}}, outside{{3, 0, 1}, {3, 0.001, 1}, {3, 0, 1.001}}, two{{0, 0, 1}, {0, 0.001, 1}};
  EXPECT_FALSE(cameras_in_one_spot(apart, kCloud, "m"));
  EXPECT_FALSE(cameras_in_one_spot(outside, kCloud, "m"));
  EXPECT_FALSE(cameras_in_one_spot(two, kCloud, "m"));
}

}  // namespace
}  // namespace chiaro::tools
