/// NumPy arrays on disk (.npy), as far as lists of colours need them.
#pragma once
#include <cstdint>
#include <filesystem>
#include <vector>

#include "stream/base/file.h"
#include "stream/base/types.h"

namespace chiaro::tools {

/// An (N, 3) array of little-endian half, float or double in C order, read row by row.
/// source: NumPy enhancement proposal 1, format versions 1.0 to 3.0.
class NpyReader {
 public:
  /// throws Error if it is something else, or shorter than its header says.
  explicit NpyReader(const std::filesystem::path& path);
  std::uint64_t rows() const { return rows_; }
  /// Up to max_rows next rows; empty at the end.
  std::vector<Vec3f> read(std::size_t max_rows);

 private:
  File file_;
  std::uint64_t rows_ = 0, next_ = 0, data_offset_ = 0;
  int scalar_bytes_ = 0;
};

}  // namespace chiaro::tools
