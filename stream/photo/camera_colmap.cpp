// COLMAP text and binary models. source: colmap/colmap doc/format.rst, src/colmap/scene/reconstruction_io_*.cc, src/colmap/sensor/models.h (facts only).
#include <algorithm>
#include <bit>
#include <cstring>
#include <map>
#include <unordered_map>
#include <unordered_set>

#include "stream/base/error.h"
#include "stream/base/file.h"
#include "stream/photo/camera_files.h"
#include "stream/photo/camera_files_detail.h"

namespace chiaro::stream {
namespace fs = std::filesystem;
namespace {

static_assert(std::endian::native == std::endian::little, "COLMAP files are little-endian");

struct Model {
  int id;
  const char* name;
  std::size_t num_params;
};
constexpr Model kModels[] = {{0, "SIMPLE_PINHOLE", 3}, {1, "PINHOLE", 4},         {2, "SIMPLE_RADIAL", 4},         {3, "RADIAL", 5},        {4, "OPENCV", 8},
                             {5, "OPENCV_FISHEYE", 8}, {6, "FULL_OPENCV", 12},    {8, "SIMPLE_RADIAL_FISHEYE", 4}, {9, "RADIAL_FISHEYE", 5},
                             {14, "SIMPLE_FISHEYE", 3}, {15, "FISHEYE", 4}};
constexpr const char* kSupported = "SIMPLE_PINHOLE, PINHOLE, SIMPLE_RADIAL, RADIAL, OPENCV, FULL_OPENCV, OPENCV_FISHEYE, SIMPLE_RADIAL_FISHEYE, RADIAL_FISHEYE, SIMPLE_FISHEYE, FISHEYE";

const char* refused_name(int id) {
  switch (id) {
    case 7: return "FOV";
    case 10: return "THIN_PRISM_FISHEYE";
    case 11: return "RAD_TAN_THIN_PRISM_FISHEYE";
    case 12: return "SIMPLE_DIVISION";
    case 13: return "DIVISION";
    case 16: return "EUCM";
    case 17: return "EQUIRECTANGULAR";
    default: return "unknown";
  }
}

const Model* model_by_name(std::string_view name) {
  for (const Model& model : kModels)
    if (name == model.name) return &model;
  return nullptr;
}
const Model* model_by_id(int id) {
  for (const Model& model : kModels)
    if (id == model.id) return &model;
  return nullptr;
}

int checked_side(std::uint64_t value, const std::string& where) {
  if (value == 0 || value > (1u << 20)) throw Error(concat(where, ": image side of ", value, " pixels, expected 1 to ", 1u << 20));
  return static_cast<int>(value);
}

/// Lines of any length in bounded memory: kept ones are limited, others are only passed over.
class Lines {
 public:
  explicit Lines(const fs::path& path) : file_(path, File::Mode::kRead), buffer_(1 << 16) {}

  /// False at the end of the file. A line that starts with '#' comes back empty.
  bool next(std::string& line) {
    line.clear();
    bool any = false;
    for (int c = get(); c >= 0; c = get()) {
      any = true;
      if (c == '\n') break;
      if (line.size() >= kMaxLine) throw Error(concat(where(number_ + 1), ": line is longer than ", kMaxLine, " bytes"));
      line.push_back(static_cast<char>(c));
    }
    if (!any) return false;
    if (++number_ == 1 && line.starts_with("\xef\xbb\xbf")) line.erase(0, 3);  // byte order mark of UTF-8, as editors add it
    if (!line.empty() && line.back() == '\r') line.pop_back();
    if (!line.empty() && line.front() == '#') line.clear();
    return true;
  }

  struct Skipped {
    std::uint64_t words = 0;
    bool numeric = true;  ///< holds no character that stands in no number
  };
  /// Passes over a line.
  Skipped skip() {
    Skipped line;
    bool in_word = false, any = false;
    for (int c = get(); c >= 0; c = get()) {
      any = true;
      if (c == '\n') break;
      const bool blank = c == ' ' || c == '\t' || c == '\r';
      line.words += !blank && !in_word;
      line.numeric = line.numeric && (blank || std::strchr("0123456789+-.eEnaif", c) != nullptr);
      in_word = !blank;
    }
    number_ += any;
    return line;
  }

