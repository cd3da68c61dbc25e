#include "stream/photo/raster.h"

#include <blosc.h>
#include <unistd.h>

#include <algorithm>
#include <cstring>

#include "stream/base/error.h"
#include "stream/base/hash.h"
#include "stream/base/parallel.h"

namespace chiaro::stream {
namespace {

constexpr char kMagic[8] = {'C', 'H', 'R', 'A', 'S', 'T', 'R', '1'};
constexpr std::uint32_t kVersion = 2, kMaxPlanes = 256;
constexpr std::int64_t kMostPixels = std::int64_t{1} << 31;
constexpr int kMostColumns = 1 << 28;                                       ///< of 4 bytes: a row is a block that the compressor takes
constexpr std::size_t kBlockBytes = std::size_t{1} << 19;                   ///< stays in a processor's own cache
constexpr int kMostBlockRows = 64;
constexpr std::size_t kBytesUnderWay = std::size_t{16} << 20, kMostUnderWay = 256;
constexpr int kLevel = 5;                                                   ///< of 9: more gains a hundredth (measured)
constexpr std::size_t kMostRatio = 255;                                     ///< that LZ4 can reach

struct Header {
  char magic[8];
  std::uint32_t version;
  std::int32_t width, height;
  std::uint32_t num_planes, block_rows, index_crc;
  std::uint64_t index_offset;
};
struct PlaneRecord {
  char name[32];
  std::uint32_t type, reserved;
};
struct BlockEntry {
  std::uint64_t offset;
  std::uint32_t bytes, crc;
};

bool is_usable(std::int64_t width, std::int64_t height) { return width > 0 && height > 0 && width <= kMostColumns && width * height <= kMostPixels; }

/// To the nearest number with so many bits after the leading one.
void round_to(Precision precision, std::span<std::byte> floats) {
  if (precision == Precision::kAll) return;
  constexpr std::uint32_t kExponent = 0x7f800000;
  const std::uint32_t unit = std::uint32_t{1} << (23 - static_cast<int>(precision)), half = unit / 2, keep = ~(unit - 1);
  for (std::size_t at = 0; at + sizeof(float) <= floats.size(); at += sizeof(float)) {
    std::uint32_t bits;
    std::memcpy(&bits, &floats[at], sizeof bits);
    const std::uint32_t rounded = (bits + half) & keep;
    bits = (bits & kExponent) == kExponent ? bits : rounded;   // infinite, or no number
    std::memcpy(&floats[at], &bits, sizeof bits);
  }
}

struct Layout {
  int width = 0, height = 0, block_rows = 1;
  std::vector<PlaneInfo> planes;

  std::size_t blocks_of_plane() const { return static_cast<std::size_t>((height + block_rows - 1) / block_rows); }
  std::size_t num_blocks() const { return planes.size() * blocks_of_plane(); }
  std::size_t header_bytes() const { return sizeof(Header) + planes.size() * sizeof(PlaneRecord); }
  std::size_t index(std::string_view name, const std::filesystem::path& path) const {
    for (std::size_t i = 0; i < planes.size(); ++i)
      if (planes[i].name == name) return i;
    throw Error(concat(path.string(), ": has no plane \"", name, "\""));
  }
  std::size_t row_bytes(std::size_t plane) const { return static_cast<std::size_t>(width) * plane_type_bytes(planes[plane].type); }

  struct Rows {
    std::size_t plane = 0;
    int y0 = 0, rows = 0;
  };
  Rows rows_of(std::size_t block) const {
    const int y0 = static_cast<int>(block % blocks_of_plane()) * block_rows;
    return {block / blocks_of_plane(), y0, std::min(block_rows, height - y0)};
  }
  std::size_t bytes_of(std::size_t block) const {
    const Rows r = rows_of(block);
    return row_bytes(r.plane) * static_cast<std::size_t>(r.rows);
  }
  std::string name_of(std::size_t block) const { return concat("plane \"", planes[rows_of(block).plane].name, "\", rows from ", rows_of(block).y0); }
};

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

int raster_block_rows(int width, int height) {
  const std::size_t row_bytes = 4 * static_cast<std::size_t>(width);
  return std::clamp(static_cast<int>(std::min<std::size_t>(kBlockBytes / row_bytes, kMostBlockRows)), 1, height);
}

struct RasterWriter::Impl {
  explicit Impl(const std::filesystem::path& path) : atomic(path), rows(path.string() + ".rows", File::Mode::kCreate) {
    ::unlink(rows.path().c_str());   // gone with the process, however that ends
  }
  AtomicFile atomic;
  File rows;                           ///< as they were written, plane after plane
  Layout layout;
  std::vector<std::uint64_t> offsets;  ///< of planes there

