#include <gmock/gmock.h>

#include <cmath>

#include "cloud_test_support.h"

namespace chiaro::stream {
namespace {

using ::testing::HasSubstr;

class Ptx : public CloudFiles {};

const char kHead[] = "0 0 0\n1 0 0\n0 1 0\n0 0 1\n";
const char kStays[] = "1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n";
// a quarter turn about z: x goes to y, y to -x
const char kTurns[] = "0 1 0 0\n-1 0 0 0\n0 0 1 0\n10 20 30 1\n";

std::string two_scans() {
  return concat("2\n3\n", kHead, kStays, "1 2 3 0.5 255 0 1\n0 0 0 0.5 0 0 0\n4 5 6 0.25 1 2 3\r\n7 8 9 1 4 5 6\n1 1 1 0 0 0 0\n2 2 2 0.125 9 9 9\n", "1\n1\n",
                kHead, kTurns, "1 2 3 0.75\n");
}

TEST_F(Ptx, ScansComeInTheFrameOfTheFile) {
  const Cloud cloud = read("a.ptx", two_scans());
  ASSERT_EQ(cloud.points.size(), 7u);
  EXPECT_EQ(cloud.points.position[0], Vec3d(1, 2, 3));
  EXPECT_STREQ(why_unusable(cloud.points.position[1]), "invalid in the scan");
  EXPECT_EQ(cloud.points.position[6], Vec3d(10 - 2, 20 + 1, 30 + 3));
  EXPECT_EQ(cloud.points.colour[0], (std::array<std::uint16_t, 3>{65535, 0, 257}));
  EXPECT_EQ(cloud.points.colour[6], (std::array<std::uint16_t, 3>{128 * 257, 128 * 257, 128 * 257}));
  EXPECT_EQ(extra_of<float>(cloud, 5, "intensity"), 0.125f);
  EXPECT_EQ(extra_of<std::uint32_t>(cloud, 4, "row"), 1u);
  EXPECT_EQ(extra_of<std::uint32_t>(cloud, 4, "column"), 1u);
  EXPECT_EQ(extra_of<std::uint16_t>(cloud, 5, "scan"), 1);
  EXPECT_EQ(extra_of<std::uint16_t>(cloud, 6, "scan"), 2);
}

TEST_F(Ptx, EmptyScansAreLegal) {
  const std::string empty = concat("0\n5\n", kHead, kStays);
  EXPECT_EQ(read("a.ptx", empty + two_scans() + empty).points.size(), 7u);
  EXPECT_THAT(error("b.ptx", empty), HasSubstr("holds no points"));
}

TEST_F(Ptx, OnePointWithoutIntensity) {
  const Cloud cloud = read("a.ptx", concat("1\n1\n", kHead, kStays, "nan 2 3"));
  ASSERT_EQ(cloud.points.size(), 1u);
  EXPECT_STREQ(why_unusable(cloud.points.position[0]), "not finite");
  EXPECT_FALSE(cloud.schema.has_colour);
  EXPECT_TRUE(std::isnan(extra_of<float>(cloud, 0, "intensity")));
}

TEST_F(Ptx, WrongCountsAreRefusedWithTheLine) {
  const std::string head = concat(kHead, kStays);
  EXPECT_THAT(error("a.ptx", "2\n2\n" + head + "1 2 3 0\n4 5 6 0\n7 8 9 0\n"), HasSubstr("3 of 4 points of scan 1 read, the file ends early at line 13"));
  EXPECT_THAT(error("b.ptx", "4000000000\n4000000000\n" + head + "1 2 3 0\n"), HasSubstr("declares 4000000000 columns of 4000000000 rows, 8 bytes follow"));
  EXPECT_THAT(error("c.ptx", "1\n1\n" + head + "1 2 3 0\n4 5 6 0\n"), HasSubstr("line 12: 4 values, expected the number of columns"));
  EXPECT_THAT(error("d.ptx", "-1\n1\n" + head + "1 2 3 0\n"), HasSubstr("line 1: '-1' is not the number of columns"));
  EXPECT_THAT(error("e.ptx", "1e30\n1\n" + head + "1 2 3 0\n"), HasSubstr("line 1"));
  EXPECT_THAT(error("f.ptx", "1\n1\n" + head + "1 2 3 0 1\n"), HasSubstr("line 11: 5 values"));
  EXPECT_THAT(error("g.ptx", "1\n1\n" + head + "1 2 b 0\n"), HasSubstr("line 11: 'b' is not a number"));
  EXPECT_THAT(error("h.ptx", "1\n1\n0 0 0\n1 0 0\n0 1 0\n0 0 1\n1 0 0 5\n"), HasSubstr("line 7: the 4x4 matrix"));
  EXPECT_THAT(error("i.ptx", "1\n1\n0 0 inf\n"), HasSubstr("line 3: 'inf' in the position of the scanner"));
  EXPECT_THAT(error("j.ptx", "1\n1\n0 0 0\n"), HasSubstr("the file ends in the header of scan 1"));
  EXPECT_THAT(error("k.ptx", "2\n1\n" + head + "1 2 3 0\n4 5 6 0 1 2 3\n"), HasSubstr("line 12: a colour, the first point of the file has none"));
}

TEST_F(Ptx, FilesOfOtherProgramsAreRead) {
  const fs::path clouds = shared_folder() / "real" / "clouds";
  if (!fs::exists(clouds)) GTEST_SKIP() << "no shared/real/clouds beside the source folder (set CHIARO_SHARED)";
  const Cloud las = read_all(clouds / "1.2-with-color.las"), ptx = read_all(clouds / "1.2-with-color.ptx");
  ASSERT_EQ(ptx.points.size(), 1065u);
  for (std::size_t i = 0; i < 1065; ++i) ASSERT_LT((ptx.points.position[i] - las.points.position[i]).norm(), 1e-6) << i;
  EXPECT_EQ(ptx.points.colour[0], las.points.colour[0]);
  const Cloud turned = read_all(clouds / "complex-transform.ptx");
  ASSERT_EQ(turned.points.size(), 12u);
  EXPECT_STREQ(why_unusable(turned.points.position[0]), "invalid in the scan");
  EXPECT_EQ(extra_of<std::uint32_t>(turned, 7, "row"), 1u);
  EXPECT_EQ(extra_of<std::uint32_t>(turned, 7, "column"), 1u);
}

}  // namespace
}  // namespace chiaro::stream
