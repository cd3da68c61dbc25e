/// What the photographs leave open about the lights, in numbers (light_spread_json.h: as a picture): no value that hangs on a start or a prior should look like a measurement.
#pragma once
#include <array>

#include "optimize/light_solve.h"

namespace chiaro::tools {

/// The two ends, two standard deviations either way, of the direction in the plane of ln flash and ln ambient radiance that is least certain; what else was
/// solved follows as it correlates. Where the ambient light is none or unknown to a factor, the flash alone.
struct LightSpread {
  std::array<double, 2> flash_intensity{}, ambient{};
  std::array<double, 2> albedo_in_flash{};     ///< relative change of an albedo that only the flash lights: -0.1 = 10 % darker
  std::array<double, 2> albedo_in_ambient{};   ///< of one that only the ambient light reaches
};
LightSpread light_spread(const optimize::LightSolution& solution);

}  // namespace chiaro::tools
