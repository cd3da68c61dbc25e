// PLY, binary little-endian, properties exactly as given.
#include "stream/base/error.h"
#include "stream/cloud/formats.h"
#include "stream/cloud/row_writer.h"
#include "stream/cloud/scalars.h"

namespace chiaro::stream {
namespace {

class PlyWriter final : public RowWriter {
 public:
  PlyWriter(const std::filesystem::path& path, const PointWriterOptions& options) : RowWriter(path, options) {
    std::string header = "ply\nformat binary_little_endian 1.0\n";
    for (const std::string& comment : options_.comments) header += concat("comment ", one_line(comment), "\n");
    header += concat("element vertex ", options_.num_points, "\n");
    for (const PointProperty& property : options_.properties) {
      if (property.type == ScalarType::kI64 || property.type == ScalarType::kU64)
        throw Error(concat(path.string(), ": PLY has no 64-bit integers, which property '", property.name, "' needs"));
      header += concat("property ", scalar_name(property.type), " ", property.name, "\n");
    }
    header += "end_header\n";
    file_.file().reserve(header.size() + options_.num_points * row_bytes_);
    file_.append(header);
  }

 private:
  void write_rows(const std::byte* rows, std::size_t count) override { file_.append(rows, count * row_bytes_); }
};

}  // namespace

std::unique_ptr<PointWriter> create_ply(const std::filesystem::path& path, const PointWriterOptions& options) {
  return std::make_unique<PlyWriter>(path, options);
}

}  // namespace chiaro::stream
