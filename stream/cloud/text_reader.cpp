// XYZ, TXT, ASC, CSV and PTS: nobody specified them, so the first lines decide what the columns are.
#include <algorithm>
#include <cctype>
#include <cmath>

#include "stream/base/error.h"
#include "stream/base/text.h"
#include "stream/cloud/formats.h"
#include "stream/cloud/row_decoder.h"
#include "stream/cloud/row_readers.h"

namespace chiaro::stream {
namespace {

constexpr std::size_t kSampleLines = 1000, kMaxColumns = 256;

// White space that separates values although the line has commas: then the commas are decimal, and refused when the line is read.
bool blanks_separate(std::string_view line) {
  for (std::size_t i = 1; i < line.size(); ++i) {
    if (line[i] != ' ' && line[i] != '\t') continue;
    std::size_t after = i;
    while (after < line.size() && (line[after] == ' ' || line[after] == '\t')) ++after;
    if (line[i - 1] != ',' && after < line.size() && line[after] != ',') return true;
    i = after;
  }
  return false;
}

char separator_of(std::string_view line) {
  if (line.find(';') != std::string_view::npos) return ';';
  if (line.find(',') != std::string_view::npos && !blanks_separate(line)) return ',';
  return ' ';
}

std::vector<std::string> names_in(std::string_view line) {
  while (!line.empty() && (line[0] == '#' || line[0] == '/' || line[0] == '%')) line.remove_prefix(1);
  line = trimmed(line);
  std::vector<std::string_view> tokens;
  split_line(line, line.find(';') != std::string_view::npos ? ';' : line.find(',') != std::string_view::npos ? ',' : ' ', tokens);
  std::vector<std::string> names;
  for (std::string_view token : tokens) {
    while (!token.empty() && (token.front() == '"' || token.front() == '\'')) token.remove_prefix(1);
    while (!token.empty() && (token.back() == '"' || token.back() == '\'')) token.remove_suffix(1);
    std::string name(token);
    for (char& c : name)
      if (static_cast<unsigned char>(c) <= ' ' || static_cast<unsigned char>(c) >= 127) c = '_';
    names.push_back(std::move(name));
  }
  return names;
}

bool names_coordinates(const std::vector<std::string>& names) {
  for (const char axis : {'x', 'y', 'z'})
    if (std::none_of(names.begin(), names.end(),
                     [axis](const std::string& n) { return n.size() == 1 && std::tolower(static_cast<unsigned char>(n[0])) == axis; }))
      return false;
  return true;
}

int significant_digits(std::string_view token) {
  int digits = 0;
  bool leading = true;
  for (const char c : token) {
    if (c == 'e' || c == 'E') break;
    if (c < '0' || c > '9') continue;
    leading &= c == '0';
    digits += leading ? 0 : 1;
  }
  return digits;
}

/// Values of the first lines, by column.
class Samples {
 public:
  void add(const std::vector<double>& row) {
    columns_.resize(row.size());
    for (std::size_t i = 0; i < row.size(); ++i) columns_[i].push_back(row[i]);
  }
  std::size_t num_columns() const { return columns_.size(); }
  bool are_colours(std::size_t first) const {
    for (std::size_t k = first; k < first + 3; ++k)
      for (const double v : columns_[k])
        if (!(v >= 0 && v <= 255 && v == std::floor(v))) return false;
    return true;
  }
  /// Numbers of the points: 1, 2, 3, … for so many lines that it is no place.
  bool counts(std::size_t column) const {
    constexpr std::size_t kLines = 20;
    const std::vector<double>& values = columns_[column];
    if (values.size() < kLines || !(values[0] == 0 || values[0] == 1)) return false;
    for (std::size_t i = 1; i < values.size(); ++i)
      if (values[i] != values[i - 1] + 1) return false;
    return true;
  }
  /// All of length one, or zero where there is none.
  bool are_normals(std::size_t first) const {
    std::size_t units = 0;
    for (std::size_t i = 0; i < columns_[first].size(); ++i) {
      const double length = std::sqrt(columns_[first][i] * columns_[first][i] + columns_[first + 1][i] * columns_[first + 1][i] +
                                      columns_[first + 2][i] * columns_[first + 2][i]);
      constexpr double kTolerance = 0.02;  // three decimals per component, with room
      if (!(length == 0 || std::abs(length - 1) < kTolerance)) return false;
      units += length != 0;
    }
    return units > 0;
  }

