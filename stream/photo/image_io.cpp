#include "stream/photo/image_io.h"

#include <algorithm>
#include <cmath>
#include <cstring>

#include "stream/base/file.h"
#include "stream/base/text.h"
#include "stream/photo/image_io_detail.h"

namespace chiaro::stream {
namespace fs = std::filesystem;
namespace {

bool is_raw_name(const fs::path& path) {
  const std::string extension = lower_extension(path);
  constexpr const char* kRaw[] = {".nef", ".nrw", ".cr2", ".cr3", ".crw", ".arw", ".srf", ".sr2", ".dng", ".raf", ".orf", ".rw2",
                                  ".pef", ".iiq", ".3fr", ".fff", ".mos", ".kdc", ".dcr", ".erf", ".mef", ".mrw", ".srw", ".x3f"};
  return std::any_of(std::begin(kRaw), std::end(kRaw), [&](const char* raw) { return extension == raw; });
}

std::unique_ptr<detail::RowReader> open_reader(const fs::path& path, const ImageOptions& options) {
  File file(path, File::Mode::kRead);
  unsigned char head[8] = {};
  const std::size_t n = file.read_some_at(0, head, sizeof head);
  if (n == 0) throw Error(concat(path.string(), ": is empty"));
  const auto starts = [&](std::initializer_list<int> magic) {
    return n >= magic.size() && std::equal(magic.begin(), magic.end(), head, [](int a, unsigned char b) { return a == b; });
  };
  if (starts({0x76, 0x2f, 0x31, 0x01})) return detail::open_exr(path, options);
  if (starts({0x89, 'P', 'N', 'G', 0x0d, 0x0a, 0x1a, 0x0a})) return detail::open_png(path, options);
  if (starts({0xff, 0xd8, 0xff})) return detail::open_jpeg(path, options);
  if (starts({'I', 'I', 42, 0}) || starts({'M', 'M', 0, 42}) || starts({'I', 'I', 43, 0}) || starts({'M', 'M', 0, 43})) {
    // Most camera RAW files are TIFFs whose first picture is a thumbnail.
    if (is_raw_name(path)) throw Error(concat(path.string(), ": is a camera RAW file, expected a picture; use encoding = \"raw\""));
    return detail::open_tiff(path, options);
  }
  throw Error(concat(path.string(), ": not a known picture, expected EXR, TIFF, PNG or JPEG", is_raw_name(path) ? " (camera RAW: use encoding = \"raw\")" : ""));
}

std::uint32_t big_endian32(std::span<const std::uint8_t> bytes, std::size_t at) {
  return (std::uint32_t{bytes[at]} << 24) | (std::uint32_t{bytes[at + 1]} << 16) | (std::uint32_t{bytes[at + 2]} << 8) | bytes[at + 3];
}

}  // namespace

void detail::check_size(const fs::path& path, std::uint64_t width, std::uint64_t height, const ImageLimits& limits) {
  constexpr std::uint64_t kMaxSide = 1u << 20;
  if (width == 0 || height == 0) throw Error(concat(path.string(), ": is ", width, " x ", height, " pixels"));
  if (width > kMaxSide || height > kMaxSide || width * height > limits.max_pixels)
    throw Error(concat(path.string(), ": claims ", width, " x ", height, " pixels, more than the limit of ", limits.max_pixels));
}

void detail::check_buffer(const fs::path& path, std::uint64_t bytes, const ImageLimits& limits, const char* what) {
  if (bytes > limits.max_buffer_bytes)
    throw Error(concat(path.string(), ": needs ", bytes, " bytes at once for ", what, ", more than the limit of ", limits.max_buffer_bytes));
}

namespace {

/// The data of a tag of an ICC profile; empty where it has none. source: ICC.1:2010, 7.3.
std::span<const std::uint8_t> profile_tag(std::span<const std::uint8_t> icc, const char* signature) {
  if (icc.size() < 132) return {};
  const std::uint32_t num_tags = std::min<std::uint32_t>(big_endian32(icc, 128), 100);
  for (std::uint32_t i = 0; i < num_tags; ++i) {
    const std::size_t tag = 132 + std::size_t{i} * 12;
    if (tag + 12 > icc.size()) break;
    const std::uint64_t at = big_endian32(icc, tag + 4), size = big_endian32(icc, tag + 8);
    if (std::memcmp(&icc[tag], signature, 4) == 0 && at + size <= icc.size()) return icc.subspan(at, size);
  }
  return {};
}

}  // namespace

std::string detail::profile_name(std::span<const std::uint8_t> icc) {
  const std::string unnamed = "unnamed";
  const std::span<const std::uint8_t> desc = profile_tag(icc, "desc");
  if (desc.size() < 28) return unnamed;
  const bool unicode = std::memcmp(desc.data(), "mluc", 4) == 0;
  const std::uint64_t begin = unicode ? big_endian32(desc, 24) : 12, length = unicode ? big_endian32(desc, 20) : big_endian32(desc, 8);
  std::string name;
  for (std::uint64_t k = begin + (unicode ? 1 : 0); k < begin + length && k < desc.size() && name.size() < 60; k += unicode ? 2 : 1)
    if (desc[k] >= 32 && desc[k] < 127) name.push_back(static_cast<char>(desc[k]));
  return name.empty() ? unnamed : name;
}

std::optional<bool> detail::profile_is_linear(std::span<const std::uint8_t> icc) {
  std::span<const std::uint8_t> curve = profile_tag(icc, "rTRC");
  if (curve.empty()) curve = profile_tag(icc, "kTRC");
  if (curve.size() < 12) return std::nullopt;
  constexpr double kTolerance = 0.01;
  const auto is_one = [](double exponent) { return std::abs(exponent - 1) <= kTolerance; };
  if (std::memcmp(curve.data(), "curv", 4) == 0) {
    const std::uint32_t count = big_endian32(curve, 8);
    if (count == 0) return true;
    if (count == 1) return curve.size() >= 14 ? std::optional(is_one((curve[12] * 256.0 + curve[13]) / 256)) : std::nullopt;
    if (12 + 2 * std::uint64_t{count} > curve.size()) return std::nullopt;
    const std::size_t middle = 12 + 2 * ((count - 1) / 2);
    return std::abs((curve[middle] * 256.0 + curve[middle + 1]) / 65535 - ((count - 1) / 2) / (count - 1.0)) <= kTolerance;
  }
  if (std::memcmp(curve.data(), "para", 4) != 0 || curve.size() < 16) return std::nullopt;
  return curve[8] == 0 && curve[9] == 0 && is_one(big_endian32(curve, 12) / 65536.0);
}

void detail::read_profile(std::span<const std::uint8_t> icc, ImageInfo& info) {
  info.profile = profile_name(icc);
  info.says_linear = profile_is_linear(icc);
}

int detail::exif_orientation(std::span<const std::uint8_t> block) {
  constexpr std::size_t kHead = 6, kEntry = 12;
  constexpr std::uint32_t kOrientationTag = 274, kMostEntries = 1000;
  if (block.size() < kHead + 8 || std::memcmp(block.data(), "Exif\0\0", kHead) != 0) return 1;
  const std::span<const std::uint8_t> tiff = block.subspan(kHead);
  const bool big = tiff[0] == 'M';
  const auto number = [&](std::size_t at, std::size_t bytes) {
    std::uint32_t v = 0;
    for (std::size_t i = 0; i < bytes; ++i) v |= std::uint32_t{tiff[at + i]} << 8 * (big ? bytes - 1 - i : i);
    return v;
  };
  const std::size_t directory = number(4, 4);
  if (directory > tiff.size() - 2) return 1;
  const std::uint32_t count = std::min(number(directory, 2), kMostEntries);
  for (std::size_t i = 0, at = directory + 2; i < count && at + kEntry <= tiff.size(); ++i, at += kEntry)
    if (number(at, 2) == kOrientationTag) return static_cast<int>(number(at + 8, 2));
  return 1;
}

void detail::note_orientation(int orientation, ImageInfo& info) {
  if (orientation <= 1 || orientation > 8) return;
  info.notes.push_back(concat("its orientation tag (", orientation, ") asks viewers to turn or mirror it; its pixels are taken as they are stored, which is what camera files mean"));
}

detail::FilePtr detail::open_c_file(const fs::path& path) {
  File check(path, File::Mode::kRead);  // gives the system's reason, and refuses folders
  FilePtr file(std::fopen(path.c_str(), "rb"));
  if (!file) throw Error(concat(path.string(), ": cannot be opened"));
  return file;
}

struct ImageSource::Impl {
  fs::path path;
  ImageOptions options;
  std::unique_ptr<detail::RowReader> reader;
  int next = 0;
};

ImageSource::ImageSource(const fs::path& path, const ImageOptions& options) : impl_(std::make_unique<Impl>()) {
  impl_->path = path;
  impl_->options = options;
  impl_->reader = open_reader(path, options);
}
ImageSource::ImageSource(ImageSource&&) noexcept = default;
ImageSource::~ImageSource() = default;
const ImageInfo& ImageSource::info() const { return impl_->reader->info; }

void ImageSource::read_rows(int y0, int rows, float* out) {
  Impl& impl = *impl_;
  if (y0 < 0 || rows < 0 || y0 > height() - rows) throw std::invalid_argument("ImageSource::read_rows: rows outside the image");
  if (!impl.reader->random_access()) {
    if (y0 < impl.next) {
      impl.reader.reset();
      impl.reader = open_reader(impl.path, impl.options);
      impl.next = 0;
    }
    std::vector<float> skipped;
    for (; impl.next < y0; ++impl.next) {
      skipped.resize(static_cast<std::size_t>(width()) * static_cast<std::size_t>(channels()));
      impl.reader->read_rows(impl.next, 1, skipped.data());
    }
  }
  impl.reader->read_rows(y0, rows, out);
  impl.next = y0 + rows;
}

Image read_image(const fs::path& path, const ImageOptions& options) {
  ImageSource source(path, options);
  Image image;
  image.width = source.width();
  image.height = source.height();
  image.channels = source.channels();
  const std::uint64_t count = static_cast<std::uint64_t>(image.width) * static_cast<std::uint64_t>(image.height) * static_cast<std::uint64_t>(image.channels);
  detail::check_buffer(path, count * sizeof(float), options.limits, "the whole picture");
  // Grown by bands: a file that ends early is noticed before all memory is taken.
  const int band = 64;
  const std::size_t row = static_cast<std::size_t>(image.width) * static_cast<std::size_t>(image.channels);
  for (int y = 0; y < image.height; y += band) {
    const int rows = std::min(band, image.height - y);
    image.values.resize(row * static_cast<std::size_t>(y + rows));
    source.read_rows(y, rows, image.values.data() + row * static_cast<std::size_t>(y));
  }
  return image;
}

Image read_exr_channels(const fs::path& path, const std::vector<std::string>& names) {
  if (names.empty()) throw std::invalid_argument("read_exr_channels: no channel named");
  ImageOptions options;
  options.exr_channels = names;
  options.limits.max_buffer_bytes = std::uint64_t{1} << 33;
  return read_image(path, options);
}

void write_exr(const fs::path& path, int width_px, int height_px, const std::vector<std::string>& channels, std::span<const float> interleaved, bool as_half) {
  ExrWriter writer(path, width_px, height_px, channels, as_half);
  writer.write_rows(height_px, interleaved);
  writer.commit();
}

void write_exr_planes(const fs::path& path, int width_px, int height_px, const std::vector<std::string>& channels,
                      const std::vector<std::span<const float>>& planes, bool as_half) {
  const std::size_t width = static_cast<std::size_t>(width_px), num = channels.size();
  if (planes.size() != num) throw std::invalid_argument("write_exr_planes: one plane a channel");
  for (const auto& plane : planes)
    if (plane.size() != width * static_cast<std::size_t>(height_px)) throw std::invalid_argument("write_exr_planes: wrong plane size");
  ExrWriter writer(path, width_px, height_px, channels, as_half);
  std::vector<float> row(width * num);
  for (std::size_t y = 0; y < static_cast<std::size_t>(height_px); ++y) {
    for (std::size_t x = 0; x < width; ++x)
      for (std::size_t c = 0; c < num; ++c) row[x * num + c] = planes[c][y * width + x];
    writer.write_rows(1, row);
  }
  writer.commit();
}

double srgb_from_linear(double linear) { return linear <= 0.0031308 ? 12.92 * linear : 1.055 * std::pow(linear, 1 / 2.4) - 0.055; }

double linear_from_srgb(double srgb) { return srgb <= 0.04045 ? srgb / 12.92 : std::pow((srgb + 0.055) / 1.055, 2.4); }

std::uint8_t srgb8_from_linear(double linear) {
  if (!(linear > 0)) return 0;
  return static_cast<std::uint8_t>(std::lround(255 * srgb_from_linear(std::min(linear, 1.0))));
}

}  // namespace chiaro::stream
