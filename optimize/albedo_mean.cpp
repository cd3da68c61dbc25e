#include "optimize/albedo_mean.h"

#include <algorithm>
#include <cmath>
#include <numeric>

#include "optimize/light_samples.h"
#include "stream/base/parallel.h"

namespace chiaro::optimize {

Lights exposed(Lights lights, double ambient_scale) {
  for (double& s : lights.sky) s *= ambient_scale;
  return lights;
}

void AlbedoMean::add(const Transport& transport, const Observation& o, const std::vector<float>& gathered, const Lights& lights, const Proxy& proxy, const Viewpoint& from) {
  parallel_blocks(weight.size(), 4096, [&](std::size_t b, std::size_t e) {
    for (std::size_t i = b; i < e; ++i) {
      if (!o.seen[i]) continue;
      LightSample s = sample_of(transport, o, gathered, i);
      if (lights.gloss.on) s.angles = gloss_angles(proxy.position[i], proxy.normal[i], from);
      const float w = static_cast<float>(sample_weight(lights, s));
      double ln[3];
      bool fine = true;
      for (int c = 0; c < 3; ++c) {
        const double h = irradiance(lights, s, c);
        fine = fine && h > 0 && s.radiosity[static_cast<std::size_t>(c)] > 0;
        ln[c] = fine ? std::log(body_radiosity(lights, s, c) / h) : 0;
      }
      if (!fine) continue;
      weight[i] += w;
      for (std::size_t c = 0; c < 3; ++c) sum[3 * i + c] += w * static_cast<float>(ln[c]);
    }
  });
}

std::vector<float> AlbedoMean::albedo(const std::vector<std::uint32_t>& nearest_seen) const {
  std::vector<float> out(sum.size());
  for (std::size_t i = 0; i < weight.size(); ++i) {
    const std::size_t j = weight[i] > 0 || nearest_seen.empty() ? i : nearest_seen[i];
    for (std::size_t c = 0; c < 3; ++c) out[3 * i + c] = weight[j] > 0 ? std::clamp(std::exp(sum[3 * j + c] / weight[j]), 0.0f, 0.98f) : 0.3f;
  }
  return out;
}

std::vector<std::uint32_t> nearest_seen_surfels(const Proxy& proxy, const std::vector<std::uint16_t>& times_seen) {
  std::vector<Vec3f> points;
  std::vector<std::uint32_t> ids;
  for (std::size_t i = 0; i < times_seen.size(); ++i)
    if (times_seen[i] > 0) {
      points.push_back(proxy.position[i]);
      ids.push_back(static_cast<std::uint32_t>(i));
    }
  std::vector<std::uint32_t> result(times_seen.size());
  std::iota(result.begin(), result.end(), 0u);
  if (points.empty()) return {};
  const NearestPoints nearest(points);
  parallel_blocks(times_seen.size(), 2048, [&](std::size_t b, std::size_t e) {
    for (std::size_t i = b; i < e; ++i) {
      std::uint32_t j;
      float d2;
      if (times_seen[i] == 0 && nearest.find(proxy.position[i], 1, &j, &d2) == 1) result[i] = ids[j];
    }
  });
  return result;
}

}  // namespace chiaro::optimize
