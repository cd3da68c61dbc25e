#include "stream/store/block.h"

#include <algorithm>
#include <bit>

namespace chiaro::stream {
namespace {

// As std::lround, which is a call: the sum of doubles is exact.
int nearest_integer(float v) { return static_cast<int>(static_cast<double>(v) + (v < 0 ? -0.5 : 0.5)); }
std::int16_t to_snorm(float v) { return static_cast<std::int16_t>(16 * nearest_integer(std::clamp(v, -1.0f, 1.0f) * 2047.0f)); }
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

void decode_normals(const SurfelBlock& block, float* x, float* y, float* z) {
  for (std::size_t i = 0; i < kBlockSurfels; ++i) {
    const int qu = block.normal_u[i] & ~15, qv = block.normal_v[i] & ~15;
    const float u = static_cast<float>(qu < -32752 ? -32752 : qu) / kSnorm, v = static_cast<float>(qv < -32752 ? -32752 : qv) / kSnorm;
    const float up = 1 - std::abs(u) - std::abs(v), folded = up < 0 ? -up : 0;   // see decode_octahedron()
    const float nx = u >= 0 ? u - folded : u + folded, ny = v >= 0 ? v - folded : v + folded, over = 1 / std::sqrt(nx * nx + ny * ny + up * up);
    x[i] = nx * over;
    y[i] = ny * over;
    z[i] = up * over;
  }
}

std::uint16_t encode_clip(std::int16_t normal_u, std::int16_t normal_v, const Vec3f& across, float distance, float radius) {
  const Vec3f n = decode_octahedron(normal_u, normal_v), size = n.cwiseAbs();
  const int dominant = size.z() >= size.x() && size.z() >= size.y() ? 2 : size.y() >= size.x() ? 1 : 0;
  const int a = (dominant + 1) % 3, b = (dominant + 2) % 3;
  // In the disc's plane the dominant coordinate follows from the two others.
  const float h_a = across[a] - across[dominant] * n[a] / n[dominant], h_b = across[b] - across[dominant] * n[b] / n[dominant];
  const float sum = std::abs(h_a) + std::abs(h_b), relative = std::max(0.0f, distance) / (sum * radius);
  if (!(relative <= 1)) return 0;
  const float turn = h_b >= 0 ? 1 - h_a / sum : 3 + h_a / sum;   // 0 .. 4 around the diamond
  const auto direction = static_cast<unsigned>(std::lround(turn * DiscClip::kDirections / 4)) % DiscClip::kDirections;
  const auto away = static_cast<unsigned>(std::ceil(relative * DiscClip::kDistances));
  return static_cast<std::uint16_t>(direction << 5 | (away + 1));
}

void put_clip(SurfelBlock& block, std::size_t lane, std::uint16_t code) {
  block.normal_u[lane] = static_cast<std::int16_t>((block.normal_u[lane] & ~15) | (code >> 8 & 15));
  block.normal_v[lane] = static_cast<std::int16_t>((block.normal_v[lane] & ~15) | (code >> 4 & 15));
  block.flags[lane] = static_cast<std::uint8_t>((block.flags[lane] & SurfelBlock::kFlags) | (code & 15) << 4);
}

std::uint8_t encode_radius(float radius, float radius_max) {
  if (!(radius > 0)) return 0;
  const float code = std::ceil(255.0f + 16.0f * std::log2(radius / radius_max));
  int c = static_cast<int>(std::clamp(code, 0.0f, 255.0f));
  while (c > 0 && decode_radius(static_cast<std::uint8_t>(c - 1), radius_max) >= radius) --c;
  while (c < 255 && decode_radius(static_cast<std::uint8_t>(c), radius_max) < radius) ++c;
  return static_cast<std::uint8_t>(c);
}

RadiusTable::RadiusTable(float radius_max) {
  for (std::size_t c = 0; c < radius_.size(); ++c) radius_[c] = decode_radius(static_cast<std::uint8_t>(c), radius_max);
}

namespace {

// 16 log2 v for v > 0, within 0.15: the mantissa's logarithm by a parabola.
float sixteenths_of_octaves(float v) {
  const auto bits = std::bit_cast<std::uint32_t>(v);
  const float m = std::bit_cast<float>((bits & 0x7fffff) | 0x3f800000) - 1;
  return 16 * (static_cast<float>(bits >> 23) + m * (1.3437f - 0.3437f * m));
}

}  // namespace

// The first code that reaches the radius: the one that the logarithms tell, which are low by 0.05 to 0.65 together, or the next.
std::uint8_t RadiusTable::encode(float radius) const {
  if (!(radius > 0)) return 0;
  const float above = 255 - 0.35f + sixteenths_of_octaves(radius) - sixteenths_of_octaves(radius_[255]);
  const float least = std::clamp(above, 0.0f, 255.0f);
  const int whole = static_cast<int>(least), c = whole + static_cast<int>(static_cast<float>(whole) < least);
  return static_cast<std::uint8_t>(c + static_cast<int>(c < 255 && radius_[static_cast<std::size_t>(c)] < radius));
}

Surfel decode_surfel(const SurfelBlock& block, int lane, const ChunkFrame& frame) {
  const auto i = static_cast<std::size_t>(lane);
  Surfel s;
  s.position_in_world = frame.origin_in_world + frame.step * Vec3d(block.x[i] + 0.5, block.y[i] + 0.5, block.z[i] + 0.5);
  s.normal = decode_normal(block.normal_u[i], block.normal_v[i]);
  s.radius = decode_radius(block.log_radius[i], frame.radius_max);
  s.flags = block.flags[i] & SurfelBlock::kFlags;
  return s;
}

}  // namespace chiaro::stream
