/// Albedo for points that no photograph saw, from the nearest seen ones: display only, never a measurement.
#pragma once
#include <vector>

#include "stream/store/layer.h"
#include "stream/store/store.h"

namespace chiaro::tools {

/// Fills the entries of `albedo` that are NaN: inverse-distance mean of the nearest seen surfels, first among those of the leaf within a few spacings, then
/// level by level among the coarser surfels of the nodes above, which reach beyond the leaf's borders. Returns how many were filled; entries
/// stay NaN only where nothing at all was seen.
std::size_t fill_unseen(const stream::Store& store, const stream::Layer& layer, const stream::Chunk& leaf, std::vector<Vec3f>& albedo);

}  // namespace chiaro::tools
