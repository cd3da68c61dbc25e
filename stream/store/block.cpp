#include "stream/store/block.h"

#include <algorithm>

namespace chiaro::stream {
namespace {

// Signed normalised 16 bits: -32767 .. 32767, so that 0 and +-1 are exact.
std::int16_t to_snorm(float v) { return static_cast<std::int16_t>(std::lround(std::clamp(v, -1.0f, 1.0f) * 32767.0f)); }
float sign_of(float v) { return v >= 0 ? 1.0f : -1.0f; }

}  // namespace

std::array<std::int16_t, 2> encode_normal(const Vec3f& n) {
  const float sum = std::abs(n.x()) + std::abs(n.y()) + std::abs(n.z());
  if (!(sum > 0) || !std::isfinite(sum)) return {0, 0};  // no direction: +z
  float u = n.x() / sum, v = n.y() / sum;
  if (n.z() < 0) {  // the lower half is folded over the diagonals
    const float folded = (1 - std::abs(v)) * sign_of(u);
    v = (1 - std::abs(u)) * sign_of(v);
    u = folded;
  }
  return {to_snorm(u), to_snorm(v)};
}

Vec3f decode_normal(std::int16_t qu, std::int16_t qv) {
  const float u = std::max(-1.0f, static_cast<float>(qu) / 32767.0f);
  const float v = std::max(-1.0f, static_cast<float>(qv) / 32767.0f);
  Vec3f n(u, v, 1 - std::abs(u) - std::abs(v));
  if (n.z() < 0) {
    n.x() = (1 - std::abs(v)) * sign_of(u);
    n.y() = (1 - std::abs(u)) * sign_of(v);
  }
  return n / n.norm();
}

std::uint8_t encode_radius(float radius, float radius_max) {
  if (!(radius > 0)) return 0;
  const float code = std::ceil(255.0f + 16.0f * std::log2(radius / radius_max));
  int c = static_cast<int>(std::clamp(code, 0.0f, 255.0f));
  while (c > 0 && decode_radius(static_cast<std::uint8_t>(c - 1), radius_max) >= radius) --c;
  while (c < 255 && decode_radius(static_cast<std::uint8_t>(c), radius_max) < radius) ++c;
  return static_cast<std::uint8_t>(c);
}

Surfel decode_surfel(const SurfelBlock& block, int lane, const ChunkFrame& frame) {
  const auto i = static_cast<std::size_t>(lane);
  Surfel s;
  s.position_in_world = frame.origin_in_world + frame.step * Vec3d(block.x[i] + 0.5, block.y[i] + 0.5, block.z[i] + 0.5);
  s.normal = decode_normal(block.normal_u[i], block.normal_v[i]);
  s.radius = decode_radius(block.log_radius[i], frame.radius_max);
  s.flags = block.flags[i];
  return s;
}

}  // namespace chiaro::stream
