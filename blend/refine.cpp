#include "blend/refine.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <cstring>
#include <limits>

#include "blend/detail.h"
#include "blend/insert.h"
#include "stream/base/error.h"
#include "stream/base/file.h"
#include "stream/base/parallel.h"
#include "stream/store/neighbours.h"

namespace chiaro::blend {
namespace {

using stream::HaloChunk;

constexpr const char* kDetailFile = "refine.detail";
constexpr std::uint32_t kSliceGroups = 128;      // of a leaf, a task: new points wait in memory until those before them are written
constexpr int kMostLevels = 6;                   // each doubles the points: 64 at most where the cloud has one
constexpr int kSteps = 96, kStepsAnOctave = 8;   // of the factor on all footprints

/// On the disk; little-endian.
struct PointRecord {
  double position[3];
  float normal[3];
  std::uint32_t reserved;
};
static_assert(sizeof(PointRecord) == 40 && std::is_trivially_copyable_v<PointRecord>);

bool meet(const Box3d& a, const Box3d& b) { return (a.min.array() <= b.max.array()).all() && (b.min.array() <= a.max.array()).all(); }

/// Leaves whose points may lie in the box, in the order of their index. Inner nodes bound their children but for rounding.
std::vector<std::pair<std::uint32_t, Box3d>> leaves_in(const stream::Store& store, const Box3d& box) {
  std::vector<std::pair<std::uint32_t, Box3d>> found;
  std::vector<std::uint32_t> stack{0};
  while (!stack.empty()) {
    const std::uint32_t i = stack.back();
    stack.pop_back();
    const stream::ChunkEntry& e = store.chunks()[i];
    Box3d bounds = store.bounds(i);
    if (!e.is_leaf()) {
      const stream::ChunkFrame cell = store.frame(i);
      bounds = {cell.origin_in_world, cell.origin_in_world + Vec3d::Constant(65536 * cell.step)};
    }
    if (!meet(bounds, box)) continue;
    if (e.is_leaf()) found.emplace_back(i, bounds);
    for (std::uint32_t c = 0; c < e.num_children; ++c) stack.push_back(e.first_child + c);
  }
  std::sort(found.begin(), found.end(), [](const auto& a, const auto& b) { return a.first < b.first; });
  return found;
}

/// Part of a leaf: groups of kGroup distinct positions.
struct Slice {
  std::size_t leaf = 0;
  std::uint32_t first_group = 0;
};

/// Of a slice.
struct Found {
  std::array<double, kSteps> asked{};   ///< points, by step of the common factor
  RefineStats counts;
  std::vector<NewPoint> points;
};

class Refiner {
 public:
  Refiner(const stream::Store& store, const LeafFile& detail, MemoryBudget& budget, Reporter& report)
      : store_(store), detail_(detail), budget_(budget), report_(report), edge_(store.manifest().edge), find_([&store](const Box3d& box) { return leaves_in(store, box); }) {
    for (std::size_t i = 0; i < store.leaves().size(); ++i) {
      const std::uint32_t count = store.chunks()[store.leaves()[i]].count;
      largest_ = std::max(largest_, count);
      surfels_ += count;
      if (!detail.is_written(i)) continue;
      for (std::uint32_t g = 0; g * HaloChunk::kGroup < count; g += kSliceGroups) slices_.push_back({i, g});
    }
  }

  RefineStats run(std::uint64_t most, const std::filesystem::path& path) {
    RefineStats stats;
    std::array<double, kSteps> asked{};
    walk("refine: measure the cloud", kMeasure, [&](const Found& found) {
      for (std::size_t i = 0; i < asked.size(); ++i) asked[i] += found.asked[i];
    });
    const auto budget = static_cast<double>(most);
    step_ = 0;
    while (step_ + 1 < kSteps && asked[static_cast<std::size_t>(step_)] > budget) ++step_;
    for (;; ++step_) {   // what was asked is an estimate: what there is counts
      stats = write(path, most);
      if (stats.inserted <= most || step_ + 1 >= kSteps) break;
    }
    if (stats.inserted > most) stats = write_none(path, stats, most);
    stats.asked = static_cast<std::uint64_t>(asked[0]);
    stats.coarser = factor();
    stats.surfels = surfels_;
    stats.unseen = surfels_ - stats.refined - stats.fine_enough - stats.without_surface - stats.over_budget;
    return stats;
  }

