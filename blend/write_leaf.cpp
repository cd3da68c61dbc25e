#include "blend/write_leaf.h"

#include <cstring>

namespace chiaro::blend {

std::vector<BlendedSurfel> resolve_leaf(const LeafRecord<Accumulator>& record, float shared_sigma) {
  std::vector<BlendedSurfel> values;
  values.reserve(record.surfels.size());
  for (const Accumulator& sum : record.surfels) values.push_back(resolve(sum, shared_sigma));
  return values;
}

LeafStats write_leaf(stream::LayerWriter& writer, std::uint32_t chunk, const LeafRecord<Accumulator>& record, const std::vector<BlendedSurfel>& values) {
  const std::size_t n = record.surfels.size();
  std::vector<std::byte> planar(n * kLayerBytes);
  std::byte* albedo = planar.data();
  std::byte* sigma = albedo + n * 3 * sizeof(float);
  std::byte* photos = sigma + n * sizeof(float);
  LeafStats stats{n, 0, 0, record.counters};
  for (std::size_t i = 0; i < n; ++i) {
    const BlendedSurfel& s = values[i];
    for (std::size_t c = 0; c < 3; ++c) std::memcpy(albedo + (c * n + i) * sizeof(float), s.albedo.data() + c, sizeof(float));
    std::memcpy(sigma + i * sizeof(float), &s.sigma, sizeof(float));
    std::memcpy(photos + i * sizeof(std::uint16_t), &s.photographs, sizeof(std::uint16_t));
    stats.points_seen += s.photographs > 0;
    stats.points_disputed += record.surfels[i].rejected > 0;
  }
  writer.write_chunk(chunk, planar);
  return stats;
}

}  // namespace chiaro::blend
