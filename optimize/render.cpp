#include "optimize/render.h"

#include <algorithm>
#include <cmath>
#include <memory>
#include <numbers>
#include <optional>
#include <unordered_map>

#include "optimize/fields.h"
#include "optimize/gloss_light.h"
#include "optimize/radiosity.h"
#include "stream/base/error.h"
#include "stream/base/parallel.h"
#include "stream/photo/image_io.h"
#include "surfels/working_set.h"

namespace chiaro::optimize {
namespace {

constexpr float kPi = std::numbers::pi_v<float>;
constexpr int kBandRows = 64, kBandPixels = 1 << 19;   ///< of a view at a time: fewer rows where it is wide
constexpr float kNowhere = 1e30f;       ///< distance of what is not there
constexpr int kMostBeyondEdge = 8;     ///< discs beyond an edge, one behind the other
constexpr float kOneSurfaceRadii = 2;   ///< depths within a pixel that differ by more belong to two surfaces

/// The geometry of a view and the albedo of its surfels.
struct RenderSet {
  surfels::Tracer tracer;
  std::unordered_map<std::uint32_t, std::vector<Vec3f>> albedo;
  BudgetLease lease;
  float metres_per_unit = 1;
  std::unique_ptr<RenderSet> inserted;   ///< finer points, for their colour alone
};

RenderSet load_set(const stream::Store& store, const stream::Layer& layer, const RenderView& view, MemoryBudget& budget, Reporter& report) {
  surfels::View seen{view.lens, view.pose, {0, 0, view.lens.width_px, view.lens.height_px}, {view.pose.world_from_camera(view.flash_in_camera)}};
  const surfels::WorkingSet set = surfels::select_visible(store, seen, {}, budget, report);
  RenderSet r{surfels::Tracer(view.pose.centre_in_world(), budget), {}, BudgetLease(budget, set.surfels * sizeof(Vec3f), "albedo of the view"), static_cast<float>(stream::metres_per_unit(store.manifest().unit)), nullptr};
  for (const std::uint32_t c : set.chunks) {
    r.tracer.add(store.read_chunk(c));
    r.albedo.emplace(c, stream::read_albedo(layer, store, c).albedo);
  }
  r.tracer.commit();
  return r;
}

/// Of the flash's intensity along its axis, what it sends into a direction of the world.
float flash_share(const RenderView& view, const Vec3f& direction) {
  if (!view.falloff.of_flash()) return 1;
  return static_cast<float>(flash_pattern(view.falloff, off_axis(view.pose.rotation_camera_from_world * direction.cast<double>(), view.falloff.flash_corner_sine)));
}

/// Light that reaches the proxy under the view's flash other than from flash and sky.
struct OtherLight {
  std::vector<float> gathered;      ///< after all bounces, 3 N
  std::vector<float> floor_flash;   ///< by way of a white floor, N; empty: no floor
};

OtherLight other_light(const stream::Store& store, const Scene& scene, const std::vector<float>& proxy_albedo, const Lights& lights, const RenderView& view,
                       int scatterings, MemoryBudget& budget) {
  const Vec3d flash_in_world = view.pose.world_from_camera(view.flash_in_camera);
  surfels::Tracer tracer(scene.proxy.origin_in_world, budget);
  for (const std::uint32_t c : scene.proxy.chunks) tracer.add(store.read_chunk(c));
  tracer.commit();
  Observation o;
  const std::size_t n = scene.proxy.size();
  o.seen.assign(n, 0);
  o.flash.assign(n, 0.0f);
  o.tan_flash.assign(n, 0.0f);
  cast_flash(scene.proxy, tracer, flash_in_world, o);
  for (std::size_t i = 0; i < n; ++i) o.flash[i] *= flash_share(view, scene.proxy.position[i] - (flash_in_world - scene.proxy.origin_in_world).cast<float>());
  const Smoother smoother = make_smoother(scene.proxy, *scene.nearest);
  OtherLight other;
  if (lights.floor && scene.floor) other.floor_flash = flash_by_floor(scene.proxy, scene.transport, smoother, tracer, *scene.floor, std::span(&flash_in_world, 1)).front();
  const std::vector<float> direct = direct_irradiance(scene.transport, o.flash, other.floor_flash, lights);
  const std::vector<float> b = forward_radiosity(scene.transport, lights.gloss.on ? coated_albedo(lights.gloss, proxy_albedo) : proxy_albedo, direct, lights.bounce, scatterings);
  gather_radiosity(scene.transport, b, other.gathered);
  smoother.apply(other.gathered, 3, kSmoothPasses);
  return other;
}

/// What a pixel of the view shows.
struct Shaded {
  Vec3f value = Vec3f::Zero();    ///< radiance, or the albedo itself, of the covered part
  Vec3f albedo = Vec3f::Zero();   ///< of the points
  float depth = 0, radius = 0;    ///< mean distance along the rays; 0: more than one surface, or not all covered
};

struct Shader {
  const RenderSet& set;
  const RenderLights* solved;     ///< null: only the albedo is wanted
  const OtherLight& other;
  const Lights& lights;           ///< the view's own
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
    if (!solved) return Vec3f::Zero();
    std::uint32_t i;
    float d2;
    solved->scene.nearest->find(p + proxy_from_tracer, 1, &i, &d2);
    const std::vector<float>& a = solved->proxy_albedo;
    return {a[3 * i], a[3 * i + 1], a[3 * i + 2]};
  }

