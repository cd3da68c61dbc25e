/// The stages that tell light from albedo: the lights of an acquisition, then the albedo of each of its photographs.
#pragma once
#include <cstddef>
#include <vector>

#include "stream/store/store.h"

namespace chiaro::tools {

struct RunContext;
struct Shoot;

/// Finds the lights of all shoots that share those of number `lead`. Nothing where none has a flash. throws Error where no photograph shows the cloud well enough.
void solve_lights(RunContext& run, const stream::Store& store, std::vector<Shoot>& shoots, std::size_t lead);
/// The albedo of each photograph of a shoot whose lights are known; those that show something else than the others are left out.
void solve_albedo(RunContext& run, const stream::Store& store, const std::vector<Shoot>& shoots, Shoot& shoot);
/// Instead of both, where no light is to be solved: the photograph's own colour.
void take_colour(RunContext& run, Shoot& shoot);

}  // namespace chiaro::tools