  std::string where() const { return where(number_); }
  std::string where(std::uint64_t number) const { return concat(file_.path().string(), ": line ", number); }

 private:
  static constexpr std::size_t kMaxLine = 1 << 16;
  int get() {
    if (at_ == filled_) {
      filled_ = file_.read_some_at(offset_, buffer_.data(), buffer_.size());
      offset_ += filled_;
      at_ = 0;
      if (filled_ == 0) return -1;
    }
    return static_cast<unsigned char>(buffer_[at_++]);
  }
  File file_;
  std::vector<char> buffer_;
  std::size_t at_ = 0, filled_ = 0;
  std::uint64_t offset_ = 0, number_ = 0;
};

/// Forward reading of a binary file; every read is checked against the size.
class Bytes {
 public:
  explicit Bytes(const fs::path& path) : file_(path, File::Mode::kRead), size_(file_.size()), buffer_(1 << 16) {}
  template <class T>
  T get() {
    T value;
    read(&value, sizeof value);
    return value;
  }
  void read(void* data, std::size_t bytes) {
    if (bytes > left()) throw Error(concat(where(), ": file ends early: ", left(), " of ", bytes, " bytes left"));
    char* out = static_cast<char*>(data);
    while (bytes > 0) {
      if (at_ == filled_) {
        filled_ = file_.read_some_at(offset_, buffer_.data(), buffer_.size());
        if (filled_ == 0) throw Error(concat(where(), ": file ends early"));
        at_ = 0;
      }
      const std::size_t n = std::min(bytes, filled_ - at_);
      std::memcpy(out, buffer_.data() + at_, n);
      out += n;
      at_ += n;
      offset_ += n;
      bytes -= n;
    }
  }
  void skip(std::uint64_t bytes) {
    if (bytes > left()) throw Error(concat(where(), ": ", bytes, " bytes expected, ", left(), " left"));
    offset_ += bytes;
    if (bytes <= filled_ - at_)
      at_ += bytes;
    else
      at_ = filled_ = 0;
  }
  std::uint64_t left() const { return size_ - offset_; }
  std::string where() const { return concat(file_.path().string(), ": offset ", offset_); }
  /// A record count at the head of the file, checked against the bytes that follow it.
  std::uint64_t count(std::uint64_t least_record_bytes, const char* what) {
    const std::string here = where();
    const std::uint64_t n = get<std::uint64_t>();
    if (n > left() / least_record_bytes) throw Error(concat(here, ": ", n, " ", what, " claimed, ", left(), " bytes left"));
    return n;
  }

 private:
  File file_;
  std::uint64_t size_ = 0, offset_ = 0;
  std::vector<char> buffer_;
  std::size_t at_ = 0, filled_ = 0;
};

using Lenses = std::unordered_map<std::uint32_t, Lens>;

void add_lens(Lenses& lenses, std::uint32_t id, const Lens& lens, const std::string& where) {
  if (!lenses.emplace(id, lens).second) throw Error(concat(where, ": camera ", id, " is given twice"));
}

struct ImageRecord {
  std::array<double, 4> quaternion_wxyz{};
  Vec3d translation = Vec3d::Zero();
  std::uint32_t camera_id = 0;
  std::string name;
};

class Collector {
 public:
  explicit Collector(Lenses lenses) : lenses_(std::move(lenses)) {}
  void add(const ImageRecord& record, const std::string& where) {
    if (record.name.empty()) throw Error(concat(where, ": image without a name"));
    const auto lens = lenses_.find(record.camera_id);
    if (lens == lenses_.end()) throw Error(concat(where, ": image \"", record.name, "\" uses camera ", record.camera_id, ", which is not in the cameras file"));
    if (!names_.insert(record.name).second) throw Error(concat(where, ": image \"", record.name, "\" is given twice"));
    const auto& q = record.quaternion_wxyz;
    const double norm = std::sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]);
    if (!(std::abs(norm - 1) <= 0.01)) throw Error(concat(where, ": image \"", record.name, "\": quaternion of length ", norm, ", expected 1"));
    Camera camera;
    camera.photograph = record.name;
    camera.lens = lens->second;
    camera.pose.rotation_camera_from_world = Eigen::Quaterniond(q[0] / norm, q[1] / norm, q[2] / norm, q[3] / norm).toRotationMatrix();
    camera.pose.translation_camera_from_world = record.translation;
    check_camera(camera, where);
    cameras_.push_back(std::move(camera));
  }
  std::vector<Camera> take() { return std::move(cameras_); }

