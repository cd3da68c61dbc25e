#include "optimize/render.h"

#include <algorithm>
#include <cmath>
#include <numbers>
#include <unordered_map>

#include "optimize/fields.h"
#include "optimize/radiosity.h"
#include "stream/base/error.h"
#include "stream/base/parallel.h"
#include "stream/photo/image_io.h"
#include "surfels/working_set.h"

namespace chiaro::optimize {
namespace {

constexpr float kPi = std::numbers::pi_v<float>;
constexpr int kBandRows = 64;

/// The geometry of a view and the albedo of its surfels.
struct RenderSet {
  surfels::Tracer tracer;
  std::unordered_map<std::uint32_t, std::vector<Vec3f>> albedo;
  BudgetLease lease;
};

RenderSet load_set(const stream::Store& store, const stream::Layer& layer, const RenderView& view, MemoryBudget& budget, Reporter& report) {
  surfels::View seen{view.lens, view.pose, {0, 0, view.lens.width_px, view.lens.height_px}, {view.pose.world_from_camera(view.flash_in_camera)}};
  const surfels::WorkingSet set = surfels::select_visible(store, seen, {}, budget, report);
  RenderSet r{surfels::Tracer(view.pose.centre_in_world(), budget), {}, BudgetLease(budget, set.surfels * sizeof(Vec3f), "albedo of the view")};
  for (const std::uint32_t c : set.chunks) {
    r.tracer.add(store.read_chunk(c));
    r.albedo.emplace(c, stream::read_albedo(layer, store, c).albedo);
  }
  r.tracer.commit();
  return r;
}

/// Light that reaches the proxy under the view's flash other than from flash and sky.
struct OtherLight {
  std::vector<float> gathered;      ///< after all bounces, 3 N
  std::vector<float> floor_flash;   ///< by way of a white floor, N; empty: no floor
};

OtherLight other_light(const stream::Store& store, const Scene& scene, const std::vector<float>& proxy_albedo, const Lights& lights, const Vec3d& flash_in_world,
                                 int scatterings, MemoryBudget& budget) {
  surfels::Tracer tracer(scene.proxy.origin_in_world, budget);
  for (const std::uint32_t c : scene.proxy.chunks) tracer.add(store.read_chunk(c));
  tracer.commit();
  Observation o;
  const std::size_t n = scene.proxy.size();
  o.seen.assign(n, 0);
  o.flash.assign(n, 0.0f);
  o.tan_flash.assign(n, 0.0f);
  cast_flash(scene.proxy, tracer, flash_in_world, o);
  const Smoother smoother = make_smoother(scene.proxy, *scene.nearest);
  OtherLight other;
  if (lights.floor && scene.floor) other.floor_flash = flash_by_floor(scene.proxy, scene.transport, smoother, tracer, *scene.floor, flash_in_world);
  const std::vector<float> direct = direct_irradiance(scene.transport, o.flash, other.floor_flash, lights);
  const std::vector<float> b = forward_radiosity(scene.transport, proxy_albedo, direct, lights.bounce, scatterings);
  gather_radiosity(scene.transport, b, other.gathered);
  smoother.apply(other.gathered, 3, kSmoothPasses);
  return other;
}

struct Shader {
  const RenderSet& set;
  const Scene& scene;
  const std::vector<float>& proxy_albedo;
  const OtherLight& other;
  const Lights& lights;
  const RenderView& view;
  const RenderOptions& options;
  Vec3f eye, flash;               ///< tracer frame
  Vec3f proxy_from_tracer;        ///< shift between the two scene frames
  Eigen::Matrix3f world_from_camera;

  /// Albedo blended over the surfels of a hit; of the nearest seen proxy surfel where no photograph saw any of them.
  Vec3f albedo_of(const surfels::HitBlend& blend, const Vec3f& p, bool& unseen) const {
    Vec3f sum = Vec3f::Zero();
    float weight = 0;
    for (int i = 0; i < blend.count; ++i) {
      const auto k = static_cast<std::size_t>(i);
      const Vec3f& a = set.albedo.at(blend.surfel[k].chunk)[blend.surfel[k].slot];
      if (!(std::isfinite(a.x()) && std::isfinite(a.y()) && std::isfinite(a.z()))) continue;
      sum += a * blend.weight[k];
      weight += blend.weight[k];
    }
    if (weight > 0) return sum / weight;
    unseen = true;
    std::uint32_t i;
    float d2;
    scene.nearest->find(p + proxy_from_tracer, 1, &i, &d2);
    return {proxy_albedo[3 * i], proxy_albedo[3 * i + 1], proxy_albedo[3 * i + 2]};
  }

  float flash_irradiance(const Vec3f& p, const surfels::Hit& hit) const {
    const Vec3f to_flash = flash - p;
    const float r2 = to_flash.squaredNorm(), r = std::sqrt(r2), cosine = hit.normal.dot(to_flash) / r;
    if (!(cosine > 0) || set.tracer.occluded(surfels::escape_ray(p, hit.normal, hit.radius, to_flash / r, r))) return 0;
    return cosine / r2;
  }

