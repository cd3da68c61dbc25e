#include "tools/synth_render.h"

#include <algorithm>
#include <cmath>
#include <numbers>
#include <stdexcept>

#include "optimize/gloss_light.h"
#include "stream/base/parallel.h"
#include "stream/base/rng.h"
#include "tools/synth_scene.h"

namespace chiaro::tools {
namespace {

constexpr double kPi = std::numbers::pi;
constexpr std::uint32_t kDrawsPerPath = 64;   // one a segment
static_assert(kMostBounces < 63);

/// Cosine-distributed about the normal.
Vec3d direction_about(const Vec3d& normal, double u, double v) {
  const Vec3d helper = std::abs(normal.z()) < 0.9 ? Vec3d(0, 0, 1) : Vec3d(1, 0, 0);
  const Vec3d x = normal.cross(helper).normalized(), y = normal.cross(x);
  const double r = std::sqrt(u), phi = 2 * kPi * v;
  return (r * std::cos(phi) * x + r * std::sin(phi) * y + std::sqrt(std::max(0.0, 1 - u)) * normal).normalized();
}

double fraction(double v) { return v - std::floor(v); }

Vec3d albedo_at(const Vec3d& p) { return synth_albedo(p).cast<double>(); }

/// Share of the light that goes on to other surfaces.
Vec3d sent_on(const SynthLights& lights, const Vec3d& p) {
  const Vec3d albedo = albedo_at(p);
  if (!lights.gloss.on) return albedo;
  return albedo * (optimize::kMeanTransmission * optimize::kMeanTransmission) + Vec3d::Constant(lights.gloss.reflectance * optimize::kMeanReflection);
}

struct Photograph {
  const SynthBody& body;
  const SynthLights& lights;
  const SynthView& view;
  const SynthPixels& pixels;
  Vec3d eye, flash;

  /// Radiance of what a ray sees, by one path. stratum: which of samples^2 equal parts of the hemisphere the path starts in.
  Vec3d radiance(const BodyHit& hit, std::uint64_t pixel, std::uint32_t stratum) const {
    const Vec3d albedo = albedo_at(hit.position);
    const Vec3d direct = Vec3d::Constant(flash_irradiance(body, lights, flash, hit) / kPi);
    Vec3d other = Vec3d::Zero();
    if (lights.bounces > 0 || lights.ambient_radiance > 0) {
      // The parts are shifted by an offset of the pixel's own: each path for itself is then even over the hemisphere, wherever in the pixel it starts.
      const auto shift = uniform01x4(pixels.seed, Purpose::kPixelJitter, pixel, 0), jitter = uniform01x4(pixels.seed, Purpose::kPixelJitter, pixel, 1 + stratum);
      const auto n = static_cast<std::uint32_t>(pixels.samples);
      const double u = fraction((stratum / n + static_cast<double>(jitter[0])) / n + static_cast<double>(shift[0]));
      const double v = fraction((stratum % n + static_cast<double>(jitter[1])) / n + static_cast<double>(shift[1]));
      other = incoming_by_one_path(body, lights, flash, hit, u, v, pixels.seed, pixel, stratum);
    }
    if (!lights.gloss.on) return albedo.cwiseProduct(direct + other);
    const optimize::GlossAngles angles = optimize::gloss_angles(hit.position.cast<float>(), hit.normal.cast<float>(), {eye.cast<float>(), flash.cast<float>()});
    const optimize::CoatFactors f = optimize::coat_factors(lights.gloss, angles);
    return albedo.cwiseProduct(f.direct * direct + f.other * other) + f.direct_mirrored * direct + f.other_mirrored * other;
  }

  void pixel(int x, int y, float* rgb, std::uint8_t& covered) const {
    const int n = pixels.samples;
    const std::uint64_t index = static_cast<std::uint64_t>(y) * static_cast<std::uint64_t>(view.lens.width_px) + static_cast<std::uint64_t>(x);
    Vec3d sum = Vec3d::Zero();
    int hits = 0;
    for (int s = 0; s < n * n; ++s) {
      const Vec3d in_camera((x + (s % n + 0.5) / n - view.lens.cx) / view.lens.fx, (y + (s / n + 0.5) / n - view.lens.cy) / view.lens.fy, 1);
      const auto hit = body.hit(eye, (view.pose.rotation_camera_from_world.transpose() * in_camera).normalized());
      if (!hit) continue;
      ++hits;
      sum += radiance(*hit, index, static_cast<std::uint32_t>(s));
    }
    for (int c = 0; c < 3; ++c) rgb[c] = static_cast<float>(noisy(sum[c] / (n * n), 3 * index + static_cast<std::uint64_t>(c)));
    covered = hits == n * n ? 255 : 0;
  }

