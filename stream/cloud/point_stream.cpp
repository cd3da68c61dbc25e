#include "stream/cloud/point_stream.h"

#include <algorithm>
#include <bit>

#include "stream/base/error.h"
#include "stream/base/file.h"
#include "stream/base/text.h"
#include "stream/cloud/formats.h"
#include "stream/cloud/laz_rows.h"

namespace chiaro::stream {
namespace {

namespace fs = std::filesystem;

constexpr const char* kFormats = "PLY, LAS and LAZ 1.2 to 1.4, E57, PCD, XYZ/TXT/ASC/CSV, PTS and PTX are read";

std::string head_of(const File& file) {
  std::string head(64, '\0');
  head.resize(file.read_some_at(0, head.data(), head.size()));
  return head;
}

bool looks_like_pcd(const std::string& head) {
  return head.starts_with("# .PCD") || head.starts_with("#.PCD") || head.starts_with("VERSION ") || head.starts_with("FIELDS ");
}

bool looks_like_ply(const std::string& head) {
  return head.starts_with("ply") && head.size() > 3 && (head[3] == '\n' || head[3] == '\r' || head[3] == ' ');
}

std::unique_ptr<PointReader> open_by_content(File file, std::uint64_t memory_bytes) {
  const fs::path path = file.path();
  const std::string extension = lower_extension(path), head = head_of(file);
  const auto refuse = [&](const char* why) -> Error { return Error(concat(path.string(), ": ", why, "; ", kFormats)); };
  if (head.empty()) throw refuse("the file is empty");
  if (looks_like_ply(head)) return open_ply(std::move(file));
  if (head.starts_with("LASF")) return open_las(std::move(file), memory_bytes);
  if (head.starts_with("ASTM-E57")) return open_e57(std::move(file));
  if (looks_like_pcd(head) || extension == ".pcd") return open_pcd(std::move(file), memory_bytes);
  if (extension == ".ply") throw refuse("byte 0: expected 'ply' on a line of its own, this is not a PLY file");
  if (extension == ".las" || extension == ".laz") throw refuse("byte 0: expected 'LASF', this is not a LAS file");
  if (extension == ".e57") throw refuse("byte 0: expected 'ASTM-E57', this is not an E57 file");
  if (extension == ".ptx") return open_ptx(std::move(file));
  for (const char* text : {".xyz", ".txt", ".asc", ".csv", ".pts", ".xyzrgb", ".xyzn"})
    if (extension == text) return open_text(std::move(file), extension == ".pts");
  throw refuse("unknown point cloud format");
}

}  // namespace

std::size_t scalar_bytes(ScalarType type) {
  switch (type) {
    case ScalarType::kI8:
    case ScalarType::kU8:
      return 1;
    case ScalarType::kI16:
    case ScalarType::kU16:
      return 2;
    case ScalarType::kI32:
    case ScalarType::kU32:
    case ScalarType::kF32:
      return 4;
    default:
      return 8;
  }
}

std::size_t PointSchema::extra_bytes() const {
  std::size_t bytes = 0;
  for (const PointProperty& extra : extras) bytes += scalar_bytes(extra.type);
  return bytes;
}

void PointBlock::clear() {
  position.clear();
  normal.clear();
  colour.clear();
  extras.clear();
}

namespace {
constexpr std::uint64_t kNoPositionBits = 0x7ff8'c41a'0000'0001;  // a quiet NaN
}

Vec3d no_position() { return Vec3d::Constant(std::bit_cast<double>(kNoPositionBits)); }

const char* why_unusable(const Vec3d& position) {
  if (position.allFinite()) return nullptr;
  // Moved points keep the bits: arithmetic with a NaN gives that NaN, whose sign alone is free.
  constexpr std::uint64_t kSign = std::uint64_t{1} << 63;
  for (const double value : position)
    if ((std::bit_cast<std::uint64_t>(value) & ~kSign) != kNoPositionBits) return "not finite";
  return "invalid in the scan";
}

std::unique_ptr<PointReader> open_points(const fs::path& path, std::uint64_t memory_bytes) {
  std::error_code code;
  // A pipe would block, and sizes are checked against the file's.
  if (fs::exists(path, code) && !fs::is_directory(path, code) && !fs::is_regular_file(path, code))
    throw Error(concat(path.string(), ": not a regular file"));
  return open_by_content(File(path, File::Mode::kRead), memory_bytes);
}

Error missing_rust_formats(const fs::path& path, const std::string& format) {
  return Error(concat(path.string(), ": ", format, " is not read by this build of chiaro, which was made without cargo. Install cargo and rustc ",
                      "(on Debian 12: apt-get install cargo-web rustc-web, or bash tools/setup.sh), configure and build again"));
}

std::unique_ptr<PointWriter> create_points(const fs::path& path, const PointWriterOptions& options) {
  const std::string extension = lower_extension(path);
  if (extension == ".ply") return create_ply(path, options);
  if (extension == ".las") return create_las(path, options);
  if (extension == ".pcd") return create_pcd(path, options);
  throw Error(concat(path.string(), ": cannot write '", extension, "', point clouds are written as .ply, .las or .pcd"));
}

}  // namespace chiaro::stream
