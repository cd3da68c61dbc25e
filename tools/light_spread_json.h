/// What the photographs leave open about the lights, written and drawn.
#pragma once
#include <nlohmann/json_fwd.hpp>
#include <string>

#include "tools/light_spread.h"

namespace chiaro::tools {

/// As it stands in lights.json.
nlohmann::ordered_json to_json(const LightSpread& spread);

/// An SVG of the plane of flash and ambient light: the ellipses of one and two standard deviations around what was found, and the calibrated range. `light` is an entry of lights.json, `calibrated_range` its range or null. Empty where the entry lacks what it takes.
std::string light_spread_svg(const nlohmann::ordered_json& light, const nlohmann::ordered_json& calibrated_range);

}  // namespace chiaro::tools
