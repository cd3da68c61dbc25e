#include "tools/metrics.h"

#include <gtest/gtest.h>

#include <cmath>
#include <functional>
#include <limits>

#include "stream/base/parallel.h"
#include "stream/base/rng.h"
#include "stream/photo/image_io.h"
#include "tools/colour_spaces.h"

namespace chiaro::tools {
namespace {

constexpr float kNanF = std::numeric_limits<float>::quiet_NaN();

struct Picture {
  int width = 0, height = 0, channels = 3;
  std::vector<float> values;
  PixelView view() const { return {width, height, channels, values}; }
  float& at(int x, int y, int c) { return values[(static_cast<std::size_t>(y) * width + x) * channels + c]; }
};

Picture make(int width, int height, const std::function<double(double, double, double)>& f, int channels = 3) {
  Picture picture{width, height, channels, std::vector<float>(static_cast<std::size_t>(width) * height * channels)};
  for (int y = 0; y < height; ++y)
    for (int x = 0; x < width; ++x)
      for (int c = 0; c < channels; ++c) picture.at(x, y, c) = static_cast<float>(f(x, y, c));
  return picture;
}

Picture as_linear(Picture srgb) {
  for (float& v : srgb.values) v = static_cast<float>(stream::linear_from_srgb(v));
  return srgb;
}

// The pictures of tests/peers/metrics_reference.py.
constexpr int kWidth = 72, kHeight = 56;
double wave(double x, double y, double c) { return 0.5 + 0.28 * std::sin(0.31 * x + 0.17 * y + c) + 0.17 * std::cos(0.011 * x * y - 0.7 * c); }
Picture waves() { return make(kWidth, kHeight, [](double x, double y, double c) { return std::clamp(wave(x, y, c), 0.0, 1.0); }); }
Picture waves_test() {
  return make(kWidth, kHeight, [](double x, double y, double c) { return std::clamp(1.04 * wave(x, y, c) + 0.05 * std::sin(0.9 * x - 0.4 * y + 2 * c), 0.0, 1.0); });
}
Picture board(double shift) {
  return make(kWidth, kHeight, [shift](double x, double y, double c) {
    const bool odd = std::fmod(std::floor((x + shift) / 9) + std::floor(y / 7), 2) > 0;
    return odd ? 0.85 - 0.25 * c : 0.08 + 0.2 * c;
  });
}

TEST(Psnr, IsTwentyDecibelsForATenth) {
  const Picture a = make(4, 3, [](double, double, double) { return 0.6; }), b = make(4, 3, [](double, double, double) { return 0.5; });
  EXPECT_NEAR(mse(a.view(), b.view()), 0.01, 1e-8);
  EXPECT_NEAR(psnr(a.view(), b.view()), 20, 1e-5);
  EXPECT_NEAR(psnr(a.view(), b.view(), {}, 10), 40, 1e-5);
  EXPECT_NEAR(relative_error(a.view(), b.view()), 0.2, 1e-6);
  EXPECT_EQ(psnr(a.view(), a.view()), std::numeric_limits<double>::infinity());
}

TEST(Mse, LooksOnlyWhereTheMaskIsSet) {
  Picture a = make(4, 2, [](double, double, double) { return 0.5; });
  const Picture b = a;
  a.at(3, 1, 0) = kNanF;
  a.at(0, 0, 1) = 0.8f;
  std::vector<std::uint8_t> mask(8, 255);
  EXPECT_TRUE(std::isnan(mse(a.view(), b.view(), mask)));
  mask[7] = 0;
  EXPECT_NEAR(mse(a.view(), b.view(), mask), 0.09 / 21, 1e-7);
  mask.assign(8, 0);
  EXPECT_TRUE(std::isnan(mse(a.view(), b.view(), mask))) << "an empty mask is no perfect match";
}

TEST(RelativeError, LeavesDarkReferencesOut) {
  Picture a = make(2, 1, [](double, double, double) { return 1; }), b = make(2, 1, [](double x, double, double) { return x > 0 ? 0.5 : 0.0; });
  EXPECT_NEAR(relative_error(a.view(), b.view()), 1.0, 1e-12);
  EXPECT_TRUE(std::isnan(relative_error(a.view(), b.view(), {}, 0.5)));
}

TEST(Metrics, RefusePicturesOfDifferentShape) {
  const Picture a = make(4, 3, [](double, double, double) { return 0; }), b = make(3, 4, [](double, double, double) { return 0; });
  EXPECT_THROW(mse(a.view(), b.view()), std::invalid_argument);
  EXPECT_THROW(ssim(a.view(), b.view()), std::invalid_argument);
  EXPECT_THROW(flip(a.view(), b.view()), std::invalid_argument);
  EXPECT_THROW(mse(a.view(), a.view(), std::vector<std::uint8_t>(5, 1)), std::invalid_argument);
  EXPECT_THROW(mse({4, 3, 3, std::span(a.values).first(7)}, a.view()), std::invalid_argument);
}

// The constants below are what scikit-image 0.26 and flip-evaluator 1.7 say: tests/peers/metrics_reference.py prints them.

TEST(Ssim, AgreesWithScikitImage) {
  const double kTol = 2e-6;  // the pictures are float here and double there
  const Picture a = waves(), b = waves_test(), c = board(0), d = board(1);
  const auto grey = [](const Picture& p) { return Picture{p.width, p.height, 1, luminance(p.view())}; };
  EXPECT_NEAR(mse(b.view(), a.view()), 0.00173394027566351, 1e-9);
  EXPECT_NEAR(ssim(grey(b).view(), grey(a).view()), 0.971464134178547, kTol);
  EXPECT_NEAR(ssim(b.view(), a.view()), 0.937043163485927, kTol);
  EXPECT_NEAR(mse(d.view(), c.view()), 0.0263777777777778, 1e-8);
  EXPECT_NEAR(ssim(grey(d).view(), grey(c).view()), 0.717928937487531, kTol);
  EXPECT_NEAR(ssim(d.view(), c.view()), 0.727842339291459, kTol);
}

TEST(Ssim, IsOneForEqualPicturesAndNothingForTinyOnes) {
  const Picture a = waves();
  EXPECT_NEAR(ssim(a.view(), a.view()), 1, 1e-12);
  const Picture tiny = make(10, 40, [](double, double, double) { return 0.3; });
  EXPECT_TRUE(std::isnan(ssim(tiny.view(), tiny.view())));
}

TEST(Ssim, WithAFullMaskEqualsTheOneWithout) {
  const Picture a = waves(), b = waves_test();
  EXPECT_DOUBLE_EQ(ssim(b.view(), a.view(), std::vector<std::uint8_t>(kWidth * kHeight, 1)), ssim(b.view(), a.view()));
}

TEST(Ssim, IgnoresWhatLiesOutsideTheMask) {
  const Picture a = waves(), b = waves_test();
  std::vector<std::uint8_t> mask(kWidth * kHeight, 0);
  for (int y = 4; y < 50; ++y)
    for (int x = 10; x < 60; ++x) mask[y * kWidth + x] = (x - 35) * (x - 35) + (y - 27) * (y - 27) < 22 * 22;
  Picture spoiled = b;
  for (int i = 0; i < kWidth * kHeight; ++i)
    if (!mask[i])
      for (int c = 0; c < 3; ++c) spoiled.values[i * 3 + c] = i % 2 ? kNanF : 1e9f;
  EXPECT_EQ(ssim(b.view(), a.view(), mask), ssim(spoiled.view(), a.view(), mask));
  EXPECT_EQ(flip(b.view(), a.view(), mask).mean, flip(spoiled.view(), a.view(), mask).mean);
  EXPECT_EQ(mse(b.view(), a.view(), mask), mse(spoiled.view(), a.view(), mask));
}

/// The definition, written down plainly: one pixel, a window cut by the mask.
double plain_masked_ssim(const Picture& a, const Picture& b, const std::vector<std::uint8_t>& mask, int x, int y, int c) {
  double sum_w = 0, sa = 0, sb = 0, saa = 0, sbb = 0, sab = 0;
  for (int dy = -5; dy <= 5; ++dy)
    for (int dx = -5; dx <= 5; ++dx) {
      const std::size_t p = static_cast<std::size_t>(y + dy) * a.width + x + dx;
      if (!mask[p]) continue;
      const double w = std::exp(-(dx * dx + dy * dy) / (2 * 1.5 * 1.5)), u = a.values[p * 3 + c], v = b.values[p * 3 + c];
      sum_w += w, sa += w * u, sb += w * v, saa += w * u * u, sbb += w * v * v, sab += w * u * v;
    }
  const double ma = sa / sum_w, mb = sb / sum_w;
  return (2 * ma * mb + 1e-4) * (2 * (sab / sum_w - ma * mb) + 9e-4) / ((ma * ma + mb * mb + 1e-4) * (saa / sum_w - ma * ma + sbb / sum_w - mb * mb + 9e-4));
}

TEST(Ssim, NormalisesWindowsThatTheMaskCuts) {
  const Picture a = waves(), b = waves_test();
  // A disc that leaves only its centre 5 px inside, while the window's corners stick out.
  std::vector<std::uint8_t> mask(kWidth * kHeight, 0);
  for (int y = 0; y < kHeight; ++y)
    for (int x = 0; x < kWidth; ++x) mask[y * kWidth + x] = (x - 30) * (x - 30) + (y - 25) * (y - 25) <= 25;
  double expected = 0;
  for (int c = 0; c < 3; ++c) expected += plain_masked_ssim(b, a, mask, 30, 25, c) / 3;
  EXPECT_NEAR(ssim(b.view(), a.view(), mask), expected, 1e-12);
}

TEST(Flip, AgreesWithTheEvaluatorOfItsAuthors) {
  const double kTol = 2e-5, kPixelTol = 1e-4;  // that one computes in float
  const Picture a = waves(), b = waves_test(), c = board(0), d = board(1);
  FlipOptions options;
  options.keep_map = true;
  EXPECT_NEAR(flip(b.view(), a.view()).mean, 0.151986271, kTol);
  EXPECT_NEAR(flip(d.view(), c.view()).mean, 0.193255961, kTol);
  const FlipResult result = flip(as_linear(b).view(), as_linear(a).view(), {}, options);
  EXPECT_NEAR(result.mean, 0.207542405, kTol);
  EXPECT_NEAR(result.map[20 * kWidth + 10], 0.219033614, kPixelTol);
  EXPECT_NEAR(result.map[0], 0.444449335, kPixelTol);
  EXPECT_NEAR(result.map[55 * kWidth + 71], 0.195126861, kPixelTol);
  const FlipResult boards = flip(as_linear(d).view(), as_linear(c).view(), {}, options);
  EXPECT_NEAR(boards.mean, 0.212082773, kTol);
  EXPECT_NEAR(boards.map[20 * kWidth + 10], 0.113883756, kPixelTol);
  EXPECT_NEAR(boards.map[0], 0.0110067055, kPixelTol);
  EXPECT_NEAR(boards.map[55 * kWidth + 71], 0.947513878, kPixelTol);
}

TEST(Flip, IsZeroForEqualAndOneForOppositePictures) {
  const Picture a = waves();
  EXPECT_EQ(flip(a.view(), a.view()).mean, 0);
  // Green against blue is the largest colour difference; without edges it is the whole error.
  const Picture green = make(30, 30, [](double, double, double c) { return c == 1; }), blue = make(30, 30, [](double, double, double c) { return c == 2; });
  EXPECT_NEAR(flip(green.view(), blue.view()).mean, 1, 1e-6);
}

TEST(Flip, DoesNotHideNonFinitePixels) {
  Picture a = waves();
  const Picture b = a;
  a.at(3, 3, 0) = kNanF;
  EXPECT_TRUE(std::isnan(flip(a.view(), b.view()).mean));
  EXPECT_TRUE(std::isnan(ssim(a.view(), b.view())));
  EXPECT_TRUE(std::isnan(relative_error(a.view(), b.view())));
}

TEST(Metrics, AreTheSameBitsForAnyThreadCount) {
  const Picture a = make(200, 150, [](double x, double y, double c) { return uniform01(1, Purpose::kTest, static_cast<std::uint64_t>(y * 200 + x), static_cast<std::uint32_t>(c)); });
  const Picture b = make(200, 150, [](double x, double y, double c) { return uniform01(2, Purpose::kTest, static_cast<std::uint64_t>(y * 200 + x), static_cast<std::uint32_t>(c)); });
  const auto all = [&](int threads) {
    const ThreadLimit limit(threads);
    return std::array{mse(a.view(), b.view()), ssim(a.view(), b.view()), flip(a.view(), b.view()).mean, relative_error(a.view(), b.view()), mean_delta_e_2000(a.view(), b.view())};
  };
  EXPECT_EQ(all(1), all(8));
}

TEST(Lab, GivesWhiteAndTheKnownRed) {
  const auto white = lab_from_linear({1, 1, 1});
  EXPECT_NEAR(white[0], 100, 1e-12);
  EXPECT_NEAR(white[1], 0, 1e-12);
  EXPECT_NEAR(white[2], 0, 1e-12);
  const auto red = lab_from_linear({1, 0, 0});
  EXPECT_NEAR(red[0], 53.24, 0.01);  // the commonly tabulated values of sRGB red
  EXPECT_NEAR(red[1], 80.09, 0.02);
  EXPECT_NEAR(red[2], 67.20, 0.02);
}

TEST(DeltaE2000, AgreesWithThePublishedPairs) {
  struct Pair {
    std::array<double, 3> a, b;
    double delta_e;
  };
  // Sharma, Wu, Dalal 2005, table 1.
  const Pair pairs[] = {
      {{50, 2.6772, -79.7751}, {50, 0, -82.7485}, 2.0425},           {{50, 3.1571, -77.2803}, {50, 0, -82.7485}, 2.8615},
      {{50, 2.8361, -74.0200}, {50, 0, -82.7485}, 3.4412},           {{50, -1.3802, -84.2814}, {50, 0, -82.7485}, 1.0000},
      {{50, -1.1848, -84.8006}, {50, 0, -82.7485}, 1.0000},          {{50, -0.9009, -85.5211}, {50, 0, -82.7485}, 1.0000},
      {{50, 0, 0}, {50, -1, 2}, 2.3669},                             {{50, -1, 2}, {50, 0, 0}, 2.3669},
      {{50, 2.49, -0.001}, {50, -2.49, 0.0009}, 7.1792},             {{50, 2.49, -0.001}, {50, -2.49, 0.001}, 7.1792},
      {{50, 2.49, -0.001}, {50, -2.49, 0.0011}, 7.2195},             {{50, 2.49, -0.001}, {50, -2.49, 0.0012}, 7.2195},
      {{50, -0.001, 2.49}, {50, 0.0009, -2.49}, 4.8045},             {{50, -0.001, 2.49}, {50, 0.001, -2.49}, 4.8045},
      {{50, -0.001, 2.49}, {50, 0.0011, -2.49}, 4.7461},             {{50, 2.5, 0}, {50, 0, -2.5}, 4.3065},
      {{50, 2.5, 0}, {73, 25, -18}, 27.1492},                        {{50, 2.5, 0}, {61, -5, 29}, 22.8977},
      {{50, 2.5, 0}, {56, -27, -3}, 31.9030},                        {{50, 2.5, 0}, {58, 24, 15}, 19.4535},
      {{50, 2.5, 0}, {50, 3.1736, 0.5854}, 1.0000},                  {{50, 2.5, 0}, {50, 3.2972, 0}, 1.0000},
      {{50, 2.5, 0}, {50, 1.8634, 0.5757}, 1.0000},                  {{50, 2.5, 0}, {50, 3.2592, 0.3350}, 1.0000},
      {{60.2574, -34.0099, 36.2677}, {60.4626, -34.1751, 39.4387}, 1.2644}, {{63.0109, -31.0961, -5.8663}, {62.8187, -29.7946, -4.0864}, 1.2630},
      {{61.2901, 3.7196, -5.3901}, {61.4292, 2.2480, -4.9620}, 1.8731},     {{35.0831, -44.1164, 3.7933}, {35.0232, -40.0716, 1.5901}, 1.8645},
      {{22.7233, 20.0904, -46.6940}, {23.0331, 14.9730, -42.5619}, 2.0373}, {{36.4612, 47.8580, 18.3852}, {36.2715, 50.5065, 21.2231}, 1.4146},
      {{90.8027, -2.0831, 1.4410}, {91.1528, -1.6435, 0.0447}, 1.4441},     {{90.9257, -0.5406, -0.9208}, {88.6381, -0.8985, -0.7239}, 1.5381},
      {{6.7747, -0.2908, -2.4247}, {5.8714, -0.0985, -2.2286}, 0.6377},     {{2.0776, 0.0795, -1.1350}, {0.9033, -0.0636, -0.5514}, 0.9082}};
  for (const Pair& pair : pairs) {
    EXPECT_NEAR(delta_e_2000(pair.a, pair.b), pair.delta_e, 5.1e-5) << pair.a[0] << ' ' << pair.a[1] << ' ' << pair.a[2];
    EXPECT_NEAR(delta_e_2000(pair.b, pair.a), pair.delta_e, 5.1e-5);
  }
}

}  // namespace
}  // namespace chiaro::tools
