// PCD 0.7, binary, with PCL's names: 8-bit colour packed into `rgb`, normals as normal_x normal_y normal_z.
#include <cstring>

#include "stream/base/error.h"
#include "stream/cloud/formats.h"
#include "stream/cloud/row_writer.h"
#include "stream/cloud/scalars.h"

namespace chiaro::stream {
namespace {

class PcdWriter final : public RowWriter {
 public:
  PcdWriter(const std::filesystem::path& path, const PointWriterOptions& options) : RowWriter(path, options) {
    plan();
    const std::string header = make_header();
    file_.file().reserve(header.size() + options_.num_points * out_bytes_);
    file_.append(header);
  }

 private:
  struct Field {
    std::string name;
    ScalarType type = ScalarType::kF32;
    std::size_t from = 0;
    bool packed_colour = false;
  };

  void plan() {
    std::size_t offset = 0;
    for (std::size_t k = 0; k < 3; ++k) {
      const char* const names[] = {"red", "green", "blue"};
      const auto slot = find_property(options_.properties, names[k]);
      pack_colour_ &= slot && slot->type == ScalarType::kU8;
      if (slot) colour_at_[k] = slot->offset;
    }
    for (const PointProperty& property : options_.properties) {
      const bool is_colour = pack_colour_ && (property.name == "red" || property.name == "green" || property.name == "blue");
      if (!is_colour) fields_.push_back({pcl_name(property.name), property.type, offset, false});
      if (is_colour && property.name == "red") fields_.push_back({"rgb", ScalarType::kF32, offset, true});
      offset += scalar_bytes(property.type);
    }
    for (const Field& field : fields_) out_bytes_ += scalar_bytes(field.type);
  }

  static std::string pcl_name(const std::string& name) {
    return name == "nx" || name == "ny" || name == "nz" ? concat("normal_", name[1]) : name;
  }

  static char type_letter(ScalarType type) {
    if (is_float(type)) return 'F';
    return type == ScalarType::kI8 || type == ScalarType::kI16 || type == ScalarType::kI32 || type == ScalarType::kI64 ? 'I' : 'U';
  }

  std::string make_header() const {
    std::string names = "FIELDS", sizes = "SIZE", types = "TYPE", counts = "COUNT", comments;
    for (const Field& field : fields_) {
      names += " " + field.name;
      sizes += concat(" ", scalar_bytes(field.type));
      types += concat(" ", type_letter(field.type));
      counts += " 1";
    }
    for (const std::string& comment : options_.comments) comments += concat("# ", one_line(comment), "\n");
    const std::uint64_t n = options_.num_points;
    return concat("# .PCD v0.7 - Point Cloud Data file format\n", comments, "VERSION 0.7\n", names, "\n", sizes, "\n", types, "\n", counts,
                  "\nWIDTH ", n, "\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS ", n, "\nDATA binary\n");
  }

  void write_rows(const std::byte* rows, std::size_t count) override {
    buffer_.resize(out_bytes_);
    for (std::size_t i = 0; i < count; ++i, rows += row_bytes_) {
      std::byte* to = buffer_.data();
      for (const Field& field : fields_) {
        if (field.packed_colour) {
          for (std::size_t k = 0; k < 3; ++k) to[k] = rows[colour_at_[2 - k]];
          to[3] = std::byte{0};
        } else {
          std::memcpy(to, rows + field.from, scalar_bytes(field.type));
        }
        to += scalar_bytes(field.type);
      }
      file_.append(buffer_.data(), buffer_.size());
    }
  }

  std::vector<Field> fields_;
  bool pack_colour_ = true;
  std::array<std::size_t, 3> colour_at_{};
  std::size_t out_bytes_ = 0;
  std::vector<std::byte> buffer_;
};

}  // namespace

std::unique_ptr<PointWriter> create_pcd(const std::filesystem::path& path, const PointWriterOptions& options) {
  return std::make_unique<PcdWriter>(path, options);
}

}  // namespace chiaro::stream
