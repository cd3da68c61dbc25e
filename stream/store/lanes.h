/// Many numbers at a time: with AVX-512 or AVX2 where the processor has them, else in halves. All give the same bits, since each lane adds in one order and
/// nothing is contracted. A kernel is written once, as an inline body for N lanes, and wrapped for each kind of processor. Internal to stream/store.
#pragma once
#include <cstddef>
#include <cstdint>

#include "stream/base/intrinsics.h"
#include "stream/base/vector_width.h"
#include "stream/store/near_kernels.h"

#define CHIARO_INLINE inline __attribute__((always_inline))

namespace chiaro::stream {

// A GCC and Clang extension. Doubles come in halves.
template <std::size_t N>
struct LaneTypes {
  typedef float Floats __attribute__((vector_size(4 * N)));
  typedef std::int32_t Mask __attribute__((vector_size(4 * N)));
  typedef double Doubles __attribute__((vector_size(8 * N)));
  typedef std::int64_t DoubleMask __attribute__((vector_size(8 * N)));
};

template <class Vector, class T>
CHIARO_INLINE void load(const T* from, Vector& to) {
  __builtin_memcpy(&to, from, sizeof to);
}
template <class Vector, class T>
CHIARO_INLINE void store(const Vector& from, T* to) {
  __builtin_memcpy(to, &from, sizeof from);
}

#if defined(CHIARO_AVX2)
// Which lanes to take so that those of a mask come first.
struct Compression {
  alignas(32) std::int32_t lane[256][8];
  constexpr Compression() : lane{} {
    for (int mask = 0; mask < 256; ++mask) {
      int n = 0;
      for (int i = 0; i < 8; ++i)
        if (mask & (1 << i)) lane[mask][n++] = i;
    }
  }
};
inline constexpr Compression kCompression;
CHIARO_AVX2 inline __m256i compression_of(unsigned mask) { return _mm256_load_si256(reinterpret_cast<const __m256i*>(kCompression.lane[mask])); }
#endif

}  // namespace chiaro::stream
