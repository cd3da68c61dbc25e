#include "tools/npy_reader.h"

#include <algorithm>
#include <bit>
#include <charconv>
#include <cstring>
#include <string>

#include "stream/base/error.h"

namespace chiaro::tools {
namespace {

/// Text after 'key': in the header's dictionary.
std::string_view value_of(std::string_view header, std::string_view key) {
  const std::size_t at = header.find(concat("'", key, "':"));
  if (at == std::string_view::npos) return {};
  std::string_view rest = header.substr(at + key.size() + 3);
  return rest.substr(std::min(rest.find_first_not_of(' '), rest.size()));
}

}  // namespace

NpyReader::NpyReader(const std::filesystem::path& path) : file_(path, File::Mode::kRead) {
  static_assert(std::endian::native == std::endian::little);
  const auto fail = [&](const std::string& text) -> void { throw Error(concat(path.string(), ": ", text)); };
  unsigned char start[12] = {};
  const std::size_t got = file_.read_some_at(0, start, sizeof start);
  if (got < sizeof start || std::memcmp(start, "\x93NUMPY", 6) != 0) fail("no NumPy array");
  const int version = start[6];
  if (version < 1 || version > 3) fail(concat("NumPy format version ", version, ", expected 1 to 3"));
  std::uint64_t length = start[8] | start[9] << 8;
  if (version > 1) length |= static_cast<std::uint64_t>(start[10]) << 16 | static_cast<std::uint64_t>(start[11]) << 24;
  const std::uint64_t header_offset = version == 1 ? 10 : 12;
  if (length > 65536 || header_offset + length > file_.size()) fail(concat("the header would have ", length, " bytes"));
  std::string header(length, ' ');
  file_.read_at(header_offset, header.data(), header.size());

  const std::string_view type = value_of(header, "descr");
  scalar_bytes_ = type.starts_with("'<f2'") ? 2 : type.starts_with("'<f4'") ? 4 : type.starts_with("'<f8'") ? 8 : 0;
  if (!scalar_bytes_) fail(concat("values of type ", type.substr(0, std::min<std::size_t>(type.find(','), 20)), ", expected '<f2', '<f4' or '<f8'"));
  if (!value_of(header, "fortran_order").starts_with("False")) fail("expected an array in C order");
  const std::string_view shape = value_of(header, "shape");
  std::uint64_t columns = 0;
  const char* end = shape.data() + shape.size();
  bool ok = shape.starts_with("(");
  if (ok) {
    const auto first = std::from_chars(shape.data() + 1, end, rows_);
    ok = first.ec == std::errc() && end - first.ptr > 2 && first.ptr[0] == ',' && first.ptr[1] == ' ';
    if (ok) {
      const auto second = std::from_chars(first.ptr + 2, end, columns);
      ok = second.ec == std::errc() && second.ptr < end && *second.ptr == ')';
    }
  }
  if (!ok || columns != 3) fail("expected an array of shape (N, 3)");
  data_offset_ = header_offset + length;
  const std::uint64_t row_bytes = 3 * static_cast<std::uint64_t>(scalar_bytes_);
  if (rows_ > (file_.size() - data_offset_) / row_bytes)
    fail(concat((file_.size() - data_offset_) / row_bytes, " of ", rows_, " rows read, file ends early"));
}

std::vector<Vec3f> NpyReader::read(std::size_t max_rows) {
  const std::size_t count = static_cast<std::size_t>(std::min<std::uint64_t>(max_rows, rows_ - next_));
  const std::size_t scalar = static_cast<std::size_t>(scalar_bytes_);
  std::vector<std::byte> bytes(count * 3 * scalar);
  if (count) file_.read_at(data_offset_ + next_ * 3 * scalar, bytes.data(), bytes.size());
  std::vector<Vec3f> rows(count);
  for (std::size_t i = 0; i < count * 3; ++i) {
    float& to = rows[i / 3][static_cast<Eigen::Index>(i % 3)];
    const std::byte* from = bytes.data() + i * scalar;
    if (scalar == 2) {
      Eigen::half value;
      std::memcpy(&value, from, 2);
      to = static_cast<float>(value);
    } else if (scalar == 4) {
      std::memcpy(&to, from, 4);
    } else {
      double value = 0;
      std::memcpy(&value, from, 8);
      to = static_cast<float>(value);
    }
  }
  next_ += count;
  return rows;
}

}  // namespace chiaro::tools
