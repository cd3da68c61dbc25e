// LAS 1.4, point format 6 (7 with colour, 8 with near infrared). What the format has no field for goes to extra bytes.
#include <algorithm>
#include <cmath>
#include <set>

#include "stream/base/error.h"
#include "stream/base/text.h"
#include "stream/cloud/formats.h"
#include "stream/cloud/las_format.h"
#include "stream/cloud/row_writer.h"
#include "stream/cloud/scalars.h"

namespace chiaro::stream {
namespace {

using namespace las;

// Names that readers give to the fixed part of point formats 6 to 8. A dimension of extra bytes that repeats one of them makes files that some readers refuse.
constexpr const char* kFixedNames[] = {"x", "y", "z", "intensity", "bit_fields", "return_number", "number_of_returns", "classification_flags", "synthetic", "key_point", "withheld", "overlap",
                                       "scanner_channel", "scan_direction", "scan_direction_flag", "edge_of_flight_line", "classification", "user_data", "scan_angle", "point_source_id", "gps_time",
                                       "red", "green", "blue", "nir"};
constexpr std::size_t kNameBytes = 32;

// Readers of some programs do not tell upper from lower case, and 32 bytes are all that a name has.
std::string extra_name(const std::string& name, std::set<std::string>& taken) {
  if (taken.empty()) taken.insert(std::begin(kFixedNames), std::end(kFixedNames));
  std::string wanted = (taken.count(lower(name)) ? "input_" + name : name).substr(0, kNameBytes), free = wanted;
  for (int k = 2; !taken.insert(lower(free)).second; ++k) {
    const std::string number = concat("_", k);
    free = wanted.substr(0, kNameBytes - number.size()) + number;
  }
  return free;
}

class LasWriter final : public RowWriter {
 public:
  LasWriter(const std::filesystem::path& path, const PointWriterOptions& options) : RowWriter(path, options) {
    plan_record();
    plan_scale();
    file_.file().reserve(point_offset() + options_.num_points * record_bytes_);
    const std::vector<std::byte> header = make_header();
    file_.append(header.data(), header.size());
  }

 private:
  struct Extra {
    RowSlot from;
    std::size_t to;
    std::string name;
  };
  struct Core {
    RowSlot from;
    CoreField to;
  };

  // Decides for each property: field of the format, or extra bytes.
  void plan_record() {
    const auto& properties = options_.properties;
    for (std::size_t axis = 0; axis < 3; ++axis) position_[axis] = *find_property(properties, std::string_view("xyz").substr(axis, 1));
    std::vector<bool> used(properties.size(), false);
    for (const RowSlot& slot : position_) used[slot.index] = true;
    plan_colour(used);
    const auto infrared = find_property(properties, "nir");
    const bool has_infrared = infrared && infrared->type == ScalarType::kU16;
    format_ = has_infrared ? 8 : has_colour_ ? 7 : 6;
    const auto take = [&](const CoreField& core) {
      const auto slot = find_property(properties, core.name);
      if (!slot || slot->type != core.type) return;  // of another type: extra bytes, where nothing is lost
      core_.push_back({*slot, core});
      used[slot->index] = true;
    };
    for (const CoreField& core : kFields) take(core);
    take({"gps_time", ScalarType::kF64, kTimeAt[format_], 0, 0});
    if (has_infrared) take({"nir", ScalarType::kU16, kInfraredAt[format_], 0, 0});
    record_bytes_ = kRecordBytes[format_];
    std::size_t offset = 0;
    std::set<std::string> taken;
    for (std::size_t i = 0; i < properties.size(); ++i) {
      const std::size_t bytes = scalar_bytes(properties[i].type);
      if (!used[i]) {
        extras_.push_back({{i, offset, properties[i].type}, record_bytes_, extra_name(properties[i].name, taken)});
        record_bytes_ += bytes;
      }
      offset += bytes;
    }
    if (record_bytes_ > 65535 || extras_.size() > 65535 / kExtraBytesBytes)
      throw Error(
          concat(file_.file().path().string(), ": ", extras_.size(), " properties of ", record_bytes_, " bytes do not fit a LAS record"));
  }

  void plan_colour(std::vector<bool>& used) {
    constexpr const char* kNames[] = {"red", "green", "blue"};
    has_colour_ = true;
    for (std::size_t k = 0; k < 3; ++k) {
      const auto slot = find_property(options_.properties, kNames[k]);
      has_colour_ &= slot && (slot->type == ScalarType::kU8 || slot->type == ScalarType::kU16);
      if (slot) colour_[k] = *slot;
    }
    if (has_colour_)
      for (const RowSlot& slot : colour_) used[slot.index] = true;
  }

