#include <algorithm>
#include <cmath>

#include "tests/support/run_fixture.h"

namespace chiaro::test {

AlbedoError albedo_error(const PlyVertices& ply, const std::vector<std::array<double, 3>>& truth) {
  AlbedoError e;
  e.points = ply.size();
  const std::vector<double>& photos = ply.column("photos");
  const std::vector<double>* channels[3] = {&ply.column("albedo_r"), &ply.column("albedo_g"), &ply.column("albedo_b")};
  std::vector<double> ratios;
  for (std::size_t i = 0; i < ply.size() && i < truth.size(); ++i) {
    if (!(photos[i] >= 1)) continue;
    ++e.seen;
    for (std::size_t c = 0; c < 3; ++c) ratios.push_back((*channels[c])[i] / truth[i][c]);
  }
  if (ratios.empty()) return e;
  std::vector<double> sorted = ratios;
  std::sort(sorted.begin(), sorted.end());
  e.factor = 1 / sorted[sorted.size() / 2];
  for (const double r : ratios) {
    e.absolute += std::abs(r - 1) / static_cast<double>(ratios.size());
    e.scaled += std::abs(r * e.factor - 1) / static_cast<double>(ratios.size());
  }
  return e;
}

}  // namespace chiaro::test
