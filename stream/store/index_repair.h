/// The index of a damaged store as it was: out of its own redundancy, the geometry and the source indices.
#pragma once
#include <filesystem>
#include <optional>
#include <string>
#include <vector>

#include "stream/base/report.h"
#include "stream/store/store.h"

namespace chiaro::stream {

struct RepairedIndex {
  std::vector<ChunkEntry> entries;  ///< linked
  std::string change;               ///< what is not as on disk, in words; empty: the file is whole
};

/// What is tried, in this order; an answer is taken only if it is proven to be the original:
/// 1. a damaged header beside whole records, a file that is too long;
/// 2. one damaged byte in the records: found by their checksum, agreed to by the chunk it belongs to and contradicted by none;
/// 3. inner records, and offsets, bounds and checksums of leaves, made from the leaves that remain: every inner node made anew must give the bytes that
///    geometry.bin holds, and the whole must give the checksum in the header (where the header is lost too: the counts in the manifest).
/// manifest: nothing where it is lost; then 3 is not possible. geometry.bin may be short or absent.
/// Memory: about three times index.bin. throws Error saying what cannot be told; nothing is written.
RepairedIndex repaired_index(const std::filesystem::path& store, const std::optional<Manifest>& manifest, Reporter& report);

/// Bounds of the stored positions of whole blocks, into the entry.
void set_tight_bounds(ChunkEntry& entry, const std::vector<SurfelBlock>& blocks);

/// CRC-32C of `bytes` bytes at `offset`; nothing where the file ends before.
std::optional<std::uint32_t> checksum_at(const File& file, std::uint64_t offset, std::uint64_t bytes);

}  // namespace chiaro::stream
