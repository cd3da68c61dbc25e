// PLY as G. Turk's format description has it, with the type names that later programs added (float32, uint8, ...).
#include <algorithm>
#include <bit>
#include <charconv>
#include <cstring>
#include <limits>

#include "stream/base/error.h"
#include "stream/cloud/formats.h"
#include "stream/cloud/ply_list_rows.h"
#include "stream/cloud/row_decoder.h"
#include "stream/cloud/row_readers.h"
#include "stream/cloud/scalars.h"

namespace chiaro::stream {
namespace {

static_assert(std::endian::native == std::endian::little, "rows are read as little-endian");

enum class Encoding { kAscii, kLittle, kBig };

struct PlyProperty {
  std::string name;
  ScalarType type = ScalarType::kF32;
  bool is_list = false;
  ScalarType count_type = ScalarType::kU8;
};

struct PlyElement {
  std::string name;
  std::uint64_t count = 0;
  std::vector<PlyProperty> properties;
};

struct PlyHeader {
  Encoding encoding = Encoding::kAscii;
  std::vector<PlyElement> elements;
  std::uint64_t end_offset = 0, end_line = 0;  // of the first byte after the header
};

[[noreturn]] void fail(const File& file, std::uint64_t line, const std::string& what) {
  throw Error(concat(file.path().string(), ": line ", line, " of the PLY header: ", what));
}

std::optional<ScalarType> ply_type(std::string_view name) {
  using enum ScalarType;
  constexpr std::pair<std::string_view, ScalarType> kTypes[] = {
      {"char", kI8},   {"uchar", kU8},   {"short", kI16},   {"ushort", kU16},  {"int", kI32},   {"uint", kU32},
      {"float", kF32}, {"double", kF64}, {"int8", kI8},     {"uint8", kU8},    {"int16", kI16}, {"uint16", kU16},
      {"int32", kI32}, {"uint32", kU32}, {"float32", kF32}, {"float64", kF64}, {"int64", kI64}, {"uint64", kU64}};
  for (const auto& [known, type] : kTypes)
    if (known == name) return type;
  return std::nullopt;
}

class HeaderParser {
 public:
  explicit HeaderParser(const File& file) : file_(file), lines_(file) {}

  PlyHeader parse() {
    std::string_view line;
    if (!lines_.next(line) || trimmed(line) != "ply") fail(file_, 1, "expected 'ply'");
    for (;;) {
      if (!lines_.next(line)) fail(file_, lines_.line(), "the file ends before 'end_header'");
      if (lines_.next_offset() > kMaxHeaderBytes)
        fail(file_, lines_.line(), concat("no 'end_header' in the first ", kMaxHeaderBytes, " bytes"));
      split_line(line, ' ', tokens_);
      if (tokens_.empty() || tokens_[0] == "comment" || tokens_[0] == "obj_info") continue;
      if (tokens_[0] == "end_header") break;
      parse_line();
    }
    if (!has_format_) fail(file_, lines_.line(), "no 'format' line");
    header_.end_offset = lines_.next_offset();
    header_.end_line = lines_.next_line();
    return std::move(header_);
  }

 private:
  static constexpr std::uint64_t kMaxHeaderBytes = 1 << 20;

  void parse_line() {
    if (tokens_[0] == "format") return parse_format();
    if (tokens_[0] == "element") return parse_element();
    if (tokens_[0] == "property") return parse_property();
    fail(file_, lines_.line(),
         concat("unknown keyword '", tokens_[0].substr(0, 40), "', expected format, element, property, comment, obj_info or end_header"));
  }

  void parse_format() {
    if (tokens_.size() != 3 || tokens_[2] != "1.0") fail(file_, lines_.line(), "expected 'format ENCODING 1.0'");
    if (tokens_[1] == "ascii")
      header_.encoding = Encoding::kAscii;
    else if (tokens_[1] == "binary_little_endian")
      header_.encoding = Encoding::kLittle;
    else if (tokens_[1] == "binary_big_endian")
      header_.encoding = Encoding::kBig;
    else
      fail(file_, lines_.line(),
           concat("encoding '", tokens_[1].substr(0, 40), "', expected ascii, binary_little_endian or binary_big_endian"));
    has_format_ = true;
  }