  std::uint64_t place_of(std::size_t plane, int y) const { return offsets[plane] + layout.row_bytes(plane) * static_cast<std::uint64_t>(y); }
  std::uint64_t place_planes() {
    std::uint64_t at = 0;
    for (std::size_t i = 0; i < layout.planes.size(); ++i) {
      offsets.push_back(at);
      at += layout.row_bytes(i) * static_cast<std::uint64_t>(layout.height);
    }
    return at;
  }

  /// Plane and place of these rows.
  std::uint64_t find(std::string_view plane, int y0, int num_rows, std::size_t bytes) const {
    const std::size_t i = layout.index(plane, atomic.part_path());
    if (y0 < 0 || num_rows < 0 || y0 + num_rows > layout.height || bytes != layout.row_bytes(i) * static_cast<std::size_t>(num_rows))
      throw std::invalid_argument("RasterWriter: rows outside the image or wrong size");
    return place_of(i, y0);
  }

  struct Block {
    std::size_t number = 0;
    std::vector<std::byte> bytes, packed;
  };
  void read(Block& b) const {
    const Layout::Rows r = layout.rows_of(b.number);
    b.bytes.resize(layout.bytes_of(b.number));
    rows.read_at(place_of(r.plane, r.y0), b.bytes.data(), b.bytes.size());
  }
  void pack(Block& b) const {
    const PlaneInfo& plane = layout.planes[layout.rows_of(b.number).plane];
    if (plane.type == PlaneType::kF32) round_to(plane.precision, b.bytes);
    b.packed.resize(b.bytes.size() + BLOSC_MAX_OVERHEAD);
    const int size = blosc_compress_ctx(kLevel, BLOSC_SHUFFLE, plane_type_bytes(plane.type), b.bytes.size(), b.bytes.data(), b.packed.data(), b.packed.size(), BLOSC_LZ4_COMPNAME, 0, 1);
    if (size <= 0) throw Error(concat(atomic.part_path().string(), ": ", layout.name_of(b.number), " cannot be compressed (", size, ")"));
    b.packed.resize(static_cast<std::size_t>(size));
  }

  std::vector<BlockEntry> write_blocks() {
    std::size_t most = 1;
    for (std::size_t i = 0; i < layout.planes.size(); ++i) most = std::max(most, layout.row_bytes(i) * static_cast<std::size_t>(layout.block_rows));
    std::vector<Block> slots(std::clamp<std::size_t>(kBytesUnderWay / (2 * most), 1, kMostUnderWay));
    std::vector<BlockEntry> index;
    std::size_t next = 0;
    ordered_pipeline(
        slots.size(),
        [&](std::size_t s) {
          if (next == layout.num_blocks()) return false;
          slots[s].number = next++;
          read(slots[s]);
          return true;
        },
        [&](std::size_t s) { pack(slots[s]); },
        [&](std::size_t s) {
          const std::vector<std::byte>& packed = slots[s].packed;
          index.push_back({atomic.appended_bytes(), static_cast<std::uint32_t>(packed.size()), crc32c(packed.data(), packed.size())});
          atomic.append(packed.data(), packed.size());
        });
    return index;
  }

