#include "surfels/tracer.h"

#if __has_include(<embree4/rtcore.h>)
#include <embree4/rtcore.h>
#define CHIARO_EMBREE4 1
#else
#include <embree3/rtcore.h>
#define CHIARO_EMBREE4 0
#endif

#include <algorithm>
#include <array>
#include <bit>
#include <cmath>
#include <map>
#include <mutex>
#include <numbers>
#include <string>

#include "stream/base/error.h"
#include "surfels/disc_block.h"

namespace chiaro::surfels {
namespace {

using stream::Chunk;
using stream::SurfelBlock;

/// Discs that a ray meets at most this far behind the first one, in radii of the first one measured along its normal, are blended with it.
constexpr float kSlabRadii = 0.6f;
/// Lowest cosine that stretches the slab along the ray.
constexpr float kSlabMinCosine = 0.25f;
/// Shadow rays use a slightly smaller disc: radii are stored with a margin of a tenth, so coverage stays whole and edges overhang less.
constexpr float kShadowRho2 = 0.83f;
/// How far around a hit points are looked for, in radii: further they would say little about its own edge, nearer too few are left.
constexpr float kEdgeRadii = 2;
constexpr int kMaxCandidates = 64;

struct ChunkGeometry {
  Chunk chunk;
  Vec3f origin_in_scene;
  DiscScale scale;
  unsigned geometry_id = 0;
  BudgetLease lease;
};

struct Candidate {
  float t, rho2;
  const ChunkGeometry* geometry;
  std::uint32_t slot;
  std::uint64_t id() const { return (std::uint64_t{geometry->chunk.index} << 16) | slot; }
  bool before(const Candidate& o) const { return t < o.t || (t == o.t && id() < o.id()); }
};

#if CHIARO_EMBREE4
using QueryBase = RTCRayQueryContext;
void init_context(QueryBase* c) { rtcInitRayQueryContext(c); }
#else
using QueryBase = RTCIntersectContext;
void init_context(QueryBase* c) { rtcInitIntersectContext(c); }
#endif

/// State of one ray while Embree walks the tree.
struct ClosestQuery {
  QueryBase context;  // first member: Embree hands back its address
  Vec3f origin, direction;
  float slack = 0;    ///< how far behind the first disc candidates may still matter, for every disc of the scene
  float first_t = 1e30f;
  int count = 0;
  std::array<Candidate, kMaxCandidates> list;

