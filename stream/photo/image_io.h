/// Picture files: read by bands of rows as interleaved floats, written atomically. Values are the file's own numbers: nothing is rotated, balanced or
/// linearised here (develop.h does that). Integers are scaled so that the largest code is 1; floats come as they are.
#pragma once
#include <cstdint>
#include <filesystem>
#include <memory>
#include <optional>
#include <span>
#include <string>
#include <vector>

namespace chiaro::stream {

/// Interleaved, row-major, origin at the upper left.
struct Image {
  int width = 0, height = 0, channels = 0;
  std::vector<float> values;
  float at(int x, int y, int c) const { return values[(static_cast<std::size_t>(y) * static_cast<std::size_t>(width) + static_cast<std::size_t>(x)) * static_cast<std::size_t>(channels) + static_cast<std::size_t>(c)]; }
};

/// Sizes beyond these end in an Error before anything is allocated.
struct ImageLimits {
  std::uint64_t max_pixels = std::uint64_t{1} << 29;        ///< width x height
  std::uint64_t max_buffer_bytes = std::uint64_t{1} << 30;  ///< what one open file may hold at once: a strip, a row of tiles, a picture that cannot be streamed
};

struct ImageOptions {
  ImageLimits limits;
  std::vector<std::string> exr_channels;  ///< EXR: these channels, in this order; empty = R, G, B (and A), else Y, else a single channel
};

struct ImageInfo {
  std::string format;  ///< "EXR", "TIFF", "PNG", "JPEG"
  int width = 0, height = 0;
  int channels = 0;           ///< 1 grey, 2 grey + alpha, 3 RGB, 4 RGB + alpha; EXR with named channels: their number
  bool has_alpha = false;     ///< then alpha is the last channel
  bool alpha_is_assumed = false;  ///< of a TIFF's single extra channel, which the file does not say to be alpha
  int bits = 0;               ///< bits a sample: 8, 16, 32, 64; TIFF in black and white: 1
  bool is_float = false;
  std::string profile;             ///< description of an embedded ICC profile; empty = none
  std::optional<bool> says_linear; ///< whether values are proportional to radiance, by the curve of the profile (PNG: or gAMA, sRGB); absent: the file says nothing
  std::vector<std::string> notes;  ///< what was passed over in reading
};

/// An open picture. Rows are cheapest in rising order; going back re-reads from the start (not for EXR).
/// Memory: a few rows; one strip or row of tiles (TIFF), one block of lines (EXR); the whole picture for interlaced PNG and progressive JPEG.
class ImageSource {
 public:
  /// The type comes from the content, not the name. throws Error with path and reason.
  explicit ImageSource(const std::filesystem::path& path, const ImageOptions& options = {});
  ImageSource(ImageSource&&) noexcept;
  ~ImageSource();
  const ImageInfo& info() const;
  int width() const { return info().width; }
  int height() const { return info().height; }
  int channels() const { return info().channels; }
  /// out: rows * width * channels floats. EXR pixels outside the data window are NaN. throws Error naming path and row where the file is damaged.
  void read_rows(int y0, int rows, float* out);

 private:
  struct Impl;
  std::unique_ptr<Impl> impl_;
};

/// The whole picture. throws Error, also if it would need more than limits.max_buffer_bytes.
Image read_image(const std::filesystem::path& path, const ImageOptions& options = {});

/// All channel names of an EXR file, sorted.
std::vector<std::string> exr_channel_names(const std::filesystem::path& path);
/// The named channels of an EXR file, interleaved in the order of `names`; the file's display window. throws Error naming missing channels.
Image read_exr_channels(const std::filesystem::path& path, const std::vector<std::string>& names);

/// Writes an EXR by rows: ZIP compressed, half (values beyond +-65504 are limited) or float; the same values give the same bytes.
class ExrWriter {
 public:
  ExrWriter(const std::filesystem::path& path, int width_px, int height_px, std::vector<std::string> channels, bool as_half);
  ExrWriter(ExrWriter&&) noexcept;
  ~ExrWriter();
  /// The next rows: rows * width * channels floats, interleaved in the order the channels were named.
  void write_rows(int rows, std::span<const float> interleaved);
  /// After the last row: syncs and renames. Without it nothing is left behind.
  void commit();

 private:
  struct Impl;
  std::unique_ptr<Impl> impl_;
};

void write_exr(const std::filesystem::path& path, int width_px, int height_px, const std::vector<std::string>& channels, std::span<const float> interleaved, bool as_half);
/// Planes of one channel each.
void write_exr_planes(const std::filesystem::path& path, int width_px, int height_px, const std::vector<std::string>& channels,
                      const std::vector<std::span<const float>>& planes, bool as_half);

/// channels 1 (grey) or 3 (RGB); sRGB is declared in the file. The bytes are already encoded.
void write_png_srgb8(const std::filesystem::path& path, int width_px, int height_px, std::span<const std::uint8_t> values, int channels = 3);
void write_png_srgb16(const std::filesystem::path& path, int width_px, int height_px, std::span<const std::uint16_t> values, int channels = 3);

/// source: IEC 61966-2-1. Values outside [0, 1] follow the same curve (negative ones its straight part).
double srgb_from_linear(double linear);
double linear_from_srgb(double srgb);
/// 0..255, clamped; NaN gives 0.
std::uint8_t srgb8_from_linear(double linear);

}  // namespace chiaro::stream