  void append_plane_records() {
    for (const PlaneInfo& plane : layout.planes) {
      PlaneRecord record{};
      std::memcpy(record.name, plane.name.data(), plane.name.size());
      record.type = static_cast<std::uint32_t>(plane.type);
      atomic.append(&record, sizeof record);
    }
  }
};

RasterWriter::RasterWriter(const std::filesystem::path& path, int width, int height, std::vector<PlaneInfo> planes) {
  if (!is_usable(width, height)) throw Error(concat(path.string(), ": image size ", width, " x ", height, " is not usable"));
  for (const PlaneInfo& plane : planes)
    if (plane.name.size() >= sizeof PlaneRecord::name) throw std::invalid_argument("plane name too long");
  impl_ = std::make_unique<Impl>(path);
  Layout& layout = impl_->layout;
  layout.width = width;
  layout.height = height;
  layout.block_rows = raster_block_rows(width, height);
  layout.planes = std::move(planes);
  impl_->rows.reserve(impl_->place_planes());
}

RasterWriter::RasterWriter(RasterWriter&&) noexcept = default;
RasterWriter::~RasterWriter() = default;
int RasterWriter::width() const { return impl_->layout.width; }
int RasterWriter::height() const { return impl_->layout.height; }

void RasterWriter::write_rows(std::string_view plane, int y0, int rows, std::span<const std::byte> bytes) {
  const std::uint64_t place = impl_->find(plane, y0, rows, bytes.size());
  impl_->rows.write_at(place, bytes.data(), bytes.size());
}

void RasterWriter::read_back(std::string_view plane, int y0, int rows, std::span<std::byte> bytes) const {
  impl_->rows.read_at(impl_->find(plane, y0, rows, bytes.size()), bytes.data(), bytes.size());
}

void RasterWriter::commit() {
  const Layout& layout = impl_->layout;
  AtomicFile& out = impl_->atomic;
  Header header{};
  out.append(&header, sizeof header);
  impl_->append_plane_records();
  const std::vector<BlockEntry> index = impl_->write_blocks();
  const std::size_t index_bytes = index.size() * sizeof index[0];
  std::memcpy(header.magic, kMagic, 8);
  header.version = kVersion;
  header.width = layout.width;
  header.height = layout.height;
  header.num_planes = static_cast<std::uint32_t>(layout.planes.size());
  header.block_rows = static_cast<std::uint32_t>(layout.block_rows);
  header.index_crc = crc32c(index.data(), index_bytes);
  header.index_offset = out.appended_bytes();
  out.append(index.data(), index_bytes);
  out.flush();
  out.file().write_at(0, &header, sizeof header);
  out.commit();
  impl_->rows.close();
}

struct RasterReader::Impl {
  File file;
  Layout layout;
  std::vector<BlockEntry> index;

  [[noreturn]] void fail(std::size_t block, std::string_view what) const { throw Error(concat(file.path().string(), ": ", layout.name_of(block), ": ", what)); }

  void read_header() {
    Header header{};
    file.read_at(0, &header, sizeof header);
    const std::string& path = file.path().string();
    if (std::memcmp(header.magic, kMagic, 8) != 0) throw Error(concat(path, ": not a raster file (magic at offset 0)"));
    if (header.version != kVersion) throw Error(concat(path, ": raster version ", header.version, ", expected ", kVersion));
    if (!is_usable(header.width, header.height) || header.num_planes == 0 || header.num_planes > kMaxPlanes || header.block_rows == 0 || header.block_rows > kMostBlockRows)
      throw Error(concat(path, ": raster header of ", header.width, " x ", header.height, ", ", header.num_planes, " planes in blocks of ", header.block_rows, " rows is not usable"));
    layout.width = header.width;
    layout.height = header.height;
    layout.block_rows = static_cast<int>(header.block_rows);
    for (std::uint32_t i = 0; i < header.num_planes; ++i) read_plane_record(i);
    read_index(header);
  }
  void read_plane_record(std::uint32_t i) {
    PlaneRecord record{};
    file.read_at(sizeof(Header) + i * sizeof record, &record, sizeof record);
    record.name[31] = 0;
    if (record.type > 3) throw Error(concat(file.path().string(), ": plane ", i, " has type ", record.type, ", expected 0 to 3"));
    if (std::any_of(layout.planes.begin(), layout.planes.end(), [&](const PlaneInfo& p) { return p.name == record.name; }))
      throw Error(concat(file.path().string(), ": planes ", i, " and one before it are both called \"", record.name, "\""));
    layout.planes.push_back({record.name, static_cast<PlaneType>(record.type)});
  }
  void read_index(const Header& header) {
    const std::uint64_t bytes = layout.num_blocks() * sizeof(BlockEntry), size = file.size();
    if (size < layout.header_bytes() + bytes || header.index_offset != size - bytes)
      throw Error(concat(file.path().string(), ": ", size, " bytes, expected ", header.index_offset, " and an index of ", bytes, " from its header"));
    index.resize(layout.num_blocks());
    file.read_at(header.index_offset, index.data(), bytes);
    if (crc32c(index.data(), bytes) != header.index_crc) throw Error(concat(file.path().string(), ": checksum of the index at offset ", header.index_offset, " is wrong"));
    for (std::size_t i = 0; i < index.size(); ++i) {
      const BlockEntry& e = index[i];
      const bool inside = e.offset >= layout.header_bytes() && e.offset <= header.index_offset && e.bytes <= header.index_offset - e.offset;
      if (!inside || e.bytes > layout.bytes_of(i) + BLOSC_MAX_OVERHEAD || layout.bytes_of(i) / kMostRatio > e.bytes)
        fail(i, concat(e.bytes, " bytes at offset ", e.offset, " cannot be its ", layout.bytes_of(i)));
    }
  }

