#include "optimize/observe.h"

#include <algorithm>
#include <cmath>
#include <functional>
#include <numbers>

#include "optimize/photo_band.h"
#include "stream/base/error.h"
#include "stream/base/file.h"
#include "stream/base/parallel.h"

namespace chiaro::optimize {
namespace {

constexpr float kPi = std::numbers::pi_v<float>;
constexpr int kBandRows = 256;
constexpr int kMaxReach = 6;          ///< pixels: a surfel that covers more is sampled at its middle
constexpr float kRegistrationPx = 0.3f;
constexpr float kMostShadowDoubt = 0.5f;   ///< nearer to a shadow's edge a pixel tells nothing about the lights

struct Projected {
  std::uint32_t surfel;
  float u, v, distance;
  float blur_px;   ///< diameter of the lens's blur
};

std::vector<Projected> project_all(const Proxy& proxy, const stream::Camera& camera) {
  std::vector<Projected> all(proxy.size());
  parallel_blocks(proxy.size(), 4096, [&](std::size_t b, std::size_t e) {
    for (std::size_t i = b; i < e; ++i) {
      all[i] = {static_cast<std::uint32_t>(i), -1, -1, 0, 0};
      const Vec3d p = camera.pose.camera_from_world(proxy.position[i].cast<double>() + proxy.origin_in_world);
      const auto pixel = stream::project(camera.lens, p);
      if (pixel && pixel->x() >= 0 && pixel->y() >= 0 && pixel->x() < camera.lens.width_px && pixel->y() < camera.lens.height_px)
        all[i] = {static_cast<std::uint32_t>(i), static_cast<float>(pixel->x()), static_cast<float>(pixel->y()), static_cast<float>(p.norm()), static_cast<float>(stream::blur_px(camera, p.z()))};
    }
  });
  all.erase(std::remove_if(all.begin(), all.end(), [](const Projected& p) { return p.distance <= 0; }), all.end());
  std::stable_sort(all.begin(), all.end(), [](const Projected& a, const Projected& b) { return static_cast<int>(a.v) < static_cast<int>(b.v); });
  return all;
}

/// Calls body(band, projected) for every proxy surfel that falls in the image, band by band, in parallel.
void for_each_projected(const Proxy& proxy, const ObserveInput& input, const std::function<void(const PhotoBand&, const Projected&)>& body) {
  const stream::RasterReader radiance(input.radiance), gbuffer(input.gbuffer);
  if (radiance.width() != gbuffer.width() || radiance.height() != gbuffer.height())
    throw Error(concat(input.radiance.string(), ": ", radiance.width(), " x ", radiance.height(), ", but its G-buffer has ", gbuffer.width(), " x ", gbuffer.height()));
  const std::vector<Projected> all = project_all(proxy, input.camera);
  std::size_t next = 0;
  for (int y0 = 0; y0 < gbuffer.height(); y0 += kBandRows) {
    const int y1 = std::min(gbuffer.height(), y0 + kBandRows);
    std::size_t end = next;
    while (end < all.size() && static_cast<int>(all[end].v) < y1) ++end;
    if (end > next) {
      const int first = std::max(0, y0 - kMaxReach - 1), last = std::min(gbuffer.height(), y1 + kMaxReach + 1);
      const PhotoBand band = read_band(radiance, gbuffer, first, last - first);
      parallel_blocks(end - next, 512, [&](std::size_t b, std::size_t e) {
        for (std::size_t i = next + b; i < next + e; ++i) body(band, all[i]);
      });
    }
    next = end;
  }
}

/// The pixel and the surfel lie on the same surface: same plane within what footprint and sampling explain, like normals, `cosine` between them.
bool same_surface(float cosine, const Vec3f& pixel_normal, const Vec3f& offset, float pixel_size, float radius) {
  if (cosine < 0.7f) return false;
  return std::fabs(pixel_normal.dot(offset)) < 1.5f * pixel_size + 0.5f * radius;
}

struct Footprint {
  double weight = 0, squares = 0, flash = 0, flash2 = 0, spread2 = 0;
  Vec3d colour = Vec3d::Zero(), colour2 = Vec3d::Zero();
};

}  // namespace

std::vector<float> visibility_votes(const Proxy& proxy, const ObserveInput& input) {
  std::vector<float> votes(proxy.size(), 0.0f);
  for_each_projected(proxy, input, [&](const PhotoBand& band, const Projected& p) {
    const int x = static_cast<int>(p.u), y = static_cast<int>(p.v);
    const std::size_t i = band.at(x, y);
    if (!(band.depth[i] > 0) || band.edge[i] < 1 + 0.5f * p.blur_px) return;
    const Vec3f offset = proxy.position[p.surfel] - pixel_point(input.camera, proxy.origin_in_world, x, y, band.depth[i]);
    if (!same_surface(std::fabs(band.normal(i).dot(proxy.normal[p.surfel])), band.normal(i), offset, band.footprint[i], proxy.radius[p.surfel])) return;   // whichever side
    votes[p.surfel] = band.normal(i).dot(proxy.normal[p.surfel]) > 0 ? band.cosv[i] : -band.cosv[i];
  });
  return votes;
}

Observation observe(const Proxy& proxy, const ObserveInput& input) {
  const std::size_t n = proxy.size();
  Observation o;
  o.seen.assign(n, 0);
  o.radiosity.assign(3 * n, 0.0f);
  o.flash.assign(n, 0.0f);
  o.spread.assign(n, 0.0f);
  o.variance.assign(n, 0.0f);
  o.noise.assign(n, 0.0f);
  o.gradient.assign(n, 0.0f);
  o.tan_flash.assign(n, 0.0f);
  for_each_projected(proxy, input, [&](const PhotoBand& band, const Projected& p) {
    const std::size_t s = p.surfel;
    const int cx = static_cast<int>(p.u), cy = static_cast<int>(p.v);
    const std::size_t middle = band.at(cx, cy);
    if (!band.usable(middle) || band.edge[middle] < 1.5f + 0.5f * p.blur_px || band.cosv[middle] < 0.1f) return;
    const float radius_px = proxy.radius[s] / band.footprint[middle];
    const float reach = std::clamp(0.8f * radius_px, 1.0f, static_cast<float>(kMaxReach));
    const int half = static_cast<int>(std::ceil(reach));
    Footprint f;
    for (int y = cy - half; y <= cy + half; ++y)
      for (int x = cx - half; x <= cx + half; ++x) {
        if (!band.contains(x, y)) continue;
        const float du = static_cast<float>(x) + 0.5f - p.u, dv = static_cast<float>(y) + 0.5f - p.v;
        const float w = 1 - std::sqrt(du * du + dv * dv) / (reach + 0.5f);
        const std::size_t i = band.at(x, y);
        if (w <= 0 || !band.usable(i) || band.shadow[i] > kMostShadowDoubt) continue;
        const Vec3f offset = proxy.position[s] - pixel_point(input.camera, proxy.origin_in_world, x, y, band.depth[i]);
        // The back of a thin wall has another irradiance than its front, which is what is gathered.
        if (!same_surface(band.normal(i).dot(proxy.normal[s]), band.normal(i), offset, band.footprint[i], proxy.radius[s])) continue;
        const double wd = static_cast<double>(w), e = static_cast<double>(band.flash[i]), spread = static_cast<double>(band.spread[i]);
        const Vec3d c = band.colour(i).cast<double>();
        f.weight += wd;
        f.squares += wd * wd;
        f.colour += wd * c;
        f.colour2 += wd * c.cwiseProduct(c);
        f.flash += wd * e;
        f.flash2 += wd * e * e * (1 + spread * spread);
      }
    if (f.weight < 0.3) return;
    const Vec3d mean = f.colour / f.weight;
    if (!(mean.minCoeff() > 0)) return;   // darker than the noise: says nothing in logarithms
    const double flash = f.flash / f.weight;
    double variance = 0, noise_alone = 0;
    for (int c = 0; c < 3; ++c) {
      const double noise = input.noise.variance(mean[c]) * f.squares / (f.weight * f.weight);
      // Scatter of the pixels stands for the image gradient: a shift of kRegistrationPx, or what the lens spreads, moves the mean by that share of it.
      const double scatter = std::max(0.0, f.colour2[c] / f.weight - mean[c] * mean[c]);
      const double shift = static_cast<double>(std::hypot(kRegistrationPx, 0.25f * p.blur_px) / reach);
      noise_alone += noise / (mean[c] * mean[c]) / 3;
      variance += (noise + scatter * shift * shift) / (mean[c] * mean[c]) / 3;
    }
    o.seen[s] = 1;
    for (int c = 0; c < 3; ++c) o.radiosity[3 * s + static_cast<std::size_t>(c)] = kPi * static_cast<float>(mean[c]);
    o.flash[s] = static_cast<float>(flash);
    o.spread[s] = flash > 0 ? static_cast<float>(std::sqrt(std::max(0.0, f.flash2 / f.weight - flash * flash)) / flash) : 0.0f;
    o.variance[s] = static_cast<float>(variance);
    o.noise[s] = static_cast<float>(noise_alone);
    o.gradient[s] = static_cast<float>(relative_gradient(band, cx, cy, input.noise));
  });
  return o;
}

void cast_flash(const Proxy& proxy, const surfels::Tracer& tracer, const Vec3d& flash_in_world, Observation& o) {
  const Vec3f flash = (flash_in_world - proxy.origin_in_world).cast<float>();
  const Vec3f shift = (proxy.origin_in_world - tracer.origin_in_world()).cast<float>();
  const auto m2 = static_cast<float>(proxy.metres_per_unit * proxy.metres_per_unit);
  parallel_blocks(proxy.size(), 1024, [&](std::size_t b, std::size_t e) {
    for (std::size_t i = b; i < e; ++i) {
      const Vec3f to_flash = flash - proxy.position[i];
      const float r2 = to_flash.squaredNorm(), r = std::sqrt(r2), cosine = proxy.normal[i].dot(to_flash) / r;
      o.tan_flash[i] = cosine > 0.05f ? std::sqrt(std::max(0.0f, 1 - cosine * cosine)) / cosine : 20.0f;
      if (o.seen[i]) continue;
      o.flash[i] = 0;
      if (!(cosine > 0)) continue;
      if (!tracer.occluded(surfels::escape_ray(proxy.position[i] + shift, proxy.normal[i], proxy.radius[i], to_flash / r, r))) o.flash[i] = cosine / (r2 * m2);
    }
  });
}

std::uint64_t observation_bytes(std::size_t n) { return n * (1 + 9 * std::uint64_t{4}); }

void write_observation(const Observation& o, const std::filesystem::path& path) {
  File file(path, File::Mode::kCreate);
  std::uint64_t at = o.seen.size();
  file.write_at(0, o.seen.data(), o.seen.size());
  for (const auto* v : {&o.radiosity, &o.flash, &o.spread, &o.variance, &o.noise, &o.gradient, &o.tan_flash}) {
    file.write_at(at, v->data(), v->size() * 4);
    at += v->size() * 4;
  }
  file.close();
}

void write_radiosity(const Observation& o, const std::filesystem::path& path) {
  File file(path, File::Mode::kReadWrite);
  file.write_at(o.seen.size(), o.radiosity.data(), o.radiosity.size() * 4);
  file.close();
}

Observation read_observation(const std::filesystem::path& path, std::size_t n) {
  const File file(path, File::Mode::kRead);
  if (file.size() != observation_bytes(n)) throw Error(concat(path.string(), ": ", file.size(), " bytes, expected ", observation_bytes(n)));
  Observation o;
  std::uint64_t at = n;
  o.seen.resize(n);
  file.read_at(0, o.seen.data(), n);
  for (auto* v : {&o.radiosity, &o.flash, &o.spread, &o.variance, &o.noise, &o.gradient, &o.tan_flash}) {
    v->resize(v == &o.radiosity ? 3 * n : n);
    file.read_at(at, v->data(), v->size() * 4);
    at += v->size() * 4;
  }
  return o;
}

}  // namespace chiaro::optimize
