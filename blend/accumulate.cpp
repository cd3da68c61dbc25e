#include "blend/accumulate.h"

#include <algorithm>
#include <cmath>
#include <limits>

namespace chiaro::blend {

namespace {

void add_middle(std::span<MiddleSum> middle, const Sample& sample, float high_band_power) {
  const auto bands = static_cast<float>(middle.size());
  for (std::size_t i = 0; i < middle.size(); ++i) {
    const float power = 1 + (high_band_power - 1) * (bands - static_cast<float>(i)) / (bands + 1), weight = std::pow(sample.weight, power);
    const Vec3f band = (i == 0 ? sample.low : sample.wider[i - 1]) - sample.wider[i];
    middle[i][0] += weight;
    for (std::size_t c = 0; c < 3; ++c) middle[i][c + 1] += weight * band[static_cast<Eigen::Index>(c)];
  }
}

}  // namespace

void add_sample(Accumulator& sum, const Sample& sample, float high_band_power, std::span<MiddleSum> middle) {
  add_middle(middle, sample, high_band_power);
  const Vec3f& lowest = middle.empty() ? sample.low : sample.wider[middle.size() - 1];
  const float low = sample.weight;
  const auto weight = static_cast<double>(sample.weight);
  const double high = high_band_power == 1.5f ? weight * std::sqrt(weight) : std::pow(weight, static_cast<double>(high_band_power)), high_deviation = high * static_cast<double>(sample.sigma);
  sum.low_weight += low;
  sum.high_weight += high;
  for (int c = 0; c < 3; ++c) {
    sum.low[c] += low * lowest[c];
    sum.high[c] += high * static_cast<double>(sample.high[c]);
  }
  sum.low_variance += (low * sample.sigma) * (low * sample.sigma);
  sum.shared += low * sample.shared;
  sum.weight_square += low * low;
  sum.low_square += low * lowest.mean() * lowest.mean();
  sum.high_variance += high_deviation * high_deviation;
  ++sum.photographs;
}

namespace {

/// Relative standard deviation of the low band's mean, from the readings alone; 0 where there is one, or where they have no mean to be relative to.
float deviation_by_scatter(const Accumulator& sum) {
  const double weight = static_cast<double>(sum.low_weight), mean = (static_cast<double>(sum.low[0]) + static_cast<double>(sum.low[1]) + static_cast<double>(sum.low[2])) / (3 * weight);
  const double independent = weight * weight / static_cast<double>(sum.weight_square);   // as many readings of equal weight
  constexpr double kLeastReadings = 1.001, kRounding = 4e-7;                             // sums of floats: what is left of a difference of nearly equal ones
  if (sum.photographs < 2 || !(independent > kLeastReadings) || !(mean > 0)) return 0;
  const double variance = static_cast<double>(sum.low_square) / weight / (mean * mean) - 1;
  return variance > kRounding ? static_cast<float>(std::sqrt(variance / (independent - 1))) : 0.0f;
}

}  // namespace

BlendedSurfel resolve(const Accumulator& sum, float shared_sigma, std::span<const MiddleSum> middle) {
  constexpr float kNaN = std::numeric_limits<float>::quiet_NaN();
  BlendedSurfel result{Vec3f::Constant(kNaN), kNaN, kNaN, 0};
  if (sum.photographs == 0 || !(sum.low_weight > 0)) return result;
  for (int c = 0; c < 3; ++c) result.albedo[c] = sum.low[c] / sum.low_weight + static_cast<float>(sum.high_weight > 0 ? sum.high[c] / sum.high_weight : 0);
  for (const MiddleSum& band : middle)
    for (std::size_t c = 0; c < 3; ++c)
      if (band[0] > 0) result.albedo[static_cast<Eigen::Index>(c)] += band[c + 1] / band[0];
  // Slow errors average with the low band's weights, pixel noise with the high band's; the larger one speaks.
  const float low = std::sqrt(sum.low_variance) / sum.low_weight;
  const auto high = static_cast<float>(sum.high_weight > 0 ? std::sqrt(sum.high_variance) / sum.high_weight : 0);
  const float independent = std::max({low, high, deviation_by_scatter(sum)}), shared = sum.shared / sum.low_weight;   // shared errors add by amplitude: they do not average out
  result.own_sigma = low > 0 || high > 0 ? independent : 0;
  result.sigma = std::sqrt(independent * independent + shared * shared + shared_sigma * shared_sigma);
  result.photographs = static_cast<std::uint16_t>(std::min<std::uint32_t>(sum.photographs, 65535));
  return result;
}

}  // namespace chiaro::blend