  // Without a resolution nothing is known of the precision of the positions: the finest decimal step that the extent affords, but none that a double would not tell apart there.
  double default_step() const {
    const Box3d& box = options_.bounds;
    const double extent = box.empty() ? 0 : (box.max - box.min).maxCoeff(), largest = box.empty() ? 0 : box.max.cwiseAbs().cwiseMax(box.min.cwiseAbs()).maxCoeff();
    const double least = std::max({extent / 2147483648.0, largest * 0x1p-52, 1e-12});
    return std::pow(10.0, std::ceil(std::log10(least) - 1e-9));
  }

  // Stored integers are 32-bit: a step that the extent cannot afford is made coarser. Offsets lie on the grid of steps, near the middle.
  void plan_scale() {
    const Box3d& box = options_.bounds;
    if (options_.num_points > 0 && (box.empty() || !box.min.allFinite() || !box.max.allFinite()))
      throw Error(concat(file_.file().path().string(), ": LAS needs finite bounds of the positions"));
    for (int axis = 0; axis < 3; ++axis) {
      const double extent = box.empty() ? 0 : box.max[axis] - box.min[axis];
      const double finest = extent / 4294000000.0;  // a little fewer than 2^32 steps
      const double wanted = options_.grid ? std::abs(options_.grid->scale[axis]) : options_.resolution.value_or(default_step());
      scale_[axis] = std::max(finest, wanted);
      const double middle = box.empty() ? 0 : box.min[axis] + extent / 2;
      const double from = options_.grid && scale_[axis] == wanted ? options_.grid->add[axis] : 0;
      add_[axis] = std::floor((middle - from) / (scale_[axis] * 1000)) * (scale_[axis] * 1000) + from;
    }
  }

  // Text that ends with a zero; a record holds no more than 65535 bytes.
  std::size_t wkt_bytes() const { return options_.coordinate_system.empty() || options_.coordinate_system.size() >= 65535 ? 0 : kVlrHeaderBytes + options_.coordinate_system.size() + 1; }
  std::size_t extras_bytes() const { return extras_.empty() ? 0 : kVlrHeaderBytes + extras_.size() * kExtraBytesBytes; }
  std::size_t point_offset() const { return kHeaderBytes14 + wkt_bytes() + extras_bytes(); }

  static void put_text(std::byte* at, std::string_view text, std::size_t bytes) {
    std::memcpy(at, text.data(), std::min(bytes, text.size()));
  }

  std::vector<std::byte> make_header() const {
    std::vector<std::byte> header(point_offset());
    std::byte* at = header.data();
    put_text(at, "LASF", 4);
    store_as<std::uint16_t>(at + kGlobalEncoding, 16);  // point formats 6 and up have their coordinate system, if any, as WKT
    store_as<std::uint8_t>(at + kVersionMajor, 1);
    store_as<std::uint8_t>(at + kVersionMinor, 4);
    put_text(at + kSystemId, "OTHER", 32);
    put_text(at + kSoftware, "chiaro", 32);
    store_as<std::uint16_t>(at + kHeaderSize, kHeaderBytes14);
    store_as<std::uint32_t>(at + kPointOffset, static_cast<std::uint32_t>(point_offset()));
    store_as<std::uint32_t>(at + kNumVlrs, (extras_.empty() ? 0u : 1u) + (wkt_bytes() > 0 ? 1u : 0u));
    store_as<std::uint8_t>(at + kPointFormat, static_cast<std::uint8_t>(format_));
    store_as<std::uint16_t>(at + kRecordLength, static_cast<std::uint16_t>(record_bytes_));
    store_as<std::uint64_t>(at + kCount, options_.num_points);
    for (std::size_t axis = 0; axis < 3; ++axis) {
      store_as(at + kScale + 8 * axis, scale_[static_cast<int>(axis)]);
      store_as(at + kAdd + 8 * axis, add_[static_cast<int>(axis)]);
    }
    if (wkt_bytes() > 0) put_coordinate_system(at + kHeaderBytes14);
    if (!extras_.empty()) put_extra_bytes(at + kHeaderBytes14 + wkt_bytes());
    return header;
  }

  void put_coordinate_system(std::byte* at) const {
    put_text(at + 2, "LASF_Projection", 16);
    store_as<std::uint16_t>(at + 18, kWktRecord);
    store_as<std::uint16_t>(at + 20, static_cast<std::uint16_t>(wkt_bytes() - kVlrHeaderBytes));
    put_text(at + 22, "coordinate system", 32);
    put_text(at + kVlrHeaderBytes, options_.coordinate_system, options_.coordinate_system.size());
  }

