/// New points beside the layer of a run, where the project asks for them (blend.refine). For the .cpp files of `run` only.
#pragma once
#include <nlohmann/json.hpp>
#include <span>
#include <string>

#include "blend/blend.h"
#include "stream/store/store.h"

namespace chiaro::tools {

struct RunContext;

/// The layer that was blended: its key, and blend_record_json() of it.
struct BlendedLayer {
  std::string key;
  const nlohmann::ordered_json& record;
};

/// Inserts points and blends their albedo, with what the layer's blend has found of the photographs; enters counts, notes and "refinement" in the record.
/// Where the project does not ask for it, those of an earlier run go. Returns a key of what was inserted; "" where nothing was asked for.
std::string refine_run_layer(RunContext& run, const stream::Store& store, std::span<const blend::BlendPhotograph> photographs, blend::BlendOptions options, const BlendedLayer& layer);

}  // namespace chiaro::tools
