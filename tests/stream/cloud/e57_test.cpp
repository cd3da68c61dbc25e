// The files in data/ were written by libE57Format (make_files.py has the formulas of their points).
#include <gmock/gmock.h>

#include <cmath>

#include "cloud_test_support.h"
#include "e57_pages.h"

namespace chiaro::stream {
namespace {

using ::testing::HasSubstr;

class E57 : public CloudFiles {
 protected:
  void SetUp() override {
    if (!CHIARO_HAS_RUST_FORMATS) GTEST_SKIP() << "built without cargo";
  }
  static fs::path data(const std::string& name) { return fs::path(CHIARO_SOURCE_DIR) / "tests/stream/cloud/data" / name; }
  /// The file with this text of its XML replaced by one of the same length, and right checksums.
  static std::string with_xml(const std::string& from, std::string to) {
    std::string file = logical_bytes(read_text(data("two_scans.e57")));
    const std::size_t at = file.find(from);
    EXPECT_NE(at, std::string::npos) << from;
    EXPECT_LE(to.size(), from.size());
    to.resize(from.size(), ' ');
    return physical_bytes(file.replace(at, from.size(), to));
  }
};

TEST_F(E57, SeveralScansComeInTheFrameOfTheFile) {
  const Cloud cloud = read_all(data("two_scans.e57"), 7);
  EXPECT_EQ(cloud.schema.declared_points, 52u);
  EXPECT_TRUE(cloud.schema.position_is_double);
  ASSERT_EQ(cloud.points.size(), 52u);
  for (int i = 0; i < 40; ++i) {
    SCOPED_TRACE(i);
    const Vec3d& p = cloud.points.position[static_cast<std::size_t>(i)];
    if (i % 8 == 3) {
      EXPECT_STREQ(why_unusable(p), "invalid in the scan");
      continue;
    }
    // a quarter turn about z, then the shift
    EXPECT_LT((p - Vec3d(100 - (10 - 0.25 * i), 200 + 10 + 0.125 * i, -3 + 12 + 0.001 * i * i)).norm(), 1e-9);
  }
  for (int i = 0; i < 12; ++i) {
    SCOPED_TRACE(i);
    const Vec3d& p = cloud.points.position[static_cast<std::size_t>(40 + i)];
    if (i == 5) {
      EXPECT_STREQ(why_unusable(p), "invalid in the scan");
      continue;
    }
    const double range = 1 + 0.5 * i, azimuth = 0.25 * i, elevation = 0.125 * i - 0.5;
    const Vec3d expected(range * std::cos(elevation) * std::cos(azimuth), range * std::cos(elevation) * std::sin(azimuth), 1000 + range * std::sin(elevation));
    EXPECT_LT((p - expected).norm(), 1e-9);
  }
}

TEST_F(E57, AttributesAreCarried) {
  const Cloud cloud = read_all(data("two_scans.e57"), 50);
  ASSERT_TRUE(cloud.schema.has_colour);
  ASSERT_TRUE(cloud.schema.has_normal);
  for (std::size_t i = 0; i < 40; ++i) {
    SCOPED_TRACE(i);
    EXPECT_EQ(cloud.points.colour[i], (std::array<std::uint16_t, 3>{static_cast<std::uint16_t>(i * 6 * 257), static_cast<std::uint16_t>((255 - i) * 257), 9 * 257}));
    EXPECT_EQ(cloud.points.normal[i], Vec3f::Zero());
    EXPECT_EQ(extra_of<std::uint16_t>(cloud, i, "intensity"), 1500 * i);
    EXPECT_EQ(extra_of<std::uint8_t>(cloud, i, "row"), i % 5);
    EXPECT_EQ(extra_of<std::uint8_t>(cloud, i, "column"), i / 5);
    EXPECT_EQ(extra_of<std::uint8_t>(cloud, i, "return_number"), 1 + i % 2);
    EXPECT_EQ(extra_of<std::uint8_t>(cloud, i, "number_of_returns"), 2);
    EXPECT_EQ(extra_of<double>(cloud, i, "time_stamp"), 0.5 * static_cast<double>(i));
    EXPECT_EQ(extra_of<std::uint16_t>(cloud, i, "scan"), 1);
  }
  for (std::size_t i = 40; i < 52; ++i) {
    SCOPED_TRACE(i);
    EXPECT_EQ(cloud.points.colour[i], (std::array<std::uint16_t, 3>{128 * 257, 128 * 257, 128 * 257}));
    EXPECT_EQ(cloud.points.normal[i], Vec3f(0.6f, 0, 0.8f));
    EXPECT_EQ(extra_of<std::uint16_t>(cloud, i, "intensity"), i - 39);
    EXPECT_TRUE(std::isnan(extra_of<double>(cloud, i, "time_stamp")));
    EXPECT_EQ(extra_of<std::uint16_t>(cloud, i, "scan"), 2);
  }
}

TEST_F(E57, OnePointAndColoursOfTenBits) {
  const Cloud cloud = read_all(data("one_point.e57"));
  ASSERT_EQ(cloud.points.size(), 1u);
  EXPECT_EQ(cloud.points.position[0], Vec3d(1.5, -2.5, 0.25));
  EXPECT_EQ(cloud.points.colour[0], (std::array<std::uint16_t, 3>{65535, 0, 32800}));  // 512 of 1023
  EXPECT_TRUE(cloud.schema.colour_is_16_bit);
  EXPECT_EQ(extra_of<float>(cloud, 0, "intensity"), 0.75f);
}

TEST_F(E57, ADamagedPageIsNamed) {
  std::string file = read_text(data("two_scans.e57"));
  file[200] ^= 1;
  EXPECT_THAT(error("a.e57", file), HasSubstr("page 0 (offset 0): checksum"));
}

TEST_F(E57, WrongHeadersAreRefusedInWords) {
  const std::string file = read_text(data("two_scans.e57"));
  EXPECT_THAT(error("a.e57", file.substr(0, 2048)), HasSubstr("the header declares 5120 bytes, the file has 2048"));
  EXPECT_THAT(error("b.e57", file.substr(0, 100)), HasSubstr("100 bytes, an E57 file has 1024 or more"));
  std::string xml = logical_bytes(file);
  xml.replace(32, 8, bytes_of(std::uint64_t{1} << 62));
  EXPECT_THAT(error("c.e57", physical_bytes(xml)), HasSubstr("bytes of XML in a file of 5120"));
  EXPECT_THAT(error("d.e57", with_xml("recordCount=\"40\"", "recordCount=\"4e\"")), HasSubstr("recordCount"));
  EXPECT_THAT(error("e.e57", with_xml("recordCount=\"40\"", "recordCount=\"41\"")), HasSubstr("scan 1: offset"));
  EXPECT_THAT(error("f.e57", with_xml("<cartesianX ", "<cartesianW ")), HasSubstr("neither cartesianX, Y and Z nor"));
}

TEST_F(E57, HugeCountsAreRefusedBeforeReading) {
  std::string file = logical_bytes(read_text(data("two_scans.e57")));
  const std::size_t guid = file.find("{scan 0}");
  ASSERT_NE(guid, std::string::npos);
  const std::size_t at = file.find("recordCount=\"40\"");
  // The guid's text gives its bytes to the count.
  file.replace(at, 16, "recordCount=\"4999999\"");
  file.erase(guid + 1, 5);
  EXPECT_THAT(error("a.e57", physical_bytes(file)), HasSubstr("scan 1 of 2: declares 4999999 points of"));
}

TEST_F(E57, FilesOfOtherProgramsAreRead) {
  const fs::path clouds = shared_folder() / "real" / "clouds";
  if (!fs::exists(clouds)) GTEST_SKIP() << "no shared/real/clouds beside the source folder (set CHIARO_SHARED)";
  EXPECT_EQ(read_all(clouds / "e57" / "bunnyDouble.e57", 65536).points.size(), 30571u);
  const Cloud whole = read_all(clouds / "e57" / "bunnyDouble.e57"), scaled = read_all(clouds / "e57" / "bunnyInt19.e57");
  ASSERT_EQ(scaled.points.size(), whole.points.size());
  double farthest = 0;
  for (std::size_t i = 0; i < whole.points.size(); ++i) farthest = std::max(farthest, (whole.points.position[i] - scaled.points.position[i]).norm());
  EXPECT_LT(farthest, 2e-6);
  EXPECT_TRUE(read_all(clouds / "e57" / "tinyCartesianFloatRgb.e57").schema.has_colour);
  EXPECT_EQ(read_all(clouds / "e57" / "tiny_spherical.e57").points.size(), 360u);
  const Cloud two = read_all(clouds / "A_B.e57");
  EXPECT_EQ(two.points.size(), 6u);
  EXPECT_LT((two.points.position[2] - Vec3d(-44.30009842, -1.13209999, 0.33579999)).norm(), 1e-6);
}

}  // namespace
}  // namespace chiaro::stream
