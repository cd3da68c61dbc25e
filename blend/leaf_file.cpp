#include "blend/leaf_file.h"

#include <fcntl.h>

#include <algorithm>
#include <cassert>
#include <cstring>
#include <mutex>

#include "stream/base/error.h"
#include "stream/base/file.h"
#include "stream/base/hash.h"

namespace chiaro::blend {
namespace {

constexpr char kMagic[8] = {'C', 'H', 'R', 'B', 'L', 'N', 'D', '3'};
constexpr std::uint64_t kPage = 4096;

struct FileHeader {
  char magic[8];
  char key[32];
  std::uint64_t num_leaves;
  std::uint32_t num_photographs, counters, record_bytes, more;
};
struct DoneRecord {   // in its own page, so that it is written at one stroke
  std::uint32_t photographs, crc;
};
struct SlotHeader {
  std::uint32_t photograph, row, leaf, surfels;
  std::uint32_t payload_crc, header_crc;
};

std::uint64_t up_to_page(std::uint64_t bytes) { return (bytes + kPage - 1) / kPage * kPage; }
std::uint32_t crc_of(const SlotHeader& h) { return crc32c(&h, offsetof(SlotHeader, header_crc)) ^ 0x5a5a5a5au; }   // zeros are no header
std::uint32_t crc_of(const DoneRecord& d) { return crc32c(&d, offsetof(DoneRecord, crc)) ^ 0x5a5a5a5au; }

std::uint64_t payload_bytes(const LeafShape& shape, std::size_t leaf) {
  return std::uint64_t{shape.counters} * sizeof(std::uint32_t) + std::uint64_t{shape.surfels_of_leaf[leaf]} * (shape.record_bytes + shape.more * sizeof(FourFloats));
}

}  // namespace

struct LeafFile::Impl {
  File file;
  LeafShape shape;
  std::vector<std::uint64_t> offsets;    // of slot 0; slot 1 follows
  std::vector<Mark> marks;
  std::vector<std::int8_t> current;      // slot that holds the state, -1 none
  std::uint32_t done = 0;
  FileHeader header{};
  // Leaves that hold two states, the older of which may go once the newer one is synced. A leaf that is being written is not among them.
  std::mutex mutex;
  std::vector<std::uint8_t> is_doubled;
  std::uint64_t spare = 0, most_spare = 0;   // bytes of second slots; those being written count too

  void lay_out(const std::string& key, LeafShape shape_) {
    shape = std::move(shape_);
    const std::size_t leaves = shape.surfels_of_leaf.size();
    marks.resize(leaves);
    current.resize(leaves, -1);
    std::memcpy(header.magic, kMagic, sizeof kMagic);
    std::memcpy(header.key, key.data(), std::min(key.size(), sizeof header.key));
    header.num_leaves = leaves;
    header.num_photographs = shape.num_photographs;
    header.counters = shape.counters;
    header.record_bytes = shape.record_bytes;
    header.more = shape.more;
    is_doubled.resize(leaves);
    std::uint64_t at = 2 * kPage;
    for (std::size_t leaf = 0; leaf < leaves; ++leaf) {
      offsets.push_back(at);
      at += 2 * slot_bytes(leaf);
    }
    most_spare = spare_bytes((at - 2 * kPage) / 2);
  }

  void begin_write(std::size_t leaf) {
    const std::lock_guard lock(mutex);
    if (current[leaf] < 0) return;
    // Its newer state may not be on the disk yet: until it is, the older one is all that a power cut would leave.
    const bool older_is_needed = is_doubled[leaf] != 0;
    if (older_is_needed || spare + slot_bytes(leaf) > most_spare) {
      file.sync();
      release_doubled();
    }
    spare += slot_bytes(leaf);
  }
  void end_write(std::size_t leaf, int slot, const Mark& mark) {
    const std::lock_guard lock(mutex);
    is_doubled[leaf] = current[leaf] >= 0;
    current[leaf] = static_cast<std::int8_t>(slot);
    marks[leaf] = mark;
  }
  /// After a sync, under the lock.
  void release_doubled() {
    for (std::size_t leaf = 0; leaf < is_doubled.size(); ++leaf) {
      if (!is_doubled[leaf]) continue;
      // A file system that cannot make holes keeps the older state: it only costs disk.
      if (::fallocate(file.descriptor(), FALLOC_FL_PUNCH_HOLE | FALLOC_FL_KEEP_SIZE, static_cast<::off_t>(slot_offset(leaf, 1 - current[leaf])), static_cast<::off_t>(slot_bytes(leaf))) != 0) {
      }
      is_doubled[leaf] = 0;
      spare -= slot_bytes(leaf);
    }
  }

  std::uint64_t slot_bytes(std::size_t leaf) const { return disk_bytes(shape, leaf); }
  std::uint64_t slot_offset(std::size_t leaf, int slot) const { return offsets[leaf] + (slot > 0 ? slot_bytes(leaf) : 0); }

