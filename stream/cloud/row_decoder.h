/// From rows of packed scalars, as nearly all formats store points, to a PointBlock. Internal to stream/cloud.
#pragma once
#include <cstddef>
#include <cstdint>
#include <filesystem>
#include <string>
#include <vector>

#include "stream/cloud/point_stream.h"

namespace chiaro::stream {

/// One named value of a row. Its value is ((stored >> shift) & mask) where mask is set, times scale plus add where `scaled` is set (then a
/// double).
struct RowField {
  std::string name;
  ScalarType type = ScalarType::kF32;
  std::size_t offset = 0;
  std::uint8_t shift = 0, mask = 0;
  bool scaled = false;
  double scale = 1, add = 0;
};

struct RowLayout {
  std::vector<RowField> fields;  ///< need not cover the row, may overlap
  std::size_t row_bytes = 0;
};

/// Finds position, normal and colour by their names (any case and the common aliases) and carries the rest as extras.
class RowDecoder {
 public:
  /// throws Error naming `path` for a missing coordinate, a name used twice, a row that is too large.
  RowDecoder(const std::filesystem::path& path, RowLayout layout, std::uint64_t declared_points);

  const RowLayout& layout() const { return layout_; }
  PointSchema& schema() { return schema_; }
  const PointSchema& schema() const { return schema_; }

  /// Whether colours are 0..1, 0..255 or 0..65535 shows in their values only (16-bit fields often hold 8-bit colours): feed samples, then
  /// decide.
  bool needs_colour_samples() const { return samples_wanted_; }
  void sample_colours(const std::byte* rows, std::size_t count);
  void decide_colour_scale();

  void wants(PointParts parts) { parts_ = parts; }
  /// Room for `count` more points in the parts that are wanted; decode_at() then fills them, any thread its own.
  void grow(PointBlock& block, std::size_t count) const;
  /// Decodes `count` rows to the points from `first` on. Values beyond the colour range are clamped, NaN becomes 0.
  void decode_at(const std::byte* rows, std::size_t count, PointBlock& block, std::size_t first) const;
  /// Appends `count` rows to the block.
  void decode(const std::byte* rows, std::size_t count, PointBlock& block) const;

 private:
  struct Copy {
    std::size_t from, to, bytes;
  };
  struct Sliced {
    RowField field;
    std::size_t to;
  };
  void find_roles(const std::filesystem::path& path);
  void add_extra(const RowField& field);
  void decode_positions(const std::byte* rows, std::size_t count, Vec3d* to) const;
  void decode_normals(const std::byte* rows, std::size_t count, Vec3f* to) const;
  void decode_colours(const std::byte* rows, std::size_t count, std::array<std::uint16_t, 3>* to) const;
  void decode_extras(const std::byte* rows, std::size_t count, std::byte* to) const;

  RowLayout layout_;
  PointSchema schema_;
  RowField position_[3], normal_[3], colour_[3];
  std::vector<Copy> copies_;
  std::vector<Sliced> sliced_;
  std::size_t extra_bytes_ = 0;
  bool samples_wanted_ = false;
  PointParts parts_ = PointParts::kAll;
  double colour_max_ = 0, colour_scale_ = 257;
  unsigned colour_low_bits_ = 0;   // lower bytes of the samples
};

/// The value of one field of one row.
double field_value(const RowField& field, const std::byte* row);

}  // namespace chiaro::stream
