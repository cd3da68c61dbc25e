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
  std::array<std::int16_t, 16> normal_u, normal_v;  ///< octahedral unit normal, see encode_normal
  std::array<std::uint8_t, 16> log_radius;      ///< radius = radius_max * 2^((code - 255) / 16)
  std::array<std::uint8_t, 16> flags;

  static constexpr std::uint8_t kPadding = 1;
  static constexpr std::uint8_t kOriented = 2;   ///< the normal's sign is known (from the file); otherwise arbitrary
  static constexpr std::uint8_t kEstimated = 4;  ///< normal estimated from neighbours
  static constexpr std::uint8_t kIsolated = 8;   ///< too few neighbours: normal is a guess
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

/// Octahedral encoding, 2 x 16 bits, error below 0.01 degrees. source: Meyer et al. 2010 / Cigolle et al. 2014.
std::array<std::int16_t, 2> encode_normal(const Vec3f& unit_normal);
Vec3f decode_normal(std::int16_t u, std::int16_t v);
/// Rounds up, so that coverage is kept. radius_max > 0.
std::uint8_t encode_radius(float radius, float radius_max);
inline float decode_radius(std::uint8_t code, float radius_max) { return radius_max * std::exp2((static_cast<float>(code) - 255.0f) / 16.0f); }

Surfel decode_surfel(const SurfelBlock& block, int lane, const ChunkFrame& frame);

}  // namespace chiaro::stream
