/// Vertices with lists in binary PLY. Lists are passed over: a point has one value of each property. Internal to stream/cloud.
#pragma once
#include <cstdint>
#include <memory>
#include <string>
#include <vector>

#include "stream/base/file.h"
#include "stream/cloud/row_decoder.h"

namespace chiaro::stream {

struct ListColumn {
  std::string name;
  ScalarType type = ScalarType::kF32;        ///< of the value, or of each entry
  bool is_list = false;
  ScalarType count_type = ScalarType::kU8;   ///< of a list's length
};

struct ListRows {
  std::vector<ListColumn> columns;   ///< in file order; those that are no lists are the fields of the decoder's layout, packed
  std::uint64_t offset = 0, count = 0;
  bool swap_bytes = false;
};

/// throws Error with offset and point for a list that the file cannot hold, and where the file ends early.
std::unique_ptr<PointReader> read_list_rows(File file, RowDecoder decoder, ListRows rows);

}  // namespace chiaro::stream
