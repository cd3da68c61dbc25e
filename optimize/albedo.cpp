#include "optimize/albedo.h"

#include <algorithm>
#include <atomic>
#include <cmath>
#include <limits>
#include <numbers>

#include "optimize/fields.h"
#include "optimize/flash_place.h"
#include "optimize/gloss_light.h"
#include "optimize/photo_band.h"
#include "optimize/proxy_file.h"
#include "stream/base/error.h"
#include "stream/base/file.h"
#include "stream/base/parallel.h"

namespace chiaro::optimize {
namespace {

constexpr double kPi = std::numbers::pi;
constexpr float kNone = std::numeric_limits<float>::quiet_NaN();
constexpr int kBandRows = 128;
constexpr double kImpossible = 2;
constexpr double kBelowBlack = 6;      // deviations of the read noise: darker is no photograph of anything
constexpr double kCommon = 0.25;       // of the variance by which photographs disagree, what they have in common beside (measured on two rendered scenes)
constexpr double kShadowDoubt = 0.7;   // of the flash, where a shadow's edge may be on either side of the pixel

struct PixelAlbedo {
  std::array<float, 3> albedo{kNone, kNone, kNone};
  float sigma = kNone, shared = kNone, direct = 0, indirect = 0, ambient = 0;
  bool impossible = false;
};

struct Context {
  const Scene& scene;
  const ObserveInput& photograph;
  const LightSolution& solution;
  const std::vector<float>&gathered, &floor_flash;   ///< floor_flash empty: no floor
  const AlbedoOptions& options;
  double exposure, ambient_scale, ambient_ln_sd, exposure_ln_sd;
  Vec3f flash, flash_cast;   ///< where it is, and where rays were cast to; scene frame of the proxy
  Vec3f camera;
  const Falloff& falloff;
  double corner_sine;
};

double square(double v) { return v * v; }

/// Factors on what the pixel shows and on the flash there; variance of ln of the one that is not 1.
struct PixelFalloff {
  double lens = 1, flash = 1, variance = 0;
};

PixelFalloff falloff_at(const Context& c, const Vec3f& point) {
  if (c.falloff.none()) return {};
  const Mat3d& turn = c.photograph.camera.pose.rotation_camera_from_world;
  const Vec2d seen = off_axis(turn * (point - c.camera).cast<double>(), c.corner_sine), lit = off_axis(turn * (point - c.flash).cast<double>(), c.falloff.flash_corner_sine);
  return {lens_factor(c.falloff, seen), flash_pattern(c.falloff, lit), falloff_variance(c.falloff, seen, lit)};
}

PixelAlbedo solve_pixel(const Context& c, const PhotoBand& band, int x, int y) {
  PixelAlbedo out;
  const std::size_t i = band.at(x, y);
  if (band.mask[i] != 1 || !(band.depth[i] > 0)) return out;
  const Lights& lights = c.solution.lights;
  LightSample s;
  s.flash = band.flash[i];
  const Vec3f point = pixel_point(c.photograph.camera, c.scene.proxy.origin_in_world, x, y, band.depth[i]);
  if (c.flash != c.flash_cast) s.flash *= static_cast<float>(flash_factor(point.cast<double>(), band.normal(i).cast<double>(), c.flash_cast.cast<double>(), c.flash.cast<double>()));
  const PixelFalloff falloff = falloff_at(c, point);
  s.flash *= static_cast<float>(falloff.flash);
  if (!c.options.direct_only) {
    const Stencil stencil = stencil_at(c.scene.proxy, *c.scene.nearest, point, band.normal(i));
    s.sky = interpolate<kSkyTerms>(stencil, c.scene.transport.sky);
    s.gathered = interpolate<3>(stencil, c.gathered);
    if (lights.floor) s.hidden = interpolate<kSkyTerms>(stencil, c.scene.transport.hidden);
    if (!c.floor_flash.empty()) s.floor_flash = interpolate<1>(stencil, c.floor_flash)[0];
  }
  const double direct = lights.flash_intensity * static_cast<double>(s.flash), exposure = c.exposure * falloff.lens;
  double sky = 0, ambient = 0;   // as it falls in, before its colour; mean of the channels
  if (!c.options.direct_only) sky = c.ambient_scale * std::max(0.0, sky_irradiance(lights, s.sky, s.hidden));
  const double by_floor = lights.floor_albedo * lights.flash_intensity * static_cast<double>(s.floor_flash);
  const float colour[3] = {band.r[i], band.g[i], band.b[i]};
  double indirect_mean = 0, total_mean = 0;
  std::array<double, 3> h{}, radiosity{};
  for (std::size_t ch = 0; ch < 3; ++ch) {
    const double indirect = c.options.direct_only ? 0.0 : lights.bounce * static_cast<double>(s.gathered[ch]) + by_floor;
    h[ch] = direct + lights.sky_colour[ch] * sky + indirect;
    radiosity[ch] = kPi * static_cast<double>(colour[ch]) / exposure;
    ambient += lights.sky_colour[ch] * sky / 3;
    indirect_mean += indirect / 3;
    total_mean += h[ch] / 3;
  }
  if (!(total_mean > 0)) return out;
  CoatedAlbedo gloss;
  if (lights.gloss.on) gloss = coated_reading(lights.gloss, gloss_angles(point, band.normal(i), {c.camera, c.flash}), direct, h, radiosity);
  double noise = 0;
  for (std::size_t ch = 0; ch < 3; ++ch) {
    out.albedo[ch] = static_cast<float>(kPi * static_cast<double>(colour[ch]) / (exposure * h[ch]) * gloss.factor[ch]);
    // What is darker than its noise is known to be dark, and no more: a relative deviation of 1.
    const double z = std::max(static_cast<double>(colour[ch]), 0.0), variance = c.photograph.noise.variance(z);
    noise += variance / std::max({z * z, variance, 1e-18}) / 3;
  }
  noise *= square(gloss.noise);
  const double sd = direct / total_mean, sg = indirect_mean / total_mean, sf = by_floor / total_mean;
  // No surface gives back twice what it receives: the light at this pixel is not what it is taken for (a shadow's edge, a highlight).
  const double brightest = static_cast<double>(std::max({out.albedo[0], out.albedo[1], out.albedo[2]})), darkest = static_cast<double>(std::min({colour[0], colour[1], colour[2]}));
  if (brightest > kImpossible || darkest < -kBelowBlack * c.photograph.noise.read_sigma) {
    PixelAlbedo none;
    none.impossible = true;
    return none;
  }
  out.direct = static_cast<float>(sd);
  out.indirect = static_cast<float>(sg);
  out.ambient = static_cast<float>(ambient / total_mean);
  const Vec3f to_flash = c.flash - point;
  const double cosine = std::max(0.05, static_cast<double>(band.normal(i).dot(to_flash) / to_flash.norm()));
  const double tan_flash = std::sqrt(1 - std::min(1.0, cosine * cosine)) / cosine;
  // Lit or not is in doubt near the edge of a cast shadow, and what is brighter than a white surface would be there is not what it is taken for.
  const double m = c.scene.proxy.metres_per_unit, r = static_cast<double>(to_flash.norm());
  const double unshadowed = lights.flash_intensity * falloff.flash * std::max(0.0, static_cast<double>(band.normal(i).dot(to_flash)) / (r * r * r * m * m));
  const double shadow = kShadowDoubt * static_cast<double>(band.shadow[i]) * std::max(direct, unshadowed - direct) / total_mean;
  const double too_bright = brightest > 1 ? 2 * (1 - 1 / brightest) : 0;
  const ErrorModel& errors = c.options.errors;
  const stream::Camera& camera = c.photograph.camera;
  const double blur_sd_px = camera.focus.aperture > 0 ? stream::blur_px(camera, camera.pose.camera_from_world(point.cast<double>() + c.scene.proxy.origin_in_world).z()) / 4 : 0;
  const double own = (square(errors.registration_px) + square(blur_sd_px)) * square(relative_gradient(band, x, y, c.photograph.noise)) + square(errors.spread * sd * static_cast<double>(band.spread[i])) +
                     square(errors.other_light * (1 - sd)) + square(errors.rest) + square(kHighlightSd * gloss.highlight);
  const double ambient_factor = c.ambient_ln_sd * gloss.other * ambient / total_mean;   // of this photograph alone
  out.sigma = static_cast<float>(std::sqrt(noise + own + square(shadow) + square(too_bright) + square(ambient_factor) + square(c.exposure_ln_sd)));
  // Lights, normals and part of the rest are the same for all photographs of a surfel: they do not average out.
  const auto terms = static_cast<int>(c.solution.covariance.rows());
  double light = 0;
  if (terms >= 2) {
    Eigen::VectorXd j = Eigen::VectorXd::Zero(terms);
    j[0] = gloss.direct * sd + gloss.other * sf;
    const double sky_scale = c.ambient_scale * (lights.sky_colour[0] + lights.sky_colour[1] + lights.sky_colour[2]) / 3;   // in the mean over the channels
    for (int k = 0; k < c.solution.sky_terms; ++k) {
      const auto at = static_cast<std::size_t>(k);
      j[1 + k] = gloss.other * sky_scale * (static_cast<double>(s.sky[at]) - (k == 0 ? 1 - lights.floor_albedo : 1.0) * static_cast<double>(s.hidden[at])) / total_mean;
    }
    int next = 1 + c.solution.sky_terms;
    if (c.solution.sky_colour) {   // ln red and ln blue
      j[next++] = gloss.other * lights.sky_colour[0] * sky / (3 * total_mean);
      j[next++] = gloss.other * lights.sky_colour[2] * sky / (3 * total_mean);
    }
    if (lights.floor)
      j[next++] = gloss.other * (lights.flash_intensity * static_cast<double>(s.floor_flash) + sky_scale * lights.sky[0] * static_cast<double>(s.hidden[0])) / total_mean;
    if (lights.gloss.on) {
      j[next++] = gloss.reflectance;
      j[next++] = gloss.roughness;
    }
    j[terms - 1] = gloss.other * (sg - sf) / std::max(1e-9, lights.bounce);
    light = j.dot(c.solution.covariance * j);
  }
  out.shared = static_cast<float>(std::sqrt(std::max(0.0, light) + falloff.variance * square(c.falloff.of_flash() ? sd : 1) + square(sd * tan_flash * errors.normal_rad) + kCommon * own));
  return out;
}

}  // namespace

std::vector<stream::PlaneInfo> albedo_planes() {
  std::vector<stream::PlaneInfo> planes;
  for (const char* name : {"r", "g", "b", "sigma", "shared", "direct", "indirect", "ambient"}) planes.push_back({name, stream::PlaneType::kF32, stream::Precision::kFine});
  return planes;
}

AlbedoStats solve_albedo(const Scene& scene, const ObserveInput& photograph, const LightSolution& lights, const Vec3d& flash_in_world,
                         const AlbedoInputs& inputs, const AlbedoOptions& options, const std::filesystem::path& raster, Reporter& report) {
  const stream::RasterReader radiance(photograph.radiance), gbuffer(photograph.gbuffer);
  const int width = gbuffer.width(), height = gbuffer.height();
  std::vector<float> gathered, floor_flash;
  if (!options.direct_only) gathered = read_floats(inputs.gathered, scene.proxy.size() * 3);
  if (!options.direct_only && lights.lights.floor) floor_flash = read_floats(inputs.floor_flash, scene.proxy.size());
  stream::RasterWriter out(raster, width, height, albedo_planes());
  const Vec3d flash = flash_in_world - scene.proxy.origin_in_world;
  const Context context{scene, photograph, lights, gathered, floor_flash, options, inputs.own.exposure, photograph.ambient_scale * inputs.own.ambient, inputs.own.ambient_ln_sd, inputs.own.exposure_ln_sd,
                        (flash + photograph.camera.pose.rotation_camera_from_world.transpose() * inputs.pattern.flash_shift).cast<float>(), flash.cast<float>(),
                        (photograph.camera.pose.centre_in_world() - scene.proxy.origin_in_world).cast<float>(), inputs.pattern.falloff, corner_sine(photograph.camera.lens)};
  AlbedoStats stats;
  std::vector<float> sigmas;
  report.begin(concat("albedo ", photograph.camera.photograph), static_cast<std::uint64_t>(height), "rows");
  for (int y0 = 0; y0 < height; y0 += kBandRows) {
    report.check();
    const int rows = std::min(kBandRows, height - y0), first = std::max(0, y0 - 1), last = std::min(height, y0 + rows + 1);
    const PhotoBand band = read_band(radiance, gbuffer, first, last - first);
    std::vector<PixelAlbedo> pixels(static_cast<std::size_t>(rows) * static_cast<std::size_t>(width));
    parallel_blocks(static_cast<std::size_t>(rows), 2, [&](std::size_t b, std::size_t e) {
      for (std::size_t row = b; row < e; ++row)
        for (int x = 0; x < width; ++x)
          pixels[row * static_cast<std::size_t>(width) + static_cast<std::size_t>(x)] = solve_pixel(context, band, x, y0 + static_cast<int>(row));
    });
    std::vector<float> values(pixels.size());
    const auto put = [&](const char* plane, auto&& get) {
      for (std::size_t i = 0; i < pixels.size(); ++i) values[i] = get(pixels[i]);
      out.write_rows<float>(plane, y0, values);
    };
    constexpr const char* kChannels[] = {"r", "g", "b"};
    for (std::size_t c = 0; c < 3; ++c) put(kChannels[c], [c](const PixelAlbedo& p) { return p.albedo[c]; });
    put("sigma", [](const PixelAlbedo& p) { return p.sigma; });
    put("shared", [](const PixelAlbedo& p) { return p.shared; });
    put("direct", [](const PixelAlbedo& p) { return p.direct; });
    put("indirect", [](const PixelAlbedo& p) { return p.indirect; });
    put("ambient", [](const PixelAlbedo& p) { return p.ambient; });
    for (const PixelAlbedo& p : pixels) {
      ++stats.pixels;
      stats.pixels_impossible += p.impossible;
      if (!(p.albedo[1] == p.albedo[1])) continue;
      ++stats.pixels_solved;
      stats.pixels_dark += p.direct < 0.05f;
      stats.pixels_above_one += std::max({p.albedo[0], p.albedo[1], p.albedo[2]}) > 1;
      if (stats.pixels_solved % 97 == 0) sigmas.push_back(std::hypot(p.sigma, p.shared));
    }
    report.progress(static_cast<std::uint64_t>(y0 + rows));
  }
  if (!sigmas.empty()) {
    std::nth_element(sigmas.begin(), sigmas.begin() + static_cast<std::ptrdiff_t>(sigmas.size() / 2), sigmas.end());
    stats.median_sigma = static_cast<double>(sigmas[sigmas.size() / 2]);
  }
  out.commit();
  report.end();
  return stats;
}

}  // namespace chiaro::optimize
