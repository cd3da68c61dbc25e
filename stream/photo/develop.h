/// One photograph to a working image: linear, scene-referred RGB with a mask of what can be used. By bands of rows, in memory that does not depend on the
/// picture (except RAW, interlaced PNG and progressive JPEG, which are unpacked whole).
#pragma once
#include <cstdint>
#include <filesystem>
#include <optional>
#include <string>
#include <vector>

#include "stream/base/report.h"

namespace chiaro::stream {

/// Variance of a linear value z: gain * max(z, 0) + read_sigma^2, in the units of the values.
struct NoiseModel {
  double gain = 0, read_sigma = 0;
  bool estimated = false;
  double variance(double z) const { return gain * (z > 0 ? z : 0) + read_sigma * read_sigma; }
};

enum class Encoding {
  kLinear,  ///< values are proportional to radiance: EXR, 16-bit TIFF, 8-bit files declared linear
  kSrgb,    ///< 8- or 16-bit values follow the sRGB curve and are taken back through it
  kRaw,     ///< camera RAW: see raw.h; the result has half the sensor's width and height
};

struct PictureSize {
  int width_px = 0, height_px = 0;
  int file_width_px = 0, file_height_px = 0;   ///< of the picture in the file, which cameras refer to: RAW has twice the pixels, and a column or row more where those are odd
};
/// Of the working image that develop() makes with cells of one pixel, from the head of the file alone. throws Error.
PictureSize working_size(const std::filesystem::path& photograph, Encoding encoding);

/// "linear", "srgb", "raw". throws UsageError.
Encoding encoding_from_name(const std::string& name);

/// Bits of the plane "mask".
enum MaskBit : std::uint8_t {
  kUsableByMask = 1,  ///< the user's mask allows it (or there is none)
  kSaturated = 2,     ///< a channel reaches the white level or lies on a plateau of clipped values, or a pixel within dilate_px does
  kNotFinite = 4,     ///< a channel is NaN or infinite, or the file holds no data there; its values are written as 0
};

struct DevelopOptions {
  Encoding encoding = Encoding::kLinear;
  std::optional<std::filesystem::path> mask;  ///< picture of the same size; usable where it is at least half white (its alpha, where that varies)
  std::optional<NoiseModel> noise;            ///< estimated from the picture where absent
  double saturation = 0.98;                   ///< share of white from which on a value counts as saturated; compared before linearisation
  std::optional<double> white;                ///< white level in the file's values; default 1 for integer files and RAW (largest code, the camera's white), none for floats
  bool find_clipping = false;                 ///< floats without a white level, and linear values of 16 bits, which often hold 12 or 14 of a sensor: a plateau at the brightest value of a channel (plateau.h) counts as saturated; reads the file twice. RAW likewise: RawSource::heaps()
  int dilate_px = 2;                          ///< around saturated pixels of RAW and 8-bit files, where sharpening and blooming reach
  int cell_px = 1;                            ///< 1 to 64: cells of that many pixels a side become one each (cells.h); the mask, `noise` and dilate_px are of the pixels before
};

struct DevelopResult {
  int width_px = 0, height_px = 0;   ///< of the working image: whole cells; all that is counted below are cells, too
  NoiseModel noise;
  std::uint64_t pixels_used = 0;  ///< allowed by the mask, not saturated, finite
  std::uint64_t pixels_masked = 0, pixels_saturated = 0, pixels_not_finite = 0;  ///< each counted by itself
  std::vector<std::string> notes;
};

/// Writes a raster (raster.h) with f32 planes "r", "g", "b" and u8 plane "mask". Grey pictures give three equal planes. Where the alpha of a photograph varies, pixels that
/// are not opaque hold no data (undistorted pictures have such borders).
///
/// throws   Error: unreadable photograph, mask missing or of another size (both named), float picture declared sRGB, fewer pixels than a cell has; Cancelled.
/// threads  serial; several photographs may be developed at once. The same bytes each time.
DevelopResult develop(const std::filesystem::path& photograph, const DevelopOptions& options, const std::filesystem::path& out_raster, Reporter& reporter);

}  // namespace chiaro::stream
