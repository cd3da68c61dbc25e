#include "stream/base/vector_width.h"

#include <algorithm>

namespace chiaro {
namespace {

VectorWidth widest_of_processor() {
#if defined(CHIARO_AVX2)
  const bool avx2 = __builtin_cpu_supports("avx2") && __builtin_cpu_supports("popcnt");
  if (avx2 && __builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512bw") && __builtin_cpu_supports("avx512dq") && __builtin_cpu_supports("avx512vl")) return VectorWidth::kAvx512;
  if (avx2) return VectorWidth::kAvx2;
#endif
  return VectorWidth::kPlain;
}
VectorWidth width = widest_of_processor();

}  // namespace

VectorWidth vector_width() { return width; }
void limit_vectors(VectorWidth widest) { width = std::min(widest, widest_of_processor()); }

}  // namespace chiaro
