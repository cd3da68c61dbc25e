// PTX: scans of columns and rows in text. Each starts with ten lines: columns, rows, the scanner's position, its three axes, and a 4x4 matrix whose
// rows are multiplied from the left (the last one is the translation); then a line per cell, "x y z intensity" and perhaps "red green blue", column
// after column. Cells without a return are 0 0 0.
#include <algorithm>
#include <cmath>
#include <limits>

#include "stream/base/error.h"
#include "stream/cloud/formats.h"
#include "stream/cloud/row_readers.h"
#include "stream/cloud/scalars.h"

namespace chiaro::stream {
namespace {

constexpr std::uint64_t kLeastLineBytes = 6;  // "0 0 0" and its end

class PtxReader final : public PointReader {
 public:
  explicit PtxReader(File file) : file_(std::move(file)), lines_(file_) {
    find_columns();
    schema_.position_is_double = true;  // text, moved by the pose
    schema_.extras = {{"intensity", ScalarType::kF32}, {"row", ScalarType::kU32}, {"column", ScalarType::kU32}, {"scan", ScalarType::kU16}};
    extra_bytes_ = schema_.extra_bytes();
  }

  const PointSchema& schema() const override { return schema_; }

  bool read(PointBlock& block, std::size_t max_points) override {
    block.clear();
    while (block.size() < max_points && (next_ < count_ || begin_scan())) add_point(block);
    return block.size() > 0;
  }

 private:
  struct Point {
    double values[7];  // x y z intensity red green blue
    std::size_t count;
  };

  [[noreturn]] void fail(const std::string& what) const {
    throw Error(concat(file_.path().string(), ": line ", lines_.line(), ": ", what));
  }

  bool next_line(std::string_view& line) {
    while (lines_.next(line)) {
      line = trimmed(line);
      if (!line.empty()) return true;
    }
    return false;
  }

  void header_numbers(std::size_t count, const char* what, double* to) {
    std::string_view line;
    if (!next_line(line)) fail(concat("the file ends in the header of scan ", scan_, ": expected ", what));
    split_line(line, ' ', tokens_);
    if (tokens_.size() != count) fail(concat(tokens_.size(), " values, expected ", what, " (", count, " values)"));
    for (std::size_t i = 0; i < count; ++i) {
      const auto value = parse_number(tokens_[i]);
      if (!value || !std::isfinite(*value)) fail(concat("'", tokens_[i].substr(0, 40), "' in ", what, " is not a finite number"));
      to[i] = *value;
    }
  }

  std::uint64_t header_count(const char* what) {
    double value = 0;
    header_numbers(1, what, &value);
    if (!(value >= 0 && value <= 4294967295.0 && value == std::floor(value))) fail(concat("'", tokens_[0].substr(0, 40), "' is not ", what));
    return static_cast<std::uint64_t>(value);
  }

  // False at the end of the file. A scan may have no points.
  bool begin_scan() {
    do {
      LineReader ahead = lines_;
      std::string_view line;
      if (!next_line(line)) return false;
      lines_ = std::move(ahead);
      if (scan_ == std::numeric_limits<std::uint16_t>::max()) fail(concat("more than ", scan_, " scans"));
      ++scan_;
      const std::uint64_t columns = header_count("the number of columns");
      rows_ = header_count("the number of rows");
      double skipped[3];
      for (const char* what : {"the position of the scanner", "the scanner's x axis", "its y axis", "its z axis"}) header_numbers(3, what, skipped);
      read_pose();
      count_ = columns * rows_;
      next_ = 0;
      const std::uint64_t bytes = file_.size() > lines_.next_offset() ? file_.size() - lines_.next_offset() : 0;
      if (count_ / 2 > bytes / kLeastLineBytes)  // the half: the last line may lack its end, and rounding
        fail(concat("scan ", scan_, " declares ", columns, " columns of ", rows_, " rows, ", bytes, " bytes follow"));
    } while (count_ == 0);
    return true;
  }

