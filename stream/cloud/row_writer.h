/// What the writers share: announced rows in, a whole file out. Internal to stream/cloud.
#pragma once
#include <cstdint>
#include <optional>
#include <string>
#include <vector>

#include "stream/base/file.h"
#include "stream/cloud/point_stream.h"

namespace chiaro::stream {

/// Packed size of one row of these properties.
std::size_t row_bytes_of(const std::vector<PointProperty>& properties);

/// A property and where its value lies in a row.
struct RowSlot {
  std::size_t index = 0, offset = 0;
  ScalarType type = ScalarType::kF32;
};
std::optional<RowSlot> find_property(const std::vector<PointProperty>& properties, std::string_view name);

/// Counts rows and keeps the file atomic; a format converts rows and finishes its header.
class RowWriter : public PointWriter {
 public:
  /// throws Error for no x y z, properties with the same name, or names that a header cannot hold (white space, control characters).
  RowWriter(const std::filesystem::path& path, const PointWriterOptions& options);
  void write(const std::byte* rows, std::size_t count) final;
  void commit() final;

 protected:
  virtual void write_rows(const std::byte* rows, std::size_t count) = 0;
  /// All rows are written; the last chance to patch the header.
  virtual void finish() {}

  const PointWriterOptions options_;
  const std::size_t row_bytes_;
  std::uint64_t written_ = 0;
  AtomicFile file_;
};

/// One line of printable text: line ends and control characters become blanks.
std::string one_line(const std::string& text);

}  // namespace chiaro::stream
