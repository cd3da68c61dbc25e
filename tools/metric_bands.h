/// What the measures of tools/metrics.h share: which pixels count, sums over them, and filters over bands of rows. Internal to them.
#pragma once
#include <algorithm>
#include <cstddef>
#include <limits>
#include <vector>

#include "stream/base/parallel.h"
#include "tools/metrics.h"

namespace chiaro::tools {

constexpr double kNan = std::numeric_limits<double>::quiet_NaN();
constexpr int kBandRows = 32;  ///< rows of one task; fixed, so that sums do not depend on threads

/// throws std::invalid_argument where the pictures do not fit each other, the mask does not fit them, or they have not `channels` (0: any).
void require_alike(const PixelView& test, const PixelView& reference, MaskView mask, int channels = 0);

inline bool counts(MaskView mask, std::size_t pixel) { return mask.empty() || mask[pixel] != 0; }

struct Sum {
  double total = 0;
  double count = 0;
  Sum& operator+=(const Sum& other) {
    total += other.total;
    count += other.count;
    return *this;
  }
  double mean() const { return count > 0 ? total / count : kNan; }
};

/// Mean of f(test value, reference value) over masked values for which f says so.
template <class F>
double mean_over_values(const PixelView& test, const PixelView& reference, MaskView mask, F f) {
  const std::size_t pixels = static_cast<std::size_t>(test.width) * static_cast<std::size_t>(test.height), channels = static_cast<std::size_t>(test.channels);
  return deterministic_sum<Sum>(pixels, 1 << 14, {}, [&](std::size_t begin, std::size_t end) {
           Sum sum;
           for (std::size_t p = begin; p < end; ++p)
             if (counts(mask, p))
               for (std::size_t i = p * channels; i < (p + 1) * channels; ++i) sum += f(test.values[i], reference.values[i]);
           return sum;
         }).mean();
}

/// A value inside the mask is not finite.
bool has_bad_value(const PixelView& test, const PixelView& reference, MaskView mask);

/// Runs rows(y0, y1) over bands of the picture and adds up what they return.
template <class F>
Sum sum_over_bands(int height, F rows) {
  const std::size_t bands = (static_cast<std::size_t>(height) + kBandRows - 1) / kBandRows;
  return deterministic_sum<Sum>(bands, 1, {}, [&](std::size_t begin, std::size_t end) {
    Sum sum;
    for (std::size_t b = begin; b < end; ++b) sum += rows(static_cast<int>(b) * kBandRows, std::min(height, static_cast<int>(b + 1) * kBandRows));
    return sum;
  });
}

/// 2 radius + 1 weights that sum to 1.
std::vector<double> gaussian(double sigma, int radius);

/// A band of rows of one quantity.
struct Rows {
  int width = 0, count = 0;
  std::vector<double> values;
  Rows(int width_px, int rows) : width(width_px), count(rows), values(static_cast<std::size_t>(width_px) * static_cast<std::size_t>(rows)) {}
  double* row(int y) { return values.data() + static_cast<std::ptrdiff_t>(y) * width; }
  const double* row(int y) const { return values.data() + static_cast<std::ptrdiff_t>(y) * width; }
};

/// Correlates every row with the kernel; the row's end values go on beyond its ends.
Rows along_rows(const Rows& in, const std::vector<double>& kernel);
/// Correlates columns; `in` has `halo` rows more above and below than the result.
Rows along_columns(const Rows& in, int halo, const std::vector<double>& kernel);

}  // namespace chiaro::tools
