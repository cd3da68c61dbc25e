#include "blend/accumulate.h"

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <cstring>
#include <limits>

#include "stream/base/error.h"
#include "stream/base/file.h"
#include "stream/base/hash.h"

namespace chiaro::blend {
namespace {

constexpr char kMagic[8] = {'C', 'H', 'R', 'B', 'L', 'N', 'D', '1'};
constexpr std::uint64_t kPage = 4096;

struct FileHeader {
  char magic[8];
  char key[32];
  std::uint64_t num_leaves;
  std::uint32_t num_photographs, record_bytes;
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

}  // namespace

void add_sample(Accumulator& sum, const Sample& sample, float high_band_power) {
  // A reading that contradicts the others is not yet down-weighted: robust rejection multiplies `low` and `high` here.
  const float low = sample.weight;
  const double high = std::pow(static_cast<double>(sample.weight), static_cast<double>(high_band_power)), high_deviation = high * static_cast<double>(sample.sigma);
  sum.low_weight += low;
  sum.high_weight += high;
  for (int c = 0; c < 3; ++c) {
    sum.low[c] += low * sample.low[c];
    sum.high[c] += high * static_cast<double>(sample.high[c]);
  }
  sum.low_variance += (low * sample.sigma) * (low * sample.sigma);
  sum.shared += low * sample.shared;
  sum.high_variance += high_deviation * high_deviation;
  ++sum.photographs;
}

BlendedSurfel resolve(const Accumulator& sum, float shared_sigma) {
  constexpr float kNaN = std::numeric_limits<float>::quiet_NaN();
  BlendedSurfel result{Vec3f::Constant(kNaN), kNaN, 0};
  if (sum.photographs == 0 || !(sum.low_weight > 0)) return result;
  for (int c = 0; c < 3; ++c) result.albedo[c] = sum.low[c] / sum.low_weight + static_cast<float>(sum.high_weight > 0 ? sum.high[c] / sum.high_weight : 0);
  // Slow errors average with the low band's weights, pixel noise with the high band's; the larger one speaks.
  const float low = std::sqrt(sum.low_variance) / sum.low_weight;
  const auto high = static_cast<float>(sum.high_weight > 0 ? std::sqrt(sum.high_variance) / sum.high_weight : 0);
  const float independent = std::max(low, high), shared = sum.shared / sum.low_weight;   // shared errors add by amplitude: they do not average out
  result.sigma = std::sqrt(independent * independent + shared * shared + shared_sigma * shared_sigma);
  result.photographs = static_cast<std::uint16_t>(std::min<std::uint32_t>(sum.photographs, 65535));
  return result;
}

struct AccumulatorFile::Impl {
  File file;
  std::vector<std::uint32_t> surfels;
  std::vector<std::uint64_t> offsets;    // of slot 0; slot 1 follows
  std::vector<Mark> marks;
  std::vector<std::int8_t> current;      // slot that holds the state, -1 none
  std::uint32_t num_photographs = 0, done = 0;
  FileHeader header{};

