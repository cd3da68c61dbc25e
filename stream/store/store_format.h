/// The files of a store, byte by byte (docs/store-format.md): shared by the builder, the reader, layers and verification.
#pragma once
#include <filesystem>
#include <optional>
#include <string>
#include <string_view>
#include <vector>

#include "stream/base/file.h"
#include "stream/store/store.h"

namespace chiaro::stream {

inline constexpr int kFormatVersion = 2;
inline constexpr std::uint64_t kChunkAlignment = 4096;
inline constexpr std::uint64_t kSourceBytes = 5;  ///< a source index: 32 low bits (plane), 8 high bits (plane)
inline constexpr std::uint32_t kNoParent = 0xffffffffu;
inline constexpr std::size_t kIndexRecordBytes = 64;

/// The first 32 bytes of index.bin.
struct IndexHeader {
  char magic[8];
  std::uint32_t version, record_bytes;
  std::uint64_t count;
  std::uint32_t records_crc, header_crc;
};
static_assert(sizeof(IndexHeader) == 32);

/// End of a chunk in geometry.bin, rounded up to where the next one begins.
inline std::uint64_t aligned_end(const ChunkEntry& e) { return (e.offset + geometry_bytes(e.count) + kChunkAlignment - 1) / kChunkAlignment * kChunkAlignment; }

/// Size of geometry.bin: up to the last inner node; room to append where there is none.
std::uint64_t geometry_file_bytes(const std::vector<ChunkEntry>& entries);

/// Surfels of a chunk, unchecked. throws Error where the file ends before.
std::vector<SurfelBlock> read_blocks(const File& geometry, const ChunkEntry& entry);
/// The first byte behind a chunk, before the next one can begin, that is not zero as it should be.
std::optional<std::uint64_t> byte_behind(const File& geometry, const ChunkEntry& entry);

std::filesystem::path manifest_path(const std::filesystem::path& store);
std::filesystem::path index_path(const std::filesystem::path& store);
std::filesystem::path geometry_path(const std::filesystem::path& store);
std::filesystem::path source_path(const std::filesystem::path& store);
std::filesystem::path layers_path(const std::filesystem::path& store);

/// JSON text whose last member is the CRC-32C of everything before it. `json` is an object with at least one member.
void write_sealed(const std::filesystem::path& path, const std::string& object_text);
/// The last line of a sealed text, after the text before it.
std::string seal_of(std::string_view body);
/// object_text with its seal, as write_sealed() writes it.
std::string sealed_text(const std::string& object_text);
/// Reads and checks the seal; returns the whole text. throws Error.
std::string read_sealed(const std::filesystem::path& path);

std::string manifest_text(const Manifest& manifest);
/// throws Error naming the path and the member that is missing or of the wrong type.
Manifest read_manifest(const std::filesystem::path& path);
Manifest parse_manifest(const std::filesystem::path& path, const std::string& text);

/// A header that fits `count` records with this checksum.
IndexHeader index_header(std::uint64_t count, std::uint32_t records_crc);
/// Checksum of the header's own bytes.
std::uint32_t header_crc_of(const IndexHeader& header);
/// 64 bytes of index.bin from and to an entry (without its parent).
void encode_entry(const ChunkEntry& entry, std::byte* record);
ChunkEntry decode_entry(const std::byte* record);

void write_index(const std::filesystem::path& path, const std::vector<ChunkEntry>& entries);
/// Checks magic, version, size and CRC, not the tree.
std::vector<ChunkEntry> read_index(const std::filesystem::path& path);
/// Checks order, links, ranges and sizes; fills `parent`. throws Error naming path, entry, expected and found.
void check_index(const std::filesystem::path& path, std::vector<ChunkEntry>& entries, std::uint64_t geometry_size, std::uint64_t source_size);

/// Lower corner and step of the cell of an entry.
ChunkFrame frame_of(const Manifest& manifest, const ChunkEntry& entry);
Box3d tight_box(const ChunkFrame& frame, const ChunkEntry& entry);

void pack_sources(const std::vector<std::uint64_t>& sources, std::vector<std::byte>& bytes);
std::vector<std::uint64_t> unpack_sources(const std::vector<std::byte>& bytes, std::uint32_t count);

}  // namespace chiaro::stream
