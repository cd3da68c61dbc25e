/// Compressed LAS records. Internal to stream/cloud.
#pragma once
#include <cstddef>
#include <cstdint>
#include <memory>
#include <string>
#include <vector>

#include "stream/base/error.h"
#include "stream/base/file.h"
#include "stream/cloud/row_decoder.h"

namespace chiaro::stream {

struct LazRows {
  int point_format = 0;
  std::uint64_t point_offset = 0, count = 0;
  std::vector<std::byte> vlr;  ///< content of the laszip record; empty: the file has none
  std::uint64_t memory_bytes = std::uint64_t{1} << 32;
};

/// Rows of layout.row_bytes each, decompressed chunk by chunk on all threads, given in file order. Memory: a few MiB a thread for chunks of the
/// usual size, 32 MiB a thread at most; a larger chunk is streamed. throws Error for damaged data, or a chunk whose compressed bytes exceed
/// memory_bytes.
std::unique_ptr<PointReader> read_laz_rows(File file, RowDecoder decoder, LazRows rows);

/// The error of a build without the Rust library: names the file, what is missing and how to get it.
Error missing_rust_formats(const std::filesystem::path& path, const std::string& format);

}  // namespace chiaro::stream
