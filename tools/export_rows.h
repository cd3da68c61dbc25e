/// Rows of an exported point file, in the order of properties that docs/project-file.md gives.
#pragma once
#include <cstddef>
#include <cstdint>
#include <vector>

#include "stream/cloud/point_stream.h"
#include "tools/export_records.h"

namespace chiaro::tools {

class RowPacker {
 public:
  RowPacker(bool double_positions, bool wide_colours, bool with_albedo, bool with_inserted, const std::vector<stream::PointProperty>& carried);
  const std::vector<stream::PointProperty>& properties() const { return properties_; }
  std::size_t row_bytes() const { return row_bytes_; }

  /// Writes all but the carried properties; returns where those go.
  std::byte* pack(const PointRecord& r, const Vec3d& position, std::uint8_t inserted, std::byte* at) const;
  /// Carried properties of a point that no source file has: not a number, whole numbers 0.
  std::byte* pack_nothing_carried(std::byte* at) const;

 private:
  bool double_positions_, wide_colours_, with_albedo_, with_inserted_;
  std::vector<stream::PointProperty> properties_;
  std::size_t first_carried_ = 0;
  std::size_t row_bytes_ = 0;
};

}  // namespace chiaro::tools