 private:
  std::vector<std::vector<double>> columns_;
};

/// xyzrgb: columns 4 to 6 of a file with that extension are colours, as Open3D writes them from 0 to 1.
std::vector<std::string> guess_names(const Samples& samples, bool xyzrgb) {
  std::vector<std::string> names = {"x", "y", "z"};
  const auto append = [&](std::initializer_list<const char*> more) { names.insert(names.end(), more.begin(), more.end()); };
  const auto colour = [&] { append({"red", "green", "blue"}); };
  const auto normal = [&] { append({"nx", "ny", "nz"}); };
  switch (samples.num_columns()) {
    case 4:
      append({"intensity"});
      break;
    case 6:
      if (xyzrgb || (!samples.are_normals(3) && samples.are_colours(3)))
        colour();
      else if (samples.are_normals(3))
        normal();
      break;
    case 7:
      if (samples.are_colours(4))
        append({"intensity"}), colour();
      else if (samples.are_colours(3))
        colour(), append({"intensity"});
      else if (samples.are_normals(3))
        normal();
      else if (samples.are_normals(4))
        append({"intensity"}), normal();
      break;
    case 10:
      if (samples.are_colours(4) && samples.are_normals(7))
        append({"intensity"}), colour(), normal();
      else if (samples.are_colours(3) && samples.are_normals(7))
        colour(), append({"intensity"}), normal();
      else if (samples.are_colours(3) && samples.are_normals(6))
        colour(), normal(), append({"intensity"});
      else if (samples.are_normals(3) && samples.are_colours(6))
        normal(), colour(), append({"intensity"});
      break;
    case 9:
      if (samples.are_colours(3) && samples.are_normals(6))
        colour(), normal();
      else if (samples.are_normals(3) && samples.are_colours(6))
        normal(), colour();
      break;
    default:
      break;
  }
  for (std::size_t k = names.size(); k < samples.num_columns(); ++k) names.push_back(concat("column_", k + 1));
  return names;
}

class TextOpener {
 public:
  TextOpener(File file, bool is_pts) : file_(std::move(file)), is_pts_(is_pts) {}

  std::unique_ptr<PointReader> open() {
    find_first_row();
    sample();
    name_columns();
    RowLayout layout;
    for (const TextColumn& column : rows_.columns) {
      RowField field;
      field.name = column.name;
      field.type = column.type;
      field.offset = column.offset;
      layout.fields.push_back(std::move(field));
    }
    layout.row_bytes = 8 * rows_.columns.size();
    RowDecoder decoder(file_.path(), std::move(layout), rows_.count.value_or(0));
    decoder.schema().position_is_double = most_digits_ > 7;  // a float keeps seven
    rows_.comments = true;
    rows_.more_counts = is_pts_;
    rows_.to_end = true;
    return read_text_rows(std::move(file_), std::move(decoder), std::move(rows_));
  }

 private:
  [[noreturn]] void fail(std::uint64_t line, const std::string& what) const {
    throw Error(concat(file_.path().string(), ": line ", line, ": ", what));
  }

  bool next_line(LineReader& lines, std::string_view& line, bool skip_comments) {
    while (lines.next(line)) {
      mark_bytes_ = lines.line_offset() == 0 && line.starts_with("\xef\xbb\xbf") ? 3 : 0;  // byte order mark of UTF-8
      line.remove_prefix(mark_bytes_);
      line = trimmed(line);
      if (!line.empty() && !(skip_comments && is_comment(line))) return true;
    }
    return false;
  }

