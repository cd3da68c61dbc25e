// LAS 1.2 to 1.4, point formats 0 to 10. Compressed points (LAZ) are read through laz_rows.h.
#include <algorithm>
#include <cmath>
#include <cstring>
#include <map>

#include "stream/base/error.h"
#include "stream/cloud/formats.h"
#include "stream/cloud/las_format.h"
#include "stream/cloud/laz_rows.h"
#include "stream/cloud/row_decoder.h"
#include "stream/cloud/row_readers.h"
#include "stream/cloud/scalars.h"

namespace chiaro::stream {
namespace {

using namespace las;

struct LasHeader {
  int minor = 2;
  std::uint64_t header_bytes = 0, point_offset = 0, count = 0;
  std::uint32_t num_vlrs = 0;
  int format = 0;
  std::size_t record_bytes = 0;
  std::array<double, 3> scale{}, add{};
  double largest = 0;  // largest coordinate of the declared bounds, by magnitude
};

class LasOpener {
 public:
  LasOpener(File file, std::uint64_t memory_bytes) : file_(std::move(file)), size_(file_.size()) { laz_.memory_bytes = memory_bytes; }

  std::unique_ptr<PointReader> open() {
    parse_header();
    add_core_fields();
    add_extra_fields();
    keep_names_apart();
    layout_.row_bytes = header_.record_bytes;
    RowDecoder decoder(file_.path(), std::move(layout_), header_.count);
    decoder.schema().position_is_double = !float_holds_the_positions();
    decoder.schema().coordinate_system = std::move(coordinate_system_);
    if (compressed_) return read_laz_rows(std::move(file_), std::move(decoder), laz_rows());
    const FixedRows rows{header_.point_offset, header_.count, false};
    return read_fixed_rows(std::move(file_), std::move(decoder), rows);
  }

 private:
  [[noreturn]] void fail(std::uint64_t offset, const std::string& what) const {
    throw Error(concat(file_.path().string(), ": offset ", offset, ": ", what));
  }

  template <class T>
  T at(std::size_t offset) const {
    return load_as<T>(bytes_.data() + offset);
  }

  void parse_header() {
    bytes_.resize(kHeaderBytes14);
    const std::size_t got = file_.read_some_at(0, bytes_.data(), bytes_.size());
    if (got < kHeaderBytes12)
      fail(got, concat("the file ends in the LAS header: expected ", kHeaderBytes12, " bytes or more, found ", got));
    const int major = at<std::uint8_t>(kVersionMajor);
    header_.minor = at<std::uint8_t>(kVersionMinor);
    if (major != 1 || header_.minor > 4) fail(kVersionMajor, concat("LAS version ", major, ".", header_.minor, ", expected 1.0 to 1.4"));
    const std::size_t least = header_.minor == 4 ? kHeaderBytes14 : header_.minor == 3 ? kHeaderBytes13 : kHeaderBytes12;
    header_.header_bytes = at<std::uint16_t>(kHeaderSize);
    if (header_.header_bytes < least || got < least)
      fail(kHeaderSize, concat("header of ", header_.header_bytes, " bytes in a file of ", size_, ", expected at least ", least));
    header_.point_offset = at<std::uint32_t>(kPointOffset);
    header_.num_vlrs = at<std::uint32_t>(kNumVlrs);
    if (header_.point_offset < header_.header_bytes || header_.point_offset > size_)
      fail(kPointOffset, concat("points start at ", header_.point_offset, ", expected ", header_.header_bytes, " (end of the header) to ",
                                size_, " (end of the file)"));
    parse_point_format();
    parse_count();
    parse_scale();
  }

  void parse_point_format() {
    compressed_ = (at<std::uint8_t>(kPointFormat) & kCompressedBit) != 0;
    const unsigned format = at<std::uint8_t>(kPointFormat) & ~kCompressedBit;
    if (format >= kRecordBytes.size()) fail(kPointFormat, concat("point format ", format, ", expected 0 to 10"));
    header_.format = static_cast<int>(format);
    header_.record_bytes = at<std::uint16_t>(kRecordLength);
    if (header_.record_bytes < kRecordBytes[format])
      fail(kRecordLength, concat("records of ", header_.record_bytes, " bytes, point format ", format, " needs ", kRecordBytes[format]));
  }