  /// packed: room that is used again.
  void unpack(std::size_t block, std::vector<std::byte>& packed, std::span<std::byte> bytes) const {
    const BlockEntry& entry = index[block];
    packed.resize(entry.bytes);
    file.read_at(entry.offset, packed.data(), packed.size());
    if (crc32c(packed.data(), packed.size()) != entry.crc) fail(block, "checksum is wrong");
    std::size_t size = 0;
    if (blosc_cbuffer_validate(packed.data(), packed.size(), &size) != 0 || size != bytes.size() || blosc_decompress_ctx(packed.data(), bytes.data(), bytes.size(), 1) != static_cast<int>(bytes.size()))
      fail(block, "cannot be unpacked");
  }
};

RasterReader::RasterReader(const std::filesystem::path& path) : impl_(std::make_unique<Impl>()) {
  impl_->file = File(path, File::Mode::kRead);
  impl_->read_header();
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
  const std::size_t i = layout.index(plane, impl_->file.path()), row_bytes = layout.row_bytes(i);
  if (y0 < 0 || rows < 0 || y0 + rows > layout.height) throw std::invalid_argument("RasterReader::read_rows: rows outside the image");
  if (bytes.size() != row_bytes * static_cast<std::size_t>(rows))
    throw Error(concat(impl_->file.path().string(), ": plane \"", plane, "\" has ", row_bytes, " bytes a row, expected ", rows > 0 ? bytes.size() / static_cast<std::size_t>(rows) : bytes.size()));
  std::vector<std::byte> packed, whole;
  for (int y = y0; y < y0 + rows;) {
    const std::size_t block = i * layout.blocks_of_plane() + static_cast<std::size_t>(y / layout.block_rows);
    const Layout::Rows there = layout.rows_of(block);
    const int last = std::min(y0 + rows, there.y0 + there.rows);
    const std::span<std::byte> to = bytes.subspan(static_cast<std::size_t>(y - y0) * row_bytes, static_cast<std::size_t>(last - y) * row_bytes);
    if (to.size() == layout.bytes_of(block)) {
      impl_->unpack(block, packed, to);
    } else {
      whole.resize(layout.bytes_of(block));
      impl_->unpack(block, packed, whole);
      std::memcpy(to.data(), whole.data() + static_cast<std::size_t>(y - there.y0) * row_bytes, to.size());
    }
    y = last;
  }
}

void RasterReader::verify() const {
  std::vector<std::byte> packed, bytes;
  for (std::size_t i = 0; i < impl_->index.size(); ++i) {
    bytes.resize(impl_->layout.bytes_of(i));
    impl_->unpack(i, packed, bytes);
  }
}

}  // namespace chiaro::stream
