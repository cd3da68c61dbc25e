/// How many numbers a kernel takes at a time: what the processor has. Kernels give the same bits with any width.
#pragma once

#if defined(__x86_64__)
#define CHIARO_AVX2 __attribute__((target("avx2,popcnt")))
#define CHIARO_AVX512 __attribute__((target("avx512f,avx512bw,avx512dq,avx512vl,avx2,popcnt")))
#endif

namespace chiaro {

enum class VectorWidth { kPlain, kAvx2, kAvx512 };
/// The way that is taken.
VectorWidth vector_width();
/// For tests: nothing wider, even where the processor has it.
void limit_vectors(VectorWidth widest);

}  // namespace chiaro