  void offer(const Candidate& c) {
    if (c.t > first_t + slack) return;
    if (c.t < first_t) {
      first_t = c.t;
      int kept = 0;
      for (int i = 0; i < count; ++i)
        if (list[static_cast<std::size_t>(i)].t <= first_t + slack) list[static_cast<std::size_t>(kept++)] = list[static_cast<std::size_t>(i)];
      count = kept;
    }
    if (count < kMaxCandidates) {
      list[static_cast<std::size_t>(count++)] = c;
      return;
    }
    // Full: the farthest goes, so that the set kept does not depend on the order of arrival.
    auto last = std::max_element(list.begin(), list.end(), [](const Candidate& a, const Candidate& b) { return a.before(b); });
    if (c.before(*last)) *last = c;
  }
};

struct ShadowQuery {
  QueryBase context;
  Vec3f origin, direction;
};

LocalRay local_ray(const ChunkGeometry& g, const Vec3f& origin, const Vec3f& direction, float t_min, float t_max) {
  const Vec3f local = origin - g.origin_in_scene;
  return {{local.x(), local.y(), local.z()}, {direction.x(), direction.y(), direction.z()}, t_min, t_max};
}

void on_bounds(const RTCBoundsFunctionArguments* args) {
  const auto& g = *static_cast<const ChunkGeometry*>(args->geometryUserPtr);
  const BlockBox box = box_of_block(g.chunk.blocks[args->primID], g.scale);
  args->bounds_o->lower_x = g.origin_in_scene.x() + box.lower[0];
  args->bounds_o->lower_y = g.origin_in_scene.y() + box.lower[1];
  args->bounds_o->lower_z = g.origin_in_scene.z() + box.lower[2];
  args->bounds_o->upper_x = g.origin_in_scene.x() + box.upper[0];
  args->bounds_o->upper_y = g.origin_in_scene.y() + box.upper[1];
  args->bounds_o->upper_z = g.origin_in_scene.z() + box.upper[2];
}

void on_intersect(const RTCIntersectFunctionNArguments* args) {
  if (!args->valid[0]) return;
  auto& query = *reinterpret_cast<ClosestQuery*>(args->context);
  const auto& g = *static_cast<const ChunkGeometry*>(args->geometryUserPtr);
  RTCRayN* ray = RTCRayHitN_RayN(args->rayhit, args->N);
  const float t_max = RTCRayN_tfar(ray, args->N, 0);
  const LocalRay local = local_ray(g, query.origin, query.direction, RTCRayN_tnear(ray, args->N, 0), t_max);
  const SurfelBlock& block = g.chunk.blocks[args->primID];
  BlockHits hits;
  bool any = false;
  for (std::uint32_t mask = intersect_block(block, g.scale, local, 1.0f, hits); mask != 0; mask &= mask - 1) {
    const auto i = static_cast<unsigned>(std::countr_zero(mask));
    if (is_clipped(block, i, g.scale, local, hits.t[i])) continue;
    query.offer({hits.t[i], hits.distance2[i] / hits.radius2[i], &g, args->primID * 16 + i});
    any = true;
  }
  if (!any) return;
  RTCRayN_tfar(ray, args->N, 0) = std::min(t_max, query.first_t + query.slack);
  RTCHitN* hit = RTCRayHitN_HitN(args->rayhit, args->N);
  RTCHitN_geomID(hit, args->N, 0) = args->geomID;
}

void on_occluded(const RTCOccludedFunctionNArguments* args) {
  if (!args->valid[0]) return;
  const auto& query = *reinterpret_cast<const ShadowQuery*>(args->context);
  const auto& g = *static_cast<const ChunkGeometry*>(args->geometryUserPtr);
  const LocalRay local = local_ray(g, query.origin, query.direction, RTCRayN_tnear(args->ray, args->N, 0), RTCRayN_tfar(args->ray, args->N, 0));
  const SurfelBlock& block = g.chunk.blocks[args->primID];
  BlockHits hits;
  bool any = false;
  for (std::uint32_t mask = intersect_block(block, g.scale, local, kShadowRho2, hits); mask != 0 && !any; mask &= mask - 1) {
    const auto i = static_cast<unsigned>(std::countr_zero(mask));
    any = !is_clipped(block, i, g.scale, local, hits.t[i]);
  }
  if (any) RTCRayN_tfar(args->ray, args->N, 0) = -std::numeric_limits<float>::infinity();
}

/// Directions across a ray, a bit each.
constexpr std::size_t kDirections = 32;
constexpr std::uint32_t kAllDirections = 0xffffffffu;
constexpr float kOneFace = 0.82f;   ///< cosine between normals: below it they belong to different faces

struct UnitCircle {
  std::array<float, kDirections> u, v;
  UnitCircle() {
    for (std::size_t i = 0; i < kDirections; ++i) {
      const double angle = 2 * std::numbers::pi * static_cast<double>(i) / kDirections;
      u[i] = static_cast<float>(std::cos(angle));
      v[i] = static_cast<float>(std::sin(angle));
    }
  }
};
const UnitCircle kCircle;

/// What lies around a place, while Embree walks the tree.
struct SurroundQuery {
  const std::vector<const ChunkGeometry*>& by_geometry;
  Vec3f at, normal, u, v;          ///< u, v: across the ray
  float reach2;
  std::uint32_t covered = 0;       ///< directions on whose side of the ray a point lies
  bool is_edge = false;            ///< more than one face is there