  Vec3f shade(int x, int y, RenderStats& stats) const {
    const int n = options.subpixels;
    Vec3f direct = Vec3f::Zero(), albedo = Vec3f::Zero(), point = Vec3f::Zero(), normal = Vec3f::Zero();
    int hits = 0;
    bool unseen = false;
    for (int j = 0; j < n; ++j)
      for (int i = 0; i < n; ++i) {
        const auto d = stream::unproject(view.lens, {x + (i + 0.5) / n, y + (j + 0.5) / n});
        if (!d) continue;
        const surfels::Ray ray{eye, (world_from_camera * d->cast<float>()).normalized(), 0, 1e30f};
        surfels::Hit hit;
        surfels::HitBlend blend;
        if (!set.tracer.closest(ray, hit, blend)) continue;
        ++hits;
        const Vec3f p = ray.origin + ray.direction * hit.t;
        const Vec3f a = albedo_of(blend, p, unseen);
        albedo += a;
        point += p;
        normal += hit.normal;
        if (options.mode != RenderMode::kAlbedo) direct += a * flash_irradiance(p, hit);
      }
    if (hits == 0) return Vec3f::Zero();
    ++stats.pixels_hit;
    stats.pixels_without_albedo += unseen;
    const float scale = 1.0f / static_cast<float>(hits), coverage = static_cast<float>(hits) / static_cast<float>(n * n);
    albedo *= scale;
    if (options.mode == RenderMode::kAlbedo) return albedo * coverage;
    Vec3f radiance = direct * (scale * static_cast<float>(lights.flash_intensity));
    if (options.mode == RenderMode::kFull) {
      const Stencil stencil = stencil_at(scene.proxy, *scene.nearest, point * scale + proxy_from_tracer, normal.normalized());
      const auto sky = interpolate<kSkyTerms>(stencil, scene.transport.sky);
      const auto g = interpolate<3>(stencil, other.gathered);
      std::array<float, kSkyTerms> hidden{};
      if (lights.floor && scene.floor) hidden = interpolate<kSkyTerms>(stencil, scene.transport.hidden);
      const auto ambient = static_cast<float>(std::max(0.0, sky_irradiance(lights, sky, hidden)));
      const float by_floor = other.floor_flash.empty() ? 0.0f : static_cast<float>(lights.floor_albedo * lights.flash_intensity) * interpolate<1>(stencil, other.floor_flash)[0];
      for (std::size_t c = 0; c < 3; ++c)
        radiance[static_cast<Eigen::Index>(c)] +=
            albedo[static_cast<Eigen::Index>(c)] * (by_floor + static_cast<float>(lights.sky_colour[c]) * ambient + static_cast<float>(lights.bounce) * g[c]);
    }
    return radiance * (coverage / kPi);
  }
};

}  // namespace

RenderStats render(const stream::Store& store, const stream::Layer& layer, const Scene& scene, const std::vector<float>& proxy_albedo, const Lights& acquisition_lights,
                   const RenderView& view, const RenderOptions& options, const std::filesystem::path& picture, MemoryBudget& budget, Reporter& report) {
  Lights lights = acquisition_lights;
  lights.flash_intensity = view.flash_intensity;
  for (double& s : lights.sky) s *= view.ambient_scale;
  const Vec3d flash_in_world = view.pose.world_from_camera(view.flash_in_camera);
  OtherLight other;
  if (options.mode == RenderMode::kFull) other = other_light(store, scene, proxy_albedo, lights, flash_in_world, options.scatterings, budget);
  const RenderSet set = load_set(store, layer, view, budget, report);
  const Shader shader{set, scene, proxy_albedo, other, lights, view, options, set.tracer.scene_from_world(view.pose.centre_in_world()),
                      set.tracer.scene_from_world(flash_in_world), (set.tracer.origin_in_world() - scene.proxy.origin_in_world).cast<float>(),
                      view.pose.rotation_camera_from_world.transpose().cast<float>()};
  const int width = view.lens.width_px, height = view.lens.height_px;
  stream::ExrWriter out(picture, width, height, {"R", "G", "B"}, true);
  RenderStats stats;
  report.begin(concat("render ", view.name), static_cast<std::uint64_t>(height), "rows");
  for (int y0 = 0; y0 < height; y0 += kBandRows) {
    report.check();
    const int rows = std::min(kBandRows, height - y0);
    std::vector<float> values(3 * static_cast<std::size_t>(rows) * static_cast<std::size_t>(width));
    std::vector<RenderStats> row_stats(static_cast<std::size_t>(rows));
    parallel_blocks(static_cast<std::size_t>(rows), 1, [&](std::size_t b, std::size_t e) {
      for (std::size_t row = b; row < e; ++row)
        for (int x = 0; x < width; ++x) {
          const Vec3f v = shader.shade(x, y0 + static_cast<int>(row), row_stats[row]);
          for (int c = 0; c < 3; ++c) values[3 * (row * static_cast<std::size_t>(width) + static_cast<std::size_t>(x)) + static_cast<std::size_t>(c)] = v[c];
        }
    });
    for (const RenderStats& s : row_stats) {
      stats.pixels_hit += s.pixels_hit;
      stats.pixels_without_albedo += s.pixels_without_albedo;
    }
    out.write_rows(rows, values);
    report.progress(static_cast<std::uint64_t>(y0 + rows));
  }
  stats.pixels = static_cast<std::uint64_t>(width) * static_cast<std::uint64_t>(height);
  out.commit();
  report.end();
  return stats;
}

}  // namespace chiaro::optimize
