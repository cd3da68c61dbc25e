#include <gmock/gmock.h>

#include <cmath>

#include "cloud_test_support.h"

namespace chiaro::stream {

std::string make_las(int minor, int format, const std::vector<std::string>& records) {
  const std::size_t header_bytes = minor == 4 ? 375 : minor == 3 ? 235 : 227;
  std::string file(header_bytes, '\0');
  const auto put = [&file](std::size_t at, const std::string& bytes) { file.replace(at, bytes.size(), bytes); };
  const auto count = static_cast<std::uint32_t>(records.size());
  put(0, "LASF");
  put(24, bytes_of(std::uint8_t{1}, static_cast<std::uint8_t>(minor)));
  put(94, bytes_of(static_cast<std::uint16_t>(header_bytes), static_cast<std::uint32_t>(header_bytes), std::uint32_t{0},
                   static_cast<std::uint8_t>(format), static_cast<std::uint16_t>(records[0].size())));
  put(107, bytes_of(minor == 4 && format >= 6 ? std::uint32_t{0} : count));
  put(131, bytes_of(0.01, 0.01, 0.01, 100.0, 0.0, -5.0));
  if (minor == 4) put(247, bytes_of(std::uint64_t{count}));
  for (const std::string& record : records) file += record;
  return file;
}

namespace {

using ::testing::HasSubstr;

class Las : public CloudFiles {};

constexpr std::size_t kRecordBytes[] = {20, 28, 26, 34, 57, 63, 30, 36, 38, 59, 67};

std::string record_of(int format, std::int32_t x) {
  std::string record(kRecordBytes[format], '\0');
  record.replace(0, 14, bytes_of(x, std::int32_t{-250}, std::int32_t{7}, std::uint16_t{500}));
  if (format < 6) {
    record[14] = static_cast<char>(0b01010011);  // return 3 of 2 (bits as they are), scan direction 1, edge 0
    record[15] = static_cast<char>(0b10100110);  // class 6, flags 5
    record[16] = -12;
    record[17] = 9;
    record.replace(18, 2, bytes_of(std::uint16_t{77}));
  } else {
    record[14] = static_cast<char>(0x53);        // return 3 of 5
    record[15] = static_cast<char>(0b10011010);  // flags 10, channel 1, scan 0, edge 1
    record[16] = static_cast<char>(200);
    record[17] = 9;
    record.replace(18, 4, bytes_of(std::int16_t{-2000}, std::uint16_t{77}));
  }
  constexpr int kTime[] = {0, 20, 0, 20, 20, 20, 22, 22, 22, 22, 22}, kColour[] = {0, 0, 20, 28, 0, 28, 0, 30, 30, 0, 30};
  if (kTime[format]) record.replace(kTime[format], 8, bytes_of(1234.5));
  if (kColour[format]) record.replace(kColour[format], 6, bytes_of(std::uint16_t{1}, std::uint16_t{2}, std::uint16_t{60000}));
  return record;
}

TEST_F(Las, EveryPointFormatGivesItsFields) {
  for (int format = 0; format <= 10; ++format) {
    SCOPED_TRACE(format);
    const int minor = format <= 3 ? 2 : format <= 5 ? 3 : 4;
    const Cloud cloud = read("a.las", make_las(minor, format, {record_of(format, 1000), record_of(format, -1000)}));
    ASSERT_EQ(cloud.points.size(), 2u);
    EXPECT_NEAR(cloud.points.position[0].x(), 110, 1e-12);
    EXPECT_NEAR(cloud.points.position[1].x(), 90, 1e-12);
    EXPECT_NEAR(cloud.points.position[0].y(), -2.5, 1e-12);
    EXPECT_NEAR(cloud.points.position[0].z(), -4.93, 1e-12);
    EXPECT_EQ(extra_of<std::uint16_t>(cloud, 1, "intensity"), 500);
    EXPECT_EQ(extra_of<std::uint8_t>(cloud, 1, "return_number"), 3);
    EXPECT_EQ(extra_of<std::uint8_t>(cloud, 1, "number_of_returns"), format < 6 ? 2 : 5);
    EXPECT_EQ(extra_of<std::uint8_t>(cloud, 1, "scan_direction"), format < 6 ? 1 : 0);
    EXPECT_EQ(extra_of<std::uint8_t>(cloud, 1, "edge_of_flight_line"), format < 6 ? 0 : 1);
    EXPECT_EQ(extra_of<std::uint8_t>(cloud, 1, "classification"), format < 6 ? 6 : 200);
    EXPECT_EQ(extra_of<std::uint8_t>(cloud, 1, "classification_flags"), format < 6 ? 5 : 10);
    EXPECT_EQ(extra_of<std::uint8_t>(cloud, 1, "user_data"), 9);
    EXPECT_EQ(extra_of<std::uint16_t>(cloud, 1, "point_source_id"), 77);
    if (format < 6) {
      EXPECT_EQ(extra_of<std::int8_t>(cloud, 1, "scan_angle_rank"), -12);
    } else {
      EXPECT_EQ(extra_of<std::int16_t>(cloud, 1, "scan_angle"), -2000);
    }
    if (format != 0 && format != 2) {
      EXPECT_EQ(extra_of<double>(cloud, 1, "gps_time"), 1234.5);
    }
    const bool coloured = format == 2 || format == 3 || format == 5 || format == 7 || format == 8 || format == 10;
    ASSERT_EQ(cloud.schema.has_colour, coloured);
    if (coloured) {
      EXPECT_EQ(cloud.points.colour[0], (std::array<std::uint16_t, 3>{1, 2, 60000}));
    }
  }
}

TEST_F(Las, ColoursOfEightBitsInSixteenBitFieldsAreScaled) {
  std::string record = record_of(2, 0);
  record.replace(24, 2, bytes_of(std::uint16_t{255}));
  const Cloud cloud = read("a.las", make_las(2, 2, {record}));
  EXPECT_EQ(cloud.points.colour[0], (std::array<std::uint16_t, 3>{257, 514, 65535}));
  EXPECT_FALSE(cloud.schema.colour_is_16_bit);
}

TEST_F(Las, ColoursOfEightBitsInTheUpperBytesAreWhatTheyWere) {
  std::string record = record_of(2, 0);
  record.replace(20, 6, bytes_of(static_cast<std::uint16_t>(255 << 8), static_cast<std::uint16_t>(247 << 8), std::uint16_t{0}));
  const Cloud cloud = read("a.las", make_las(2, 2, {record}));
  EXPECT_EQ(cloud.points.colour[0], (std::array<std::uint16_t, 3>{65535, 247 * 257, 0}));   // not 65280: white stays white
  EXPECT_FALSE(cloud.schema.colour_is_16_bit);
}

TEST_F(Las, UndescribedExtraBytesAreCarried) {
  const Cloud cloud = read("a.las", make_las(2, 0, {record_of(0, 0) + "\x05\x06"}));
  EXPECT_EQ(extra_of<std::uint8_t>(cloud, 0, "extra_byte_1"), 6);
}

TEST_F(Las, ErrorsNameOffsetExpectedAndFound) {
  const std::string good = make_las(2, 3, {record_of(3, 0), record_of(3, 1)});
  const auto changed = [&](std::size_t at, const std::string& bytes) { return std::string(good).replace(at, bytes.size(), bytes); };
  EXPECT_THAT(error("a.las", good.substr(0, good.size() - 1)),
              HasSubstr("declares 2 points of 34 bytes from offset 227, the file holds 1 (294 bytes)"));
  EXPECT_THAT(error("b.las", changed(104, "\x83")), HasSubstr("compressed"));
  EXPECT_THAT(error("c.las", changed(104, "\x0b")), HasSubstr("offset 104: point format 11, expected 0 to 10"));
  EXPECT_THAT(error("d.las", changed(105, bytes_of(std::uint16_t{33}))), HasSubstr("records of 33 bytes, point format 3 needs 34"));
  EXPECT_THAT(error("e.las", changed(131, bytes_of(0.0))), HasSubstr("scale 0"));
  EXPECT_THAT(error("f.las", changed(155, bytes_of(std::nan("")))), HasSubstr("offset nan"));
  EXPECT_THAT(error("g.las", changed(96, bytes_of(std::uint32_t{1 << 30}))), HasSubstr("points start at 1073741824"));
  EXPECT_THAT(error("h.las", changed(100, bytes_of(std::uint32_t{5}))), HasSubstr("variable length record 1 of 5"));
  EXPECT_THAT(error("i.las", changed(107, bytes_of(std::uint32_t{0}))), HasSubstr("declares no points although the file has room for 2"));
  EXPECT_THAT(error("j.las", changed(107, bytes_of(std::uint32_t{0xffffffff}))), HasSubstr("declares 4294967295 points"));
  EXPECT_THAT(error("k.las", changed(25, "\x05")), HasSubstr("LAS version 1.5"));
  EXPECT_THAT(error("l.las", good.substr(0, 200)), HasSubstr("expected 227 bytes or more, found 200"));
}

PointWriterOptions export_options() {
  PointWriterOptions options;
  options.num_points = 2;
  options.properties = {{"x", ScalarType::kF64},
                        {"y", ScalarType::kF64},
                        {"z", ScalarType::kF64},
                        {"nx", ScalarType::kF32},
                        {"ny", ScalarType::kF32},
                        {"nz", ScalarType::kF32},
                        {"red", ScalarType::kU8},
                        {"green", ScalarType::kU8},
                        {"blue", ScalarType::kU8},
                        {"albedo_r", ScalarType::kF32},
                        {"albedo_g", ScalarType::kF32},
                        {"albedo_b", ScalarType::kF32},
                        {"sigma", ScalarType::kF32},
                        {"photos", ScalarType::kU16},
                        {"intensity", ScalarType::kU16},
                        {"classification", ScalarType::kU8},
                        {"gps_time", ScalarType::kF64},
                        {"return_number", ScalarType::kU8},
                        {"number_of_returns", ScalarType::kU8}};
  options.bounds.extend(Vec3d(500000.123, -4, 10));
  options.bounds.extend(Vec3d(500100.123, 4, 10));
  options.resolution = 0.0005;
  return options;
}

std::string export_row(double x, int i) {
  const auto f = static_cast<float>(i);
  return bytes_of(x, i ? 4.0 : -4.0, 10.0, 0.f, 0.6f, 0.8f) + "\x01\x80\xff" +
         bytes_of(0.25f, 0.5f, std::nanf(""), 0.02f + f, static_cast<std::uint16_t>(i), std::uint16_t{65000}) + "\x07" + bytes_of(99.5) +
         "\x02\x03";
}

TEST_F(Las, WriterReadsBackWithinHalfAStepAndKeepsTheRestInExtraBytes) {
  const fs::path path = folder_.path() / "w.las";
  auto writer = create_points(path, export_options());
  const std::string rows = export_row(500000.123, 0) + export_row(500100.123, 1);
  writer->write(reinterpret_cast<const std::byte*>(rows.data()), 2);
  writer->commit();
  const Cloud cloud = read_all(path);
  ASSERT_EQ(cloud.points.size(), 2u);
  EXPECT_TRUE(cloud.schema.position_is_double);
  const double tolerance = 0.5 * 0.0005 + 1e-9;  // half a step and the rounding of half a million metres
  EXPECT_NEAR(cloud.points.position[0].x(), 500000.123, tolerance);
  EXPECT_NEAR(cloud.points.position[1].x(), 500100.123, tolerance);
  EXPECT_NEAR(cloud.points.position[1].y(), 4, tolerance);
  ASSERT_TRUE(cloud.schema.has_normal);
  EXPECT_EQ(cloud.points.normal[1], Vec3f(0, 0.6f, 0.8f));
  EXPECT_EQ(cloud.points.colour[0], (std::array<std::uint16_t, 3>{257, 128 * 257, 65535}));
  EXPECT_EQ(extra_of<float>(cloud, 1, "albedo_g"), 0.5f);
  EXPECT_TRUE(std::isnan(extra_of<float>(cloud, 1, "albedo_b")));
  EXPECT_EQ(extra_of<float>(cloud, 1, "sigma"), 1.02f);
  EXPECT_EQ(extra_of<std::uint16_t>(cloud, 1, "photos"), 1);
  EXPECT_EQ(extra_of<std::uint16_t>(cloud, 1, "intensity"), 65000);
  EXPECT_EQ(extra_of<std::uint8_t>(cloud, 1, "classification"), 7);
  EXPECT_EQ(extra_of<double>(cloud, 1, "gps_time"), 99.5);
  EXPECT_EQ(extra_of<std::uint8_t>(cloud, 1, "return_number"), 2);
  EXPECT_EQ(extra_of<std::uint8_t>(cloud, 1, "number_of_returns"), 3);
}

TEST_F(Las, WriterFillsTheHeaderAsTheSpecificationAsks) {
  const fs::path path = folder_.path() / "w.las";
  auto writer = create_points(path, export_options());
  const std::string rows = export_row(500000.123, 0) + export_row(500100.123, 1);
  writer->write(reinterpret_cast<const std::byte*>(rows.data()), 2);
  writer->commit();
  const std::string file = read_text(path);
  const auto u16 = [&](std::size_t at) {
    std::uint16_t v;
    std::memcpy(&v, file.data() + at, 2);
    return v;
  };
  const auto u32 = [&](std::size_t at) {
    std::uint32_t v;
    std::memcpy(&v, file.data() + at, 4);
    return v;
  };
  const auto f64 = [&](std::size_t at) {
    double v;
    std::memcpy(&v, file.data() + at, 8);
    return v;
  };
  EXPECT_EQ(file.substr(0, 4), "LASF");
  EXPECT_EQ(u16(6), 16);  // WKT bit
  EXPECT_EQ(file.substr(24, 2), "\x01\x04");
  EXPECT_EQ(u16(94), 375);
  const std::size_t num_extras = 8;  // normal, albedo, sigma, photos
  EXPECT_EQ(u32(96), 375 + 54 + num_extras * 192);
  EXPECT_EQ(u32(100), 1u);
  EXPECT_EQ(file[104], 7);
  EXPECT_EQ(u16(105), 36 + 7 * 4 + 2);
  EXPECT_EQ(u32(107), 0u);  // the older count stays 0 for point formats 6 and up
  EXPECT_NEAR(f64(179), 500100.123, 0.0003);
  EXPECT_NEAR(f64(187), 500000.123, 0.0003);
  EXPECT_EQ(u32(247), 2u);
  EXPECT_EQ(u32(255), 0u);
  EXPECT_EQ(u32(263), 2u);  // both are second returns
  EXPECT_EQ(file.substr(375 + 2, 9), "LASF_Spec");
  EXPECT_EQ(file.substr(375 + 54 + 4, 3), std::string("nx\0", 3));
  EXPECT_EQ(file[375 + 54 + 2], 9);            // float
  EXPECT_EQ(file[375 + 54 + 7 * 192 + 2], 3);  // unsigned short
  EXPECT_EQ(file.size(), u32(96) + 2u * u16(105));
}

TEST_F(Las, WriterRefusesPointsOutsideItsBounds) {
  auto writer = create_points(folder_.path() / "w.las", export_options());
  const std::string far = export_row(9e9, 0), nowhere = export_row(std::nan(""), 0);
  EXPECT_THAT(error_of([&] { writer->write(reinterpret_cast<const std::byte*>(far.data()), 1); }), HasSubstr("coordinate x = 9e+09"));
  EXPECT_THAT(error_of([&] { writer->write(reinterpret_cast<const std::byte*>(nowhere.data()), 1); }), HasSubstr("not a number"));
}

TEST_F(Las, WithoutAResolutionPositionsKeepTheDigitsOfTheirExtent) {
  PointWriterOptions options = export_options();
  options.resolution.reset();
  options.bounds = {};
  options.bounds.extend(Vec3d(500000.123, -4, 10));
  options.bounds.extend(Vec3d(500000.523, 4, 10));   // an object of eight metres, by its survey's coordinates
  const fs::path path = folder_.path() / "w.las";
  auto writer = create_points(path, options);
  const std::string rows = export_row(500000.12345678, 0) + export_row(500000.5000001, 1);
  writer->write(reinterpret_cast<const std::byte*>(rows.data()), 2);
  writer->commit();
  const double tolerance = 0.5e-8 + 1e-9;   // 8 / 2^31 is 3.7e-9: steps of 1e-8
  const Cloud cloud = read_all(path);
  EXPECT_NEAR(cloud.points.position[0].x(), 500000.12345678, tolerance);
  EXPECT_NEAR(cloud.points.position[1].x(), 500000.5000001, tolerance);
  double scale = 0;
  std::memcpy(&scale, read_text(path).data() + 131, sizeof scale);
  EXPECT_DOUBLE_EQ(scale, 1e-8);
}

TEST_F(Las, TheCoordinateSystemIsCarried) {
  PointWriterOptions options = export_options();
  options.num_points = 1;
  options.coordinate_system = "PROJCS[\"WGS 84 / UTM zone 32N\",GEOGCS[]]";
  const fs::path path = folder_.path() / "w.las";
  auto writer = create_points(path, options);
  const std::string row = export_row(500000.123, 0);
  writer->write(reinterpret_cast<const std::byte*>(row.data()), 1);
  writer->commit();
  const Cloud cloud = read_all(path);
  EXPECT_EQ(cloud.schema.coordinate_system, options.coordinate_system);
  EXPECT_EQ(extra_of<std::uint16_t>(cloud, 0, "photos"), 0);   // and extra bytes are found behind it
  EXPECT_EQ(extra_of<float>(cloud, 0, "sigma"), 0.02f);
}

TEST_F(Las, ExtraBytesDoNotRepeatNamesOfTheFixedPart) {
  PointWriterOptions options = export_options();
  options.num_points = 1;
  const std::string longest = "the_same_name_of_thirty_bytes_";   // and two more that tell them apart, then more than fit
  options.properties = {{"x", ScalarType::kF64}, {"y", ScalarType::kF64}, {"z", ScalarType::kF64}, {"intensity", ScalarType::kF32}, {"Classification", ScalarType::kI32}, {"point_source_id", ScalarType::kU16},
                        {longest + "ab_one", ScalarType::kU8}, {longest + "ab_two", ScalarType::kU8}};
  const fs::path path = folder_.path() / "w.las";
  auto writer = create_points(path, options);
  const std::string row = bytes_of(500000.123, -4.0, 10.0, -2048.5f, std::int32_t{-7}, std::uint16_t{5}, std::uint8_t{8}, std::uint8_t{9});
  writer->write(reinterpret_cast<const std::byte*>(row.data()), 1);
  writer->commit();
  const std::string file = read_text(path);
  std::vector<std::string> names;
  for (std::size_t k = 0; k < 4; ++k) names.emplace_back(file.data() + 375 + 54 + 192 * k + 4, 32);
  for (std::string& name : names) name.resize(std::min(name.find('\0'), name.size()));
  EXPECT_THAT(names, ::testing::ElementsAre("input_intensity", "input_Classification", longest + "ab", longest + "_2"));
  const Cloud cloud = read_all(path);
  EXPECT_EQ(extra_of<float>(cloud, 0, "input_intensity"), -2048.5f);
  EXPECT_EQ(extra_of<std::int32_t>(cloud, 0, "input_Classification"), -7);
  EXPECT_EQ(extra_of<std::uint16_t>(cloud, 0, "point_source_id"), 5);
  EXPECT_EQ(extra_of<std::uint8_t>(cloud, 0, longest + "_2"), 9);
}

TEST_F(Las, AStepTooFineForTheExtentIsMadeCoarser) {
  PointWriterOptions options = export_options();
  options.resolution = 1e-12;
  const fs::path path = folder_.path() / "w.las";
  auto writer = create_points(path, options);
  const std::string rows = export_row(500000.123, 0) + export_row(500100.123, 1);
  writer->write(reinterpret_cast<const std::byte*>(rows.data()), 2);
  writer->commit();
  EXPECT_NEAR(read_all(path).points.position[1].x(), 500100.123, 100 / 4e9);
}

}  // namespace
}  // namespace chiaro::stream
