#include "stream/photo/raster.h"

#include <algorithm>
#include <array>
#include <atomic>
#include <cstring>

#include "stream/base/error.h"
#include "stream/base/hash.h"

namespace chiaro::stream {
namespace {

constexpr char kMagic[8] = {'C', 'H', 'R', 'A', 'S', 'T', 'R', '1'};
constexpr std::uint32_t kVersion = 1, kMaxPlanes = 256;
constexpr int kCrcRows = 64;

struct Header {
  char magic[8];
  std::uint32_t version;
  std::int32_t width, height;
  std::uint32_t num_planes;
};
struct PlaneRecord {
  char name[32];
  std::uint32_t type, reserved;
};

std::uint64_t align64(std::uint64_t v) { return (v + 63) / 64 * 64; }

struct Layout {
  int width = 0, height = 0;
  std::vector<PlaneInfo> planes;
  std::vector<std::uint64_t> offsets;
  std::uint64_t crc_offset = 0, end = 0;

  void place() {
    std::uint64_t at = align64(sizeof(Header) + planes.size() * sizeof(PlaneRecord));
    offsets.clear();
    for (const PlaneInfo& p : planes) {
      offsets.push_back(at);
      at = align64(at + static_cast<std::uint64_t>(width) * static_cast<std::uint64_t>(height) * plane_type_bytes(p.type));
    }
    crc_offset = at;
    end = at + planes.size() * num_bands() * sizeof(std::uint32_t);
  }
  std::size_t num_bands() const { return static_cast<std::size_t>((height + kCrcRows - 1) / kCrcRows); }
  std::size_t index(std::string_view name, const std::filesystem::path& path) const {
    for (std::size_t i = 0; i < planes.size(); ++i)
      if (planes[i].name == name) return i;
    throw Error(concat(path.string(), ": has no plane \"", name, "\""));
  }
  std::uint64_t row_bytes(std::size_t plane) const { return static_cast<std::uint64_t>(width) * plane_type_bytes(planes[plane].type); }
};

/// Of one plane and band, as the file holds it now.
std::uint32_t band_crc(const File& file, const Layout& layout, std::size_t plane, std::size_t band) {
  const int y0 = static_cast<int>(band) * kCrcRows, rows = std::min(kCrcRows, layout.height - y0);
  std::uint64_t at = layout.offsets[plane] + layout.row_bytes(plane) * static_cast<std::uint64_t>(y0);
  const std::uint64_t end = at + layout.row_bytes(plane) * static_cast<std::uint64_t>(rows);
  std::array<std::byte, 65536> piece;
  std::uint32_t crc = 0;
  for (; at < end; at += piece.size()) {
    const auto bytes = static_cast<std::size_t>(std::min<std::uint64_t>(piece.size(), end - at));
    file.read_at(at, piece.data(), bytes);
    crc = crc32c(piece.data(), bytes, crc);
  }
  return crc;
}

std::vector<std::uint32_t> band_crcs(const File& file, const Layout& layout) {
  std::vector<std::uint32_t> crcs(layout.planes.size() * layout.num_bands());
  for (std::size_t i = 0; i < crcs.size(); ++i) crcs[i] = band_crc(file, layout, i / layout.num_bands(), i % layout.num_bands());
  return crcs;
}

}  // namespace

std::size_t plane_type_bytes(PlaneType type) {
  switch (type) {
    case PlaneType::kF32:
    case PlaneType::kU32: return 4;
    case PlaneType::kU16: return 2;
    case PlaneType::kU8: return 1;
  }
  return 0;
}

struct RasterWriter::Impl {
  explicit Impl(const std::filesystem::path& path) : atomic(path) {}
  AtomicFile atomic;
  Layout layout;
};

RasterWriter::RasterWriter(const std::filesystem::path& path, int width, int height, std::vector<PlaneInfo> planes) {
  if (width <= 0 || height <= 0 || static_cast<std::int64_t>(width) * height > (std::int64_t{1} << 31))
    throw Error(concat(path.string(), ": image size ", width, " x ", height, " is not usable"));
  impl_ = std::make_unique<Impl>(path);
  Layout& layout = impl_->layout;
  layout.width = width;
  layout.height = height;
  layout.planes = std::move(planes);
  layout.place();
  File& file = impl_->atomic.file();
  file.reserve(layout.end);
  Header header{};
  std::memcpy(header.magic, kMagic, 8);
  header.version = kVersion;
  header.width = width;
  header.height = height;
  header.num_planes = static_cast<std::uint32_t>(layout.planes.size());
  file.write_at(0, &header, sizeof header);
  for (std::size_t i = 0; i < layout.planes.size(); ++i) {
    PlaneRecord record{};
    if (layout.planes[i].name.size() >= sizeof record.name) throw std::invalid_argument("plane name too long");
    std::memcpy(record.name, layout.planes[i].name.data(), layout.planes[i].name.size());
    record.type = static_cast<std::uint32_t>(layout.planes[i].type);
    file.write_at(sizeof header + i * sizeof record, &record, sizeof record);
  }
}

RasterWriter::RasterWriter(RasterWriter&&) noexcept = default;
RasterWriter::~RasterWriter() = default;
int RasterWriter::width() const { return impl_->layout.width; }
int RasterWriter::height() const { return impl_->layout.height; }

void RasterWriter::write_rows(std::string_view plane, int y0, int rows, std::span<const std::byte> bytes) {
  const Layout& layout = impl_->layout;
  const std::size_t i = layout.index(plane, impl_->atomic.part_path());
  if (y0 < 0 || rows < 0 || y0 + rows > layout.height || bytes.size() != layout.row_bytes(i) * static_cast<std::uint64_t>(rows))
    throw std::invalid_argument("RasterWriter::write_rows: rows outside the image or wrong size");
  impl_->atomic.file().write_at(layout.offsets[i] + layout.row_bytes(i) * static_cast<std::uint64_t>(y0), bytes.data(), bytes.size());
}

void RasterWriter::read_back(std::string_view plane, int y0, int rows, std::span<std::byte> bytes) const {
  const Layout& layout = impl_->layout;
  const std::size_t i = layout.index(plane, impl_->atomic.part_path());
  if (y0 < 0 || rows < 0 || y0 + rows > layout.height || bytes.size() != layout.row_bytes(i) * static_cast<std::uint64_t>(rows))
    throw std::invalid_argument("RasterWriter::read_back: rows outside the image or wrong size");
  impl_->atomic.file().read_at(layout.offsets[i] + layout.row_bytes(i) * static_cast<std::uint64_t>(y0), bytes.data(), bytes.size());
}

void RasterWriter::commit() {
  File& file = impl_->atomic.file();
  file.truncate(impl_->layout.end);
  const auto crcs = band_crcs(file, impl_->layout);
  file.write_at(impl_->layout.crc_offset, crcs.data(), crcs.size() * sizeof crcs[0]);
  impl_->atomic.commit();
}

struct RasterReader::Impl {
  File file;
  Layout layout;
  std::vector<std::uint32_t> crcs;             ///< as stored
  std::vector<std::atomic<bool>> checked;      ///< one a plane and band; two threads may both check a band, to the same end

