#include "optimize/photo_band.h"

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

Vec3f pixel_point(const stream::Camera& camera, const Vec3d& origin_in_world, int x, int y, float depth) {
  const auto direction = stream::unproject(camera.lens, {x + 0.5, y + 0.5});
  if (!direction) return Vec3f::Zero();
  return (camera.pose.world_from_camera(*direction * static_cast<double>(depth)) - origin_in_world).cast<float>();
}

}  // namespace chiaro::optimize
