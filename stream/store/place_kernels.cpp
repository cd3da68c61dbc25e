#include "stream/store/place_kernels.h"

#include "stream/store/lanes.h"

// Plain loops that the compiler turns into vectors, once for each kind of processor. Positions are off the grid in few files: rounding goes through integers in all.
namespace chiaro::stream {
namespace {

constexpr double kMostInteger = 0x1p40;

CHIARO_INLINE void positions_body(const std::int64_t* __restrict k, std::size_t n, GridAxis axis, double* __restrict positions) {
  for (std::size_t i = 0; i < n; ++i) positions[i] = static_cast<double>(k[i]) * axis.scale + axis.add;
}

CHIARO_INLINE void integers_body(const double* __restrict positions, std::size_t n, GridAxis axis, std::int64_t* __restrict k, std::uint8_t* __restrict whole) {
  const double inverse = 1 / axis.scale;
  for (std::size_t i = 0; i < n; ++i) {
    const double place = (positions[i] - axis.add) * inverse, magnitude = place < 0 ? -place : place;
    const double near = magnitude < kMostInteger ? place : 0.0;
    const auto nearest = static_cast<std::int64_t>(near + (near < 0 ? -0.5 : 0.5));
    k[i] = nearest;
    whole[i] = static_cast<std::uint8_t>(whole[i] & static_cast<std::uint8_t>(static_cast<double>(nearest) * axis.scale + axis.add == positions[i]));
  }
}

struct AxisOfRoot {
  double per_unit;
  std::int64_t corner;
};

CHIARO_INLINE void quantise_body(const double* __restrict positions, std::size_t n, AxisOfRoot root, std::int64_t* __restrict q) {
  constexpr std::int64_t kLast = (std::int64_t{1} << kAxisBits) - 1;
  constexpr double kReach = 0x1p61;
  for (std::size_t i = 0; i < n; ++i) {
    const double scaled = positions[i] * root.per_unit;
    const double bounded = scaled > -kReach ? scaled < kReach ? scaled : kReach : -kReach;
    const auto cut = static_cast<std::int64_t>(bounded);
    const std::int64_t cell = cut - static_cast<std::int64_t>(static_cast<double>(cut) > bounded) - root.corner;
    const std::int64_t above = cell < 0 ? 0 : cell;
    q[i] = above > kLast ? kLast : above;
  }
}

CHIARO_INLINE void usable_body(const double* __restrict positions, std::size_t n, double most, std::uint8_t* __restrict usable) {
  for (std::size_t i = 0; i < n; ++i) {
    const double magnitude = positions[i] < 0 ? -positions[i] : positions[i];
    usable[i] = static_cast<std::uint8_t>(usable[i] & static_cast<std::uint8_t>(magnitude <= most));
  }
}

CHIARO_INLINE void morton_body(const std::int64_t* __restrict x, const std::int64_t* __restrict y, const std::int64_t* __restrict z, std::size_t n, AxisBits bits, std::uint64_t* __restrict codes) {
  const std::uint64_t mask = (std::uint64_t{1} << bits.count) - 1;
  for (std::size_t i = 0; i < n; ++i)
    codes[i] = morton_encode(static_cast<std::uint64_t>(x[i]) >> bits.first & mask, static_cast<std::uint64_t>(y[i]) >> bits.first & mask, static_cast<std::uint64_t>(z[i]) >> bits.first & mask);
}

CHIARO_INLINE void decode_body(const std::uint64_t* __restrict codes, std::size_t n, int axis, std::uint16_t* __restrict places) {
  for (std::size_t i = 0; i < n; ++i) places[i] = static_cast<std::uint16_t>(compact_bits(codes[i] >> axis));
}

#if defined(CHIARO_AVX2)
CHIARO_AVX2 void positions_avx2(const std::int64_t* k, std::size_t n, GridAxis axis, double* positions) { positions_body(k, n, axis, positions); }
CHIARO_AVX512 void positions_avx512(const std::int64_t* k, std::size_t n, GridAxis axis, double* positions) { positions_body(k, n, axis, positions); }
CHIARO_AVX2 void integers_avx2(const double* p, std::size_t n, GridAxis axis, std::int64_t* k, std::uint8_t* whole) { integers_body(p, n, axis, k, whole); }
CHIARO_AVX512 void integers_avx512(const double* p, std::size_t n, GridAxis axis, std::int64_t* k, std::uint8_t* whole) { integers_body(p, n, axis, k, whole); }
CHIARO_AVX2 void quantise_avx2(const double* p, std::size_t n, AxisOfRoot root, std::int64_t* q) { quantise_body(p, n, root, q); }
CHIARO_AVX512 void quantise_avx512(const double* p, std::size_t n, AxisOfRoot root, std::int64_t* q) { quantise_body(p, n, root, q); }
CHIARO_AVX2 void usable_avx2(const double* p, std::size_t n, double most, std::uint8_t* usable) { usable_body(p, n, most, usable); }
CHIARO_AVX512 void usable_avx512(const double* p, std::size_t n, double most, std::uint8_t* usable) { usable_body(p, n, most, usable); }
CHIARO_AVX2 void morton_avx2(const std::int64_t* x, const std::int64_t* y, const std::int64_t* z, std::size_t n, AxisBits bits, std::uint64_t* codes) { morton_body(x, y, z, n, bits, codes); }
CHIARO_AVX512 void morton_avx512(const std::int64_t* x, const std::int64_t* y, const std::int64_t* z, std::size_t n, AxisBits bits, std::uint64_t* codes) { morton_body(x, y, z, n, bits, codes); }
CHIARO_AVX2 void decode_avx2(const std::uint64_t* codes, std::size_t n, int axis, std::uint16_t* places) { decode_body(codes, n, axis, places); }
CHIARO_AVX512 void decode_avx512(const std::uint64_t* codes, std::size_t n, int axis, std::uint16_t* places) { decode_body(codes, n, axis, places); }
#endif

struct Kernels {
  decltype(&positions_body) positions;
  decltype(&integers_body) integers;
  decltype(&quantise_body) quantise;
  decltype(&usable_body) usable;
  decltype(&morton_body) morton;
  decltype(&decode_body) decode;
};

Kernels kernels() {
#if defined(CHIARO_AVX2)
  if (vector_width() == VectorWidth::kAvx512) return {positions_avx512, integers_avx512, quantise_avx512, usable_avx512, morton_avx512, decode_avx512};
  if (vector_width() == VectorWidth::kAvx2) return {positions_avx2, integers_avx2, quantise_avx2, usable_avx2, morton_avx2, decode_avx2};
#endif
  return {positions_body, integers_body, quantise_body, usable_body, morton_body, decode_body};
}

}  // namespace

void positions_of(std::span<const std::int64_t> k, GridAxis axis, double* positions) { kernels().positions(k.data(), k.size(), axis, positions); }

void integers_of(std::span<const double> positions, GridAxis axis, std::int64_t* k, std::uint8_t* whole) { kernels().integers(positions.data(), positions.size(), axis, k, whole); }

void quantise(std::span<const double> positions, const RootCube& root, std::size_t axis, std::int64_t* q) {
  const AxisOfRoot of_root{root.per_unit(), root.corner[axis]};
  kernels().quantise(positions.data(), positions.size(), of_root, q);
}

void clear_unusable(std::span<const double> positions, double most, std::uint8_t* usable) { kernels().usable(positions.data(), positions.size(), most, usable); }

void morton_codes(const AxisColumns<std::int64_t>& q, AxisBits bits, std::span<std::uint64_t> codes) {
  kernels().morton(q.of[0].data(), q.of[1].data(), q.of[2].data(), codes.size(), bits, codes.data());
}

void places_of_codes(std::span<const std::uint64_t> codes, AxisColumns<std::uint16_t>& places) {
  places.resize(codes.size());
  const Kernels k = kernels();
  for (int axis = 0; axis < 3; ++axis) k.decode(codes.data(), codes.size(), axis, places.of[static_cast<std::size_t>(axis)].data());
}

}  // namespace chiaro::stream
