#include "blend/blend.h"

#include <algorithm>
#include <atomic>
#include <cmath>
#include <cstring>
#include <functional>
#include <stdexcept>

#include "blend/accumulate.h"
#include "blend/photo_window.h"
#include "blend/sample.h"
#include "stream/base/error.h"
#include "stream/base/file.h"
#include "stream/base/hash.h"
#include "stream/base/parallel.h"
#include "stream/store/layer.h"

namespace chiaro::blend {
namespace {

constexpr int kLeastWindowRows = 16;

/// Content of a raster by its size and its ends: the checksums of all planes stand at the end of the file.
void add_raster(Hasher& hash, const std::filesystem::path& path) {
  constexpr std::uint64_t kHead = 8192, kTail = 65536;
  const File file(path, File::Mode::kRead);
  const std::uint64_t size = file.size();
  std::vector<std::byte> bytes(std::min(size, kHead));
  file.read_at(0, bytes.data(), bytes.size());
  hash.add(size).add_bytes(bytes.data(), bytes.size());
  bytes.resize(std::min(size, kTail));
  file.read_at(size - bytes.size(), bytes.data(), bytes.size());
  hash.add_bytes(bytes.data(), bytes.size());
}

/// Everything that the accumulators depend on.
std::string accumulator_key(const stream::Store& store, const std::vector<const BlendPhotograph*>& photographs, const BlendOptions& options) {
  Hasher hash;
  hash.add("blend accumulators 3").add(store.manifest().key).add(std::uint64_t{store.chunks().size()});
  hash.add(options.low_band_px).add(options.border_px).add(options.high_band_power);
  for (const BlendPhotograph* p : photographs) {
    const stream::Lens& lens = p->camera.lens;
    hash.add(p->name).add(static_cast<std::uint64_t>(lens.kind));
    for (const double v : {lens.fx, lens.fy, lens.cx, lens.cy, lens.skew}) hash.add(v);
    for (const double v : lens.k) hash.add(v);
    for (const double v : lens.p) hash.add(v);
    for (int i = 0; i < 9; ++i) hash.add(p->camera.pose.rotation_camera_from_world(i / 3, i % 3));
    for (int i = 0; i < 3; ++i) hash.add(p->camera.pose.translation_camera_from_world[i]);
    add_raster(hash, p->gbuffer);
    add_raster(hash, p->albedo);
    add_raster(hash, p->radiance);
  }
  return hash.hex();
}

/// The order in which photographs are added: by name, so that the caller's order has no influence on the bits.
std::vector<const BlendPhotograph*> in_order_of_names(std::span<const BlendPhotograph> photographs) {
  std::vector<const BlendPhotograph*> sorted;
  for (const BlendPhotograph& p : photographs) sorted.push_back(&p);
  std::sort(sorted.begin(), sorted.end(), [](const BlendPhotograph* a, const BlendPhotograph* b) {
    return a->name != b->name ? a->name < b->name : a->albedo < b->albedo;
  });
  return sorted;
}

float median_footprint(const std::vector<const BlendPhotograph*>& photographs, Reporter& report) {
  FootprintHistogram all;
  for (const BlendPhotograph* p : photographs) {
    report.check();
    all.merge(footprints(PhotographRasters(p->camera.lens, p->gbuffer, p->albedo, p->radiance)));
  }
  return all.median();
}

/// What a task holds while it works on a leaf: geometry, sums, readings.
std::uint64_t leaf_bytes(std::uint32_t surfels, std::size_t num_photographs) {
  return stream::geometry_bytes(surfels) + surfels * (sizeof(Accumulator) + sizeof(Sample)) + num_photographs * sizeof(std::uint32_t);
}

class Blender {
 public:
  Blender(const stream::Store& store, std::span<const BlendPhotograph> photographs, const BlendOptions& options, const std::filesystem::path& scratch,
          MemoryBudget& budget, Reporter& report)
      : store_(store), options_(options), budget_(budget), report_(report), photographs_(in_order_of_names(photographs)),
        sums_(scratch / "blend.sums", accumulator_key(store, photographs_, options), leaf_counts(store), static_cast<std::uint32_t>(photographs_.size())) {
    for (const std::uint32_t leaf : store.leaves()) largest_leaf_ = std::max(largest_leaf_, store.chunks()[leaf].count);
  }

  void add_photographs() {
    const float footprint = photographs_.empty() ? 0 : median_footprint(photographs_, report_);
    window_options_ = {.low_radius = static_cast<float>(options_.low_band_px) * footprint,
                       .reference_footprint = footprint,
                       .border_px = static_cast<float>(options_.border_px)};
    report_.begin("blend", photographs_.size(), "photographs");
    for (std::uint32_t k = sums_.photographs_done(); k < photographs_.size(); ++k) {
      report_.check();
      report_.progress(k);
      add_photograph(k);
      sums_.set_photographs_done(k + 1);
    }
    report_.end();
  }

