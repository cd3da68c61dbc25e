#include <gmock/gmock.h>

#include <cmath>

#include "cloud_test_support.h"
#include "stream/cloud/pcl_module.h"

namespace chiaro::stream {
namespace {

using ::testing::HasSubstr;

class Pcd : public CloudFiles {};

const char kFields[] =
    "# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\nFIELDS x y z rgb normal_x normal_y normal_z label hist\nSIZE 4 4 4 4 4 4 4 2 "
    "1\n"
    "TYPE F F F U F F F U I\nCOUNT 1 1 1 1 1 1 1 1 2\nWIDTH 2\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS 2\nDATA ";

void expect_points(const Cloud& cloud) {
  ASSERT_EQ(cloud.points.size(), 2u);
  EXPECT_EQ(cloud.points.position[0], Vec3d(1, 2, 3));
  EXPECT_TRUE(std::isnan(cloud.points.position[1].x()));
  EXPECT_EQ(cloud.points.colour[0], (std::array<std::uint16_t, 3>{0x11 * 257, 0x22 * 257, 0x33 * 257}));
  EXPECT_EQ(cloud.points.normal[1], Vec3f(0, 0, 1));
  EXPECT_EQ(extra_of<std::uint16_t>(cloud, 1, "label"), 65535);
  EXPECT_EQ(extra_of<std::int8_t>(cloud, 0, "hist_1"), -1);
}

TEST_F(Pcd, AsciiAndBinaryAreStreamed) {
  expect_points(read("a.pcd", std::string(kFields) + "ascii\n1 2 3 1122867 1 0 0 7 5 -1\nnan 0 0 0 0 0 1 65535 0 0\n"));
  expect_points(
      read("b.pcd", std::string(kFields) + "binary\n" +
                        bytes_of(1.f, 2.f, 3.f, 0x112233u, 1.f, 0.f, 0.f, std::uint16_t{7}, std::int8_t{5}, std::int8_t{-1}) +
                        bytes_of(std::nanf(""), 0.f, 0.f, 0u, 0.f, 0.f, 1.f, std::uint16_t{65535}, std::int8_t{0}, std::int8_t{0})));
}

TEST_F(Pcd, ErrorsNameLineExpectedAndFound) {
  const std::string head(kFields);
  EXPECT_THAT(error("a.pcd", head + "ascii\n1 2 3 0 0 0 1 7 5 -1\n"), HasSubstr("1 of 2 points"));
  EXPECT_THAT(error("b.pcd", head + "binary\n1234"), HasSubstr("declares 2 points of 32 bytes"));
  EXPECT_THAT(error("c.pcd", head + "binary_compressed\n" + bytes_of(100u, 64u) + "abc"),
              HasSubstr("100 compressed bytes declared, the file holds 3"));
  EXPECT_THAT(error("d.pcd", head + "binary_compressed\n" + bytes_of(3u, 640u) + "abc"),
              HasSubstr("640 bytes of points declared, expected 2 points of 32 bytes"));
  EXPECT_THAT(error("e.pcd", "VERSION 0.7\nFIELDS x y z\nSIZE 4 4\n"),
              HasSubstr("line 3 of the PCD header: SIZE has 2 values for 3 fields"));
  EXPECT_THAT(error("f.pcd", "VERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nWIDTH 3\nHEIGHT 2\nPOINTS 5\nDATA ascii\n"),
              HasSubstr("POINTS is 5, WIDTH times HEIGHT is 6"));
  EXPECT_THAT(error("g.pcd", "VERSION 0.7\nFIELDS x y z\nSIZE 4 4 3\nTYPE F F F\nWIDTH 3\nDATA ascii\n"),
              HasSubstr("field 'z' has TYPE F and SIZE 3"));
  EXPECT_THAT(error("h.pcd", "VERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nWIDTH 0\nDATA ascii\n"), HasSubstr("holds no points"));
}

class PcdWithPcl : public Pcd {
 protected:
  // PCL's own reading of the file, decoded here field by field.
  static void expect_same_as_pcl(const fs::path& path) {
    const Cloud ours = read_all(path);
    const PclCloud pcl = pcl_read_pcd(path);
    ASSERT_EQ(pcl.num_points, ours.points.size());
    std::size_t compared = 0;
    for (const PclCloud::Field& field : pcl.fields) {
      const int axis = field.name == "x" || field.name == "X"   ? 0
                       : field.name == "y" || field.name == "Y" ? 1
                       : field.name == "z" || field.name == "Z" ? 2
                                                                : -1;
      for (std::size_t i = 0; i < pcl.num_points; ++i) {
        const std::byte* at = pcl.rows.data() + i * pcl.row_bytes + field.offset;
        if (axis >= 0) {
          double value = 0;
          float single = 0;
          if (field.bytes == 8) std::memcpy(&value, at, 8);
          if (field.bytes == 4) std::memcpy(&single, at, 4), value = static_cast<double>(single);
          const double mine = ours.points.position[i][axis];
          ASSERT_TRUE(mine == value || (std::isnan(mine) && std::isnan(value))) << i;
          ++compared;
        } else if (field.name == "rgb" || field.name == "rgba") {
          for (std::size_t k = 0; k < 3; ++k) ASSERT_EQ(ours.points.colour[i][k], 257 * std::to_integer<int>(at[2 - k])) << i;
        }
      }
    }
    EXPECT_EQ(compared, 3 * pcl.num_points);
  }
};

TEST_F(PcdWithPcl, OurStreamsGiveWhatPclReads) {
  expect_same_as_pcl(make("a.pcd", std::string(kFields) + "ascii\n1 2 3 1122867 1 0 0 7 5 -1\nnan 0 0 0 0 0 1 65535 0 0\n"));
  const fs::path clouds = shared_folder() / "real" / "clouds";
  if (!fs::exists(clouds)) GTEST_SKIP() << "no shared/real/clouds beside the source folder (set CHIARO_SHARED)";
  expect_same_as_pcl(clouds / "autzen-utm.pcd");
  expect_same_as_pcl(clouds / "pcl" / "milk.pcd");
  expect_same_as_pcl(clouds / "pcl" / "table_scene_mug_stereo_textured.pcd");
  EXPECT_EQ(read_all(clouds / "autzen-utm.pcd").points.size(), 1065u);
  EXPECT_EQ(read_all(clouds / "pcl" / "milk.pcd").points.size(), 12575u);
  const Cloud table = read_all(clouds / "pcl" / "table_scene_mug_stereo_textured.pcd");
  EXPECT_EQ(table.points.size(), 307200u);
  EXPECT_GT(std::count_if(table.points.position.begin(), table.points.position.end(), [](const Vec3d& p) { return !p.allFinite(); }), 0);
  // Compressed clouds are read whole: they ask for memory first.
  EXPECT_THAT(error_of([&] { open_points(clouds / "pcl" / "milk.pcd", 100'000); }), HasSubstr("100000 are allowed"));
}

TEST_F(PcdWithPcl, ACompressedFileThatPclWroteIsRead) {
  const fs::path path = fs::path(CHIARO_SOURCE_DIR) / "tests/stream/cloud/data/compressed.pcd";  // make_pcd.cpp has its formulas
  expect_same_as_pcl(path);
  const Cloud cloud = read_all(path, 77);
  ASSERT_EQ(cloud.points.size(), 500u);
  for (std::size_t i = 0; i < 500; ++i) {
    if (i == 7) {
      EXPECT_TRUE(std::isnan(cloud.points.position[i].y()));
    } else {
      EXPECT_EQ(cloud.points.position[i], Vec3d(0.25 * static_cast<double>(i), -1.5 * static_cast<double>(i), 3));
    }
    const auto red = static_cast<std::uint16_t>(i % 256 * 257), blue = static_cast<std::uint16_t>((255 - i % 256) * 257);
    EXPECT_EQ(cloud.points.colour[i], (std::array<std::uint16_t, 3>{red, 17 * 257, blue}));
    EXPECT_EQ(cloud.points.normal[i], Vec3f(0.6f, 0, 0.8f));
    EXPECT_EQ(extra_of<float>(cloud, i, "curvature"), 0.001f * static_cast<float>(i));
  }
}

TEST_F(PcdWithPcl, DamagedCompressedFilesAreReadOrRefused) {
  const std::string file = read_text(fs::path(CHIARO_SOURCE_DIR) / "tests/stream/cloud/data/compressed.pcd");
  const std::size_t body = file.find("binary_compressed\n") + 18;
  for (std::size_t n = 0; n < file.size(); n += 97) error("cut.pcd", file.substr(0, n));
  for (std::size_t i = body; i < file.size(); i += 13) {
    std::string changed = file;
    changed[i] ^= 0x55;
    try {
      EXPECT_EQ(read_all(make("changed.pcd", changed)).points.size(), 500u);
    } catch (const Error&) {
    }
  }
}

TEST_F(PcdWithPcl, PclReadsWhatWeWrite) {
  PointWriterOptions options;
  options.num_points = 3;
  options.properties = {{"x", ScalarType::kF64},   {"y", ScalarType::kF32},     {"z", ScalarType::kF32},      {"nx", ScalarType::kF32},
                        {"ny", ScalarType::kF32},  {"nz", ScalarType::kF32},    {"red", ScalarType::kU8},     {"green", ScalarType::kU8},
                        {"blue", ScalarType::kU8}, {"sigma", ScalarType::kF32}, {"photos", ScalarType::kU16}, {"id", ScalarType::kI64}};
  const fs::path path = folder_.path() / "w.pcd";
  auto writer = create_points(path, options);
  for (int i = 0; i < 3; ++i) {
    const std::string row = bytes_of(1e6 + i / 8.0, 2.f, static_cast<float>(i), 0.f, 0.f, 1.f) + "\x01\x02\xfe" +
                            bytes_of(0.5f, static_cast<std::uint16_t>(i), std::int64_t{-5});
    writer->write(reinterpret_cast<const std::byte*>(row.data()), 1);
  }
  writer->commit();
  expect_same_as_pcl(path);
  const Cloud cloud = read_all(path);
  EXPECT_EQ(cloud.points.position[2], Vec3d(1e6 + 0.25, 2, 2));
  EXPECT_EQ(cloud.points.colour[1], (std::array<std::uint16_t, 3>{257, 514, 254 * 257}));
  EXPECT_EQ(cloud.points.normal[0], Vec3f(0, 0, 1));
  EXPECT_EQ(extra_of<std::uint16_t>(cloud, 2, "photos"), 2);
  EXPECT_EQ(extra_of<std::int64_t>(cloud, 2, "id"), -5);
}

}  // namespace
}  // namespace chiaro::stream
