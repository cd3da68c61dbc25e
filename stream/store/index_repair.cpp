#include "stream/store/index_repair.h"

#include <algorithm>
#include <cmath>
#include <cstring>
#include <limits>
#include <map>
#include <tuple>

#include "stream/base/error.h"
#include "stream/base/hash.h"
#include "stream/store/checksum_repair.h"
#include "stream/store/inner_levels.h"
#include "stream/store/morton.h"
#include "stream/store/store_format.h"

namespace chiaro::stream {
namespace fs = std::filesystem;
namespace {

constexpr std::uint64_t kAnySize = std::uint64_t{1} << 62;  // files may be short: their chunks are looked at one by one

constexpr std::size_t kMostMade = 16;  // nodes of at most 768 KiB that are held at a time

MortonKey first_key(const ChunkEntry& e) { return cell_begin(e.morton, e.level); }

File open_or_nothing(const fs::path& path) {
  std::error_code code;
  return fs::is_regular_file(path, code) ? File(path, File::Mode::kRead) : File();
}

class IndexRepairer {
 public:
  IndexRepairer(const fs::path& store, const std::optional<Manifest>& manifest, Reporter& report)
      : path_(index_path(store)), manifest_(manifest), report_(report), geometry_(open_or_nothing(geometry_path(store))), source_(open_or_nothing(source_path(store))) {
    const File file(path_, File::Mode::kRead);
    const std::uint64_t size = file.size();
    if (size < sizeof(IndexHeader)) fail(concat(size, " bytes are left of it"));
    bytes_.resize(size);
    file.read_at(0, bytes_.data(), size);
  }

  RepairedIndex run() {
    judge_header();
    const std::uint64_t on_disk = (bytes_.size() - sizeof(IndexHeader)) / kIndexRecordBytes;
    records_ = std::span<const std::byte>(bytes_).subspan(sizeof(IndexHeader), std::min(count_, on_disk) * kIndexRecordBytes);
    const bool all_there = on_disk >= count_;
    if (wanted_ && all_there && crc32c(records_) == *wanted_) return {checked(decode(records_)), header_is_whole_ && bytes_.size() == whole_size() ? "" : "header or size put right"};
    if (wanted_ && all_there)
      if (auto entries = by_one_byte(records_)) return {std::move(*entries), "one damaged byte found by the checksum"};
    if (!manifest_) fail("too much of it is damaged, and manifest.json is too");
    try {
      return {from_leaves(true), kFromLeaves};
    } catch (const Error&) {
      return {from_leaves(false), kFromLeaves};
    }
  }

 private:
  static constexpr const char* kFromLeaves = "damaged records made anew from the leaves";

  [[noreturn]] void fail(const std::string& why) const { throw Error(concat(path_.string(), ": cannot be rebuilt: ", why)); }

  std::uint64_t whole_size() const { return sizeof(IndexHeader) + count_ * kIndexRecordBytes; }

  // How many records there should be, and their checksum, if that can still be told.
  void judge_header() {
    IndexHeader found;
    std::memcpy(&found, bytes_.data(), sizeof found);
    count_ = (bytes_.size() - sizeof found) / kIndexRecordBytes;
    const IndexHeader known = index_header(0, 0);
    if (found.header_crc == header_crc_of(found)) {
      if (std::memcmp(found.magic, known.magic, sizeof known.magic) != 0 || found.version != known.version || found.record_bytes != known.record_bytes)
        fail("it is of another kind or version");
      header_is_whole_ = true;
      count_ = found.count;
      wanted_ = found.records_crc;
      if (count_ > std::numeric_limits<std::uint32_t>::max()) fail("too many records");
      return;
    }
    const std::uint32_t records = crc32c(std::span<const std::byte>(bytes_).subspan(sizeof found, count_ * kIndexRecordBytes));
    const bool records_are_whole = index_header(count_, records).header_crc == found.header_crc || records == found.records_crc;
    if (records_are_whole) wanted_ = records;
    else if (index_header(count_, found.records_crc).header_crc == found.header_crc) wanted_ = found.records_crc;
  }

