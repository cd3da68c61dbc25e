#include "tools/metric_bands.h"

#include <cmath>
#include <stdexcept>

namespace chiaro::tools {

void require_alike(const PixelView& test, const PixelView& reference, MaskView mask, int channels) {
  const auto fits = [](const PixelView& v) {
    return v.width > 0 && v.height > 0 && v.channels > 0 &&
           v.values.size() == static_cast<std::size_t>(v.width) * static_cast<std::size_t>(v.height) * static_cast<std::size_t>(v.channels);
  };
  if (!fits(test) || !fits(reference)) throw std::invalid_argument("metrics: a picture's values do not fit its size");
  if (test.width != reference.width || test.height != reference.height || test.channels != reference.channels)
    throw std::invalid_argument("metrics: the pictures differ in size or channels");
  if (!mask.empty() && mask.size() != static_cast<std::size_t>(test.width) * static_cast<std::size_t>(test.height))
    throw std::invalid_argument("metrics: the mask has another size than the pictures");
  if (channels && test.channels != channels) throw std::invalid_argument("metrics: the pictures need 3 channels");
}

bool has_bad_value(const PixelView& test, const PixelView& reference, MaskView mask) {
  return std::isnan(mean_over_values(test, reference, mask, [](float a, float b) { return Sum{std::isfinite(a) && std::isfinite(b) ? 0 : kNan, 1}; }));
}

std::vector<double> gaussian(double sigma, int radius) {
  std::vector<double> kernel;
  double sum = 0;
  for (int i = -radius; i <= radius; ++i) {
    kernel.push_back(std::exp(-0.5 * i * i / (sigma * sigma)));
    sum += kernel.back();
  }
  for (double& k : kernel) k /= sum;
  return kernel;
}

Rows along_rows(const Rows& in, const std::vector<double>& kernel) {
  const int radius = static_cast<int>(kernel.size()) / 2;
  Rows out(in.width, in.count);
  for (int y = 0; y < in.count; ++y) {
    const double* from = in.row(y);
    double* to = out.row(y);
    for (int x = 0; x < in.width; ++x) {
      double sum = 0;
      if (x >= radius && x + radius < in.width)
        for (int i = -radius; i <= radius; ++i) sum += kernel[static_cast<std::size_t>(i + radius)] * from[x + i];
      else
        for (int i = -radius; i <= radius; ++i) sum += kernel[static_cast<std::size_t>(i + radius)] * from[std::clamp(x + i, 0, in.width - 1)];
      to[x] = sum;
    }
  }
  return out;
}

Rows along_columns(const Rows& in, int halo, const std::vector<double>& kernel) {
  const int radius = static_cast<int>(kernel.size()) / 2;
  Rows out(in.width, in.count - 2 * halo);
  for (int y = 0; y < out.count; ++y) {
    double* to = out.row(y);
    for (int i = -radius; i <= radius; ++i) {
      const double k = kernel[static_cast<std::size_t>(i + radius)];
      const double* from = in.row(y + halo + i);
      for (int x = 0; x < in.width; ++x) to[x] += k * from[x];
    }
  }
  return out;
}

}  // namespace chiaro::tools