  void parse_element() {
    if (tokens_.size() != 3) fail(file_, lines_.line(), "expected 'element NAME COUNT'");
    PlyElement element{std::string(tokens_[1]), 0, {}};
    const std::string_view count = tokens_[2];
    const auto [end, code] = std::from_chars(count.data(), count.data() + count.size(), element.count);
    if (code != std::errc{} || end != count.data() + count.size() || element.count > (std::uint64_t{1} << 62))
      fail(file_, lines_.line(), concat("'", count.substr(0, 40), "' is not a count"));
    for (const PlyElement& other : header_.elements)
      if (other.name == element.name) fail(file_, lines_.line(), concat("element '", element.name, "' is declared twice"));
    header_.elements.push_back(std::move(element));
  }

  void parse_property() {
    if (header_.elements.empty()) fail(file_, lines_.line(), "a property before the first element");
    PlyProperty property;
    property.is_list = tokens_.size() > 1 && tokens_[1] == "list";
    if (tokens_.size() != (property.is_list ? 5u : 3u))
      fail(file_, lines_.line(), "expected 'property TYPE NAME' or 'property list TYPE TYPE NAME'");
    property.type = type_of(tokens_[property.is_list ? 3 : 1]);
    if (property.is_list) property.count_type = type_of(tokens_[2]);
    if (property.is_list && is_float(property.count_type)) fail(file_, lines_.line(), "the length of a list has a floating point type");
    property.name = tokens_.back();
    header_.elements.back().properties.push_back(std::move(property));
  }

  ScalarType type_of(std::string_view name) const {
    const std::optional<ScalarType> type = ply_type(name);
    if (!type) fail(file_, lines_.line(), concat("unknown type '", name.substr(0, 40), "'"));
    return *type;
  }

  const File& file_;
  LineReader lines_;
  PlyHeader header_;
  bool has_format_ = false;
  std::vector<std::string_view> tokens_;
};

/// Where the element after `element` starts, in a binary file.
class ElementSkipper {
 public:
  ElementSkipper(const File& file, bool swap_bytes) : file_(file), size_(file.size()), swap_bytes_(swap_bytes) {}

  std::uint64_t skip(const PlyElement& element, std::uint64_t offset) {
    bool has_list = false;
    std::uint64_t row_bytes = 0;
    for (const PlyProperty& property : element.properties) {
      has_list |= property.is_list;
      row_bytes += scalar_bytes(property.is_list ? property.count_type : property.type);
    }
    if (row_bytes == 0) return offset;
    if (offset > size_ || element.count > (size_ - offset) / row_bytes)
      throw Error(concat(file_.path().string(), ": the header declares ", element.count, " of element '", element.name,
                         "', which do not fit the ", size_, " bytes of the file"));
    if (!has_list) return offset + element.count * row_bytes;
    for (std::uint64_t i = 0; i < element.count; ++i)
      for (const PlyProperty& property : element.properties) offset += property_bytes(element, property, offset);
    return offset;
  }

 private:
  std::uint64_t property_bytes(const PlyElement& element, const PlyProperty& property, std::uint64_t offset) {
    if (!property.is_list) return scalar_bytes(property.type);
    const std::size_t count_bytes = scalar_bytes(property.count_type);
    std::byte bytes[8];
    load(offset, bytes, count_bytes);
    if (swap_bytes_) std::reverse(bytes, bytes + count_bytes);
    const double count = load_scalar(property.count_type, bytes);
    if (count < 0 || count * static_cast<double>(scalar_bytes(property.type)) > static_cast<double>(size_ - offset))
      throw Error(concat(file_.path().string(), ": offset ", offset, ": list '", property.name, "' of element '", element.name, "' has ",
                         count, " entries, the file has ", size_, " bytes"));
    return count_bytes + static_cast<std::uint64_t>(count) * scalar_bytes(property.type);
  }

