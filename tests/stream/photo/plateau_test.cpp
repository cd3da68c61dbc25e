#include "stream/photo/plateau.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <limits>

#include "stream/base/rng.h"

namespace chiaro::stream {
namespace {

std::optional<float> level_of(const std::vector<float>& values) {
  PlateauFinder finder;
  const std::vector<std::uint8_t> all(values.size(), 1);
  const std::size_t half = values.size() / 2;   // as it comes
  finder.add(std::span(values).first(half), std::span(all).first(half));
  finder.add(std::span(values).subspan(half), std::span(all).subspan(half));
  return finder.level();
}

/// As a half float of the same sign and exponent holds it.
float rounded_to_half(double v) {
  const double step = std::ldexp(1.0, std::ilogb(v) - 10);
  return static_cast<float>(std::round(v / step) * step);
}

/// A highlight 300 pixels wide on a ground, and noise about it.
std::vector<float> highlight(double noise, bool half) {
  std::vector<float> values;
  for (int y = 0; y < 400; ++y)
    for (int x = 0; x < 400; ++x) {
      const double d2 = (std::pow(x - 190.3, 2) + std::pow(y - 205.7, 2)) / (150.0 * 150.0);
      const double v = (0.3 + 0.6 * std::exp(-d2)) * std::exp(noise * normal01(5, Purpose::kTest, static_cast<std::uint64_t>(400 * y + x), 0));
      values.push_back(half ? rounded_to_half(v) : static_cast<float>(v));
    }
  return values;
}

TEST(Plateau, PicturesThatAreNotClippedHaveNone) {
  for (const double noise : {0.0, 0.001, 0.02})
    for (const bool half : {false, true}) EXPECT_FALSE(level_of(highlight(noise, half))) << noise << " " << half;
  EXPECT_FALSE(level_of({}));
  EXPECT_FALSE(level_of(std::vector<float>(5000, 0.5f))) << "a picture of one value is none";
  EXPECT_FALSE(level_of(std::vector<float>(5000, -1.0f)));
}

TEST(Plateau, IsWhereValuesWereClipped) {
  for (const double noise : {0.0, 0.001, 0.02})
    for (const bool half : {false, true})
      for (const float white : {0.5f, 0.75f, 0.85f}) {
        std::vector<float> values = highlight(noise, half);
        for (float& v : values) v = std::min(v, white);
        ASSERT_TRUE(level_of(values)) << noise << " " << half << " " << white;
        EXPECT_LE(*level_of(values), white);
        EXPECT_NEAR(*level_of(values), white, 2e-6 * static_cast<double>(white));
      }
}

TEST(Plateau, IsFoundThoughAFactorWasRounded) {
  std::vector<float> values = highlight(0.02, false);
  for (std::size_t i = 0; i < values.size(); ++i) {
    values[i] = std::min(values[i], 0.7f) * 1.7f;
    if (i % 3 == 0) values[i] = std::nextafter(values[i], 0.0f);
  }
  ASSERT_TRUE(level_of(values));
  EXPECT_LE(*level_of(values), std::nextafter(0.7f * 1.7f, 0.0f));
}

TEST(Plateau, AFewPixelsAreNone) {
  std::vector<float> values = highlight(0.02, false);
  std::sort(values.begin(), values.end());
  const float white = values[values.size() - 20];
  for (float& v : values) v = std::min(v, white);
  EXPECT_FALSE(level_of(values));
}

TEST(Plateau, WhatIsNotFiniteOrNotUsableDoesNotCount) {
  std::vector<float> values = highlight(0.02, false);
  std::vector<std::uint8_t> usable(values.size(), 1);
  for (std::size_t i = 0; i < 100; ++i) values[i] = i % 2 ? std::numeric_limits<float>::infinity() : std::numeric_limits<float>::quiet_NaN();
  for (std::size_t i = 100; i < 200; ++i) {
    values[i] = 50;
    usable[i] = 0;
  }
  PlateauFinder finder;
  finder.add(values, usable);
  EXPECT_FALSE(finder.level());
}

}  // namespace
}  // namespace chiaro::stream
