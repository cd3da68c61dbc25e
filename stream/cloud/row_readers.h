/// The two ways in which files hold rows: fixed-size binary records, and lines of text. Internal to stream/cloud.
#pragma once
#include <cstdint>
#include <memory>
#include <optional>
#include <string>
#include <string_view>
#include <vector>

#include "stream/base/file.h"
#include "stream/cloud/point_stream.h"
#include "stream/cloud/row_decoder.h"

namespace chiaro::stream {

/// Lines of a file without their line ends (LF or CR LF), read through a buffer of 1 MiB.
class LineReader {
 public:
  /// Starts at byte `offset`, whose line has the number `line` (from 1).
  LineReader(const File& file, std::uint64_t offset = 0, std::uint64_t line = 1) : file_(&file), next_offset_(offset), next_line_(line) {}
  /// False at the end of the file. The view holds until the next call. throws Error for a line longer than 1 MiB.
  bool next(std::string_view& line);
  std::uint64_t line() const { return line_; }                ///< number of the line that next() gave
  std::uint64_t line_offset() const { return line_offset_; }  ///< byte where it starts
  std::uint64_t next_offset() const { return next_offset_; }  ///< byte where the next line starts
  std::uint64_t next_line() const { return next_line_; }

 private:
  const File* file_;
  std::vector<char> buffer_;
  std::uint64_t buffer_offset_ = 0;  // of buffer_[0] in the file
  std::uint64_t next_offset_ = 0, next_line_ = 1, line_ = 0, line_offset_ = 0;
};

/// Reads a number as text files write it: optional sign, "nan" and "inf" in any spelling. nullopt if the token is anything else.
std::optional<double> parse_number(std::string_view token);

struct FixedRows {
  std::uint64_t offset = 0;  ///< of the first row in the file
  std::uint64_t count = 0;
  bool swap_bytes = false;  ///< big-endian rows: fields are swapped before decoding
};

/// Rows of layout.row_bytes each. throws Error if the file holds fewer rows than `rows.count`.
std::unique_ptr<PointReader> read_fixed_rows(File file, RowDecoder decoder, const FixedRows& rows);

struct TextColumn {
  std::string name;
  ScalarType type = ScalarType::kF64;
  std::size_t offset = 0;  ///< in the packed row
};

struct TextRows {
  std::vector<TextColumn> columns;
  std::uint64_t offset = 0, line = 1;  ///< where the rows start
  std::optional<std::uint64_t> count;  ///< rows announced; none: until the end of the file
  char separator = ' ';                ///< ' ' for any white space, else ',' or ';'
  bool comments = false;               ///< lines that start with # or // or % are skipped
  bool more_counts = false;            ///< a lone integer after `count` rows announces further rows (PTS with several scans)
  bool to_end = false;                 ///< rows beyond `count` are read too (else what follows is not looked at)
};

/// throws Error with the line number for a wrong number of columns, a token that is not a number, a value its type cannot hold, fewer rows
/// than announced.
std::unique_ptr<PointReader> read_text_rows(File file, RowDecoder decoder, TextRows rows);

/// Splits at `separator`. throws nothing; a blank field between two separators gives an empty token.
void split_line(std::string_view line, char separator, std::vector<std::string_view>& tokens);
bool is_comment(std::string_view line);
std::string_view trimmed(std::string_view text);

}  // namespace chiaro::stream