  static std::vector<ChunkEntry> decode(std::span<const std::byte> records) {
    std::vector<ChunkEntry> entries;
    entries.reserve(records.size() / kIndexRecordBytes);
    for (std::size_t at = 0; at < records.size(); at += kIndexRecordBytes) entries.push_back(decode_entry(&records[at]));
    return entries;
  }

  std::vector<ChunkEntry> checked(std::vector<ChunkEntry> entries) const {
    check_index(path_, entries, kAnySize, kAnySize);
    return entries;
  }

  std::optional<std::vector<ChunkEntry>> by_one_byte(std::span<const std::byte> records) const {
    std::optional<std::vector<ChunkEntry>> answer;
    std::vector<std::byte> candidate(records.begin(), records.end());
    for (const ByteFix& fix : one_byte_fixes(records, *wanted_)) {
      candidate[fix.at] ^= fix.flip;
      std::vector<ChunkEntry> entries = decode(candidate);
      candidate[fix.at] ^= fix.flip;
      try {
        entries = checked(std::move(entries));
      } catch (const Error&) {
        continue;
      }
      const std::size_t i = fix.at / kIndexRecordBytes;
      if ((!agrees(entries[i]) && !follows(entries, i)) || is_contradicted(entries)) continue;
      if (answer) return std::nullopt;
      answer = std::move(entries);
    }
    return answer;
  }

  // Damage of several bytes may look like that of one somewhere else. Then there is a chunk whose geometry is whole and whose bounds are not those of its record.
  bool is_contradicted(const std::vector<ChunkEntry>& entries) const {
    return std::any_of(entries.begin(), entries.end(), [&](const ChunkEntry& e) {
      report_.check();
      return checksum_at(geometry_, e.offset, geometry_bytes(e.count)) == e.geometry_crc && !has_bounds(e);
    });
  }

  // Of its geometry, which is whole.
  bool has_bounds(const ChunkEntry& e) const {
    ChunkEntry same = e;
    set_tight_bounds(same, read_blocks(geometry_, e));
    return same.tight_min == e.tight_min && same.tight_max == e.tight_max;
  }

  // Is the chunk what its record says, as far as the bytes on disk can tell?
  bool agrees(const ChunkEntry& e) const {
    if (checksum_at(geometry_, e.offset, geometry_bytes(e.count)) != e.geometry_crc) return false;
    if (e.is_leaf() && checksum_at(source_, e.source_offset, kSourceBytes * e.count) != e.source_crc) return false;
    return has_bounds(e);
  }

  // Is an inner node, whose own bytes may be damaged, what its children make?
  bool follows(const std::vector<ChunkEntry>& entries, std::size_t i) const {
    const ChunkEntry& e = entries[i];
    if (e.is_leaf() || !manifest_) return false;
    for (std::uint32_t c = e.first_child; c < e.first_child + e.num_children; ++c)
      if (checksum_at(geometry_, entries[c].offset, geometry_bytes(entries[c].count)) != entries[c].geometry_crc) return false;
    const ChunkEntry made = make_inner_node(*manifest_, entries, e, [&](std::uint32_t c) { return read_blocks(geometry_, entries[c]); }, kMaxChunkSurfels, static_cast<int>(e.source_offset)).entry;
    std::byte expected[kIndexRecordBytes], found[kIndexRecordBytes];
    encode_entry(made, expected);
    encode_entry(e, found);
    return std::memcmp(expected, found, kIndexRecordBytes) == 0;
  }