 private:
  Lenses lenses_;
  std::unordered_set<std::string> names_;
  std::vector<Camera> cameras_;
};

template <class T>
T number_in(std::string_view& rest, const char* what, const std::string& where) {
  const std::string_view word = detail::take_word(rest);
  const auto value = detail::parse_number<T>(word);
  if (!value) throw Error(concat(where, ": ", what, " is \"", word.substr(0, 40), "\", expected a number"));
  return *value;
}

Lenses read_lenses_text(const fs::path& path) {
  Lines lines(path);
  Lenses lenses;
  std::string line;
  while (lines.next(line)) {
    std::string_view rest = line;
    if (rest.find_first_not_of(" \t") == std::string_view::npos) continue;
    const auto id = number_in<std::uint32_t>(rest, "camera id", lines.where());
    const std::string model(detail::take_word(rest));
    const int width = checked_side(number_in<std::uint64_t>(rest, "width", lines.where()), lines.where());
    const int height = checked_side(number_in<std::uint64_t>(rest, "height", lines.where()), lines.where());
    std::vector<double> params;
    for (std::string_view word = detail::take_word(rest); !word.empty(); word = detail::take_word(rest)) {
      const auto value = detail::parse_number<double>(word);
      if (!value) throw Error(concat(lines.where(), ": camera ", id, ": parameter ", params.size() + 1, " is \"", word.substr(0, 40), "\", expected a finite number"));
      params.push_back(*value);
    }
    add_lens(lenses, id, lens_from_colmap(model, width, height, params, concat(lines.where(), ": camera ", id)), lines.where());
  }
  return lenses;
}

std::vector<Camera> read_images_text(const fs::path& path, Lenses lenses) {
  Lines lines(path);
  Collector collector(std::move(lenses));
  std::string line;
  while (lines.next(line)) {
    std::string_view rest = line;
    if (rest.find_first_not_of(" \t") == std::string_view::npos) continue;
    const std::string where = lines.where();
    ImageRecord record;
    number_in<std::uint32_t>(rest, "image id", where);
    for (double& q : record.quaternion_wxyz) q = number_in<double>(rest, "quaternion", where);
    for (int i = 0; i < 3; ++i) record.translation[i] = number_in<double>(rest, "translation", where);
    record.camera_id = number_in<std::uint32_t>(rest, "camera id", where);
    const std::size_t begin = rest.find_first_not_of(" \t"), end = rest.find_last_not_of(" \t");
    if (begin != std::string_view::npos) record.name = rest.substr(begin, end - begin + 1);  // names may hold blanks
    collector.add(record, where);
    const Lines::Skipped points = lines.skip();
    if (points.words % 3 != 0 || !points.numeric)
      throw Error(concat(where, ": image \"", record.name, "\": the line of its points that follows holds ", points.words, points.numeric ? " numbers" : " words that are not all numbers",
                         ", expected a multiple of 3 numbers (each image takes two lines; the second may be empty)"));
  }
  return collector.take();
}

Lenses read_lenses_binary(const fs::path& path) {
  Bytes bytes(path);
  Lenses lenses;
  const std::uint64_t num_cameras = bytes.count(24 + 3 * 8, "cameras");
  for (std::uint64_t i = 0; i < num_cameras; ++i) {
    const std::string where = bytes.where();
    const auto id = bytes.get<std::uint32_t>();
    const auto model_id = bytes.get<std::int32_t>();
    const Model* model = model_by_id(model_id);
    if (!model)
      throw Error(concat(where, ": camera ", id, ": lens model ", refused_name(model_id), " (id ", model_id, ") is not supported, expected ", kSupported));
    const int width = checked_side(bytes.get<std::uint64_t>(), where), height = checked_side(bytes.get<std::uint64_t>(), where);
    std::vector<double> params(model->num_params);
    bytes.read(params.data(), params.size() * sizeof(double));
    add_lens(lenses, id, lens_from_colmap(model->name, width, height, params, concat(where, ": camera ", id)), where);
  }
  if (bytes.left() > 0) throw Error(concat(bytes.where(), ": ", bytes.left(), " bytes left after ", num_cameras, " cameras"));
  return lenses;
}

