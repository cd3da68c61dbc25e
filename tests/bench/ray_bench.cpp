// Rays against surfels: ours and Embree's own oriented discs on the same discs, one after the other in each round; one table for each run.
//
//   ray_bench [--points 5000000] [--size 1024] [--rounds 5] [--threads 0]
//
// The scene is a bumpy sphere of 10 m radius, randomly sampled, seen from inside, so that every ray hits. Coherent: a camera of --size x --size pixels. Incoherent:
// from each of its hits a direction spread by the cosine. Ours answers with the blend of all discs in a slab behind the first; "first disc" is Embree's nearest
// hit, "blend" the same work as ours: the nearest, then all discs in the slab behind it through a filter. Rates are rays a second of processor time,
// so that other work on the machine changes them little; ratios are of medians, above 1 ours is faster.
#if __has_include(<embree4/rtcore.h>)
#include <embree4/rtcore.h>
#define CHIARO_EMBREE4 1
#else
#include <embree3/rtcore.h>
#define CHIARO_EMBREE4 0
#endif
#if defined(__x86_64__)
#include <pmmintrin.h>
#include <xmmintrin.h>
#endif

#include <algorithm>
#include <array>
#include <chrono>
#include <ctime>
#include <cmath>
#include <cstdio>
#include <functional>
#include <string>
#include <vector>

#include "stream/base/error.h"
#include "stream/base/file.h"
#include "stream/base/parallel.h"
#include "stream/base/rng.h"
#include "surfels/tracer.h"
#include "tests/support/sampled_surface.h"

namespace {

using namespace chiaro;
using surfels::Ray;
using Clock = std::chrono::steady_clock;

struct Options {
  std::size_t points = 5'000'000;
  int size = 1024, rounds = 5, threads = 0;
};

Vec3d direction_of(float a, float b) {
  const double z = 2 * static_cast<double>(a) - 1, r = std::sqrt(1 - z * z), phi = 6.283185307179586 * static_cast<double>(b);
  return {r * std::cos(phi), r * std::sin(phi), z};
}

std::vector<tests::SampledPoint> bumpy_sphere(std::size_t count) {
  std::vector<tests::SampledPoint> points(count);
  parallel_blocks(count, 65536, [&](std::size_t begin, std::size_t end) {
    for (std::size_t i = begin; i < end; ++i) {
      const auto u = uniform01x4(1, Purpose::kTest, i, 0);
      const Vec3d d = direction_of(u[0], u[1]);
      const auto surface = [](const Vec3d& n) { return Vec3d(n * (10 + 0.2 * std::sin(9 * n.x()) * std::sin(7 * n.y()) * std::sin(8 * n.z()))); };
      const Vec3d across = d.unitOrthogonal(), along = d.cross(across);
      const Vec3d normal = (surface((d + 1e-5 * across).normalized()) - surface((d - 1e-5 * across).normalized()))
                               .cross(surface((d + 1e-5 * along).normalized()) - surface((d - 1e-5 * along).normalized()))
                               .normalized();
      points[i] = {surface(d), Vec3f((normal.dot(d) > 0 ? -normal : normal).cast<float>())};
    }
  });
  return points;
}

struct RtcRelease {
  void operator()(RTCDevice d) const { rtcReleaseDevice(d); }
  void operator()(RTCScene s) const { rtcReleaseScene(s); }
};

#if CHIARO_EMBREE4
using QueryBase = RTCRayQueryContext;
constexpr RTCSceneFlags kWithFilter = RTC_SCENE_FLAG_FILTER_FUNCTION_IN_ARGUMENTS;
#else
using QueryBase = RTCIntersectContext;
constexpr RTCSceneFlags kWithFilter = RTC_SCENE_FLAG_CONTEXT_FILTER_FUNCTION;
#endif

/// The discs of a tracer, decoded, as Embree's own geometry.
class NativeDiscs {
 public:
  NativeDiscs(const stream::Store& store, const surfels::Tracer& tracer) {
    device_.reset(rtcNewDevice("start_threads=0,set_affinity=0"));
    rtcSetDeviceMemoryMonitorFunction(device_.get(), [](void* self, ssize_t bytes, bool) { static_cast<NativeDiscs*>(self)->bytes_ += bytes; return true; }, this);
    for (const std::uint32_t leaf : store.leaves()) {
      const stream::Chunk* chunk = tracer.chunk(leaf);
      for (std::uint32_t slot = 0; slot < chunk->count; ++slot) {
        const stream::Surfel s = chunk->surfel(slot);
        const Vec3f p = tracer.scene_from_world(s.position_in_world);
        discs_.push_back({p.x(), p.y(), p.z(), s.radius});
        normals_.push_back({s.normal.x(), s.normal.y(), s.normal.z()});
      }
    }
    const RTCGeometry geometry = rtcNewGeometry(device_.get(), RTC_GEOMETRY_TYPE_ORIENTED_DISC_POINT);
    rtcSetSharedGeometryBuffer(geometry, RTC_BUFFER_TYPE_VERTEX, 0, RTC_FORMAT_FLOAT4, discs_.data(), 0, sizeof discs_[0], discs_.size());
    rtcSetSharedGeometryBuffer(geometry, RTC_BUFFER_TYPE_NORMAL, 0, RTC_FORMAT_FLOAT3, normals_.data(), 0, sizeof normals_[0], normals_.size());
    rtcCommitGeometry(geometry);
    scene_ = scene_of(geometry, RTC_SCENE_FLAG_NONE);
    bytes_of_one_ = bytes_;
    filtered_scene_ = scene_of(geometry, kWithFilter);
    rtcReleaseGeometry(geometry);
  }
  std::size_t size() const { return discs_.size(); }
  double bytes() const { return static_cast<double>(bytes_of_one_) + static_cast<double>(discs_.size() * (sizeof discs_[0] + sizeof normals_[0])); }

