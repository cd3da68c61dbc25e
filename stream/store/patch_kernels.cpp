#include "stream/store/patch_kernels.h"

#include <algorithm>

#include "stream/store/lanes.h"

namespace chiaro::stream {
namespace {

constexpr std::size_t kWide = 16;
typedef std::uint16_t Values __attribute__((vector_size(2 * kWide)));

CHIARO_INLINE void least_body(const std::uint16_t* v, std::size_t n, ValueRange& range) {
  std::uint16_t low = range.low, high = range.high;
  for (std::size_t i = 0; i < n; ++i) {
    low = v[i] < low ? v[i] : low;
    high = v[i] > high ? v[i] : high;
  }
  range = {low, high};
}

// Sums of 16 bits a lane suffice: a chunk has at most 65536 positions.
CHIARO_INLINE std::uint32_t count_body(const std::uint16_t* v, std::size_t n, std::uint16_t limit) {
  Values sum{};
  const Values limits = Values{} + limit;
  std::size_t i = 0;
  for (; i + kWide <= n; i += kWide) {
    Values values;
    load(v + i, values);
    sum -= reinterpret_cast<Values>(values < limits);
  }
  std::uint32_t count = 0;
  for (std::size_t lane = 0; lane < kWide; ++lane) count += sum[lane];
  for (; i < n; ++i) count += v[i] < limit;
  return count;
}

struct Places {
  std::size_t kept, moved;   ///< where the next one goes, in the columns and in the room
  std::uint32_t equals;      ///< so many at the value have been seen
};

void divide_plain(PatchColumns& c, std::size_t first, std::size_t last, const PatchCut& cut, PatchColumns& room, Places& at) {
  for (std::size_t i = first; i < last; ++i) {
    const std::uint16_t v = c.of[cut.axis][i];
    const bool stays = (v < cut.value) | ((v == cut.value) & (at.equals < cut.equals));
    at.equals += v == cut.value;
    for (std::size_t column = 0; column < PatchColumns::kColumns; ++column) {
      const std::uint16_t moves = c.of[column][i];
      c.of[column][at.kept] = moves;
      room.of[column][at.moved] = moves;
    }
    at.kept += stays;
    at.moved += !stays;
  }
}

#if defined(CHIARO_AVX2)
// Which bytes to take so that the numbers of 16 bits of a mask come first.
struct ShortCompression {
  alignas(16) std::uint8_t byte[256][16];
  constexpr ShortCompression() : byte{} {
    for (int mask = 0; mask < 256; ++mask) {
      int n = 0;
      for (int i = 0; i < 8; ++i) {
        if ((mask & (1 << i)) == 0) continue;
        byte[mask][n++] = static_cast<std::uint8_t>(2 * i);
        byte[mask][n++] = static_cast<std::uint8_t>(2 * i + 1);
      }
    }
  }
};
constexpr ShortCompression kShortCompression;

CHIARO_AVX2 void least_avx2(const std::uint16_t* v, std::size_t n, ValueRange& range) { least_body(v, n, range); }
CHIARO_AVX2 std::uint32_t count_avx2(const std::uint16_t* v, std::size_t n, std::uint16_t limit) { return count_body(v, n, limit); }

CHIARO_AVX2 inline unsigned mask_of(__m128i lanes) { return static_cast<unsigned>(_mm_movemask_epi8(_mm_packs_epi16(lanes, _mm_setzero_si128()))); }

// Returns where it stopped. What is stored beyond the last one kept has been read before.
CHIARO_AVX2 std::size_t divide_avx2(PatchColumns& c, std::size_t first, std::size_t last, const PatchCut& cut, PatchColumns& room, Places& at) {
  std::array<std::uint16_t*, PatchColumns::kColumns> from, to;
  for (std::size_t column = 0; column < from.size(); ++column) {
    from[column] = c.of[column].data();
    to[column] = room.of[column].data();
  }
  const std::uint16_t* const values = from[cut.axis];
  const __m128i value = _mm_set1_epi16(static_cast<short>(cut.value));
  std::size_t i = first;
  for (; i + 8 <= last; i += 8) {
    const __m128i v = _mm_loadu_si128(reinterpret_cast<const __m128i*>(values + i));
    const unsigned equal = mask_of(_mm_cmpeq_epi16(v, value)), up_to = mask_of(_mm_cmpeq_epi16(_mm_min_epu16(v, value), v));
    unsigned stays = up_to & ~equal;
    if (equal != 0)
      for (unsigned left = equal; left != 0; left &= left - 1)
        if (at.equals++ < cut.equals) stays |= left & (0u - left);
    const __m128i keep = _mm_load_si128(reinterpret_cast<const __m128i*>(kShortCompression.byte[stays]));
    const __m128i move = _mm_load_si128(reinterpret_cast<const __m128i*>(kShortCompression.byte[~stays & 0xff]));
    for (std::size_t column = 0; column < from.size(); ++column) {
      const __m128i moves = _mm_loadu_si128(reinterpret_cast<const __m128i*>(from[column] + i));
      _mm_storeu_si128(reinterpret_cast<__m128i*>(from[column] + at.kept), _mm_shuffle_epi8(moves, keep));
      _mm_storeu_si128(reinterpret_cast<__m128i*>(to[column] + at.moved), _mm_shuffle_epi8(moves, move));
    }
    const auto kept = static_cast<std::size_t>(_mm_popcnt_u32(stays));
    at.kept += kept;
    at.moved += 8 - kept;
  }
  return i;
}
#endif

}  // namespace

void PatchColumns::make_room(std::size_t count) {
  for (std::vector<std::uint16_t>& column : of)
    if (column.size() < count + kWide) column.resize(count + kWide);
}

ValueRange range_of(std::span<const std::uint16_t> values) {
  ValueRange range;
#if defined(CHIARO_AVX2)
  if (vector_width() >= VectorWidth::kAvx2) least_avx2(values.data(), values.size(), range);
  else least_body(values.data(), values.size(), range);
#else
  least_body(values.data(), values.size(), range);
#endif
  return range;
}

std::uint32_t count_below(std::span<const std::uint16_t> values, std::uint16_t limit) {
#if defined(CHIARO_AVX2)
  if (vector_width() >= VectorWidth::kAvx2) return count_avx2(values.data(), values.size(), limit);
#endif
  return count_body(values.data(), values.size(), limit);
}

std::size_t divide(PatchColumns& columns, std::size_t first, std::size_t last, const PatchCut& cut, PatchColumns& room) {
  Places at{first, 0, 0};
  std::size_t begin = first;
#if defined(CHIARO_AVX2)
  if (vector_width() >= VectorWidth::kAvx2) begin = divide_avx2(columns, first, last, cut, room, at);
#endif
  divide_plain(columns, begin, last, cut, room, at);
  for (std::size_t column = 0; column < PatchColumns::kColumns; ++column)
    std::copy_n(room.of[column].begin(), at.moved, columns.of[column].begin() + static_cast<std::ptrdiff_t>(at.kept));
  return at.kept;
}

}  // namespace chiaro::stream
