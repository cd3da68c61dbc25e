// Files that other programs wrote, and damaged ones. They lie outside the repository; without them these tests are skipped.
#include <gmock/gmock.h>

#include "cloud_test_support.h"

namespace chiaro::stream {
namespace {

using ::testing::HasSubstr;

class RealClouds : public ::testing::Test {
 protected:
  void SetUp() override {
    if (!fs::exists(shared_folder() / "real" / "clouds"))
      GTEST_SKIP() << "no shared/real/clouds beside the source folder (set CHIARO_SHARED)";
  }
  static Cloud read(const std::string& name) { return read_all(shared_folder() / "real" / "clouds" / name); }
  static std::string error(const std::string& name) {
    return error_of([&] { read_all(shared_folder() / "real" / name); });
  }
};

TEST_F(RealClouds, LasFilesGiveTheirPoints) {
  const Cloud colour = read("1.2-with-color.las");
  ASSERT_EQ(colour.points.size(), 1065u);
  EXPECT_NEAR(colour.points.position[0].x(), 637012.24, 1e-6);
  EXPECT_NEAR(colour.points.position[0].y(), 849028.31, 1e-6);
  EXPECT_NEAR(colour.points.position[0].z(), 431.66, 1e-6);
  EXPECT_EQ(colour.points.colour[0], (std::array<std::uint16_t, 3>{68 * 257, 77 * 257, 88 * 257}));
  EXPECT_NEAR(extra_of<double>(colour, 0, "gps_time"), 245380.78254, 1e-4);
  EXPECT_EQ(read("test1_4.las").points.size(), 1000u);
  EXPECT_EQ(read("prec3.las").points.size(), 110u);
  const Cloud extra = read("extrabytes.las");
  EXPECT_EQ(extra.points.size(), 1065u);
  EXPECT_EQ(extra.points.position[0], colour.points.position[0]);
  EXPECT_TRUE(extra.schema.position_is_double);
}

TEST_F(RealClouds, TextAndPlyFilesGiveTheirPoints) {
  ASSERT_EQ(read("bunny_8.pts").points.size(), 9u);  // its first line says 8
  EXPECT_EQ(read("bunny_8.pts").points.position[8], Vec3d(-0.025508, 0.112568, 0.036676));
  const Cloud pts = read("test.pts");
  EXPECT_EQ(pts.points.size(), 19u);
  EXPECT_EQ(extra_of<double>(pts, 0, "intensity"), -1035);
  EXPECT_EQ(pts.points.colour[0], (std::array<std::uint16_t, 3>{97 * 257, 59 * 257, 38 * 257}));
  EXPECT_EQ(read("simple_text.ply").points.position[2], Vec3d(1, 0, 0));
  EXPECT_EQ(read("simple_binary.ply").points.size(), 3u);
  EXPECT_EQ(read("mesh.ply").points.position[3], Vec3d(2, 2, 2));
}

TEST_F(RealClouds, OtherFormatsAreRefusedInWords) { EXPECT_THAT(error("clouds/1.2-with-color.obj"), HasSubstr("unknown point cloud format")); }

TEST_F(RealClouds, DamagedFilesAreRefused) {
  EXPECT_THAT(error("malformed/bad_vlr_count.las"), HasSubstr("variable length record"));
  EXPECT_THAT(error("malformed/garbage_nVariableLength.las"), HasSubstr("variable length record 1 of"));
  EXPECT_THAT(error("malformed/no-points.las"), HasSubstr("declares no points"));
  EXPECT_THAT(error("malformed/missingheader.pcd"), HasSubstr("line 1 of the PCD header"));
  EXPECT_THAT(error("malformed/no_vertex.ply"), HasSubstr("no element 'vertex'"));
  EXPECT_THAT(error("malformed/unsized_dims.ply"), HasSubstr("no point property 'z'"));
  EXPECT_THAT(error("malformed/badheader.txt"), HasSubstr("names of columns with x, y and z"));
  for (const char* name : {"no_vertex.obj", "corrupt_crc.e57", "empty.e57"}) error(std::string("malformed/") + name);
}

TEST_F(RealClouds, OddButValidFilesAreRead) {
  const Cloud lines = read("../malformed/crlf_test.txt");
  EXPECT_EQ(lines.points.size(), 10u);
  EXPECT_EQ(lines.points.position[9], Vec3d(289818.50, 4320980.59, 170.58));
  EXPECT_EQ(extra_of<double>(lines, 9, "Intensity"), 9);
  const Cloud no_time = read("../malformed/gps-time-nan.las");
  ASSERT_EQ(no_time.points.size(), 1u);
  EXPECT_TRUE(std::isnan(extra_of<double>(no_time, 0, "gps_time")));
}

TEST_F(RealClouds, ScenesAndPhotogrammetryAreRead) {
  const fs::path tower = shared_folder() / "scenes" / "tower" / "cloud.ply";
  if (fs::exists(tower)) {
    EXPECT_EQ(read_all(tower, 65536).points.size(), 450000u);
  }
  const fs::path rodin = shared_folder() / "real" / "rodin_flash" / "derived" / "points_normals.ply";
  if (fs::exists(rodin)) {
    EXPECT_TRUE(read_all(rodin, 65536).schema.has_normal);
  }
}

}  // namespace
}  // namespace chiaro::stream