  float closest(const Ray& ray) const { return nearest(ray).ray.tfar; }

  /// Distance of the blend of the discs in the slab behind the nearest one, as the tracer defines it.
  float blended(const Ray& ray) const {
    const RTCRayHit first = nearest(ray);
    if (first.hit.geomID == RTC_INVALID_GEOMETRY_ID) return ray.t_max;
    const float cosine = std::abs(Vec3f(first.hit.Ng_x, first.hit.Ng_y, first.hit.Ng_z).normalized().dot(ray.direction));
    Slab slab{};
    slab.discs = this;
    slab.ray = &ray;
    Ray second = ray;
    second.t_max = first.ray.tfar + 0.6f * discs_[first.hit.primID][3] / std::max(0.25f, cosine);
    RTCRayHit hit = start(second);
    intersect(hit, slab.context, &gather);
    return slab.weight > 0 ? slab.sum / slab.weight : first.ray.tfar;
  }

  bool occluded(const Ray& ray) const {
    RTCRayHit hit = start(ray);
    QueryBase context;
#if CHIARO_EMBREE4
    rtcInitRayQueryContext(&context);
    RTCOccludedArguments arguments;
    rtcInitOccludedArguments(&arguments);
    arguments.context = &context;
    rtcOccluded1(scene_.get(), &hit.ray, &arguments);
#else
    rtcInitIntersectContext(&context);
    rtcOccluded1(scene_.get(), &context, &hit.ray);
#endif
    return hit.ray.tfar < 0;
  }

 private:
  struct Slab {
    QueryBase context;  // first: Embree hands back its address
    const NativeDiscs* discs;
    const Ray* ray;
    float sum, weight;
  };

  static void gather(const RTCFilterFunctionNArguments* a) {
    auto& slab = *reinterpret_cast<Slab*>(a->context);
    const unsigned i = RTCHitN_primID(a->hit, a->N, 0);
    const float t = RTCRayN_tfar(a->ray, a->N, 0);
    const std::array<float, 4>& disc = slab.discs->discs_[i];
    const float rho2 = (slab.ray->origin + t * slab.ray->direction - Vec3f(disc[0], disc[1], disc[2])).squaredNorm() / (disc[3] * disc[3]);
    const float k = std::max(0.0f, 1 - rho2), w = k * k + 1e-4f;
    slab.sum += w * t;
    slab.weight += w;
    a->valid[0] = 0;  // go on
  }

  using ScenePtr = std::unique_ptr<RTCSceneTy, RtcRelease>;
  ScenePtr scene_of(RTCGeometry geometry, RTCSceneFlags flags) const {
    ScenePtr scene(rtcNewScene(device_.get()));
    rtcSetSceneFlags(scene.get(), flags);
    rtcSetSceneBuildQuality(scene.get(), RTC_BUILD_QUALITY_MEDIUM);
    rtcAttachGeometry(scene.get(), geometry);
    rtcCommitScene(scene.get());
    return scene;
  }