std::string read_name(Bytes& bytes, const std::string& where) {
  constexpr std::size_t kMaxName = 4096;
  std::string name;
  for (char c = bytes.get<char>(); c != '\0'; c = bytes.get<char>()) {
    if (name.size() >= kMaxName) throw Error(concat(where, ": image name is longer than ", kMaxName, " bytes"));
    name.push_back(c);
  }
  return name;
}

std::vector<Camera> read_images_binary(const fs::path& path, Lenses lenses) {
  constexpr std::uint64_t kPointBytes = 24;
  Bytes bytes(path);
  Collector collector(std::move(lenses));
  const std::uint64_t num_images = bytes.count(4 + 7 * 8 + 4 + 1 + 8, "images");
  for (std::uint64_t i = 0; i < num_images; ++i) {
    const std::string where = bytes.where();
    ImageRecord record;
    bytes.get<std::uint32_t>();
    for (double& q : record.quaternion_wxyz) q = bytes.get<double>();
    for (int k = 0; k < 3; ++k) record.translation[k] = bytes.get<double>();
    record.camera_id = bytes.get<std::uint32_t>();
    record.name = read_name(bytes, where);
    const std::uint64_t num_points = bytes.count(kPointBytes, "points");
    bytes.skip(num_points * kPointBytes);
    collector.add(record, where);
  }
  if (bytes.left() > 0) throw Error(concat(bytes.where(), ": ", bytes.left(), " bytes left after ", num_images, " images"));
  return collector.take();
}

}  // namespace

Lens lens_from_colmap(const std::string& model, int width_px, int height_px, std::span<const double> params, const std::string& where) {
  const Model* known = model_by_name(model);
  if (!known) throw Error(concat(where, ": lens model \"", model.substr(0, 40), "\" is not supported, expected ", kSupported));
  if (params.size() != known->num_params)
    throw Error(concat(where, ": ", model, " has ", params.size(), " parameters, expected ", known->num_params));
  Lens lens;
  lens.width_px = width_px;
  lens.height_px = height_px;
  std::size_t at = 0;
  const auto next = [&] { return params[at++]; };
  const bool one_focal = known->id == 0 || known->id == 2 || known->id == 3 || known->id == 8 || known->id == 9 || known->id == 14;
  lens.fx = next();
  lens.fy = one_focal ? lens.fx : next();
  lens.cx = next();
  lens.cy = next();
  const bool tangential = known->id == 4 || known->id == 6;
  if (known->id == 5 || known->id == 8 || known->id == 9 || known->id == 14 || known->id == 15) lens.kind = LensKind::kFisheye;
  for (std::size_t k = 0; k < 2 && at < params.size(); ++k) lens.k[k] = next();
  if (tangential) {
    lens.p[0] = next();
    lens.p[1] = next();
  }
  for (std::size_t k = 2; at < params.size(); ++k) lens.k[k] = next();
  return lens;
}

std::vector<Camera> detail::read_colmap(const fs::path& folder, bool binary, std::vector<std::string>& notes) {
  // Files of COLMAP 3.12 and later add rigs and frames; images still holds the whole pose of each image, so they are not needed.
  const char* extension = binary ? ".bin" : ".txt";
  const fs::path cameras = folder / concat("cameras", extension), images = folder / concat("images", extension);
  std::vector<Camera> out = binary ? read_images_binary(images, read_lenses_binary(cameras)) : read_images_text(images, read_lenses_text(cameras));
  if (out.empty()) notes.push_back(concat(images.string(), ": holds no image"));
  return out;
}

}  // namespace chiaro::stream