  void load(std::uint64_t offset, std::byte* out, std::size_t bytes) {
    if (offset < window_offset_ || offset + bytes > window_offset_ + window_.size()) {
      window_.resize(1 << 20);
      window_.resize(file_.read_some_at(offset, window_.data(), window_.size()));
      window_offset_ = offset;
      if (window_.size() < bytes) throw Error(concat(file_.path().string(), ": the file ends early at offset ", offset));
    }
    std::memcpy(out, window_.data() + (offset - window_offset_), bytes);
  }

  const File& file_;
  std::uint64_t size_;
  bool swap_bytes_;
  std::vector<std::byte> window_;
  std::uint64_t window_offset_ = 0;
};

const PlyProperty* first_list(const PlyElement& element) {
  const auto list = std::find_if(element.properties.begin(), element.properties.end(), [](const PlyProperty& p) { return p.is_list; });
  return list == element.properties.end() ? nullptr : &*list;
}

/// Of the properties that are no lists.
RowLayout vertex_layout(const PlyElement& vertex) {
  RowLayout layout;
  for (const PlyProperty& property : vertex.properties) {
    if (property.is_list) continue;
    RowField field;
    field.name = property.name;
    field.type = property.type;
    field.offset = layout.row_bytes;
    layout.row_bytes += scalar_bytes(property.type);
    layout.fields.push_back(std::move(field));
  }
  return layout;
}

std::unique_ptr<PointReader> open_ascii(File file, const PlyHeader& header, std::size_t vertex_idx, RowDecoder decoder) {
  LineReader lines(file, header.end_offset, header.end_line);
  std::string_view line;
  for (std::size_t e = 0; e < vertex_idx; ++e) {
    const PlyElement& element = header.elements[e];
    for (std::uint64_t i = 0; !element.properties.empty() && i < element.count; ++i) {
      do {
        if (!lines.next(line))
          throw Error(
              concat(file.path().string(), ": ", i, " of ", element.count, " lines of element '", element.name, "', the file ends early"));
      } while (trimmed(line).empty());
    }
  }
  TextRows rows;
  for (const RowField& field : decoder.layout().fields) rows.columns.push_back({field.name, field.type, field.offset});
  rows.offset = lines.next_offset();
  rows.line = lines.next_line();
  rows.count = header.elements[vertex_idx].count;
  return read_text_rows(std::move(file), std::move(decoder), std::move(rows));
}

}  // namespace

std::unique_ptr<PointReader> open_ply(File file) {
  const PlyHeader header = HeaderParser(file).parse();
  std::size_t vertex_idx = 0;
  while (vertex_idx < header.elements.size() && header.elements[vertex_idx].name != "vertex") ++vertex_idx;
  if (vertex_idx == header.elements.size()) throw Error(concat(file.path().string(), ": the PLY header declares no element 'vertex'"));
  const PlyElement& vertex = header.elements[vertex_idx];
  if (vertex.count == 0) throw Error(concat(file.path().string(), ": holds no points"));
  RowDecoder decoder(file.path(), vertex_layout(vertex), vertex.count);
  const PlyProperty* list = first_list(vertex);
  if (list && header.encoding == Encoding::kAscii)
    throw Error(concat(file.path().string(), ": the list '", list->name, "' inside the element 'vertex' is not supported in ASCII; save the file as binary PLY"));
  if (header.encoding == Encoding::kAscii) return open_ascii(std::move(file), header, vertex_idx, std::move(decoder));

  FixedRows rows;
  rows.swap_bytes = header.encoding == Encoding::kBig;
  rows.offset = header.end_offset;
  rows.count = vertex.count;
  ElementSkipper skipper(file, rows.swap_bytes);
  for (std::size_t e = 0; e < vertex_idx; ++e) rows.offset = skipper.skip(header.elements[e], rows.offset);
  if (!list) return read_fixed_rows(std::move(file), std::move(decoder), rows);
  ListRows list_rows;
  list_rows.offset = rows.offset;
  list_rows.count = rows.count;
  list_rows.swap_bytes = rows.swap_bytes;
  for (const PlyProperty& property : vertex.properties) list_rows.columns.push_back({property.name, property.type, property.is_list, property.count_type});
  return read_list_rows(std::move(file), std::move(decoder), std::move(list_rows));
}

}  // namespace chiaro::stream
