#include "blend/blend.h"

#include <algorithm>
#include <cmath>
#include <cstring>
#include <mutex>
#include <optional>
#include <stdexcept>

#include "blend/accumulate.h"
#include "blend/agreement.h"
#include "blend/ballot.h"
#include "blend/leaf_file.h"
#include "blend/photo_walk.h"
#include "blend/sample.h"
#include "stream/base/error.h"
#include "stream/base/file.h"
#include "stream/base/hash.h"
#include "stream/store/layer.h"

namespace chiaro::blend {
namespace {

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
  hash.add("blend accumulators 5").add(store.manifest().key).add(std::uint64_t{store.chunks().size()});
  hash.add(options.low_band_px).add(options.border_px).add(options.high_band_power);
  hash.add(std::uint64_t{options.reject}).add(static_cast<std::uint64_t>(options.gain)).add(std::uint64_t{options.align});
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

/// What lengths and colours are measured against, of all photographs together.
struct Scale {
  float footprint = 0, brightness = 0;
};
Scale scale_of(const std::vector<const BlendPhotograph*>& photographs, Reporter& report) {
  OctaveHistogram footprint, brightness;
  for (const BlendPhotograph* p : photographs) {
    report.check();
    const PhotographRasters rasters(p->camera.lens, p->gbuffer, p->albedo, p->radiance);
    footprint.merge(footprints(rasters));
    brightness.merge(brightnesses(rasters));
  }
  return {footprint.median(), brightness.median()};
}

constexpr int kLeastMargin = 1;   // for interpolation

class Blender {
 public:
  Blender(const stream::Store& store, std::span<const BlendPhotograph> photographs, const BlendOptions& options, const std::filesystem::path& scratch,
          MemoryBudget& budget, Reporter& report)
      : store_(store), options_(options), scratch_(scratch), budget_(budget), report_(report), photographs_(in_order_of_names(photographs)),
        scale_(scale_of(photographs_, report)), key_(accumulator_key(store, photographs_, options)),
        walk_(store, photographs_,
              {.low_radius = static_cast<float>(options.low_band_px) * scale_.footprint, .reference_footprint = scale_.footprint, .border_px = static_cast<float>(options.border_px)},
              budget, report) {
    for (const BlendPhotograph* p : photographs_) callers_index_.push_back(static_cast<std::size_t>(p - photographs.data()));
  }

  BlendStats run() {
    collect_votes();
    compare_photographs();
    inspect_photographs();
    sums_.emplace(scratch_ / kSumsFile, key_, shape(2 * num_photographs(), sizeof(Accumulator)));
    walk_.into(*sums_, "blend", shift_margin(), sizeof(Accumulator) + sizeof(Ballot), [&](const PhotoWalk::Visit& v) { add_to_leaf(v); });
    return write_layer();
  }

  static constexpr const char *kVotesFile = "blend.votes", *kSumsFile = "blend.sums";

 private:
  std::uint32_t num_photographs() const { return static_cast<std::uint32_t>(photographs_.size()); }

  LeafShape shape(std::uint32_t counters, std::uint32_t record_bytes) const {
    LeafShape s{{}, num_photographs(), counters, record_bytes};
    for (const std::uint32_t leaf : store_.leaves()) s.surfels_of_leaf.push_back(store_.chunks()[leaf].count);
    return s;
  }

  std::vector<Sample> samples_of(const PhotoWalk::Visit& v, const Vec2f& shift_px) const {
    return sample_chunk(store_.read_chunk(store_.leaves()[v.leaf]), photographs_[v.photograph]->camera, shift_px, *v.window, v.y0, v.y1);
  }

  /// First look: what the photographs say of each surfel. One photograph has nobody to disagree with.
  void collect_votes() {
    if (num_photographs() < 2 || (!options_.reject && options_.gain == Gain::kNone) || !(scale_.brightness > 0)) return;
    votes_.emplace(scratch_ / kVotesFile, key_, shape(0, sizeof(Ballot)));
    walk_.into(*votes_, "blend: compare photographs", kLeastMargin, sizeof(Ballot), [&](const PhotoWalk::Visit& v) {
      const std::vector<Sample> samples = samples_of(v, Vec2f::Zero());
      if (samples.empty()) return;
      auto record = votes_->read<Ballot>(v.leaf);
      for (const Sample& s : samples) cast_vote(record.surfels[s.slot], static_cast<std::uint16_t>(v.photograph), s, scale_.brightness);
      votes_->write(v.leaf, {v.photograph, static_cast<std::uint32_t>(v.y1)}, record);
    });
  }