  void parse_count() {
    const std::uint32_t legacy = at<std::uint32_t>(kLegacyCount);
    const std::uint64_t count = header_.minor == 4 ? at<std::uint64_t>(kCount) : 0;
    if (legacy != 0 && count != 0 && legacy != count)
      fail(kCount, concat("the header declares ", count, " points and, in its older field, ", legacy));
    header_.count = count != 0 ? count : legacy;
    if (header_.count == 0) {
      const std::uint64_t room = (size_ - header_.point_offset) / header_.record_bytes;
      fail(kLegacyCount, concat("the header declares no points",
                                room > 0 && !compressed_ ? concat(" although the file has room for ", room, " (was it closed properly?)") : std::string()));
    }
  }

  void parse_scale() {
    for (std::size_t axis = 0; axis < 3; ++axis) {
      header_.scale[axis] = at<double>(kScale + 8 * axis);
      header_.add[axis] = at<double>(kAdd + 8 * axis);
      if (!std::isfinite(header_.scale[axis]) || header_.scale[axis] == 0)
        fail(kScale + 8 * axis, concat("scale ", header_.scale[axis], ", expected a finite number other than 0"));
      if (!std::isfinite(header_.add[axis])) fail(kAdd + 8 * axis, concat("offset ", header_.add[axis], ", expected a finite number"));
      header_.largest =
          std::max({header_.largest, std::abs(at<double>(kBounds + 16 * axis)), std::abs(at<double>(kBounds + 16 * axis + 8))});
    }
  }

  // A float steps by |value| * 2^-23; half the file's step is exact enough to tell neighbouring values apart.
  bool float_holds_the_positions() const {
    const double step = std::min({std::abs(header_.scale[0]), std::abs(header_.scale[1]), std::abs(header_.scale[2])});
    return header_.largest * 0x1p-23 <= step / 2;
  }

  RowField& add_field(const std::string& name, ScalarType type, std::size_t offset) {
    RowField& field = layout_.fields.emplace_back();
    field.name = name;
    field.type = type;
    field.offset = offset;
    return field;
  }

  void add_core(const CoreField& core) {
    RowField& field = add_field(core.name, core.type, core.offset);
    field.shift = core.shift;
    field.mask = core.mask;
  }

  void add_core_fields() {
    const auto format = static_cast<std::size_t>(header_.format);
    for (std::size_t axis = 0; axis < 3; ++axis) {
      RowField& field = add_field(std::string(1, "xyz"[axis]), ScalarType::kI32, 4 * axis);
      field.scaled = true;
      field.scale = header_.scale[axis];
      field.add = header_.add[axis];
    }
    if (header_.format < 6) {
      for (const CoreField& core : kLegacyFields) add_core(core);
      add_core(kLegacySource);
    } else {
      for (const CoreField& core : kFields) add_core(core);
    }
    if (const std::size_t at_time = kTimeAt[format]) add_field("gps_time", ScalarType::kF64, at_time);
    if (const std::size_t at_colour = kColourAt[format]) {
      add_field("red", ScalarType::kU16, at_colour);
      add_field("green", ScalarType::kU16, at_colour + 2);
      add_field("blue", ScalarType::kU16, at_colour + 4);
    }
    if (const std::size_t at_infrared = kInfraredAt[format]) add_field("nir", ScalarType::kU16, at_infrared);
    if (const std::size_t wave = kWaveAt[format]) {
      add_field("wave_descriptor", ScalarType::kU8, wave);
      add_field("wave_offset", ScalarType::kU64, wave + 1);
      add_field("wave_bytes", ScalarType::kU32, wave + 9);
      add_field("wave_location", ScalarType::kF32, wave + 13);
      for (std::size_t k = 0; k < 3; ++k) add_field(concat("wave_d", "xyz"[k]), ScalarType::kF32, wave + 17 + 4 * k);
    }
    used_bytes_ = kRecordBytes[format];
  }

