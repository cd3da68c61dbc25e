#include "optimize/photo_band.h"

#include <algorithm>
#include <array>
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

double relative_gradient(const PhotoBand& band, int x, int y, const PixelNoise& noise) {
  constexpr double kNoise = 6.2;   // what noise alone makes of it: the larger of two squared differences that share a pixel, along two axes
  const std::array<const std::vector<float>*, 3> channels{&band.r, &band.g, &band.b};
  const std::size_t i = band.at(x, y);
  std::array<double, 3> sum{}, brightness{};
  for (std::size_t c = 0; c < 3; ++c) brightness[c] = static_cast<double>((*channels[c])[i]);
  for (const auto& [dx, dy] : {std::pair{1, 0}, std::pair{0, 1}}) {
    std::array<double, 3> best{};
    for (const int sign : {-1, 1}) {
      if (!band.contains(x + sign * dx, y + sign * dy)) continue;
      const std::size_t j = band.at(x + sign * dx, y + sign * dy);
      if (!band.usable(j)) continue;
      for (std::size_t c = 0; c < 3; ++c) {
        const auto value = static_cast<double>((*channels[c])[j]);
        best[c] = std::max(best[c], std::fabs(value - static_cast<double>((*channels[c])[i])));
        brightness[c] += value;
      }
    }
    for (std::size_t c = 0; c < 3; ++c) sum[c] += best[c] * best[c];
  }
  const auto c = static_cast<std::size_t>(std::max_element(brightness.begin(), brightness.end()) - brightness.begin());
  const double value = std::max(0.0, static_cast<double>((*channels[c])[i])), variance = noise.variance(value);
  return std::sqrt(std::max(0.0, sum[c] - kNoise * variance)) / std::max({1e-9, value, std::sqrt(variance)});
}

Vec3f pixel_point(const stream::Camera& camera, const Vec3d& origin_in_world, int x, int y, float depth) {
  const auto direction = stream::unproject(camera.lens, {x + 0.5, y + 0.5});
  if (!direction) return Vec3f::Zero();
  return (camera.pose.world_from_camera(*direction * static_cast<double>(depth)) - origin_in_world).cast<float>();
}

}  // namespace chiaro::optimize