  std::uint64_t payload_bytes(std::size_t leaf) const {
    return std::uint64_t{num_photographs} * sizeof(std::uint32_t) + std::uint64_t{surfels[leaf]} * sizeof(Accumulator);
  }
  std::uint64_t slot_bytes(std::size_t leaf) const { return up_to_page(sizeof(SlotHeader) + payload_bytes(leaf)); }
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
    if (old.read_some_at(kPage, &record, sizeof record) != sizeof record || record.crc != crc_of(record) || record.photographs > num_photographs) return false;
    file = std::move(old);
    done = record.photographs;
    for (std::size_t leaf = 0; leaf < surfels.size(); ++leaf) find_current(leaf);
    return true;
  }
  /// The newest slot that is whole. Slots of photographs that are noted as done were synced; younger ones may be torn and are checked.
  void find_current(std::size_t leaf) {
    for (int slot = 0; slot < 2; ++slot) {
      SlotHeader h{};
      if (file.read_some_at(slot_offset(leaf, slot), &h, sizeof h) != sizeof h || h.header_crc != crc_of(h) || h.leaf != leaf || h.surfels != surfels[leaf]) continue;
      const Mark mark{h.photograph, h.row};
      if (current[leaf] >= 0 && mark <= marks[leaf]) continue;
      if (h.photograph >= done && !payload_fits(leaf, slot, h)) continue;
      current[leaf] = static_cast<std::int8_t>(slot);
      marks[leaf] = mark;
    }
  }
  bool payload_fits(std::size_t leaf, int slot, const SlotHeader& h) const {
    std::vector<std::byte> payload(payload_bytes(leaf));
    return file.read_some_at(slot_offset(leaf, slot) + sizeof h, payload.data(), payload.size()) == payload.size() && crc32c(payload) == h.payload_crc;
  }
};

AccumulatorFile::AccumulatorFile(const std::filesystem::path& path, const std::string& key, std::vector<std::uint32_t> surfels_of_leaf, std::uint32_t num_photographs)
    : impl_(std::make_unique<Impl>()) {
  Impl& m = *impl_;
  m.surfels = std::move(surfels_of_leaf);
  m.num_photographs = num_photographs;
  m.marks.resize(m.surfels.size());
  m.current.resize(m.surfels.size(), -1);
  std::memcpy(m.header.magic, kMagic, sizeof kMagic);
  std::memcpy(m.header.key, key.data(), std::min(key.size(), sizeof m.header.key));
  m.header.num_leaves = m.surfels.size();
  m.header.num_photographs = num_photographs;
  m.header.record_bytes = sizeof(Accumulator);
  std::uint64_t at = 2 * kPage;
  for (std::size_t leaf = 0; leaf < m.surfels.size(); ++leaf) {
    m.offsets.push_back(at);
    at += 2 * m.slot_bytes(leaf);
  }
  if (!m.resume(path)) m.start(path);
}

AccumulatorFile::AccumulatorFile(AccumulatorFile&&) noexcept = default;
AccumulatorFile::~AccumulatorFile() = default;
std::uint32_t AccumulatorFile::photographs_done() const { return impl_->done; }
Mark AccumulatorFile::mark(std::size_t leaf) const { return impl_->marks[leaf]; }
bool AccumulatorFile::is_written(std::size_t leaf) const { return impl_->current[leaf] >= 0; }

void AccumulatorFile::set_photographs_done(std::uint32_t count) {
  impl_->file.sync();
  impl_->write_done(count);
}

AccumulatorFile::Record AccumulatorFile::read(std::size_t leaf) const {
  const Impl& m = *impl_;
  Record record;
  record.samples_of_photograph.resize(m.num_photographs);
  record.surfels.resize(m.surfels[leaf]);
  if (m.current[leaf] < 0) return record;
  SlotHeader h{};
  const std::uint64_t at = m.slot_offset(leaf, m.current[leaf]), counts = record.samples_of_photograph.size() * sizeof(std::uint32_t),
                      sums = record.surfels.size() * sizeof(Accumulator);
  m.file.read_at(at, &h, sizeof h);
  m.file.read_at(at + sizeof h, record.samples_of_photograph.data(), counts);
  m.file.read_at(at + sizeof h + counts, record.surfels.data(), sums);
  if (crc32c(record.surfels.data(), sums, crc32c(record.samples_of_photograph.data(), counts)) != h.payload_crc)
    throw Error(concat(m.file.path().string(), ": checksum of leaf ", leaf, " at offset ", at, " does not fit; remove the file to start the blend anew"));
  return record;
}

void AccumulatorFile::write(std::size_t leaf, const Mark& mark, const Record& record) {
  Impl& m = *impl_;
  const int slot = m.current[leaf] == 0 ? 1 : 0;
  const std::uint64_t at = m.slot_offset(leaf, slot), counts = record.samples_of_photograph.size() * sizeof(std::uint32_t),
                      sums = record.surfels.size() * sizeof(Accumulator);
  SlotHeader h{mark.photograph, mark.row, static_cast<std::uint32_t>(leaf), m.surfels[leaf], 0, 0};
  h.payload_crc = crc32c(record.surfels.data(), sums, crc32c(record.samples_of_photograph.data(), counts));
  h.header_crc = crc_of(h);
  m.file.write_at(at + sizeof h, record.samples_of_photograph.data(), counts);
  m.file.write_at(at + sizeof h + counts, record.surfels.data(), sums);
  m.file.write_at(at, &h, sizeof h);
  m.current[leaf] = static_cast<std::int8_t>(slot);
  m.marks[leaf] = mark;
}

}  // namespace chiaro::blend
