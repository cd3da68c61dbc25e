/// Rays against surfels: Embree user geometry whose primitive is a block of 16 quantised discs, exactly as read from disk.
///
/// Points of a scan are noisy and their discs overlap, so a ray does not take the first disc but the blend of all discs that it meets within
/// a slab behind the first one: position and normal are smooth, and do not depend on the order in which Embree visits blocks.
#pragma once
#include <array>
#include <cstdint>
#include <memory>
#include <span>
#include <vector>

#include "stream/base/budget.h"
#include "stream/base/types.h"
#include "stream/store/store.h"

namespace chiaro::surfels {

struct Ray {
  Vec3f origin;     ///< scene frame: world minus Tracer::origin_in_world()
  Vec3f direction;  ///< unit
  float t_min = 0;
  float t_max = 1e30f;
};

struct Hit {
  float t = 0;             ///< blended distance
  Vec3f normal;            ///< blended, unit, facing the ray's origin
  float radius = 0;        ///< of the surfel nearest to the ray
  SurfelId surfel;         ///< the surfel whose centre is nearest to the ray, in units of its radius
  float back = 0;          ///< share of the blend weight on oriented surfels that were hit from behind, 0..1
};

/// The surfels that a hit blends, with weights that sum to 1; the first kMost along the ray.
struct HitBlend {
  static constexpr int kMost = 16;
  int count = 0;
  std::array<SurfelId, kMost> surfel;
  std::array<float, kMost> weight{};
};

/// How shadow and gather rays leave a surface: they start `lift` radii above it, and what they meet within `skip` radii of the start is the surface itself.
struct EscapeOptions {
  float lift = 0.35f;
  float skip = 1.0f;
};

/// The ray-castable set of chunks. Chunks are added and removed; commit() after changes. Queries are thread-safe.
class Tracer {
 public:
  /// origin_in_world: chosen near the geometry, since rays work in float. Embree's allocations are charged to the budget and refused beyond it.
  Tracer(const Vec3d& origin_in_world, MemoryBudget& budget);
  Tracer(Tracer&&) noexcept;
  ~Tracer();
  const Vec3d& origin_in_world() const;
  Vec3f scene_from_world(const Vec3d& p) const { return (p - origin_in_world()).cast<float>(); }

  /// Takes the chunk over. throws Error when the budget does not allow it (the tracer is unchanged then).
  void add(stream::Chunk chunk);
  bool contains(std::uint32_t chunk) const;
  void remove(std::uint32_t chunk);
  /// Builds the acceleration structure. throws Error beyond the budget.
  void commit();
  std::size_t num_chunks() const;
  std::uint64_t num_surfels() const;
  std::uint64_t bytes() const;
  const stream::Chunk* chunk(std::uint32_t index) const;

  /// Nearest surface along the ray; false if there is none.
  bool closest(const Ray& ray, Hit& hit) const;
  /// The same, and what was blended: for reading colour smoothly.
  bool closest(const Ray& ray, Hit& hit, HitBlend& blend) const;
  /// True if something lies between t_min and t_max. What belongs to the starting surface (origin_normal, radius) is not counted.
  bool occluded(const Ray& ray) const;
  /// Did closest() find only a disc that stands out over an edge? A disc covers its point's cell, and at an edge, above all at a sharp or rounded one, it reaches up to
  /// half a spacing into the air. As seen along the ray, points lie densely up to where a surface turns away: true if all points around the hit lie on one side
  /// of the ray. Where they are all of one face it may as well be a gap between them: false.
  bool is_beyond_edge(const Ray& ray, const Hit& hit) const;

 private:
  struct Impl;
  bool find(const Ray& ray, Hit& hit, HitBlend* blend) const;
  std::unique_ptr<Impl> impl_;
};

/// A ray that leaves a surface point: lifted along the normal and skipping its own surface.
Ray escape_ray(const Vec3f& position, const Vec3f& normal, float radius, const Vec3f& direction, float t_max, const EscapeOptions& options = {});

}  // namespace chiaro::surfels
