/// What the photographs leave open about the lights, in numbers and as a picture: no value that hangs on a start or a prior should look like a measurement.
#pragma once
#include <array>
#include <nlohmann/json_fwd.hpp>
#include <optional>
#include <string>

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

/// As it stands in lights.json.
nlohmann::ordered_json to_json(const LightSpread& spread);

/// An SVG of the plane of flash and ambient light: the ellipses of one and two standard deviations around what was found, the calibrated range, the least certain
/// direction. `light` is an entry of lights.json, `calibrated_range` its range or null. Empty where the entry lacks what it takes.
std::string light_spread_svg(const nlohmann::ordered_json& light, const nlohmann::ordered_json& calibrated_range);

}  // namespace chiaro::tools
