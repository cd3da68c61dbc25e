#include "stream/cloud/row_readers.h"

#include <algorithm>
#include <charconv>
#include <cmath>
#include <cstring>
#include <exception>
#include <limits>

#include "stream/base/error.h"
#include "stream/base/parallel.h"
#include "stream/cloud/scalars.h"

namespace chiaro::stream {
namespace {

constexpr std::size_t kBufferBytes = 1 << 20;

bool is_blank(char c) { return c == ' ' || c == '\t' || c == '\r' || c == '\v' || c == '\f'; }

void swap_fields(const RowLayout& layout, std::byte* rows, std::size_t count) {
  for (std::size_t i = 0; i < count; ++i)
    for (const RowField& field : layout.fields) {
      std::byte* at = rows + i * layout.row_bytes + field.offset;
      std::reverse(at, at + scalar_bytes(field.type));
    }
}

class FixedRowReader : public PointReader {
 public:
  FixedRowReader(File file, RowDecoder decoder, const FixedRows& rows) : file_(std::move(file)), decoder_(std::move(decoder)), rows_(rows) {
    const std::size_t row_bytes = decoder_.layout().row_bytes;
    const std::uint64_t size = file_.size();
    const std::uint64_t available = size > rows_.offset ? (size - rows_.offset) / row_bytes : 0;
    if (available < rows_.count) {
      throw Error(concat(file_.path().string(), ": the header declares ", rows_.count, " points of ", row_bytes, " bytes from offset ",
                         rows_.offset, ", the file holds ", available, " (", size, " bytes)"));
    }
    piece_rows_ = std::max<std::size_t>(1, static_cast<std::size_t>(std::min<std::uint64_t>(kPieceBytes / row_bytes, rows_.count)));
    for (auto& buffer : buffers_) buffer.resize(piece_rows_ * row_bytes);
    if (decoder_.needs_colour_samples()) sample_colours();
  }

  const PointSchema& schema() const override { return decoder_.schema(); }

  void wants(PointParts parts) override { decoder_.wants(parts); }

  // Pieces of the block are read and decoded side by side, each through a buffer of its own.
  bool read(PointBlock& block, std::size_t max_points) override {
    block.clear();
    const auto count = static_cast<std::size_t>(std::min<std::uint64_t>(max_points, rows_.count - next_));
    decoder_.grow(block, count);
    for (std::size_t first = 0; first < count; first += kPieces * piece_rows_) {
      const std::size_t pieces = (std::min(count - first, kPieces * piece_rows_) + piece_rows_ - 1) / piece_rows_;
      parallel_blocks(pieces, 1, [&](std::size_t piece, std::size_t) {
        const std::size_t at = first + piece * piece_rows_, n = std::min(piece_rows_, count - at);
        load(next_ + at, n, buffers_[piece]);
        decoder_.decode_at(buffers_[piece].data(), n, block, at);
      });
    }
    next_ += count;
    return count > 0;
  }

 private:
  static constexpr std::size_t kPieces = 8, kPieceBytes = 256 << 10;

  void load(std::uint64_t first, std::size_t count, std::vector<std::byte>& buffer) {
    const std::size_t row_bytes = decoder_.layout().row_bytes;
    file_.read_at(rows_.offset + first * row_bytes, buffer.data(), count * row_bytes);
    if (rows_.swap_bytes) swap_fields(decoder_.layout(), buffer.data(), count);
  }

  // Runs of points spread over the whole file, so that one dark corner does not decide.
  void sample_colours() {
    constexpr std::uint64_t kRuns = 64, kRunLength = 256;
    for (std::uint64_t run = 0; run < kRuns; ++run) file_.will_need(rows_.offset + rows_.count / kRuns * run * decoder_.layout().row_bytes, kRunLength * decoder_.layout().row_bytes);
    for (std::uint64_t run = 0; run < kRuns; ++run) {
      const std::uint64_t first = rows_.count / kRuns * run;
      const std::uint64_t count = std::min<std::uint64_t>({kRunLength, rows_.count - first, piece_rows_});
      load(first, static_cast<std::size_t>(count), buffers_[0]);
      decoder_.sample_colours(buffers_[0].data(), static_cast<std::size_t>(count));
      if (rows_.count <= count) break;
    }
    decoder_.decide_colour_scale();
  }

