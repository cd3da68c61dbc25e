#include "tools/metrics.h"

#include <algorithm>
#include <cmath>
#include <cstddef>

#include "tools/colour_spaces.h"
#include "tools/metric_bands.h"

namespace chiaro::tools {
namespace {

constexpr int kSsimRadius = 5;  // 11 x 11

/// No unmasked pixel within 5 px.
bool is_inside(MaskView mask, int width, int x, int y) {
  if (mask.empty()) return true;
  for (int dy = -kSsimRadius; dy <= kSsimRadius; ++dy)
    for (int dx = -kSsimRadius; dx <= kSsimRadius; ++dx)
      if (dx * dx + dy * dy <= kSsimRadius * kSsimRadius && !mask[static_cast<std::size_t>(y + dy) * static_cast<std::size_t>(width) + static_cast<std::size_t>(x + dx)]) return false;
  return true;
}

/// The six windowed sums of one channel over rows [y0, y1), which keep 5 rows from the border.
struct SsimMoments {
  Rows weight, a, b, aa, bb, ab;
};

SsimMoments ssim_moments(const PixelView& test, const PixelView& reference, MaskView mask, int channel, int y0, int y1, const std::vector<double>& kernel) {
  const int rows = y1 - y0 + 2 * kSsimRadius;
  std::vector<Rows> planes(6, Rows(test.width, rows));
  for (int y = 0; y < rows; ++y)
    for (int x = 0; x < test.width; ++x) {
      const std::size_t pixel = static_cast<std::size_t>(y + y0 - kSsimRadius) * static_cast<std::size_t>(test.width) + static_cast<std::size_t>(x);
      if (!counts(mask, pixel)) continue;  // all six stay 0
      const std::size_t i = pixel * static_cast<std::size_t>(test.channels) + static_cast<std::size_t>(channel);
      const double a = test.values[i], b = reference.values[i];
      const double values[] = {1, a, b, a * a, b * b, a * b};
      for (std::size_t k = 0; k < 6; ++k) planes[k].row(y)[x] = values[k];
    }
  for (Rows& plane : planes) plane = along_columns(along_rows(plane, kernel), kSsimRadius, kernel);
  return {std::move(planes[0]), std::move(planes[1]), std::move(planes[2]), std::move(planes[3]), std::move(planes[4]), std::move(planes[5])};
}

double ssim_of(double mean_a, double mean_b, double mean_aa, double mean_bb, double mean_ab) {
  constexpr double kC1 = 0.01 * 0.01, kC2 = 0.03 * 0.03;
  const double var_a = mean_aa - mean_a * mean_a, var_b = mean_bb - mean_b * mean_b, covariance = mean_ab - mean_a * mean_b;
  return (2 * mean_a * mean_b + kC1) * (2 * covariance + kC2) / ((mean_a * mean_a + mean_b * mean_b + kC1) * (var_a + var_b + kC2));
}

}  // namespace

double mse(const PixelView& test, const PixelView& reference, MaskView mask) {
  require_alike(test, reference, mask);
  const double mean = mean_over_values(test, reference, mask, [](float a, float b) {
    const double difference = static_cast<double>(a) - static_cast<double>(b);
    return Sum{difference * difference, 1};
  });
  return std::isfinite(mean) ? mean : kNan;
}

double psnr(const PixelView& test, const PixelView& reference, MaskView mask, double peak) { return 10 * std::log10(peak * peak / mse(test, reference, mask)); }

double relative_error(const PixelView& test, const PixelView& reference, MaskView mask, double floor) {
  require_alike(test, reference, mask);
  const double mean = mean_over_values(test, reference, mask, [floor](float a, float b) {
    if (!std::isfinite(a) || !std::isfinite(b)) return Sum{kNan, 1};
    if (!(static_cast<double>(b) > floor)) return Sum{};
    return Sum{std::abs(static_cast<double>(a) - static_cast<double>(b)) / static_cast<double>(b), 1};
  });
  return std::isfinite(mean) ? mean : kNan;
}

double ssim(const PixelView& test, const PixelView& reference, MaskView mask) {
  require_alike(test, reference, mask);
  if (has_bad_value(test, reference, mask)) return kNan;
  const std::vector<double> kernel = gaussian(1.5, kSsimRadius);
  return sum_over_bands(test.height, [&](int y0, int y1) {
           y0 = std::max(y0, kSsimRadius);
           y1 = std::min(y1, test.height - kSsimRadius);
           Sum sum;
           if (y0 >= y1) return sum;
           for (int c = 0; c < test.channels; ++c) {
             const SsimMoments m = ssim_moments(test, reference, mask, c, y0, y1, kernel);
             for (int y = y0; y < y1; ++y)
               for (int x = kSsimRadius; x < test.width - kSsimRadius; ++x) {
                 if (!is_inside(mask, test.width, x, y)) continue;
                 const std::size_t i = static_cast<std::size_t>(y - y0) * static_cast<std::size_t>(test.width) + static_cast<std::size_t>(x);
                 const double w = m.weight.values[i];
                 sum += {ssim_of(m.a.values[i] / w, m.b.values[i] / w, m.aa.values[i] / w, m.bb.values[i] / w, m.ab.values[i] / w), 1};
               }
           }
           return sum;
         }).mean();
}

std::vector<float> luminance(const PixelView& rgb) {
  require_alike(rgb, rgb, {}, 3);
  std::vector<float> y(rgb.values.size() / 3);
  for (std::size_t i = 0; i < y.size(); ++i) y[i] = 0.2126f * rgb.values[3 * i] + 0.7152f * rgb.values[3 * i + 1] + 0.0722f * rgb.values[3 * i + 2];
  return y;
}

double mean_delta_e_2000(const PixelView& test, const PixelView& reference, MaskView mask) {
  require_alike(test, reference, mask, 3);
  const std::size_t pixels = static_cast<std::size_t>(test.width) * static_cast<std::size_t>(test.height);
  const auto lab = [](const PixelView& view, std::size_t pixel) {
    return lab_from_linear({view.values[3 * pixel], view.values[3 * pixel + 1], view.values[3 * pixel + 2]});
  };
  return deterministic_sum<Sum>(pixels, 1 << 12, {}, [&](std::size_t begin, std::size_t end) {
           Sum sum;
           for (std::size_t p = begin; p < end; ++p)
             if (counts(mask, p)) sum += {delta_e_2000(lab(test, p), lab(reference, p)), 1};
           return sum;
         }).mean();
}

}  // namespace chiaro::tools
