#include "stream/photo/noise.h"

#include <algorithm>
#include <cmath>

namespace chiaro::stream {
namespace {

constexpr std::size_t kMaxBlocks = 30000, kMinBlocks = 40, kMaxBins = 24, kMinPerBin = 20;
constexpr double kQuantile = 0.25;
/// The 25 % quantile of the block variances of pure white noise, as a share of the true variance (simulated, 16x16 blocks: see the test).
constexpr double kQuantileOfWhiteNoise = 0.906;

struct Bin {
  double value, variance;
};

/// Weighted least squares of variance = gain * value + read^2 with both parts not negative; relative errors count, so weights are 1 / variance^2.
NoiseModel fit_line(const std::vector<Bin>& bins) {
  NoiseModel model;
  double gain = 0, read2 = 0;
  for (int round = 0; round < 8; ++round) {
    double s = 0, sz = 0, szz = 0, sv = 0, szv = 0;
    for (const Bin& bin : bins) {
      const double expected = round == 0 ? bin.variance : gain * bin.value + read2;
      const double w = 1 / std::max(expected * expected, 1e-40);
      s += w;
      sz += w * bin.value;
      szz += w * bin.value * bin.value;
      sv += w * bin.variance;
      szv += w * bin.value * bin.variance;
    }
    const double det = s * szz - sz * sz;
    gain = det > 1e-12 * s * szz ? (s * szv - sz * sv) / det : 0;
    read2 = (sv - gain * sz) / s;
    if (gain < 0) {
      gain = 0;
      read2 = sv / s;
    } else if (read2 < 0) {
      read2 = 0;
      gain = szz > 0 ? szv / szz : 0;
    }
  }
  model.gain = gain;
  model.read_sigma = std::sqrt(std::max(read2, 0.0));
  model.estimated = true;
  return model;
}

}  // namespace

NoiseEstimator::NoiseEstimator(int width_px, int height_px) : width_(width_px), stride_(1) {
  const std::uint64_t blocks = static_cast<std::uint64_t>(width_px / kBlock) * static_cast<std::uint64_t>(height_px / kBlock) * 3;
  stride_ = static_cast<int>(blocks / kMaxBlocks + 1);
}

void NoiseEstimator::add_band(int y0, int rows, const std::vector<float> (&rgb)[3], const std::vector<std::uint8_t>& good) {
  const int columns = width_ / kBlock;
  const std::size_t width = static_cast<std::size_t>(width_);
  for (int by = 0; by + kBlock <= rows; by += kBlock)
    for (int bx = 0; bx < columns; ++bx) {
      if (((y0 + by) / kBlock * columns + bx) % stride_ != 0) continue;
      const std::size_t corner = static_cast<std::size_t>(by) * width + static_cast<std::size_t>(bx) * kBlock;
      bool usable = true;
      for (std::size_t r = 0; r < kBlock && usable; ++r)
        usable = std::all_of(good.begin() + static_cast<std::ptrdiff_t>(corner + r * width), good.begin() + static_cast<std::ptrdiff_t>(corner + r * width + kBlock),
                             [](std::uint8_t g) { return g != 0; });
      if (!usable) continue;
      for (const std::vector<float>& plane : rgb) {
        const float* p = plane.data() + corner;
        double sum = 0, energy = 0;
        for (std::size_t r = 0; r < kBlock; ++r)
          for (std::size_t c = 0; c < kBlock; ++c) sum += static_cast<double>(p[r * width + c]);
        for (std::size_t r = 1; r + 1 < kBlock; ++r)
          for (std::size_t c = 1; c + 1 < kBlock; ++c) {
            const float* q = p + r * width + c;
            const double d = 4.0 * q[0] - 2.0 * (static_cast<double>(q[-1]) + q[1] + *(q - width) + q[width]) +
                             (static_cast<double>(*(q - width - 1)) + *(q - width + 1) + q[width - 1] + q[width + 1]);
            energy += d * d;
          }
        const double variance = energy / (36.0 * (kBlock - 2) * (kBlock - 2));  // the nine weights squared sum to 36
        if (variance > 0) blocks_.push_back({static_cast<float>(sum / (kBlock * kBlock)), static_cast<float>(variance)});
      }
    }
}

std::optional<NoiseModel> NoiseEstimator::fit() const {
  if (blocks_.size() < kMinBlocks) return std::nullopt;
  std::vector<Block> sorted = blocks_;
  std::sort(sorted.begin(), sorted.end(), [](const Block& a, const Block& b) { return a.mean != b.mean ? a.mean < b.mean : a.variance < b.variance; });
  const std::size_t num_bins = std::clamp<std::size_t>(sorted.size() / kMinPerBin, 1, kMaxBins);
  NoiseModel model{0, 1, true};
  // Inside a bin variances are compared as multiples of the last fit: else the quantile would favour the bin's darkest blocks.
  for (int round = 0; round < 4; ++round) {
    const double least = 1e-9 * std::max(model.variance(static_cast<double>(sorted.back().mean)), 1e-30);
    const auto expected = [&](double z) { return std::max(model.variance(z), least); };
    std::vector<Bin> bins;
    for (std::size_t i = 0; i < num_bins; ++i) {
      const std::size_t begin = i * sorted.size() / num_bins, end = (i + 1) * sorted.size() / num_bins;
      std::vector<double> ratios;
      double value = 0;
      for (std::size_t k = begin; k < end; ++k) {
        const double z = std::max(static_cast<double>(sorted[k].mean), 0.0);
        ratios.push_back(static_cast<double>(sorted[k].variance) / expected(z));
        value += z;
      }
      value /= static_cast<double>(end - begin);
      const auto at = ratios.begin() + static_cast<std::ptrdiff_t>(kQuantile * static_cast<double>(ratios.size()));
      std::nth_element(ratios.begin(), at, ratios.end());
      bins.push_back({value, *at / kQuantileOfWhiteNoise * expected(value)});
    }
    model = fit_line(bins);
  }
  return model;
}

}  // namespace chiaro::stream
