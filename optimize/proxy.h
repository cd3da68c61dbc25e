/// The transport proxy: a cut of the octree, small enough to hold, on which light transport is gathered and solved. Indirect light varies slowly, so
/// the proxy may be coarser than the photographs; direct light, shadows and normals stay at full resolution (physics.md E.7).
#pragma once
#include <cstdint>
#include <span>
#include <vector>

#include "stream/base/nearest_points.h"
#include "stream/store/store.h"
#include "surfels/tracer.h"
#include "surfels/working_set.h"

namespace chiaro::optimize {

/// Structure of arrays over N proxy surfels; positions in the scene frame (world minus origin_in_world), project units.
struct Proxy {
  Vec3d origin_in_world = Vec3d::Zero();
  double metres_per_unit = 1;               ///< flash irradiance is per m^2, whatever the project's unit; and how far people misplace a flash is known in metres
  std::vector<Vec3f> position, normal;      ///< normals unit; the sign is settled by orient()
  std::vector<float> radius;
  std::vector<std::uint8_t> oriented;       ///< 1: the sign of the normal is known
  std::vector<std::uint32_t> chunks, first; ///< store chunks of the cut, ascending, and the proxy index of their slot 0
  std::size_t size() const { return position.size(); }
  /// throws std::out_of_range if the chunk is not part of the proxy.
  std::uint32_t index_of(const SurfelId& id) const;
  std::uint64_t bytes() const { return size() * 33; }
};

Proxy load_proxy(const stream::Store& store, const surfels::WorkingSet& cut);
/// For rays from and to the proxy's surfels, in its frame.
surfels::Tracer make_tracer(const stream::Store& store, const Proxy& proxy, MemoryBudget& budget);

/// Settles the signs of normals: votes[i] > 0 keeps, < 0 flips (cameras that see the surfel); the rest follows its neighbours, outwards.
void orient(Proxy& proxy, std::span<const float> votes, const NearestPoints& nearest);

/// Averages over neighbours of like normal and plane: what was gathered is smooth, its noise is not (prototype.md: worth 16 times the rays).
struct Smoother {
  std::size_t k = 0;
  std::vector<std::uint32_t> index;   ///< N * k
  std::vector<float> weight;          ///< N * k, rows sum to 1
  /// In place, `channels` interleaved values a surfel, `passes` times.
  void apply(std::vector<float>& values, int channels, int passes) const;
};
Smoother make_smoother(const Proxy& proxy, const NearestPoints& nearest, std::size_t k = 16);

}  // namespace chiaro::optimize