 private:
  static constexpr int kMeasure = 0, kInsert = 1;
  double factor(int step) const { return std::exp2(static_cast<double>(step) / kStepsAnOctave); }
  double factor() const { return factor(step_); }

  RefineStats write(const std::filesystem::path& path, std::uint64_t most) {
    RefineStats stats;
    AtomicFile file(path);
    walk("refine: insert points", kInsert, [&](const Found& found) {
      stats.refined += found.counts.refined;
      stats.fine_enough += found.counts.fine_enough;
      stats.without_surface += found.counts.without_surface;
      stats.inserted += found.points.size();
      if (stats.inserted > most) return;   // it will be done again
      for (const NewPoint& p : found.points) {
        const Vec3d position = store_.manifest().origin_in_world + p.from_anchor;
        const PointRecord record{{position.x(), position.y(), position.z()}, {p.normal.x(), p.normal.y(), p.normal.z()}, 0};
        file.append(&record, sizeof record);
      }
    });
    if (stats.inserted <= most) file.commit();
    return stats;
  }

  /// Where the photographs are finer than the cloud by more than the steps reach, the last one still asks for points everywhere. Whose those within the budget should be is not
  /// said by anything then. found: at that step.
  RefineStats write_none(const std::filesystem::path& path, const RefineStats& found, std::uint64_t most) {
    AtomicFile(path).commit();
    report_.note(concat("refine: none inserted: points ", std::llround(factor()), " times as far apart as the photographs' pixels, the farthest that is tried, would be ", found.inserted,
                        ", and ", most, " are allowed"));
    RefineStats none = found;
    none.inserted = none.refined = 0;
    none.over_budget = found.refined;
    return none;
  }

  /// Slices in parallel, what they found in their order.
  template <class Take>
  void walk(const char* title, int what, const Take& take) {
    // A worker holds its leaf, a copy for searching with one of a neighbour, details, candidates, and in the worst case the new points of a slice.
    const std::uint64_t per_worker = stream::geometry_bytes(largest_) + 3 * HaloChunk::bytes_for(largest_) + largest_ * sizeof(Detail) + (2u << 20) +
                                     (what == kInsert ? std::uint64_t{kSliceGroups} * HaloChunk::kGroup * 64 * sizeof(NewPoint) : 0);
    const auto workers = static_cast<std::size_t>(std::clamp<std::uint64_t>(budget_.free_bytes() / 2 / per_worker, 1, static_cast<std::uint64_t>(ThreadLimit::current())));
    const BudgetLease lease(budget_, workers * per_worker, "refinement of leaves");
    stream::HaloCache cache(
        budget_,
        [&](std::uint32_t i) {
          const stream::Chunk chunk = store_.read_chunk(i);
          return stream::make_halo_chunk(i, chunk.frame, chunk.blocks, chunk.count, true);
        },
        [&](std::uint32_t i) { return HaloChunk::bytes_for(store_.chunks()[i].count); }, workers * stream::HaloCache::kLeavesOfWorker * HaloChunk::bytes_for(largest_));
    report_.begin(title, slices_.size(), "parts");
    for (std::size_t first = 0; first < slices_.size(); first += workers) {
      report_.check();
      report_.progress(first);
      std::vector<Found> found(std::min(workers, slices_.size() - first));
      parallel_blocks(found.size(), 1, [&](std::size_t b, std::size_t e) {
        for (std::size_t i = b; i < e; ++i) look_at(slices_[first + i], what, cache, found[i]);
      });
      for (const Found& f : found) take(f);
    }
    report_.end();
  }

