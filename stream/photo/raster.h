/// Working images on disk: named planes of equal size, read and written by bands of rows, so that memory never depends on the image.
///
/// File, little-endian: magic "CHRASTR1", u32 version, i32 width, i32 height, u32 planes, u32 rows a block, u32 CRC-32C of the index, u64 place of the index; per
/// plane a 32-byte name, u32 type, u32 reserved; blocks of rows, plane after plane, row-major, compressed one by one (Blosc: bytes of a number apart, LZ4); the
/// index, per plane and block u64 place, u32 bytes, u32 CRC-32C of these. Written as .part, renamed by commit(); until then rows lie uncompressed in a file without a name.
#pragma once
#include <cstdint>
#include <filesystem>
#include <memory>
#include <span>
#include <string>
#include <string_view>
#include <vector>

#include "stream/base/file.h"
#include "stream/base/types.h"

namespace chiaro::stream {

enum class PlaneType : std::uint32_t { kF32 = 0, kU32 = 1, kU16 = 2, kU8 = 3 };
std::size_t plane_type_bytes(PlaneType type);
/// Rows that are compressed together: a read that touches one of them unpacks all.
int raster_block_rows(int width_px, int height_px);

/// Bits of the fraction of an f32 that a plane keeps; the others are noise that does not compress. Relative rounding errors: none, 2^-16, 2^-8.
enum class Precision { kAll = 23, kFine = 15, kCoarse = 7 };

struct PlaneInfo {
  std::string name;  ///< at most 31 bytes
  PlaneType type = PlaneType::kF32;
  Precision precision = Precision::kAll;   ///< for the writer
};

class RasterWriter {
 public:
  /// throws Error if the size is not positive, beyond 2^31 pixels or 2^28 columns, or the disk is full (space is reserved for rows as they are).
  RasterWriter(const std::filesystem::path& path, int width_px, int height_px, std::vector<PlaneInfo> planes);
  RasterWriter(RasterWriter&&) noexcept;
  ~RasterWriter();
  int width() const;
  int height() const;
  /// Writes rows [y0, y0 + rows) of one plane; `bytes` must be rows * width * type size. Any order, any thread (disjoint rows).
  void write_rows(std::string_view plane, int y0, int rows, std::span<const std::byte> bytes);
  template <class T>
  void write_rows(std::string_view plane, int y0, std::span<const T> values) {
    write_rows(plane, y0, static_cast<int>(values.size() / static_cast<std::size_t>(width())), std::as_bytes(values));
  }
  /// Reads back rows that were written.
  template <class T>
  std::vector<T> read_back(std::string_view plane, int y0, int num_rows) const {
    std::vector<T> values(static_cast<std::size_t>(num_rows) * static_cast<std::size_t>(width()));
    read_back(plane, y0, num_rows, std::as_writable_bytes(std::span<T>(values)));
    return values;
  }
  void read_back(std::string_view plane, int y0, int rows, std::span<std::byte> bytes) const;
  /// Rounds as the planes' precision says, compresses, side by side, syncs and renames. Memory: a few MiB.
  void commit();

 private:
  struct Impl;
  std::unique_ptr<Impl> impl_;
};

class RasterReader {
 public:
  /// throws Error with path and reason if the file is not a whole raster.
  explicit RasterReader(const std::filesystem::path& path);
  RasterReader(RasterReader&&) noexcept;
  RasterReader& operator=(RasterReader&&) noexcept;
  ~RasterReader();
  int width() const;
  int height() const;
  const std::vector<PlaneInfo>& planes() const;
  bool has(std::string_view plane) const;
  /// Reads rows [y0, y0 + rows); thread-safe. Compares the checksum of each block that is touched: throws Error naming plane and rows.
  void read_rows(std::string_view plane, int y0, int rows, std::span<std::byte> bytes) const;
  template <class T>
  std::vector<T> rows(std::string_view plane, int y0, int num_rows) const {
    std::vector<T> values(static_cast<std::size_t>(num_rows) * static_cast<std::size_t>(width()));
    read_rows(plane, y0, num_rows, std::as_writable_bytes(std::span<T>(values)));
    return values;
  }
  template <class T>
  std::vector<T> all(std::string_view plane) const { return rows<T>(plane, 0, height()); }
  /// Re-reads everything and compares the checksums. throws Error naming plane and rows.
  void verify() const;

 private:
  struct Impl;
  std::unique_ptr<Impl> impl_;
};

}  // namespace chiaro::stream
