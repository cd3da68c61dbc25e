// PCD 0.7. The header and the bodies `ascii` and `binary` are streamed here; `binary_compressed` stores each field of all points in one
// compressed piece, so PCL reads it whole, within the memory the caller allows.
#include <algorithm>
#include <charconv>

#include "stream/base/error.h"
#include "stream/cloud/formats.h"
#include "stream/cloud/pcl_module.h"
#include "stream/cloud/row_decoder.h"
#include "stream/cloud/row_readers.h"
#include "stream/cloud/scalars.h"

namespace chiaro::stream {
namespace {

enum class PcdData { kAscii, kBinary, kCompressed };

struct PcdField {
  std::string name;
  std::size_t bytes = 4, count = 1;
  char type = 'F';
};

struct PcdHeader {
  std::vector<PcdField> fields;
  std::uint64_t points = 0, offset = 0, line = 0;  // of the first byte after the header
  PcdData data = PcdData::kAscii;
};

class PcdHeaderParser {
 public:
  explicit PcdHeaderParser(const File& file) : file_(file), lines_(file) {}

  PcdHeader parse() {
    std::string_view line;
    bool done = false;
    while (!done) {
      if (!lines_.next(line)) fail("the file ends before the line DATA");
      if (lines_.next_offset() > kMaxHeaderBytes) fail(concat("no line DATA in the first ", kMaxHeaderBytes, " bytes"));
      line = trimmed(line);
      if (line.empty() || line[0] == '#') continue;
      split_line(line, ' ', tokens_);
      done = parse_line();
    }
    finish();
    return std::move(header_);
  }

 private:
  static constexpr std::uint64_t kMaxHeaderBytes = 1 << 20;

  [[noreturn]] void fail(const std::string& what) const {
    throw Error(concat(file_.path().string(), ": line ", lines_.line(), " of the PCD header: ", what));
  }

  bool parse_line() {
    const std::string_view key = tokens_[0];
    if (key == "FIELDS" || key == "COLUMNS") {
      header_.fields.clear();
      for (std::size_t i = 1; i < tokens_.size(); ++i) header_.fields.push_back({std::string(tokens_[i]), 4, 1, 'F'});
    } else if (key == "SIZE") {
      for (std::size_t i = 0; i < values(); ++i) header_.fields[i].bytes = number(i + 1);
    } else if (key == "COUNT") {
      for (std::size_t i = 0; i < values(); ++i) header_.fields[i].count = number(i + 1);
    } else if (key == "TYPE") {
      for (std::size_t i = 0; i < values(); ++i) header_.fields[i].type = tokens_[i + 1].size() == 1 ? tokens_[i + 1][0] : '?';
    } else if (key == "WIDTH") {
      width_ = single();
    } else if (key == "HEIGHT") {
      height_ = single();
    } else if (key == "POINTS") {
      points_ = single();
    } else if (key == "DATA") {
      const std::string_view data = tokens_.size() == 2 ? tokens_[1] : std::string_view();
      if (data == "ascii")
        header_.data = PcdData::kAscii;
      else if (data == "binary")
        header_.data = PcdData::kBinary;
      else if (data == "binary_compressed")
        header_.data = PcdData::kCompressed;
      else
        fail("expected DATA ascii, binary or binary_compressed");
      return true;
    } else if (key != "VERSION" && key != "VIEWPOINT") {
      fail(concat("unknown keyword '", key.substr(0, 40),
                  "', expected VERSION, FIELDS, SIZE, TYPE, COUNT, WIDTH, HEIGHT, VIEWPOINT, POINTS or DATA"));
    }
    return false;
  }

  std::size_t values() const {
    if (tokens_.size() - 1 != header_.fields.size())
      fail(concat(tokens_[0], " has ", tokens_.size() - 1, " values for ", header_.fields.size(), " fields"));
    return header_.fields.size();
  }

  std::uint64_t number(std::size_t i) const {
    std::uint64_t value = 0;
    const std::string_view token = tokens_[i];
    const auto [end, code] = std::from_chars(token.data(), token.data() + token.size(), value);
    if (code != std::errc{} || end != token.data() + token.size() || value > (std::uint64_t{1} << 48))
      fail(concat("'", token.substr(0, 40), "' is not a count"));
    return value;
  }