  static RTCRayHit start(const Ray& ray) {
    RTCRayHit r{};
    r.ray.org_x = ray.origin.x(), r.ray.org_y = ray.origin.y(), r.ray.org_z = ray.origin.z();
    r.ray.dir_x = ray.direction.x(), r.ray.dir_y = ray.direction.y(), r.ray.dir_z = ray.direction.z();
    r.ray.tnear = ray.t_min;
    r.ray.tfar = ray.t_max;
    r.ray.mask = 0xffffffffu;
    r.hit.geomID = RTC_INVALID_GEOMETRY_ID;
    return r;
  }

  void intersect(RTCRayHit& hit, QueryBase& context, RTCFilterFunctionN filter) const {
#if CHIARO_EMBREE4
    rtcInitRayQueryContext(&context);
    RTCIntersectArguments arguments;
    rtcInitIntersectArguments(&arguments);
    arguments.context = &context;
    arguments.filter = filter;
    if (filter) arguments.flags = RTC_RAY_QUERY_FLAG_INVOKE_ARGUMENT_FILTER;
    rtcIntersect1(filter ? filtered_scene_.get() : scene_.get(), &hit, &arguments);
#else
    rtcInitIntersectContext(&context);
    context.filter = filter;
    rtcIntersect1(filter ? filtered_scene_.get() : scene_.get(), &context, &hit);
#endif
  }

  RTCRayHit nearest(const Ray& ray) const {
    RTCRayHit hit = start(ray);
    QueryBase context;
    intersect(hit, context, nullptr);
    return hit;
  }

