#include "stream/cloud/row_decoder.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <map>
#include <string_view>

#include "stream/base/error.h"
#include "stream/base/text.h"
#include "stream/cloud/scalars.h"

namespace chiaro::stream {
namespace {

// No format needs more; without a limit a header alone could make rows of gigabytes.
constexpr std::size_t kMaxFields = 4096, kMaxRowBytes = 1 << 18;

enum Role { kX, kY, kZ, kNx, kNy, kNz, kRed, kGreen, kBlue, kNumRoles };

int role_of(const std::string& name) {
  static const std::map<std::string, Role, std::less<>> roles = {{"x", kX},
                                                                 {"y", kY},
                                                                 {"z", kZ},
                                                                 {"nx", kNx},
                                                                 {"ny", kNy},
                                                                 {"nz", kNz},
                                                                 {"normal_x", kNx},
                                                                 {"normal_y", kNy},
                                                                 {"normal_z", kNz},
                                                                 {"normalx", kNx},
                                                                 {"normaly", kNy},
                                                                 {"normalz", kNz},
                                                                 {"red", kRed},
                                                                 {"green", kGreen},
                                                                 {"blue", kBlue},
                                                                 {"diffuse_red", kRed},
                                                                 {"diffuse_green", kGreen},
                                                                 {"diffuse_blue", kBlue},
                                                                 {"r", kRed},
                                                                 {"g", kGreen},
                                                                 {"b", kBlue}};
  const auto found = roles.find(lower(name));
  return found == roles.end() ? -1 : found->second;
}

void check_layout(const std::filesystem::path& path, const RowLayout& layout) {
  if (layout.fields.size() > kMaxFields)
    throw Error(concat(path.string(), ": ", layout.fields.size(), " values per point, expected at most ", kMaxFields));
  if (layout.row_bytes > kMaxRowBytes)
    throw Error(concat(path.string(), ": ", layout.row_bytes, " bytes per point, expected at most ", kMaxRowBytes));
  std::map<std::string, int, std::less<>> seen;
  for (const RowField& field : layout.fields)
    if (++seen[field.name] == 2) throw Error(concat(path.string(), ": two point properties are named '", field.name, "'"));
}

bool all_are(const RowField* fields, ScalarType type, bool scaled) {
  return std::all_of(fields, fields + 3, [&](const RowField& f) { return f.type == type && f.scaled == scaled && f.mask == 0; });
}

}  // namespace

std::string_view scalar_name(ScalarType type) {
  constexpr std::array<std::string_view, 10> kNames = {"char", "uchar", "short",  "ushort", "int",
                                                       "uint", "int64", "uint64", "float",  "double"};
  return kNames[static_cast<std::size_t>(type)];
}

double field_value(const RowField& field, const std::byte* row) {
  double value = load_scalar(field.type, row + field.offset);
  if (field.mask) value = (static_cast<unsigned>(value) >> field.shift) & field.mask;
  return field.scaled ? value * field.scale + field.add : value;
}

RowDecoder::RowDecoder(const std::filesystem::path& path, RowLayout layout, std::uint64_t declared_points) : layout_(std::move(layout)) {
  schema_.declared_points = declared_points;
  check_layout(path, layout_);
  find_roles(path);
}

void RowDecoder::find_roles(const std::filesystem::path& path) {
  std::array<int, kNumRoles> index;
  index.fill(-1);
  for (std::size_t i = 0; i < layout_.fields.size(); ++i) {
    const int role = role_of(layout_.fields[i].name);
    if (role < 0) continue;
    int& slot = index[static_cast<std::size_t>(role)];
    if (slot >= 0 && role <= kZ) {
      throw Error(concat(path.string(), ": two coordinates '", layout_.fields[static_cast<std::size_t>(slot)].name, "' and '",
                         layout_.fields[i].name, "'"));
    }
    if (slot < 0) slot = static_cast<int>(i);  // of two aliases the first counts; the second is an extra
  }
  for (int axis = 0; axis < 3; ++axis) {
    if (index[static_cast<std::size_t>(axis)] >= 0) continue;
    std::string names;
    for (const RowField& field : layout_.fields) names += (names.empty() ? "" : ", ") + field.name;
    throw Error(concat(path.string(), ": no point property '", "xyz"[axis], "', found: ", names.empty() ? "none" : names));
  }
  const auto complete = [&](int first) { return index[first] >= 0 && index[first + 1] >= 0 && index[first + 2] >= 0; };
  schema_.has_normal = complete(kNx);
  schema_.has_colour = complete(kRed);
  std::vector<bool> used(layout_.fields.size(), false);
  const auto take = [&](int first, RowField* out) {
    for (int k = 0; k < 3; ++k) {
      const std::size_t i = static_cast<std::size_t>(index[static_cast<std::size_t>(first + k)]);
      out[k] = layout_.fields[i];
      used[i] = true;
    }
  };
  take(kX, position_);
  if (schema_.has_normal) take(kNx, normal_);
  if (schema_.has_colour) take(kRed, colour_);
  for (const RowField& f : position_)
    schema_.position_is_double |= f.type == ScalarType::kF64 || f.type == ScalarType::kI32 || f.type == ScalarType::kU32 ||
                                  f.type == ScalarType::kI64 || f.type == ScalarType::kU64;
  if (all_are(position_, ScalarType::kI32, true))
    schema_.grid = PositionGrid{{position_[0].scale, position_[1].scale, position_[2].scale}, {position_[0].add, position_[1].add, position_[2].add}};
  for (const RowField& f : colour_) samples_wanted_ |= schema_.has_colour && f.type != ScalarType::kU8;
  for (std::size_t i = 0; i < used.size(); ++i)
    if (!used[i]) add_extra(layout_.fields[i]);
}

void RowDecoder::add_extra(const RowField& field) {
  const ScalarType type = field.scaled ? ScalarType::kF64 : field.type;
  const std::size_t bytes = scalar_bytes(type);
  schema_.extras.push_back({field.name, type});
  if (field.scaled || field.mask) {
    sliced_.push_back({field, extra_bytes_});
  } else if (!copies_.empty() && copies_.back().from + copies_.back().bytes == field.offset &&
             copies_.back().to + copies_.back().bytes == extra_bytes_) {
    copies_.back().bytes += bytes;
  } else {
    copies_.push_back({field.offset, extra_bytes_, bytes});
  }
  extra_bytes_ += bytes;
}

void RowDecoder::sample_colours(const std::byte* rows, std::size_t count) {
  for (std::size_t i = 0; i < count; ++i)
    for (const RowField& field : colour_) {
      const double value = field_value(field, rows + i * layout_.row_bytes);
      if (value > colour_max_) colour_max_ = value;
      if (value >= 1 && value <= 65535) colour_low_bits_ |= static_cast<unsigned>(value) & 255u;
    }
}

void RowDecoder::decide_colour_scale() {
  if (!samples_wanted_) return;
  const bool floats = is_float(colour_[0].type);
  const bool upper_bytes = !floats && colour_max_ > 255 && colour_low_bits_ == 0;   // 8 bits times 256, as many writers of LAS have them
  colour_scale_ = floats && colour_max_ <= 1 ? 65535 : colour_max_ <= 255 ? 257 : upper_bytes ? 257 / 256.0 : 1;
  schema_.colour_is_16_bit = colour_max_ > 255 ? !upper_bytes : colour_scale_ != 257;
}

void RowDecoder::decode(const std::byte* rows, std::size_t count, PointBlock& block) const {
  const std::size_t first = block.size();
  grow(block, count);
  decode_at(rows, count, block, first);
}

void RowDecoder::grow(PointBlock& block, std::size_t count) const {
  const std::size_t size = block.size() + count;
  block.position.resize(size);
  if (parts_ == PointParts::kPositions) return;
  if (schema_.has_normal) block.normal.resize(size);
  if (schema_.has_colour) block.colour.resize(size);
  if (parts_ == PointParts::kAll) block.extras.resize(size * extra_bytes_);
}

void RowDecoder::decode_at(const std::byte* rows, std::size_t count, PointBlock& block, std::size_t first) const {
  decode_positions(rows, count, block.position.data() + first);
  if (parts_ == PointParts::kPositions) return;
  if (schema_.has_normal) decode_normals(rows, count, block.normal.data() + first);
  if (schema_.has_colour) decode_colours(rows, count, block.colour.data() + first);
  if (parts_ == PointParts::kAll && extra_bytes_ > 0) decode_extras(rows, count, block.extras.data() + first * extra_bytes_);
}

// The two layouts that nearly all large files have get loops of their own: plain floats, and integers with a scale.
void RowDecoder::decode_positions(const std::byte* rows, std::size_t count, Vec3d* to) const {
  const RowField &fx = position_[0], &fy = position_[1], &fz = position_[2];
  const std::byte* row = rows;
  if (all_are(position_, ScalarType::kF32, false)) {
    for (std::size_t i = 0; i < count; ++i, row += layout_.row_bytes)
      to[i] = {static_cast<double>(load_as<float>(row + fx.offset)), static_cast<double>(load_as<float>(row + fy.offset)), static_cast<double>(load_as<float>(row + fz.offset))};
  } else if (all_are(position_, ScalarType::kI32, true)) {
    const double sx = fx.scale, sy = fy.scale, sz = fz.scale, ax = fx.add, ay = fy.add, az = fz.add;
    for (std::size_t i = 0; i < count; ++i, row += layout_.row_bytes)
      to[i] = {load_as<std::int32_t>(row + fx.offset) * sx + ax, load_as<std::int32_t>(row + fy.offset) * sy + ay, load_as<std::int32_t>(row + fz.offset) * sz + az};
  } else {
    for (std::size_t i = 0; i < count; ++i, row += layout_.row_bytes)
      for (int k = 0; k < 3; ++k) to[i][k] = field_value(position_[k], row);
  }
}

void RowDecoder::decode_normals(const std::byte* rows, std::size_t count, Vec3f* to) const {
  const std::byte* row = rows;
  const bool floats = all_are(normal_, ScalarType::kF32, false);
  for (std::size_t i = 0; i < count; ++i, row += layout_.row_bytes)
    for (int k = 0; k < 3; ++k) to[i][k] = floats ? load_as<float>(row + normal_[k].offset) : static_cast<float>(field_value(normal_[k], row));
}

void RowDecoder::decode_colours(const std::byte* rows, std::size_t count, std::array<std::uint16_t, 3>* to) const {
  const std::size_t row_bytes = layout_.row_bytes;
  const auto encoded = [this](double value) {
    value *= colour_scale_;
    return static_cast<std::uint16_t>(value > 0 ? std::min(value, 65535.0) + 0.5 : 0);  // NaN goes to 0 too
  };
  const auto scale = static_cast<std::uint32_t>(colour_scale_);
  const bool whole_scale = colour_scale_ < 2 ? colour_scale_ > 1 - 1e-9 && colour_scale_ < 1 + 1e-9 : scale == 257;   // 1 or 257
  for (std::size_t k = 0; k < 3; ++k) {
    const RowField& field = colour_[k];
    const std::byte* at = rows + field.offset;
    if (field.type == ScalarType::kU8 && !samples_wanted_) {
      for (std::size_t i = 0; i < count; ++i, at += row_bytes) to[i][k] = static_cast<std::uint16_t>(257 * std::to_integer<int>(*at));
    } else if (field.type == ScalarType::kU16 && !field.scaled && whole_scale) {
      for (std::size_t i = 0; i < count; ++i, at += row_bytes) to[i][k] = static_cast<std::uint16_t>(std::min<std::uint32_t>(65535, load_as<std::uint16_t>(at) * scale));
    } else {
      for (std::size_t i = 0; i < count; ++i) to[i][k] = encoded(field_value(field, rows + i * row_bytes));
    }
  }
}

void RowDecoder::decode_extras(const std::byte* rows, std::size_t count, std::byte* to) const {
  const std::size_t row_bytes = layout_.row_bytes;
  for (std::size_t i = 0; i < count; ++i)
    for (const Copy& copy : copies_) std::memcpy(to + i * extra_bytes_ + copy.to, rows + i * row_bytes + copy.from, copy.bytes);
  for (const Sliced& sliced : sliced_) {
    const RowField& field = sliced.field;
    for (std::size_t i = 0; i < count; ++i) {
      const std::byte* row = rows + i * row_bytes;
      std::byte* at = to + i * extra_bytes_ + sliced.to;
      if (field.scaled) {
        store_as(at, field_value(field, row));
      } else {
        *at = static_cast<std::byte>((std::to_integer<unsigned>(row[field.offset]) >> field.shift) & field.mask);
      }
    }
  }
}

}  // namespace chiaro::stream