  /// The same over the inserted points at p, and those of the cloud that are as near as they; nullopt where there are none.
  std::optional<Vec3f> finer_albedo(const surfels::Ray& ray, const surfels::Hit& hit, const surfels::HitBlend& cloud, const Vec3f& p) const {
    if (!set.inserted) return std::nullopt;
    surfels::Hit fine;
    surfels::HitBlend found;
    const float beside = hit.radius / std::max(0.2f, -hit.normal.dot(ray.direction));
    if (!set.inserted->tracer.closest({ray.origin, ray.direction, std::max(0.0f, hit.t - beside), hit.t + beside}, fine, found)) return std::nullopt;
    Vec3f sum = Vec3f::Zero();
    float weight = 0;
    const auto add = [&](const RenderSet& from, const surfels::HitBlend& blend) {
      for (std::size_t i = 0; i < static_cast<std::size_t>(blend.count); ++i) {
        const SurfelId& id = blend.surfel[i];
        const Vec3f& a = from.albedo.at(id.chunk)[id.slot];
        Vec3f away = from.tracer.scene_from_world(from.tracer.chunk(id.chunk)->surfel(id.slot).position_in_world) - p;
        away -= hit.normal * hit.normal.dot(away);
        const float k = 1 - away.squaredNorm() / (fine.radius * fine.radius);
        if (!(k > 0) || !(std::isfinite(a.x()) && std::isfinite(a.y()) && std::isfinite(a.z()))) continue;
        sum += k * k * a;
        weight += k * k;
      }
    };
    add(*set.inserted, found);
    if (!(weight > 0)) return std::nullopt;
    add(set, cloud);
    return Vec3f(sum / weight);
  }

  float flash_irradiance(const Vec3f& p, const surfels::Hit& hit) const {
    const Vec3f to_flash = flash - p;
    const float r2 = to_flash.squaredNorm(), r = std::sqrt(r2), cosine = hit.normal.dot(to_flash) / r;
    if (!(cosine > 0) || set.tracer.occluded(surfels::escape_ray(p, hit.normal, hit.radius, to_flash / r, r))) return 0;
    return cosine * flash_share(view, -to_flash) / (r2 * set.metres_per_unit * set.metres_per_unit);
  }

  CoatFactors coat(const Vec3f& p, const Vec3f& n) const { return lights.gloss.on ? coat_factors(lights.gloss, gloss_angles(p, n, {eye, flash})) : CoatFactors{}; }

  /// What a ray of the view meets, past discs that stand out over an edge. A hit as far away as `sure_from` is taken as it is; by_edge is set where one was not.
  bool find(surfels::Ray ray, float sure_from, bool& by_edge, surfels::Hit& hit, surfels::HitBlend& blend) const {
    for (int i = 0; i < kMostBeyondEdge; ++i) {
      if (!set.tracer.closest(ray, hit, blend)) return false;
      if (hit.t >= sure_from || !set.tracer.is_beyond_edge(ray, hit)) return true;
      by_edge = true;
      ray.t_min = hit.t;
    }
    return true;
  }

