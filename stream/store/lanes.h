/// Eight numbers at a time: with AVX2 where the processor has it, else in halves. Both give the same bits, since each lane adds in one order and nothing is
/// contracted. A kernel is written once, as an inline body, and wrapped for either processor. Internal to stream/store.
#pragma once
#include <cstdint>

#include "stream/store/near_kernels.h"

#if defined(__x86_64__)
#define CHIARO_AVX2 __attribute__((target("avx2,popcnt")))
#endif
#define CHIARO_INLINE inline __attribute__((always_inline))

namespace chiaro::stream {

// A GCC and Clang extension.
typedef float Lanes __attribute__((vector_size(32)));
typedef std::int32_t LaneMask __attribute__((vector_size(32)));
typedef double HalfLanes __attribute__((vector_size(32)));   ///< four of the eight, where floats do not do
typedef std::int64_t HalfLaneMask __attribute__((vector_size(32)));

/// Is the way with AVX2 to be taken? See use_wide_vectors().
bool wide_vectors();

CHIARO_INLINE void load(const float* from, Lanes& to) { __builtin_memcpy(&to, from, sizeof to); }
CHIARO_INLINE void load(const double* from, HalfLanes& to) { __builtin_memcpy(&to, from, sizeof to); }
CHIARO_INLINE void store(const Lanes& from, float* to) { __builtin_memcpy(to, &from, sizeof from); }
CHIARO_INLINE void store(const HalfLanes& from, double* to) { __builtin_memcpy(to, &from, sizeof from); }

}  // namespace chiaro::stream