  void put_extra_bytes(std::byte* at) const {
    put_text(at + 2, "LASF_Spec", 16);
    store_as<std::uint16_t>(at + 18, kExtraBytesRecord);
    store_as<std::uint16_t>(at + 20, static_cast<std::uint16_t>(extras_.size() * kExtraBytesBytes));
    put_text(at + 22, "extra bytes", 32);
    at += kVlrHeaderBytes;
    for (const Extra& extra : extras_) {
      constexpr std::uint8_t kTypes[] = {2, 1, 4, 3, 6, 5, 8, 7, 9, 10};  // in the order of ScalarType
      store_as<std::uint8_t>(at + 2, kTypes[static_cast<std::size_t>(extra.from.type)]);
      put_text(at + 4, extra.name, kNameBytes);
      at += kExtraBytesBytes;
    }
  }

  void write_rows(const std::byte* rows, std::size_t count) override {
    record_.assign(record_bytes_, std::byte{0});
    for (std::size_t i = 0; i < count; ++i, rows += row_bytes_) {
      std::fill(record_.begin(), record_.end(), std::byte{0});
      put_position(rows);
      for (const Core& core : core_) put_core(core, rows);
      count_return();
      if (has_colour_ || format_ == 8) put_colour(rows);
      for (const Extra& extra : extras_) std::memcpy(record_.data() + extra.to, rows + extra.from.offset, scalar_bytes(extra.from.type));
      file_.append(record_.data(), record_.size());
    }
  }

  void put_position(const std::byte* row) {
    for (int axis = 0; axis < 3; ++axis) {
      const RowSlot& slot = position_[static_cast<std::size_t>(axis)];
      const double value = load_scalar(slot.type, row + slot.offset);
      const double steps = std::round((value - add_[axis]) / scale_[axis]);
      if (!(std::abs(steps) <= 2147483647.0))
        throw Error(concat(file_.file().path().string(), ": coordinate ", "xyz"[axis], " = ", value, " lies outside the announced bounds ",
                           options_.bounds.min[axis], " to ", options_.bounds.max[axis], ", or is not a number"));
      store_as(record_.data() + 4 * axis, static_cast<std::int32_t>(steps));
      const double stored = steps * scale_[axis] + add_[axis];
      stored_.min[axis] = std::min(stored_.min[axis], stored);
      stored_.max[axis] = std::max(stored_.max[axis], stored);
    }
  }

  void put_core(const Core& core, const std::byte* row) {
    std::byte* to = record_.data() + core.to.offset;
    if (core.to.mask == 0) {
      std::memcpy(to, row + core.from.offset, scalar_bytes(core.to.type));
    } else {
      const unsigned value = std::min<unsigned>(std::to_integer<unsigned>(row[core.from.offset]), core.to.mask);
      *to |= static_cast<std::byte>(value << core.to.shift);
    }
  }

  // Points without returns are the first of one; the header counts points by their return.
  void count_return() {
    unsigned returns = std::to_integer<unsigned>(record_[14]);
    if ((returns & 15u) == 0) returns |= 1u;
    if ((returns >> 4) == 0) returns |= (returns & 15u) << 4;
    record_[14] = static_cast<std::byte>(returns);
    ++by_return_[(returns & 15u) - 1];
  }

  void put_colour(const std::byte* row) {
    if (!has_colour_) return;
    for (std::size_t k = 0; k < 3; ++k) {
      const double value = load_scalar(colour_[k].type, row + colour_[k].offset);
      const double to_16_bit = colour_[k].type == ScalarType::kU8 ? 257 : 1;
      store_as(record_.data() + kColourAt[format_] + 2 * k, static_cast<std::uint16_t>(value * to_16_bit));
    }
  }

  void finish() override {
    file_.flush();
    std::byte bounds[48] = {};
    if (written_ > 0)
      for (std::size_t axis = 0; axis < 3; ++axis) {
        store_as(bounds + 16 * axis, stored_.max[static_cast<int>(axis)]);
        store_as(bounds + 16 * axis + 8, stored_.min[static_cast<int>(axis)]);
      }
    file_.file().write_at(kBounds, bounds, sizeof bounds);
    file_.file().write_at(kCountByReturn, by_return_.data(), sizeof by_return_);
  }

  std::array<RowSlot, 3> position_, colour_;
  bool has_colour_ = false;
  std::size_t format_ = 6, record_bytes_ = 0;
  std::vector<Core> core_;
  std::vector<Extra> extras_;
  Vec3d scale_ = Vec3d::Ones(), add_ = Vec3d::Zero();
  std::vector<std::byte> record_;
  Box3d stored_;
  std::array<std::uint64_t, 15> by_return_{};
};

}  // namespace

std::unique_ptr<PointWriter> create_las(const std::filesystem::path& path, const PointWriterOptions& options) {
  return std::make_unique<LasWriter>(path, options);
}

}  // namespace chiaro::stream