  std::uint64_t single() const {
    if (tokens_.size() != 2) fail(concat("expected ", tokens_[0], " and one number"));
    return number(1);
  }

  void finish() {
    if (header_.fields.empty()) fail("no line FIELDS");
    if (!points_ && !width_) fail("neither POINTS nor WIDTH");
    const std::uint64_t height = height_.value_or(1);
    if (width_ && height != 0 && *width_ > (std::uint64_t{1} << 60) / height)
      fail(concat("WIDTH ", *width_, " and HEIGHT ", height, " are too large"));
    header_.points = points_ ? *points_ : *width_ * height;
    if (width_ && *width_ * height != header_.points)
      fail(concat("POINTS is ", header_.points, ", WIDTH times HEIGHT is ", *width_ * height));
    if (header_.points == 0) throw Error(concat(file_.path().string(), ": holds no points"));
    header_.offset = lines_.next_offset();
    header_.line = lines_.next_line();
  }

  const File& file_;
  LineReader lines_;
  PcdHeader header_;
  std::vector<std::string_view> tokens_;
  std::optional<std::uint64_t> width_, height_, points_;
};

ScalarType scalar_type(const File& file, const PcdField& field) {
  using enum ScalarType;
  const auto of = [&](std::initializer_list<std::pair<std::size_t, ScalarType>> known) -> std::optional<ScalarType> {
    for (const auto& [bytes, type] : known)
      if (bytes == field.bytes) return type;
    return std::nullopt;
  };
  std::optional<ScalarType> type;
  if (field.type == 'F') type = of({{4, kF32}, {8, kF64}});
  if (field.type == 'U') type = of({{1, kU8}, {2, kU16}, {4, kU32}, {8, kU64}});
  if (field.type == 'I') type = of({{1, kI8}, {2, kI16}, {4, kI32}, {8, kI64}});
  if (!type)
    throw Error(concat(file.path().string(), ": field '", field.name, "' has TYPE ", field.type, " and SIZE ", field.bytes,
                       ", expected F 4 8, U or I 1 2 4 8"));
  return *type;
}

// PCL packs a colour into one value: blue, green, red and alpha from the lowest byte.
bool is_packed_colour(const PcdField& field) {
  return (field.name == "rgb" || field.name == "rgba") && field.bytes == 4 && field.count == 1;
}

void add_fields(const PcdField& field, ScalarType type, std::size_t offset, RowLayout& layout) {
  const auto add = [&](const std::string& name, ScalarType t, std::size_t at) {
    RowField f;
    f.name = name;
    f.type = t;
    f.offset = at;
    layout.fields.push_back(std::move(f));
  };
  if (field.name == "_") return;  // padding
  if (is_packed_colour(field)) {
    add("red", ScalarType::kU8, offset + 2);
    add("green", ScalarType::kU8, offset + 1);
    add("blue", ScalarType::kU8, offset);
    if (field.name == "rgba") add("alpha", ScalarType::kU8, offset + 3);
    return;
  }
  for (std::size_t k = 0; k < field.count; ++k)
    add(field.count == 1 ? field.name : concat(field.name, "_", k), type, offset + k * scalar_bytes(type));
}

struct PcdLayout {
  RowLayout row;
  std::vector<TextColumn> columns;
};

PcdLayout packed_layout(const File& file, const PcdHeader& header) {
  constexpr std::size_t kMaxValues = 4096;
  PcdLayout layout;
  for (const PcdField& field : header.fields) {
    const ScalarType type = scalar_type(file, field);
    if (field.count == 0 || field.count > kMaxValues - layout.columns.size())
      throw Error(concat(file.path().string(), ": field '", field.name, "' has ", field.count, " values, expected 1 or more and at most ",
                         kMaxValues, " in all"));
    add_fields(field, type, layout.row.row_bytes, layout.row);
    for (std::size_t k = 0; k < field.count; ++k)
      layout.columns.push_back({field.name, type, layout.row.row_bytes + k * scalar_bytes(type)});
    layout.row.row_bytes += field.count * field.bytes;
  }
  return layout;
}

/// Points that PCL holds, decoded block by block.
class PclRowReader final : public PointReader {
 public:
  PclRowReader(PclCloud cloud, RowDecoder decoder) : cloud_(std::move(cloud)), decoder_(std::move(decoder)) {
    if (decoder_.needs_colour_samples()) {
      decoder_.sample_colours(cloud_.rows.data(), cloud_.num_points);
      decoder_.decide_colour_scale();
    }
  }
  const PointSchema& schema() const override { return decoder_.schema(); }
  bool read(PointBlock& block, std::size_t max_points) override {
    block.clear();
    const std::size_t count = std::min(max_points, cloud_.num_points - next_);
    decoder_.decode(cloud_.rows.data() + next_ * decoder_.layout().row_bytes, count, block);
    next_ += count;
    return count > 0;
  }

