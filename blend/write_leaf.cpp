#include "blend/write_leaf.h"

#include <cmath>
#include <cstring>

namespace chiaro::blend {

std::vector<BlendedSurfel> resolve_leaf(const LeafRecord<Accumulator>& record, float shared_sigma) {
  std::vector<BlendedSurfel> values;
  values.reserve(record.surfels.size());
  const std::size_t n = record.surfels.size(), bands = n > 0 ? record.more.size() / n : 0;
  for (std::size_t i = 0; i < n; ++i) values.push_back(resolve(record.surfels[i], shared_sigma, std::span(record.more).subspan(i * bands, bands)));
  return values;
}

void Denoising::add(const Denoising& other) {
  points += other.points;
  points_changed += other.points_changed;
  sigma_before += other.sigma_before;
  sigma_after += other.sigma_after;
}

Denoising compared(const std::vector<BlendedSurfel>& before, const std::vector<BlendedSurfel>& after) {
  Denoising d;
  for (std::size_t i = 0; i < before.size(); ++i) {
    if (before[i].photographs == 0 || !std::isfinite(before[i].sigma) || !std::isfinite(after[i].sigma)) continue;
    ++d.points;
    d.points_changed += before[i].albedo != after[i].albedo;
    d.sigma_before += static_cast<double>(before[i].sigma);
    d.sigma_after += static_cast<double>(after[i].sigma);
  }
  return d;
}

LeafStats write_leaf(stream::LayerWriter& writer, std::uint32_t chunk, const LeafRecord<Accumulator>& record, const std::vector<BlendedSurfel>& values) {
  const std::size_t n = record.surfels.size();
  std::vector<std::byte> planar(n * kLayerBytes);
  std::byte* albedo = planar.data();
  std::byte* sigma = albedo + n * 3 * sizeof(float);
  std::byte* photos = sigma + n * sizeof(float);
  LeafStats stats{n, 0, 0, {}};
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
