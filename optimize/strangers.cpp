#include "optimize/strangers.h"

#include <algorithm>
#include <cmath>

namespace chiaro::optimize {
namespace {

constexpr int kRounds = 24;

double median(std::vector<double>& v) {
  const auto mid = v.begin() + static_cast<std::ptrdiff_t>(v.size() / 2);
  std::nth_element(v.begin(), mid, v.end());
  if (v.size() % 2 == 1) return *mid;
  return 0.5 * (*mid + *std::max_element(v.begin(), mid));
}

/// ln albedo of a surfel as one photograph has it.
struct Reading {
  std::uint32_t group, photograph;
  double ln_albedo;
};

/// Of surfels that so many flash photographs have measured.
std::vector<Reading> readings_of(std::span<const LightSample> samples, const Lights& lights, std::size_t least) {
  std::vector<Reading> all, shared;
  for (const LightSample& s : samples) {
    if (!s.flash_photograph) continue;
    double sum = 0;
    bool fine = true;
    for (int c = 0; c < 3; ++c) {
      const double h = irradiance(lights, s, c), b = body_radiosity(lights, s, c);
      fine = fine && h > 0 && b > 0;
      if (fine) sum += std::log(b / h) / 3;
    }
    if (fine) all.push_back({s.group, s.photograph, sum});
  }
  for (std::size_t i = 0; i < all.size();) {
    std::size_t e = i + 1;
    while (e < all.size() && all[e].group == all[i].group) ++e;
    if (e - i >= least) shared.insert(shared.end(), all.begin() + static_cast<std::ptrdiff_t>(i), all.begin() + static_cast<std::ptrdiff_t>(e));
    i = e;
  }
  return shared;
}

/// One round: how far each photograph lies off the median of the others, given the factors so far.
std::vector<std::vector<double>> differences(const std::vector<Reading>& readings, const std::vector<double>& ln_factor) {
  std::vector<std::vector<double>> found(ln_factor.size());
  std::vector<double> others;
  for (std::size_t i = 0; i < readings.size();) {
    std::size_t e = i + 1;
    while (e < readings.size() && readings[e].group == readings[i].group) ++e;
    for (std::size_t k = i; k < e; ++k) {
      others.clear();
      for (std::size_t o = i; o < e; ++o)
        if (o != k) others.push_back(readings[o].ln_albedo - ln_factor[readings[o].photograph]);
      found[readings[k].photograph].push_back(readings[k].ln_albedo - ln_factor[readings[k].photograph] - median(others));
    }
    i = e;
  }
  return found;
}

/// ln of each photograph's brightness beside the others'; `compared`: those that share enough surfels.
std::vector<double> brightnesses(const std::vector<Reading>& readings, std::size_t photographs, std::size_t least_surfels, std::vector<std::size_t>& compared) {
  std::vector<double> ln_factor(photographs, 0.0);
  for (int round = 0; round < kRounds; ++round) {
    std::vector<std::vector<double>> found = differences(readings, ln_factor);
    compared.clear();
    for (std::size_t k = 0; k < found.size(); ++k) {
      if (found[k].size() < least_surfels) continue;
      compared.push_back(k);
      ln_factor[k] += 0.5 * median(found[k]);   // half: two photographs that differ meet in the middle
    }
  }
  return ln_factor;
}

}  // namespace

std::vector<bool> strangers(std::span<const LightSample> samples, const Lights& lights, std::size_t photographs, const StrangerOptions& options) {
  const std::vector<Reading> readings = readings_of(samples, lights, 3);
  std::vector<std::size_t> compared;
  const std::vector<double> ln_factor = brightnesses(readings, photographs, options.least_surfels, compared);
  std::vector<std::vector<double>> found = differences(readings, ln_factor);
  std::vector<double> scatter(photographs, 0.0), typical;
  for (const std::size_t k : compared) {
    const double middle = median(found[k]);
    for (double& v : found[k]) v = std::fabs(v - middle);
    scatter[k] = 1.4826 * median(found[k]);
    typical.push_back(scatter[k]);
  }
  std::vector<bool> is(photographs, false);
  if (typical.size() < 3) return is;
  const double limit = std::max(options.least, options.least_ratio * median(typical));
  for (std::size_t k = 0; k < photographs; ++k) is[k] = scatter[k] >= limit;
  return is;
}

}  // namespace chiaro::optimize