  /// From every n-th surfel, so that memory does not grow with the model.
  void compare_photographs() {
    agreement_.log_gain.assign(num_photographs(), Vec3f::Zero());
    if (!votes_) return;
    constexpr std::uint64_t kMostSurfels = 1 << 15;
    std::uint64_t total = 0, index = 0;
    for (const std::uint32_t leaf : store_.leaves()) total += store_.chunks()[leaf].count;
    const std::uint64_t step = (total + kMostSurfels - 1) / kMostSurfels;
    std::vector<ReadingPair> pairs;
    for (std::size_t leaf = 0; leaf < votes_->num_leaves(); ++leaf) {
      report_.check();
      const std::uint32_t count = store_.chunks()[store_.leaves()[leaf]].count;
      if (votes_->is_written(leaf)) {
        const auto record = votes_->read<Ballot>(leaf);
        for (std::uint64_t slot = (step - index % step) % step; slot < count; slot += step) append_pairs(record.surfels[slot], pairs);
      }
      index += count;
    }
    agreement_ = find_agreement(pairs, num_photographs(), options_.gain);
    tolerance_ = tolerance_for(agreement_.scatter);
  }

  /// Second look: where each photograph lies on the surface, and what in it disagrees.
  void inspect_photographs() {
    inspections_.resize(num_photographs());
    alignments_.resize(num_photographs());
    if (!votes_ || num_photographs() < 3) return;
    report_.begin("blend: inspect photographs", num_photographs(), "photographs");
    for (std::uint32_t k = 0; k < num_photographs(); ++k) {
      report_.progress(k);
      inspections_[k] = inspect(k, Vec2f::Zero());
      if (!options_.align) continue;
      // A photograph that is read in the wrong place is judged and correlated wrongly too: once more from where it seems to be.
      constexpr int kMostRounds = 3;
      alignments_[k] = alignment_for(inspections_[k]);
      for (int round = 0; round < kMostRounds && alignments_[k].shift_px != Vec2f::Zero(); ++round) {
        const Vec2f before = alignments_[k].shift_px;
        const Inspection again = inspect(k, before);
        if (!again.shift_px) break;
        inspections_[k] = again;
        alignments_[k] = alignment_for(again);
        if ((alignments_[k].shift_px - before).norm() < 0.05f) break;
      }
    }
    report_.end();
  }

  /// shift_px: where the photograph is read; the result's shift is the whole one.
  Inspection inspect(std::uint32_t k, const Vec2f& shift_px) {
    const stream::Lens& lens = photographs_[k]->camera.lens;
    InspectionCounts counts(lens.width_px, lens.height_px);
    std::mutex mutex;
    const int margin = kInspectMargin + static_cast<int>(std::ceil(std::abs(shift_px.y())));
    walk_.look(k, margin, sizeof(Ballot), [&](const PhotoWalk::Visit& v) {
      InspectionCounts own(lens.width_px, lens.height_px);
      inspect_leaf(v, shift_px, own);
      const std::lock_guard lock(mutex);   // whole numbers: the order does not matter
      counts.merge(own);
    });
    Inspection result = conclude(counts);
    if (result.shift_px) *result.shift_px += shift_px;
    return result;
  }

  void inspect_leaf(const PhotoWalk::Visit& v, const Vec2f& shift_px, InspectionCounts& counts) const {
    constexpr std::uint64_t kMostSurfels = 1 << 17;
    if (!votes_->is_written(v.leaf)) return;
    const std::uint32_t step = 1 + static_cast<std::uint32_t>(v.surfels_in_view / kMostSurfels);
    const stream::Chunk chunk = store_.read_chunk(store_.leaves()[v.leaf]);
    const auto ballots = votes_->read<Ballot>(v.leaf);
    const stream::Camera& camera = photographs_[v.photograph]->camera;
    const Vec3f gain = agreement_.log_gain[v.photograph].array().exp();
    for (std::uint32_t slot = static_cast<std::uint32_t>(v.leaf) % step; slot < chunk.count; slot += step) {
      const auto majority = majority_of(ballots.surfels[slot], agreement_.log_gain, tolerance_);
      if (!majority) continue;
      const stream::Surfel surfel = chunk.surfel(slot);
      const auto pixel = project_surfel(camera, surfel);
      if (!pixel || pixel->y() < v.y0 || pixel->y() >= v.y1) continue;
      if (const auto sample = read_surfel(camera, surfel, *pixel, shift_px, *v.window))
        inspect_reading(ballots.surfels[slot], *majority, static_cast<std::uint16_t>(v.photograph), log_value(sample->low.cwiseProduct(gain), scale_.brightness), tolerance_,
                        *pixel + shift_px.cast<double>(), *v.window, counts);
    }
  }

  /// Rows of a window beside those of the surfels, so that shifted readings find their pixels.
  int shift_margin() const {
    float largest = 0;
    for (const Alignment& a : alignments_) largest = std::max(largest, std::abs(a.shift_px.y()));
    return kLeastMargin + static_cast<int>(std::ceil(largest));
  }