  double noisy(double value, std::uint64_t element) const {
    const double variance = pixels.gain * value + pixels.read_sigma * pixels.read_sigma;
    return variance > 0 ? value + std::sqrt(variance) * normal01(pixels.seed, Purpose::kNoise, element, 0) : value;
  }
};

void check(const SynthLights& lights, const SynthView& view, const SynthPixels& pixels) {
  if (pixels.samples < 1 || pixels.samples > 64) throw std::invalid_argument("render_synth_rows: 1 .. 64 samples");
  if (lights.bounces < 0 || lights.bounces > kMostBounces) throw std::invalid_argument("render_synth_rows: 0 .. 60 bounces");
  if (view.lens.kind != stream::LensKind::kPerspective || view.lens.width_px < 1 || view.lens.height_px < 1) throw std::invalid_argument("render_synth_rows: lens");
}

}  // namespace

double flash_irradiance(const SynthBody& body, const SynthLights& lights, const Vec3d& flash, const BodyHit& hit) {
  const Vec3d to_flash = flash - hit.position;
  const double r2 = to_flash.squaredNorm(), r = std::sqrt(r2), cosine = hit.normal.dot(to_flash) / r;
  if (!(cosine > 0) || !(lights.flash_intensity > 0)) return 0;
  const Vec3d start = hit.position + SynthBody::kLift * hit.normal, way = flash - start;
  return body.occluded(start, way.normalized(), way.norm()) ? 0 : lights.flash_intensity * cosine / r2;
}

Vec3d incoming_by_one_path(const SynthBody& body, const SynthLights& lights, const Vec3d& flash, const BodyHit& from, double u, double v, std::uint64_t seed, std::uint64_t element,
                           std::uint32_t draw) {
  Vec3d light = Vec3d::Zero(), share = Vec3d::Ones();
  BodyHit at = from;
  for (int segment = 0; segment <= lights.bounces; ++segment) {
    if (segment == lights.bounces && !(lights.ambient_radiance > 0)) break;
    const Vec3d direction = direction_about(at.normal, u, v);
    const auto next = body.hit(at.position + SynthBody::kLift * at.normal, direction);
    if (!next) return light + lights.ambient_radiance * share;
    if (segment == lights.bounces) break;
    at = *next;
    const Vec3d albedo = sent_on(lights, at.position);
    share = share.cwiseProduct(albedo);
    light += flash_irradiance(body, lights, flash, at) / kPi * share;
    // From here on a path goes on as often as light would, and those that do stand for the others: the mean stays, and long paths are rare.
    const auto r = uniform01x4(seed, Purpose::kSynth, element, draw * kDrawsPerPath + static_cast<std::uint32_t>(segment));
    const double survival = albedo.maxCoeff();
    if (!(static_cast<double>(r[2]) < survival)) break;
    share /= survival;
    u = static_cast<double>(r[0]);
    v = static_cast<double>(r[1]);
  }
  return light;
}

void render_synth_rows(const SynthBody& body, const SynthLights& lights, const SynthView& view, const SynthPixels& pixels, int y0, int y1, std::span<float> rgb,
                       std::span<std::uint8_t> covered) {
  check(lights, view, pixels);
  const auto width = static_cast<std::size_t>(view.lens.width_px), rows = static_cast<std::size_t>(y1 - y0);
  if (rgb.size() != 3 * width * rows || covered.size() != width * rows) throw std::invalid_argument("render_synth_rows: size of the buffers");
  const Photograph photograph{body, lights, view, pixels, view.pose.centre_in_world(), view.flash_in_scene()};
  parallel_blocks(rows, 1, [&](std::size_t begin, std::size_t end) {
    for (std::size_t row = begin; row < end; ++row)
      for (std::size_t x = 0; x < width; ++x)
        photograph.pixel(static_cast<int>(x), y0 + static_cast<int>(row), rgb.data() + 3 * (row * width + x), covered[row * width + x]);
  });
}

}  // namespace chiaro::tools
