#include "stream/store/store_format.h"

#include <array>
#include <bit>
#include <cmath>
#include <cstdio>
#include <cstring>
#include <nlohmann/json.hpp>

#include "stream/base/error.h"
#include "stream/base/hash.h"
#include "stream/store/morton.h"

namespace chiaro::stream {
namespace fs = std::filesystem;
namespace {

static_assert(std::endian::native == std::endian::little, "files are little-endian and copied as they are");

struct IndexRecord {
  std::uint64_t morton, offset, source_offset;
  std::uint32_t count, geometry_crc, source_crc, first_child;
  std::uint16_t num_children;
  std::uint8_t level, part;
  std::uint16_t tight[6];
  float radius_max, spacing;
};
static_assert(sizeof(IndexRecord) == kIndexRecordBytes);

constexpr char kIndexMagic[9] = "chiaroIX";

IndexRecord to_record(const ChunkEntry& e) {
  IndexRecord r{};
  r.morton = e.morton;
  r.offset = e.offset;
  r.source_offset = e.source_offset;
  r.count = e.count;
  r.geometry_crc = e.geometry_crc;
  r.source_crc = e.source_crc;
  r.first_child = e.first_child;
  r.num_children = e.num_children;
  r.level = e.level;
  r.part = e.part;
  for (std::size_t a = 0; a < 3; ++a) {
    r.tight[a] = e.tight_min[a];
    r.tight[3 + a] = e.tight_max[a];
  }
  r.radius_max = e.radius_max;
  r.spacing = e.spacing;
  return r;
}

ChunkEntry from_record(const IndexRecord& r) {
  ChunkEntry e;
  e.morton = r.morton;
  e.offset = r.offset;
  e.source_offset = r.source_offset;
  e.count = r.count;
  e.geometry_crc = r.geometry_crc;
  e.source_crc = r.source_crc;
  e.first_child = r.first_child;
  e.num_children = r.num_children;
  e.level = r.level;
  e.part = r.part;
  for (std::size_t a = 0; a < 3; ++a) {
    e.tight_min[a] = r.tight[a];
    e.tight_max[a] = r.tight[3 + a];
  }
  e.radius_max = r.radius_max;
  e.spacing = r.spacing;
  return e;
}

}  // namespace

std::uint64_t geometry_file_bytes(const std::vector<ChunkEntry>& entries) {
  const ChunkEntry* last = nullptr;
  for (const ChunkEntry& e : entries)
    if (!last || e.offset > last->offset) last = &e;
  return !last ? 0 : last->is_leaf() ? aligned_end(*last) : last->offset + geometry_bytes(last->count);
}

std::vector<SurfelBlock> read_blocks(const File& geometry, const ChunkEntry& entry) {
  std::vector<SurfelBlock> blocks((entry.count + 15) / 16);
  geometry.read_at(entry.offset, blocks.data(), geometry_bytes(entry.count));
  return blocks;
}

std::optional<std::uint64_t> byte_behind(const File& geometry, const ChunkEntry& entry) {
  const std::uint64_t end = entry.offset + geometry_bytes(entry.count);
  std::array<char, kChunkAlignment> bytes;
  const std::size_t n = geometry.read_some_at(end, bytes.data(), static_cast<std::size_t>(aligned_end(entry) - end));
  for (std::size_t i = 0; i < n; ++i)
    if (bytes[i] != 0) return end + i;
  return std::nullopt;
}

fs::path manifest_path(const fs::path& store) { return store / "manifest.json"; }
fs::path index_path(const fs::path& store) { return store / "index.bin"; }
fs::path geometry_path(const fs::path& store) { return store / "geometry.bin"; }
fs::path source_path(const fs::path& store) { return store / "source.bin"; }
fs::path layers_path(const fs::path& store) { return store / "layers"; }

std::string seal_of(std::string_view body) {
  char line[40];
  std::snprintf(line, sizeof line, ",\n  \"crc32c\": \"%08x\"\n}\n", crc32c(body.data(), body.size()));
  return line;
}

std::string sealed_text(const std::string& object_text) {
  std::string text = object_text.substr(0, object_text.rfind('}'));
  while (!text.empty() && (text.back() == '\n' || text.back() == ' ')) text.pop_back();
  return text + seal_of(text);
}

void write_sealed(const fs::path& path, const std::string& object_text) { write_text(path, sealed_text(object_text)); }

std::string read_sealed(const fs::path& path) {
  const std::string text = read_text(path);
  const std::size_t seal_bytes = seal_of("").size();
  if (text.size() <= seal_bytes) throw Error(concat(path.string(), ": ", text.size(), " bytes, file ends early"));
  const std::string_view body(text.data(), text.size() - seal_bytes);
  if (text.compare(body.size(), seal_bytes, seal_of(body)) != 0)
    throw Error(concat(path.string(), ": checksum at byte ", body.size(), " does not match: expected \"", seal_of(body).substr(15, 8), "\"; the file is damaged or was edited"));
  return text;
}

std::string manifest_text(const Manifest& m) {
  nlohmann::ordered_json j;
  const auto vec = [](const Vec3d& v) { return nlohmann::ordered_json{v.x(), v.y(), v.z()}; };
  j["format"] = "chiaro store";
  j["format_version"] = m.format_version;
  j["unit"] = m.unit;
  j["origin_in_world"] = vec(m.origin_in_world);
  j["edge"] = m.edge;
  j["bounds"] = {{"min", vec(m.bounds.min)}, {"max", vec(m.bounds.max)}};
  j["points_read"] = m.points_read;
  j["points_stored"] = m.points_stored;
  j["points_rejected"] = m.points_rejected;
  j["surfels_inner"] = m.surfels_inner;
  j["normals_from_file"] = m.normals_from_file;
  j["source_files"] = m.source_files;
  j["source_fingerprints"] = m.source_fingerprints;
  j["source_points"] = m.source_points;
  j["key"] = m.key;
  return j.dump(2, ' ', false, nlohmann::ordered_json::error_handler_t::replace);
}

Manifest read_manifest(const fs::path& path) { return parse_manifest(path, read_sealed(path)); }

Manifest parse_manifest(const fs::path& path, const std::string& text) {
  Manifest m;
  try {
    const auto j = nlohmann::json::parse(text);
    if (j.at("format").get<std::string>() != "chiaro store") throw Error(concat(path.string(), ": format is not \"chiaro store\""));
    m.format_version = j.at("format_version").get<int>();
    if (m.format_version != kFormatVersion)
      throw Error(concat(path.string(), ": format version ", m.format_version, ", this program reads version ", kFormatVersion));
    const auto vec = [](const nlohmann::json& v) {
      const auto a = v.get<std::array<double, 3>>();
      return Vec3d(a[0], a[1], a[2]);
    };
    m.unit = j.at("unit").get<std::string>();
    m.origin_in_world = vec(j.at("origin_in_world"));
    m.edge = j.at("edge").get<double>();
    m.bounds.min = vec(j.at("bounds").at("min"));
    m.bounds.max = vec(j.at("bounds").at("max"));
    m.points_read = j.at("points_read").get<std::uint64_t>();
    m.points_stored = j.at("points_stored").get<std::uint64_t>();
    m.points_rejected = j.at("points_rejected").get<std::map<std::string, std::uint64_t>>();
    m.surfels_inner = j.at("surfels_inner").get<std::uint64_t>();
    m.normals_from_file = j.at("normals_from_file").get<bool>();
    m.source_files = j.at("source_files").get<std::vector<std::string>>();
    m.source_fingerprints = j.at("source_fingerprints").get<std::vector<std::string>>();
    m.source_points = j.at("source_points").get<std::vector<std::uint64_t>>();
    m.key = j.at("key").get<std::string>();
  } catch (const nlohmann::json::exception& e) {
    throw Error(concat(path.string(), ": ", e.what()));
  }
  if (!(m.edge > 0) || !std::isfinite(m.edge) || !m.origin_in_world.allFinite() || !m.bounds.min.allFinite() || !m.bounds.max.allFinite())
    throw Error(concat(path.string(), ": origin, edge or bounds are not finite numbers"));
  return m;
}

IndexHeader index_header(std::uint64_t count, std::uint32_t records_crc) {
  IndexHeader header{};
  std::memcpy(header.magic, kIndexMagic, 8);
  header.version = kFormatVersion;
  header.record_bytes = sizeof(IndexRecord);
  header.count = count;
  header.records_crc = records_crc;
  header.header_crc = header_crc_of(header);
  return header;
}

std::uint32_t header_crc_of(const IndexHeader& header) { return crc32c(&header, offsetof(IndexHeader, header_crc)); }

void encode_entry(const ChunkEntry& entry, std::byte* record) {
  const IndexRecord r = to_record(entry);
  std::memcpy(record, &r, sizeof r);
}

ChunkEntry decode_entry(const std::byte* record) {
  IndexRecord r;
  std::memcpy(&r, record, sizeof r);
  return from_record(r);
}

void write_index(const fs::path& path, const std::vector<ChunkEntry>& entries) {
  std::uint32_t crc = 0;
  for (const ChunkEntry& e : entries) {
    const IndexRecord r = to_record(e);
    crc = crc32c(&r, sizeof r, crc);
  }
  const IndexHeader header = index_header(entries.size(), crc);
  AtomicFile file(path);
  file.append(&header, sizeof header);
  for (const ChunkEntry& e : entries) {
    const IndexRecord r = to_record(e);
    file.append(&r, sizeof r);
  }
  file.commit();
}

std::vector<ChunkEntry> read_index(const fs::path& path) {
  const File file(path, File::Mode::kRead);
  IndexHeader header{};
  const std::uint64_t size = file.size();
  if (size < sizeof header) throw Error(concat(path.string(), ": ", size, " bytes, file ends early"));
  file.read_at(0, &header, sizeof header);
  if (std::memcmp(header.magic, kIndexMagic, 8) != 0) throw Error(concat(path.string(), ": not an index of a store (magic at byte 0)"));
  if (header.header_crc != header_crc_of(header)) throw Error(concat(path.string(), ": checksum of the header does not match"));
  if (header.version != kFormatVersion)
    throw Error(concat(path.string(), ": format version ", header.version, ", this program reads version ", kFormatVersion));
  if (header.record_bytes != sizeof(IndexRecord) || header.count != (size - sizeof header) / sizeof(IndexRecord) ||
      (size - sizeof header) % sizeof(IndexRecord) != 0)
    throw Error(concat(path.string(), ": ", size, " bytes, expected ", header.count, " records of ", sizeof(IndexRecord), " bytes"));
  std::vector<ChunkEntry> entries;
  entries.reserve(header.count);
  std::vector<IndexRecord> records(std::min<std::uint64_t>(header.count, 16384));
  std::uint32_t crc = 0;
  for (std::uint64_t at = 0; at < header.count;) {
    const auto n = static_cast<std::size_t>(std::min<std::uint64_t>(records.size(), header.count - at));
    file.read_at(sizeof header + at * sizeof(IndexRecord), records.data(), n * sizeof(IndexRecord));
    crc = crc32c(records.data(), n * sizeof(IndexRecord), crc);
    for (std::size_t i = 0; i < n; ++i) entries.push_back(from_record(records[i]));
    at += n;
  }
  if (crc != header.records_crc) throw Error(concat(path.string(), ": checksum of the records does not match: expected ", header.records_crc, ", found ", crc));
  return entries;
}

void check_index(const fs::path& path, std::vector<ChunkEntry>& entries, std::uint64_t geometry_size, std::uint64_t source_size) {
  const auto require = [&](bool ok, std::size_t i, const char* what) {
    if (!ok) throw Error(concat(path.string(), ": entry ", i, " of ", entries.size(), ": ", what));
  };
  if (entries.empty()) throw Error(concat(path.string(), ": no entries, expected at least the root"));
  require(entries[0].level == 0, 0, "level is not 0, expected the root");
  std::uint64_t next_child = 1;
  for (std::size_t i = 0; i < entries.size(); ++i) {
    ChunkEntry& e = entries[i];
    require(e.level <= kMaxLevel, i, "level is above 21");
    require(e.morton >> (3 * e.level) == 0, i, "cell is outside the root");
    require(e.count >= 1 && e.count <= kMaxChunkSurfels, i, "count is not in 1 .. 65536");
    require(e.offset % kChunkAlignment == 0, i, "offset is not a multiple of 4096");
    require(e.offset <= geometry_size && geometry_bytes(e.count) <= geometry_size - e.offset, i, "blocks lie beyond the end of geometry.bin");
    require(std::isfinite(e.radius_max) && e.radius_max > 0, i, "largest radius is not a positive number");
    require(std::isfinite(e.spacing) && e.spacing >= 0, i, "spacing is not a number");
    for (std::size_t a = 0; a < 3; ++a) require(e.tight_min[a] <= e.tight_max[a], i, "bounds are inverted");
    if (i > 0) {
      const ChunkEntry& p = entries[i - 1];
      require(std::tie(p.level, p.morton, p.part) < std::tie(e.level, e.morton, e.part), i, "is not in the order of level, cell and part");
      require(e.parent < i, i, "has no parent");
    }
    require(e.part == 0 || (e.level == kMaxLevel && e.is_leaf()), i, "is a continuation above the deepest level");
    if (e.is_leaf()) {
      require(e.source_offset <= source_size && kSourceBytes * e.count <= source_size - e.source_offset, i, "source indices lie beyond the end of source.bin");
      continue;
    }
    require(e.source_offset <= kLocalBits, i, "voxel bits are above 16");
    require(e.first_child == next_child, i, "first child is not next in the index");
    require(next_child + e.num_children <= entries.size(), i, "children lie beyond the end of the index");
    for (std::size_t c = 0; c < e.num_children; ++c) {
      ChunkEntry& child = entries[next_child + c];
      require(child.level == e.level + 1 && child.morton >> 3 == e.morton, next_child + c, "is not inside its parent's cell");
      child.parent = static_cast<std::uint32_t>(i);
    }
    next_child += e.num_children;
  }
  require(next_child == entries.size(), next_child, "has no parent");
  entries[0].parent = kNoParent;
}

ChunkFrame frame_of(const Manifest& manifest, const ChunkEntry& entry) {
  const auto cell = morton_decode(entry.morton);
  const double edge = std::ldexp(manifest.edge, -entry.level);
  ChunkFrame frame;
  frame.origin_in_world = manifest.origin_in_world + edge * Vec3d(cell[0], cell[1], cell[2]);
  frame.step = std::ldexp(edge, -kLocalBits);
  frame.radius_max = entry.radius_max;
  return frame;
}

Box3d tight_box(const ChunkFrame& frame, const ChunkEntry& e) {
  Box3d box;
  box.min = frame.origin_in_world + frame.step * Vec3d(e.tight_min[0] + 0.5, e.tight_min[1] + 0.5, e.tight_min[2] + 0.5);
  box.max = frame.origin_in_world + frame.step * Vec3d(e.tight_max[0] + 0.5, e.tight_max[1] + 0.5, e.tight_max[2] + 0.5);
  return box;
}

void pack_sources(const std::vector<std::uint64_t>& sources, std::vector<std::byte>& bytes) {
  const std::size_t n = sources.size();
  bytes.resize(n * kSourceBytes);
  for (std::size_t i = 0; i < n; ++i) {
    const auto low = static_cast<std::uint32_t>(sources[i]);
    std::memcpy(&bytes[4 * i], &low, 4);
    bytes[4 * n + i] = static_cast<std::byte>(sources[i] >> 32);
  }
}

std::vector<std::uint64_t> unpack_sources(const std::vector<std::byte>& bytes, std::uint32_t count) {
  std::vector<std::uint64_t> sources(count);
  for (std::size_t i = 0; i < count; ++i) {
    std::uint32_t low = 0;
    std::memcpy(&low, &bytes[4 * i], 4);
    sources[i] = low | static_cast<std::uint64_t>(bytes[4 * std::size_t{count} + i]) << 32;
  }
  return sources;
}

}  // namespace chiaro::stream
