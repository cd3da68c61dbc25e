/// Aligned text tables, and numbers as people read them.
#pragma once
#include <cstdint>
#include <string>
#include <vector>

namespace chiaro::tools {

/// Columns separated by two spaces; the first column is left-aligned, the others right-aligned unless said otherwise.
class Table {
 public:
  enum class Align { kLeft, kRight };
  /// Without headers (all empty) no header line is printed.
  explicit Table(std::vector<std::string> headers, std::vector<Align> aligns = {});
  /// Short rows are filled with empty cells; long ones are a caller's mistake (std::invalid_argument).
  void row(std::vector<std::string> cells);
  /// Lines without trailing spaces, each with a newline. UTF-8 characters count as one column.
  std::string text() const;

 private:
  std::vector<std::string> headers_;
  std::vector<Align> aligns_;
  std::vector<std::vector<std::string>> rows_;
};

/// 9000000 to "9 000 000".
std::string format_count(std::uint64_t count);
/// Up to `digits` significant digits without trailing zeros: 0.0312, 37.4, 1.2e-06; "nan" where it is none.
std::string format_number(double value, int digits = 4);
/// The smallest of 1, 2, 5 times a power of ten that is not below `value`: the end of a scale. 1 where value is not positive.
double round_range(double value);
/// 0.31 s, 42 s, 3 min 05 s, 2 h 11 min.
std::string format_seconds(double seconds);
/// 1234567 to "1.23 M", 950 to "950": for rates.
std::string format_rate(double per_second);

}  // namespace chiaro::tools
