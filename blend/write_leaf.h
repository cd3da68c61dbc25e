/// From the sums of a leaf to its values in the layer.
#pragma once
#include <cstdint>
#include <vector>

#include "blend/accumulate.h"
#include "blend/blend.h"
#include "blend/leaf_file.h"
#include "stream/store/layer.h"

namespace chiaro::blend {

/// Of a surfel in the layer, as stream::albedo_fields().
inline constexpr std::size_t kLayerBytes = 4 * sizeof(float) + sizeof(std::uint16_t);

struct LeafStats {
  std::uint64_t points = 0, points_seen = 0, points_disputed = 0;
  Denoising denoising;
};

/// What denoising made of a leaf's values.
Denoising compared(const std::vector<BlendedSurfel>& before, const std::vector<BlendedSurfel>& after);

std::vector<BlendedSurfel> resolve_leaf(const LeafRecord<Accumulator>& record, float shared_sigma);
/// chunk: the leaf's number in the store; values: what is written of its surfels.
LeafStats write_leaf(stream::LayerWriter& writer, std::uint32_t chunk, const LeafRecord<Accumulator>& record, const std::vector<BlendedSurfel>& values);

}  // namespace chiaro::blend