  void add(const Vec3f& offset, const Vec3f& n) {
    is_edge |= std::fabs(n.dot(normal)) < kOneFace;
    const float x = offset.dot(u), y = offset.dot(v);
    for (std::size_t i = 0; i < kDirections; ++i) covered |= static_cast<std::uint32_t>(x * kCircle.u[i] + y * kCircle.v[i] >= 0) << i;
  }
};

bool on_near(RTCPointQueryFunctionArguments* args) {
  auto& query = *static_cast<SurroundQuery*>(args->userPtr);
  const ChunkGeometry& g = *query.by_geometry[args->geomID];
  const SurfelBlock& block = g.chunk.blocks[args->primID];
  const Vec3f at = query.at - g.origin_in_scene;
  for (std::size_t i = 0; i < 16; ++i) {
    if (block.flags[i] & SurfelBlock::kPadding) continue;
    const Vec3f offset = (Vec3f(block.x[i], block.y[i], block.z[i]) + Vec3f::Constant(0.5f)) * g.scale.step - at;
    if (offset.squaredNorm() <= query.reach2) query.add(offset, stream::decode_normal(block.normal_u[i], block.normal_v[i]));
  }
  if (query.covered != kAllDirections) return false;
  args->query->radius = 0;   // surrounded, whatever else is there
  return true;
}

struct RtcRelease {
  void operator()(RTCDevice d) const { rtcReleaseDevice(d); }
  void operator()(RTCScene s) const { rtcReleaseScene(s); }
};
using DevicePtr = std::unique_ptr<RTCDeviceTy, RtcRelease>;
using ScenePtr = std::unique_ptr<RTCSceneTy, RtcRelease>;

}  // namespace

struct Tracer::Impl {
  Impl(const Vec3d& origin, MemoryBudget& b) : origin_in_world(origin), budget(b) {}
  ~Impl() {
    scene.reset();
    chunks.clear();
    device.reset();
    budget.give(embree_bytes);
  }

  Vec3d origin_in_world;
  MemoryBudget& budget;
  std::atomic<std::uint64_t> embree_bytes{0};
  std::atomic<bool> refused{false};
  std::mutex error_mutex;
  std::string error;
  DevicePtr device;
  ScenePtr scene;
  std::map<std::uint32_t, std::unique_ptr<ChunkGeometry>> chunks;
  std::vector<const ChunkGeometry*> by_geometry;   ///< Embree's number of a geometry to its chunk; null: none
  std::uint64_t surfels = 0;
  float slack = 0;

