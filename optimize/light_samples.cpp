#include "optimize/light_samples.h"

#include <algorithm>
#include <cmath>

#include "optimize/photo_band.h"
#include "stream/base/parallel.h"
#include "stream/base/rng.h"

namespace chiaro::optimize {

std::optional<Vec3d> flash_in_world(const AcquisitionInput& input, std::size_t k) {
  const ObserveInput& p = input.photographs[k];
  if (!p.flash_in_camera) return std::nullopt;
  return p.camera.pose.world_from_camera(*p.flash_in_camera);
}

LightSample sample_of(const Transport& transport, const Observation& o, const std::vector<float>& gathered, std::size_t i) {
  LightSample s;
  for (std::size_t c = 0; c < 3; ++c) {
    s.radiosity[c] = o.radiosity[3 * i + c];
    s.gathered[c] = gathered[3 * i + c];
  }
  s.flash = o.flash[i];
  for (std::size_t k = 0; k < kSkyTerms; ++k) s.sky[k] = transport.sky[i * kSkyTerms + k];
  if (!transport.hidden.empty())
    for (std::size_t k = 0; k < kSkyTerms; ++k) s.hidden[k] = transport.hidden[i * kSkyTerms + k];
  if (!o.floor_flash.empty()) s.floor_flash = o.floor_flash[i];
  s.variance = o.variance[i];
  s.noise = o.noise[i];
  s.gradient = o.gradient[i];
  s.spread = o.spread[i];
  s.tan_flash = o.tan_flash[i];
  return s;
}

std::vector<std::uint32_t> choose_surfels(const std::vector<std::uint16_t>& times_seen, int at_least, std::size_t count, std::uint64_t seed, std::size_t most_readings) {
  std::vector<std::pair<float, std::uint32_t>> order;
  for (std::size_t i = 0; i < times_seen.size(); ++i)
    if (times_seen[i] >= at_least) order.emplace_back(uniform01(seed, Purpose::kSampleChoice, i, 0), static_cast<std::uint32_t>(i));
  std::sort(order.begin(), order.end());
  if (order.size() > count) order.resize(count);
  std::vector<std::uint32_t> chosen;
  std::size_t readings = 0;
  for (const auto& [hash, i] : order) {
    readings += times_seen[i];
    if (readings > most_readings && !chosen.empty()) break;
    chosen.push_back(i);
  }
  std::sort(chosen.begin(), chosen.end());
  return chosen;
}

std::vector<LightSample> thinned(const std::vector<LightSample>& samples, std::size_t most) {
  std::size_t groups = 0;
  const auto begins = [&](std::size_t i) { return i == 0 || samples[i].group != samples[i - 1].group; };
  for (std::size_t i = 0; i < samples.size(); ++i) groups += begins(i);
  const std::size_t step = std::max<std::size_t>(1, groups / std::max<std::size_t>(1, most));
  std::vector<LightSample> left;
  std::size_t group = 0;
  for (std::size_t i = 0; i < samples.size(); ++i) {
    if (begins(i)) ++group;
    if (group % step == 0) left.push_back(samples[i]);
  }
  return left;
}

namespace {

float chroma_distance(const Observation& o, std::size_t a, std::size_t b) {
  const auto chroma = [&](std::size_t i) {
    const Vec3f c(o.radiosity[3 * i], o.radiosity[3 * i + 1], o.radiosity[3 * i + 2]);
    return Vec3f(c / c.sum());
  };
  return (chroma(a) - chroma(b)).norm();
}

}  // namespace

std::vector<Pair> choose_pairs(const Scene& scene, const Observation& o, std::size_t count, std::uint64_t seed) {
  const Proxy& proxy = scene.proxy;
  std::vector<std::uint16_t> seen(o.seen.begin(), o.seen.end());
  const std::vector<std::uint32_t> starts = choose_surfels(seen, 1, count, seed);
  constexpr float kScales[] = {4, 12, 36, 108, 324};
  constexpr float kChromaSigma = 0.02f;
  std::vector<std::vector<Pair>> found(starts.size());
  parallel_blocks(starts.size(), 256, [&](std::size_t b, std::size_t e) {
    for (std::size_t s = b; s < e; ++s) {
      const std::uint32_t i = starts[s];
      for (std::size_t scale = 0; scale < std::size(kScales); ++scale) {
        const auto u = uniform01x4(seed, Purpose::kPairChoice, i, static_cast<std::uint32_t>(scale));
        const float z = 2 * u[0] - 1, r = std::sqrt(std::max(0.0f, 1 - z * z)), phi = 6.2831853f * u[1];
        Vec3f direction(r * std::cos(phi), r * std::sin(phi), z);
        std::uint32_t j;
        float d2;
        if (scene.nearest->find(proxy.position[i] + direction * (kScales[scale] * proxy.radius[i]), 1, &j, &d2) == 0 || j == i || !o.seen[j]) continue;
        const float chroma = chroma_distance(o, i, j);
        const float trust = std::exp(-0.5f * chroma * chroma / (kChromaSigma * kChromaSigma));
        if (trust > 0.01f) found[s].push_back({i, j, trust});
      }
    }
  });
  std::vector<Pair> pairs;
  for (const auto& f : found) pairs.insert(pairs.end(), f.begin(), f.end());
  return pairs;
}

namespace {

constexpr double kReadingSd = 0.003;                          ///< of a target's mean brightness, relative
constexpr double kLeastNormalSd = 0.005, kNormalSd = 0.0175;  ///< of a target's normal

bool inside(const std::vector<Vec2d>& polygon, const Vec2d& p) {
  bool in = false;
  for (std::size_t i = 0, j = polygon.size() - 1; i < polygon.size(); j = i++) {
    const Vec2d &a = polygon[i], &b = polygon[j];
    if ((a.y() > p.y()) != (b.y() > p.y()) && p.x() < (b.x() - a.x()) * (p.y() - a.y()) / (b.y() - a.y()) + a.x()) in = !in;
  }
  return in;
}

}  // namespace

double unknown_share(const Transport& transport, const Stencil& stencil, std::span<const float> radiosity, std::span<const std::uint16_t> times_seen) {
  const auto rays = static_cast<std::size_t>(transport.rays);
  double unknown = 0, all = 0;
  for (std::size_t k = 0; k < kStencil; ++k)
    for (std::size_t r = stencil.index[k] * rays; r < (stencil.index[k] + 1) * rays; ++r) {
      const std::uint32_t j = transport.hits[r];
      if (j == Transport::kSky) continue;
      const double light = static_cast<double>(stencil.weight[k]) * static_cast<double>(radiosity[3 * j] + radiosity[3 * j + 1] + radiosity[3 * j + 2]);
      all += light;
      if (times_seen[j] == 0) unknown += light;
    }
  return all > 0 ? unknown / all : 0;
}

std::optional<ReferenceReading> read_reference(const Scene& scene, const AcquisitionInput& input, const ReferenceTarget& target) {
  const ObserveInput& photo = input.photographs[target.photograph];
  const stream::RasterReader radiance(photo.radiance), gbuffer(photo.gbuffer);
  double y0 = 1e9, y1 = -1e9, x0 = 1e9, x1 = -1e9;
  for (const Vec2d& p : target.polygon) {
    x0 = std::min(x0, p.x());
    x1 = std::max(x1, p.x());
    y0 = std::min(y0, p.y());
    y1 = std::max(y1, p.y());
  }
  const int first = std::max(0, static_cast<int>(std::floor(y0))), last = std::min(gbuffer.height(), static_cast<int>(std::ceil(y1)));
  const int left = std::max(0, static_cast<int>(std::floor(x0))), right = std::min(gbuffer.width(), static_cast<int>(std::ceil(x1)));
  if (first >= last || left >= right) return std::nullopt;
  const PhotoBand band = read_band(radiance, gbuffer, first, last - first);
  Vec3d colour = Vec3d::Zero();
  double squares = 0, noise = 0;   // of the green channel: squared values, variance of the pixels
  Vec3f point = Vec3f::Zero(), normal = Vec3f::Zero();
  double flash = 0, spread = 0;
  int count = 0;
  for (int y = first; y < last; ++y)
    for (int x = left; x < right; ++x) {
      const std::size_t i = band.at(x, y);
      if (!inside(target.polygon, {x + 0.5, y + 0.5}) || band.mask[i] != 1 || !(band.depth[i] > 0)) continue;
      colour += band.colour(i).cast<double>();
      squares += static_cast<double>(band.g[i]) * static_cast<double>(band.g[i]);
      noise += photo.noise.variance(std::max(0.0, static_cast<double>(band.g[i])));
      flash += static_cast<double>(band.flash[i]);
      spread += static_cast<double>(band.spread[i]);
      point += pixel_point(photo.camera, scene.proxy.origin_in_world, x, y, band.depth[i]);
      normal += band.normal(i);
      ++count;
    }
  if (count == 0 || !(colour.minCoeff() > 0)) return std::nullopt;
  ReferenceReading reading;
  reading.photograph = target.photograph;
  reading.reference.albedo = target.albedo;
  // Reading error: a target is even, so what varies over it beside noise is light that the model does not follow; its mean is off by about half of that.
  const double green = colour[1] / count, uneven = std::sqrt(std::max(0.0, (squares - noise) / count - green * green)) / green;
  reading.reference.sigma = std::hypot(target.sigma, kReadingSd, 0.5 * uneven);
  // And flat: what its pixels' normals scatter by about their mean, along one direction, says how far that may be off.
  const double length = static_cast<double>(normal.norm()) / count;
  reading.reference.normal_rad = std::clamp(std::sqrt(std::max(0.0, 1 - length * length) / 2), kLeastNormalSd, kNormalSd);
  LightSample& s = reading.reference.sample;
  s.photograph = static_cast<std::uint32_t>(target.photograph);
  for (int c = 0; c < 3; ++c) s.radiosity[static_cast<std::size_t>(c)] = static_cast<float>(3.14159265358979 * colour[c] / count);
  s.flash = static_cast<float>(flash / count);
  s.spread = static_cast<float>(spread / count);
  const double mean = colour.mean() / count;
  s.variance = static_cast<float>(photo.noise.variance(mean) / (mean * mean * count));
  const Vec3f middle = point / static_cast<float>(count), n = normal.normalized();
  reading.place = middle;
  reading.normal = n;
  reading.stencil = stencil_at(scene.proxy, *scene.nearest, middle, n);
  s.sky = interpolate<kSkyTerms>(reading.stencil, scene.transport.sky);
  for (float& t : s.sky) t *= static_cast<float>(photo.ambient_scale);
  if (scene.floor) {
    s.hidden = interpolate<kSkyTerms>(reading.stencil, scene.transport.hidden);
    for (float& t : s.hidden) t *= static_cast<float>(photo.ambient_scale);
  }
  if (const auto at = flash_in_world(input, target.photograph)) {
    const Vec3f to_flash = (*at - scene.proxy.origin_in_world).cast<float>() - middle;
    const float cosine = std::max(0.05f, n.dot(to_flash.normalized()));
    s.tan_flash = std::sqrt(std::max(0.0f, 1 - cosine * cosine)) / cosine;
  }
  return reading;
}

}  // namespace chiaro::optimize
