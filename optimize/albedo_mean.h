/// The albedo that the photographs of an acquisition have together, on the proxy.
#pragma once
#include <cstdint>
#include <vector>

#include "optimize/gather.h"
#include "optimize/gloss_light.h"
#include "optimize/light_solve.h"
#include "optimize/observe.h"

namespace chiaro::optimize {

/// The lights as a photograph of another exposure has them.
Lights exposed(Lights lights, double ambient_scale);

/// Mean log albedo of every surfel over the photographs that see it.
struct AlbedoMean {
  std::vector<float> weight, sum;   ///< N, 3 N
  explicit AlbedoMean(std::size_t n) : weight(n, 0.0f), sum(3 * n, 0.0f) {}

  /// gathered: G of the photograph, 3 N.
  void add(const Transport& transport, const Observation& o, const std::vector<float>& gathered, const Lights& lights, const Proxy& proxy, const Viewpoint& from);

  /// Unseen surfels take the albedo of the nearest seen one (physics.md A.4; the median instead costs 5 % of the flash).
  std::vector<float> albedo(const std::vector<std::uint32_t>& nearest_seen) const;
};

/// For every surfel the nearest one that a photograph sees: itself where it is seen. Empty if none is.
std::vector<std::uint32_t> nearest_seen_surfels(const Proxy& proxy, const std::vector<std::uint16_t>& times_seen);

}  // namespace chiaro::optimize
