/// How finely the photographs show each surfel of the cloud.
#pragma once
#include <filesystem>
#include <span>

#include "blend/blend.h"
#include "blend/leaf_file.h"

namespace chiaro::blend {

/// The reading that counts most.
struct Detail {
  float weight = 0;      ///< 0: no photograph sees the surfel
  float footprint = 0;   ///< of that photograph's pixel on the surface, see Sample
};

/// Walks all photographs over the leaves; goes on from `file` where it was interrupted. known: as in the options; none: every photograph where its camera says.
/// The result does not depend on threads, budget or order of photographs. throws Error, Cancelled.
LeafFile collect_detail(const stream::Store& store, std::span<const BlendPhotograph> photographs, const BlendOptions& options, const std::filesystem::path& file,
                        MemoryBudget& budget, Reporter& report);

}  // namespace chiaro::blend