  Shaded shade(int x, int y, RenderStats& stats) const {
    const int n = options.subpixels;
    Vec3f direct = Vec3f::Zero(), albedo = Vec3f::Zero(), point = Vec3f::Zero(), normal = Vec3f::Zero();
    int hits = 0;
    bool unseen = false, by_edge = false;
    float nearest = kNowhere, farthest = 0;
    Shaded pixel;
    const auto cast = [&](int i, int j, float sure_from) {
      const auto d = stream::unproject(view.lens, {x + (i + 0.5) / n, y + (j + 0.5) / n});
      if (!d) return;
      const surfels::Ray ray{eye, (world_from_camera * d->cast<float>()).normalized(), 0, 1e30f};
      surfels::Hit hit;
      surfels::HitBlend blend;
      if (!find(ray, sure_from, by_edge, hit, blend)) return;
      ++hits;
      nearest = std::min(nearest, hit.t);
      farthest = std::max(farthest, hit.t);
      pixel.depth += hit.t;
      pixel.radius = std::max(pixel.radius, hit.radius);
      const Vec3f p = ray.origin + ray.direction * hit.t;
      const auto finer = finer_albedo(ray, hit, blend, p);
      const Vec3f a = finer ? *finer : albedo_of(blend, p, unseen);
      albedo += a;
      point += p;
      normal += hit.normal;
      if (options.mode == RenderMode::kAlbedo) return;
      const CoatFactors f = coat(p, hit.normal);
      direct += (a * static_cast<float>(f.direct) + Vec3f::Constant(static_cast<float>(f.direct_mirrored))) * flash_irradiance(p, hit);
    };
    // The corners first: where they show one surface and none of them an edge, only what lies in front of it may be beyond one.
    const auto is_corner = [n](int i, int j) { return (i == 0 || i == n - 1) && (j == 0 || j == n - 1); };
    float sure_from = kNowhere;
    for (const bool corners : {true, false}) {
      for (int j = 0; j < n; ++j)
        for (int i = 0; i < n; ++i)
          if (is_corner(i, j) == corners) cast(i, j, sure_from);
      sure_from = by_edge || farthest - nearest > pixel.radius ? kNowhere : nearest - pixel.radius;
    }
    if (hits == 0) return pixel;
    ++stats.pixels_hit;
    stats.pixels_without_albedo += unseen;
    const float scale = 1.0f / static_cast<float>(hits), coverage = static_cast<float>(hits) / static_cast<float>(n * n);
    albedo *= scale;
    pixel.albedo = albedo;
    pixel.depth = hits == n * n && !unseen && farthest - nearest < kOneSurfaceRadii * pixel.radius ? pixel.depth * scale : 0.0f;
    pixel.value = albedo * coverage;
    if (options.mode == RenderMode::kAlbedo) return pixel;
    Vec3f radiance = direct * (scale * static_cast<float>(lights.flash_intensity));
    if (options.mode == RenderMode::kFull) {
      const Scene& scene = solved->scene;
      const Stencil stencil = stencil_at(scene.proxy, *scene.nearest, point * scale + proxy_from_tracer, normal.normalized());
      const auto sky = interpolate<kSkyTerms>(stencil, scene.transport.sky);
      const auto g = interpolate<3>(stencil, other.gathered);
      std::array<float, kSkyTerms> hidden{};
      if (lights.floor && scene.floor) hidden = interpolate<kSkyTerms>(stencil, scene.transport.hidden);
      const auto ambient = static_cast<float>(std::max(0.0, sky_irradiance(lights, sky, hidden)));
      const float by_floor = other.floor_flash.empty() ? 0.0f : static_cast<float>(lights.floor_albedo * lights.flash_intensity) * interpolate<1>(stencil, other.floor_flash)[0];
      const CoatFactors f = coat(point * scale, normal.normalized());
      for (std::size_t c = 0; c < 3; ++c)
        radiance[static_cast<Eigen::Index>(c)] +=
            (albedo[static_cast<Eigen::Index>(c)] * static_cast<float>(f.other) + static_cast<float>(f.other_mirrored)) * (by_floor + static_cast<float>(lights.sky_colour[c]) * ambient + static_cast<float>(lights.bounce) * g[c]);
    }
    pixel.value = radiance * (coverage / kPi);
    return pixel;
  }
};

/// Of render_rows(): values, depth, radius and albedo of the points, and the interleaved result.
constexpr std::uint64_t kBytesPerPixel = 2 * sizeof(Vec3f) + 2 * sizeof(float) + 3 * sizeof(float);

/// Interleaved pixels of some rows.
std::vector<float> render_rows(const Shader& shader, int y0, int rows, RenderStats& stats) {
  const int width = shader.view.lens.width_px;
  const std::size_t n = static_cast<std::size_t>(rows) * static_cast<std::size_t>(width);
  std::vector<Vec3f> values(n);
  ViewRows band{y0, rows, width, std::vector<float>(n), std::vector<float>(n), std::vector<Vec3f>(n)};
  std::vector<RenderStats> row_stats(static_cast<std::size_t>(rows));
  parallel_blocks(static_cast<std::size_t>(rows), 1, [&](std::size_t b, std::size_t e) {
    for (std::size_t row = b; row < e; ++row)
      for (int x = 0; x < width; ++x) {
        const Shaded s = shader.shade(x, y0 + static_cast<int>(row), row_stats[row]);
        const std::size_t i = row * static_cast<std::size_t>(width) + static_cast<std::size_t>(x);
        values[i] = s.value;
        band.depth[i] = s.depth;
        band.radius[i] = s.radius;
        band.albedo[i] = s.albedo;
      }
  });
  for (const RenderStats& s : row_stats) {
    stats.pixels_hit += s.pixels_hit;
    stats.pixels_without_albedo += s.pixels_without_albedo;
  }
  DetailView view{shader.view.lens, shader.view.pose, {}};
  if (shader.options.mode != RenderMode::kAlbedo) view.flash_in_world = view.pose.world_from_camera(shader.view.flash_in_camera);
  const std::vector<Vec3f> factors = sharpening(view, band, shader.options.sharpen_by);
  std::vector<float> interleaved(3 * n);
  for (std::size_t i = 0; i < n; ++i) {
    stats.pixels_sharpened += factors[i] != Vec3f::Ones();
    for (std::size_t c = 0; c < 3; ++c) interleaved[3 * i + c] = values[i][static_cast<Eigen::Index>(c)] * factors[i][static_cast<Eigen::Index>(c)];
  }
  return interleaved;
}

}  // namespace

