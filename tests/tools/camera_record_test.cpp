#include "tools/camera_record.h"

#include <gtest/gtest.h>

#include <filesystem>

#include "stream/base/error.h"
#include "stream/base/file.h"

namespace chiaro::tools {
namespace {

std::vector<PhotographCamera> two_cameras() {
  PhotographCamera a;
  a.acquisition = "day1";
  a.camera.photograph = "photo_00";
  a.camera.lens = {stream::LensKind::kPerspective, 640, 480, 610.25, 611.5, 322.5, 238.25, 0.5, {0.1, -0.02, 0.003, 0, 0, 0, 1e-5}, {1e-4, -2e-4, 0, 0}};
  a.camera.pose.rotation_camera_from_world << 0.8, -0.6, 0, 0.6, 0.8, 0, 0, 0, 1;
  a.camera.pose.translation_camera_from_world = {0.1, 1.0 / 3, -2.5};
  a.flash_in_camera = Vec3d(0.13, -0.16, 0.03);
  a.camera.focus = {0.0125, 2};
  PhotographCamera b = a;
  b.camera.photograph = "photo_01";
  b.camera.lens.kind = stream::LensKind::kFisheye;
  b.flash_in_camera.reset();
  b.camera.focus = {};
  b.gain = {1.25, 1.3, 1.0 / 3};
  b.shift_px = {-2, 0.125};
  b.trust = 0.4;
  return {a, b};
}

class CameraRecord : public testing::Test {
 protected:
  void SetUp() override { write_camera_record(file_, two_cameras()); }
  ScratchFolder scratch_;   // of this test alone: others run beside it
  std::filesystem::path file_ = scratch_.path() / "cameras.json";
};

TEST_F(CameraRecord, ReadsBackWhatWasWritten) {
  const std::vector<PhotographCamera> wanted = two_cameras(), found = read_camera_record(file_);
  ASSERT_EQ(found.size(), 2u);
  for (std::size_t i = 0; i < 2; ++i) {
    const stream::Lens &l = wanted[i].camera.lens, &m = found[i].camera.lens;
    EXPECT_EQ(found[i].acquisition, "day1");
    EXPECT_EQ(found[i].camera.photograph, wanted[i].camera.photograph);
    EXPECT_EQ(m.kind, l.kind);
    EXPECT_EQ(std::tie(m.width_px, m.height_px, m.fx, m.fy, m.cx, m.cy, m.skew, m.k, m.p), std::tie(l.width_px, l.height_px, l.fx, l.fy, l.cx, l.cy, l.skew, l.k, l.p));
    EXPECT_TRUE(found[i].camera.pose.rotation_camera_from_world.isApprox(wanted[i].camera.pose.rotation_camera_from_world, 1e-12));
    EXPECT_EQ(found[i].camera.pose.translation_camera_from_world, wanted[i].camera.pose.translation_camera_from_world);
    EXPECT_EQ(found[i].flash_in_camera, wanted[i].flash_in_camera);
    EXPECT_EQ(found[i].camera.focus.aperture, wanted[i].camera.focus.aperture);
    EXPECT_EQ(found[i].camera.focus.distance, wanted[i].camera.focus.distance);
    EXPECT_EQ(std::tie(found[i].gain, found[i].shift_px, found[i].trust), std::tie(wanted[i].gain, wanted[i].shift_px, wanted[i].trust));
  }
}

TEST_F(CameraRecord, RefusesADamagedOne) {
  const std::string whole = read_text(file_);
  for (const auto& [from, to] : std::vector<std::pair<std::string, std::string>>{{"photo_01", "../secret"}, {"fisheye", "pinhole"}, {"611.5", "-611.5"}, {"\"skew\"", "\"askew\""}, {"\"aperture\": 0.0125", "\"aperture\": -1"}, {"[\n", "{\n"}}) {
    std::string damaged = whole;
    damaged.replace(damaged.find(from), from.size(), to);
    write_text(file_, damaged);
    EXPECT_THROW(read_camera_record(file_), Error) << from;
  }
  write_text(file_, whole.substr(0, whole.size() / 2));
  EXPECT_THROW(read_camera_record(file_), Error);
}

}  // namespace
}  // namespace chiaro::tools