  File file_;
  RowDecoder decoder_;
  FixedRows rows_;
  std::uint64_t next_ = 0;
  std::size_t piece_rows_ = 1;
  std::array<std::vector<std::byte>, kPieces> buffers_;
};

class TextRowReader : public PointReader {
 public:
  TextRowReader(File file, RowDecoder decoder, TextRows rows)
      : file_(std::move(file)), decoder_(std::move(decoder)), rows_(std::move(rows)), lines_(file_, rows_.offset, rows_.line) {
    check_count();
    if (decoder_.needs_colour_samples()) sample_colours();
    left_ = rows_.count;
    announced_ = rows_.count.value_or(0);
  }
  const PointSchema& schema() const override { return decoder_.schema(); }
  void wants(PointParts parts) override { decoder_.wants(parts); }

  bool read(PointBlock& block, std::size_t max_points) override {
    block.clear();
    while (block.size() < max_points) {
      const std::size_t count = parse_rows(std::min<std::size_t>(max_points - block.size(), kRowsAtOnce));
      if (count == 0) break;
      decoder_.decode(packed_.data(), count, block);
    }
    return block.size() > 0;
  }

 private:
  static constexpr std::size_t kRowsAtOnce = 32768, kRowsSampled = 1024, kRowsOfPiece = 2048, kTextAtOnce = 4 << 20;
  struct TakenLine {
    std::size_t begin, size;  // in text_
    std::uint64_t number;
  };

  // Every row needs a character or more: a count beyond that is wrong before a row is read.
  void check_count() const {
    const std::uint64_t bytes = file_.size() > rows_.offset ? file_.size() - rows_.offset : 0;
    if (rows_.count && *rows_.count > bytes)
      throw Error(concat(file_.path().string(), ": the header declares ", *rows_.count, " points, ", bytes, " bytes follow from line ",
                         rows_.line));
  }

  void sample_colours() {
    left_ = rows_.count;
    announced_ = rows_.count.value_or(0);
    const std::size_t count = parse_rows(kRowsSampled);
    decoder_.sample_colours(packed_.data(), count);
    if (count == kRowsSampled) sample_further_on(static_cast<double>(lines_.next_offset() - rows_.offset) / kRowsSampled);
    decoder_.decide_colour_scale();
    lines_ = LineReader(file_, rows_.offset, rows_.line);
    done_ = 0;
  }

  // Scans often begin with points that are black. Runs of rows spread over the file; what is no row (the line that a run starts in, another scan's count) is passed
  // over here. Where rows are counted, something else may follow them (faces), and rows may become shorter: the last tenth by the length of the first ones is left out.
  void sample_further_on(double bytes_of_row) {
    constexpr std::uint64_t kRuns = 64, kRunLength = 64;
    const double counted = rows_.count && !rows_.to_end ? 0.9 * bytes_of_row * static_cast<double>(*rows_.count) : 1e18;
    const auto bytes = static_cast<std::uint64_t>(std::min(counted, static_cast<double>(file_.size() - rows_.offset)));
    std::vector<std::string_view> tokens;
    packed_.assign(decoder_.layout().row_bytes, std::byte{0});
    for (std::uint64_t run = 1; run < kRuns; ++run) {
      LineReader lines(file_, rows_.offset + bytes / kRuns * run);
      std::string_view line;
      if (!lines.next(line)) break;
      for (std::uint64_t k = 0; k < kRunLength && lines.next(line) && lines.next_offset() <= rows_.offset + bytes; ++k) {
        try {
          parse_row(lines.line(), trimmed(line), tokens, packed_.data());
        } catch (const Error&) {
          continue;
        }
        decoder_.sample_colours(packed_.data(), 1);
      }
    }
  }

  bool next_row_line(std::string_view& line) {
    while (lines_.next(line)) {
      line = trimmed(line);
      if (line.empty() || (rows_.comments && is_comment(line))) continue;
      return true;
    }
    return false;
  }

  [[noreturn]] void fail_at(std::uint64_t line, const std::string& what) const { throw Error(concat(file_.path().string(), ": line ", line, ": ", what)); }

