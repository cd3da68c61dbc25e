#include "stream/photo/image_io.h"

#include <ImfChannelList.h>
#include <ImfFrameBuffer.h>
#include <ImfHeader.h>
#include <ImfMultiPartOutputFile.h>
#include <ImfOutputPart.h>
#include <ImfPartType.h>
#include <jpeglib.h>
#include <png.h>
#include <tiffio.h>

#include <chrono>
#include <cmath>
#include <cstring>

#include "tests/stream/photo/photo_support.h"

namespace chiaro::stream {
namespace {
namespace fs = std::filesystem;

std::vector<float> ramp(int width, int height, int channels) {
  std::vector<float> values;
  for (int i = 0; i < width * height * channels; ++i) values.push_back(static_cast<float>(i % 251) / 255.0f);
  return values;
}

// ---- writers of small files by the libraries themselves, so that readers are not tested with our own writers only

struct TiffSpec {
  int width = 13, height = 9, samples = 3, bits = 8, format = SAMPLEFORMAT_UINT, planar = PLANARCONFIG_CONTIG, compression = COMPRESSION_NONE, photometric = PHOTOMETRIC_RGB, tile = 0;
  std::uint16_t orientation = ORIENTATION_TOPLEFT;
};

std::uint32_t code(const TiffSpec&, int x, int y, int c) { return static_cast<std::uint32_t>((x * 7 + y * 31 + c * 50) % 256); }

void put_sample(const TiffSpec& spec, std::vector<std::uint8_t>& row, std::size_t index, std::uint32_t value) {
  std::uint8_t* at = row.data() + index * static_cast<std::size_t>(spec.bits / 8);
  if (spec.bits == 8) {
    *at = static_cast<std::uint8_t>(value);
  } else if (spec.bits == 16) {
    const auto v = static_cast<std::uint16_t>(value * 257);
    std::memcpy(at, &v, 2);
  } else {
    const float v = static_cast<float>(value) * 0.5f;
    std::memcpy(at, &v, 4);
  }
}

void make_tiff(const fs::path& path, const TiffSpec& spec) {
  TIFF* tiff = TIFFOpen(path.c_str(), "w");
  TIFFSetField(tiff, TIFFTAG_IMAGEWIDTH, spec.width);
  TIFFSetField(tiff, TIFFTAG_IMAGELENGTH, spec.height);
  TIFFSetField(tiff, TIFFTAG_BITSPERSAMPLE, spec.bits);
  TIFFSetField(tiff, TIFFTAG_SAMPLESPERPIXEL, spec.samples);
  TIFFSetField(tiff, TIFFTAG_SAMPLEFORMAT, spec.format);
  TIFFSetField(tiff, TIFFTAG_PLANARCONFIG, spec.planar);
  TIFFSetField(tiff, TIFFTAG_COMPRESSION, spec.compression);
  TIFFSetField(tiff, TIFFTAG_PHOTOMETRIC, spec.photometric);
  TIFFSetField(tiff, TIFFTAG_ORIENTATION, spec.orientation);
  const bool planar = spec.planar == PLANARCONFIG_SEPARATE;
  const int planes = planar ? spec.samples : 1, inside = planar ? 1 : spec.samples;
  if (spec.tile > 0) {
    TIFFSetField(tiff, TIFFTAG_TILEWIDTH, spec.tile);
    TIFFSetField(tiff, TIFFTAG_TILELENGTH, spec.tile);
    std::vector<std::uint8_t> tile(static_cast<std::size_t>(spec.tile * spec.tile * inside * spec.bits / 8));
    for (int p = 0; p < planes; ++p)
      for (int y = 0; y < spec.height; y += spec.tile)
        for (int x = 0; x < spec.width; x += spec.tile) {
          for (int dy = 0; dy < spec.tile; ++dy)
            for (int dx = 0; dx < spec.tile; ++dx)
              for (int c = 0; c < inside; ++c) put_sample(spec, tile, static_cast<std::size_t>((dy * spec.tile + dx) * inside + c), code(spec, x + dx, y + dy, planar ? p : c));
          TIFFWriteTile(tiff, tile.data(), static_cast<std::uint32_t>(x), static_cast<std::uint32_t>(y), 0, static_cast<std::uint16_t>(p));
        }
  } else {
    TIFFSetField(tiff, TIFFTAG_ROWSPERSTRIP, 4);
    std::vector<std::uint8_t> row(static_cast<std::size_t>(spec.width * inside * spec.bits / 8));
    for (int p = 0; p < planes; ++p)
      for (int y = 0; y < spec.height; ++y) {
        for (int x = 0; x < spec.width; ++x)
          for (int c = 0; c < inside; ++c) put_sample(spec, row, static_cast<std::size_t>(x * inside + c), code(spec, x, y, planar ? p : c));
        TIFFWriteScanline(tiff, row.data(), static_cast<std::uint32_t>(y), static_cast<std::uint16_t>(p));
      }
  }
  TIFFClose(tiff);
}

std::vector<std::uint8_t> bytes_ramp(int count) {
  std::vector<std::uint8_t> values;
  for (int i = 0; i < count; ++i) values.push_back(static_cast<std::uint8_t>((i * 13) % 256));
  return values;
}

void make_jpeg(const fs::path& path, int width, int height, int channels, bool progressive, int quality = 95, const std::string& exif = {}) {
  jpeg_compress_struct jpeg{};
  jpeg_error_mgr errors{};
  jpeg.err = jpeg_std_error(&errors);
  jpeg_create_compress(&jpeg);
  std::FILE* file = std::fopen(path.c_str(), "wb");
  jpeg_stdio_dest(&jpeg, file);
  jpeg.image_width = static_cast<JDIMENSION>(width);
  jpeg.image_height = static_cast<JDIMENSION>(height);
  jpeg.input_components = channels;
  jpeg.in_color_space = channels == 1 ? JCS_GRAYSCALE : JCS_RGB;
  jpeg_set_defaults(&jpeg);
  jpeg_set_quality(&jpeg, quality, TRUE);
  if (progressive) jpeg_simple_progression(&jpeg);
  jpeg_start_compress(&jpeg, TRUE);
  if (!exif.empty()) jpeg_write_marker(&jpeg, JPEG_APP0 + 1, reinterpret_cast<const JOCTET*>(exif.data()), static_cast<unsigned>(exif.size()));
  std::vector<std::uint8_t> row(static_cast<std::size_t>(width * channels));
  for (int y = 0; y < height; ++y) {
    for (int x = 0; x < width; ++x)
      for (int c = 0; c < channels; ++c) row[static_cast<std::size_t>(x * channels + c)] = static_cast<std::uint8_t>((40 + 4 * x + 3 * y + 20 * c) % 256);
    JSAMPROW pointer = row.data();
    jpeg_write_scanlines(&jpeg, &pointer, 1);
  }
  jpeg_finish_compress(&jpeg);
  jpeg_destroy_compress(&jpeg);
  std::fclose(file);
}

/// PNG of any type by libpng; interlaced where asked.
void make_png(const fs::path& path, int width, int height, int type, int depth, bool interlaced, double gamma = 0) {
  std::FILE* file = std::fopen(path.c_str(), "wb");
  png_structp png = png_create_write_struct(PNG_LIBPNG_VER_STRING, nullptr, nullptr, nullptr);
  png_infop info = png_create_info_struct(png);
  png_init_io(png, file);
  png_set_IHDR(png, info, static_cast<png_uint_32>(width), static_cast<png_uint_32>(height), depth, type, interlaced ? PNG_INTERLACE_ADAM7 : PNG_INTERLACE_NONE,
               PNG_COMPRESSION_TYPE_DEFAULT, PNG_FILTER_TYPE_DEFAULT);
  if (type == PNG_COLOR_TYPE_PALETTE) {
    const png_color palette[4] = {{0, 0, 0}, {255, 0, 0}, {0, 255, 0}, {10, 20, 30}};
    png_set_PLTE(png, info, palette, 4);
  }
  if (gamma > 0) png_set_gAMA(png, info, gamma);
  png_write_info(png, info);
  const std::size_t row_bytes = png_get_rowbytes(png, info);
  std::vector<png_byte> all(row_bytes * static_cast<std::size_t>(height));
  for (std::size_t i = 0; i < all.size(); ++i) all[i] = static_cast<png_byte>(type == PNG_COLOR_TYPE_PALETTE ? i % 4 : i * 3);
  std::vector<png_bytep> rows;
  for (int y = 0; y < height; ++y) rows.push_back(all.data() + static_cast<std::size_t>(y) * row_bytes);
  png_write_image(png, rows.data());
  png_write_end(png, nullptr);
  png_destroy_write_struct(&png, &info);
  std::fclose(file);
}

// ---- EXR

TEST(Exr, FloatRoundTripsExactlyAndHalfToItsPrecision) {
  ScratchFolder scratch;
  std::vector<float> values = ramp(37, 50, 3);
  values[0] = -1.5f;
  values[1] = 1e9f;
  values[2] = std::nanf("");
  write_exr(scratch.path() / "a.exr", 37, 50, {"R", "G", "B"}, values, false);
  write_exr(scratch.path() / "b.exr", 37, 50, {"R", "G", "B"}, values, true);
  const Image exact = read_image(scratch.path() / "a.exr"), half = read_image(scratch.path() / "b.exr");
  ASSERT_EQ(exact.values.size(), values.size());
  EXPECT_EQ(std::memcmp(exact.values.data(), values.data(), values.size() * sizeof(float)), 0);
  EXPECT_EQ(half.values[0], -1.5f);
  EXPECT_EQ(half.values[1], 65504.0f);
  EXPECT_TRUE(std::isnan(half.values[2]));
  for (std::size_t i = 3; i < values.size(); ++i) EXPECT_NEAR(half.values[i], values[i], values[i] / 2048 + 1e-7);
  EXPECT_FALSE(fs::exists(scratch.path() / "a.exr.part"));
}

TEST(Exr, SameValuesGiveTheSameBytesWhateverTheBands) {
  ScratchFolder scratch;
  const std::vector<float> values = ramp(20, 100, 4);
  write_exr(scratch.path() / "a.exr", 20, 100, {"R", "G", "B", "A"}, values, true);
  ExrWriter writer(scratch.path() / "b.exr", 20, 100, {"R", "G", "B", "A"}, true);
  for (int y = 0; y < 100; y += 10) writer.write_rows(10, std::span(values).subspan(static_cast<std::size_t>(y * 80), 800));
  writer.commit();
  EXPECT_EQ(file_bytes(scratch.path() / "a.exr"), file_bytes(scratch.path() / "b.exr"));
}

TEST(Exr, LeavesNothingBehindWithoutCommit) {
  ScratchFolder scratch;
  { ExrWriter writer(scratch.path() / "a.exr", 4, 4, {"Y"}, false); }
  EXPECT_TRUE(fs::is_empty(scratch.path()));
  EXPECT_NE(error_of([&] { ExrWriter writer(scratch.path() / "no/a.exr", 4, 4, {"Y"}, false); }), "");
}

TEST(Exr, ReadsChannelsByNameInAnyOrder) {
  ScratchFolder scratch;
  const fs::path path = scratch.path() / "a.exr";
  const std::vector<float> first = {1, 2, 3, 4, 5, 6}, second = {10, 20, 30, 40, 50, 60};
  write_exr_planes(path, 3, 2, {"direct", "ambient"}, {first, second}, false);
  EXPECT_EQ(exr_channel_names(path), (std::vector<std::string>{"ambient", "direct"}));
  const Image image = read_exr_channels(path, {"direct", "ambient"});
  EXPECT_EQ(image.values, (std::vector<float>{1, 10, 2, 20, 3, 30, 4, 40, 5, 50, 6, 60}));
  EXPECT_NE(error_of([&] { read_exr_channels(path, {"depth"}); }).find("has no channel \"depth\", found ambient, direct"), std::string::npos);
  EXPECT_NE(error_of([&] { read_image(path); }).find("no channels R, G, B"), std::string::npos);
}

TEST(Exr, ADepthIsNoPhotographAndOneChannelIsGreyWithANote) {
  ScratchFolder scratch;
  const fs::path path = scratch.path() / "a.exr";
  const std::vector<float> values = {1, 2, 3, 4, 5, 6};
  for (const char* name : {"Z", "ViewLayer.Depth"}) {
    write_exr_planes(path, 3, 2, {name}, {values}, false);
    EXPECT_NE(error_of([&] { read_image(path); }).find("alone, which is a depth"), std::string::npos) << name;
  }
  write_exr_planes(path, 3, 2, {"X", "Y", "Z"}, {values, values, values}, false);
  EXPECT_NE(error_of([&] { read_image(path); }).find("X, Y, Z are not supported"), std::string::npos);
  write_exr_planes(path, 3, 2, {"grey"}, {values}, false);
  ASSERT_EQ(ImageSource(path).info().notes.size(), 1u);
  EXPECT_EQ(ImageSource(path).info().notes.front(), "its only channel, \"grey\", is taken as grey");
  write_exr_planes(path, 3, 2, {"Y"}, {values}, false);
  EXPECT_TRUE(ImageSource(path).info().notes.empty());
}

TEST(Exr, OfSeveralPartsTheFirstIsTakenWithANote) {
  ScratchFolder scratch;
  const fs::path path = scratch.path() / "a.exr";
  std::vector<Imf::Header> headers;
  for (const char* name : {"colour", "again"}) {
    Imf::Header header(2, 1);
    header.setName(name);
    header.setType(Imf::SCANLINEIMAGE);
    for (const char* channel : {"R", "G", "B"}) header.channels().insert(channel, Imf::Channel(Imf::FLOAT));
    headers.push_back(header);
  }
  {
    Imf::MultiPartOutputFile file(path.c_str(), headers.data(), 2);
    for (int part = 0; part < 2; ++part) {
      std::vector<float> values(6, static_cast<float>(part + 1));
      Imf::OutputPart out(file, part);
      Imf::FrameBuffer frame;
      for (std::size_t c = 0; c < 3; ++c) frame.insert(std::string(1, "RGB"[c]), Imf::Slice(Imf::FLOAT, reinterpret_cast<char*>(values.data() + c), 3 * sizeof(float), 6 * sizeof(float)));
      out.setFrameBuffer(frame);
      out.writePixels(1);
    }
  }
  ImageSource source(path);
  ASSERT_EQ(source.info().notes.size(), 1u);
  EXPECT_EQ(source.info().notes.front(), "holds 2 parts; the first one is taken");
  EXPECT_EQ(read_image(path).values, std::vector<float>(6, 1.0f));
}

TEST(Png, AGammaOfOneSaysLinear) {
  ScratchFolder scratch;
  const fs::path path = scratch.path() / "a.png";
  write_png_srgb16(path, 2, 1, std::vector<std::uint16_t>{1, 2, 3, 4, 5, 6});   // with sRGB
  EXPECT_EQ(ImageSource(path).info().says_linear, false);
  make_png(path, 3, 2, PNG_COLOR_TYPE_RGB, 16, false);
  EXPECT_EQ(ImageSource(path).info().says_linear, std::nullopt);
  make_png(path, 3, 2, PNG_COLOR_TYPE_RGB, 16, false, 1.0);
  EXPECT_EQ(ImageSource(path).info().says_linear, true);
  make_png(path, 3, 2, PNG_COLOR_TYPE_RGB, 16, false, 0.45455);
  EXPECT_EQ(ImageSource(path).info().says_linear, false);
}

TEST(Exr, ReadsAnyBandInAnyOrder) {
  ScratchFolder scratch;
  const std::vector<float> values = ramp(11, 90, 3);
  write_exr(scratch.path() / "a.exr", 11, 90, {"R", "G", "B"}, values, false);
  ImageSource source(scratch.path() / "a.exr");
  std::vector<float> band(11 * 3 * 7);
  for (const int y : {83, 0, 40, 10}) {
    source.read_rows(y, 7, band.data());
    EXPECT_EQ(std::memcmp(band.data(), values.data() + y * 33, band.size() * sizeof(float)), 0) << y;
  }
  EXPECT_THROW(source.read_rows(84, 7, band.data()), std::invalid_argument);
}

// ---- PNG

TEST(Png, SixteenAndEightBitsRoundTrip) {
  ScratchFolder scratch;
  const std::vector<std::uint16_t> deep = {0, 65535, 256, 1, 2, 30000};
  write_png_srgb16(scratch.path() / "a.png", 2, 1, deep);
  const Image image = read_image(scratch.path() / "a.png");
  for (std::size_t i = 0; i < 6; ++i) EXPECT_FLOAT_EQ(image.values[i], static_cast<float>(deep[i]) / 65535.0f);
  const std::vector<std::uint8_t> grey = {0, 128, 255, 7};
  write_png_srgb8(scratch.path() / "b.png", 2, 2, grey, 1);
  const Image small = read_image(scratch.path() / "b.png");
  EXPECT_EQ(small.channels, 1);
  for (std::size_t i = 0; i < 4; ++i) EXPECT_FLOAT_EQ(small.values[i], static_cast<float>(grey[i]) / 255.0f);
}

TEST(Png, ReadsAllTypesInterlacedOrNot) {
  ScratchFolder scratch;
  const fs::path path = scratch.path() / "a.png";
  const struct {
    int type, depth, channels;
  } cases[] = {{PNG_COLOR_TYPE_GRAY, 8, 1},       {PNG_COLOR_TYPE_GRAY, 16, 1}, {PNG_COLOR_TYPE_GRAY, 1, 1},      {PNG_COLOR_TYPE_GRAY_ALPHA, 8, 2},
               {PNG_COLOR_TYPE_RGB_ALPHA, 16, 4}, {PNG_COLOR_TYPE_RGB, 8, 3},   {PNG_COLOR_TYPE_PALETTE, 8, 3}};
  for (const auto& c : cases) {
    make_png(path, 19, 17, c.type, c.depth, false);
    const Image plain = read_image(path);
    make_png(path, 19, 17, c.type, c.depth, true);
    const Image interlaced = read_image(path);
    EXPECT_EQ(plain.channels, c.channels) << c.type << " " << c.depth;
    EXPECT_EQ(plain.values, interlaced.values) << c.type << " " << c.depth;
  }
}

TEST(Png, GoesBackByReadingAgain) {
  ScratchFolder scratch;
  write_png_srgb8(scratch.path() / "a.png", 4, 30, bytes_ramp(360));
  ImageSource source(scratch.path() / "a.png");
  std::vector<float> row(12);
  for (const int y : {20, 5, 29, 0}) {
    source.read_rows(y, 1, row.data());
    EXPECT_FLOAT_EQ(row[0], static_cast<float>((y * 12 * 13) % 256) / 255.0f) << y;
  }
}

// ---- TIFF

TEST(Tiff, ReadsStripsTilesAndPlanesInAllSampleTypes) {
  ScratchFolder scratch;
  const fs::path path = scratch.path() / "a.tif";
  for (const int bits : {8, 16, 32})
    for (const int planar : {PLANARCONFIG_CONTIG, PLANARCONFIG_SEPARATE})
      for (const int compression : {COMPRESSION_NONE, COMPRESSION_LZW, COMPRESSION_ADOBE_DEFLATE})
        for (const int tile : {0, 16}) {
          TiffSpec spec;
          spec.bits = bits;
          spec.width = 21;
          spec.height = 35;
          spec.format = bits == 32 ? SAMPLEFORMAT_IEEEFP : SAMPLEFORMAT_UINT;
          spec.planar = planar;
          spec.compression = compression;
          spec.tile = tile;
          make_tiff(path, spec);
          const Image image = read_image(path);
          ASSERT_EQ(image.channels, 3);
          for (int y = 0; y < spec.height; ++y)
            for (int x = 0; x < spec.width; ++x)
              for (int c = 0; c < 3; ++c) {
                const double v = code(spec, x, y, c), expected = bits == 8 ? v / 255 : bits == 16 ? v * 257 / 65535 : v * 0.5;
                ASSERT_NEAR(image.at(x, y, c), expected, 1e-6) << bits << " " << planar << " " << compression << " " << tile << " at " << x << "," << y;
              }
        }
}

TEST(Tiff, GreyAlphaAndInvertedFilesAreUnderstood) {
  ScratchFolder scratch;
  const fs::path path = scratch.path() / "a.tif";
  TiffSpec grey;
  grey.samples = 1;
  grey.photometric = PHOTOMETRIC_MINISWHITE;
  make_tiff(path, grey);
  EXPECT_FLOAT_EQ(read_image(path).at(2, 0, 0), 1 - 14 / 255.0f);
  TiffSpec rgba;
  rgba.samples = 4;
  make_tiff(path, rgba);
  ImageSource source(path);
  EXPECT_EQ(source.channels(), 4);
  EXPECT_TRUE(source.info().has_alpha);
  TiffSpec palette;
  palette.samples = 1;
  palette.photometric = PHOTOMETRIC_CIELAB;
  make_tiff(path, palette);
  EXPECT_NE(error_of([&] { read_image(path); }).find("photometric interpretation 8"), std::string::npos);
}

TEST(Tiff, BlackAndWhiteIsReadWithEitherMeaningAndBitOrder) {
  ScratchFolder scratch;
  const fs::path path = scratch.path() / "a.tif";
  const int width = 19, height = 5;
  for (const int photometric : {PHOTOMETRIC_MINISBLACK, PHOTOMETRIC_MINISWHITE})
    for (const int compression : {COMPRESSION_NONE, COMPRESSION_CCITTFAX4})
      for (const int order : {FILLORDER_MSB2LSB, FILLORDER_LSB2MSB}) {
        TIFF* tiff = TIFFOpen(path.c_str(), "w");
        for (const auto& [tag, value] : {std::pair{TIFFTAG_IMAGEWIDTH, width}, {TIFFTAG_IMAGELENGTH, height}, {TIFFTAG_BITSPERSAMPLE, 1}, {TIFFTAG_SAMPLESPERPIXEL, 1}, {TIFFTAG_PHOTOMETRIC, photometric},
                                         {TIFFTAG_COMPRESSION, compression}, {TIFFTAG_FILLORDER, order}, {TIFFTAG_ROWSPERSTRIP, height}})
          TIFFSetField(tiff, static_cast<std::uint32_t>(tag), value);
        const auto is_set = [](int x, int y) { return (x * 5 + y * 3) % 7 < 3; };
        for (int y = 0; y < height; ++y) {
          std::vector<std::uint8_t> row((width + 7) / 8);
          for (int x = 0; x < width; ++x)
            if (is_set(x, y)) row[static_cast<std::size_t>(x / 8)] = static_cast<std::uint8_t>(row[static_cast<std::size_t>(x / 8)] | 0x80 >> x % 8);
          TIFFWriteScanline(tiff, row.data(), static_cast<std::uint32_t>(y), 0);
        }
        TIFFClose(tiff);
        const Image image = read_image(path);
        ASSERT_EQ(image.channels, 1);
        for (int y = 0; y < height; ++y)
          for (int x = 0; x < width; ++x) ASSERT_EQ(image.at(x, y, 0), is_set(x, y) == (photometric == PHOTOMETRIC_MINISBLACK) ? 1 : 0) << photometric << " " << compression << " " << order << " at " << x << "," << y;
      }
}

// ---- JPEG

TEST(Jpeg, ReadsBaselineAndProgressiveAlike) {
  ScratchFolder scratch;
  for (const int channels : {1, 3}) {
    make_jpeg(scratch.path() / "a.jpg", 45, 37, channels, false);
    make_jpeg(scratch.path() / "b.jpg", 45, 37, channels, true);
    const Image a = read_image(scratch.path() / "a.jpg"), b = read_image(scratch.path() / "b.jpg");
    EXPECT_EQ(a.channels, channels);
    EXPECT_EQ(a.values, b.values);
    EXPECT_NEAR(a.at(10, 10, 0), (40 + 40 + 30) / 255.0, 0.03);
  }
}

/// "Exif", a TIFF header, and a directory of a camera's maker and the orientation.
std::string exif_block(bool big, std::uint16_t orientation) {
  const auto number = [&](std::uint32_t v, int bytes) {
    std::string s;
    for (int k = 0; k < bytes; ++k) s += static_cast<char>(v >> 8 * (big ? bytes - 1 - k : k) & 0xff);
    return s;
  };
  std::string block = std::string("Exif\0\0", 6) + (big ? "MM" : "II") + number(42, 2) + number(8, 4) + number(2, 2);
  block += number(271, 2) + number(2, 2) + number(4, 4) + std::string("abc\0", 4);
  block += number(274, 2) + number(3, 2) + number(1, 4) + number(orientation, 2) + number(0, 2);
  return block + number(0, 4);
}

TEST(Jpeg, AnOrientationTagIsNotedAndPixelsStay) {
  const ScratchFolder folder;
  const fs::path plain = folder.path() / "plain.jpg", turned = folder.path() / "turned.jpg";
  make_jpeg(plain, 24, 16, 3, false);
  for (const bool big : {false, true}) {
    make_jpeg(turned, 24, 16, 3, false, 95, exif_block(big, 6));
    const ImageSource image(turned);
    ASSERT_EQ(image.info().notes.size(), 1u) << big;
    EXPECT_NE(image.info().notes[0].find("orientation tag (6)"), std::string::npos) << image.info().notes[0];
    EXPECT_EQ(read_image(turned).values, read_image(plain).values);
    make_jpeg(turned, 24, 16, 3, false, 95, exif_block(big, 1));
    EXPECT_TRUE(ImageSource(turned).info().notes.empty());
  }
  for (std::size_t bytes = 0; bytes < exif_block(true, 6).size(); ++bytes) {   // cut anywhere
    make_jpeg(turned, 24, 16, 3, false, 95, exif_block(true, 6).substr(0, bytes));
    EXPECT_EQ(read_image(turned).values.size(), 24u * 16 * 3);
  }
}

TEST(Tiff, AnOrientationTagIsNoted) {
  const ScratchFolder folder;
  TiffSpec spec;
  make_tiff(folder.path() / "plain.tif", spec);
  EXPECT_TRUE(ImageSource(folder.path() / "plain.tif").info().notes.empty());
  spec.orientation = ORIENTATION_BOTRIGHT;
  make_tiff(folder.path() / "turned.tif", spec);
  const ImageSource image(folder.path() / "turned.tif");
  ASSERT_EQ(image.info().notes.size(), 1u);
  EXPECT_NE(image.info().notes[0].find("orientation tag (3)"), std::string::npos) << image.info().notes[0];
}

TEST(Image, TypeComesFromTheContent) {
  ScratchFolder scratch;
  make_jpeg(scratch.path() / "a.png", 8, 8, 3, false);
  EXPECT_EQ(ImageSource(scratch.path() / "a.png").info().format, "JPEG");
  make_tiff(scratch.path() / "a.nef", {});
  EXPECT_NE(error_of([&] { read_image(scratch.path() / "a.nef"); }).find("encoding = \"raw\""), std::string::npos);
  put_bytes(scratch.path() / "a.txt", "hello");
  EXPECT_NE(error_of([&] { read_image(scratch.path() / "a.txt"); }).find("not a known picture"), std::string::npos);
  put_bytes(scratch.path() / "empty", "");
  EXPECT_NE(error_of([&] { read_image(scratch.path() / "empty"); }).find("is empty"), std::string::npos);
  EXPECT_NE(error_of([&] { read_image(scratch.path() / "missing.jpg"); }).find("cannot be opened"), std::string::npos);
  EXPECT_NE(error_of([&] { read_image(scratch.path()); }).find("is a folder"), std::string::npos);
}

TEST(Image, LimitsAreCheckedBeforeAllocation) {
  ScratchFolder scratch;
  write_png_srgb8(scratch.path() / "a.png", 100, 100, bytes_ramp(30000));
  ImageOptions options;
  options.limits.max_pixels = 9999;
  EXPECT_NE(error_of([&] { read_image(scratch.path() / "a.png", options); }).find("claims 100 x 100 pixels"), std::string::npos);
}

// ---- damage: small files, all of their bytes (or many of them)

class Damage : public testing::Test {
 protected:
  void survive(const std::string& name, std::size_t places) {
    const fs::path good = scratch_.path() / name;
    const std::string bytes = file_bytes(good);
    ASSERT_EQ(error_of([&] { read_image(good); }), "");
    const fs::path bad = scratch_.path() / ("bad_" + name);
    EXPECT_GT(survive_damage(bad, bytes, places, [&] { read_image(bad); }), 20);
  }
  ScratchFolder scratch_;
};

TEST_F(Damage, OfExrIsSurvived) {
  write_exr(scratch_.path() / "a.exr", 5, 20, {"R", "G", "B"}, ramp(5, 20, 3), true);
  survive("a.exr", 1000);
}
TEST_F(Damage, OfTiffIsSurvived) {
  TiffSpec spec;
  spec.compression = COMPRESSION_LZW;
  make_tiff(scratch_.path() / "a.tif", spec);
  survive("a.tif", 300);
  spec.tile = 16;
  spec.compression = COMPRESSION_ADOBE_DEFLATE;
  spec.planar = PLANARCONFIG_SEPARATE;
  make_tiff(scratch_.path() / "b.tif", spec);
  survive("b.tif", 300);
}
TEST_F(Damage, OfPngIsSurvived) {
  write_png_srgb8(scratch_.path() / "a.png", 9, 7, bytes_ramp(189));
  survive("a.png", 1000);
  make_png(scratch_.path() / "b.png", 9, 7, PNG_COLOR_TYPE_PALETTE, 8, true);
  survive("b.png", 1000);
}
TEST_F(Damage, OfJpegIsSurvived) {
  make_jpeg(scratch_.path() / "a.jpg", 24, 20, 3, false, 60);
  survive("a.jpg", 400);
  make_jpeg(scratch_.path() / "b.jpg", 24, 20, 3, true, 60);
  survive("b.jpg", 400);
}
TEST_F(Damage, CutFilesAreAlwaysRefused) {
  write_png_srgb8(scratch_.path() / "a.png", 9, 7, bytes_ramp(189));
  make_jpeg(scratch_.path() / "b.jpg", 24, 20, 3, false, 60);
  write_exr(scratch_.path() / "c.exr", 5, 40, {"R", "G", "B"}, ramp(5, 40, 3), true);
  make_tiff(scratch_.path() / "d.tif", {});
  for (const char* name : {"a.png", "b.jpg", "c.exr", "d.tif"}) {
    const std::string bytes = file_bytes(scratch_.path() / name);
    // The end marker of a JPEG carries no pixels; everything before it does.
    for (std::size_t n = 0; n + 2 < bytes.size(); n += 3) {
      put_bytes(scratch_.path() / "cut", bytes.substr(0, n));
      const std::string message = error_of([&] { read_image(scratch_.path() / "cut"); });
      EXPECT_NE(message, "") << name << " cut to " << n << " of " << bytes.size();
      EXPECT_TRUE(message.empty() || message.find("cut: ") != std::string::npos) << message;
    }
  }
}

// ---- colour curve

TEST(Srgb, FollowsThePublishedCurve) {
  EXPECT_DOUBLE_EQ(linear_from_srgb(0), 0);
  EXPECT_DOUBLE_EQ(linear_from_srgb(1), 1);
  EXPECT_NEAR(linear_from_srgb(0.5), 0.21404114048223255, 1e-15);
  EXPECT_NEAR(srgb_from_linear(0.18), 0.46135612950044164, 1e-15);
  for (int i = 0; i < 256; ++i) {
    EXPECT_NEAR(srgb_from_linear(linear_from_srgb(i / 255.0)), i / 255.0, 1e-7);  // the two branches of the standard meet to 1e-7
    EXPECT_EQ(srgb8_from_linear(linear_from_srgb(i / 255.0)), i);
  }
  EXPECT_EQ(srgb8_from_linear(-1), 0);
  EXPECT_EQ(srgb8_from_linear(7), 255);
  EXPECT_EQ(srgb8_from_linear(std::nan("")), 0);
}

// ---- files that other programs wrote

TEST(RealImages, MalformedFilesEndInAnErrorOrAPictureQuickly) {
  CHIARO_NEED_SHARED(shared);
  int files = 0;
  for (const auto& entry : fs::recursive_directory_iterator(shared / "real/malformed")) {
    if (!entry.is_regular_file()) continue;
    const auto start = std::chrono::steady_clock::now();
    const std::string message = error_of([&] { read_image(entry.path()); });
    const double seconds = std::chrono::duration<double>(std::chrono::steady_clock::now() - start).count();
    EXPECT_LT(seconds, 2) << entry.path();
    if (std::getenv("CHIARO_TEST_VERBOSE")) std::printf("%s\n  -> %s\n", entry.path().filename().c_str(), message.empty() ? "read" : message.c_str());
    ++files;
  }
  EXPECT_GT(files, 30);
  for (const char* bomb : {"bomb.exr", "bomb.png", "bomb-65500x65500.jpg"})
    EXPECT_NE(error_of([&] { read_image(shared / "real/malformed" / bomb); }).find("more than the limit"), std::string::npos) << bomb;
}

TEST(RealImages, CameraJpegsWithOddMetadataAreRead) {
  CHIARO_NEED_SHARED(shared);
  for (const auto& entry : fs::directory_iterator(shared / "real/exif")) {
    const std::string message = error_of([&] { read_image(entry.path()); });
    if (std::getenv("CHIARO_TEST_VERBOSE")) std::printf("%s -> %s\n", entry.path().filename().c_str(), message.empty() ? "read" : message.c_str());
    EXPECT_TRUE(message.empty() || message.find(entry.path().filename().string()) != std::string::npos);
  }
}

TEST(RealImages, ReadsSensorTiffsAndPhotographs) {
  CHIARO_NEED_SHARED(shared);
  const Image sensor = read_image(shared / "real/micasense/IMG_0000_1.tif");
  EXPECT_EQ(sensor.width, 1280);
  EXPECT_EQ(sensor.height, 960);
  EXPECT_EQ(sensor.channels, 1);
  const Image bayer = read_image(shared / "real/chart_bayer/d2_colorChecker30cm_450nm_100ms_2019-02-18-113136-0004.tif");
  EXPECT_EQ(bayer.width, 408);
  EXPECT_EQ(bayer.height, 342);
  const Image rodin = read_image(shared / "real/rodin_flash/photos/231016_miaEURO_9506.jpg");
  EXPECT_EQ(rodin.width, 2172);
  EXPECT_EQ(rodin.height, 1448);
}

}  // namespace
}  // namespace chiaro::stream
