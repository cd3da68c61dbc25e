#include "stream/base/rng.h"

#include <cmath>

namespace chiaro {

std::array<std::uint32_t, 4> philox4x32(std::array<std::uint32_t, 4> c, std::array<std::uint32_t, 2> k) {
  for (int round = 0; round < 10; ++round) {
    const std::uint64_t p0 = std::uint64_t{0xD2511F53u} * c[0];
    const std::uint64_t p1 = std::uint64_t{0xCD9E8D57u} * c[2];
    c = {static_cast<std::uint32_t>(p1 >> 32) ^ c[1] ^ k[0], static_cast<std::uint32_t>(p1),
         static_cast<std::uint32_t>(p0 >> 32) ^ c[3] ^ k[1], static_cast<std::uint32_t>(p0)};
    k[0] += 0x9E3779B9u;
    k[1] += 0xBB67AE85u;
  }
  return c;
}

std::array<float, 4> uniform01x4(std::uint64_t seed, Purpose purpose, std::uint64_t element, std::uint32_t block) {
  const auto bits = philox4x32({block, static_cast<std::uint32_t>(element), static_cast<std::uint32_t>(element >> 32), static_cast<std::uint32_t>(purpose)},
                               {static_cast<std::uint32_t>(seed), static_cast<std::uint32_t>(seed >> 32)});
  std::array<float, 4> u;
  for (int i = 0; i < 4; ++i) u[i] = static_cast<float>(bits[i] >> 8) * 0x1p-24f;
  return u;
}

float uniform01(std::uint64_t seed, Purpose purpose, std::uint64_t element, std::uint32_t draw) {
  return uniform01x4(seed, purpose, element, draw / 4)[draw % 4];
}

double normal01(std::uint64_t seed, Purpose purpose, std::uint64_t element, std::uint32_t draw) {
  const auto u = uniform01x4(seed, purpose, element, draw);
  const double radius = std::sqrt(-2.0 * std::log(1.0 - static_cast<double>(u[0])));
  return radius * std::cos(2.0 * 3.14159265358979323846 * static_cast<double>(u[1]));
}

}  // namespace chiaro
