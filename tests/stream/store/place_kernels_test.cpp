#include "stream/store/place_kernels.h"

#include <gtest/gtest.h>

#include <cmath>
#include <limits>
#include <vector>

#include "stream/base/vector_width.h"

namespace chiaro::stream {
namespace {

template <class F>
void for_each_width(const F& body) {
  for (const VectorWidth width : {VectorWidth::kPlain, VectorWidth::kAvx2, VectorWidth::kAvx512}) {
    limit_vectors(width);
    body();
  }
  limit_vectors(VectorWidth::kAvx512);
}

// Not a multiple of any number of lanes; both signs; fractions, cell borders, and what is no place at all.
std::vector<double> places() {
  std::vector<double> p;
  for (int i = -60; i < 61; ++i) p.push_back(i * 0.37 + 1e-9 * i);
  for (const double v : {0.0, -0.0, 1.0, -1.0, 0.5, -0.5, 1e9, -1e9, 1e9 + 1, 1e300, -1e300}) p.push_back(v);
  for (const double v : {std::numeric_limits<double>::quiet_NaN(), std::numeric_limits<double>::infinity(), -std::numeric_limits<double>::infinity()}) p.push_back(v);
  return p;
}

TEST(PlaceKernels, QuantiseFloorsAndClampsAsTheRootDoes) {
  RootCube root;
  root.exponent = 4;
  const std::int64_t unit = std::int64_t{1} << (kAxisBits - 4);   // to a project unit
  root.corner = {-8 * unit, 0, 3 * unit};
  const std::vector<double> p = places();
  for_each_width([&] {
    for (std::size_t axis = 0; axis < 3; ++axis) {
      std::vector<std::int64_t> q(p.size());
      quantise(p, root, axis, q.data());
      for (std::size_t i = 0; i < p.size(); ++i) {
        if (!(std::abs(p[i]) <= 1e9)) continue;
        const double expected = std::floor(std::ldexp(p[i], kAxisBits - 4)) - static_cast<double>(root.corner[axis]);
        EXPECT_EQ(q[i], static_cast<std::int64_t>(std::min(std::max(expected, 0.0), std::ldexp(1.0, kAxisBits) - 1))) << p[i];
      }
      for (const std::int64_t cell : q) EXPECT_TRUE(cell >= 0 && cell < (std::int64_t{1} << kAxisBits));
    }
  });
}

TEST(PlaceKernels, WhatIsOffTheGridIsFound) {
  const GridAxis axis{0.001, 12.5};
  std::vector<double> on, off = places();
  for (std::int64_t k = -70; k < 70; ++k) on.push_back(static_cast<double>(k * 1'234'567) * axis.scale + axis.add);
  for_each_width([&] {
    std::vector<std::int64_t> k(on.size());
    std::vector<std::uint8_t> whole(on.size(), 1);
    whole[3] = 0;   // what is cleared stays so
    integers_of(on, axis, k.data(), whole.data());
    std::vector<double> back(on.size());
    positions_of(k, axis, back.data());
    for (std::size_t i = 0; i < on.size(); ++i) {
      EXPECT_EQ(k[i], (static_cast<std::int64_t>(i) - 70) * 1'234'567);
      EXPECT_EQ(back[i], on[i]);
      EXPECT_EQ(whole[i], i == 3 ? 0 : 1);
    }
    k.resize(off.size());
    whole.assign(off.size(), 1);
    integers_of(off, axis, k.data(), whole.data());
    for (std::size_t i = 0; i < off.size(); ++i) {
      const double nearest = std::round((off[i] - axis.add) / axis.scale);
      const bool on_grid = std::abs(nearest) < 0x1p40 && nearest * axis.scale + axis.add == off[i];
      EXPECT_EQ(whole[i], on_grid) << off[i];
    }
  });
}

TEST(PlaceKernels, WhatCannotBeUsedIsCleared) {
  const std::vector<double> p = places();
  for_each_width([&] {
    std::vector<std::uint8_t> usable(p.size(), 1);
    usable[0] = 0;
    clear_unusable(p, 1e9, usable.data());
    for (std::size_t i = 0; i < p.size(); ++i) EXPECT_EQ(usable[i], i != 0 && std::isfinite(p[i]) && std::abs(p[i]) <= 1e9) << p[i];
  });
}

TEST(PlaceKernels, MortonCodesTakeTheBitsAskedFor) {
  AxisColumns<std::int64_t> q;
  for (std::size_t axis = 0; axis < 3; ++axis)
    for (std::int64_t i = 0; i < 43; ++i) q.of[axis].push_back((i * 0x2545f4914f + 977 * static_cast<std::int64_t>(axis)) & ((std::int64_t{1} << kAxisBits) - 1));
  for_each_width([&] {
    for (const AxisBits bits : {AxisBits{0, 16}, AxisBits{16, 21}, AxisBits{30, 7}}) {
      std::vector<std::uint64_t> codes(43);
      morton_codes(q, bits, codes);
      for (std::size_t i = 0; i < codes.size(); ++i) {
        const auto axes = morton_decode(codes[i]);
        for (std::size_t a = 0; a < 3; ++a) EXPECT_EQ(axes[a], (q.of[a][i] >> bits.first) % (std::int64_t{1} << bits.count));
      }
      if (bits.count > 16) continue;
      AxisColumns<std::uint16_t> places;
      places_of_codes(codes, places);
      for (std::size_t a = 0; a < 3; ++a) {
        ASSERT_EQ(places.of[a].size(), codes.size());
        for (std::size_t i = 0; i < codes.size(); ++i) EXPECT_EQ(places.of[a][i], (q.of[a][i] >> bits.first) % (std::int64_t{1} << bits.count));
      }
    }
  });
}

}  // namespace
}  // namespace chiaro::stream
