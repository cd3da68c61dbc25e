#include "stream/store/border_line.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <numbers>

namespace chiaro::stream {
namespace {

constexpr int kDirections = 64;
constexpr float kAlike = 0.05f;   // share of the reach within which two directions fit equally well

struct Directions {
  std::array<float, kDirections> u, v;
  Directions() {
    for (int d = 0; d < kDirections; ++d) {
      const double angle = 2 * std::numbers::pi * d / kDirections;
      u[d] = static_cast<float>(std::cos(angle));
      v[d] = static_cast<float>(std::sin(angle));
    }
  }
};

}  // namespace

std::optional<BorderLine> find_border_line(const std::vector<float>& x, const std::vector<float>& y, float reach, float most_distance, float margin) {
  static const Directions directions;
  std::array<float, kDirections> support{};   // 0 at least: the point itself
  for (std::size_t k = 0; k < x.size(); ++k) {
    if (x[k] * x[k] + y[k] * y[k] > reach * reach) continue;
    for (int d = 0; d < kDirections; ++d) support[d] = std::max(support[d], directions.u[d] * x[k] + directions.v[d] * y[k]);
  }
  const int best = static_cast<int>(std::min_element(support.begin(), support.end()) - support.begin());
  if (support[best] > most_distance) return std::nullopt;
  const auto fits = [&](int d) { return support[(d + kDirections) % kDirections] <= support[best] + kAlike * reach; };
  int first = best, last = best;
  while (last - first < kDirections / 2 && fits(first - 1)) --first;
  while (last - first < kDirections / 2 && fits(last + 1)) ++last;
  const int middle = ((first + last) / 2 + kDirections) % kDirections;
  return BorderLine{directions.u[middle], directions.v[middle], support[middle] + margin};
}

}  // namespace chiaro::stream