  std::atomic<std::int64_t> bytes_{0};   // outlives what reports to it
  std::int64_t bytes_of_one_ = 0;
  std::unique_ptr<RTCDeviceTy, RtcRelease> device_;
  ScenePtr scene_, filtered_scene_;
  std::vector<std::array<float, 4>> discs_;
  std::vector<std::array<float, 3>> normals_;
};

/// Tiles of 8 x 8 pixels, since that is how pictures are made.
std::vector<Ray> camera_rays(int size) {
  std::vector<Ray> rays;
  for (int tile_y = 0; tile_y < size; tile_y += 8)
    for (int tile_x = 0; tile_x < size; tile_x += 8)
      for (int i = 0; i < 64; ++i) {
        const float x = 2 * (static_cast<float>(tile_x + i % 8) + 0.5f) / static_cast<float>(size) - 1, y = 2 * (static_cast<float>(tile_y + i / 8) + 0.5f) / static_cast<float>(size) - 1;
        rays.push_back({{0.5f, -0.3f, 0.2f}, Vec3f(x, y, 1).normalized(), 0, 1e30f});
      }
  return rays;
}

std::vector<Ray> bounced_rays(const std::vector<Ray>& rays, const surfels::Tracer& tracer) {
  std::vector<Ray> bounced(rays.size());
  parallel_blocks(rays.size(), 4096, [&](std::size_t begin, std::size_t end) {
    for (std::size_t i = begin; i < end; ++i) {
      surfels::Hit hit;
      bounced[i] = rays[i];
      if (!tracer.closest(rays[i], hit)) continue;
      const auto u = uniform01x4(2, Purpose::kTest, i, 0);
      const Vec3f d = (hit.normal + direction_of(u[0], u[1]).cast<float>()).normalized();
      bounced[i] = surfels::escape_ray(rays[i].origin + hit.t * rays[i].direction, hit.normal, hit.radius, d, 1e30f);
    }
  });
  return bounced;
}

struct Measure {
  const char* name;
  std::function<bool(const Ray&)> ray;
  std::vector<double> mrays;
  std::size_t hits = 0;
  double median() const {
    std::vector<double> sorted = mrays;
    std::sort(sorted.begin(), sorted.end());
    return sorted[sorted.size() / 2];
  }
};

// The processor's time and not the clock's: others may use the machine too.
std::int64_t thread_ns() {
  timespec t{};
  clock_gettime(CLOCK_THREAD_CPUTIME_ID, &t);
  return t.tv_sec * 1'000'000'000ll + t.tv_nsec;
}

void run_once(const std::vector<Ray>& rays, Measure& m) {
  std::atomic<std::size_t> hits{0};
  std::atomic<std::int64_t> spent_ns{0};
  parallel_blocks(rays.size(), 4096, [&](std::size_t begin, std::size_t end) {
#if defined(__x86_64__)
    const unsigned mode = _mm_getcsr();   // as Embree asks for
    _MM_SET_FLUSH_ZERO_MODE(_MM_FLUSH_ZERO_ON);
    _MM_SET_DENORMALS_ZERO_MODE(_MM_DENORMALS_ZERO_ON);
#endif
    std::size_t n = 0;
    const std::int64_t before = thread_ns();
    for (std::size_t i = begin; i < end; ++i) n += m.ray(rays[i]);
    spent_ns += thread_ns() - before;
    hits += n;
#if defined(__x86_64__)
    _mm_setcsr(mode);
#endif
  });
  m.mrays.push_back(1e3 * static_cast<double>(rays.size()) / static_cast<double>(spent_ns));
  m.hits = hits;
}

void measure(const char* name, const std::vector<Ray>& rays, const surfels::Tracer& tracer, const NativeDiscs& native, int rounds) {
  std::vector<Measure> all{{"closest", [&](const Ray& r) { surfels::Hit hit; return tracer.closest(r, hit); }, {}, 0},
                           {"occluded", [&](const Ray& r) { return tracer.occluded(r); }, {}, 0},
                           {"native first disc", [&](const Ray& r) { return native.closest(r) < 1e29f; }, {}, 0},
                           {"native blend", [&](const Ray& r) { return native.blended(r) < 1e29f; }, {}, 0},
                           {"native occluded", [&](const Ray& r) { return native.occluded(r); }, {}, 0}};
  for (int round = 0; round < rounds; ++round)
    for (Measure& m : all) run_once(rays, m);
  const auto share = [&](const Measure& m) { return 100 * static_cast<double>(m.hits) / static_cast<double>(rays.size()); };
  std::printf("%-11s  Mray a second of one core (hits %%):", name);
  for (const Measure& m : all) std::printf("  %s %.3f (%.3f)", m.name, m.median(), share(m));
  std::printf("\n%-11s  ratios: closest / native first disc %.2f, closest / native blend %.2f, occluded / native occluded %.2f\n", name, all[0].median() / all[2].median(),
              all[0].median() / all[3].median(), all[1].median() / all[4].median());
}

Options parse(int count, char** words) {
  Options o;
  for (int i = 1; i < count; ++i) {
    const std::string word = words[i];
    if (i + 1 == count) throw Error(concat(word, ": a value is missing"));
    if (word == "--points") o.points = static_cast<std::size_t>(std::stod(words[++i]));
    else if (word == "--size") o.size = std::stoi(words[++i]) / 8 * 8;
    else if (word == "--rounds") o.rounds = std::stoi(words[++i]);
    else if (word == "--threads") o.threads = std::stoi(words[++i]);
    else throw Error(concat(word, ": unknown; see the head of ray_bench.cpp"));
  }
  if (o.size < 8 || o.rounds < 1 || o.points < 100) throw Error("at least 100 points, 8 pixels and one round");
  return o;
}

}  // namespace

int main(int count, char** words) {
  try {
    const Options options = parse(count, words);
    const ThreadLimit limit(options.threads);
    const ScratchFolder folder;
    const stream::Store store = tests::build_test_store(bumpy_sphere(options.points), folder.path());
    MemoryBudget budget(std::uint64_t{64} << 30);
    surfels::Tracer tracer({0, 0, 0}, budget);
    auto start = Clock::now();
    for (const std::uint32_t leaf : store.leaves()) tracer.add(store.read_chunk(leaf));
    tracer.commit();
    const double ours_s = std::chrono::duration<double>(Clock::now() - start).count();
    start = Clock::now();
    const NativeDiscs native(store, tracer);
    const double native_s = std::chrono::duration<double>(Clock::now() - start).count();
    const auto n = static_cast<double>(tracer.num_surfels());
    std::printf("%zu discs; ours: %.1f B/surfel, read and built in %.2f s; native: %.1f B/surfel, decoded and built in %.2f s\n", native.size(), static_cast<double>(tracer.bytes()) / n, ours_s,
                native.bytes() / n, native_s);
    const std::vector<Ray> coherent = camera_rays(options.size);
    measure("coherent", coherent, tracer, native, options.rounds);
    measure("incoherent", bounced_rays(coherent, tracer), tracer, native, options.rounds);
    return 0;
  } catch (const std::exception& e) {
    std::fprintf(stderr, "error: %s\n", e.what());
    return 1;
  }
}