  // trust_checksums: where those of a leaf do not fit, its bytes are damaged and not its record.
  std::vector<ChunkEntry> from_leaves(bool trust_checksums) {
    std::vector<ChunkEntry> leaves, old_inner;
    for (const ChunkEntry& e : decode(records_)) {
      if (e.level > kMaxLevel || e.morton >> (3 * e.level) != 0 || e.count < 1 || e.count > kMaxChunkSurfels) continue;
      if (!std::isfinite(e.radius_max) || !(e.radius_max > 0)) continue;
      (e.is_leaf() ? leaves : old_inner).push_back(e);
    }
    const bool untouched = lay_out(leaves, trust_checksums);
    std::vector<ChunkEntry> entries = link_index(leaves);
    if (entries.size() != count_) fail(concat(count_, " records, the leaves that can be told make ", entries.size()));
    make_inner(entries, old_inner, aligned_end(leaves.back()));
    std::vector<std::byte> made(entries.size() * kIndexRecordBytes);
    for (std::size_t i = 0; i < entries.size(); ++i) encode_entry(entries[i], &made[i * kIndexRecordBytes]);
    if (wanted_) {
      if (crc32c(made) == *wanted_) return checked(std::move(entries));
      if (auto fixed = by_one_byte(made)) return std::move(*fixed);
      fail("records of leaves are damaged where nothing else tells what they were");
    }
    std::uint64_t inner = 0;
    for (const ChunkEntry& e : entries) inner += e.is_leaf() ? 0 : e.count;
    if (!untouched || inner != manifest_->surfels_inner) fail("its header and records of leaves are damaged");
    return checked(std::move(entries));
  }

  // Leaves follow each other in both files. False where something had to be put right: the checksum of all records then has to prove it.
  bool lay_out(std::vector<ChunkEntry>& leaves, bool trust_checksums) const {
    if (leaves.empty()) fail("no record of a leaf is left");
    std::sort(leaves.begin(), leaves.end(), [](const ChunkEntry& a, const ChunkEntry& b) { return first_key(a) != first_key(b) ? first_key(a) < first_key(b) : a.part < b.part; });
    bool untouched = true;
    std::uint64_t geometry_end = 0, source_end = 0, points = 0;
    const ChunkEntry* last = nullptr;
    for (ChunkEntry& e : leaves) {
      report_.check();
      const bool goes_on = last && e.level == kMaxLevel && last->level == kMaxLevel && e.morton == last->morton && e.part == last->part + 1;
      if (last && !goes_on && first_key(e) < cell_begin(last->morton + 1, last->level)) fail("records of leaves overlap");
      last = &e;
      const ChunkEntry found = e;
      e.offset = geometry_end;
      e.source_offset = source_end;
      e.first_child = 0;
      put_right(e, trust_checksums);
      std::byte before[kIndexRecordBytes], after[kIndexRecordBytes];
      encode_entry(found, before);
      encode_entry(e, after);
      untouched = untouched && std::memcmp(before, after, kIndexRecordBytes) == 0;
      geometry_end = aligned_end(e);
      source_end += kSourceBytes * e.count;
      points += e.count;
    }
    if (points != manifest_->points_stored) fail(concat("records of leaves with ", points < manifest_->points_stored ? manifest_->points_stored - points : 0, " points are lost"));
    return untouched;
  }

  void put_right(ChunkEntry& e, bool trust_checksums) const {
    const auto geometry = checksum_at(geometry_, e.offset, geometry_bytes(e.count)), source = checksum_at(source_, e.source_offset, kSourceBytes * e.count);
    if (!trust_checksums && geometry) e.geometry_crc = *geometry;
    if (!trust_checksums && source) e.source_crc = *source;
    if (geometry == e.geometry_crc) set_tight_bounds(e, read_blocks(geometry_, e));
  }

