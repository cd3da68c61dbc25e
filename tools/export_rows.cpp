#include "tools/export_rows.h"

#include <cmath>
#include <cstring>
#include <limits>

namespace chiaro::tools {
namespace {

using stream::PointProperty;
using stream::ScalarType;

std::uint8_t srgb_8bit(float linear) {
  if (!(linear > 0)) return 0;
  if (linear >= 1) return 255;
  const double v = linear <= 0.0031308 ? 12.92 * linear : 1.055 * std::pow(static_cast<double>(linear), 1 / 2.4) - 0.055;
  return static_cast<std::uint8_t>(std::lround(255 * v));
}

template <class T>
void put(const T& value, std::byte*& at) {
  std::memcpy(at, &value, sizeof value);
  at += sizeof value;
}

}  // namespace

RowPacker::RowPacker(bool double_positions, bool wide_colours, bool with_albedo, bool with_inserted, const std::vector<PointProperty>& carried)
    : double_positions_(double_positions), wide_colours_(wide_colours), with_albedo_(with_albedo), with_inserted_(with_inserted) {
  const ScalarType position = double_positions ? ScalarType::kF64 : ScalarType::kF32;
  for (const char* name : {"x", "y", "z"}) properties_.push_back({name, position});
  for (const char* name : {"nx", "ny", "nz"}) properties_.push_back({name, ScalarType::kF32});
  for (const char* name : {"red", "green", "blue"}) properties_.push_back({name, wide_colours ? ScalarType::kU16 : ScalarType::kU8});
  if (with_albedo) {
    for (const char* name : {"albedo_r", "albedo_g", "albedo_b", "sigma"}) properties_.push_back({name, ScalarType::kF32});
    properties_.push_back({"photos", ScalarType::kU16});
  }
  if (with_inserted) properties_.push_back({"inserted", ScalarType::kU8});
  first_carried_ = properties_.size();
  properties_.insert(properties_.end(), carried.begin(), carried.end());
  for (const PointProperty& p : properties_) row_bytes_ += stream::scalar_bytes(p.type);
}

std::byte* RowPacker::pack(const PointRecord& r, const Vec3d& position, std::uint8_t inserted, std::byte* at) const {
  for (int c = 0; c < 3; ++c) double_positions_ ? put(position[c], at) : put(static_cast<float>(position[c]), at);
  const Vec3f normal = stream::decode_normal(r.normal[0], r.normal[1]);
  for (int c = 0; c < 3; ++c) put(normal[c], at);
  const bool has_albedo = r.albedo.allFinite();
  for (int c = 0; c < 3; ++c) {
    const auto colour = has_albedo ? static_cast<std::uint16_t>(257 * srgb_8bit(r.albedo[c])) : r.colour[static_cast<std::size_t>(c)];
    wide_colours_ ? put(colour, at) : put(static_cast<std::uint8_t>((colour + 128) / 257), at);
  }
  if (with_albedo_) {
    for (int c = 0; c < 3; ++c) put(r.albedo[c], at);
    put(r.sigma, at);
    put(r.photos, at);
  }
  if (with_inserted_) put(inserted, at);
  return at;
}

std::byte* RowPacker::pack_nothing_carried(std::byte* at) const {
  for (std::size_t i = first_carried_; i < properties_.size(); ++i) {
    const ScalarType type = properties_[i].type;
    if (type == ScalarType::kF64) put(std::numeric_limits<double>::quiet_NaN(), at);
    else if (type == ScalarType::kF32) put(std::numeric_limits<float>::quiet_NaN(), at);
    else {
      std::memset(at, 0, stream::scalar_bytes(type));
      at += stream::scalar_bytes(type);
    }
  }
  return at;
}

}  // namespace chiaro::tools
