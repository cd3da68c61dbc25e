#include "tests/blend/analytic_scene.h"

#include <algorithm>
#include <cmath>
#include <cstring>
#include <limits>
#include <numbers>

#include "blend/bands.h"
#include "stream/base/file.h"
#include "stream/base/parallel.h"
#include "stream/base/rng.h"
#include "stream/photo/raster.h"

namespace chiaro::blend::testing {
namespace {

constexpr int kSub = 4;

void keep_nearest(std::optional<AnalyticScene::Hit>& best, double t, const Vec3d& normal) {
  if (t > 1e-9 && (!best || t < best->distance)) best = AnalyticScene::Hit{t, normal};
}

struct PixelPlanes {
  std::vector<float> depth, nx, ny, nz, radius, footprint, cosv, coverage, edge, r, g, b, sigma;
  std::vector<std::uint8_t> mask;
  explicit PixelPlanes(std::size_t n) {
    for (auto* p : {&depth, &nx, &ny, &nz, &radius, &footprint, &cosv, &coverage, &edge, &r, &g, &b, &sigma}) p->assign(n, 0);
    mask.assign(n, 1);
  }
};

void render_pixel(const AnalyticScene& scene, const stream::Camera& camera, const ShotOptions& options, int x, int y, PixelPlanes& out) {
  const auto i = static_cast<std::size_t>(y) * static_cast<std::size_t>(camera.lens.width_px) + static_cast<std::size_t>(x);
  const Vec3d eye = camera.pose.centre_in_world();
  int hits = 0;
  double depth = 0;
  Vec3d normal = Vec3d::Zero();
  Vec3f albedo = Vec3f::Zero();
  for (int s = 0; s < kSub * kSub; ++s) {
    const Vec2d at(x + (s % kSub + 0.5) / kSub, y + (s / kSub + 0.5) / kSub);
    const auto ray = stream::unproject(camera.lens, at);
    if (!ray) continue;
    const Vec3d direction = camera.pose.rotation_camera_from_world.transpose() * *ray;
    const auto hit = scene.cast(eye, direction);
    if (!hit) continue;
    ++hits;
    depth += hit->distance;
    normal += hit->normal.dot(direction) < 0 ? hit->normal : Vec3d(-hit->normal);
    albedo += options.gain * scene.albedo(eye + hit->distance * direction);
  }
  out.sigma[i] = options.sigma;
  if (hits == 0) {
    out.r[i] = out.g[i] = out.b[i] = std::numeric_limits<float>::quiet_NaN();
    out.mask[i] = 0;
    return;
  }
  depth /= hits;
  albedo /= static_cast<float>(hits);
  normal.normalize();
  const Vec3d view = camera.pose.rotation_camera_from_world.transpose() * *stream::unproject(camera.lens, Vec2d(x + 0.5, y + 0.5));
  if (options.paint) albedo = options.paint(x, y, albedo);
  out.depth[i] = static_cast<float>(depth);
  out.nx[i] = static_cast<float>(normal.x());
  out.ny[i] = static_cast<float>(normal.y());
  out.nz[i] = static_cast<float>(normal.z());
  out.radius[i] = static_cast<float>(0.75 * scene.spacing);
  out.footprint[i] = static_cast<float>(depth / camera.lens.fx);
  out.cosv[i] = static_cast<float>(std::abs(normal.dot(view)));
  out.coverage[i] = static_cast<float>(hits) / (kSub * kSub);
  out.r[i] = albedo.x();
  out.g[i] = albedo.y();
  out.b[i] = albedo.z();
  if (hits < kSub * kSub) out.mask[i] = 0;
  if (options.mask) out.mask[i] = options.mask(x, y);
}

struct DepthSample {
  float depth = 0, footprint = 0, cosv = 0, radius = 0;
};
bool depth_breaks(const DepthSample& a, const DepthSample& b) {
  if (!(a.depth > 0 && b.depth > 0)) return true;
  const float c = std::max(0.05f, std::min(a.cosv, b.cosv)), slope = std::sqrt(std::max(0.0f, 1 - c * c)) / c;
  return std::abs(a.depth - b.depth) > 2 * std::max(a.footprint, b.footprint) * (0.5f + slope) + std::max(a.radius, b.radius);
}

std::vector<float> edge_distances(const PixelPlanes& p, int width, int height) {
  std::vector<std::uint8_t> edge(p.depth.size());
  const auto sample = [&](std::size_t i) { return DepthSample{p.depth[i], p.footprint[i], p.cosv[i], p.radius[i]}; };
  for (int y = 0; y < height; ++y)
    for (int x = 0; x < width; ++x) {
      const auto i = static_cast<std::size_t>(y * width + x);
      if (p.coverage[i] < 1) edge[i] = 1;
      if (x + 1 < width && depth_breaks(sample(i), sample(i + 1))) edge[i] = edge[i + 1] = 1;
      if (y + 1 < height && depth_breaks(sample(i), sample(i + static_cast<std::size_t>(width)))) edge[i] = edge[i + static_cast<std::size_t>(width)] = 1;
    }
  std::vector<float> distance = distance_to_marked(edge, width, height, 64);
  for (int y = 0; y < height; ++y)
    for (int x = 0; x < width; ++x) {
      float& d = distance[static_cast<std::size_t>(y * width + x)];
      d = std::min(d, static_cast<float>(std::min({x, y, width - 1 - x, height - 1 - y})));
    }
  return distance;
}

}  // namespace

std::optional<AnalyticScene::Hit> AnalyticScene::cast(const Vec3d& origin, const Vec3d& direction) const {
  std::optional<Hit> best;
  for (const Rectangle& r : rectangles) {
    const Vec3d n = r.u.cross(r.v).normalized();
    const double slope = n.dot(direction);
    if (std::abs(slope) < 1e-12) continue;
    const double t = n.dot(r.corner - origin) / slope;
    const Vec3d p = origin + t * direction - r.corner;
    const double s = p.dot(r.u) / r.u.squaredNorm(), q = p.dot(r.v) / r.v.squaredNorm();
    if (s >= 0 && s <= 1 && q >= 0 && q <= 1) keep_nearest(best, t, n);
  }
  for (const Sphere& s : spheres) {
    const Vec3d to = origin - s.centre;
    const double b = to.dot(direction), c = to.squaredNorm() - s.radius * s.radius, d = b * b - c;
    if (d < 0) continue;
    for (const double t : {-b - std::sqrt(d), -b + std::sqrt(d)}) keep_nearest(best, t, (to + t * direction) / s.radius);
  }
  return best;
}

std::vector<AnalyticScene::Point> AnalyticScene::points() const {
  std::vector<Point> result;
  for (const Rectangle& r : rectangles) {
    const int nu = std::max(1, static_cast<int>(r.u.norm() / spacing)), nv = std::max(1, static_cast<int>(r.v.norm() / spacing));
    for (int i = 0; i < nu * nv; ++i) {
      const auto jitter = uniform01x4(5, Purpose::kTest, result.size(), 0);
      result.push_back({r.corner + (i % nu + static_cast<double>(jitter[0])) / nu * r.u + (static_cast<double>(i / nu) + static_cast<double>(jitter[1])) / nv * r.v, r.u.cross(r.v).normalized()});
    }
  }
  for (const Sphere& s : spheres) {
    const int n = static_cast<int>(4 * std::numbers::pi * s.radius * s.radius / (spacing * spacing));
    for (int i = 0; i < n; ++i) {   // Fibonacci spiral
      const double z = 1 - 2 * (i + 0.5) / n, phi = i * std::numbers::pi * (3 - std::sqrt(5.0)), w = std::sqrt(1 - z * z);
      const Vec3d normal(w * std::cos(phi), w * std::sin(phi), z);
      result.push_back({s.centre + s.radius * normal, normal});
    }
  }
  std::vector<std::pair<float, std::size_t>> order;
  for (std::size_t i = 0; i < result.size(); ++i) order.emplace_back(uniform01(9, Purpose::kTest, i, 0), i);
  std::sort(order.begin(), order.end());
  std::vector<Point> shuffled;
  for (const auto& [key, i] : order) shuffled.push_back(result[i]);
  return shuffled;
}

void write_scene_ply(const std::filesystem::path& path, const std::vector<AnalyticScene::Point>& points) {
  std::string text = "ply\nformat binary_little_endian 1.0\nelement vertex " + std::to_string(points.size()) + "\n";
  for (const char* name : {"x", "y", "z", "nx", "ny", "nz"}) text += std::string("property float ") + name + "\n";
  text += "end_header\n";
  for (const AnalyticScene::Point& p : points) {
    const float row[6] = {static_cast<float>(p.position.x()), static_cast<float>(p.position.y()), static_cast<float>(p.position.z()),
                          static_cast<float>(p.normal.x()),   static_cast<float>(p.normal.y()),   static_cast<float>(p.normal.z())};
    text.append(reinterpret_cast<const char*>(row), sizeof row);
  }
  write_text(path, text);
}

stream::Camera look_at(const std::string& name, const Vec3d& eye, const Vec3d& target, int width, int height, double focal) {
  const Vec3d z = (target - eye).normalized();
  const Vec3d up = std::abs(z.z()) > 0.9 ? Vec3d(0, 1, 0) : Vec3d(0, 0, 1);
  const Vec3d x = z.cross(up).normalized();
  stream::Camera camera;
  camera.photograph = name;
  camera.lens.width_px = width;
  camera.lens.height_px = height;
  camera.lens.fx = camera.lens.fy = focal;
  camera.lens.cx = width / 2.0;
  camera.lens.cy = height / 2.0;
  camera.pose.rotation_camera_from_world.row(0) = x.transpose();
  camera.pose.rotation_camera_from_world.row(1) = z.cross(x).transpose();
  camera.pose.rotation_camera_from_world.row(2) = z.transpose();
  camera.pose.translation_camera_from_world = -camera.pose.rotation_camera_from_world * eye;
  return camera;
}

BlendPhotograph shoot(const AnalyticScene& scene, const stream::Camera& camera, const std::filesystem::path& folder, const ShotOptions& options) {
  const int width = camera.lens.width_px, height = camera.lens.height_px;
  PixelPlanes p(static_cast<std::size_t>(width) * static_cast<std::size_t>(height));
  parallel_blocks(static_cast<std::size_t>(height), 4, [&](std::size_t y0, std::size_t y1) {
    for (auto y = static_cast<int>(y0); y < static_cast<int>(y1); ++y)
      for (int x = 0; x < width; ++x) render_pixel(scene, camera, options, x, y, p);
  });
  p.edge = edge_distances(p, width, height);

  BlendPhotograph photograph{camera.photograph, camera, folder / (camera.photograph + "_gbuffer.raster"), folder / (camera.photograph + "_albedo.raster"),
                             folder / (camera.photograph + "_radiance.raster")};
  using Named = std::pair<const char*, const std::vector<float>*>;
  const auto write = [&](const std::filesystem::path& path, const std::vector<Named>& planes) {
    std::vector<stream::PlaneInfo> infos;
    for (const auto& [name, values] : planes) infos.push_back({name, stream::PlaneType::kF32});
    stream::RasterWriter writer(path, width, height, infos);
    for (const auto& [name, values] : planes) writer.write_rows<float>(name, 0, *values);
    writer.commit();
  };
  write(photograph.gbuffer, {{"depth", &p.depth}, {"nx", &p.nx}, {"ny", &p.ny}, {"nz", &p.nz}, {"radius", &p.radius}, {"footprint", &p.footprint}, {"cosv", &p.cosv},
                             {"coverage", &p.coverage}, {"edge", &p.edge}});
  write(photograph.albedo, {{"r", &p.r}, {"g", &p.g}, {"b", &p.b}, {"sigma", &p.sigma}});
  stream::RasterWriter writer(photograph.radiance, width, height, {{"mask", stream::PlaneType::kU8}});
  writer.write_rows<std::uint8_t>("mask", 0, p.mask);
  writer.commit();
  return photograph;
}

}  // namespace chiaro::blend::testing