  // Each inner node made from its children, with the g it had; the one whose bytes are those on disk is the right one.
  void make_inner(std::vector<ChunkEntry>& entries, std::vector<ChunkEntry>& old_inner, std::uint64_t end) {
    const auto by_cell = [](const ChunkEntry& a, const ChunkEntry& b) { return std::tie(a.level, a.morton) < std::tie(b.level, b.morton); };
    std::sort(old_inner.begin(), old_inner.end(), by_cell);
    const ReadBlocks read = [&](std::uint32_t chunk) {
      const auto made = made_.find(chunk);
      return made != made_.end() ? made->second : read_blocks(geometry_, entries[chunk]);
    };
    made_.clear();
    report_.begin("rebuild index", entries.size(), "chunks");
    std::uint64_t done = 0;
    for (std::size_t level_end = entries.size(); level_end > 0;) {
      std::size_t begin = level_end;
      while (begin > 0 && entries[begin - 1].level == entries[level_end - 1].level) --begin;
      for (std::size_t i = begin; i < level_end; ++i) {
        report_.check();
        report_.progress(++done);
        if (entries[i].is_leaf()) continue;
        std::vector<int> tries;
        const auto old = std::lower_bound(old_inner.begin(), old_inner.end(), entries[i], by_cell);
        if (old != old_inner.end() && !by_cell(entries[i], *old) && old->source_offset <= kLocalBits) tries.push_back(static_cast<int>(old->source_offset));
        tries.push_back(-1);
        for (int bits = kLocalBits; bits >= 0; --bits) tries.push_back(bits);
        if (!make_node(entries, i, tries, read, end)) fail(concat("chunk ", i, " of level ", int{entries[i].level}, " does not follow from its children"));
        end = aligned_end(entries[i]);
      }
      level_end = begin;
    }
    report_.end();
  }

  bool make_node(std::vector<ChunkEntry>& entries, std::size_t i, const std::vector<int>& tries, const ReadBlocks& read, std::uint64_t offset) {
    std::optional<InnerNode> first;
    for (const int bits : tries) {
      InnerNode node = make_inner_node(*manifest_, entries, entries[i], read, kMaxChunkSurfels, bits);
      if (node.entry.count > kMaxChunkSurfels) continue;
      node.entry.offset = offset;
      if (checksum_at(geometry_, offset, geometry_bytes(node.entry.count)) == node.entry.geometry_crc) {
        entries[i] = node.entry;
        return true;
      }
      if (!first) first = std::move(node);
    }
    // The bytes on disk are damaged too: the most likely node, for which the checksum of all records has to stand.
    if (!first || !wanted_ || made_.size() >= kMostMade) return false;
    entries[i] = first->entry;
    made_[static_cast<std::uint32_t>(i)] = std::move(first->blocks);
    return true;
  }

  fs::path path_;
  const std::optional<Manifest>& manifest_;
  Reporter& report_;
  File geometry_, source_;
  std::vector<std::byte> bytes_;
  std::span<const std::byte> records_;
  bool header_is_whole_ = false;
  std::uint64_t count_ = 0;
  std::optional<std::uint32_t> wanted_;
  std::map<std::uint32_t, std::vector<SurfelBlock>> made_;  // inner nodes that are damaged on disk
};

}  // namespace

RepairedIndex repaired_index(const fs::path& store, const std::optional<Manifest>& manifest, Reporter& report) {
  return IndexRepairer(store, manifest, report).run();
}

void set_tight_bounds(ChunkEntry& e, const std::vector<SurfelBlock>& blocks) {
  e.tight_min = {65535, 65535, 65535};
  e.tight_max = {0, 0, 0};
  for (std::uint32_t slot = 0; slot < e.count; ++slot) {
    const SurfelBlock& b = blocks[slot / 16];
    const std::array<std::uint16_t, 3> q{b.x[slot % 16], b.y[slot % 16], b.z[slot % 16]};
    for (std::size_t a = 0; a < 3; ++a) {
      e.tight_min[a] = std::min(e.tight_min[a], q[a]);
      e.tight_max[a] = std::max(e.tight_max[a], q[a]);
    }
  }
}

std::optional<std::uint32_t> checksum_at(const File& file, std::uint64_t offset, std::uint64_t bytes) {
  if (!file.is_open()) return std::nullopt;
  const std::uint64_t size = file.size();
  if (offset > size || bytes > size - offset) return std::nullopt;
  std::vector<std::byte> buffer(static_cast<std::size_t>(std::min<std::uint64_t>(bytes, 1 << 20)));
  std::uint32_t crc = 0;
  for (std::uint64_t at = 0; at < bytes; at += buffer.size()) {
    const auto n = static_cast<std::size_t>(std::min<std::uint64_t>(buffer.size(), bytes - at));
    file.read_at(offset + at, buffer.data(), n);
    crc = crc32c(buffer.data(), n, crc);
  }
  return crc;
}

}  // namespace chiaro::stream
