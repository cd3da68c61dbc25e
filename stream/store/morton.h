/// Morton (z-order) codes: x in the lowest bit of each triple.
#pragma once
#include <array>
#include <cstdint>

namespace chiaro::stream {

inline constexpr int kMaxLevel = 21;                     ///< deepest octree level
inline constexpr int kLocalBits = 16;                    ///< stored bits an axis below the cell
inline constexpr int kAxisBits = kMaxLevel + kLocalBits; ///< 37: finest integer coordinate in the root cube

/// Spreads the low 21 bits of v so that two zeros lie between neighbours.
inline std::uint64_t spread_bits(std::uint64_t v) {
  v &= 0x1fffff;
  v = (v | v << 32) & 0x001f00000000ffffull;
  v = (v | v << 16) & 0x001f0000ff0000ffull;
  v = (v | v << 8) & 0x100f00f00f00f00full;
  v = (v | v << 4) & 0x10c30c30c30c30c3ull;
  v = (v | v << 2) & 0x1249249249249249ull;
  return v;
}

/// Inverse of spread_bits; other bits are ignored.
inline std::uint32_t compact_bits(std::uint64_t v) {
  v &= 0x1249249249249249ull;
  v = (v | v >> 2) & 0x10c30c30c30c30c3ull;
  v = (v | v >> 4) & 0x100f00f00f00f00full;
  v = (v | v >> 8) & 0x001f0000ff0000ffull;
  v = (v | v >> 16) & 0x001f00000000ffffull;
  v = (v | v >> 32) & 0x1fffff;
  return static_cast<std::uint32_t>(v);
}

inline std::uint64_t morton_encode(std::uint64_t x, std::uint64_t y, std::uint64_t z) {
  return spread_bits(x) | spread_bits(y) << 1 | spread_bits(z) << 2;
}
inline std::array<std::uint32_t, 3> morton_decode(std::uint64_t m) { return {compact_bits(m), compact_bits(m >> 1), compact_bits(m >> 2)}; }

/// 111-bit Morton key of a point: 21 levels of cells (high) and 16 below (low).
__extension__ typedef unsigned __int128 MortonKey;
inline MortonKey make_key(std::uint64_t cells, std::uint64_t local) { return (static_cast<MortonKey>(cells) << 48) | local; }
/// First key of cell `morton` of `level`.
inline MortonKey cell_begin(std::uint64_t morton, int level) { return static_cast<MortonKey>(morton) << (3 * (kAxisBits - level)); }
/// Cell of `level` (up to 21) that holds the key.
inline std::uint64_t cell_of(MortonKey key, int level) { return static_cast<std::uint64_t>(key >> (3 * (kAxisBits - level))); }
/// The 48-bit Morton code of the stored coordinates of a point in its cell of `level`.
inline std::uint64_t local_of(MortonKey key, int level) {
  return static_cast<std::uint64_t>(key >> (3 * (kMaxLevel - level))) & 0xffffffffffffull;
}

}  // namespace chiaro::stream
