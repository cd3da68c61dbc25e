/// Packed little-endian scalars of any ScalarType, as doubles.
#pragma once
#include <cstddef>
#include <cstdint>
#include <cstring>
#include <limits>
#include <string_view>

#include "stream/cloud/point_stream.h"

namespace chiaro::stream {

template <class T>
T load_as(const std::byte* at) {
  T value;
  std::memcpy(&value, at, sizeof value);
  return value;
}

template <class T>
void store_as(std::byte* at, T value) {
  std::memcpy(at, &value, sizeof value);
}

/// Calls visit(T{}) with the C++ type of `type`.
template <class Visit>
auto with_type(ScalarType type, const Visit& visit) {
  switch (type) {
    case ScalarType::kI8:
      return visit(std::int8_t{});
    case ScalarType::kU8:
      return visit(std::uint8_t{});
    case ScalarType::kI16:
      return visit(std::int16_t{});
    case ScalarType::kU16:
      return visit(std::uint16_t{});
    case ScalarType::kI32:
      return visit(std::int32_t{});
    case ScalarType::kU32:
      return visit(std::uint32_t{});
    case ScalarType::kI64:
      return visit(std::int64_t{});
    case ScalarType::kU64:
      return visit(std::uint64_t{});
    case ScalarType::kF32:
      return visit(float{});
    case ScalarType::kF64:
      break;
  }
  return visit(double{});
}

/// 64-bit integers beyond 2^53 lose their low bits.
inline double load_scalar(ScalarType type, const std::byte* at) {
  return with_type(type, [at](auto zero) { return static_cast<double>(load_as<decltype(zero)>(at)); });
}

inline bool is_float(ScalarType type) { return type == ScalarType::kF32 || type == ScalarType::kF64; }

/// False, and nothing stored, where an integer type cannot hold the value (a fraction is cut off).
inline bool store_scalar(ScalarType type, double value, std::byte* at) {
  return with_type(type, [&](auto zero) {
    using T = decltype(zero);
    if constexpr (std::numeric_limits<T>::is_integer) {
      // max() + 1 is a power of two, so that the comparison is exact for 64-bit types too.
      const double past_max = 2.0 * static_cast<double>(std::numeric_limits<T>::max() / 2 + 1);
      if (!(value > static_cast<double>(std::numeric_limits<T>::min()) - 1.0 && value < past_max)) return false;
    }
    store_as(at, static_cast<T>(value));
    return true;
  });
}

/// "uchar", "float64" and the like, as messages and PLY headers say it.
std::string_view scalar_name(ScalarType type);

}  // namespace chiaro::stream
