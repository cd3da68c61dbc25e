/// Reading a finished store: NAME.chiaro/ with manifest.json, index.bin, geometry.bin, source.bin and layers/. Format: docs/store-format.md.
///
/// An octree of chunks of at most 65 536 surfels. Leaves hold every input point exactly once; inner nodes replace their children (mean position,
/// normal, a radius that covers), so that any cut of the tree is a complete surface.
#pragma once
#include <array>
#include <cstdint>
#include <filesystem>
#include <map>
#include <memory>
#include <string>
#include <string_view>
#include <vector>

#include "stream/base/file.h"
#include "stream/base/types.h"
#include "stream/store/block.h"

namespace chiaro::stream {

/// One line of the index (64-byte record on disk), sorted by (level, morton, part).
struct ChunkEntry {
  std::uint64_t morton = 0;      ///< cell of this level: `level` bits an axis, interleaved x lowest
  std::uint64_t offset = 0;      ///< of its blocks in geometry.bin
  std::uint64_t source_offset = 0;  ///< leaves: of its source indices in source.bin
  std::uint32_t count = 0;       ///< surfels
  std::uint32_t geometry_crc = 0, source_crc = 0;
  std::uint32_t first_child = 0; ///< index of the first child chunk; children are consecutive in the index
  std::uint16_t num_children = 0;  ///< 0 for leaves
  std::uint8_t level = 0;        ///< 0 = root cell
  std::uint8_t part = 0;         ///< > 0: continuation of a leaf that holds more than 65 536 duplicates
  std::uint32_t parent = 0xffffffffu;
  std::array<std::uint16_t, 3> tight_min{}, tight_max{};  ///< bounds of the positions in cell units (radii not included)
  float radius_max = 0;
  float spacing = 0;             ///< mean distance to the nearest neighbours, project units: the chunk's resolution
  bool is_leaf() const { return num_children == 0; }
};

struct Manifest {
  int format_version = 2;
  std::string unit = "m";
  Vec3d origin_in_world = Vec3d::Zero();  ///< lower corner of the root cell
  double edge = 1;                        ///< of the root cell
  Box3d bounds;                           ///< of the stored positions
  std::uint64_t points_read = 0, points_stored = 0;
  std::map<std::string, std::uint64_t> points_rejected;   ///< by reason, e.g. "not finite"
  std::uint64_t surfels_inner = 0;
  bool normals_from_file = false;
  std::vector<std::string> source_files, source_fingerprints;  ///< absolute paths at the time; one fingerprint each
  std::vector<std::uint64_t> source_points;   ///< points read per file, rejected ones included: source index = running number over all files
  std::string key;                        ///< hash of inputs and options that made it
};

/// Of the names that `Manifest::unit` may have: m, cm, mm. What is stated per area or per solid angle in metres (W/sr, W/m^2) needs it.
double metres_per_unit(std::string_view unit);

/// The geometry of one chunk in memory.
struct Chunk {
  std::uint32_t index = 0;
  std::uint32_t count = 0;
  ChunkFrame frame;
  std::vector<SurfelBlock> blocks;
  Surfel surfel(std::uint32_t slot) const { return decode_surfel(blocks[slot / 16], static_cast<int>(slot % 16), frame); }
  std::uint64_t bytes() const { return blocks.size() * sizeof(SurfelBlock); }
};

/// A finished, published store. Thread-safe for reading.
class Store {
 public:
  /// throws Error if it is not a whole store of a known version (path, expected, found).
  explicit Store(const std::filesystem::path& path);
  Store(Store&&) noexcept;
  ~Store();
  const std::filesystem::path& path() const;
  const Manifest& manifest() const;
  const std::vector<ChunkEntry>& chunks() const;
  /// Leaves in Morton order: the order in which layers and exports stream.
  const std::vector<std::uint32_t>& leaves() const;
  ChunkFrame frame(std::uint32_t chunk) const;
  /// Tight bounds of the positions, and grown by radius_max: what rays may hit.
  Box3d bounds(std::uint32_t chunk) const;
  Box3d ray_bounds(std::uint32_t chunk) const;
  /// Reads and checks the CRC. throws Error naming file, chunk and offset.
  Chunk read_chunk(std::uint32_t chunk) const;
  /// Source index of each surfel of a leaf (running number of the point over all input files).
  std::vector<std::uint64_t> read_sources(std::uint32_t leaf) const;

 private:
  struct Impl;
  std::unique_ptr<Impl> impl_;
};

/// Bytes of geometry of a chunk with `count` surfels.
inline std::uint64_t geometry_bytes(std::uint32_t count) { return (count + 15ull) / 16 * sizeof(SurfelBlock); }

}  // namespace chiaro::stream