  // The line of the next row. With all announced rows read, what follows in a text file is a further count, or rows that the count forgot.
  bool next_row(std::string_view& line) {
    while (!left_ || *left_ > 0 || rows_.to_end) {
      if (!next_row_line(line)) {
        if (!left_ || *left_ == 0) return false;
        throw Error(
            concat(file_.path().string(), ": ", done_, " of ", announced_, " points read, the file ends early at line ", lines_.line()));
      }
      if (!rows_.more_counts || !left_ || *left_ > 0 || !take_count(line)) return true;
    }
    return false;
  }

  bool take_count(std::string_view line) {
    split_line(line, rows_.separator, tokens_);
    if (tokens_.size() != 1) return false;
    const double most = static_cast<double>(file_.size()), number = parse_number(tokens_[0]).value_or(-1);
    if (!(number >= 0 && number <= most && number == std::floor(number)))
      fail_at(lines_.line(), concat("'", tokens_[0].substr(0, 40), "' is not a number of points"));
    left_ = static_cast<std::uint64_t>(number);
    announced_ += *left_;
    return true;
  }

  // Lines are taken one after the other, then parsed side by side. Of several bad lines the first is reported.
  std::size_t parse_rows(std::size_t max_rows) {
    const std::size_t row_bytes = decoder_.layout().row_bytes;
    text_.clear();
    taken_.clear();
    std::string_view line;
    std::exception_ptr ended;  // the end of the file came too early, or a count is wrong: but lines before may be wrong as well
    try {
      while (taken_.size() < max_rows && text_.size() < kTextAtOnce && next_row(line)) {
        taken_.push_back({text_.size(), line.size(), lines_.line()});
        text_.append(line);
        ++done_;
        if (left_ && *left_ > 0) --*left_;
      }
    } catch (const Error&) {
      ended = std::current_exception();
    }
    packed_.resize(taken_.size() * row_bytes);
    std::vector<std::exception_ptr> failed((taken_.size() + kRowsOfPiece - 1) / kRowsOfPiece);
    parallel_blocks(taken_.size(), kRowsOfPiece, [&](std::size_t begin, std::size_t end) {
      std::vector<std::string_view> tokens;
      try {
        for (std::size_t i = begin; i < end; ++i) parse_row(taken_[i].number, std::string_view(text_).substr(taken_[i].begin, taken_[i].size), tokens, packed_.data() + i * row_bytes);
      } catch (const Error&) {
        failed[begin / kRowsOfPiece] = std::current_exception();
      }
    });
    for (const std::exception_ptr& error : failed)
      if (error) std::rethrow_exception(error);
    if (ended) std::rethrow_exception(ended);
    return taken_.size();
  }

  void parse_row(std::uint64_t number, std::string_view line, std::vector<std::string_view>& tokens, std::byte* row) const {
    split_line(line, rows_.separator, tokens);
    if (tokens.size() != rows_.columns.size()) {
      check_decimal_commas(number, line);
      fail_at(number, concat(tokens.size(), " values, expected ", rows_.columns.size()));
    }
    for (std::size_t i = 0; i < tokens.size(); ++i) {
      const TextColumn& column = rows_.columns[i];
      const std::optional<double> value = parse_number(tokens[i]);
      if (!value) {
        check_decimal_commas(number, line);
        fail_at(number, concat("'", tokens[i].substr(0, 40), "' is not a number (column ", i + 1, ", ", column.name, ")"));
      }
      if (!store_scalar(column.type, *value, row + column.offset))
        fail_at(number, concat(tokens[i].substr(0, 40), " does not fit the type ", scalar_name(column.type), " of ", column.name));
    }
  }

  void check_decimal_commas(std::uint64_t number, std::string_view line) const {
    if (rows_.separator == ',') return;
    for (std::size_t i = 1; i + 1 < line.size(); ++i) {
      const auto digit = [&](std::size_t k) { return line[k] >= '0' && line[k] <= '9'; };
      if (line[i] == ',' && digit(i - 1) && digit(i + 1)) fail_at(number, "decimal commas are not read, expected decimal points");
    }
  }

