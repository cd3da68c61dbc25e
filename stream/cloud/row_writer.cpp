#include "stream/cloud/row_writer.h"

#include <set>

#include "stream/base/error.h"

namespace chiaro::stream {

std::size_t row_bytes_of(const std::vector<PointProperty>& properties) {
  std::size_t bytes = 0;
  for (const PointProperty& property : properties) bytes += scalar_bytes(property.type);
  return bytes;
}

std::optional<RowSlot> find_property(const std::vector<PointProperty>& properties, std::string_view name) {
  RowSlot slot;
  for (const PointProperty& property : properties) {
    slot.type = property.type;
    if (property.name == name) return slot;
    ++slot.index;
    slot.offset += scalar_bytes(property.type);
  }
  return std::nullopt;
}

RowWriter::RowWriter(const std::filesystem::path& path, const PointWriterOptions& options)
    : options_(options), row_bytes_(row_bytes_of(options.properties)), file_(path) {
  std::set<std::string> names;
  for (const PointProperty& property : options_.properties) {
    bool valid = !property.name.empty();
    for (const char c : property.name) valid &= c > ' ' && c < 127;
    if (!valid)
      throw Error(concat(path.string(), ": '", one_line(property.name),
                         "' cannot be a property name, expected printable characters without blanks"));
    if (!names.insert(property.name).second) throw Error(concat(path.string(), ": property '", property.name, "' is given twice"));
  }
  for (const char* axis : {"x", "y", "z"})
    if (!names.count(axis)) throw Error(concat(path.string(), ": no property '", axis, "' to write"));
}

void RowWriter::write(const std::byte* rows, std::size_t count) {
  if (count > options_.num_points - written_)
    throw Error(concat(file_.file().path().string(), ": ", written_ + count, " points to write, ", options_.num_points, " were announced"));
  write_rows(rows, count);
  written_ += count;
}

void RowWriter::commit() {
  if (written_ != options_.num_points)
    throw Error(concat(file_.file().path().string(), ": ", written_, " points written, ", options_.num_points, " were announced"));
  finish();
  file_.commit();
}

std::string one_line(const std::string& text) {
  std::string line = text;
  for (char& c : line)
    if (static_cast<unsigned char>(c) < ' ' || c == 127) c = ' ';
  return line;
}

}  // namespace chiaro::stream