  static bool on_memory(void* self, ssize_t bytes, bool post) {
    auto& impl = *static_cast<Impl*>(self);
    if (bytes > 0) {
      if (!impl.budget.try_take(static_cast<std::uint64_t>(bytes))) {
        // `post` means that the memory is already taken: it must be counted, and is then refused at the next call.
        impl.refused = true;
        return false;
      }
      impl.embree_bytes += static_cast<std::uint64_t>(bytes);
    } else {
      const auto freed = std::min<std::uint64_t>(static_cast<std::uint64_t>(-bytes), impl.embree_bytes);
      impl.embree_bytes -= freed;
      impl.budget.give(freed);
    }
    (void)post;
    return true;
  }
  static void on_error(void* self, RTCError, const char* text) {
    auto& impl = *static_cast<Impl*>(self);
    const std::lock_guard lock(impl.error_mutex);
    if (impl.error.empty()) impl.error = text ? text : "unknown";
  }
  void check(const char* what) {
    const std::lock_guard lock(error_mutex);
    if (error.empty() && !refused) return;
    const std::string text = refused ? concat("the memory budget does not allow it (", format_bytes(budget.free_bytes()), " left)") : error;
    error.clear();
    refused = false;
    throw Error(concat("ray tracing: ", what, ": ", text));
  }
};

Tracer::Tracer(const Vec3d& origin_in_world, MemoryBudget& budget) : impl_(std::make_unique<Impl>(origin_in_world, budget)) {
  impl_->device.reset(rtcNewDevice("start_threads=0,set_affinity=0"));
  if (!impl_->device) throw Error("ray tracing: Embree does not start");
  rtcSetDeviceErrorFunction(impl_->device.get(), &Impl::on_error, impl_.get());
  rtcSetDeviceMemoryMonitorFunction(impl_->device.get(), &Impl::on_memory, impl_.get());
  impl_->scene.reset(rtcNewScene(impl_->device.get()));
  rtcSetSceneBuildQuality(impl_->scene.get(), RTC_BUILD_QUALITY_MEDIUM);
}

Tracer::Tracer(Tracer&&) noexcept = default;
Tracer::~Tracer() = default;
const Vec3d& Tracer::origin_in_world() const { return impl_->origin_in_world; }
std::size_t Tracer::num_chunks() const { return impl_->chunks.size(); }
std::uint64_t Tracer::num_surfels() const { return impl_->surfels; }
bool Tracer::contains(std::uint32_t chunk) const { return impl_->chunks.contains(chunk); }

std::uint64_t Tracer::bytes() const {
  std::uint64_t sum = impl_->embree_bytes;
  for (const auto& [index, g] : impl_->chunks) sum += g->lease.bytes();
  return sum;
}

const Chunk* Tracer::chunk(std::uint32_t index) const {
  const auto it = impl_->chunks.find(index);
  return it == impl_->chunks.end() ? nullptr : &it->second->chunk;
}

void Tracer::add(Chunk chunk) {
  if (contains(chunk.index) || chunk.blocks.empty()) return;
  auto g = std::make_unique<ChunkGeometry>();
  g->lease = BudgetLease(impl_->budget, chunk.bytes(), "surfels for rays");
  g->chunk = std::move(chunk);
  g->origin_in_scene = scene_from_world(g->chunk.frame.origin_in_world);
  g->scale.step = static_cast<float>(g->chunk.frame.step);
  g->scale.radius2_max = g->chunk.frame.radius_max * g->chunk.frame.radius_max;
  const RTCGeometry geometry = rtcNewGeometry(impl_->device.get(), RTC_GEOMETRY_TYPE_USER);
  rtcSetGeometryUserPrimitiveCount(geometry, static_cast<unsigned>(g->chunk.blocks.size()));
  rtcSetGeometryUserData(geometry, g.get());
  rtcSetGeometryBoundsFunction(geometry, [](const RTCBoundsFunctionArguments* a) { on_bounds(a); }, nullptr);
  rtcSetGeometryIntersectFunction(geometry, &on_intersect);
  rtcSetGeometryOccludedFunction(geometry, &on_occluded);
  rtcCommitGeometry(geometry);
  g->geometry_id = rtcAttachGeometry(impl_->scene.get(), geometry);
  rtcReleaseGeometry(geometry);
  if (impl_->by_geometry.size() <= g->geometry_id) impl_->by_geometry.resize(g->geometry_id + 1, nullptr);
  impl_->by_geometry[g->geometry_id] = g.get();
  impl_->check("adding a chunk");
  impl_->surfels += g->chunk.count;
  impl_->slack = std::max(impl_->slack, g->chunk.frame.radius_max * kSlabRadii / kSlabMinCosine);
  impl_->chunks.emplace(g->chunk.index, std::move(g));
}

void Tracer::remove(std::uint32_t chunk) {
  const auto it = impl_->chunks.find(chunk);
  if (it == impl_->chunks.end()) return;
  rtcDetachGeometry(impl_->scene.get(), it->second->geometry_id);
  impl_->by_geometry[it->second->geometry_id] = nullptr;
  impl_->surfels -= it->second->chunk.count;
  impl_->chunks.erase(it);
}

void Tracer::commit() {
  rtcCommitScene(impl_->scene.get());
  impl_->check("building the acceleration structure");
}

namespace {

RTCRay embree_ray(const Ray& ray) {
  RTCRay r{};
  r.org_x = ray.origin.x();
  r.org_y = ray.origin.y();
  r.org_z = ray.origin.z();
  r.dir_x = ray.direction.x();
  r.dir_y = ray.direction.y();
  r.dir_z = ray.direction.z();
  r.tnear = ray.t_min;
  r.tfar = ray.t_max;
  r.mask = 0xffffffffu;
  return r;
}

/// Blends what lies in the slab behind the first disc. Candidates are sorted, so sums do not depend on the order of traversal.
void blend(ClosestQuery& q, Hit& hit, HitBlend* parts) {
  std::sort(q.list.begin(), q.list.begin() + q.count, [](const Candidate& a, const Candidate& b) { return a.before(b); });
  const auto normal_of = [](const Candidate& c) {
    const SurfelBlock& b = c.geometry->chunk.blocks[c.slot / 16];
    return stream::decode_normal(b.normal_u[c.slot % 16], b.normal_v[c.slot % 16]);
  };
  const auto radius_of = [](const Candidate& c) { return std::sqrt(radius2_of(c.geometry->chunk.blocks[c.slot / 16], c.slot % 16, c.geometry->scale)); };
  const Candidate& first = q.list[0];
  const Vec3f n_front = normal_of(first), n_first = n_front.dot(q.direction) > 0 ? Vec3f(-n_front) : n_front;
  const float slab = kSlabRadii * radius_of(first) / std::max(kSlabMinCosine, -n_first.dot(q.direction));
  float weight = 0, t = 0, back = 0, best = 2;
  Vec3f normal = Vec3f::Zero();
  for (int i = 0; i < q.count; ++i) {
    const Candidate& c = q.list[static_cast<std::size_t>(i)];
    if (c.t > first.t + slab) break;
    Vec3f n = i == 0 ? n_front : normal_of(c);
    const bool from_behind = n.dot(q.direction) > 0;
    if (from_behind) n = -n;
    if (n.dot(n_first) < 0.5f) continue;  // another face of an edge
    const float k = 1.0f - c.rho2, w = k * k + 1e-4f;
    if (parts && parts->count < HitBlend::kMost) {
      const auto k_part = static_cast<std::size_t>(parts->count++);
      parts->surfel[k_part] = {c.geometry->chunk.index, static_cast<std::uint16_t>(c.slot)};
      parts->weight[k_part] = w;
    }
    weight += w;
    t += w * (c.t - first.t);
    normal += w * n;
    if (from_behind && (c.geometry->chunk.blocks[c.slot / 16].flags[c.slot % 16] & SurfelBlock::kOriented)) back += w;
    if (c.rho2 < best) {
      best = c.rho2;
      hit.surfel = {c.geometry->chunk.index, static_cast<std::uint16_t>(c.slot)};
      hit.radius = radius_of(c);
    }
  }
  hit.t = first.t + t / weight;
  hit.normal = normal.normalized();
  hit.back = back / weight;
  if (!parts) return;
  float kept = 0;
  for (int i = 0; i < parts->count; ++i) kept += parts->weight[static_cast<std::size_t>(i)];
  for (int i = 0; i < parts->count; ++i) parts->weight[static_cast<std::size_t>(i)] /= kept;
}

}  // namespace

bool Tracer::closest(const Ray& ray, Hit& hit) const { return find(ray, hit, nullptr); }

bool Tracer::closest(const Ray& ray, Hit& hit, HitBlend& parts) const {
  parts.count = 0;
  return find(ray, hit, &parts);
}

bool Tracer::find(const Ray& ray, Hit& hit, HitBlend* parts) const {
  ClosestQuery query;
  init_context(&query.context);
  query.origin = ray.origin;
  query.direction = ray.direction;
  query.slack = impl_->slack;
  RTCRayHit rh{};
  rh.ray = embree_ray(ray);
  rh.hit.geomID = RTC_INVALID_GEOMETRY_ID;
#if CHIARO_EMBREE4
  RTCIntersectArguments args;
  rtcInitIntersectArguments(&args);
  args.context = &query.context;
  rtcIntersect1(impl_->scene.get(), &rh, &args);
#else
  rtcIntersect1(impl_->scene.get(), &query.context, &rh);
#endif
  if (query.count == 0) return false;
  blend(query, hit, parts);
  return true;
}

bool Tracer::occluded(const Ray& ray) const {
  ShadowQuery query;
  init_context(&query.context);
  query.origin = ray.origin;
  query.direction = ray.direction;
  RTCRay r = embree_ray(ray);
#if CHIARO_EMBREE4
  RTCOccludedArguments args;
  rtcInitOccludedArguments(&args);
  args.context = &query.context;
  rtcOccluded1(impl_->scene.get(), &r, &args);
#else
  rtcOccluded1(impl_->scene.get(), &query.context, &r);
#endif
  return r.tfar < 0;
}

bool Tracer::is_beyond_edge(const Ray& ray, const Hit& hit) const {
  const Vec3f at = ray.origin + ray.direction * hit.t, u = ray.direction.unitOrthogonal();
  const float reach = kEdgeRadii * hit.radius;
  SurroundQuery query{impl_->by_geometry, at, hit.normal, u, ray.direction.cross(u), reach * reach};
  RTCPointQuery near{at.x(), at.y(), at.z(), 0, reach * 1.001f};   // what is near is decided point by point
  RTCPointQueryContext context;
  rtcInitPointQueryContext(&context);
  rtcPointQuery(impl_->scene.get(), &near, &context, &on_near, &query);
  return query.is_edge && query.covered != kAllDirections;
}

Ray escape_ray(const Vec3f& position, const Vec3f& normal, float radius, const Vec3f& direction, float t_max, const EscapeOptions& options) {
  return {position + normal * (options.lift * radius), direction, options.skip * radius, t_max};
}

}  // namespace chiaro::surfels
