#include "tools/compare_images.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <cmath>
#include <cstdlib>
#include <fstream>
#include <limits>

#include "stream/base/error.h"
#include "stream/base/file.h"
#include "stream/photo/image_io.h"
#include "tools/npy_reader.h"

namespace chiaro::tools {
namespace {

namespace fs = std::filesystem;
using testing::HasSubstr;

class CompareImagesTest : public testing::Test {
 protected:
  std::string exr(const std::string& name, int width, int height, float value) {
    const std::vector<float> values(static_cast<std::size_t>(width) * height * 3, value);
    stream::write_exr(scratch_.path() / name, width, height, {"R", "G", "B"}, values, false);
    return (scratch_.path() / name).string();
  }
  std::string png(const std::string& name, int width, int height, std::uint8_t value, int channels = 3) {
    const std::vector<std::uint8_t> values(static_cast<std::size_t>(width) * height * channels, value);
    stream::write_png_srgb8(scratch_.path() / name, width, height, values, channels);
    return (scratch_.path() / name).string();
  }
  template <class F>
  static std::string complaint(F f) {
    try {
      f();
    } catch (const Error& e) {
      return e.what();
    }
    return "none";
  }
  ScratchFolder scratch_;
};

TEST_F(CompareImagesTest, GivesTheNumbersOfATenth) {
  const ImageComparison r = compare_images(exr("a.exr", 20, 16, 0.6f), exr("b.exr", 20, 16, 0.5f), {});
  EXPECT_NEAR(r.psnr, 20, 1e-4);
  EXPECT_NEAR(r.mse, 0.01, 1e-7);
  EXPECT_NEAR(r.relative_error, 0.2, 1e-6);
  EXPECT_NEAR(r.ssim, (2 * 0.3 + 1e-4) / (0.36 + 0.25 + 1e-4), 1e-5);  // flat pictures: the luminance term alone
  EXPECT_EQ(r.pixels, 320u);
  EXPECT_EQ(r.not_finite, 0u);
  EXPECT_TRUE(r.notes.empty());
}

TEST_F(CompareImagesTest, LinearisesEightBitFilesAndSaysSo) {
  const std::string a = png("a.png", 12, 12, 188, 1), b = exr("b.exr", 12, 12, 0.5028865f);  // 188/255 encoded
  const ImageComparison r = compare_images(a, b, {});
  EXPECT_LT(r.mse, 1e-12);
  ASSERT_EQ(r.notes.size(), 1u);
  EXPECT_THAT(r.notes[0], HasSubstr("a.png: taken as sRGB and linearised"));
  CompareImagesOptions stored;
  stored.as_stored = true;
  EXPECT_NEAR(compare_images(a, b, stored).mse, std::pow(188 / 255.0 - 0.5028865, 2), 1e-6);
  CompareImagesOptions encoded;
  encoded.srgb = true;
  EXPECT_NEAR(compare_images(a, exr("c.exr", 12, 12, 1), encoded).mse, std::pow(188 / 255.0 - 1, 2), 1e-6);
}

TEST_F(CompareImagesTest, LeavesAlphaOutAndKeepsTheChannelsApart) {
  const fs::path with_alpha = scratch_.path() / "alpha.exr", without = scratch_.path() / "rgb.exr", grey = scratch_.path() / "grey.exr";
  std::vector<float> rgba, rgb;
  for (int i = 0; i < 12 * 12; ++i) {
    rgba.insert(rgba.end(), {0.1f, 0.2f, 0.4f, 0.7f});
    rgb.insert(rgb.end(), {0.1f, 0.2f, 0.5f});
  }
  stream::write_exr(with_alpha, 12, 12, {"R", "G", "B", "A"}, rgba, false);
  stream::write_exr(without, 12, 12, {"R", "G", "B"}, rgb, false);
  const ImageComparison r = compare_images(with_alpha, without, {});
  EXPECT_NEAR(r.mse, 0.01 / 3, 1e-7);
  EXPECT_NEAR(r.relative_error, 0.2 / 3, 1e-6);
  stream::write_exr(grey, 12, 12, {"Y"}, std::vector<float>(144, 0.2f), false);
  EXPECT_NEAR(compare_images(grey, without, {}).mse, (0.01 + 0.09) / 3, 1e-7);
}

TEST_F(CompareImagesTest, SixteenBitsOfAPngAreEncodedAndFloatsAreNot) {
  const std::vector<std::uint16_t> values(12 * 12 * 3, 188 * 257);
  stream::write_png_srgb16(scratch_.path() / "a.png", 12, 12, values);
  EXPECT_LT(compare_images(scratch_.path() / "a.png", exr("b.exr", 12, 12, 0.5028865f), {}).mse, 1e-12);
}

TEST_F(CompareImagesTest, HalfOfAMaskIsInAndLessIsNot) {
  std::vector<float> mask(12 * 12, 0.49f), values(12 * 12 * 3, 0.75f);
  mask[5] = 0.5f;
  std::fill_n(values.begin() + 15, 3, 0.5f);
  stream::write_exr(scratch_.path() / "mask.exr", 12, 12, {"Y"}, mask, false);
  stream::write_exr(scratch_.path() / "a.exr", 12, 12, {"R", "G", "B"}, values, false);
  CompareImagesOptions options;
  options.mask = scratch_.path() / "mask.exr";
  const ImageComparison r = compare_images(scratch_.path() / "a.exr", exr("b.exr", 12, 12, 0.5f), options);
  EXPECT_EQ(r.pixels, 1u);
  for (const double none : {r.mse, r.relative_error, r.flip, r.delta_e}) EXPECT_EQ(none, 0);
}

TEST_F(CompareImagesTest, TakesWhatIsBeyondWhiteAsWhiteIfAsked) {
  const std::string a = exr("a.exr", 12, 12, 3), b = exr("b.exr", 12, 12, 1.5f), black = exr("black.exr", 12, 12, -0.25f);
  CompareImagesOptions options;
  options.clip = true;
  EXPECT_EQ(compare_images(a, b, options).mse, 0);
  EXPECT_EQ(compare_images(a, black, options).mse, 1);
  options.peak = 2;
  EXPECT_EQ(compare_images(a, b, options).mse, 0.25);
  EXPECT_EQ(compare_images(a, b, {}).mse, 2.25);
  EXPECT_TRUE(std::isnan(compare_images(a, exr("nan.exr", 12, 12, std::nanf("")), options).mse));
  const ImageComparison glaring = compare_images(a, exr("inf.exr", 12, 12, std::numeric_limits<float>::infinity()), options);
  EXPECT_EQ(glaring.mse, 0);
  EXPECT_EQ(glaring.not_finite, 0u);   // what is said of the measures holds for what was measured
  EXPECT_EQ(compare_images(a, (scratch_.path() / "inf.exr").string(), {}).not_finite, 144u);
}

TEST_F(CompareImagesTest, CountsOnlyMaskedPixels) {
  std::vector<float> values(30 * 20 * 3, 0.5f);
  values[0] = std::nanf("");
  stream::write_exr(scratch_.path() / "a.exr", 30, 20, {"R", "G", "B"}, values, false);
  const std::string a = (scratch_.path() / "a.exr").string(), b = exr("b.exr", 30, 20, 0.5f);
  const ImageComparison all = compare_images(a, b, {});
  EXPECT_TRUE(std::isnan(all.psnr));
  EXPECT_TRUE(std::isnan(all.flip));
  EXPECT_EQ(all.not_finite, 1u);
  std::vector<std::uint8_t> mask(30 * 20, 255);
  mask[0] = 0;
  stream::write_png_srgb8(scratch_.path() / "mask.png", 30, 20, mask, 1);
  CompareImagesOptions options;
  options.mask = scratch_.path() / "mask.png";
  const ImageComparison r = compare_images(a, b, options);
  EXPECT_EQ(r.mse, 0);
  EXPECT_EQ(r.pixels, 599u);
  EXPECT_NEAR(r.ssim, 1, 1e-12);
  EXPECT_EQ(r.flip, 0);
}

TEST_F(CompareImagesTest, RefusesWhatDoesNotFit) {
  const std::string a = exr("a.exr", 20, 16, 0.6f), b = exr("b.exr", 16, 20, 0.5f);
  EXPECT_THAT(complaint([&] { compare_images(a, b, {}); }), HasSubstr("a.exr has 20 x 16 pixels"));
  CompareImagesOptions options;
  options.mask = png("small.png", 4, 4, 255, 1);
  EXPECT_THAT(complaint([&] { compare_images(a, a, options); }), HasSubstr("the mask has 4 x 4 pixels"));
  options.mask = png("black.png", 20, 16, 0, 1);
  EXPECT_THAT(complaint([&] { compare_images(a, a, options); }), HasSubstr("sets no pixel"));
  EXPECT_THAT(complaint([&] { compare_images(a, scratch_.path() / "absent.exr", {}); }), HasSubstr("absent.exr"));
}

/// A version 1.0 file as numpy.save writes it.
std::string npy(const std::string& type, const std::string& shape, const std::string& data, const std::string& order = "False") {
  std::string header = "{'descr': '" + type + "', 'fortran_order': " + order + ", 'shape': " + shape + ", }";
  header.resize((header.size() + 10 + 64) / 64 * 64 - 10, ' ');
  header.back() = '\n';
  return std::string("\x93NUMPY\x01\x00", 8) + static_cast<char>(header.size() & 255) + static_cast<char>(header.size() >> 8) + header + data;
}

TEST(NpyReader, ReadsHalfFloatAndDouble) {
  const ScratchFolder scratch;
  const fs::path file = scratch.path() / "a.npy";
  const auto read = [&](const std::string& bytes) {
    std::ofstream(file, std::ios::binary) << bytes;
    NpyReader reader(file);
    std::vector<Vec3f> rows = reader.read(1);
    for (const Vec3f& row : reader.read(100)) rows.push_back(row);
    EXPECT_TRUE(reader.read(1).empty());
    return rows;
  };
  const std::vector<Vec3f> expected{{1, 0.5f, -2}, {0.25f, 0, 1}};
  EXPECT_EQ(read(npy("<f2", "(2, 3)", std::string("\x00\x3c\x00\x38\x00\xc0\x00\x34\x00\x00\x00\x3c", 12))), expected);
  const float floats[] = {1, 0.5f, -2, 0.25f, 0, 1};
  const double doubles[] = {1, 0.5, -2, 0.25, 0, 1};
  EXPECT_EQ(read(npy("<f4", "(2, 3)", std::string(reinterpret_cast<const char*>(floats), sizeof floats))), expected);
  EXPECT_EQ(read(npy("<f8", "(2, 3)", std::string(reinterpret_cast<const char*>(doubles), sizeof doubles))), expected);
}

TEST(NpyReader, RefusesAllElseCleanly) {
  const ScratchFolder scratch;
  const fs::path file = scratch.path() / "a.npy";
  const std::string data(12, '\0'), good = npy("<f2", "(2, 3)", data);
  const auto open = [&](const std::string& bytes) {
    std::ofstream(file, std::ios::binary) << bytes;
    NpyReader(file).read(100);
  };
  EXPECT_NO_THROW(open(good));
  for (const std::string& bad : {npy(">f2", "(2, 3)", data), npy("<i4", "(1, 3)", data), npy("<f2", "(3, 2)", data), npy("<f2", "(6,)", data), npy("<f2", "(2, 3)", data, "True"),
                                 npy("<f2", "(99999999999999999999, 3)", data), npy("<f2", "(18446744073709551615, 3)", data), npy("<f8", "(6148914691236517206, 3)", data)})
    EXPECT_THROW(open(bad), Error);
  for (std::size_t length = 0; length < good.size(); ++length) EXPECT_THROW(open(good.substr(0, length)), Error) << length;
  for (std::size_t i = 0; i < good.size() - data.size(); ++i)
    for (const int change : {0x00, 0xff, good[i] ^ 1, good[i] ^ 0x10}) {
      std::string bad = good;
      bad[i] = static_cast<char>(change);
      try {
        open(bad);
      } catch (const Error&) {
      }
    }
}

fs::path shared_folder() {
  const char* named = std::getenv("CHIARO_SHARED");
  return named ? fs::path(named) : fs::path(CHIARO_SOURCE_DIR) / ".." / "shared";
}

TEST(CompareImagesOnScenes, SeesTheNoiseOfAPhotograph) {
  const fs::path tower = shared_folder() / "scenes" / "tower";
  if (!fs::exists(tower)) GTEST_SKIP() << "no ../shared/scenes beside the sources";
  CompareImagesOptions options;
  options.mask = tower / "masks/photo_00.png";
  const ImageComparison same = compare_images(tower / "photos/photo_00.exr", tower / "photos/photo_00.exr", options);
  EXPECT_EQ(same.mse, 0);
  EXPECT_EQ(same.flip, 0);
  const ImageComparison other = compare_images(tower / "photos/photo_00.exr", tower / "truth/photo_00_albedo.exr", options);
  EXPECT_GT(other.mse, 0);
  EXPECT_LT(other.ssim, 1);
}

}  // namespace
}  // namespace chiaro::tools
