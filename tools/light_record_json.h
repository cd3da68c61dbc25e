/// The lights of an acquisition as the record of the task that found them: what a later run goes on from. For .cpp files only.
#pragma once
#include <nlohmann/json.hpp>
#include <vector>

#include "optimize/acquisition.h"

namespace chiaro::tools {

nlohmann::ordered_json evidence_json(const std::vector<optimize::SkyEvidence>& evidence);
nlohmann::ordered_json error_json(const optimize::ErrorModel& e);
/// null: Lambert's surfaces.
nlohmann::ordered_json gloss_json(const optimize::Gloss& g);
/// null: none.
nlohmann::ordered_json falloff_json(const optimize::Falloff& f);
optimize::Falloff falloff_from_json(const nlohmann::ordered_json& j);
/// A list of rows.
nlohmann::ordered_json covariance_json(const optimize::LightSolution& s);
nlohmann::ordered_json light_json(const optimize::AcquisitionResult& r);
/// Of light_json(). throws nlohmann's exceptions where it is something else.
optimize::AcquisitionResult lights_from_json(const nlohmann::ordered_json& j);

}  // namespace chiaro::tools
