/// Two picture files side by side: every measure of metrics.h at once, on values of one kind.
#pragma once
#include <cstdint>
#include <filesystem>
#include <string>
#include <vector>

namespace chiaro::tools {

struct CompareImagesOptions {
  std::filesystem::path mask;  ///< grey picture of the same size; at least half = use. Empty: all pixels
  bool srgb = false;           ///< mse, psnr, ssim and relative error on sRGB-encoded values instead of linear ones (FLIP and delta E know no choice)
  bool as_stored = false;      ///< take 8-bit files and PNG as linear; otherwise they are taken as sRGB-encoded and linearised
  double peak = 1;             ///< of PSNR
  bool clip = false;           ///< take values below 0 and above `peak` as those, as a display would
};

struct ImageComparison {
  int width = 0, height = 0;
  std::uint64_t pixels = 0;      ///< that count: set in the mask
  std::uint64_t not_finite = 0;  ///< of these, pixels with NaN or infinity (unless clipped) in one of the pictures; any makes the measures NaN
  double psnr = 0;               ///< dB
  double ssim = 0;               ///< on luminance
  double ssim_rgb = 0;           ///< mean over the channels
  double flip = 0, mse = 0, relative_error = 0, delta_e = 0;
  std::vector<std::string> notes;  ///< how files were taken
};

/// EXR, PNG, TIFF, JPEG; alpha is dropped, grey becomes three equal channels. `reference` is what `test` is measured against.
/// throws Error if a file cannot be read, if the sizes differ, or if the mask sets no pixel.
ImageComparison compare_images(const std::filesystem::path& test, const std::filesystem::path& reference, const CompareImagesOptions& options);

}  // namespace chiaro::tools
