// The files in data/ were written by laspy and lazrs (make_files.py has the formulas of their points).
#include <gmock/gmock.h>

#include <algorithm>

#include "cloud_test_support.h"
#include "stream/base/parallel.h"
#include "stream/cloud/formats.h"
#include "stream/cloud/laz_rows.h"

namespace chiaro::stream {
namespace {

using ::testing::HasSubstr;

class Laz : public CloudFiles {
 protected:
  void SetUp() override {
    if (!CHIARO_HAS_RUST_FORMATS) GTEST_SKIP() << "built without cargo";
  }
  static fs::path data(const std::string& name) { return fs::path(CHIARO_SOURCE_DIR) / "tests/stream/cloud/data" / name; }
  static std::string bytes(const std::string& name) { return read_text(data(name)); }
  template <class T>
  static std::string with(std::string file, std::size_t at, T value) {
    return file.replace(at, sizeof value, bytes_of(value));
  }
  template <class T>
  static T number(const std::string& file, std::size_t at) {
    T value;
    std::memcpy(&value, file.data() + at, sizeof value);
    return value;
  }
  /// Where the content of the laszip record starts.
  static std::size_t laszip_record(const std::string& file) { return file.find("laszip encoded") - 2 + 54; }
};

void expect_point(const Cloud& cloud, int format, int i) {
  SCOPED_TRACE(i);
  const auto at = static_cast<std::size_t>(i);
  const Vec3d expected(100 + 0.01 * (1000 + 7 * i), 0.01 * (-250 + i * i % 1001), -5 + 0.01 * (i % 13));
  EXPECT_LT((cloud.points.position[at] - expected).norm(), 1e-9);
  EXPECT_EQ(extra_of<std::uint16_t>(cloud, at, "intensity"), 500 + i % 100);
  EXPECT_EQ(extra_of<std::uint8_t>(cloud, at, "return_number"), 1 + i % 3);
  EXPECT_EQ(extra_of<std::uint8_t>(cloud, at, "number_of_returns"), 3);
  EXPECT_EQ(extra_of<std::uint8_t>(cloud, at, "classification"), i % 7);
  EXPECT_EQ(extra_of<std::uint8_t>(cloud, at, "user_data"), i % 11);
  EXPECT_EQ(extra_of<std::uint16_t>(cloud, at, "point_source_id"), 77 + i % 2);
  if (format >= 6) {
    EXPECT_EQ(extra_of<std::int16_t>(cloud, at, "scan_angle"), -2000 + i % 50);
  } else {
    EXPECT_EQ(extra_of<std::int8_t>(cloud, at, "scan_angle_rank"), -12 + i % 5);
  }
  if (format != 0 && format != 2) {
    EXPECT_EQ(extra_of<double>(cloud, at, "gps_time"), 1234.5 + 0.25 * i);
  }
  const bool coloured = format == 2 || format == 3 || format == 5 || format == 7 || format == 8 || format == 10;
  ASSERT_EQ(cloud.schema.has_colour, coloured);
  if (coloured) {
    const auto red = static_cast<std::uint16_t>(60000 - i % 1000), green = static_cast<std::uint16_t>(2 + i % 50);
    EXPECT_EQ(cloud.points.colour[at], (std::array<std::uint16_t, 3>{red, green, 300}));
  }
  if (format == 8 || format == 10) {
    EXPECT_EQ(extra_of<std::uint16_t>(cloud, at, "nir"), 4 * i);
  }
  if (format == 4 || format == 5 || format >= 9) {
    EXPECT_EQ(extra_of<std::uint8_t>(cloud, at, "wave_descriptor"), i % 2);
    EXPECT_EQ(extra_of<std::uint32_t>(cloud, at, "wave_bytes"), 5u + static_cast<unsigned>(i) % 3u);
    EXPECT_EQ(extra_of<float>(cloud, at, "wave_dx"), 0.5f * static_cast<float>(i));
  }
}

TEST_F(Laz, EveryPointFormatGivesItsFields) {
  for (int format = 0; format <= 10; ++format) {
    SCOPED_TRACE(format);
    const Cloud cloud = read_all(data(concat("format_", format, ".laz")), 4);
    EXPECT_EQ(cloud.schema.declared_points, 9u);
    ASSERT_EQ(cloud.points.size(), 9u);
    for (int i = 0; i < 9; ++i) expect_point(cloud, format, i);
    if (format == 3 || format == 7) {
      EXPECT_EQ(extra_of<float>(cloud, 5, "amplitude"), 0.625f);
      EXPECT_EQ(extra_of<std::uint8_t>(cloud, 8, "pulse"), 3);
    }
  }
}

TEST_F(Laz, ChunksComeInFileOrderForAnyNumberOfThreads) {
  for (const int threads : {1, 8}) {
    const ThreadLimit limit(threads);
    const Cloud cloud = read_all(data("three_chunks.laz"), 7777);
    ASSERT_EQ(cloud.points.size(), 120'000u);
    for (std::size_t i = 0; i < cloud.points.size(); ++i) {
      const Vec3d expected(100 + 0.01 * 7 * static_cast<double>(i), 0.05, -5 + 0.01 * static_cast<double>(i / 40'000));
      ASSERT_LT((cloud.points.position[i] - expected).norm(), 1e-9) << i;
    }
  }
}

TEST_F(Laz, ChunksOfUnequalSizeAreRead) {
  const Cloud cloud = read_all(data("variable_chunks.laz"), 5);
  ASSERT_EQ(cloud.points.size(), 30u);
  for (int i = 0; i < 30; ++i) expect_point(cloud, 7, i);
}

TEST_F(Laz, PartsThatAreWantedDoNotDependOnTheOthers) {
  for (const char* name : {"format_2.laz", "format_7.laz", "format_10.laz"}) {
    SCOPED_TRACE(name);
    const Cloud all = read_all(data(name));
    for (const PointParts parts : {PointParts::kNoExtras, PointParts::kPositions}) {
      const auto reader = open_points(data(name));
      reader->wants(parts);
      PointBlock block;
      ASSERT_TRUE(reader->read(block, 100));
      EXPECT_EQ(block.position, all.points.position);
      if (parts == PointParts::kNoExtras) {
        EXPECT_EQ(block.colour, all.points.colour);
      }
    }
  }
}

TEST_F(Laz, LittleMemoryGivesTheSamePoints) {
  // Too little for whole chunks: each is streamed.
  for (const char* name : {"three_chunks.laz", "format_7.laz"})
    EXPECT_EQ(read_all(*open_points(data(name), 100'000), 3333).points.position, read_all(data(name)).points.position) << name;
}

TEST_F(Laz, AChunkBeyondTheMemoryIsRefused) {
  const std::string message = error_of([] { read_all(*open_points(data("variable_chunks.laz"), 16)); });
  EXPECT_THAT(message, HasSubstr("compressed bytes, 16 are allowed"));
}

TEST_F(Laz, DamagedHeadersAndTablesAreRefusedInWords) {
  const std::string file = bytes("three_chunks.laz");
  const auto points = number<std::uint32_t>(file, 96);
  const auto table = static_cast<std::size_t>(number<std::int64_t>(file, points));
  EXPECT_THAT(error("a.laz", with(file, laszip_record(file) - 54 + 18, std::uint16_t{7})), HasSubstr("no record 22204 of 'laszip encoded'"));
  EXPECT_THAT(error("b.laz", with(file, 107, std::uint32_t{4'000'000'000u})), HasSubstr("declares 3 chunks, expected 80000 (for 4000000000 points)"));
  EXPECT_THAT(error("c.laz", with(file, points, std::int64_t{1} << 62)), HasSubstr("the chunk table starts at 4611686018427387904"));
  EXPECT_THAT(error("d.laz", with(file, table + 4, std::uint32_t{0xffffffffu})), HasSubstr("declares 4294967295 chunks"));
  EXPECT_THAT(error("e.laz", file.substr(0, table)), HasSubstr("may be cut off"));
  EXPECT_THAT(error("f.laz", with(file, table + 8, std::uint64_t{0x0123456789abcdefu})), HasSubstr("chunk"));
  EXPECT_THAT(error("g.laz", with(file, laszip_record(file) + 34 + 2, std::uint16_t{19})), HasSubstr("laszip item 1 of 1"));
  EXPECT_THAT(error("h.laz", with(file, 107, std::uint32_t{0})), HasSubstr("declares no points"));
  EXPECT_THAT(error("i.laz", with(file, 131, 0.0)), HasSubstr("scale 0"));
  EXPECT_THAT(error("j.laz", with(file, 105, std::uint16_t{24})), HasSubstr("laszip items of 20 bytes, the header declares records of 24"));
  EXPECT_THAT(error("k.laz", with(file, laszip_record(file), std::uint16_t{3})), HasSubstr("do not belong together"));
}

TEST_F(Laz, ALayeredChunkCannotClaimMoreThanItHas) {
  const std::string file = bytes("format_7.laz");
  const std::size_t layers = number<std::uint32_t>(file, 96) + 8 + number<std::uint16_t>(file, 105) + 4;
  EXPECT_THAT(error("a.laz", with(file, layers, std::uint32_t{0xfffffff0u})), HasSubstr("the layers of the chunk have"));
  EXPECT_THAT(error("b.laz", with(file, 247, std::uint64_t{1} << 40)), HasSubstr("expected"));
}

TEST_F(Laz, TheTableMayBeNamedAtTheEndOfTheFile) {
  std::string file = bytes("format_3.laz");
  const auto points = number<std::uint32_t>(file, 96);
  const auto table = number<std::int64_t>(file, points);
  file = with(file, points, std::int64_t{-1}) + bytes_of(table);
  EXPECT_EQ(read("a.laz", file).points.size(), 9u);
}

TEST_F(Laz, FilesOfOtherProgramsEqualTheirLas) {
  const fs::path clouds = shared_folder() / "real" / "clouds";
  if (!fs::exists(clouds)) GTEST_SKIP() << "no shared/real/clouds beside the source folder (set CHIARO_SHARED)";
  EXPECT_EQ(read_all(clouds / "autzen_trim.laz", 65536).points.size(), 110'000u);
  EXPECT_EQ(read_all(clouds / "simple.laz").points.size(), 1065u);
  const Cloud las = read_all(clouds / "1.2-with-color.las"), copc = read_all(clouds / "1.2-with-color.copc.laz");
  ASSERT_EQ(copc.points.size(), las.points.size());
  const auto sorted = [](const Cloud& cloud) {  // COPC has an order of its own
    std::vector<std::array<double, 6>> rows;
    for (std::size_t i = 0; i < cloud.points.size(); ++i) {
      const Vec3d& p = cloud.points.position[i];
      rows.push_back({std::round(p.x() * 100), std::round(p.y() * 100), std::round(p.z() * 100), extra_of<double>(cloud, i, "gps_time"),
                      static_cast<double>(extra_of<std::uint16_t>(cloud, i, "intensity")), static_cast<double>(cloud.points.colour[i][1])});
    }
    std::sort(rows.begin(), rows.end());
    return rows;
  };
  EXPECT_EQ(sorted(copc), sorted(las));
}

TEST(WithoutRust, TheErrorNamesFileAndRemedy) {
  const std::string message = missing_rust_formats("scan.laz", "LAZ").what();
  EXPECT_THAT(message, HasSubstr("scan.laz: LAZ is not read by this build"));
  EXPECT_THAT(message, HasSubstr("cargo-web rustc-web"));
}

}  // namespace
}  // namespace chiaro::stream
