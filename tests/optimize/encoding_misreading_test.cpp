#include "optimize/encoding_misreading.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <cmath>
#include <functional>
#include <vector>

#include "stream/base/rng.h"

namespace chiaro::optimize {
namespace {

using testing::HasSubstr;

constexpr double kPi = 3.14159265358979, kNoise = 0.01;

Lights lights() {
  Lights x;
  x.flash_intensity = 1;
  x.sky[0] = 0.02;
  return x;
}

/// Places lit in three photographs by a flash from three distances, with values that `curve` makes of linear ones.
std::vector<LightSample> samples_of(const std::function<double(double)>& curve, double noise = kNoise) {
  std::vector<LightSample> samples;
  for (std::uint32_t i = 0; i < 400; ++i) {
    const auto u = uniform01x4(7, Purpose::kTest, i, 0);
    const double albedo = 0.2 + 0.6 * static_cast<double>(u[3]);
    for (std::uint32_t k = 0; k < 3; ++k) {
      LightSample s;
      s.group = i;
      s.photograph = k;
      s.flash = 0.1f + 0.7f * static_cast<float>(u[k]) * static_cast<float>(k + 1);
      s.sky[0] = static_cast<float>(kPi);
      s.variance = static_cast<float>(kNoise * kNoise);
      const double b = albedo * (static_cast<double>(s.flash) + 0.02 * kPi) * std::exp(noise * normal01(8, Purpose::kTest, 10 * i + k, 0));
      s.radiosity.fill(static_cast<float>(kPi * curve(b / kPi)));
      samples.push_back(s);
    }
  }
  return samples;
}

double linear(double v) { return v; }
double encoded(double v) { return v <= 0.0031308 ? v * 12.92 : 1.055 * std::pow(v, 1 / 2.4) - 0.055; }
double decoded(double v) { return v <= 0.04045 ? v / 12.92 : std::pow((v + 0.055) / 1.055, 2.4); }

TEST(EncodingMisreading, LinearValuesAreLeftAlone) { EXPECT_FALSE(find_encoding_misreading(samples_of(linear), {}, lights())); }

TEST(EncodingMisreading, ACurveThatWasNotTakenOffIsNoticed) {
  const auto found = find_encoding_misreading(samples_of(encoded), {}, lights());
  ASSERT_TRUE(found);
  EXPECT_EQ(found->change, CurveChange::kDecode);
  EXPECT_LT(found->scatter, kNoise);   // as the curve makes it smaller
  EXPECT_THAT(encoding_note(*found), HasSubstr("write encoding = \"srgb\""));
}

TEST(EncodingMisreading, ACurveThatWasTakenOffLinearValuesIsNoticed) {
  const auto found = find_encoding_misreading(samples_of(decoded), {}, lights());
  ASSERT_TRUE(found);
  EXPECT_EQ(found->change, CurveChange::kEncode);
  EXPECT_THAT(encoding_note(*found), HasSubstr("write encoding = \"linear\""));
}

TEST(EncodingMisreading, SurfacesThatNothingExplainsSayNothing) {
  ASSERT_TRUE(find_encoding_misreading(samples_of(decoded, 0.05), {}, lights()));
  EXPECT_FALSE(find_encoding_misreading(samples_of(decoded, 0.25), {}, lights()));
}

TEST(EncodingMisreading, ValuesBeyondWhiteHaveNoCurve) { EXPECT_FALSE(find_encoding_misreading(samples_of([](double v) { return 4 * encoded(v); }), {}, lights())); }

TEST(EncodingMisreading, AFewPlacesSayNothing) {
  std::vector<LightSample> samples = samples_of(encoded);
  samples.resize(80 * 3);
  EXPECT_FALSE(find_encoding_misreading(samples, {}, lights()));
}

}  // namespace
}  // namespace chiaro::optimize