  void read_pose() {
    for (int row = 0; row < 4; ++row) {
      double values[4];
      header_numbers(4, "a row of the 4x4 matrix", values);
      if (values[3] != (row == 3 ? 1 : 0)) fail(concat("the 4x4 matrix has ", values[3], " in its last column, expected 0 0 0 1 from top to bottom"));
      for (int k = 0; k < 3; ++k) (row < 3 ? turn_(k, row) : shift_[k]) = values[k];
    }
  }

  Point parse_point() {
    std::string_view line;
    if (!next_line(line))
      throw Error(concat(file_.path().string(), ": ", next_, " of ", count_, " points of scan ", scan_, " read, the file ends early at line ", lines_.line()));
    split_line(line, ' ', tokens_);
    Point point{};
    point.count = tokens_.size();
    if (point.count != 3 && point.count != 4 && point.count != 7) {
      fail(concat(point.count, " values, expected x y z, perhaps intensity, perhaps red green blue (point ", next_ + 1, " of ", count_, " of scan ", scan_, ")"));
    }
    for (std::size_t i = 0; i < point.count; ++i) {
      const auto value = parse_number(tokens_[i]);
      if (!value) fail(concat("'", tokens_[i].substr(0, 40), "' is not a number"));
      point.values[i] = *value;
    }
    return point;
  }

  // Whether there are colours shows in the first point.
  void find_columns() {
    const LineReader start = lines_;
    if (!begin_scan()) throw Error(concat(file_.path().string(), ": holds no points"));
    schema_.has_colour = parse_point().count == 7;
    lines_ = start;
    scan_ = 0;
    count_ = next_ = 0;
  }

  void add_point(PointBlock& block) {
    const Point point = parse_point();
    if (point.count == 7 && !schema_.has_colour) fail("a colour, the first point of the file has none: colours would be lost");
    const Vec3d p(point.values[0], point.values[1], point.values[2]);
    block.position.push_back(p.isZero(0) ? no_position() : Vec3d(turn_ * p + shift_));
    if (schema_.has_colour) block.colour.push_back(colour(point));
    const std::size_t at = block.extras.size();
    block.extras.resize(at + extra_bytes_);
    std::byte* to = block.extras.data() + at;
    store_as(to, point.count > 3 ? static_cast<float>(point.values[3]) : std::numeric_limits<float>::quiet_NaN());
    store_as(to + 4, static_cast<std::uint32_t>(next_ % rows_));
    store_as(to + 8, static_cast<std::uint32_t>(next_ / rows_));
    store_as(to + 12, static_cast<std::uint16_t>(scan_));
    ++next_;
  }

  static std::array<std::uint16_t, 3> colour(const Point& point) {
    constexpr std::uint16_t kGrey = 128 * 257;  // a point without colour, as elsewhere
    if (point.count < 7) return {kGrey, kGrey, kGrey};
    std::array<std::uint16_t, 3> encoded{};
    for (std::size_t k = 0; k < 3; ++k) {
      const double value = point.values[4 + k] * 257 + 0.5;
      encoded[k] = static_cast<std::uint16_t>(value > 0 ? std::min(value, 65535.0) : 0);
    }
    return encoded;
  }

  File file_;
  LineReader lines_;
  PointSchema schema_;
  std::size_t extra_bytes_ = 0;
  std::vector<std::string_view> tokens_;
  unsigned scan_ = 0;  // from 1
  std::uint64_t rows_ = 0, count_ = 0, next_ = 0;
  Eigen::Matrix3d turn_ = Eigen::Matrix3d::Identity();
  Vec3d shift_ = Vec3d::Zero();
};

}  // namespace

std::unique_ptr<PointReader> open_ptx(File file) { return std::make_unique<PtxReader>(std::move(file)); }

}  // namespace chiaro::stream
