/// How alike two pictures are: MSE, PSNR, SSIM, FLIP, relative error; and colour difference after CIEDE2000. Definitions: docs/metrics.md.
#pragma once
#include <cstdint>
#include <span>
#include <vector>

namespace chiaro::tools {

/// A picture to look at: row-major, channels interleaved, values.size() = width * height * channels.
struct PixelView {
  int width = 0, height = 0, channels = 0;
  std::span<const float> values;
};

/// One byte a pixel, 0 = leave out; empty = all pixels count.
using MaskView = std::span<const std::uint8_t>;

/// All functions below: the pictures agree in size and channels and the mask in size, else std::invalid_argument. A value that is not
/// finite inside the mask makes the result NaN, and so does an empty mask: bad input never looks like a good match. Parallel inside; the
/// same bits for any thread count.

/// Mean squared difference over masked pixels and all channels.
double mse(const PixelView& test, const PixelView& reference, MaskView mask = {});

/// 10 log10(peak^2 / mse), dB; infinity for equal pictures. The peak is fixed, never the picture's maximum.
double psnr(const PixelView& test, const PixelView& reference, MaskView mask = {}, double peak = 1);

/// Mean of |test - reference| / reference over masked values with reference > floor; NaN if there is none.
double relative_error(const PixelView& test, const PixelView& reference, MaskView mask = {}, double floor = 1e-3);

/// Structural similarity, mean over pixels and channels: 11 x 11 Gaussian window of sigma 1.5, K1 = .01, K2 = .03, population covariance, data
/// range 1. Pixels nearer than 5 px to the border are left out, as the window would leave the picture. With a mask, the window's moments are
/// taken over masked pixels only (weights renormalised), and the mean over the pixels that have no unmasked pixel within 5 px.
/// returns  NaN where no pixel is left (pictures smaller than 11 px).
/// source   Wang, Bovik, Sheikh, Simoncelli, "Image quality assessment: from error visibility to structural similarity", 2004.
double ssim(const PixelView& test, const PixelView& reference, MaskView mask = {});

struct FlipOptions {
  double pixels_per_degree = 67.02;  ///< 0.7 m from a display 0.7 m wide with 3840 pixels
  bool keep_map = false;
};
struct FlipResult {
  double mean = 0;         ///< over masked pixels, 0 (alike) .. 1
  std::vector<float> map;  ///< per pixel, with keep_map
};

/// FLIP for low dynamic range: the difference that a viewer sees when flipping between the pictures.
///
/// test, reference  3 channels, linear with sRGB primaries; clamped to 0..1. Outside the mask both show the reference, so that nothing
///                  beyond the mask's border leaks in.
/// source           Andersson, Nilsson, Akenine-Moller, Oskarsson, Astrom, Fairchild, "FLIP: A Difference Evaluator for Alternating Images", HPG 2020.
FlipResult flip(const PixelView& test, const PixelView& reference, MaskView mask = {}, const FlipOptions& options = {});

/// Rec. 709 luminance of linear RGB: one value a pixel. 3 channels.
std::vector<float> luminance(const PixelView& rgb);

/// Mean of CIEDE2000 (tools/colour_spaces.h) over masked pixels; 3 channels, linear.
double mean_delta_e_2000(const PixelView& test, const PixelView& reference, MaskView mask = {});

}  // namespace chiaro::tools
