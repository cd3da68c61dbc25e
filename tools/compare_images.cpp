#include "tools/compare_images.h"

#include <algorithm>
#include <cmath>

#include "stream/base/error.h"
#include "stream/photo/image_io.h"
#include "tools/metrics.h"

namespace chiaro::tools {
namespace {

struct Picture {
  int width = 0, height = 0;
  std::vector<float> rgb;
  PixelView view() const { return {width, height, 3, rgb}; }
};

/// Only 16-bit TIFF, and floats, are linear by themselves: so the project file says of photographs, too.
bool is_srgb(const stream::ImageInfo& info) { return !info.is_float && (info.bits <= 8 || info.format == "PNG" || info.format == "JPEG"); }

Picture read_picture(const std::filesystem::path& path, bool as_stored, std::vector<std::string>& notes) {
  stream::ImageSource source(path);
  const stream::ImageInfo& info = source.info();
  const std::size_t stored = static_cast<std::size_t>(info.channels);
  const std::size_t colours = stored - (info.has_alpha ? 1 : 0);
  if (colours != 1 && colours != 3) throw Error(concat(path.string(), ": ", colours, " channels; expected grey or red, green, blue"));
  const bool encoded = is_srgb(info) && !as_stored;
  if (encoded) notes.push_back(concat(path.filename().string(), ": taken as sRGB and linearised"));
  for (const std::string& note : info.notes) notes.push_back(concat(path.filename().string(), ": ", note));

  Picture picture{info.width, info.height, {}};
  const std::size_t width = static_cast<std::size_t>(info.width);
  picture.rgb.resize(width * static_cast<std::size_t>(info.height) * 3);
  constexpr int kBandRows = 64;
  std::vector<float> band(width * stored * kBandRows);
  for (int y0 = 0; y0 < info.height; y0 += kBandRows) {
    const int rows = std::min(kBandRows, info.height - y0);
    source.read_rows(y0, rows, band.data());
    float* to = picture.rgb.data() + static_cast<std::size_t>(y0) * width * 3;
    for (std::size_t p = 0; p < width * static_cast<std::size_t>(rows); ++p)
      for (std::size_t c = 0; c < 3; ++c) {
        const float value = band[p * stored + (colours == 3 ? c : 0)];
        to[p * 3 + c] = encoded ? static_cast<float>(stream::linear_from_srgb(value)) : value;
      }
  }
  return picture;
}

std::vector<std::uint8_t> read_mask(const std::filesystem::path& path, int width, int height) {
  const stream::Image image = stream::read_image(path);
  if (image.width != width || image.height != height)
    throw Error(concat(path.string(), ": the mask has ", image.width, " x ", image.height, " pixels, the pictures have ", width, " x ", height));
  std::vector<std::uint8_t> mask(static_cast<std::size_t>(width) * static_cast<std::size_t>(height));
  for (std::size_t p = 0; p < mask.size(); ++p) mask[p] = image.values[p * static_cast<std::size_t>(image.channels)] >= 0.5f;
  if (std::find(mask.begin(), mask.end(), 1) == mask.end()) throw Error(concat(path.string(), ": the mask sets no pixel"));
  return mask;
}

void count_pixels(const Picture& a, const Picture& b, const std::vector<std::uint8_t>& mask, ImageComparison& result) {
  for (std::size_t p = 0; p < a.rgb.size() / 3; ++p) {
    if (!mask.empty() && !mask[p]) continue;
    ++result.pixels;
    bool finite = true;
    for (std::size_t i = 3 * p; i < 3 * p + 3; ++i) finite = finite && std::isfinite(a.rgb[i]) && std::isfinite(b.rgb[i]);
    if (!finite) ++result.not_finite;
  }
}

}  // namespace

ImageComparison compare_images(const std::filesystem::path& test, const std::filesystem::path& reference, const CompareImagesOptions& options) {
  ImageComparison result;
  Picture a = read_picture(test, options.as_stored, result.notes), b = read_picture(reference, options.as_stored, result.notes);
  if (a.width != b.width || a.height != b.height)
    throw Error(concat(test.string(), " has ", a.width, " x ", a.height, " pixels, ", reference.string(), " has ", b.width, " x ", b.height));
  std::vector<std::uint8_t> mask;
  if (!options.mask.empty()) mask = read_mask(options.mask, a.width, a.height);
  result.width = a.width;
  result.height = a.height;

  if (options.clip)
    for (std::vector<float>* values : {&a.rgb, &b.rgb})
      for (float& v : *values) v = std::isnan(v) ? v : std::clamp(v, 0.0f, static_cast<float>(options.peak));
  count_pixels(a, b, mask, result);
  result.flip = flip(a.view(), b.view(), mask).mean;
  result.delta_e = mean_delta_e_2000(a.view(), b.view(), mask);
  if (options.srgb)
    for (std::vector<float>* values : {&a.rgb, &b.rgb})
      for (float& v : *values) v = static_cast<float>(stream::srgb_from_linear(v));
  result.mse = mse(a.view(), b.view(), mask);
  result.psnr = psnr(a.view(), b.view(), mask, options.peak);
  result.relative_error = relative_error(a.view(), b.view(), mask);
  result.ssim_rgb = ssim(a.view(), b.view(), mask);
  const std::vector<float> grey_a = luminance(a.view()), grey_b = luminance(b.view());
  result.ssim = ssim({a.width, a.height, 1, grey_a}, {b.width, b.height, 1, grey_b}, mask);
  return result;
}

}  // namespace chiaro::tools