  void start(const std::filesystem::path& path) {
    file = File(path, File::Mode::kCreate);
    file.write_at(0, &header, sizeof header);
    write_done(0);
    file.sync();
  }
  void write_done(std::uint32_t count) {
    DoneRecord record{count, 0};
    record.crc = crc_of(record);
    file.write_at(kPage, &record, sizeof record);
    done = count;
  }
  bool resume(const std::filesystem::path& path) {
    if (!std::filesystem::exists(path)) return false;
    File old(path, File::Mode::kReadWrite);
    FileHeader found{};
    DoneRecord record{};
    if (old.read_some_at(0, &found, sizeof found) != sizeof found || std::memcmp(&found, &header, sizeof header) != 0) return false;
    if (old.read_some_at(kPage, &record, sizeof record) != sizeof record || record.crc != crc_of(record) || record.photographs > shape.num_photographs) return false;
    file = std::move(old);
    done = record.photographs;
    for (std::size_t leaf = 0; leaf < shape.surfels_of_leaf.size(); ++leaf) find_current(leaf);
    return true;
  }
  /// The newest slot that is whole. Slots of photographs that are noted as done were synced; younger ones may be torn and are checked.
  void find_current(std::size_t leaf) {
    for (int slot = 0; slot < 2; ++slot) {
      SlotHeader h{};
      if (file.read_some_at(slot_offset(leaf, slot), &h, sizeof h) != sizeof h || h.header_crc != crc_of(h) || h.leaf != leaf || h.surfels != shape.surfels_of_leaf[leaf]) continue;
      const Mark mark{h.photograph, h.row};
      if (current[leaf] >= 0 && mark <= marks[leaf]) continue;
      if (h.photograph >= done && !payload_fits(leaf, slot, h)) continue;
      current[leaf] = static_cast<std::int8_t>(slot);
      marks[leaf] = mark;
    }
    if (current[leaf] < 0) return;
    is_doubled[leaf] = 1;   // for all that is known
    spare += slot_bytes(leaf);
  }
  bool payload_fits(std::size_t leaf, int slot, const SlotHeader& h) const {
    std::vector<std::byte> payload(payload_bytes(shape, leaf));
    return file.read_some_at(slot_offset(leaf, slot) + sizeof h, payload.data(), payload.size()) == payload.size() && crc32c(payload) == h.payload_crc;
  }
};

LeafFile::LeafFile() : impl_(std::make_unique<Impl>()) {}

LeafFile::LeafFile(const std::filesystem::path& path, const std::string& key, LeafShape shape) : LeafFile() {
  impl_->lay_out(key, std::move(shape));
  if (!impl_->resume(path)) impl_->start(path);
}

std::optional<LeafFile> LeafFile::existing(const std::filesystem::path& path, const std::string& key, LeafShape shape) {
  LeafFile file;
  file.impl_->lay_out(key, std::move(shape));
  if (!file.impl_->resume(path)) return std::nullopt;
  return file;
}

std::uint64_t LeafFile::disk_bytes(const LeafShape& shape, std::size_t leaf) {
  return up_to_page(sizeof(SlotHeader) + payload_bytes(shape, leaf));
}

/// Syncing costs more than room: as much as all of it where that is little.
std::uint64_t LeafFile::spare_bytes(std::uint64_t leaves_bytes) {
  constexpr std::uint64_t kLittle = std::uint64_t{64} << 20;
  return std::min(leaves_bytes, std::max(kLittle, leaves_bytes / 8));
}

LeafFile::LeafFile(LeafFile&&) noexcept = default;
LeafFile& LeafFile::operator=(LeafFile&&) noexcept = default;
LeafFile::~LeafFile() = default;
std::size_t LeafFile::num_leaves() const { return impl_->shape.surfels_of_leaf.size(); }
std::uint32_t LeafFile::photographs_done() const { return impl_->done; }
Mark LeafFile::mark(std::size_t leaf) const { return impl_->marks[leaf]; }
bool LeafFile::is_written(std::size_t leaf) const { return impl_->current[leaf] >= 0; }
std::uint32_t LeafFile::surfels(std::size_t leaf) const { return impl_->shape.surfels_of_leaf[leaf]; }
std::uint32_t LeafFile::counters() const { return impl_->shape.counters; }
std::uint32_t LeafFile::more() const { return impl_->shape.more; }

void LeafFile::set_photographs_done(std::uint32_t count) {
  const std::lock_guard lock(impl_->mutex);
  impl_->file.sync();
  impl_->write_done(count);
  impl_->release_doubled();
}

void LeafFile::read_bytes(std::size_t leaf, std::span<std::uint32_t> counters, std::span<std::byte> surfels, std::span<std::byte> more) const {
  const Impl& m = *impl_;
  assert(surfels.size() == std::size_t{m.shape.surfels_of_leaf[leaf]} * m.shape.record_bytes);
  if (m.current[leaf] < 0) return;
  SlotHeader h{};
  const std::uint64_t at = m.slot_offset(leaf, m.current[leaf]);
  m.file.read_at(at, &h, sizeof h);
  std::uint64_t from = at + sizeof h;
  std::uint32_t crc = 0;
  for (const std::span<std::byte> part : {std::as_writable_bytes(counters), surfels, more}) {
    m.file.read_at(from, part.data(), part.size());
    from += part.size();
    crc = crc32c(part, crc);
  }
  if (crc != h.payload_crc) throw Error(concat(m.file.path().string(), ": checksum of leaf ", leaf, " at offset ", at, " does not fit; remove the file to start the blend anew"));
}

void LeafFile::write_bytes(std::size_t leaf, const Mark& mark, std::span<const std::uint32_t> counters, std::span<const std::byte> surfels, std::span<const std::byte> more) {
  Impl& m = *impl_;
  const int slot = m.current[leaf] == 0 ? 1 : 0;
  m.begin_write(leaf);
  std::uint64_t to = m.slot_offset(leaf, slot) + sizeof(SlotHeader);
  SlotHeader h{mark.photograph, mark.row, static_cast<std::uint32_t>(leaf), m.shape.surfels_of_leaf[leaf], 0, 0};
  for (const std::span<const std::byte> part : {std::as_bytes(counters), surfels, more}) {
    h.payload_crc = crc32c(part, h.payload_crc);
    m.file.write_at(to, part.data(), part.size());
    to += part.size();
  }
  h.header_crc = crc_of(h);
  m.file.write_at(m.slot_offset(leaf, slot), &h, sizeof h);
  m.end_write(leaf, slot, mark);
}

}  // namespace chiaro::blend