  void check(std::size_t i) {
    if (checked[i].load(std::memory_order_relaxed)) return;
    const std::size_t plane = i / layout.num_bands(), band = i % layout.num_bands();
    if (band_crc(file, layout, plane, band) != crcs[i])
      throw Error(concat(file.path().string(), ": checksum of plane \"", layout.planes[plane].name, "\", rows from ", band * kCrcRows, " is wrong"));
    checked[i].store(true, std::memory_order_relaxed);
  }
};

RasterReader::RasterReader(const std::filesystem::path& path) : impl_(std::make_unique<Impl>()) {
  impl_->file = File(path, File::Mode::kRead);
  Header header{};
  impl_->file.read_at(0, &header, sizeof header);
  if (std::memcmp(header.magic, kMagic, 8) != 0) throw Error(concat(path.string(), ": not a raster file (magic at offset 0)"));
  if (header.version != kVersion) throw Error(concat(path.string(), ": raster version ", header.version, ", expected ", kVersion));
  if (header.width <= 0 || header.height <= 0 || header.num_planes == 0 || header.num_planes > kMaxPlanes ||
      static_cast<std::int64_t>(header.width) * header.height > (std::int64_t{1} << 31))
    throw Error(concat(path.string(), ": raster header of ", header.width, " x ", header.height, ", ", header.num_planes, " planes is not usable"));
  Layout& layout = impl_->layout;
  layout.width = header.width;
  layout.height = header.height;
  for (std::uint32_t i = 0; i < header.num_planes; ++i) {
    PlaneRecord record{};
    impl_->file.read_at(sizeof header + i * sizeof record, &record, sizeof record);
    record.name[31] = 0;
    if (record.type > 3) throw Error(concat(path.string(), ": plane ", i, " has type ", record.type, ", expected 0 to 3"));
    if (has(record.name)) throw Error(concat(path.string(), ": planes ", i, " and one before it are both called \"", record.name, "\""));
    layout.planes.push_back({record.name, static_cast<PlaneType>(record.type)});
  }
  layout.place();
  if (impl_->file.size() != layout.end)
    throw Error(concat(path.string(), ": ", impl_->file.size(), " bytes, expected ", layout.end, " from its header"));
  impl_->crcs.resize(layout.planes.size() * layout.num_bands());
  impl_->file.read_at(layout.crc_offset, impl_->crcs.data(), impl_->crcs.size() * sizeof impl_->crcs[0]);
  impl_->checked = std::vector<std::atomic<bool>>(impl_->crcs.size());
}

RasterReader::RasterReader(RasterReader&&) noexcept = default;
RasterReader& RasterReader::operator=(RasterReader&&) noexcept = default;
RasterReader::~RasterReader() = default;
int RasterReader::width() const { return impl_->layout.width; }
int RasterReader::height() const { return impl_->layout.height; }
const std::vector<PlaneInfo>& RasterReader::planes() const { return impl_->layout.planes; }
bool RasterReader::has(std::string_view plane) const {
  return std::any_of(planes().begin(), planes().end(), [&](const PlaneInfo& p) { return p.name == plane; });
}

void RasterReader::read_rows(std::string_view plane, int y0, int rows, std::span<std::byte> bytes) const {
  const Layout& layout = impl_->layout;
  const std::size_t i = layout.index(plane, impl_->file.path());
  if (y0 < 0 || rows < 0 || y0 + rows > layout.height) throw std::invalid_argument("RasterReader::read_rows: rows outside the image");
  if (bytes.size() != layout.row_bytes(i) * static_cast<std::uint64_t>(rows))
    throw Error(concat(impl_->file.path().string(), ": plane \"", plane, "\" has ", layout.row_bytes(i), " bytes a row, expected ", rows > 0 ? bytes.size() / static_cast<std::uint64_t>(rows) : bytes.size()));
  if (rows == 0) return;
  for (int band = y0 / kCrcRows; band <= (y0 + rows - 1) / kCrcRows; ++band) impl_->check(i * layout.num_bands() + static_cast<std::size_t>(band));
  impl_->file.read_at(layout.offsets[i] + layout.row_bytes(i) * static_cast<std::uint64_t>(y0), bytes.data(), bytes.size());
}

void RasterReader::verify() const {
  for (std::size_t i = 0; i < impl_->crcs.size(); ++i) {
    impl_->checked[i] = false;
    impl_->check(i);
  }
}

}  // namespace chiaro::stream
