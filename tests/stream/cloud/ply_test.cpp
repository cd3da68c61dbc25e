#include <gmock/gmock.h>

#include <cmath>

#include "cloud_test_support.h"

namespace chiaro::stream {
namespace {

using ::testing::HasSubstr;

class Ply : public CloudFiles {};

const char kAscii[] =
    "ply\nformat ascii 1.0\ncomment by hand\nelement vertex 2\nproperty float x\nproperty float y\nproperty float z\nproperty uchar red\n"
    "property uchar green\nproperty uchar blue\nproperty int label\nend_header\n1 2 3 255 0 128 -7\n-1.5 nan 4e2 0 1 2 9\n";

TEST_F(Ply, AsciiGivesPositionsColoursAndExtras) {
  const Cloud cloud = read("a.ply", kAscii);
  ASSERT_EQ(cloud.points.size(), 2u);
  EXPECT_EQ(cloud.schema.declared_points, 2u);
  EXPECT_FALSE(cloud.schema.position_is_double);
  EXPECT_FALSE(cloud.schema.colour_is_16_bit);
  EXPECT_EQ(cloud.points.position[0], Vec3d(1, 2, 3));
  EXPECT_TRUE(std::isnan(cloud.points.position[1].y()));
  EXPECT_EQ(cloud.points.colour[0], (std::array<std::uint16_t, 3>{65535, 0, 128 * 257}));
  EXPECT_EQ(extra_of<std::int32_t>(cloud, 0, "label"), -7);
  EXPECT_EQ(extra_of<std::int32_t>(cloud, 1, "label"), 9);
}

TEST_F(Ply, WindowsLineEndsAndBlankLinesChangeNothing) {
  std::string text;
  for (const char c : std::string(kAscii)) text += c == '\n' ? std::string("\r\n") : std::string(1, c);
  const Cloud cloud = read("a.ply", text + "\r\n\r\n");
  ASSERT_EQ(cloud.points.size(), 2u);
  EXPECT_EQ(cloud.points.position[1].z(), 400);
}

std::string binary_ply(bool big) {
  std::string file =
      std::string("ply\nformat binary_") + (big ? "big" : "little") +
      "_endian 1.0\nelement camera 2\nproperty list uchar int ids\nproperty double f\nelement vertex 2\nproperty ushort diffuse_red\n"
      "property double z\nproperty float nx\nproperty float ny\nproperty float nz\nproperty float64 x\nproperty int16 y\nproperty uint16 "
      "diffuse_green\n"
      "property uint16 diffuse_blue\nproperty float32 quality\nelement face 1\nproperty list uchar int vertex_indices\nend_header\n";
  const auto add = [&](auto... values) {
    for (const std::string& value : {bytes_of(values)...}) file += big ? reversed(value) : value;
  };
  add(std::uint8_t{2}, std::int32_t{5}, std::int32_t{6}, 1.5, std::uint8_t{0}, 2.5);
  for (const int i : {0, 1})
    add(static_cast<std::uint16_t>(1000 + i), 3.25 + i, 0.f, 1.f, 0.f, 0.1 + i, static_cast<std::int16_t>(-2 - i), std::uint16_t{40000},
        std::uint16_t{2}, 7.f + static_cast<float>(i));
  add(std::uint8_t{3}, 0, 1, 1);
  return file;
}

TEST_F(Ply, BinaryOfBothByteOrdersInAnyPropertyOrderBehindAnElementWithLists) {
  for (const bool big : {false, true}) {
    const Cloud cloud = read("b.ply", binary_ply(big));
    ASSERT_EQ(cloud.points.size(), 2u);
    EXPECT_TRUE(cloud.schema.position_is_double);
    EXPECT_EQ(cloud.points.position[1], Vec3d(1.1, -3, 4.25));
    EXPECT_EQ(cloud.points.normal[1], Vec3f(0, 1, 0));
    EXPECT_TRUE(cloud.schema.colour_is_16_bit);
    EXPECT_EQ(cloud.points.colour[1], (std::array<std::uint16_t, 3>{1001, 40000, 2}));
    EXPECT_EQ(extra_of<float>(cloud, 1, "quality"), 8.f);
  }
}

TEST_F(Ply, ListsOfAPointArePassedOver) {
  for (const bool big : {false, true}) {
    std::string file = std::string("ply\nformat binary_") + (big ? "big" : "little") +
                       "_endian 1.0\nelement vertex 70000\nproperty float x\nproperty float y\nproperty float z\nproperty list uchar uint view_indices\nproperty ushort red\nproperty ushort green\n"
                       "property ushort blue\nproperty list ushort float view_weights\nproperty float quality\nelement face 1\nproperty list uchar int vertex_indices\nend_header\n";
    const auto add = [&](auto... values) {
      for (const std::string& value : {bytes_of(values)...}) file += big ? reversed(value) : value;
    };
    for (std::uint32_t i = 0; i < 70000; ++i) {   // more than a window of the reader
      add(static_cast<float>(i), 2.f, 3.f, static_cast<std::uint8_t>(i % 4));
      for (std::uint32_t k = 0; k < i % 4; ++k) add(k);
      add(std::uint16_t{200}, std::uint16_t{100}, static_cast<std::uint16_t>(i % 256), static_cast<std::uint16_t>(i % 3));
      for (std::uint32_t k = 0; k < i % 3; ++k) add(0.5f);
      add(0.25f * static_cast<float>(i));
    }
    add(std::uint8_t{3}, 0, 1, 2);
    const Cloud cloud = read("lists.ply", file);
    ASSERT_EQ(cloud.points.size(), 70000u);
    ASSERT_EQ(cloud.schema.extras.size(), 1u);
    for (const std::size_t i : {std::size_t{0}, std::size_t{1}, std::size_t{65537}, std::size_t{69999}}) {
      EXPECT_EQ(cloud.points.position[i], Vec3d(static_cast<double>(i), 2, 3));
      EXPECT_EQ(cloud.points.colour[i], (std::array<std::uint16_t, 3>{200 * 257, 100 * 257, static_cast<std::uint16_t>(i % 256 * 257)}));
      EXPECT_EQ(extra_of<float>(cloud, i, "quality"), 0.25f * static_cast<float>(i));
    }
    EXPECT_THAT(error("cut.ply", file.substr(0, file.size() - 40)), HasSubstr("69999 of 70000 points read, the file ends early"));
    const std::size_t length = file.find("end_header\n") + 11 + 12;
    file[length] = static_cast<char>(255);
    EXPECT_THAT(error("few.ply", file.substr(0, length + 200000)), HasSubstr("declares 70000 points of 25 bytes or more"));
  }
}

TEST_F(Ply, FloatColoursUpToOneAndUpTo255AreTold) {
  const std::string header =
      "ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nproperty float y\nproperty float z\nproperty float red\nproperty float "
      "green\nproperty float blue\nend_header\n";
  EXPECT_EQ(read("u.ply", header + "0 0 0 1 0.5 0\n0 0 0 nan -1 0\n").points.colour[0], (std::array<std::uint16_t, 3>{65535, 32768, 0}));
  const Cloud bytes = read("v.ply", header + "0 0 0 255 127 1\n0 0 0 nan -1 0\n");
  EXPECT_EQ(bytes.points.colour[0], (std::array<std::uint16_t, 3>{65535, 127 * 257, 257}));
  EXPECT_EQ(bytes.points.colour[1], (std::array<std::uint16_t, 3>{0, 0, 0}));
}

TEST_F(Ply, ErrorsNameFilePlaceExpectedAndFound) {
  const std::string xyz = "property float x\nproperty float y\nproperty float z\n";
  EXPECT_THAT(error("a.ply", "ply\nformat ascii 1.0\nelement vertex 3\n" + xyz + "end_header\n1 2 3\n4 5 6\n\n\n"),
              HasSubstr("2 of 3 points"));
  EXPECT_THAT(
      error("b.ply", "ply\nformat binary_little_endian 1.0\nelement vertex 9000000000000\n" + xyz + "end_header\n" + std::string(30, 'a')),
      HasSubstr("declares 9000000000000 points"));
  EXPECT_THAT(error("b2.ply", "ply\nformat binary_little_endian 1.0\nelement vertex 3\n" + xyz + "end_header\n" + std::string(30, 'a')),
              HasSubstr("the file holds 2"));
  EXPECT_THAT(error("c.ply", "ply\nformat ascii 1.0\nelement vertex 1\n" + xyz + "end_header\n1 2\n"),
              HasSubstr("line 8: 2 values, expected 3"));
  EXPECT_THAT(error("d.ply", "ply\nformat ascii 1.0\nelement vertex 1\n" + xyz + "end_header\n1 x 2\n"),
              HasSubstr("line 8: 'x' is not a number (column 2, y)"));
  EXPECT_THAT(error("e.ply", "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nend_header\n1 2\n"),
              HasSubstr("no point property 'z'"));
  EXPECT_THAT(error("f.ply", "ply\nformat ascii 1.0\nelement vertex 1\n" + xyz + "property list uchar int ids\nend_header\n1 2 3 0\n"),
              HasSubstr("list 'ids'"));
  EXPECT_THAT(error("g.ply", "ply\nformat ascii 1.0\nelement vertex 1\n" + xyz + "property uchar red\nend_header\n1 2 3 256\n"),
              HasSubstr("does not fit the type uchar of red"));
  EXPECT_THAT(error("h.ply", "ply\nformat ascii 1.0\nelement face 1\n" + xyz + "end_header\n1 2 3\n"), HasSubstr("no element 'vertex'"));
  EXPECT_THAT(error("i.ply", "ply\nformat ascii 1.0\nelement vertex 0\n" + xyz + "end_header\n"), HasSubstr("holds no points"));
  EXPECT_THAT(error("j.ply", "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float x\nend_header\n1 2\n"),
              HasSubstr("two point properties are named 'x'"));
  EXPECT_THAT(error("k.ply", "ply\nformat binary_little_endian 1.0\nelement face 1\nproperty list int int i\nelement vertex 1\n" + xyz +
                                 "end_header\n" + bytes_of(1 << 30, 7)),
              HasSubstr("list 'i'"));
  EXPECT_THAT(error("l.ply", "ply\nformat ascii 1.0\nelement vertex 1\n" + xyz), HasSubstr("before 'end_header'"));
  EXPECT_THAT(error("m.ply", "not a ply"), HasSubstr("expected 'ply'"));
}

TEST_F(Ply, WriterKeepsPropertiesInOrderAndReadsBack) {
  PointWriterOptions options;
  options.num_points = 2;
  options.properties = {{"x", ScalarType::kF64},        {"y", ScalarType::kF64},     {"z", ScalarType::kF64},
                        {"red", ScalarType::kU8},       {"green", ScalarType::kU8},  {"blue", ScalarType::kU8},
                        {"albedo_r", ScalarType::kF32}, {"photos", ScalarType::kU16}};
  options.comments = {"two\nlines"};
  const fs::path path = folder_.path() / "w.ply";
  auto writer = create_points(path, options);
  const std::string rows = bytes_of(1e7 + 0.125, 2.0, 3.0) + "\x01\x02\x03" + bytes_of(0.5f, std::uint16_t{300}) + bytes_of(4.0, 5.0, 6.0) +
                           "\x04\x05\x06" + bytes_of(0.75f, std::uint16_t{4});
  writer->write(reinterpret_cast<const std::byte*>(rows.data()), 1);
  writer->write(reinterpret_cast<const std::byte*>(rows.data() + 33), 1);
  EXPECT_FALSE(fs::exists(path));
  writer->commit();
  const std::string file = read_text(path);
  EXPECT_THAT(file, HasSubstr("ply\nformat binary_little_endian 1.0\ncomment two lines\nelement vertex 2\nproperty double x\nproperty "
                              "double y\nproperty double z\nproperty uchar red\n"
                              "property uchar green\nproperty uchar blue\nproperty float albedo_r\nproperty ushort photos\nend_header\n"));
  EXPECT_EQ(file.substr(file.size() - rows.size()), rows);
  const Cloud cloud = read_all(path);
  EXPECT_EQ(cloud.points.position[0], Vec3d(1e7 + 0.125, 2, 3));
  EXPECT_EQ(cloud.points.colour[1][2], 6 * 257);
  EXPECT_EQ(extra_of<std::uint16_t>(cloud, 0, "photos"), 300);
  EXPECT_EQ(extra_of<float>(cloud, 1, "albedo_r"), 0.75f);
}

TEST_F(Ply, WriterRefusesOtherCountsAndLeavesNothing) {
  PointWriterOptions options;
  options.num_points = 1;
  options.properties = {{"x", ScalarType::kF32}, {"y", ScalarType::kF32}, {"z", ScalarType::kF32}};
  const fs::path path = folder_.path() / "w.ply";
  const std::string rows(24, '\0');
  {
    auto writer = create_points(path, options);
    EXPECT_THAT(error_of([&] { writer->commit(); }), HasSubstr("0 points written, 1 were announced"));
    EXPECT_THAT(error_of([&] { writer->write(reinterpret_cast<const std::byte*>(rows.data()), 2); }),
                HasSubstr("2 points to write, 1 were announced"));
  }
  EXPECT_TRUE(fs::is_empty(folder_.path()));
  EXPECT_THAT(error_of([&] { create_points(folder_.path() / "w.e57", options); }), HasSubstr(".ply, .las or .pcd"));
  options.properties.pop_back();
  EXPECT_THAT(error_of([&] { create_points(path, options); }), HasSubstr("no property 'z'"));
}

}  // namespace
}  // namespace chiaro::stream
