/// lights.json of a run: what was found of the lights of each acquisition, how, and how certain it is.
#pragma once
#include <vector>

namespace chiaro::tools {

struct RunContext;
struct Shoot;

void write_run_lights(const RunContext& run, const std::vector<Shoot>& shoots);

}  // namespace chiaro::tools