RenderStats render(const stream::Store& store, const stream::Layer& layer, const RenderLights* solved, const RenderView& view, const RenderOptions& options,
                   const std::filesystem::path& picture, MemoryBudget& budget, Reporter& report) {
  if (!solved && options.mode != RenderMode::kAlbedo) throw std::invalid_argument("render: no lights");
  Lights lights = solved ? solved->lights : Lights{};
  lights.flash_intensity = view.flash_intensity;
  for (double& s : lights.sky) s *= view.ambient_scale;
  const Vec3d flash_in_world = view.pose.world_from_camera(view.flash_in_camera);
  OtherLight other;
  if (options.mode == RenderMode::kFull) other = other_light(store, solved->scene, solved->proxy_albedo, lights, view, options.scatterings, budget);
  RenderSet set = load_set(store, layer, view, budget, report);
  if (options.inserted && options.inserted_layer) set.inserted = std::make_unique<RenderSet>(load_set(*options.inserted, *options.inserted_layer, view, budget, report));
  const Vec3f proxy_from_tracer = solved ? Vec3f((set.tracer.origin_in_world() - solved->scene.proxy.origin_in_world).cast<float>()) : Vec3f::Zero();
  const Shader shader{set, solved, other, lights, view, options, set.tracer.scene_from_world(view.pose.centre_in_world()), set.tracer.scene_from_world(flash_in_world),
                      proxy_from_tracer, view.pose.rotation_camera_from_world.transpose().cast<float>()};
  const int width = view.lens.width_px, height = view.lens.height_px;
  stream::ExrWriter out(picture, width, height, {"R", "G", "B"}, true);
  RenderStats stats;
  report.begin(concat("render ", view.name), static_cast<std::uint64_t>(height), "rows");
  const int band_rows = std::clamp(kBandPixels / width, 1, kBandRows);
  const std::size_t band_pixels = static_cast<std::size_t>(band_rows) * static_cast<std::size_t>(width);
  const BudgetLease lease(budget, band_pixels * kBytesPerPixel + sharpening_bytes(band_pixels, options.sharpen_by), "rows of the view");
  for (int y0 = 0; y0 < height; y0 += band_rows) {
    report.check();
    const int rows = std::min(band_rows, height - y0);
    const std::vector<float> values = render_rows(shader, y0, rows, stats);
    out.write_rows(rows, values);
    report.progress(static_cast<std::uint64_t>(y0 + rows));
  }
  stats.pixels = static_cast<std::uint64_t>(width) * static_cast<std::uint64_t>(height);
  out.commit();
  report.end();
  return stats;
}

}  // namespace chiaro::optimize
