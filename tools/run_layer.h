/// The last stages of a run: from the albedo of each photograph to the layer of the store, what it leaves unexplained, and the exports.
#pragma once
#include <vector>

#include "stream/store/store.h"

namespace chiaro::tools {

struct RunContext;
struct Shoot;

/// Blends the photographs of all shoots into a layer, writes their residuals, work/cameras.json and the exports.
void write_run_layer(RunContext& run, const stream::Store& store, const std::vector<Shoot>& shoots);

}  // namespace chiaro::tools