  BlendStats write_layer() {
    BlendStats stats;
    stats.samples_per_photograph.resize(photographs_.size());
    stream::LayerWriter writer(store_, options_.layer, stream::albedo_fields(), options_.provenance_json);
    const auto& leaves = store_.leaves();
    const std::size_t batch = tasks_at_once(leaves.size());
    const BudgetLease lease(budget_, batch * leaf_bytes(largest_leaf_, photographs_.size()), "blended leaves");
    std::vector<BlendStats> partial(leaves.size());
    run_tasks(leaves.size(), batch, [&](std::size_t i) { partial[i] = write_leaf(writer, i); });
    for (const BlendStats& p : partial) {
      stats.points += p.points;
      stats.points_seen += p.points_seen;
      for (std::size_t k = 0; k < p.samples_per_photograph.size(); ++k) stats.samples_per_photograph[k] += p.samples_per_photograph[k];
    }
    for (const std::uint64_t n : stats.samples_per_photograph) stats.samples += n;
    stats.samples_per_photograph = in_callers_order(stats.samples_per_photograph);
    stats.chunks_visited = chunks_visited_;
    writer.finish_inner(report_);
    writer.commit();
    return stats;
  }

  void set_callers_order(std::span<const BlendPhotograph> photographs) {
    for (const BlendPhotograph* p : photographs_) callers_index_.push_back(static_cast<std::size_t>(p - photographs.data()));
  }

 private:
  static std::vector<std::uint32_t> leaf_counts(const stream::Store& store) {
    std::vector<std::uint32_t> counts;
    for (const std::uint32_t leaf : store.leaves()) counts.push_back(store.chunks()[leaf].count);
    return counts;
  }

  std::vector<std::uint64_t> in_callers_order(const std::vector<std::uint64_t>& by_name) const {
    std::vector<std::uint64_t> result(by_name.size());
    for (std::size_t i = 0; i < by_name.size(); ++i) result[callers_index_[i]] = by_name[i];
    return result;
  }

  /// Leaves in memory at a time: one a thread, fewer where the budget says so, at least one.
  std::size_t tasks_at_once(std::size_t count) const {
    const std::uint64_t fit = budget_.free_bytes() / 2 / std::max<std::uint64_t>(1, leaf_bytes(largest_leaf_, photographs_.size()));
    return static_cast<std::size_t>(std::clamp<std::uint64_t>(fit, 1, std::min<std::uint64_t>(std::max<std::size_t>(count, 1), static_cast<std::uint64_t>(ThreadLimit::current()))));
  }

  /// Runs task(0..count-1), at most `at_once` at the same time.
  void run_tasks(std::size_t count, std::size_t at_once, const std::function<void(std::size_t)>& task) {
    std::atomic<std::size_t> next{0};
    parallel_blocks(at_once, 1, [&](std::size_t, std::size_t) {
      for (std::size_t i = next++; i < count; i = next++) {
        report_.check();
        task(i);
      }
    });
  }

  std::vector<RowSpan> leaf_rows(const stream::Camera& camera) const {
    const auto& leaves = store_.leaves();
    std::vector<RowSpan> rows(leaves.size());
    parallel_blocks(leaves.size(), 256, [&](std::size_t begin, std::size_t end) {
      for (std::size_t i = begin; i < end; ++i) rows[i] = rows_of_box(camera, store_.bounds(leaves[i]));
    });
    return rows;
  }

  /// Rows of a band so that the window with its halo takes at most two thirds of what is left.
  int band_rows(int width, int height, int halo) const {
    const std::uint64_t row_bytes = static_cast<std::uint64_t>(width) * window_bytes_per_pixel();
    const auto fit = static_cast<std::int64_t>(budget_.free_bytes() / 3 * 2 / row_bytes) - 2 * (halo + 1);
    return static_cast<int>(std::clamp<std::int64_t>(fit, std::min(kLeastWindowRows, height), height));
  }

  void add_photograph(std::uint32_t k) {
    const BlendPhotograph& photograph = *photographs_[k];
    const PhotographRasters rasters(photograph.camera.lens, photograph.gbuffer, photograph.albedo, photograph.radiance);
    const std::vector<RowSpan> rows = leaf_rows(photograph.camera);
    const int halo = halo_rows(window_options_, footprints(rasters).smallest());
    const int band = band_rows(rasters.width(), rasters.height(), halo);
    for (int y0 = 0; y0 < rasters.height(); y0 += band) {
      const int y1 = std::min(rasters.height(), y0 + band);
      std::vector<std::size_t> visited;
      for (std::size_t i = 0; i < rows.size(); ++i)
        if (rows[i].overlaps(y0, y1) && sums_.mark(i) < Mark{k, static_cast<std::uint32_t>(y1)}) visited.push_back(i);
      if (visited.empty()) continue;
      const int held = std::min(rasters.height(), y1 + 1 + halo) - std::max(0, y0 - 1 - halo);
      BudgetLease window_lease(budget_, static_cast<std::uint64_t>(held) * static_cast<std::uint64_t>(rasters.width()) * window_bytes_per_pixel(),
                               concat("rows of photograph ", photograph.name));
      const PhotoWindow window = load_window(rasters, photograph.camera, y0, y1, halo, window_options_);
      const std::size_t at_once = tasks_at_once(visited.size());
      const BudgetLease leaf_lease(budget_, at_once * leaf_bytes(largest_leaf_, photographs_.size()), "leaves of the blend");
      run_tasks(visited.size(), at_once, [&](std::size_t i) { add_to_leaf(visited[i], k, photograph.camera, window, y0, y1); });
      chunks_visited_ += visited.size();
    }
  }