 private:
  PclCloud cloud_;
  RowDecoder decoder_;
  std::size_t next_ = 0;
};

// Sizes are compared before PCL sees the file: it allocates what the header says.
void check_compressed(const File& file, const PcdHeader& header, std::size_t row_bytes, std::uint64_t memory_bytes) {
  std::uint32_t sizes[2];
  file.read_at(header.offset, sizes, sizeof sizes);
  const std::uint64_t left = file.size() - header.offset - sizeof sizes;
  if (sizes[0] > left)
    throw Error(
        concat(file.path().string(), ": offset ", header.offset, ": ", sizes[0], " compressed bytes declared, the file holds ", left));
  std::uint64_t packed = 0;
  for (const PcdField& field : header.fields)
    if (field.name != "_") packed += field.bytes * field.count;
  if (header.points > (std::uint64_t{1} << 40) / row_bytes || sizes[1] != header.points * packed)
    throw Error(concat(file.path().string(), ": offset ", header.offset + 4, ": ", sizes[1], " bytes of points declared, expected ",
                       header.points, " points of ", packed, " bytes"));
  // LZF copies at most 264 bytes for 3 bytes of input.
  if (sizes[1] / 264 > sizes[0])
    throw Error(concat(file.path().string(), ": offset ", header.offset, ": ", sizes[0], " compressed bytes cannot give ", sizes[1]));
  const std::uint64_t needed = sizes[0] + 2 * header.points * row_bytes;
  if (needed > memory_bytes)
    throw Error(concat(file.path().string(), ": a compressed PCD is read whole and needs ", needed, " bytes, ", memory_bytes,
                       " are allowed; convert it to DATA binary"));
}

std::unique_ptr<PointReader> open_compressed(const File& file, const PcdHeader& header) {
  PclCloud cloud = pcl_read_pcd(file.path());
  if (cloud.num_points != header.points)
    throw Error(concat(file.path().string(), ": PCL read ", cloud.num_points, " points, the header declares ", header.points));
  RowLayout layout;
  layout.row_bytes = cloud.row_bytes;
  for (const PclCloud::Field& f : cloud.fields) {
    const PcdField field{f.name, f.bytes, f.count, f.type};
    const ScalarType type = scalar_type(file, field);
    if (f.count == 0 || f.offset + f.count * f.bytes > cloud.row_bytes)
      throw Error(concat(file.path().string(), ": field '", f.name, "' lies outside the point"));
    add_fields(field, type, f.offset, layout);
  }
  RowDecoder decoder(file.path(), std::move(layout), header.points);
  return std::make_unique<PclRowReader>(std::move(cloud), std::move(decoder));
}

}  // namespace

std::unique_ptr<PointReader> open_pcd(File file, std::uint64_t memory_bytes) {
  const PcdHeader header = PcdHeaderParser(file).parse();
  PcdLayout layout = packed_layout(file, header);
  if (header.data == PcdData::kCompressed) {
    RowDecoder check(file.path(), layout.row, header.points);  // the same complaints as for the other encodings, before PCL is needed
    check_compressed(file, header, layout.row.row_bytes, memory_bytes);
    return open_compressed(file, header);
  }
  RowDecoder decoder(file.path(), std::move(layout.row), header.points);
  if (header.data == PcdData::kBinary) return read_fixed_rows(std::move(file), std::move(decoder), {header.offset, header.points, false});
  TextRows rows;
  rows.columns = std::move(layout.columns);
  rows.offset = header.offset;
  rows.line = header.line;
  rows.count = header.points;
  return read_text_rows(std::move(file), std::move(decoder), std::move(rows));
}

}  // namespace chiaro::stream
