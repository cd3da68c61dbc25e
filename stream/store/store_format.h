/// The files of a store, byte by byte (docs/store-format.md): shared by the builder, the reader, layers and verification.
#pragma once
#include <filesystem>
#include <string>
#include <vector>

#include "stream/store/store.h"

namespace chiaro::stream {

inline constexpr int kFormatVersion = 2;
inline constexpr std::uint64_t kChunkAlignment = 4096;
inline constexpr std::uint64_t kSourceBytes = 5;  ///< a source index: 32 low bits (plane), 8 high bits (plane)
inline constexpr std::uint32_t kNoParent = 0xffffffffu;

std::filesystem::path manifest_path(const std::filesystem::path& store);
std::filesystem::path index_path(const std::filesystem::path& store);
std::filesystem::path geometry_path(const std::filesystem::path& store);
std::filesystem::path source_path(const std::filesystem::path& store);
std::filesystem::path layers_path(const std::filesystem::path& store);

/// JSON text whose last member is the CRC-32C of everything before it. `json` is an object with at least one member.
void write_sealed(const std::filesystem::path& path, const std::string& object_text);
/// Reads and checks the seal; returns the whole text. throws Error.
std::string read_sealed(const std::filesystem::path& path);

std::string manifest_text(const Manifest& manifest);
/// throws Error naming the path and the member that is missing or of the wrong type.
Manifest read_manifest(const std::filesystem::path& path);
Manifest parse_manifest(const std::filesystem::path& path, const std::string& text);

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