  /// Rows that an interrupted run has added already are left out.
  void add_to_leaf(std::size_t leaf, std::uint32_t k, const stream::Camera& camera, const PhotoWindow& window, int y0, int y1) {
    const Mark mark = sums_.mark(leaf);
    if (mark.photograph == k) y0 = std::max(y0, static_cast<int>(mark.row));
    const std::vector<Sample> samples = sample_chunk(store_.read_chunk(store_.leaves()[leaf]), camera, window, y0, y1);
    if (samples.empty()) return;
    AccumulatorFile::Record record = sums_.read(leaf);
    for (const Sample& s : samples) add_sample(record.surfels[s.slot], s, static_cast<float>(options_.high_band_power));
    record.samples_of_photograph[k] += static_cast<std::uint32_t>(samples.size());
    sums_.write(leaf, {k, static_cast<std::uint32_t>(y1)}, record);
  }

  BlendStats write_leaf(stream::LayerWriter& writer, std::size_t leaf) const {
    const AccumulatorFile::Record record = sums_.read(leaf);
    const std::size_t n = record.surfels.size();
    std::vector<std::byte> planar(n * (4 * sizeof(float) + sizeof(std::uint16_t)));
    std::byte* albedo = planar.data();
    std::byte* sigma = albedo + n * 3 * sizeof(float);
    std::byte* photos = sigma + n * sizeof(float);
    BlendStats stats;
    stats.points = n;
    for (std::size_t i = 0; i < n; ++i) {
      const BlendedSurfel s = resolve(record.surfels[i], static_cast<float>(options_.shared_sigma));
      for (std::size_t c = 0; c < 3; ++c) std::memcpy(albedo + (c * n + i) * sizeof(float), s.albedo.data() + c, sizeof(float));
      std::memcpy(sigma + i * sizeof(float), &s.sigma, sizeof(float));
      std::memcpy(photos + i * sizeof(std::uint16_t), &s.photographs, sizeof(std::uint16_t));
      stats.points_seen += s.photographs > 0;
    }
    if (sums_.is_written(leaf)) stats.samples_per_photograph.assign(record.samples_of_photograph.begin(), record.samples_of_photograph.end());
    writer.write_chunk(store_.leaves()[leaf], planar);
    return stats;
  }

  const stream::Store& store_;
  const BlendOptions& options_;
  MemoryBudget& budget_;
  Reporter& report_;
  std::vector<const BlendPhotograph*> photographs_;
  std::vector<std::size_t> callers_index_;
  AccumulatorFile sums_;
  WindowOptions window_options_;
  std::uint32_t largest_leaf_ = 0;
  std::uint64_t chunks_visited_ = 0;
};

}  // namespace

void BlendOptions::validate() const {
  if (layer.empty()) throw std::invalid_argument("BlendOptions: layer has no name");
  if (!(low_band_px >= 1 && low_band_px <= kMaxLowRadiusPx)) throw std::invalid_argument("BlendOptions: low_band_px must be in 1 .. 64");
  if (!(border_px >= 1 && border_px <= 64)) throw std::invalid_argument("BlendOptions: border_px must be in 1 .. 64");
  if (!(high_band_power >= 1 && high_band_power <= 8)) throw std::invalid_argument("BlendOptions: high_band_power must be in 1 .. 8");
  if (!(shared_sigma >= 0)) throw std::invalid_argument("BlendOptions: shared_sigma must not be negative");
}

BlendStats blend(const stream::Store& store, std::span<const BlendPhotograph> photographs, const BlendOptions& options,
                 const std::filesystem::path& scratch, MemoryBudget& budget, Reporter& report) {
  options.validate();
  make_folder(scratch);
  BlendStats stats;
  {
    Blender blender(store, photographs, options, scratch, budget, report);
    blender.set_callers_order(photographs);
    blender.add_photographs();
    stats = blender.write_layer();
  }
  std::error_code ignored;   // the layer is published: a scratch file that stays only costs disk
  std::filesystem::remove(scratch / "blend.sums", ignored);
  return stats;
}

}  // namespace chiaro::blend
