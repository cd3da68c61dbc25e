#include "blend/denoise.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <span>

#include "stream/base/nearest_points.h"

namespace chiaro::blend {
namespace {

constexpr std::size_t kNeighbours = 16, kMostNeighbours = 48;
constexpr float kNoiseLeft = 0.01f;         // of ln albedo: as many neighbours as bring it down to this, if values are alike
constexpr float kExact = 0.01f;             // no value counts for more than this deviation
constexpr float kLikeness = 2, kLeastLikeness = 0.02f;   // values further apart than twice their deviations, and this, are another colour
constexpr float kGuidedLikeness = 1;        // and once those of values without most of their noise
constexpr float kSmoothest = 0.005f;        // of ln albedo: no surface is more even

/// Weighted sums over a surfel and its neighbours.
struct Surroundings {
  std::array<std::uint32_t, kMostNeighbours + 1> index{};
  std::array<float, kMostNeighbours + 1> weight{};
  std::size_t count = 0;
  float weights = 0;
};

/// What colours are compared by: values, and their deviations.
struct Colours {
  std::span<const Vec3f> log_albedo;
  std::span<const float> sd;
  float likeness;
};

float alike(const NoisySurfels& s, const Colours& colours, std::uint32_t a, std::uint32_t b) {
  float cosine = s.normal[a].dot(s.normal[b]);
  if (!s.oriented[a] || !s.oriented[b]) cosine = std::abs(cosine);
  if (!(cosine > 0)) return 0;
  const float noise = colours.sd[a] * colours.sd[a] + colours.sd[b] * colours.sd[b] + kLeastLikeness * kLeastLikeness;
  const float apart = (colours.log_albedo[a] - colours.log_albedo[b]).squaredNorm() / 3;
  return cosine * cosine * cosine * cosine * std::exp(-apart / (2 * colours.likeness * colours.likeness * noise));
}

Surroundings surroundings_of(const NoisySurfels& s, const Colours& colours, const NearestPoints& nearest, std::uint32_t i, float reach, std::size_t neighbours) {
  Surroundings around;
  std::array<std::uint32_t, kMostNeighbours + 1> found{};
  std::array<float, kMostNeighbours + 1> squared{};
  const std::size_t n = nearest.find(s.position[i], neighbours + 1, found.data(), squared.data());
  const auto add = [&](std::uint32_t j, float likeness) {
    const float w = likeness / (s.sd[j] * s.sd[j] + kExact * kExact);
    around.index[around.count] = j;
    around.weight[around.count++] = w;
    around.weights += w;
  };
  add(i, 1);
  for (std::size_t k = 0; k < n && around.count <= neighbours; ++k)
    if (found[k] != i && squared[k] <= reach * reach) add(found[k], alike(s, colours, i, found[k]));
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

std::size_t neighbours_for(float sd) {
  const float wanted = sd / kNoiseLeft * (sd / kNoiseLeft);
  return wanted > static_cast<float>(kNeighbours) ? static_cast<std::size_t>(std::min(wanted, static_cast<float>(kMostNeighbours))) : kNeighbours;
}

}  // namespace

void NoisySurfels::resize(std::size_t n) {
  position.resize(n);
  normal.resize(n);
  oriented.resize(n);
  log_albedo.resize(n);
  sd.resize(n);
}

bool takes_two_steps(float sd) { return neighbours_for(sd) > kNeighbours; }

std::vector<Denoised> denoise(const NoisySurfels& surfels, std::size_t count, float reach) {
  if (count == 0) return {};
  const NearestPoints nearest(surfels.position);
  const bool guided = std::any_of(surfels.sd.begin(), surfels.sd.begin() + static_cast<std::ptrdiff_t>(count), takes_two_steps);
  const Colours own{surfels.log_albedo, surfels.sd, kLikeness};
  std::vector<Denoised> result(guided ? surfels.size() : count);
  for (std::uint32_t i = 0; i < result.size(); ++i)
    result[i] = surfels.sd[i] > 0 ? denoised(surfels, surroundings_of(surfels, own, nearest, i, reach, kNeighbours), i) : Denoised{surfels.log_albedo[i], 0};
  if (!guided) return result;
  std::vector<Vec3f> log_albedo;
  std::vector<float> sd;
  for (const Denoised& d : result) {
    log_albedo.push_back(d.log_albedo);
    sd.push_back(d.sd);
  }
  const Colours guide{log_albedo, sd, kGuidedLikeness};
  result.resize(count);
  for (std::uint32_t i = 0; i < count; ++i) {
    if (!takes_two_steps(surfels.sd[i])) continue;
    const Denoised second = denoised(surfels, surroundings_of(surfels, guide, nearest, i, reach, neighbours_for(surfels.sd[i])), i);
    // What it gains in sigma is not stated: neighbours further away, chosen to be alike, share more of what is wrong (crypt: z 1.43 instead of 1.19).
    result[i] = {second.log_albedo, std::max(second.sd, result[i].sd)};
  }
  return result;
}

}  // namespace chiaro::blend
