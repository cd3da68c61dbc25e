#include <gmock/gmock.h>

#include <cmath>

#include "cloud_test_support.h"

namespace chiaro::stream {
namespace {

using ::testing::HasSubstr;

class Text : public CloudFiles {};

TEST_F(Text, ThreeColumnsWithAnySeparator) {
  for (const char* content : {"1 2 3\n4 5 6\n", "  1\t2  3 \r\n\r\n4 5 6", "1,2,3\n4, 5, 6\n", "1;2;3\n4; 5;6\n",
                              "# comment\n1 2 3\n% more\n// and more\n4 5 6\n",
                              "\xef\xbb\xbf"
                              "1 2 3\n4 5 6\n",
                              "+1 2 3\n4.0 5e0 6\n"}) {
    SCOPED_TRACE(content);
    const Cloud cloud = read("a.xyz", content);
    ASSERT_EQ(cloud.points.size(), 2u);
    EXPECT_EQ(cloud.points.position[0], Vec3d(1, 2, 3));
    EXPECT_EQ(cloud.points.position[1], Vec3d(4, 5, 6));
    EXPECT_FALSE(cloud.schema.position_is_double);
    EXPECT_EQ(cloud.schema.declared_points, 0u);
    EXPECT_TRUE(cloud.schema.extras.empty());
  }
}

TEST_F(Text, SixColumnsAreColourOrNormal) {
  const Cloud colour = read("a.txt", "1 2 3 255 0 10\n1 2 3 7 7 7\n");
  ASSERT_TRUE(colour.schema.has_colour);
  EXPECT_FALSE(colour.schema.has_normal);
  EXPECT_EQ(colour.points.colour[0], (std::array<std::uint16_t, 3>{65535, 0, 2570}));
  const Cloud normal = read("b.txt", "1 2 3 0.6 0 0.8\n1 2 3 0 0 0\n");
  ASSERT_TRUE(normal.schema.has_normal);
  EXPECT_EQ(normal.points.normal[0], Vec3f(0.6f, 0, 0.8f));
  const Cloud other = read("c.txt", "1 2 3 300 0 10.5\n");
  EXPECT_EQ(extra_of<double>(other, 0, "column_6"), 10.5);
}

TEST_F(Text, XyzrgbHasColoursWhateverTheirRange) {
  const Cloud unit = read("a.xyzrgb", "1 2 3 0.5 0 1\n1 2 3 0 0 0\n"), bytes = read("b.xyzrgb", "1 2 3 255 0 10\n");
  ASSERT_TRUE(unit.schema.has_colour && bytes.schema.has_colour);
  EXPECT_EQ(unit.points.colour[0], (std::array<std::uint16_t, 3>{32768, 0, 65535}));
  EXPECT_EQ(bytes.points.colour[0], (std::array<std::uint16_t, 3>{65535, 0, 2570}));
}

TEST_F(Text, SevenAndNineColumns) {
  const Cloud seven = read("a.txt", "1 2 3 -40.5 1 2 3\n");
  EXPECT_EQ(extra_of<double>(seven, 0, "intensity"), -40.5);
  EXPECT_EQ(seven.points.colour[0][2], 771);
  const Cloud behind = read("b.txt", "1 2 3 1 2 3 0.125\n");
  EXPECT_EQ(extra_of<double>(behind, 0, "intensity"), 0.125);
  EXPECT_EQ(behind.points.colour[0][2], 771);
  const Cloud nine = read("c.txt", "1 2 3 10 20 30 0 -1 0\n");
  EXPECT_EQ(nine.points.colour[0][0], 2570);
  EXPECT_EQ(nine.points.normal[0], Vec3f(0, -1, 0));
}

TEST_F(Text, IntensityBesideColoursAndNormalsIsFoundInAnyOrder) {
  for (const char* row : {"1 2 3 -40 10 20 30 0 -1 0", "1 2 3 10 20 30 -40 0 -1 0", "1 2 3 10 20 30 0 -1 0 -40", "1 2 3 0 -1 0 10 20 30 -40"}) {
    SCOPED_TRACE(row);
    const Cloud cloud = read("a.txt", std::string(row) + "\n" + row + "\n");
    ASSERT_TRUE(cloud.schema.has_colour && cloud.schema.has_normal);
    EXPECT_EQ(cloud.points.colour[1], (std::array<std::uint16_t, 3>{2570, 5140, 7710}));
    EXPECT_EQ(cloud.points.normal[1], Vec3f(0, -1, 0));
    EXPECT_EQ(extra_of<double>(cloud, 1, "intensity"), -40);
  }
  const Cloud before = read("b.txt", "1 2 3 -40 0 -1 0\n"), behind = read("c.txt", "1 2 3 0 -1 0 -40\n");
  ASSERT_TRUE(before.schema.has_normal && behind.schema.has_normal);
  EXPECT_EQ(before.points.normal[0], Vec3f(0, -1, 0));
  EXPECT_EQ(extra_of<double>(before, 0, "intensity"), -40);
  EXPECT_EQ(behind.points.normal[0], Vec3f(0, -1, 0));
  EXPECT_EQ(extra_of<double>(behind, 0, "column_7"), -40);
}

TEST_F(Text, TheRangeOfColoursIsThatOfTheWholeFile) {
  std::string text;
  const auto lines = [&](int count, const char* line) {
    for (int i = 0; i < count; ++i) text += line;
  };
  lines(5000, "1 2 3 0 0 0\n");   // a scan that begins with points without colour
  lines(5000, "1 2 3 200 100 1\n");
  const Cloud eight = read("a.xyz", text);
  EXPECT_EQ(eight.points.colour.back(), (std::array<std::uint16_t, 3>{200 * 257, 100 * 257, 257}));
  EXPECT_FALSE(eight.schema.colour_is_16_bit);
  text = "x y z r g b\n";
  lines(5000, "1 2 3 0 20 100\n");
  lines(5000, "1 2 3 200 60000 1\n");
  const Cloud sixteen = read("b.xyz", text);
  EXPECT_EQ(sixteen.points.colour.front()[2], 100);
  EXPECT_EQ(sixteen.points.colour.back()[1], 60000);
  text = "ply\nformat ascii 1.0\nelement vertex 5000\nproperty float x\nproperty float y\nproperty float z\nproperty ushort red\nproperty ushort green\nproperty ushort blue\n"
         "element face 5000\nproperty list uchar int vertex_indices\nend_header\n";
  lines(5000, "1 2 3 7 8 200\n");
  lines(5000, "5 1 2 3 4 4000\n");   // faces, which have as many values as points here
  EXPECT_EQ(read("c.ply", text).points.colour.back()[2], 200 * 257);
}

TEST_F(Text, AHeaderLineNamesTheColumns) {
  for (const char* header : {"Z,Y,X,R,G,B,Nx,Ny,Nz,quality", "//Z Y X R G B Nx Ny Nz quality", "# z y x red green blue nx ny nz quality",
                             "\"z\";\"y\";\"x\";\"r\";\"g\";\"b\";\"nx\";\"ny\";\"nz\";\"quality\""}) {
    SCOPED_TRACE(header);
    const Cloud cloud = read("a.csv", std::string(header) + "\n3,2,1,0.5,0,1,0,0,1,17\n");
    ASSERT_EQ(cloud.points.size(), 1u);
    EXPECT_EQ(cloud.points.position[0], Vec3d(1, 2, 3));
    EXPECT_EQ(cloud.points.colour[0], (std::array<std::uint16_t, 3>{32768, 0, 65535}));
    EXPECT_EQ(cloud.points.normal[0], Vec3f(0, 0, 1));
    EXPECT_EQ(extra_of<double>(cloud, 0, "quality"), 17);
  }
}

TEST_F(Text, NumbersOfPointsAreNoCoordinates) {
  std::string three, four;
  for (int i = 1; i <= 100; ++i) {
    three += concat(i, " ", 0.5 * i, " 7\n");
    four += concat(i, " ", 0.5 * i, " 7 ", 0.25 * i, "\n");
  }
  EXPECT_THAT(error("a.txt", four), HasSubstr("line 1: the first column counts the points"));
  const Cloud named = read("b.txt", "number x y z\n" + four);
  EXPECT_EQ(named.points.position[1], Vec3d(1, 7, 0.5));
  EXPECT_EQ(extra_of<double>(named, 1, "number"), 2);
  EXPECT_EQ(read("c.txt", three).points.position[1], Vec3d(2, 1, 7));   // there is nothing else that could be x
}

TEST_F(Text, LinesParsedSideBySideStayInOrderAndTheFirstBadOneIsReported) {
  std::string text;
  for (int i = 0; i < 20000; ++i) text += std::to_string(i) + " 1 " + std::to_string(i % 7) + "\n";
  const Cloud cloud = read("a.xyz", text);
  ASSERT_EQ(cloud.points.size(), 20000u);
  for (int i = 0; i < 20000; ++i) ASSERT_EQ(cloud.points.position[static_cast<std::size_t>(i)], Vec3d(i, 1, i % 7));
  std::string bad = text;
  bad.replace(bad.find("\n15000 ") + 1, 5, "1500x");
  bad.replace(bad.find("\n9000 ") + 1, 4, "900x");
  try {
    read("bad.xyz", bad);
    FAIL();
  } catch (const Error& e) {
    EXPECT_NE(std::string(e.what()).find("line 9001: '900x'"), std::string::npos) << e.what();
  }
}

TEST_F(Text, ManyDigitsNeedDoubles) {
  EXPECT_TRUE(read("a.xyz", "289814.15 4320978.61 170.76\n").schema.position_is_double);
  EXPECT_EQ(read("a.xyz", "289814.15 4320978.61 170.76\n").points.position[0].y(), 4320978.61);
}

TEST_F(Text, NotANumberIsAPosition) {
  const Cloud cloud = read("a.xyz", "nan NaN -inf\n1.#QNAN 1e999 1e-999\n");
  EXPECT_TRUE(std::isnan(cloud.points.position[0].x()) && std::isnan(cloud.points.position[0].y()));
  EXPECT_EQ(cloud.points.position[0].z(), -INFINITY);
  EXPECT_TRUE(std::isnan(cloud.points.position[1].x()));
  EXPECT_EQ(cloud.points.position[1].y(), INFINITY);
  EXPECT_EQ(cloud.points.position[1].z(), 0);
}

TEST_F(Text, PtsCountsItsPointsAndMayHoldSeveralScans) {
  const Cloud one = read("a.pts", "2\n1 2 3 -1035 97 59 38\n1 2 3 5 1 2 3\n");
  EXPECT_EQ(one.schema.declared_points, 2u);
  EXPECT_EQ(extra_of<double>(one, 0, "intensity"), -1035);
  EXPECT_EQ(one.points.colour[0][0], 97 * 257);
  EXPECT_EQ(read("b.pts", "1\r\n1 2 3\r\n2\r\n4 5 6\r\n7 8 9\r\n").points.size(), 3u);
  EXPECT_THAT(error("c.pts", "3\n1 2 3\n4 5 6\n"), HasSubstr("2 of 3 points"));
  EXPECT_EQ(read("d.pts", "1\n1 2 3\n4 5 6\n").points.size(), 2u);  // programs do miscount
  EXPECT_THAT(error("e.pts", "5000000\n1 2 3\n4 5 6\n"), HasSubstr("line 1"));
}

TEST_F(Text, ErrorsNameTheLine) {
  EXPECT_THAT(error("a.xyz", "1,5 2,5 3,5\n"), HasSubstr("line 1: decimal commas"));
  EXPECT_THAT(error("b.csv", "x;y;z\n1;2;3\n1;2,5;3\n"), HasSubstr("line 3: decimal commas"));
  EXPECT_THAT(error("c.xyz", "1 2 3\n1 2\n"), HasSubstr("line 2: 2 values, expected 3"));
  EXPECT_THAT(error("d.xyz", "1 2 3\n1 b 3\n"), HasSubstr("line 2: 'b' is not a number"));
  EXPECT_THAT(error("e.csv", "1,2,3\n1,,3\n"), HasSubstr("line 2: '' is not a number (column 2"));
  EXPECT_THAT(error("f.xyz", "1 2\n"), HasSubstr("line 1: 2 values, expected 3"));
  EXPECT_THAT(error("g.xyz", "hello world\n1 2 3\n"), HasSubstr("names of columns with x, y and z"));
  EXPECT_THAT(error("h.csv", "x,y,z,w\n1,2,3\n"), HasSubstr("line 1 names 4 columns"));
  EXPECT_THAT(error("i.txt", "# nothing\n\n"), HasSubstr("holds no points"));
  EXPECT_THAT(error("j.xyz", "1 2 3\n" + std::string(3 << 20, '7') + "\n"), HasSubstr("line 2 (byte 6) is longer than"));
  EXPECT_THAT(error("k.bin", "1 2 3\n"), HasSubstr("unknown point cloud format"));
  EXPECT_THAT(error("l.xyz", ""), HasSubstr("empty"));
  EXPECT_THAT(error_of([&] { open_points(folder_.path() / "missing.xyz"); }), HasSubstr("missing.xyz"));
  EXPECT_THAT(error_of([&] { open_points(folder_.path()); }), HasSubstr("folder"));
}

TEST_F(Text, LinesAcrossTheBufferBorderAreWhole) {
  std::string content;
  const int count = 200000;  // some 3 MB
  for (int i = 0; i < count; ++i) content += std::to_string(i) + " " + std::to_string(2 * i) + ".5 1\n";
  const Cloud cloud = read_all(make("a.xyz", content), 777);
  ASSERT_EQ(cloud.points.size(), static_cast<std::size_t>(count));
  for (int i = 0; i < count; ++i) ASSERT_EQ(cloud.points.position[static_cast<std::size_t>(i)], Vec3d(i, 2 * i + 0.5, 1));
}

}  // namespace
}  // namespace chiaro::stream
