#include "optimize/photo_band.h"

#include <algorithm>
#include <cmath>

namespace chiaro::optimize {

PhotoBand read_band(const stream::RasterReader& radiance, const stream::RasterReader& gbuffer, int y0, int rows) {
  PhotoBand band;
  band.y0 = y0;
  band.rows = rows;
  band.width = gbuffer.width();
  band.r = radiance.rows<float>("r", y0, rows);
  band.g = radiance.rows<float>("g", y0, rows);
  band.b = radiance.rows<float>("b", y0, rows);
  band.mask = radiance.rows<std::uint8_t>("mask", y0, rows);
  const auto plane = [&](const char* name) { return gbuffer.rows<float>(name, y0, rows); };
  band.depth = plane("depth");
  band.nx = plane("nx");
  band.ny = plane("ny");
  band.nz = plane("nz");
  band.radius = plane("radius");
  band.footprint = plane("footprint");
  band.cosv = plane("cosv");
  band.coverage = plane("coverage");
  band.edge = plane("edge");
  band.has_flash = gbuffer.has("flash");
  if (band.has_flash) {
    band.flash = plane("flash");
    band.spread = plane("spread");
    band.lit = plane("lit");
    band.shadow = plane("shadow");
  } else {
    band.flash.assign(band.depth.size(), 0.0f);
    band.spread = band.lit = band.shadow = band.flash;
  }
  return band;
}

double relative_gradient(const PhotoBand& band, int x, int y, double noise_variance) {
  constexpr double kNoise = 6.2;   // what noise alone makes of it: the larger of two squared differences that share a pixel, along two axes
  double sum = 0;
  const std::size_t i = band.at(x, y);
  for (const auto& [dx, dy] : {std::pair{1, 0}, std::pair{0, 1}}) {
    double best = 0;
    for (const int sign : {-1, 1}) {
      if (!band.contains(x + sign * dx, y + sign * dy)) continue;
      const std::size_t j = band.at(x + sign * dx, y + sign * dy);
      if (!band.usable(j)) continue;
      best = std::max(best, std::fabs(static_cast<double>(band.g[j] - band.g[i])));
    }
    sum += best * best;
  }
  return std::sqrt(std::max(0.0, sum - kNoise * noise_variance)) / std::max(1e-9, static_cast<double>(band.g[i]));
}

Vec3f pixel_point(const stream::Camera& camera, const Vec3d& origin_in_world, int x, int y, float depth) {
  const auto direction = stream::unproject(camera.lens, {x + 0.5, y + 0.5});
  if (!direction) return Vec3f::Zero();
  return (camera.pose.world_from_camera(*direction * static_cast<double>(depth)) - origin_in_world).cast<float>();
}

}  // namespace chiaro::optimize
