/// Camera RAW to linear sensor values, without any of the automatic steps a converter takes.
#pragma once
#include <array>
#include <cstdint>
#include <filesystem>
#include <memory>
#include <optional>
#include <string>
#include <vector>

namespace chiaro::stream {

struct RawInfo {
  std::string camera;                    ///< make and model
  int width_px = 0, height_px = 0;       ///< of the half-size picture: one pixel a 2x2 cell of the mosaic
  int sensor_width_px = 0, sensor_height_px = 0;  ///< visible area of the sensor, which lens calibrations of full-size pictures refer to
  int crop_left_px = 0, crop_top_px = 0;          ///< margins cut off the stored sensor frame, in sensor pixels
  double white = 0, black = 0;           ///< raw numbers that map to 1 and (mean over the mosaic) to 0
  std::vector<std::string> notes;
};

/// An unpacked mosaic, read as half-size RGB: R, mean of the two G, B of each 2x2 cell; (raw - black) / (white - black), negative noise kept (but of Phase One backs). No demosaicing,
/// white balance, colour matrix, highlight handling or rotation. The white level is the camera's fixed one, never the picture's own maximum.
/// source: LibRaw's unpacked raw_image; black levels as its black-subtraction step uses them.
class RawSource {
 public:
  static constexpr int kCellPx = 2;   ///< sensor pixels a side of one pixel
  /// throws Error: not a RAW file, pixels missing or damaged, no 2x2 Bayer mosaic (X-Trans, sRAW, linear DNG, Foveon), values already white-balanced.
  explicit RawSource(const std::filesystem::path& path);
  RawSource(RawSource&&) noexcept;
  ~RawSource();
  const RawInfo& info() const;
  /// Width and height of the sensor's visible area as the head of a file gives them, without its pixels. throws Error: not a RAW file.
  static std::array<int, 2> sensor_size_px(const std::filesystem::path& path);
  /// Raw numbers at which red, green, blue end in a heap: many sensors saturate below the white level that is known of their camera (some by a sixth, greens often alone),
  /// or by another one at each ISO. Absent where they do not. Reads all of the mosaic.
  std::array<std::optional<int>, 3> heaps() const;
  /// rgb: rows * width * 3 floats. saturated: rows * width flags, 1 where any of the four raw values reaches `saturation` times white or `heap` of its colour.
  void read_rows(int y0, int rows, double saturation, const std::array<std::optional<int>, 3>& heap, float* rgb, std::uint8_t* saturated) const;

 private:
  struct Impl;
  std::unique_ptr<Impl> impl_;
};

}  // namespace chiaro::stream