  void add_to_leaf(const PhotoWalk::Visit& v) {
    std::vector<Sample> samples = samples_of(v, alignments_[v.photograph].shift_px);
    if (samples.empty()) return;
    auto record = sums_->read<Accumulator>(v.leaf);
    const auto ballots = votes_ ? votes_->read<Ballot>(v.leaf) : LeafRecord<Ballot>{};
    const Vec3f log_gain = agreement_.log_gain[v.photograph], gain = log_gain.array().exp();
    for (Sample& s : samples) {
      s.low = s.low.cwiseProduct(gain);
      s.high = s.high.cwiseProduct(gain);
      float share = 1, trust = alignments_[v.photograph].trust;
      if (votes_ && options_.reject)
        if (const auto majority = majority_of(ballots.surfels[s.slot], agreement_.log_gain, tolerance_))
          share = agreement_weight(*majority, log_value(s.low, scale_.brightness), tolerance_);
      Accumulator& sum = record.surfels[s.slot];
      if (share < 0.5f) {
        ++sum.rejected;
        ++record.counters[num_photographs() + v.photograph];
      }
      if (!(share > 0)) continue;
      s.weight *= share * trust;
      add_sample(sum, s, static_cast<float>(options_.high_band_power));
      ++record.counters[v.photograph];
    }
    sums_->write(v.leaf, {v.photograph, static_cast<std::uint32_t>(v.y1)}, record);
  }

  BlendStats write_layer() {
    BlendStats stats;
    stream::LayerWriter writer(store_, options_.layer, stream::albedo_fields(), options_.provenance_json);
    std::vector<LeafStats> leaves(store_.leaves().size());
    walk_.for_leaves(leaves.size(), sizeof(Accumulator), [&](std::size_t i) { leaves[i] = write_leaf(writer, i); });
    stats.photographs.resize(photographs_.size());
    for (std::size_t leaf = 0; leaf < leaves.size(); ++leaf) {
      stats.points += leaves[leaf].points;
      stats.points_seen += leaves[leaf].points_seen;
      stats.points_disputed += leaves[leaf].points_disputed;
      for (std::size_t k = 0; k < leaves[leaf].counters.size(); ++k) {
        PhotographStats& p = stats.photographs[callers_index_[k % photographs_.size()]];
        (k < photographs_.size() ? p.samples : p.rejected) += leaves[leaf].counters[k];
      }
    }
    for (std::size_t k = 0; k < photographs_.size(); ++k)
      for (int c = 0; c < 3; ++c) stats.photographs[callers_index_[k]].gain[static_cast<std::size_t>(c)] = std::exp(static_cast<double>(agreement_.log_gain[k][c]));
    for (std::size_t k = 0; k < photographs_.size(); ++k) {
      stats.photographs[callers_index_[k]].inspection = inspections_[k];
      stats.photographs[callers_index_[k]].alignment = alignments_[k];
    }
    for (const PhotographStats& p : stats.photographs) stats.samples += p.samples;
    stats.scatter = static_cast<double>(agreement_.scatter);
    stats.chunks_visited = walk_.chunks_visited();
    writer.finish_inner(report_);
    writer.commit();
    return stats;
  }

  struct LeafStats {
    std::uint64_t points = 0, points_seen = 0, points_disputed = 0;
    std::vector<std::uint32_t> counters;
  };
  LeafStats write_leaf(stream::LayerWriter& writer, std::size_t leaf) const {
    const auto record = sums_->read<Accumulator>(leaf);
    const std::size_t n = record.surfels.size();
    std::vector<std::byte> planar(n * (4 * sizeof(float) + sizeof(std::uint16_t)));
    std::byte* albedo = planar.data();
    std::byte* sigma = albedo + n * 3 * sizeof(float);
    std::byte* photos = sigma + n * sizeof(float);
    LeafStats stats{n, 0, 0, record.counters};
    for (std::size_t i = 0; i < n; ++i) {
      const BlendedSurfel s = resolve(record.surfels[i], static_cast<float>(options_.shared_sigma));
      for (std::size_t c = 0; c < 3; ++c) std::memcpy(albedo + (c * n + i) * sizeof(float), s.albedo.data() + c, sizeof(float));
      std::memcpy(sigma + i * sizeof(float), &s.sigma, sizeof(float));
      std::memcpy(photos + i * sizeof(std::uint16_t), &s.photographs, sizeof(std::uint16_t));
      stats.points_seen += s.photographs > 0;
      stats.points_disputed += record.surfels[i].rejected > 0;
    }
    writer.write_chunk(store_.leaves()[leaf], planar);
    return stats;
  }

  const stream::Store& store_;
  const BlendOptions& options_;
  const std::filesystem::path scratch_;
  MemoryBudget& budget_;
  Reporter& report_;
  std::vector<const BlendPhotograph*> photographs_;
  std::vector<std::size_t> callers_index_;
  Scale scale_;
  std::string key_;
  PhotoWalk walk_;
  std::optional<LeafFile> votes_, sums_;
  Agreement agreement_;
  float tolerance_ = 0;
  std::vector<Inspection> inspections_;
  std::vector<Alignment> alignments_;
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
  const BlendStats stats = Blender(store, photographs, options, scratch, budget, report).run();
  for (const char* file : {Blender::kVotesFile, Blender::kSumsFile}) {
    std::error_code ignored;   // the layer is published: a scratch file that stays only costs disk
    std::filesystem::remove(scratch / file, ignored);
  }
  return stats;
}

}  // namespace chiaro::blend