  void look_at(const Slice& slice, int what, stream::HaloCache& cache, Found& found) const {
    const std::uint32_t index = store_.leaves()[slice.leaf];
    const stream::Chunk chunk = store_.read_chunk(index);
    const auto details = detail_.read<Detail>(slice.leaf);
    stream::Neighbourhood around(cache.get(index), store_.bounds(index), find_, cache);
    const HaloChunk& own = around.own();
    const std::uint32_t groups = (own.size + HaloChunk::kGroup - 1) / HaloChunk::kGroup;
    for (std::uint32_t g = slice.first_group; g < std::min(groups, slice.first_group + kSliceGroups); ++g) look_at_group(g, what, chunk, details.surfels, around, found);
  }

  void look_at_group(std::uint32_t group, int what, const stream::Chunk& chunk, const std::vector<Detail>& details, stream::Neighbourhood& around, Found& found) const {
    const HaloChunk& own = around.own();
    const std::uint32_t first = group * HaloChunk::kGroup, end = std::min(own.size, first + HaloChunk::kGroup);
    float radius = 0;
    for (std::uint32_t i = first; i < end; ++i)
      if (const std::uint32_t slot = own.first_slot[i]; details[slot].weight > 0) radius = std::max(radius, chunk.surfel(slot).radius);
    if (!(radius > 0)) return;
    const float reach = kReachRadii * radius;
    stream::Selection near;
    around.gather(own.box_of_group(group), reach, true, near);
    stream::LanePoints points;
    std::memcpy(points.x.data(), &own.x[first], sizeof points.x);
    std::memcpy(points.y.data(), &own.y[first], sizeof points.y);
    std::memcpy(points.z.data(), &own.z[first], sizeof points.z);
    stream::Nearest nearest;
    stream::nearest_of(near.view(), points, nearest);
    stream::LaneFloats sixth, mean;
    stream::distances_of(nearest, sixth, mean);
    for (std::uint32_t i = first; i < end; ++i) {
      const Detail& detail = details[own.first_slot[i]];
      if (!(detail.weight > 0)) continue;
      const std::uint64_t together = own.first_slot[i + 1] - own.first_slot[i];   // points on one spot
      const float distance = sixth[i - first];
      if (!(distance > 0 && distance <= reach) || (own.flags[i] & stream::SurfelBlock::kIsolated) != 0) {
        found.counts.without_surface += together;
        continue;
      }
      const float spacing = distance * kSpacingOfSixth;
      what == kMeasure ? measure(own, i, spacing, detail, found) : insert(own, i, spacing, detail, near, together, found);
    }
  }

  static Vec3f normal_of(const HaloChunk& own, std::uint32_t i) { return {own.nx[i], own.ny[i], own.nz[i]}; }

  /// Level of the lattice around a disc; nullopt where it would add too little.
  std::optional<int> level_for(const Vec3f& normal, float spacing, double footprint) const {
    const float along = normal.cwiseAbs().maxCoeff();
    const int finest = lattice_level(edge_, static_cast<double>(spacing), along) + kMostLevels, level = std::min(finest, lattice_level(edge_, footprint, along));
    if (lattice_spacing(edge_, level, along) > kWorthRefining * static_cast<double>(spacing)) return std::nullopt;
    return level;
  }

  void measure(const HaloChunk& own, std::uint32_t i, float spacing, const Detail& detail, Found& found) const {
    const Vec3f normal = normal_of(own, i);
    for (int step = 0; step < kSteps; ++step) {
      const auto level = level_for(normal, spacing, factor(step) * static_cast<double>(detail.footprint));
      if (!level) return;
      const double ratio = static_cast<double>(spacing) / lattice_spacing(edge_, *level, normal.cwiseAbs().maxCoeff());
      found.asked[static_cast<std::size_t>(step)] += ratio * ratio - 1;
    }
  }

