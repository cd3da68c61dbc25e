/// Four floats at once, a GCC and Clang extension. Internal to blend.
#pragma once
#include <cstdint>
#include <cstring>

namespace chiaro::blend {

typedef float Four __attribute__((vector_size(16)));
typedef std::int32_t FourMask __attribute__((vector_size(16)));

inline Four load_four(const float* from) {
  Four v;
  std::memcpy(&v, from, sizeof v);
  return v;
}
inline void store_four(const Four& v, float* to) { std::memcpy(to, &v, sizeof v); }
/// 0 where it is not positive.
inline Four positive(const Four& v) { return v > 0 ? v : Four{}; }
inline bool is_any(const FourMask& mask) {
  std::uint64_t halves[2];
  std::memcpy(halves, &mask, sizeof halves);
  return (halves[0] | halves[1]) != 0;
}

}  // namespace chiaro::blend