  File file_;
  RowDecoder decoder_;
  TextRows rows_;
  LineReader lines_;
  std::optional<std::uint64_t> left_;
  std::uint64_t announced_ = 0, done_ = 0;
  std::string text_;
  std::vector<TakenLine> taken_;
  std::vector<std::byte> packed_;
  std::vector<std::string_view> tokens_;
};

}  // namespace

bool LineReader::next(std::string_view& line) {
  std::size_t begin = static_cast<std::size_t>(next_offset_ - buffer_offset_);
  if (buffer_.empty() || begin > buffer_.size()) begin = buffer_.size();
  const char* end_of_line = nullptr;
  if (begin < buffer_.size()) end_of_line = static_cast<const char*>(std::memchr(buffer_.data() + begin, '\n', buffer_.size() - begin));
  if (!end_of_line) {
    buffer_.resize(kBufferBytes);
    buffer_.resize(file_->read_some_at(next_offset_, buffer_.data(), kBufferBytes));
    buffer_offset_ = next_offset_;
    begin = 0;
    if (buffer_.empty()) return false;
    end_of_line = static_cast<const char*>(std::memchr(buffer_.data(), '\n', buffer_.size()));
    if (!end_of_line && buffer_.size() == kBufferBytes)
      throw Error(
          concat(file_->path().string(), ": line ", next_line_, " (byte ", next_offset_, ") is longer than ", kBufferBytes, " bytes"));
  }
  const std::size_t end = end_of_line ? static_cast<std::size_t>(end_of_line - buffer_.data()) : buffer_.size();
  line = std::string_view(buffer_.data() + begin, end - begin);
  line_ = next_line_++;
  line_offset_ = next_offset_;
  next_offset_ = buffer_offset_ + end + (end_of_line ? 1 : 0);
  if (!line.empty() && line.back() == '\r') line.remove_suffix(1);
  return true;
}

std::string_view trimmed(std::string_view text) {
  while (!text.empty() && is_blank(text.front())) text.remove_prefix(1);
  while (!text.empty() && is_blank(text.back())) text.remove_suffix(1);
  return text;
}

bool is_comment(std::string_view line) { return !line.empty() && (line[0] == '#' || line[0] == '%' || line.substr(0, 2) == "//"); }

void split_line(std::string_view line, char separator, std::vector<std::string_view>& tokens) {
  tokens.clear();
  if (separator != ' ') {
    for (;;) {
      const std::size_t at = line.find(separator);
      tokens.push_back(trimmed(line.substr(0, at)));
      if (at == std::string_view::npos) break;
      line.remove_prefix(at + 1);
    }
    if (tokens.size() > 1 && tokens.back().empty()) tokens.pop_back();  // a separator at the end of the line
    return;
  }
  std::size_t i = 0;
  while (i < line.size()) {
    while (i < line.size() && is_blank(line[i])) ++i;
    const std::size_t begin = i;
    while (i < line.size() && !is_blank(line[i])) ++i;
    if (i > begin) tokens.push_back(line.substr(begin, i - begin));
  }
}

std::optional<double> parse_number(std::string_view token) {
  if (token.size() > 1 && token[0] == '+' && token[1] != '-') token.remove_prefix(1);
  double value = 0;
  const char* end = token.data() + token.size();
  const auto [stop, code] = std::from_chars(token.data(), end, value);
  if (code == std::errc::result_out_of_range && stop == end) {
    // Too small is zero; too large is infinite, which the caller counts among the points without a position.
    const bool tiny = token.find("e-") != std::string_view::npos || token.find("E-") != std::string_view::npos;
    value = tiny ? 0 : std::numeric_limits<double>::infinity();
    return token[0] == '-' ? -value : value;
  }
  if (code == std::errc{} && stop == end && !token.empty()) return value;
  const std::string_view magnitude = !token.empty() && token[0] == '-' ? token.substr(1) : token;
  if (magnitude.substr(0, 3) == "1.#") return std::numeric_limits<double>::quiet_NaN();  // old Microsoft run-time: 1.#QNAN, 1.#IND, 1.#INF
  return std::nullopt;
}

std::unique_ptr<PointReader> read_fixed_rows(File file, RowDecoder decoder, const FixedRows& rows) {
  return std::make_unique<FixedRowReader>(std::move(file), std::move(decoder), rows);
}

std::unique_ptr<PointReader> read_text_rows(File file, RowDecoder decoder, TextRows rows) {
  return std::make_unique<TextRowReader>(std::move(file), std::move(decoder), std::move(rows));
}

}  // namespace chiaro::stream
