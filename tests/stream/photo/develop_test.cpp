#include "stream/photo/develop.h"

#include <ImfFrameBuffer.h>
#include <ImfHeader.h>
#include <ImfOutputFile.h>
#include <ImfChannelList.h>
#include <tiffio.h>

#include <algorithm>
#include <cmath>

#include "stream/base/error.h"
#include "stream/base/rng.h"
#include "stream/photo/image_io.h"
#include "stream/photo/noise.h"
#include "stream/photo/raw.h"
#include "tests/stream/photo/develop_fixture.h"

namespace chiaro::stream {
namespace {
namespace fs = std::filesystem;

class Develop : public DevelopFixture {};

TEST_F(Develop, LinearisesEightBitSrgbByTheCurve) {
  std::vector<std::uint8_t> values;
  for (int i = 0; i < 16 * 16; ++i)
    for (int c = 0; c < 3; ++c) values.push_back(static_cast<std::uint8_t>(c == 0 ? i : c == 1 ? 255 - i : 100));
  write_png_srgb8(path("a.png"), 16, 16, values);
  DevelopOptions options;
  options.encoding = Encoding::kSrgb;
  options.dilate_px = 0;
  const DevelopResult result = run(path("a.png"), options);
  const auto red = raster().all<float>("r"), green = raster().all<float>("g"), blue = raster().all<float>("b");
  const auto mask = raster().all<std::uint8_t>("mask");
  std::uint64_t saturated = 0;
  for (int i = 0; i < 256; ++i) {
    const std::size_t k = static_cast<std::size_t>(i);
    EXPECT_FLOAT_EQ(red[k], static_cast<float>(linear_from_srgb(i / 255.0)));
    EXPECT_FLOAT_EQ(green[k], static_cast<float>(linear_from_srgb((255 - i) / 255.0)));
    EXPECT_FLOAT_EQ(blue[k], static_cast<float>(linear_from_srgb(100 / 255.0)));
    const bool full = i >= 250 || 255 - i >= 250;  // 0.98 * 255 = 249.9
    EXPECT_EQ(mask[k], full ? kUsableByMask | kSaturated : kUsableByMask) << i;
    saturated += full;
  }
  EXPECT_EQ(result.pixels_saturated, saturated);
  EXPECT_EQ(result.pixels_used, 256 - saturated);
  EXPECT_EQ(result.pixels_masked, 0u);
}

TEST_F(Develop, SaturationGrowsByTwoPixelsAcrossBands) {
  // One white pixel in the last row of the first band of 64 rows, one in a corner.
  const int width = 20, height = 70;
  std::vector<std::uint8_t> values(static_cast<std::size_t>(width * height * 3), 50);
  const auto set = [&](int x, int y) { values[static_cast<std::size_t>((y * width + x) * 3 + 1)] = 255; };
  set(10, 63);
  set(0, 69);
  write_png_srgb8(path("a.png"), width, height, values);
  DevelopOptions options;
  options.encoding = Encoding::kSrgb;
  run(path("a.png"), options);
  const auto mask = raster().all<std::uint8_t>("mask");
  for (int y = 0; y < height; ++y)
    for (int x = 0; x < width; ++x) {
      const bool near = (std::abs(x - 10) <= 2 && std::abs(y - 63) <= 2) || (x <= 2 && y >= 67);
      EXPECT_EQ((mask[static_cast<std::size_t>(y * width + x)] & kSaturated) != 0, near) << x << "," << y;
    }
}

TEST_F(Develop, FloatsHaveNoWhiteUnlessGivenAndBadValuesAreMarked) {
  std::vector<float> values(4 * 2 * 3, 0.25f);
  values[0] = std::nanf("");
  values[3 + 1] = INFINITY;
  values[6] = -0.5f;
  values[9] = 100;
  write_exr(path("a.exr"), 4, 2, {"R", "G", "B"}, values, false);
  DevelopResult result = run(path("a.exr"), {});
  auto mask = raster().all<std::uint8_t>("mask");
  EXPECT_EQ(mask, (std::vector<std::uint8_t>{5, 5, 1, 1, 1, 1, 1, 1}));
  EXPECT_EQ(raster().all<float>("r"), (std::vector<float>{0, 0, -0.5f, 100, 0.25f, 0.25f, 0.25f, 0.25f}));
  EXPECT_EQ(result.pixels_not_finite, 2u);
  EXPECT_EQ(result.pixels_used, 6u);
  DevelopOptions options;
  options.white = 50;
  run(path("a.exr"), options);
  EXPECT_EQ(raster().all<std::uint8_t>("mask")[3], kUsableByMask | kSaturated);
  options.encoding = Encoding::kSrgb;
  EXPECT_NE(error_of([&] { run(path("a.exr"), options); }).find("expected \"linear\""), std::string::npos);
}

/// Noise about a ramp; what is brighter than `white` is clipped.
std::vector<float> clipped_ramp(int width, int height, float white) {
  std::vector<float> values;
  for (int i = 0; i < width * height; ++i)
    for (std::uint32_t c = 0; c < 3; ++c) {
      const double level = 0.2 + 0.8 * (i % width) / width, noise = std::exp(0.02 * normal01(3, Purpose::kTest, static_cast<std::uint64_t>(i), c));
      values.push_back(std::min(white, static_cast<float>((c == 2 ? 0.4 : 1.0) * level * noise)));
    }
  return values;
}

TEST_F(Develop, APlateauOfClippedFloatsIsSaturated) {
  for (const bool half : {false, true}) {
    write_exr(path("a.exr"), 80, 70, {"R", "G", "B"}, clipped_ramp(80, 70, 0.75f), half);
    DevelopOptions options;
    options.find_clipping = true;
    const DevelopResult result = run(path("a.exr"), options);
    const auto mask = raster().all<std::uint8_t>("mask");
    const auto red = raster().all<float>("r"), green = raster().all<float>("g");
    std::size_t clipped = 0;
    for (std::size_t i = 0; i < mask.size(); ++i) {
      const bool is = red[i] == 0.75f || green[i] == 0.75f;
      EXPECT_EQ(mask[i], is ? kUsableByMask | kSaturated : kUsableByMask) << i;
      clipped += is;
    }
    EXPECT_GT(clipped, 1000u);
    EXPECT_EQ(result.pixels_saturated, clipped);
    ASSERT_FALSE(result.notes.empty());
    EXPECT_EQ(result.notes.front(), concat("a.exr: ", clipped, " pixels share the brightest value of the file: taken as clipped, they count as saturated"));
    options.find_clipping = false;
    EXPECT_EQ(run(path("a.exr"), options).pixels_saturated, 0u);
  }
}

TEST_F(Develop, APlateauBelowTheLargestCodeOfSixteenBitsIsSaturated) {
  // Twelve bits of a sensor in sixteen, as they were: white is at 4095.
  std::vector<std::uint16_t> codes;
  for (const float v : clipped_ramp(80, 70, 0.75f)) codes.push_back(static_cast<std::uint16_t>(std::lround(v / 0.75f * 4095)));
  write_png_srgb16(path("a.png"), 80, 70, codes);
  DevelopOptions options;
  options.find_clipping = true;
  const DevelopResult result = run(path("a.png"), options);
  std::uint64_t clipped = 0;
  for (std::size_t i = 0; i < codes.size(); i += 3) clipped += codes[i] == 4095 || codes[i + 1] == 4095;
  EXPECT_GT(clipped, 1000u);
  EXPECT_EQ(result.pixels_saturated, clipped);
  EXPECT_NE(std::find(result.notes.begin(), result.notes.end(), concat("a.png: ", clipped, " pixels share the brightest value of the file: taken as clipped, they count as saturated")), result.notes.end());
  for (std::uint16_t& c : codes) c = static_cast<std::uint16_t>(c / 16);   // too few codes to tell
  write_png_srgb16(path("a.png"), 80, 70, codes);
  EXPECT_EQ(run(path("a.png"), options).pixels_saturated, 0u);
}

/// An ICC profile with nothing but the curve of red, as a gamma, as a table of three values or as parameters.
std::string profile_of(const std::string& curve) {
  const auto number = [](std::uint32_t v) { return std::string{static_cast<char>(v >> 24), static_cast<char>(v >> 16), static_cast<char>(v >> 8), static_cast<char>(v)}; };
  return std::string(128, '\0') + number(1) + "rTRC" + number(144) + number(static_cast<std::uint32_t>(curve.size())) + curve;
}

TEST_F(Develop, AnEncodingThatTheFileContradictsIsNoted) {
  const std::string zero(4, '\0');
  const std::pair<std::string, std::optional<bool>> curves[] = {{"curv" + zero + zero, true},
                                                 {"curv" + zero + std::string("\0\0\0\1\x01\x00", 6), true},
                                                 {"curv" + zero + std::string("\0\0\0\1\x02\x33", 6), false},   // 2.2
                                                 {"curv" + zero + std::string("\0\0\0\3\0\0\x80\0\xff\xff", 10), true},
                                                 {"curv" + zero + std::string("\0\0\0\3\0\0\x37\0\xff\xff", 10), false},
                                                 {"para" + zero + std::string("\0\0\0\0\0\1\0\0", 8), true},
                                                 {"para" + zero + std::string("\0\3\0\0\0\2\x66\x66", 8) + std::string(16, '\1'), false},
                                                 {"mft2" + std::string(40, '\0'), std::nullopt}};   // tables alone
  for (const auto& [curve, linear] : curves) {
    TIFF* tiff = TIFFOpen(path("a.tif").c_str(), "w");
    const std::string profile = profile_of(curve);
    for (const auto& [tag, value] : {std::pair{TIFFTAG_IMAGEWIDTH, 4}, {TIFFTAG_IMAGELENGTH, 1}, {TIFFTAG_BITSPERSAMPLE, 16}, {TIFFTAG_SAMPLESPERPIXEL, 3}, {TIFFTAG_PHOTOMETRIC, PHOTOMETRIC_RGB}}) TIFFSetField(tiff, static_cast<std::uint32_t>(tag), value);
    TIFFSetField(tiff, TIFFTAG_ICCPROFILE, static_cast<std::uint32_t>(profile.size()), profile.data());
    std::vector<std::uint16_t> row(12, 30000);
    TIFFWriteScanline(tiff, row.data(), 0, 0);
    TIFFClose(tiff);
    const auto said = [&](Encoding encoding, const char* what) {
      DevelopOptions options;
      options.encoding = encoding;
      options.noise = NoiseModel{1e-3, 1e-3, false};
      const auto notes = run(path("a.tif"), options).notes;
      return std::any_of(notes.begin(), notes.end(), [&](const std::string& note) { return note.find(what) != std::string::npos; });
    };
    EXPECT_EQ(said(Encoding::kLinear, "says that values are not linear"), linear == false) << curve.substr(0, 4) << curve.size();
    EXPECT_EQ(said(Encoding::kLinear, "does not say by a curve whether values are linear"), !linear.has_value()) << curve.substr(0, 4) << curve.size();
    EXPECT_EQ(said(Encoding::kSrgb, "says that values are linear"), linear == true) << curve.substr(0, 4) << curve.size();
  }
}

TEST_F(Develop, WhatIsMaskedMakesNoPlateau) {
  std::vector<float> values = clipped_ramp(80, 70, 9);
  std::vector<std::uint8_t> picture(80 * 70, 255);
  for (std::size_t i = 0; i < 80 * 10; ++i) {   // a white background
    values[3 * i] = values[3 * i + 1] = values[3 * i + 2] = 20;
    picture[i] = 0;
  }
  write_exr(path("a.exr"), 80, 70, {"R", "G", "B"}, values, false);
  write_png_srgb8(path("mask.png"), 80, 70, picture, 1);
  DevelopOptions options;
  options.find_clipping = true;
  options.mask = path("mask.png");
  const DevelopResult result = run(path("a.exr"), options);
  EXPECT_EQ(result.pixels_saturated, 0u);
  EXPECT_EQ(result.pixels_used, 80u * 60u);
}

TEST_F(Develop, PixelsOutsideTheDataWindowHoldNoData) {
  // Display window 6 x 5 with a data window that is shifted, smaller below and reaches beyond it on the left.
  Imf::Header header(Imath::Box2i({10, 20}, {15, 24}), Imath::Box2i({8, 21}, {13, 23}));
  std::vector<float> values;
  for (int i = 0; i < 6 * 3; ++i) values.push_back(static_cast<float>(i));
  for (const char* name : {"R", "G", "B"}) header.channels().insert(name, Imf::Channel(Imf::FLOAT));
  {
    Imf::OutputFile file(path("a.exr").c_str(), header);
    Imf::FrameBuffer frame;
    for (const char* name : {"R", "G", "B"})
      frame.insert(name, Imf::Slice(Imf::FLOAT, reinterpret_cast<char*>(reinterpret_cast<std::uintptr_t>(values.data()) - (21 * 6 + 8) * sizeof(float)), sizeof(float), 6 * sizeof(float)));
    file.setFrameBuffer(frame);
    file.writePixels(3);
  }
  const DevelopResult result = run(path("a.exr"), {});
  EXPECT_EQ(result.width_px, 6);
  EXPECT_EQ(result.height_px, 5);
  EXPECT_EQ(result.pixels_used, 4u * 3u);
  const auto red = raster().all<float>("r");
  EXPECT_EQ(red[6], 2);          // x = 10, y = 21 of the file
  EXPECT_EQ(red[3 * 6 + 3], 17); // x = 13, y = 23
  EXPECT_EQ(raster().all<std::uint8_t>("mask")[6 + 4], kUsableByMask | kNotFinite);
}

TEST_F(Develop, TransparentPixelsHoldNoData) {
  const int width = 5, height = 70;   // more than a band, so that the first one does not decide
  std::vector<float> values;
  for (int i = 0; i < width * height; ++i) values.insert(values.end(), {0.5f, 0.5f, 0.5f, 1});
  const std::size_t last = values.size() - 4;
  values[last + 3] = 0.9f;
  values[last - 1] = 0;
  write_exr(path("a.exr"), width, height, {"R", "G", "B", "A"}, values, false);
  DevelopOptions options;
  const DevelopResult result = run(path("a.exr"), options);
  EXPECT_EQ(result.pixels_used, static_cast<std::uint64_t>(width * height - 2));
  EXPECT_EQ(result.pixels_not_finite, 2u);
  EXPECT_EQ(raster().all<float>("r").back(), 0);
  EXPECT_NE(std::find(result.notes.begin(), result.notes.end(), "pixels that its alpha channel has as transparent, in full or in part, are left out"), result.notes.end());
  // The mask does not bring them back.
  write_png_srgb8(path("mask.png"), width, height, std::vector<std::uint8_t>(static_cast<std::size_t>(width * height), 255), 1);
  options.mask = path("mask.png");
  EXPECT_EQ(run(path("a.exr"), options).pixels_used, static_cast<std::uint64_t>(width * height - 2));
  // A fourth channel that nothing says to be alpha is not taken for it.
  for (const int declared : {EXTRASAMPLE_UNSPECIFIED, EXTRASAMPLE_UNASSALPHA}) {
    TIFF* tiff = TIFFOpen(path("a.tif").c_str(), "w");
    for (const auto& [tag, value] : {std::pair{TIFFTAG_IMAGEWIDTH, 4}, {TIFFTAG_IMAGELENGTH, 1}, {TIFFTAG_BITSPERSAMPLE, 8}, {TIFFTAG_SAMPLESPERPIXEL, 4}, {TIFFTAG_PHOTOMETRIC, PHOTOMETRIC_RGB}}) TIFFSetField(tiff, static_cast<std::uint32_t>(tag), value);
    const auto extra = static_cast<std::uint16_t>(declared);
    TIFFSetField(tiff, TIFFTAG_EXTRASAMPLES, 1, &extra);
    std::vector<std::uint8_t> row{90, 90, 90, 255, 90, 90, 90, 200, 90, 90, 90, 0, 90, 90, 90, 255};
    TIFFWriteScanline(tiff, row.data(), 0, 0);
    TIFFClose(tiff);
    EXPECT_EQ(run(path("a.tif"), {}).pixels_used, declared == EXTRASAMPLE_UNSPECIFIED ? 4u : 2u);
  }
  // An alpha channel of nothing but zeros was not meant.
  for (std::size_t i = 3; i < values.size(); i += 4) values[i] = 0;
  write_exr(path("a.exr"), width, height, {"R", "G", "B", "A"}, values, false);
  EXPECT_EQ(run(path("a.exr"), {}).pixels_used, static_cast<std::uint64_t>(width * height));
}

TEST_F(Develop, MasksAreCutAtHalfInAnyFormat) {
  write_exr(path("a.exr"), 4, 1, {"R", "G", "B"}, std::vector<float>(12, 0.5f), false);
  DevelopOptions options;
  const auto mask_of = [&](const std::string& name) {
    options.mask = path(name);
    run(path("a.exr"), options);
    return raster().all<std::uint8_t>("mask");
  };
  const std::vector<std::uint8_t> expected = {0, 0, 1, 1};
  write_png_srgb8(path("grey.png"), 4, 1, std::vector<std::uint8_t>{0, 127, 128, 255}, 1);
  EXPECT_EQ(mask_of("grey.png"), expected);
  write_png_srgb16(path("deep.png"), 4, 1, std::vector<std::uint16_t>{0, 32767, 32768, 65535}, 1);
  EXPECT_EQ(mask_of("deep.png"), expected);
  write_png_srgb8(path("rgb.png"), 4, 1, std::vector<std::uint8_t>{0, 0, 0, 255, 0, 0, 255, 255, 0, 255, 255, 255});
  EXPECT_EQ(mask_of("rgb.png"), expected);
  write_exr(path("alpha.exr"), 4, 1, {"R", "G", "B", "A"}, std::vector<float>{1, 1, 1, 0, 1, 1, 1, 0.4f, 0, 0, 0, 1, 0, 0, 0, 1}, false);
  EXPECT_EQ(mask_of("alpha.exr"), expected);
  write_exr(path("opaque.exr"), 4, 1, {"R", "G", "B", "A"}, std::vector<float>{0, 0, 0, 1, 0, 0, 0, 1, 1, 1, 1, 1, 1, 1, 1, 1}, false);
  EXPECT_EQ(mask_of("opaque.exr"), expected);
}

TEST_F(Develop, AMaskWithoutWhiteIsNotedAndAGreyPhotographToo) {
  write_exr(path("a.exr"), 4, 1, {"Y"}, std::vector<float>(4, 0.5f), false);
  write_png_srgb8(path("mask.png"), 4, 1, std::vector<std::uint8_t>{0, 1, 1, 0}, 1);   // written as numbers 0 and 1
  DevelopOptions options;
  options.mask = path("mask.png");
  const DevelopResult result = run(path("a.exr"), options);
  const auto said = [&](const char* what) { return std::find(result.notes.begin(), result.notes.end(), what) != result.notes.end(); };
  EXPECT_EQ(result.pixels_used, 0u);
  EXPECT_TRUE(said("its mask leaves nothing: white is what is used, and the brightest place of the mask is 1 of 255"));
  EXPECT_TRUE(said("is grey: its red, green and blue are taken as equal"));
}

TEST_F(Develop, MissingAndOddMasksAreNamed) {
  write_exr(path("a.exr"), 4, 1, {"R", "G", "B"}, std::vector<float>(12, 0.5f), false);
  DevelopOptions options;
  options.mask = path("masks/a.png");
  std::string message = error_of([&] { run(path("a.exr"), options); });
  EXPECT_NE(message.find("a.exr: its mask is missing: "), std::string::npos) << message;
  EXPECT_NE(message.find("masks/a.png"), std::string::npos) << message;
  write_png_srgb8(path("b.png"), 2, 3, std::vector<std::uint8_t>(6, 255), 1);
  options.mask = path("b.png");
  message = error_of([&] { run(path("a.exr"), options); });
  EXPECT_NE(message.find("the mask is 2 x 3 pixels"), std::string::npos) << message;
  EXPECT_NE(message.find("is 4 x 1"), std::string::npos) << message;
  EXPECT_EQ(message.find("half size"), std::string::npos) << message;
  write_png_srgb8(path("c.png"), 8, 2, std::vector<std::uint8_t>(16, 255), 1);
  options.mask = path("c.png");
  message = error_of([&] { run(path("a.exr"), options); });
  EXPECT_NE(message.find("camera RAW is read at half size"), std::string::npos) << message;
  EXPECT_FALSE(fs::exists(raster_path()));
}

TEST_F(Develop, LeavesNoRasterBehindOnDamage) {
  write_exr(path("a.exr"), 50, 200, {"R", "G", "B"}, std::vector<float>(30000, 0.5f), false);
  const std::string bytes = file_bytes(path("a.exr"));
  put_bytes(path("a.exr"), bytes.substr(0, bytes.size() - 40));
  EXPECT_NE(error_of([&] { run(path("a.exr"), {}); }), "");
  EXPECT_EQ(std::distance(fs::directory_iterator(scratch_.path()), fs::directory_iterator()), 1);
}

TEST_F(Develop, SixteenBitGreyGivesThreeEqualPlanes) {
  write_png_srgb16(path("a.png"), 2, 1, std::vector<std::uint16_t>{1000, 65000}, 1);
  run(path("a.png"), {});
  EXPECT_FLOAT_EQ(raster().all<float>("g")[0], 1000 / 65535.0f);
  EXPECT_EQ(raster().all<float>("r"), raster().all<float>("b"));
  EXPECT_EQ(raster().all<std::uint8_t>("mask"), (std::vector<std::uint8_t>{1, 3}));  // 16 bits: not dilated
}

TEST(Encoding, NamesAreThoseOfTheProjectFile) {
  EXPECT_EQ(encoding_from_name("linear"), Encoding::kLinear);
  EXPECT_EQ(encoding_from_name("srgb"), Encoding::kSrgb);
  EXPECT_EQ(encoding_from_name("raw"), Encoding::kRaw);
  EXPECT_THROW(encoding_from_name("jpeg"), UsageError);
}

// ---- noise

/// A picture with a ramp of brightness, some texture, and noise of known size.
NoiseModel estimate_synthetic(double gain, double read_sigma, double texture) {
  constexpr int kWidth = 512, kHeight = 512;
  NoiseEstimator estimator(kWidth, kHeight);
  std::vector<float> rgb[3];
  std::vector<std::uint8_t> good(static_cast<std::size_t>(kWidth * kHeight), 1);
  for (int c = 0; c < 3; ++c)
    for (int y = 0; y < kHeight; ++y)
      for (int x = 0; x < kWidth; ++x) {
        double z = 0.02 + 0.8 * (x + 0.3 * y) / (1.3 * kWidth);
        if (y % 64 < 32) z *= 1 + texture * std::sin(0.9 * x) * std::cos(0.7 * y);
        const double sigma = std::sqrt(gain * z + read_sigma * read_sigma);
        rgb[c].push_back(static_cast<float>(z + sigma * normal01(5, Purpose::kTest, static_cast<std::uint64_t>((c * kHeight + y) * kWidth + x), 0)));
      }
  estimator.add_band(0, kHeight, rgb, good);
  return estimator.fit().value();
}

TEST(Noise, IsRecoveredFromPlainAndFromTexturedPictures) {
  const NoiseModel flat = estimate_synthetic(0, 0.01, 0);
  EXPECT_NEAR(flat.variance(0.4) / 1e-4, 1, 0.05);
  for (const double texture : {0.0, 0.2}) {
    const NoiseModel model = estimate_synthetic(1e-4, 2e-3, texture);
    if (std::getenv("CHIARO_TEST_VERBOSE")) std::printf("gain %g read %g\n", model.gain, model.read_sigma);
    for (const double z : {0.05, 0.2, 0.7}) EXPECT_NEAR(model.variance(z) / (1e-4 * z + 4e-6), 1, texture > 0 ? 0.2 : 0.07) << texture << " " << z;
    EXPECT_NEAR(model.gain, 1e-4, texture > 0 ? 2e-5 : 5e-6) << texture;
    EXPECT_NEAR(model.read_sigma, 2e-3, texture > 0 ? 6e-4 : 2e-4) << texture;
  }
}

TEST(Noise, IsNotEstimatedFromNothing) {
  EXPECT_FALSE(NoiseEstimator(100, 100).fit());
}

TEST_F(Develop, EstimatesNoiseOnlyWhereNotGiven) {
  std::vector<float> values;
  for (int i = 0; i < 200 * 200 * 3; ++i) values.push_back(static_cast<float>(0.5 + 0.01 * normal01(9, Purpose::kTest, static_cast<std::uint64_t>(i), 0)));
  write_exr(path("a.exr"), 200, 200, {"R", "G", "B"}, values, false);
  const DevelopResult estimated = run(path("a.exr"), {});
  EXPECT_TRUE(estimated.noise.estimated);
  EXPECT_NEAR(std::sqrt(estimated.noise.variance(0.5)), 0.01, 0.001);
  DevelopOptions options;
  options.noise = NoiseModel{1e-3, 2e-3, false};
  const DevelopResult given = run(path("a.exr"), options);
  EXPECT_EQ(given.noise.gain, 1e-3);
  EXPECT_FALSE(given.noise.estimated);
}

// ---- files that other programs wrote

TEST_F(Develop, RealKodakRawGivesALinearHalfSizePicture) {
  CHIARO_NEED_SHARED(shared);
  for (const auto& entry : fs::directory_iterator(shared / "real/raw")) {
    if (!entry.is_regular_file()) continue;
    const RawSource raw(entry.path());
    EXPECT_EQ(raw.info().width_px * 2, raw.info().sensor_width_px & ~1);
    DevelopOptions options;
    options.encoding = Encoding::kRaw;
    const DevelopResult result = run(entry.path(), options);
    EXPECT_EQ(result.width_px, 384);
    EXPECT_EQ(result.height_px, 256);
    EXPECT_GT(result.pixels_used, 384u * 256u / 2);
    const auto green = raster().all<float>("g");
    const auto [low, high] = std::minmax_element(green.begin(), green.end());
    EXPECT_GT(*low, -0.2f);
    EXPECT_LE(*high, 1.2f);
    EXPECT_GT(*high - *low, 0.1f);
    if (std::getenv("CHIARO_TEST_VERBOSE"))
      std::printf("%s: white %g black %g, values %g..%g, used %llu saturated %llu, noise %g %g\n", raw.info().camera.c_str(), raw.info().white, raw.info().black, static_cast<double>(*low),
                  static_cast<double>(*high), static_cast<unsigned long long>(result.pixels_used), static_cast<unsigned long long>(result.pixels_saturated), result.noise.gain, result.noise.read_sigma);
  }
}

TEST_F(Develop, RealRawStubsAreRefusedWithAReason) {
  CHIARO_NEED_SHARED(shared);
  DevelopOptions options;
  options.encoding = Encoding::kRaw;
  for (const char* folder : {"real/raw/stubs", "real/malformed"})
    for (const auto& entry : fs::directory_iterator(shared / folder)) {
      if (!entry.is_regular_file()) continue;
      const std::string message = error_of([&] { run(entry.path(), options); });
      EXPECT_NE(message.find(entry.path().filename().string()), std::string::npos) << entry.path();
      if (std::getenv("CHIARO_TEST_VERBOSE") && std::string(folder) == "real/raw/stubs") std::printf("%s\n", message.c_str());
    }
}

TEST_F(Develop, RealRawSurvivesDamage) {
  CHIARO_NEED_SHARED(shared);
  for (const auto& entry : fs::directory_iterator(shared / "real/raw")) {
    if (!entry.is_regular_file()) continue;
    const std::string bytes = file_bytes(entry.path());
    survive_damage(path("bad.kdc"), bytes, 12, [&] { RawSource raw(path("bad.kdc")); });
    // The header, where the sizes are, more densely.
    for (std::size_t i = 0; i < std::min<std::size_t>(bytes.size(), 1200); i += 13) {
      std::string damaged = bytes;
      damaged[i] = static_cast<char>(damaged[i] ^ 0xff);
      put_bytes(path("bad.kdc"), damaged);
      error_of([&] { RawSource raw(path("bad.kdc")); });
    }
  }
}

TEST_F(Develop, RealChartLadderIsLinearAndItsLongExposuresAreSaturated) {
  CHIARO_NEED_SHARED(shared);
  const fs::path chart = shared / "real/chart_bayer";
  const Image labels = read_image(chart / "d2_colorChecker30cm_550nm_labels.png");
  double means[5] = {}, saturated[5] = {};
  const int exposures[5] = {25, 50, 100, 250, 500};
  for (int e = 0; e < 5; ++e)
    for (const auto& entry : fs::directory_iterator(chart)) {
      if (entry.path().filename().string().find(concat("_550nm_", exposures[e], "ms_")) == std::string::npos) continue;
      const DevelopResult result = run(entry.path(), {});
      saturated[e] = static_cast<double>(result.pixels_saturated);
      const auto values = raster().all<float>("g");
      int num = 0;
      for (int y = 0; y < labels.height; y += 2)
        for (int x = 0; x < labels.width; x += 2)
          if (std::lround(labels.at(x, y, 0) * 255) == 22) {  // neutral 5, one Bayer phase
            means[e] += static_cast<double>(values[static_cast<std::size_t>(y * result.width_px + x)]);
            ++num;
          }
      ASSERT_GT(num, 20);
      means[e] /= num;
    }
  if (std::getenv("CHIARO_TEST_VERBOSE"))
    for (int e = 0; e < 5; ++e) std::printf("%d ms: mean %g, saturated %g\n", exposures[e], means[e] * 255, saturated[e]);
  EXPECT_NEAR(means[1] / means[0], 2, 0.15);
  EXPECT_NEAR(means[2] / means[1], 2, 0.15);
  EXPECT_LT(saturated[0], saturated[4]);
  EXPECT_GT(saturated[4], 10000);
}

TEST_F(Develop, RealPanelHasTheGreyOfItsSensor) {
  CHIARO_NEED_SHARED(shared);
  const DevelopResult result = run(shared / "real/micasense/IMG_0000_1.tif", {});
  const auto values = raster().all<float>("g");
  double sum = 0;
  for (int y = 520; y < 640; ++y)
    for (int x = 690; x < 810; ++x) sum += static_cast<double>(values[static_cast<std::size_t>(y * 1280 + x)]);
  const double panel = sum / (120 * 120);
  EXPECT_GT(panel, 0.2);
  EXPECT_LT(panel, 0.98);
  EXPECT_EQ(result.pixels_not_finite, 0u);
  if (std::getenv("CHIARO_TEST_VERBOSE")) std::printf("panel %g, noise %g %g\n", panel * 65535, result.noise.gain, result.noise.read_sigma);
}

TEST_F(Develop, RealScenesNoiseIsEstimatedNearTheDeclaredOne) {
  CHIARO_NEED_SHARED(shared);
  for (const char* scene : {"sphere", "vplanes_textured", "tower"}) {
    const fs::path folder = shared / "scenes" / scene;
    if (!fs::exists(folder / "photos/photo_00.exr")) continue;
    DevelopOptions options;
    if (fs::exists(folder / "masks/photo_00.png")) options.mask = folder / "masks/photo_00.png";
    const DevelopResult result = run(folder / "photos/photo_00.exr", options);
    EXPECT_TRUE(result.noise.estimated);
    // Declared: gain 1e-4, read 4e-4; the renderer adds noise of its own.
    const double ratio = result.noise.variance(0.3) / (1e-4 * 0.3 + 1.6e-7);
    EXPECT_GT(ratio, 0.5) << scene;
    EXPECT_LT(ratio, 10) << scene;
    if (std::getenv("CHIARO_TEST_VERBOSE")) std::printf("%s: gain %g read %g ratio at 0.3 %g, used %llu\n", scene, result.noise.gain, result.noise.read_sigma, ratio, static_cast<unsigned long long>(result.pixels_used));
  }
}

TEST_F(Develop, RealFlashPhotographIsDeveloped) {
  CHIARO_NEED_SHARED(shared);
  DevelopOptions options;
  options.encoding = Encoding::kSrgb;
  const DevelopResult result = run(shared / "real/rodin_flash/photos/231016_miaEURO_9506.jpg", options);
  EXPECT_EQ(result.width_px, 2172);
  EXPECT_EQ(result.pixels_masked, 0u);
  raster().verify();
  if (std::getenv("CHIARO_TEST_VERBOSE")) std::printf("noise %g %g saturated %llu notes %zu %s\n", result.noise.gain, result.noise.read_sigma, static_cast<unsigned long long>(result.pixels_saturated), result.notes.size(), result.notes.empty() ? "" : result.notes[0].c_str());
}

TEST_F(Develop, CellsAreTheMeansOfWhatTheirPixelsDevelopTo) {
  // 500 x 400 pixels of a ramp with noise, in cells of 3: 166 x 133, over more than one band of either.
  const int width = 500, height = 400, cell = 3;
  std::vector<float> values;
  for (int y = 0; y < height; ++y)
    for (int x = 0; x < width; ++x)
      for (int c = 0; c < 3; ++c) values.push_back(0.2f + 0.0008f * static_cast<float>(x) + 0.01f * static_cast<float>(normal01(7, Purpose::kTest, values.size(), 0)));
  write_exr(path("a.exr"), width, height, {"R", "G", "B"}, values, false);
  DevelopOptions options;
  options.white = 0.6;
  const DevelopResult fine = run(path("a.exr"), options);
  const auto green = raster().all<float>("g");
  const auto mask = raster().all<std::uint8_t>("mask");
  options.cell_px = cell;
  const DevelopResult coarse = run(path("a.exr"), options);
  ASSERT_EQ(coarse.width_px, 166);
  ASSERT_EQ(coarse.height_px, 133);
  const auto cells = raster().all<float>("g");
  const auto cell_mask = raster().all<std::uint8_t>("mask");
  std::uint64_t used = 0;
  for (int y = 0; y < 133; ++y)
    for (int x = 0; x < 166; ++x) {
      double sum = 0;
      int num = 0;
      for (int k = 0; k < cell * cell; ++k) {
        const auto at = static_cast<std::size_t>((y * cell + k / cell) * width + x * cell + k % cell);
        if (mask[at] != kUsableByMask) continue;
        sum += static_cast<double>(green[at]);
        ++num;
      }
      const auto at = static_cast<std::size_t>(y * 166 + x);
      ASSERT_EQ(cell_mask[at] == kUsableByMask, 2 * num >= cell * cell) << x << "," << y;
      if (cell_mask[at] != kUsableByMask) continue;
      ++used;
      ASSERT_NEAR(cells[at], sum / num, 1e-6) << x << "," << y;
    }
  EXPECT_EQ(coarse.pixels_used, used);
  EXPECT_GT(used, 166u * 133u / 2);
  EXPECT_LT(used, 166u * 133u);
  // The mean of nine varies by a third as much.
  EXPECT_NEAR(fine.noise.variance(0.3), 1e-4, 2e-5);
  EXPECT_NEAR(coarse.noise.variance(0.3), 1e-4 / 9, 3e-6);
}

TEST_F(Develop, NoiseThatIsGivenIsThatOfPixels) {
  write_exr(path("a.exr"), 8, 8, {"R", "G", "B"}, std::vector<float>(8 * 8 * 3, 0.25f), false);
  DevelopOptions options;
  options.noise = NoiseModel{3.2e-4, 4e-3, false};
  options.cell_px = 4;
  const DevelopResult result = run(path("a.exr"), options);
  EXPECT_DOUBLE_EQ(result.noise.gain, 3.2e-4 / 16);
  EXPECT_DOUBLE_EQ(result.noise.read_sigma, 1e-3);
}

TEST_F(Develop, SaturationGrowsInThePixelsThatCellsAreMadeOf) {
  // One white pixel in the middle of a cell of 3 x 3: two pixels around it fill its own cell, and take 6 of 9 or 4 of 9 pixels of the others.
  std::vector<std::uint8_t> values(15 * 15 * 3, 50);
  values[(7 * 15 + 7) * 3] = 255;
  write_png_srgb8(path("a.png"), 15, 15, values);
  DevelopOptions options;
  options.encoding = Encoding::kSrgb;
  options.cell_px = 3;
  run(path("a.png"), options);
  const auto mask = raster().all<std::uint8_t>("mask");
  // Pixels 5 to 9: the last column of cell 1, all of cell 2, the first column of cell 3.
  for (int y = 0; y < 5; ++y)
    for (int x = 0; x < 5; ++x) EXPECT_EQ((mask[static_cast<std::size_t>(y * 5 + x)] & kSaturated) != 0, x == 2 && y == 2) << x << "," << y;
}

TEST_F(Develop, APictureSmallerThanACellIsRefused) {
  write_exr(path("a.exr"), 8, 5, {"R", "G", "B"}, std::vector<float>(8 * 5 * 3, 0.25f), false);
  DevelopOptions options;
  options.cell_px = 6;
  EXPECT_NE(error_of([&] { run(path("a.exr"), options); }).find("is 8 x 5 pixels, less than one cell of 6 x 6 pixels"), std::string::npos);
  EXPECT_FALSE(fs::exists(raster_path()));
}

TEST_F(Develop, TheSizeIsKnownBefore) {
  write_exr(path("a.exr"), 8, 5, {"R", "G", "B"}, std::vector<float>(8 * 5 * 3, 0.25f), false);
  const PictureSize size = working_size(path("a.exr"), Encoding::kLinear);
  EXPECT_EQ(size.width_px, 8);
  EXPECT_EQ(size.height_px, 5);
  EXPECT_NE(error_of([&] { working_size(path("b.exr"), Encoding::kLinear); }), "");
}

}  // namespace
}  // namespace chiaro::stream
