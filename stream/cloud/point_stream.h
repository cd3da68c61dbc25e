/// Point clouds as streams of blocks: readers and writers for every format behind one interface, in bounded memory.
#pragma once
#include <array>
#include <cstdint>
#include <filesystem>
#include <memory>
#include <optional>
#include <string>
#include <vector>

#include "stream/base/types.h"

namespace chiaro::stream {

enum class ScalarType : std::uint8_t { kI8, kU8, kI16, kU16, kI32, kU32, kI64, kU64, kF32, kF64 };
std::size_t scalar_bytes(ScalarType type);

struct PointProperty {
  std::string name;
  ScalarType type = ScalarType::kF32;
};

/// Positions that are stored as integers k: p = k * scale + add, rounded as doubles are.
struct PositionGrid {
  Vec3d scale, add;
  Vec3d position(const std::array<std::int64_t, 3>& k) const {
    return {static_cast<double>(k[0]) * scale.x() + add.x(), static_cast<double>(k[1]) * scale.y() + add.y(), static_cast<double>(k[2]) * scale.z() + add.z()};
  }
};

/// What a file holds per point beside position, normal and colour is `extras`, carried through to exports untouched.
struct PointSchema {
  std::uint64_t declared_points = 0;   ///< as the header says, 0 = unknown (text). Never trusted: see PointReader::read
  bool position_is_double = false;     ///< input stored doubles, or scaled integers that a float cannot hold
  std::optional<PositionGrid> grid;    ///< of scaled integers, a hint: whoever uses it checks each position
  bool has_normal = false;
  bool has_colour = false;
  bool colour_is_16_bit = false;
  std::vector<PointProperty> extras;   ///< in file order
  std::string coordinate_system;       ///< WKT of the positions' coordinate system, as LAS has it; empty: none. Carried, never looked into
  std::size_t extra_bytes() const;     ///< packed size of one point's extras
};

/// Structure of arrays; all vectors have size() entries or are empty where the schema says so.
struct PointBlock {
  std::vector<Vec3d> position;                        ///< project units, file's frame
  std::vector<Vec3f> normal;                          ///< as stored, not normalised; empty without normals
  std::vector<std::array<std::uint16_t, 3>> colour;   ///< sRGB-encoded, 0..65535 (8-bit values times 257); empty without colour
  std::vector<std::byte> extras;                      ///< size() * schema.extra_bytes(), little-endian, packed
  std::size_t size() const { return position.size(); }
  void clear();
};

/// The position that readers give to a point whose scanner marked it as invalid (it hit nothing): not a number, in bits that tell it from
/// other numbers that are none.
Vec3d no_position();
/// Why a point with this position cannot be used: "invalid in the scan" for no_position(), "not finite"; null for a finite position.
const char* why_unusable(const Vec3d& position);

/// What the caller of a reader looks at.
enum class PointParts { kAll, kNoExtras, kPositions };

class PointReader {
 public:
  virtual ~PointReader() = default;
  virtual const PointSchema& schema() const = 0;
  /// A hint, before the first read(): other parts may then stay empty, whatever the schema says.
  virtual void wants(PointParts) {}
  /// Fills `block` with up to max_points next points in file order; false at the end (block empty then). NaN and infinite positions are
  /// passed on: the caller counts and rejects them. throws Error with path, position in the file (byte or line), expected and found.
  virtual bool read(PointBlock& block, std::size_t max_points) = 0;
  /// Whether reading again takes longer than keeping the points in a file (see spool.h).
  virtual bool decodes_slowly() const { return false; }
};

/// Opens by content (magic) first, extension second: PLY (ascii, binary little and big endian), LAS and LAZ 1.2-1.4, E57, PCD (all encodings),
/// XYZ/TXT/ASC/CSV, PTS, PTX. Several scans in one file come one after the other, in the frame of the file.
/// memory_bytes bounds formats that are not streamed through and through (compressed PCD, huge chunks of LAZ): throws Error if the file needs more.
/// throws Error for an unknown format, naming the formats that are read.
std::unique_ptr<PointReader> open_points(const std::filesystem::path& path, std::uint64_t memory_bytes = std::uint64_t{1} << 32);

/// Writes rows of packed little-endian scalars. Known names: x y z nx ny nz red green blue (u8 or u16, sRGB) albedo_r albedo_g albedo_b sigma photos;
/// LAS keeps x y z and colour in its own fields and the rest as extra bytes, under a name of their own where one of its fields has that name and another
/// type ("input_intensity"); PCD and PLY keep all.
class PointWriter {
 public:
  virtual ~PointWriter() = default;
  /// rows: count * row_bytes packed values in the order of the properties.
  virtual void write(const std::byte* rows, std::size_t count) = 0;
  /// Finishes, syncs and renames into place. Without it nothing appears at the path. throws Error if fewer or more rows came than announced.
  virtual void commit() = 0;
};

struct PointWriterOptions {
  std::uint64_t num_points = 0;
  std::vector<PointProperty> properties;
  Box3d bounds;                         ///< of the positions; LAS derives scale and offset from it
  std::optional<double> resolution;     ///< > 0: smallest step worth keeping, project units (LAS scale); default: the power of ten above extent / 2^31
  std::optional<PositionGrid> grid;     ///< what the positions lie on (LAS): kept where the extent allows it, and goes before `resolution`
  std::vector<std::string> comments;    ///< header comments where the format has them
  std::string coordinate_system;        ///< WKT, where the format has a place for it (LAS)
};

/// By extension: .ply (binary little-endian), .las (1.4), .pcd (binary). throws Error for others, naming these.
std::unique_ptr<PointWriter> create_points(const std::filesystem::path& path, const PointWriterOptions& options);

}  // namespace chiaro::stream
