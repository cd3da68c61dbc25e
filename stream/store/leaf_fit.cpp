#include "stream/store/leaf_fit.h"

#include <algorithm>
#include <atomic>
#include <bit>
#include <cmath>

#include "stream/base/hash.h"
#include "stream/base/parallel.h"
#include "stream/store/morton.h"
#include "stream/store/pending_normal.h"
#include "stream/store/store_format.h"
#include "stream/store/surfel_fit.h"

namespace chiaro::stream {
namespace {

// What is further than this many typical spacings is no neighbour, so that outliers stay alone.
constexpr double kReachSpacings = 256;
// Radii need the points beyond the corners of a Voronoi cell, to tell a gap in the sampling from a border. Measured on random samples of a sphere and a
// square: 2.8 leaves 2 rays in 10 000 without a disc, 3.4 none in 100 000; discs reach 0.6 spacings over the border in both.
constexpr double kRadiusSpacings = 3.4;

bool meet(const Box3d& a, const Box3d& b) { return (a.min.array() <= b.max.array()).all() && (b.min.array() <= a.max.array()).all(); }

// Leaves whose tight bounds meet the box, by descent from the root.
std::vector<std::pair<std::uint32_t, Box3d>> find_leaves(const FitJob& job, const Box3d& box) {
  std::vector<std::pair<std::uint32_t, Box3d>> found;
  std::vector<std::uint32_t> stack{0};
  while (!stack.empty()) {
    const std::uint32_t i = stack.back();
    stack.pop_back();
    const ChunkEntry& e = job.entries[i];
    const ChunkFrame frame = frame_of(job.manifest, e);
    Box3d bounds;
    if (e.is_leaf()) {
      bounds = tight_box(frame, e);
    } else {
      bounds.min = frame.origin_in_world;
      bounds.max = frame.origin_in_world + Vec3d::Constant(65536 * frame.step);
    }
    if (!meet(bounds, box)) continue;
    if (e.is_leaf()) found.emplace_back(i, bounds);
    for (std::uint32_t c = 0; c < e.num_children; ++c) stack.push_back(e.first_child + c);
  }
  std::sort(found.begin(), found.end(), [](const auto& a, const auto& b) { return a.first < b.first; });
  return found;
}

// Calls body(chunk, neighbourhood) for the leaves, by workers that take them in Morton order so that they share the cache.
enum class Look { kPositions, kFirstNormals, kSettledNormals };

std::vector<SurfelBlock> read_as(const FitJob& job, const ChunkEntry& e, Look look) {
  std::vector<SurfelBlock> blocks = read_blocks(job.geometry, e);
  if (look == Look::kFirstNormals) forget_pending(blocks);
  if (look == Look::kSettledNormals) settle(blocks);
  return blocks;
}

template <class F>
void for_each_leaf(const FitJob& job, const char* stage, Look look, MemoryBudget& budget, Reporter& report, const F& body) {
  std::uint64_t points = 0, largest = 1;
  for (const std::uint32_t i : job.leaves) {
    points += job.entries[i].count;
    largest = std::max<std::uint64_t>(largest, job.entries[i].count);
  }
  // A worker holds its chunk twice, a neighbour, and lists of candidates.
  const std::uint64_t per_worker = largest * 16 + (2 << 20);
  const std::uint64_t pinned = 3 * HaloChunk::bytes_for(static_cast<std::uint32_t>(largest));
  const auto workers = static_cast<std::size_t>(std::clamp<std::uint64_t>(budget.free_bytes() / (per_worker + pinned), 1, static_cast<std::uint64_t>(std::clamp(ThreadLimit::current(), 1, 64))));
  const BudgetLease lease(budget, per_worker * workers, "fitting of surfels");
  HaloCache cache(
      budget, [&](std::uint32_t i) { return make_halo_chunk(i, frame_of(job.manifest, job.entries[i]), read_as(job, job.entries[i], look), job.entries[i].count, look != Look::kPositions); },
      [&](std::uint32_t i) { return HaloChunk::bytes_for(job.entries[i].count); }, workers * HaloCache::kLeavesOfWorker * HaloChunk::bytes_for(static_cast<std::uint32_t>(largest)));
  const Neighbourhood::Find find = [&](const Box3d& box) { return find_leaves(job, box); };
  report.begin(stage, points, "points");
  std::atomic<std::size_t> next{0};
  std::atomic<std::uint64_t> done{0};
  parallel_blocks(workers, 1, [&](std::size_t, std::size_t) {
    for (std::size_t at = next++; at < job.leaves.size(); at = next++) {
      report.check();
      const std::uint32_t chunk = job.leaves[at];
      Neighbourhood around(cache.get(chunk), tight_box(frame_of(job.manifest, job.entries[chunk]), job.entries[chunk]), find, cache);
      body(chunk, around);
      report.progress(done += job.entries[chunk].count);
    }
  });
  report.end();
}

FitOptions fit_options(const FitJob& job, double radius_spacings) {
  FitOptions options;
  options.radius_spacings = radius_spacings;
  options.max_radius = static_cast<float>(kReachSpacings * job.typical_spacing);
  options.lone_radius = static_cast<float>(job.typical_spacing);
  return options;
}

bool is_estimated(const SurfelBlock& b, std::size_t lane) { return (b.flags[lane] & SurfelBlock::kEstimated) != 0; }

template <class Test>
bool any_surfel(const std::vector<SurfelBlock>& blocks, std::uint32_t count, const Test& test) {
  for (std::uint32_t slot = 0; slot < count; ++slot)
    if (test(blocks[slot / 16], slot % 16)) return true;
  return false;
}

}  // namespace

void fit_normals(const FitJob& job, MemoryBudget& budget, Reporter& report) {
  const FitOptions options = fit_options(job, job.estimate_radius_spacings);
  for_each_leaf(job, "normals", Look::kPositions, budget, report, [&](std::uint32_t chunk, Neighbourhood& around) {
    const ChunkEntry& e = job.entries[chunk];
    std::vector<SurfelBlock> blocks = read_blocks(job.geometry, e);
    if (!any_surfel(blocks, e.count, [&](const SurfelBlock& b, std::size_t lane) { return is_estimated(b, lane); })) return;
    std::vector<NormalFit> fits;
    fit_normals_of(around, options, fits);
    for (std::uint32_t i = 0; i < fits.size(); ++i) {
      const auto code = encode_normal(fits[i].normal);
      const auto flags = static_cast<std::uint8_t>(SurfelBlock::kEstimated | (fits[i].isolated ? SurfelBlock::kIsolated : 0) | (fits[i].rough ? kPending : 0));
      for (std::uint32_t slot = around.own().first_slot[i]; slot < around.own().first_slot[i + 1]; ++slot) {
        SurfelBlock& b = blocks[slot / 16];
        if (!is_estimated(b, slot % 16)) continue;
        b.normal_u[slot % 16] = code[0];
        b.normal_v[slot % 16] = code[1];
        b.flags[slot % 16] = flags;
      }
    }
    job.geometry.write_at(e.offset, blocks.data(), geometry_bytes(e.count));
  });
}

void refine_normals(const FitJob& job, MemoryBudget& budget, Reporter& report) {
  const FitOptions options = fit_options(job, job.estimate_radius_spacings);
  for_each_leaf(job, "normals near edges", Look::kFirstNormals, budget, report, [&](std::uint32_t chunk, Neighbourhood& around) {
    const ChunkEntry& e = job.entries[chunk];
    std::vector<SurfelBlock> blocks = read_blocks(job.geometry, e);
    if (!any_surfel(blocks, e.count, [&](const SurfelBlock& b, std::size_t lane) { return is_pending(b, lane); })) return;
    const HaloChunk& own = around.own();
    const auto pending = [&](std::uint32_t slot) { return is_pending(blocks[slot / 16], slot % 16); };
    std::vector<std::uint8_t> wanted(own.size, 0);
    for (std::uint32_t i = 0; i < own.size; ++i)
      for (std::uint32_t slot = own.first_slot[i]; slot < own.first_slot[i + 1]; ++slot) wanted[i] = static_cast<std::uint8_t>(wanted[i] | pending(slot));
    std::vector<Vec3f> normals;
    refine_normals_of(around, options, wanted, normals);
    for (std::uint32_t i = 0; i < own.size; ++i)
      for (std::uint32_t slot = own.first_slot[i]; slot < own.first_slot[i + 1]; ++slot)
        if (pending(slot)) put_pending(blocks[slot / 16], slot % 16, normals[i]);
    job.geometry.write_at(e.offset, blocks.data(), geometry_bytes(e.count));
  });
}

void fit_radii(const FitJob& job, MemoryBudget& budget, Reporter& report) {
  const FitOptions options = fit_options(job, kRadiusSpacings);
  for_each_leaf(job, "radii", Look::kSettledNormals, budget, report, [&](std::uint32_t chunk, Neighbourhood& around) {
    std::vector<SurfelBlock> blocks = read_as(job, job.entries[chunk], Look::kSettledNormals);
    ChunkEntry& e = job.entries[chunk];
    const HaloChunk& own = around.own();
    std::vector<RadiusFit> fits;
    fit_radii_of(around, options, fits);
    double sum = 0;
    e.radius_max = 0;
    for (const RadiusFit& fit : fits) {
      sum += static_cast<double>(fit.mean_of_nearest);
      e.radius_max = std::max(e.radius_max, fit.radius);
    }
    e.spacing = static_cast<float>(sum / own.size);
    if (!(e.radius_max > 0)) e.radius_max = options.lone_radius;
    const RadiusTable radii(e.radius_max);
    for (std::uint32_t i = 0; i < own.size; ++i) {
      const std::uint8_t code = radii.encode(fits[i].radius);
      for (std::uint32_t slot = own.first_slot[i]; slot < own.first_slot[i + 1]; ++slot) {
        SurfelBlock& b = blocks[slot / 16];
        b.log_radius[slot % 16] = code;
        const bool whole = fits[i].clip_across.isZero();
        put_clip(b, slot % 16, whole ? std::uint16_t{0} : encode_clip(b.normal_u[slot % 16], b.normal_v[slot % 16], fits[i].clip_across, fits[i].clip_distance, fits[i].radius));
        if (fits[i].outlier) b.flags[slot % 16] = static_cast<std::uint8_t>(b.flags[slot % 16] | SurfelBlock::kIsolated);
      }
    }
    job.geometry.write_at(e.offset, blocks.data(), geometry_bytes(e.count));
    e.geometry_crc = crc32c(blocks.data(), geometry_bytes(e.count));
  });
}

namespace {

// A surface turned at random meets 1.5 voxels for each square of their edge. The finest voxels that still hold four points on average tell its area.
double mean_spacing(const ChunkEntry& e, const std::vector<SurfelBlock>& blocks, double step) {
  std::array<std::uint64_t, 17> first_differs{};  // neighbours that part at this depth
  for (std::uint32_t i = 1; i < e.count; ++i) {
    const SurfelBlock &a = blocks[(i - 1) / 16], &b = blocks[i / 16];
    const std::size_t k = (i - 1) % 16, l = i % 16;
    const auto differ = static_cast<std::uint32_t>((a.x[k] ^ b.x[l]) | (a.y[k] ^ b.y[l]) | (a.z[k] ^ b.z[l]));
    if (differ != 0) ++first_differs[static_cast<std::size_t>(17 - std::bit_width(differ))];
  }
  std::uint64_t voxels = 1;
  int bits = 0;
  while (bits < kLocalBits && 4 * (voxels + first_differs[static_cast<std::size_t>(bits + 1)]) <= e.count) voxels += first_differs[static_cast<std::size_t>(++bits)];
  return std::ldexp(step, kLocalBits - bits) * std::sqrt(static_cast<double>(voxels) / (1.5 * e.count));
}

}  // namespace

void guess_surfels(ChunkEntry& e, std::vector<SurfelBlock>& blocks, double step) {
  e.spacing = static_cast<float>(mean_spacing(e, blocks, step));
  e.radius_max = 1.5f * e.spacing;
  for (std::size_t k = 0; k < blocks.size(); ++k) {
    SurfelBlock& b = blocks[k];
    const std::size_t count = std::min<std::size_t>(16, e.count - 16 * k);
    const auto code = encode_normal(plane_normal(b, count));
    for (std::size_t lane = 0; lane < count; ++lane) {
      b.log_radius[lane] = 255;
      if (!(b.flags[lane] & SurfelBlock::kEstimated)) continue;
      b.normal_u[lane] = code[0];
      b.normal_v[lane] = code[1];
      b.flags[lane] = SurfelBlock::kEstimated | SurfelBlock::kIsolated;
    }
  }
  e.geometry_crc = crc32c(blocks.data(), geometry_bytes(e.count));
}

}  // namespace chiaro::stream
