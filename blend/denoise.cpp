#include "blend/denoise.h"

#include <algorithm>
#include <array>
#include <cmath>

#include "stream/base/nearest_points.h"

namespace chiaro::blend {
namespace {

constexpr std::size_t kNeighbours = 16;     // 8 leave more noise, 24 and 32 change nothing but the time
constexpr float kExact = 0.01f;             // no value counts for more than this deviation
constexpr float kLikeness = 2, kLeastLikeness = 0.02f;   // values further apart than twice their deviations, and this, are another colour
constexpr float kSmoothest = 0.005f;        // of ln albedo: no surface is more even

/// Weighted sums over a surfel and its neighbours.
struct Surroundings {
  std::array<std::uint32_t, kNeighbours + 1> index{};
  std::array<float, kNeighbours + 1> weight{};
  std::size_t count = 0;
  float weights = 0;
};

float alike(const NoisySurfels& s, std::uint32_t a, std::uint32_t b) {
  float cosine = s.normal[a].dot(s.normal[b]);
  if (!s.oriented[a] || !s.oriented[b]) cosine = std::abs(cosine);
  if (!(cosine > 0)) return 0;
  const float noise = s.sd[a] * s.sd[a] + s.sd[b] * s.sd[b] + kLeastLikeness * kLeastLikeness;
  const float apart = (s.log_albedo[a] - s.log_albedo[b]).squaredNorm() / 3;
  return cosine * cosine * cosine * cosine * std::exp(-apart / (2 * kLikeness * kLikeness * noise));
}

Surroundings surroundings_of(const NoisySurfels& s, const NearestPoints& nearest, std::uint32_t i, float reach) {
  Surroundings around;
  std::array<std::uint32_t, kNeighbours + 1> found{};
  std::array<float, kNeighbours + 1> squared{};
  const std::size_t n = nearest.find(s.position[i], found.size(), found.data(), squared.data());
  const auto add = [&](std::uint32_t j, float likeness) {
    const float w = likeness / (s.sd[j] * s.sd[j] + kExact * kExact);
    around.index[around.count] = j;
    around.weight[around.count++] = w;
    around.weights += w;
  };
  add(i, 1);
  for (std::size_t k = 0; k < n && around.count < around.index.size(); ++k)
    if (found[k] != i && squared[k] <= reach * reach) add(found[k], alike(s, i, found[k]));
  return around;
}

Denoised denoised(const NoisySurfels& s, const Surroundings& around, std::uint32_t i) {
  Vec3f mean = Vec3f::Zero();
  for (std::size_t k = 0; k < around.count; ++k) mean += around.weight[k] / around.weights * s.log_albedo[around.index[k]];
  float variance = 0, noise = 0, noise_of_mean = 0;
  for (std::size_t k = 0; k < around.count; ++k) {
    const float share = around.weight[k] / around.weights, sd = s.sd[around.index[k]];
    variance += share * (s.log_albedo[around.index[k]] - mean).squaredNorm() / 3;
    noise += share * sd * sd;
    noise_of_mean += share * share * sd * sd;
  }
  const float own = s.sd[i] * s.sd[i], surface = std::max(variance - noise, kSmoothest * kSmoothest), kept = surface / (surface + own);
  // What neighbours have wrong alike (normals, places) does not average out, and does not show in how they differ; what shows does.
  const float shown = noise > 0 ? std::min(1.0f, variance / noise) : 1.0f;
  return {mean + kept * (s.log_albedo[i] - mean), std::sqrt(kept * own + (1 - kept) * (1 - kept) * (shown * noise_of_mean + (1 - shown) * noise))};
}

}  // namespace

void NoisySurfels::resize(std::size_t n) {
  position.resize(n);
  normal.resize(n);
  oriented.resize(n);
  log_albedo.resize(n);
  sd.resize(n);
}

std::vector<Denoised> denoise(const NoisySurfels& surfels, std::size_t count, float reach) {
  std::vector<Denoised> result(count);
  if (count == 0) return result;
  const NearestPoints nearest(surfels.position);
  for (std::uint32_t i = 0; i < count; ++i)
    result[i] = surfels.sd[i] > 0 ? denoised(surfels, surroundings_of(surfels, nearest, i, reach), i) : Denoised{surfels.log_albedo[i], 0};
  return result;
}

}  // namespace chiaro::blend