  // Leaves rows_ pointing at the first row of numbers, with a count and column names if the lines above give them.
  void find_first_row() {
    LineReader lines(file_);
    std::string_view line;
    std::vector<std::string_view> tokens;
    while (next_line(lines, line, false)) {
      if (is_comment(line)) {
        std::vector<std::string> names = names_in(line);
        if (names_coordinates(names)) names_ = std::move(names), names_line_ = 0;  // a comment binds only if it fits
        continue;
      }
      rows_.separator = separator_of(line);
      split_line(line, rows_.separator, tokens);
      if (!rows_.count && tokens.size() == 1 && take_count(tokens[0])) continue;
      if (!starts_with_number(tokens[0]) && names_line_ == 0) {
        names_ = names_in(line);
        names_line_ = lines.line();
        if (!names_coordinates(names_))
          fail(names_line_, concat("expected numbers, or the names of columns with x, y and z, found '", line.substr(0, 60), "'"));
        continue;
      }
      rows_.offset = lines.line_offset() + mark_bytes_;
      rows_.line = lines.line();
      return;
    }
    throw Error(concat(file_.path().string(), ": holds no points"));
  }

  // "1,5" is a number with a decimal comma, not a name.
  static bool starts_with_number(std::string_view token) {
    return parse_number(token) ||
           (!token.empty() && ((token[0] >= '0' && token[0] <= '9') || token[0] == '-' || token[0] == '+' || token[0] == '.'));
  }

  bool take_count(std::string_view token) {
    const std::optional<double> value = parse_number(token);
    if (!value || !(*value >= 1 && *value <= static_cast<double>(file_.size()) && *value == std::floor(*value))) return false;
    rows_.count = static_cast<std::uint64_t>(*value);
    return true;
  }

  // Lines that do not fit end the sample; the reader reports them when it comes to them.
  void sample() {
    LineReader lines(file_, rows_.offset, rows_.line);
    std::string_view line;
    std::vector<std::string_view> tokens;
    std::vector<double> row;
    for (std::size_t i = 0; i < kSampleLines && next_line(lines, line, true); ++i) {
      split_line(line, rows_.separator, tokens);
      if (i == 0) num_columns_ = tokens.size();
      if (tokens.size() != num_columns_ || num_columns_ > kMaxColumns) break;
      row.clear();
      for (const std::string_view token : tokens)
        if (const std::optional<double> value = parse_number(token)) row.push_back(*value);
      if (row.size() != num_columns_) break;
      samples_.add(row);
      for (std::size_t k = 0; k < 3 && k < tokens.size(); ++k) most_digits_ = std::max(most_digits_, significant_digits(tokens[k]));
    }
  }

  void name_columns() {
    if (num_columns_ < 3 || num_columns_ > kMaxColumns)
      fail(rows_.line, concat(num_columns_, " values, expected 3 to ", kMaxColumns, ": x y z and more"));
    if (names_line_ > 0 && names_.size() != num_columns_)
      fail(rows_.line, concat(num_columns_, " values, line ", names_line_, " names ", names_.size(), " columns"));
    if (names_.size() != num_columns_) {
      if (samples_.num_columns() > 3 && samples_.counts(0))
        fail(rows_.line, "the first column counts the points: taken for x it would give another cloud. A line of names above, such as 'number x y z', says what the columns are");
      names_ = samples_.num_columns() > 0 ? guess_names(samples_, lower_extension(file_.path()) == ".xyzrgb") : std::vector<std::string>{"x", "y", "z"};
      while (names_.size() < num_columns_) names_.push_back(concat("column_", names_.size() + 1));
    }
    for (std::size_t i = 0; i < num_columns_; ++i)
      rows_.columns.push_back({names_[i].empty() ? concat("column_", i + 1) : names_[i], ScalarType::kF64, 8 * i});
  }

  File file_;
  bool is_pts_;
  TextRows rows_;
  std::vector<std::string> names_;
  std::uint64_t names_line_ = 0;  // 0: from a comment, or none
  std::size_t num_columns_ = 0, mark_bytes_ = 0;
  Samples samples_;
  int most_digits_ = 0;
};

}  // namespace

std::unique_ptr<PointReader> open_text(File file, bool is_pts) { return TextOpener(std::move(file), is_pts).open(); }

}  // namespace chiaro::stream
