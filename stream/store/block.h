/// The surfel block: the unit on disk, in memory and for rays. What is read is directly ray-castable.
#pragma once
#include <array>
#include <cmath>
#include <cstdint>
#include <span>

#include "stream/base/types.h"

namespace chiaro::stream {

inline constexpr int kBlockSurfels = 16;
inline constexpr std::uint32_t kMaxChunkSurfels = 65536;

/// 16 surfels, structure of arrays, 192 bytes. Slots past the chunk's count are padding (flags = kPadding) and are never hit.
struct SurfelBlock {
  std::array<std::uint16_t, 16> x, y, z;        ///< position in the cell: origin + (q + 0.5) * step
  std::array<std::int16_t, 16> normal_u, normal_v;  ///< upper 12 bits: octahedral unit normal, see encode_normal; lower 4 bits: clip
  std::array<std::uint8_t, 16> log_radius;      ///< radius = radius_max * 2^((code - 255) / 16)
  std::array<std::uint8_t, 16> flags;           ///< lower 4 bits: flags; upper 4 bits: clip

  static constexpr std::uint8_t kPadding = 1;
  static constexpr std::uint8_t kOriented = 2;   ///< the normal's sign is known (from the file); otherwise arbitrary
  static constexpr std::uint8_t kEstimated = 4;  ///< normal estimated from neighbours
  static constexpr std::uint8_t kIsolated = 8;   ///< too few neighbours: normal is a guess
  static constexpr std::uint8_t kFlags = 15;
};
static_assert(sizeof(SurfelBlock) == 192);

/// How a chunk's integers become world coordinates.
struct ChunkFrame {
  Vec3d origin_in_world = Vec3d::Zero();  ///< lower corner of the cell
  double step = 1;                        ///< cell edge / 65536
  float radius_max = 0;
};

struct Surfel {
  Vec3d position_in_world;
  Vec3f normal;
  float radius = 0;
  std::uint8_t flags = 0;
};

/// Octahedral encoding, 2 x 12 bits in the upper bits of 2 x 16, error below 0.06 degrees. source: Meyer et al. 2010 / Cigolle et al. 2014.
std::array<std::int16_t, 2> encode_normal(const Vec3f& unit_normal);
inline Vec3f decode_normal(std::int16_t u, std::int16_t v);
/// All of a block: the same but for the last bit.
void decode_normals(const SurfelBlock& block, float* x, float* y, float* z);
/// Rounds up, so that coverage is kept. radius_max > 0.
std::uint8_t encode_radius(float radius, float radius_max);
inline float decode_radius(std::uint8_t code, float radius_max) { return radius_max * std::exp2((static_cast<float>(code) - 255.0f) / 16.0f); }
/// The radii of a chunk's codes, for many surfels: the same answers as the two functions above.
class RadiusTable {
 public:
  explicit RadiusTable(float radius_max);
  float decode(std::uint8_t code) const { return radius_[code]; }
  std::uint8_t encode(float radius) const;

 private:
  std::array<float, 256> radius_;
};

/// A disc that ends at an edge is cut there by a straight line, so that it does not stand out beyond the edge. 12 bits: upper 7 the direction across the
/// line, lower 5 its distance from the centre; 0 = whole disc. The direction lies in the two axes that are not the normal's largest: the line is
/// {e : u e_a + v e_b = distance}, |u| + |v| = 1, e = point - centre, (a, b) = (x, y), (z, x) or (y, z) where the normal is largest in z, y or x.
struct DiscClip {
  static constexpr int kDirections = 128, kDistances = 30;
};
/// across: unit vector in the disc's plane that points over the line; distance >= 0 from the centre. normal_u, normal_v as stored. 0 if the line misses the disc.
std::uint16_t encode_clip(std::int16_t normal_u, std::int16_t normal_v, const Vec3f& across, float distance, float radius);
/// Sets the clip; the bits of normal and flags stay.
void put_clip(SurfelBlock& block, std::size_t lane, std::uint16_t code);
inline std::uint16_t clip_of(const SurfelBlock& block, std::size_t lane) {
  return static_cast<std::uint16_t>((block.normal_u[lane] & 15) << 8 | (block.normal_v[lane] & 15) << 4 | block.flags[lane] >> 4);
}

Surfel decode_surfel(const SurfelBlock& block, int lane, const ChunkFrame& frame);

// Signed normalised 12 bits in the upper ones of 16: 16 * (-2047 .. 2047), so that 0 and +-1 are exact.
inline constexpr float kSnorm = 32752.0f;

/// The point of the octahedron, not yet on the sphere.
inline Vec3f decode_octahedron(std::int16_t qu, std::int16_t qv) {
  const int iu = qu & ~15, iv = qv & ~15;
  // A product of doubles, rounded, is the quotient of floats for each of the 4095 numbers, and faster.
  constexpr double kOverSnorm = 1 / static_cast<double>(kSnorm);
  const auto u = static_cast<float>((iu < -32752 ? -32752 : iu) * kOverSnorm), v = static_cast<float>((iv < -32752 ? -32752 : iv) * kOverSnorm);
  const float au = std::abs(u), av = std::abs(v), z = 1 - au - av;
  return {z < 0 ? std::copysign(1 - av, u) : u, z < 0 ? std::copysign(1 - au, v) : v, z};
}
inline Vec3f decode_normal(std::int16_t u, std::int16_t v) {
  const Vec3f n = decode_octahedron(u, v);
  return n / n.norm();
}

}  // namespace chiaro::stream
