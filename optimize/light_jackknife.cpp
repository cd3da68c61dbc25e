#include "optimize/light_jackknife.h"

#include <algorithm>
#include <iterator>
#include <vector>

#include "optimize/light_residuals.h"

namespace chiaro::optimize {
namespace {

constexpr std::size_t kLots = 8, kLeastPhotographs = 3, kLeastGroups = 100;

}  // namespace

std::optional<double> ambient_variance_by_photographs(std::span<const LightSample> samples, std::span<const ReferenceSample> references, const LightSolveOptions& options, const LightSolution& solution) {
  std::vector<std::uint32_t> photographs;
  for (const LightSample& s : samples) photographs.push_back(s.photograph);
  std::sort(photographs.begin(), photographs.end());
  photographs.erase(std::unique(photographs.begin(), photographs.end()), photographs.end());
  if (photographs.size() < kLeastPhotographs || options.sky_terms == 0) return std::nullopt;
  const std::size_t lots = std::min(kLots, photographs.size());
  const auto lot_of = [&](std::uint32_t k) { return static_cast<std::size_t>(std::lower_bound(photographs.begin(), photographs.end(), k) - photographs.begin()) % lots; };
  std::vector<double> found;
  std::vector<LightSample> left;
  for (std::size_t lot = 0; lot < lots; ++lot) {
    left.clear();
    std::copy_if(samples.begin(), samples.end(), std::back_inserter(left), [&](const LightSample& s) { return lot_of(s.photograph) != lot; });
    if (groups_of(left).size() < kLeastGroups) return std::nullopt;
    found.push_back(solve_lights(left, references, options, solution.lights).lights.sky[0]);
  }
  double mean = 0, squares = 0;
  for (const double v : found) mean += v / static_cast<double>(lots);
  for (const double v : found) squares += (v - mean) * (v - mean);
  return squares * static_cast<double>(lots - 1) / static_cast<double>(lots);
}

}  // namespace chiaro::optimize
