/// Nearest points of a leaf across all leaves: each leaf in memory with a small tree of its blocks, behind a cache under the budget.
#pragma once
#include <functional>
#include <list>
#include <memory>
#include <mutex>
#include <unordered_map>
#include <vector>

#include "stream/base/budget.h"
#include "stream/base/file.h"
#include "stream/store/near_select.h"
#include "stream/store/store.h"

namespace chiaro::stream {

/// The distinct positions of a leaf: points on one spot are one entry.
struct HaloChunk {
  static constexpr std::uint32_t kGroup = kBoxedPoints;
  std::uint32_t index = 0;
  Vec3d origin_in_world;
  std::uint32_t size = 0;                            ///< distinct positions
  std::vector<float> x, y, z;                        ///< relative to the cell's lower corner; padded to groups with a far value
  std::vector<float> nx, ny, nz;                     ///< unit normal of the first surfel on the spot; empty while normals are being fitted
  std::vector<std::uint8_t> flags;                   ///< of the first surfel on the spot
  std::vector<std::uint32_t> first_slot;             ///< size + 1
  bool any_oriented = false;                         ///< some flags say that the sign of the normal is known
  struct FlatBox {
    std::array<float, 3> min, max;
  };
  FlatBox bounds{};
  BoxLevels levels;                                  ///< of groups of kGroup points
  FlatBox box_of_group(std::uint32_t group) const;
  static std::uint64_t bytes_for(std::uint32_t count);
};
std::shared_ptr<const HaloChunk> make_halo_chunk(std::uint32_t index, const ChunkFrame& frame, const std::vector<SurfelBlock>& blocks, std::uint32_t count, bool with_normals);

/// Leaves as HaloChunks, least recently used first out. Holds what was used last, up to most_bytes and never beyond the budget. Thread-safe; what a caller holds stays valid.
class HaloCache {
 public:
  using Load = std::function<std::shared_ptr<const HaloChunk>(std::uint32_t chunk)>;
  /// Leaves worth keeping for each worker that goes through a cloud in Morton order: those around the one it is at, and those that it comes back to. More bring
  /// nothing (docs/scale.md).
  static constexpr std::uint64_t kLeavesOfWorker = 24;
  /// bytes_of: cost of a chunk, known before it is loaded. most_bytes: of what is kept, whatever the budget has left.
  HaloCache(MemoryBudget& budget, Load load, std::function<std::uint64_t(std::uint32_t)> bytes_of, std::uint64_t most_bytes)
      : budget_(budget), most_bytes_(most_bytes), load_(std::move(load)), bytes_of_(std::move(bytes_of)) {}
  std::shared_ptr<const HaloChunk> get(std::uint32_t chunk);

 private:
  struct Slot {
    std::shared_ptr<const HaloChunk> chunk;
    BudgetLease lease;
    std::list<std::uint32_t>::iterator place;
  };
  bool evict_one();
  MemoryBudget& budget_;
  std::uint64_t most_bytes_, held_bytes_ = 0;
  Load load_;
  std::function<std::uint64_t(std::uint32_t)> bytes_of_;
  std::mutex mutex_;
  std::unordered_map<std::uint32_t, Slot> slots_;
  std::list<std::uint32_t> order_;  ///< most recent first
};

/// Gathers candidates for one chunk from itself and the leaves around. One thread at a time.
class Neighbourhood {
 public:
  /// Leaves whose tight bounds meet a box in world, in index order, with these bounds.
  using Find = std::function<std::vector<std::pair<std::uint32_t, Box3d>>(const Box3d& box)>;
  Neighbourhood(std::shared_ptr<const HaloChunk> own, const Box3d& own_bounds, const Find& find, HaloCache& cache);
  const HaloChunk& own() const { return *own_; }
  /// All points within `radius` of the box, relative to the lower corner of the own chunk, in an order that does not depend on the radius.
  void gather(const HaloChunk::FlatBox& box, float radius, bool with_normals, Selection& out);

 private:
  struct Near {
    std::uint32_t chunk;
    HaloChunk::FlatBox box;  ///< in the own frame, grown for rounding
  };
  void find_near(float radius);
  void gather_from(const HaloChunk& chunk, const HaloChunk::FlatBox& box, float radius, const Vec3d* shift, Selection& out);
  std::shared_ptr<const HaloChunk> own_;
  Box3d own_bounds_;
  const Find& find_;
  HaloCache& cache_;
  std::vector<Near> near_;
  float near_radius_ = 0;    ///< near_ holds all leaves that come this close
};

}  // namespace chiaro::stream