  void insert(const HaloChunk& own, std::uint32_t i, float spacing, const Detail& detail, const stream::Selection& near, std::uint64_t together, Found& found) const {
    const Vec3f normal = normal_of(own, i), centre(own.x[i], own.y[i], own.z[i]);
    const auto level = level_for(normal, spacing, factor() * static_cast<double>(detail.footprint));
    if (!level) {
      found.counts.fine_enough += together;
      return;
    }
    std::vector<NearDisc> around;
    const float limit = kReachSpacings * spacing;
    for (std::size_t k = 0; k < near.size(); ++k) {
      const Vec3f offset = Vec3f(near.x[k], near.y[k], near.z[k]) - centre;
      const float squared = offset.squaredNorm();
      if (squared > 0 && squared <= limit * limit) around.push_back({offset, {near.nx[k], near.ny[k], near.nz[k]}});
    }
    const RefinedDisc disc{own.origin_in_world - store_.manifest().origin_in_world + centre.cast<double>(), normal, (own.flags[i] & stream::SurfelBlock::kOriented) != 0, spacing};
    const std::size_t before = found.points.size();
    insert_around(disc, around, edge_, *level, found.points);
    (found.points.size() > before ? found.counts.refined : found.counts.without_surface) += together;
  }

  static constexpr float kReachRadii = 4;                  // a disc covers its Voronoi cell: at least 0.7 spacings
  static constexpr float kSpacingOfSixth = 0.7236f;        // over sqrt(6 / pi), see stream/store/surfel_fit.h
  const stream::Store& store_;
  const LeafFile& detail_;
  MemoryBudget& budget_;
  Reporter& report_;
  double edge_;
  stream::Neighbourhood::Find find_;
  std::vector<Slice> slices_;
  std::uint32_t largest_ = 1;
  std::uint64_t surfels_ = 0;
  int step_ = 0;
};

class NewPointReader final : public stream::PointReader {
 public:
  explicit NewPointReader(const std::filesystem::path& path) : file_(path, File::Mode::kRead), left_(file_.size() / sizeof(PointRecord)) {
    if (file_.size() % sizeof(PointRecord) != 0) throw Error(concat(path.string(), ": ", file_.size(), " bytes, expected whole points of ", sizeof(PointRecord)));
    schema_.declared_points = left_;
    schema_.position_is_double = schema_.has_normal = true;
  }
  const stream::PointSchema& schema() const override { return schema_; }
  bool read(stream::PointBlock& block, std::size_t max_points) override {
    block.clear();
    records_.resize(static_cast<std::size_t>(std::min<std::uint64_t>(max_points, left_)));
    if (records_.empty()) return false;
    file_.read_at(at_, records_.data(), records_.size() * sizeof(PointRecord));
    at_ += records_.size() * sizeof(PointRecord);
    left_ -= records_.size();
    for (const PointRecord& r : records_) {
      block.position.emplace_back(r.position[0], r.position[1], r.position[2]);
      block.normal.emplace_back(r.normal[0], r.normal[1], r.normal[2]);
    }
    return true;
  }

 private:
  File file_;
  std::uint64_t left_ = 0, at_ = 0;
  stream::PointSchema schema_;
  std::vector<PointRecord> records_;
};

}  // namespace

RefineStats find_new_points(const stream::Store& store, std::span<const BlendPhotograph> photographs, const BlendOptions& options, std::uint64_t most,
                            const std::filesystem::path& file, const std::filesystem::path& scratch, MemoryBudget& budget, Reporter& report) {
  options.validate();
  make_folder(scratch);
  const std::filesystem::path detail_path = scratch / kDetailFile;
  RefineStats stats;
  {
    const LeafFile detail = collect_detail(store, photographs, options, detail_path, budget, report);
    stats = Refiner(store, detail, budget, report).run(most, file);
  }
  std::error_code ignored;
  std::filesystem::remove(detail_path, ignored);
  return stats;
}

std::unique_ptr<stream::PointReader> read_new_points(const std::filesystem::path& file) { return std::make_unique<NewPointReader>(file); }

}  // namespace chiaro::blend