  // Extra bytes are described by a variable length record; what it does not describe is carried as plain bytes.
  void add_extra_fields() {
    std::uint64_t offset = header_.header_bytes;
    for (std::uint32_t i = 0; i < header_.num_vlrs; ++i) {
      if (offset + kVlrHeaderBytes > header_.point_offset)
        fail(offset, concat("variable length record ", i + 1, " of ", header_.num_vlrs, " does not fit before the points, which start at ",
                            header_.point_offset));
      std::byte vlr[kVlrHeaderBytes];
      file_.read_at(offset, vlr, sizeof vlr);
      const std::uint64_t bytes = load_as<std::uint16_t>(vlr + 20);
      const std::uint64_t content = offset + kVlrHeaderBytes;
      if (content + bytes > header_.point_offset)
        fail(offset, concat("variable length record ", i + 1, " of ", header_.num_vlrs, " has ", bytes, " bytes, the points start ",
                            header_.point_offset - content, " bytes later"));
      if (std::memcmp(vlr + 2, "LASF_Spec\0", 10) == 0 && load_as<std::uint16_t>(vlr + 18) == kExtraBytesRecord) {
        std::vector<std::byte> records(bytes);
        file_.read_at(content, records.data(), records.size());
        for (std::size_t at_record = 0; at_record + kExtraBytesBytes <= records.size(); at_record += kExtraBytesBytes)
          add_described(records.data() + at_record);
      }
      if (std::memcmp(vlr + 2, "LASF_Projection\0", 16) == 0 && load_as<std::uint16_t>(vlr + 18) == kWktRecord) {
        coordinate_system_.resize(bytes);
        file_.read_at(content, coordinate_system_.data(), coordinate_system_.size());
        coordinate_system_.resize(std::min(coordinate_system_.find('\0'), coordinate_system_.size()));
      }
      if (std::memcmp(vlr + 2, "laszip encoded\0", 15) == 0 && load_as<std::uint16_t>(vlr + 18) == kLaszipRecord) {
        laz_.vlr.resize(bytes);
        file_.read_at(content, laz_.vlr.data(), laz_.vlr.size());
      }
      offset = content + bytes;
    }
    constexpr std::size_t kMostUndescribed = 2048;
    if (header_.record_bytes - used_bytes_ > kMostUndescribed)
      fail(kRecordLength, concat("records of ", header_.record_bytes, " bytes, of which ", header_.record_bytes - used_bytes_,
                                 " are not described, expected at most ", kMostUndescribed));
    for (int k = 0; used_bytes_ < header_.record_bytes; ++k) add_field(concat("extra_byte_", k), ScalarType::kU8, used_bytes_++);
  }

  void add_described(const std::byte* record) {
    using enum ScalarType;
    constexpr ScalarType kTypes[10] = {kU8, kI8, kU16, kI16, kU32, kI32, kU64, kI64, kF32, kF64};
    const unsigned type = load_as<std::uint8_t>(record + 2), options = load_as<std::uint8_t>(record + 3);
    const std::string name = name_of(record + 4);
    if (type == 0) {  // undocumented: `options` is the number of bytes
      for (unsigned k = 0; k < options && used_bytes_ < header_.record_bytes; ++k) add_field(concat(name, "_", k), kU8, used_bytes_++);
      return;
    }
    if (type > 30) return;
    const ScalarType scalar = kTypes[(type - 1) % 10];
    const unsigned values = 1 + (type - 1) / 10;  // 11..20 and 21..30 are the deprecated pairs and triples
    for (unsigned k = 0; k < values; ++k) {
      if (used_bytes_ + scalar_bytes(scalar) > header_.record_bytes) return;
      RowField& field = add_field(values == 1 ? name : concat(name, "_", k), scalar, used_bytes_);
      const double scale = load_as<double>(record + 112 + 8 * k), add = load_as<double>(record + 136 + 8 * k);
      if (options & 8u) field.scale = std::isfinite(scale) ? scale : 1;
      if (options & 16u) field.add = std::isfinite(add) ? add : 0;
      field.scaled = (options & 24u) != 0;
      used_bytes_ += scalar_bytes(scalar);
    }
  }

  static std::string name_of(const std::byte* at_name) {
    std::string name;
    for (std::size_t i = 0; i < 32 && at_name[i] != std::byte{0}; ++i) {
      const char c = static_cast<char>(at_name[i]);
      name += c > ' ' && c < 127 ? c : '_';  // names become PLY and PCD property names
    }
    if (name.size() == 1 && std::strchr("xyzXYZ", name[0])) return "extra_" + name;  // the record has its position already
    return name.empty() ? "extra" : name;
  }

  // Extra bytes may repeat a name of the fixed part, which every reader of the file would then find twice.
  void keep_names_apart() {
    std::map<std::string, int, std::less<>> seen;
    for (RowField& field : layout_.fields) {
      const std::string name = field.name;
      for (int k = 2; ++seen[field.name] > 1; ++k) field.name = concat(name, "_", k);
    }
  }

  LazRows laz_rows() {
    laz_.point_format = header_.format;
    laz_.point_offset = header_.point_offset;
    laz_.count = header_.count;
    return std::move(laz_);
  }

  File file_;
  std::uint64_t size_;
  bool compressed_ = false;
  std::string coordinate_system_;
  LazRows laz_;
  std::vector<std::byte> bytes_;
  LasHeader header_;
  RowLayout layout_;
  std::size_t used_bytes_ = 0;
};

}  // namespace

std::unique_ptr<PointReader> open_las(File file, std::uint64_t memory_bytes) { return LasOpener(std::move(file), memory_bytes).open(); }

}  // namespace chiaro::stream
