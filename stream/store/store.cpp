#include "stream/store/store.h"

#include <algorithm>

#include "stream/base/error.h"
#include "stream/base/hash.h"
#include "stream/store/morton.h"
#include "stream/store/store_format.h"

namespace chiaro::stream {
namespace fs = std::filesystem;

double metres_per_unit(std::string_view unit) { return unit == "mm" ? 1e-3 : unit == "cm" ? 1e-2 : 1.0; }

struct Store::Impl {
  fs::path path;
  Manifest manifest;
  std::vector<ChunkEntry> chunks;
  std::vector<std::uint32_t> leaves;
  File geometry, source;

  const ChunkEntry& entry(std::uint32_t chunk) const {
    if (chunk >= chunks.size()) throw std::invalid_argument(concat("chunk ", chunk, " of ", chunks.size()));
    return chunks[chunk];
  }
};

namespace {

// Leaves of all levels in the order of their first key.
std::vector<std::uint32_t> leaves_in_morton_order(const std::vector<ChunkEntry>& chunks) {
  std::vector<std::uint32_t> leaves;
  for (std::uint32_t i = 0; i < chunks.size(); ++i)
    if (chunks[i].is_leaf()) leaves.push_back(i);
  const auto first_key = [&](std::uint32_t i) { return chunks[i].morton << (3 * (kMaxLevel - chunks[i].level)); };
  std::sort(leaves.begin(), leaves.end(), [&](std::uint32_t a, std::uint32_t b) {
    const std::uint64_t ka = first_key(a), kb = first_key(b);
    return ka != kb ? ka < kb : a < b;
  });
  return leaves;
}

void check_conservation(const fs::path& path, const Manifest& m, const std::vector<ChunkEntry>& chunks) {
  std::uint64_t leaf = 0, inner = 0, rejected = 0, per_file = 0;
  for (const ChunkEntry& e : chunks) (e.is_leaf() ? leaf : inner) += e.count;
  for (const auto& [reason, count] : m.points_rejected) rejected += count;
  for (const std::uint64_t n : m.source_points) per_file += n;
  if (leaf != m.points_stored || inner != m.surfels_inner)
    throw Error(concat(path.string(), ": ", m.points_stored, " points stored and ", m.surfels_inner, " inner surfels, the index holds ", leaf, " and ", inner));
  if (m.points_read != m.points_stored + rejected || per_file != m.points_read)
    throw Error(concat(path.string(), ": ", m.points_read, " points read, but ", m.points_stored, " stored and ", rejected, " rejected, ", per_file, " over all files"));
}

}  // namespace

Store::Store(const fs::path& path) : impl_(std::make_unique<Impl>()) {
  Impl& s = *impl_;
  s.path = path;
  if (!fs::is_directory(path)) throw Error(concat(path.string(), ": no such store (expected a folder with manifest.json)"));
  s.manifest = read_manifest(manifest_path(path));
  s.chunks = read_index(index_path(path));
  s.geometry = File(geometry_path(path), File::Mode::kRead);
  s.source = File(source_path(path), File::Mode::kRead);
  check_index(index_path(path), s.chunks, s.geometry.size(), s.source.size());
  check_conservation(manifest_path(path), s.manifest, s.chunks);
  s.leaves = leaves_in_morton_order(s.chunks);
}

Store::Store(Store&&) noexcept = default;
Store::~Store() = default;

const fs::path& Store::path() const { return impl_->path; }
const Manifest& Store::manifest() const { return impl_->manifest; }
const std::vector<ChunkEntry>& Store::chunks() const { return impl_->chunks; }
const std::vector<std::uint32_t>& Store::leaves() const { return impl_->leaves; }
ChunkFrame Store::frame(std::uint32_t chunk) const { return frame_of(impl_->manifest, impl_->entry(chunk)); }
Box3d Store::bounds(std::uint32_t chunk) const { return tight_box(frame(chunk), impl_->entry(chunk)); }

Box3d Store::ray_bounds(std::uint32_t chunk) const {
  Box3d box = bounds(chunk);
  const Vec3d grow = Vec3d::Constant(impl_->entry(chunk).radius_max);
  box.min -= grow;
  box.max += grow;
  return box;
}

Chunk Store::read_chunk(std::uint32_t index) const {
  const ChunkEntry& e = impl_->entry(index);
  Chunk chunk;
  chunk.index = index;
  chunk.count = e.count;
  chunk.frame = frame(index);
  chunk.blocks.resize((e.count + 15) / 16);
  impl_->geometry.read_at(e.offset, chunk.blocks.data(), chunk.bytes());
  const std::uint32_t crc = crc32c(chunk.blocks.data(), chunk.bytes());
  if (crc != e.geometry_crc)
    throw Error(concat(impl_->geometry.path().string(), ": chunk ", index, " at byte ", e.offset, " is damaged: checksum expected ", e.geometry_crc, ", found ", crc));
  return chunk;
}

std::vector<std::uint64_t> Store::read_sources(std::uint32_t leaf) const {
  const ChunkEntry& e = impl_->entry(leaf);
  if (!e.is_leaf()) throw std::invalid_argument(concat("chunk ", leaf, " is an inner node: it has no source indices"));
  std::vector<std::byte> bytes(e.count * kSourceBytes);
  impl_->source.read_at(e.source_offset, bytes.data(), bytes.size());
  const std::uint32_t crc = crc32c(bytes);
  if (crc != e.source_crc)
    throw Error(concat(impl_->source.path().string(), ": chunk ", leaf, " at byte ", e.source_offset, " is damaged: checksum expected ", e.source_crc, ", found ", crc));
  return unpack_sources(bytes, e.count);
}

}  // namespace chiaro::stream
