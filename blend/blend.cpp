#include "blend/blend.h"

#include <algorithm>
#include <atomic>
#include <cmath>
#include <cstring>
#include <numeric>
#include <optional>
#include <stdexcept>
#include <tuple>

#include "blend/accumulate.h"
#include "blend/agreement.h"
#include "blend/ballot.h"
#include "blend/denoise_leaf.h"
#include "blend/identity.h"
#include "blend/kept.h"
#include "blend/leaf_file.h"
#include "blend/photo_walk.h"
#include "blend/sample.h"
#include "blend/second_look.h"
#include "blend/write_leaf.h"
#include "stream/base/disk_space.h"
#include "stream/base/error.h"
#include "stream/base/file.h"
#include "stream/base/hash.h"
#include "stream/store/layer.h"

namespace chiaro::blend {
namespace {

constexpr int kLeastMargin = 1;   // for interpolation
constexpr std::size_t kMostPhotographs = 1u << 16;   // votes keep their numbers in 16 bits

class Blender {
 public:
  Blender(const stream::Store& store, std::span<const BlendPhotograph> photographs, const BlendOptions& options, const std::filesystem::path& scratch,
          MemoryBudget& budget, Reporter& report)
      : store_(store), options_(options), scratch_(scratch), budget_(budget), report_(report), photographs_(in_order_of_names(photographs)),
        scale_(scale_of(photographs_, report)),
        window_(window_options(options, scale_)),
        windows_(window_, budget), walk_(store, photographs_, windows_, budget, report), was_read_(photographs_.size()) {
    Hasher hash;
    hash.add(options_key(store, options));
    for (const BlendPhotograph* p : photographs_) {
      callers_index_.push_back(static_cast<std::size_t>(p - photographs.data()));
      photograph_keys_.push_back(photograph_key(*p));
      hash.add(photograph_keys_.back());
    }
    if (options.known) add_known(hash);
    key_ = hash.hex();
  }

  BlendStats run() {
    find_views();
    require_space();
    if (!options_.keep.empty() && has_votes()) open_kept();
    collect_votes();
    compare_photographs();
    find_changed_leaves();
    find_tolerance();
    inspect_photographs();
    sums_.emplace(scratch_ / kSumsFile, key_, shape_of_sums());
    take_over_sums();
    walk_.into(*sums_, "blend", shift_margin(), sum_bytes() + sizeof(Ballot), [&](const PhotoWalk::Visit& v) { add_to_leaf(v); }, first_sum_);
    const BlendStats stats = write_layer();
    if (!options_.keep.empty()) keep();
    return stats;
  }

  static constexpr const char *kVotesFile = "blend.votes", *kSumsFile = "blend.sums";

 private:
  std::uint32_t num_photographs() const { return static_cast<std::uint32_t>(photographs_.size()); }

  LeafShape shape(std::uint32_t counters, std::uint32_t record_bytes, std::uint32_t more = 0) const {
    LeafShape s{{}, num_photographs(), counters, record_bytes, more};
    for (const std::uint32_t leaf : store_.leaves()) s.surfels_of_leaf.push_back(store_.chunks()[leaf].count);
    return s;
  }

  void add_known(Hasher& hash) const {
    hash.add(options_.known->scatter);
    for (const float v : options_.known->tolerance.by_class) hash.add(static_cast<double>(v));
    for (const std::size_t i : callers_index_) {
      const Alignment& a = options_.known->alignment[i];
      for (const double gain : options_.known->gain[i]) hash.add(gain);
      for (const float v : {a.shift_px.x(), a.shift_px.y(), a.trust}) hash.add(static_cast<double>(v));
    }
  }

  std::uint32_t middle_bands() const { return static_cast<std::uint32_t>(options_.bands - 2); }
  LeafShape shape_of_votes() const { return shape(0, sizeof(Ballot)); }
  LeafShape shape_of_sums() const { return shape(2 * num_photographs(), sizeof(Accumulator), middle_bands()); }
  std::uint64_t sum_bytes() const { return sizeof(Accumulator) + middle_bands() * sizeof(MiddleSum); }

  /// One photograph has nobody to disagree with.
  bool has_votes() const { return num_photographs() >= 2 && (options_.reject || options_.gain != Gain::kNone) && scale_.brightness > 0; }

  /// Which leaves each photograph may see.
  void find_views() {
    views_.assign(num_photographs(), std::vector<bool>(store_.leaves().size()));
    in_view_.assign(store_.leaves().size(), false);
    for (std::uint32_t k = 0; k < num_photographs(); ++k) {
      const std::vector<RowSpan> rows = walk_.leaf_rows(photographs_[k]->camera);
      for (std::size_t i = 0; i < rows.size(); ++i)
        if (rows[i].overlaps(0, photographs_[k]->camera.lens.height_px)) views_[k][i] = in_view_[i] = true;
    }
  }

  /// A disk that is too small is met now and not hours later. Leaves that nobody sees take nothing.
  void require_space() {
    const LeafShape ballots = shape_of_votes(), sums = shape_of_sums();
    std::uint64_t ballot_bytes = 0, sums_bytes = 0;
    for (std::size_t i = 0; i < in_view_.size(); ++i) {
      if (!in_view_[i]) continue;
      sums_bytes += LeafFile::disk_bytes(sums, i);
      if (has_votes()) ballot_bytes += LeafFile::disk_bytes(ballots, i);
    }
    scratch_bytes_ = sums_bytes + ballot_bytes + std::max(LeafFile::spare_bytes(sums_bytes), LeafFile::spare_bytes(ballot_bytes));   // one after the other
    std::uint64_t layer_bytes = 0;
    for (const stream::ChunkEntry& c : store_.chunks()) layer_bytes += std::uint64_t{c.count} * kLayerBytes;
    const std::uint64_t there = allocated_bytes(scratch_ / kVotesFile) + allocated_bytes(scratch_ / kSumsFile);
    require_disk_space(scratch_, "blending", scratch_bytes_ + layer_bytes, options_.free_bytes(scratch_) + there);
  }

  void open_kept() {
    kept_ = KeptBlend::open(options_.keep, options_key(store_, options_), photograph_keys_, shape(0, 0).surfels_of_leaf, middle_bands());
    if (kept_ && (kept_->state().footprint != scale_.footprint || kept_->state().brightness != scale_.brightness)) {
      report_.note("blend: the median footprint or brightness of the photographs is not what it was: everything is added up anew");
      kept_.reset();
    }
  }

  /// First look: what the photographs say of each surfel. Those of a kept blend have spoken: they come first, and are heard again only where a ballot is open.
  void collect_votes() {
    if (!has_votes()) return;
    for (const bool known : {true, false})
      for (std::uint32_t k = 0; k < num_photographs(); ++k)
        if ((kept_ && kept_->photograph(k)) == known) {
          order_.push_back(k);
          num_known_ += known;
        }
    votes_key_ = Hasher().add(key_).add_bytes(order_.data(), order_.size() * sizeof(std::uint32_t)).hex();
    votes_.emplace(scratch_ / kVotesFile, votes_key_, shape_of_votes());
    std::vector<std::uint32_t> first;
    if (kept_) first = take_over_votes();
    std::vector<const BlendPhotograph*> ordered;
    for (const std::uint32_t k : order_) ordered.push_back(photographs_[k]);
    PhotoWalk walk(store_, std::move(ordered), windows_, budget_, report_);
    walk.into(*votes_, "blend: compare photographs", kLeastMargin, sizeof(Ballot), [&](const PhotoWalk::Visit& v) { vote_in_leaf(v); }, first);
    for (std::size_t i = 0; i < order_.size(); ++i) was_read_[order_[i]] = was_read_[order_[i]] || walk.photographs_read()[i];
    votes_visited_ = walk.chunks_visited();
  }

  void vote_in_leaf(const PhotoWalk::Visit& v) {
    std::vector<SurfelReader> readers;
    for (const PhotoWalk::View& view : v.views) readers.push_back(reader_of(view, photographs_[order_[view.photograph]]->camera, Vec2f::Zero()));
    auto record = votes_->read<Ballot>(v.leaf);
    bool any = false;
    std::vector<float> least;   // weights that count, by surfel
    for (const Ballot& ballot : record.surfels) least.push_back(least_weight(ballot));
    for_readings(
        store_.read_chunk(store_.leaves()[v.leaf]), readers,
        [&](std::uint32_t slot, std::size_t i, const Sample& sample) {
          cast_vote(record.surfels[slot], static_cast<std::uint16_t>(order_[v.views[i].photograph]), sample, scale_.brightness);
          least[slot] = least_weight(record.surfels[slot]);
          any = true;
        },
        [&](std::uint32_t slot, std::size_t, float weight) {
          any = true;   // it may be read, be it among the votes or not
          return weight >= least[slot];
        });
    if (any) votes_->write(v.leaf, v.reached(), record);
  }

  /// Returns from which photograph on each leaf is to be visited.
  std::vector<std::uint32_t> take_over_votes() {
    std::vector<std::uint32_t> first(votes_->num_leaves(), num_known_);
    walk_.for_leaves(first.size(), sizeof(Ballot), [&](std::size_t i) {
      const KeptBlend::Votes known = kept_->votes(i);
      if (!known.is_whole) first[i] = 0;
      else if (known.is_written && !votes_->is_written(i)) votes_->write(i, {num_known_, 0}, known.record);
    });
    return first;
  }

  /// Leaves whose votes, or factors of brightness, are not those of the kept blend.
  void find_changed_leaves() {
    changed_.assign(store_.leaves().size(), 1);
    if (!kept_ || kept_->state().tolerance.of_votes() != tolerance_.of_votes()) return;
    walk_.for_leaves(changed_.size(), 2 * sizeof(Ballot), [&](std::size_t i) {
      const KeptBlend::Votes known = kept_->votes(i);
      const auto now = votes_->read<Ballot>(i);
      changed_[i] = known.withdrawn || std::memcmp(known.record.surfels.data(), now.surfels.data(), now.surfels.size() * sizeof(Ballot)) != 0;
    });
    for (std::uint32_t k = 0; k < num_photographs(); ++k)
      if (const PhotographState* then = kept_->photograph(k); then && then->log_gain != agreement_.log_gain[k])
        for (std::size_t i = 0; i < changed_.size(); ++i) changed_[i] |= views_[k][i];
  }

  /// How far readings without a vote may lie from the majority, by a sample of photographs that one more or less hardly changes. Where each has a vote there are none.
  void find_tolerance() {
    constexpr std::size_t kMostInSample = 64;
    distances_.resize(num_photographs());
    if (!votes_ || options_.known || num_photographs() <= kVotes) return;
    std::vector<std::uint32_t> sample(num_photographs()), unknown;
    std::iota(sample.begin(), sample.end(), 0u);
    std::sort(sample.begin(), sample.end(), [&](std::uint32_t a, std::uint32_t b) { return std::tie(photograph_keys_[a], a) < std::tie(photograph_keys_[b], b); });
    sample.resize(std::min(sample.size(), kMostInSample));
    std::sort(sample.begin(), sample.end());
    for (const std::uint32_t k : sample) {
      if (const PhotographState* known = unchanged(k); known && known->distances.readings != ReadingDistances{}.readings) distances_[k] = known->distances;
      else unknown.push_back(k);
    }
    const std::vector<ReadingDistances> found = second_look().distances(unknown);
    for (std::size_t i = 0; i < found.size(); ++i) distances_[unknown[i]] = found[i];
    tolerance_ = tolerance_by_class(tolerance_.of_votes(), distances_);
    if (kept_ && kept_->state().tolerance != tolerance_) changed_.assign(changed_.size(), 1);
  }

  /// What was found of a photograph stands while all that it was compared with does.
  const PhotographState* unchanged(std::uint32_t k) const {
    if (!kept_ || !kept_->state().inspected || !kept_->photograph(k)) return nullptr;
    for (std::size_t i = 0; i < changed_.size(); ++i)
      if (changed_[i] && views_[k][i]) return nullptr;
    return kept_->photograph(k);
  }

  /// Sums of leaves in which nothing that they depend on has changed.
  void take_over_sums() {
    first_sum_.assign(store_.leaves().size(), 0);
    if (!kept_) return;
    std::vector<std::uint8_t> moved(changed_);
    for (std::uint32_t k = 0; k < num_photographs(); ++k) {
      const PhotographState* then = kept_->photograph(k);
      if (!then || (then->alignment.shift_px == alignments_[k].shift_px && then->alignment.trust == alignments_[k].trust)) continue;
      for (std::size_t i = 0; i < moved.size(); ++i) moved[i] |= views_[k][i];
    }
    std::atomic<std::uint64_t> kept{0};
    walk_.for_leaves(moved.size(), sum_bytes(), [&](std::size_t i) {
      if (moved[i] || votes_->mark(i) > Mark{num_known_, 0}) return;   // a new photograph has readings there, be they among the votes or not
      const KeptBlend::Sums known = kept_->sums(i);
      if (known.holds_removed) return;
      first_sum_[i] = num_photographs();
      kept += known.is_written;
      if (known.is_written && !sums_->is_written(i)) sums_->write(i, {num_photographs(), 0}, known.record);
    });
    leaves_kept_ = kept;
  }

  void keep() {
    make_folder(options_.keep);
    if (!votes_) return;   // one photograph alone: nothing to go on from
    BlendState state{options_key(store_, options_), votes_key_, key_, scale_.footprint, scale_.brightness, tolerance_, num_photographs() >= 3, {}};
    for (std::uint32_t k = 0; k < num_photographs(); ++k) state.photographs.push_back({photograph_keys_[k], agreement_.log_gain[k], distances_[k], inspections_[k], alignments_[k]});
    votes_.reset();
    sums_.reset();
    kept_.reset();
    KeptBlend::save(options_.keep, state, scratch_ / kVotesFile, scratch_ / kSumsFile);
  }

  /// From every n-th surfel, so that memory does not grow with the model.
  void compare_photographs() {
    agreement_.log_gain.assign(num_photographs(), Vec3f::Zero());
    if (options_.known) {
      for (std::uint32_t k = 0; k < num_photographs(); ++k)
        for (int c = 0; c < 3; ++c) agreement_.log_gain[k][c] = static_cast<float>(std::log(options_.known->gain[callers_index_[k]][static_cast<std::size_t>(c)]));
      agreement_.scatter = static_cast<float>(options_.known->scatter);
      tolerance_ = options_.known->tolerance;
    }
    if (!votes_ || options_.known) return;
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
    tolerance_.by_class.fill(tolerance_for(agreement_.scatter));
  }

  SecondLook second_look() { return {store_, photographs_, *votes_, walk_, agreement_, tolerance_, scale_.brightness, report_}; }

  /// Second look: where each photograph lies on the surface, and what in it disagrees.
  void inspect_photographs() {
    inspections_.resize(num_photographs());
    alignments_.resize(num_photographs());
    if (options_.known)
      for (std::uint32_t k = 0; k < num_photographs(); ++k) alignments_[k] = options_.known->alignment[callers_index_[k]];
    if (!votes_ || options_.known || num_photographs() < 3) return;
    report_.begin("blend: inspect photographs", num_photographs(), "photographs");
    std::vector<std::uint32_t> unknown;
    for (std::uint32_t k = 0; k < num_photographs(); ++k) {
      if (const PhotographState* known = unchanged(k)) {
        inspections_[k] = known->inspection;
        alignments_[k] = known->alignment;
      } else {
        unknown.push_back(k);
      }
    }
    const SecondLook look = second_look();
    constexpr std::size_t kAtOnce = 128;   // 40 KB of counts each: memory does not grow with the photographs
    for (std::size_t first = 0; first < unknown.size(); first += kAtOnce) {
      const std::span<const std::uint32_t> some = std::span(unknown).subspan(first, std::min(kAtOnce, unknown.size() - first));
      const std::vector<Inspection> found = look.inspect(some, Vec2f::Zero());
      for (std::size_t i = 0; i < some.size(); ++i) inspections_[some[i]] = found[i];
    }
    if (options_.align)
      for (const std::uint32_t k : unknown) alignments_[k] = look.align(k, inspections_[k]);
    report_.end();
  }

  /// Rows of a window beside those of the surfels, so that shifted readings find their pixels.
  int shift_margin() const {
    float largest = 0;
    for (const Alignment& a : alignments_) largest = std::max(largest, std::abs(a.shift_px.y()));
    return kLeastMargin + static_cast<int>(std::ceil(largest));
  }

  void add_to_leaf(const PhotoWalk::Visit& v) {
    std::vector<SurfelReader> readers;
    for (const PhotoWalk::View& view : v.views) readers.push_back(reader_of(view, photographs_[view.photograph]->camera, alignments_[view.photograph].shift_px));
    auto record = sums_->read<Accumulator>(v.leaf);
    const auto ballots = votes_ && options_.reject ? votes_->read<Ballot>(v.leaf) : LeafRecord<Ballot>{};
    std::array<std::optional<Majority>, kSurfelsTogether> majorities;   // of surfels that readings come from together
    std::array<float, kSurfelsTogether> least{};                        // weights of their votes
    std::array<std::uint32_t, kSurfelsTogether> judged;                 // which surfels they are of
    judged.fill(0xffffffffu);
    bool any = false;
    for_readings(store_.read_chunk(store_.leaves()[v.leaf]), readers, [&](std::uint32_t slot, std::size_t i, Sample s) {
      const std::uint32_t k = v.views[i].photograph;
      const Vec3f gain = agreement_.log_gain[k].array().exp();
      s.low = s.low.cwiseProduct(gain);
      s.high = s.high.cwiseProduct(gain);
      for (Vec3f& mean : s.wider) mean = mean.cwiseProduct(gain);
      const std::uint32_t place = slot % kSurfelsTogether;
      if (!ballots.surfels.empty() && judged[place] != slot) {
        majorities[place] = majority_of(ballots.surfels[slot], agreement_.log_gain, tolerance_.of_votes());
        least[place] = least_weight(ballots.surfels[slot]);
        judged[place] = slot;
      }
      const auto& majority = majorities[place];
      const float share = majority ? agreement_weight(*majority, log_value(s.low, scale_.brightness), tolerance_.of(s.weight, least[place])) : 1;
      Accumulator& sum = record.surfels[slot];
      any = true;
      if (share < 0.5f) {
        ++sum.rejected;
        ++record.counters[num_photographs() + k];
      }
      if (!(share > 0)) return;
      s.weight *= share * alignments_[k].trust;
      add_sample(sum, s, static_cast<float>(options_.high_band_power), std::span(record.more).subspan(std::size_t{slot} * middle_bands(), middle_bands()));
      ++record.counters[k];
    });
    if (any) sums_->write(v.leaf, v.reached(), record);
  }

  BlendStats write_layer() {
    BlendStats stats;
    stream::LayerWriter writer(store_, options_.layer, stream::albedo_fields(), options_.provenance_json);
    std::vector<LeafStats> leaves(store_.leaves().size());
    const auto resolved = [&](const LeafRecord<Accumulator>& record) { return resolve_leaf(record, static_cast<float>(options_.shared_sigma)); };
    const LeafDenoiser denoiser(store_, scale_.brightness, [&](std::size_t i) { return resolved(sums_->read<Accumulator>(i)); });
    const bool denoises = options_.denoise && scale_.brightness > 0;
    std::vector<std::atomic<std::uint64_t>> counters(2 * photographs_.size());   // whole numbers: the order does not matter
    report_.begin(denoises ? "blend: denoise and write" : "blend: write", leaves.size(), "chunks");
    std::atomic<std::uint64_t> done{0};
    walk_.for_leaves(leaves.size(), (denoises ? LeafDenoiser::bytes_per_surfel() : sizeof(Accumulator)) + 2 * (sum_bytes() - sizeof(Accumulator)), [&](std::size_t i) {
      const auto record = sums_->read<Accumulator>(i);
      std::vector<BlendedSurfel> values = resolved(record);
      const std::vector<BlendedSurfel> before = denoises ? values : std::vector<BlendedSurfel>();
      if (denoises) denoiser.denoise(i, values);
      leaves[i] = write_leaf(writer, store_.leaves()[i], record, values);
      leaves[i].denoising = compared(before, values);
      for (std::size_t k = 0; k < counters.size(); ++k) counters[k] += record.counters[k];
      report_.progress(++done);
    });
    report_.end();
    stats.photographs.resize(photographs_.size());
    if (denoises) stats.denoising.emplace();
    for (std::size_t leaf = 0; leaf < leaves.size(); ++leaf) {
      if (denoises) stats.denoising->add(leaves[leaf].denoising);
      stats.points += leaves[leaf].points;
      stats.points_seen += leaves[leaf].points_seen;
      stats.points_disputed += leaves[leaf].points_disputed;
    }
    for (std::size_t k = 0; k < photographs_.size(); ++k) {
      PhotographStats& p = stats.photographs[callers_index_[k]];
      p.samples = counters[k];
      p.rejected = counters[photographs_.size() + k];
      for (int c = 0; c < 3; ++c) p.gain[static_cast<std::size_t>(c)] = std::exp(static_cast<double>(agreement_.log_gain[k][c]));
      p.inspection = inspections_[k];
      p.alignment = alignments_[k];
      stats.photographs_read += was_read_[k] || walk_.photographs_read()[k];
      stats.samples += p.samples;
    }
    stats.scatter = static_cast<double>(agreement_.scatter);
    stats.tolerance = tolerance_;
    stats.chunks_visited = walk_.chunks_visited() + votes_visited_;
    for (std::size_t i = 0; i < leaves.size(); ++i) stats.leaves += sums_->is_written(i);
    stats.leaves_kept = leaves_kept_;
    stats.scratch_bytes = scratch_bytes_;
    stats.window = window_;
    writer.finish_inner(report_);
    writer.commit();
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
  WindowOptions window_;
  WindowCache windows_;
  PhotoWalk walk_;
  std::string key_, votes_key_;
  std::vector<std::string> photograph_keys_;
  std::vector<bool> was_read_, in_view_;
  std::vector<std::vector<bool>> views_;         // by photograph and leaf
  std::optional<KeptBlend> kept_;
  std::vector<std::uint32_t> order_, first_sum_; // order_: in which photographs vote
  std::uint32_t num_known_ = 0;                  // of the photographs, by a kept blend
  std::vector<std::uint8_t> changed_;            // by leaf
  std::uint64_t scratch_bytes_ = 0, leaves_kept_ = 0, votes_visited_ = 0;
  std::optional<LeafFile> votes_, sums_;
  Agreement agreement_;
  Tolerance tolerance_;
  std::vector<ReadingDistances> distances_;
  std::vector<Inspection> inspections_;
  std::vector<Alignment> alignments_;
};

}  // namespace

void BlendOptions::validate() const {
  if (layer.empty()) throw std::invalid_argument("BlendOptions: layer has no name");
  if (bands < 2 || bands > kMostBands) throw std::invalid_argument("BlendOptions: bands must be 2, 3 or 4");
  if (!(low_band_px * (1 << (bands - 2)) <= static_cast<double>(kMaxLowRadiusPx))) throw std::invalid_argument("BlendOptions: low_band_px is too large for so many bands");
  if (!(low_band_px >= 1 && low_band_px <= kMaxLowRadiusPx)) throw std::invalid_argument("BlendOptions: low_band_px must be in 1 .. 64");
  if (!(border_px >= 1 && border_px <= 64)) throw std::invalid_argument("BlendOptions: border_px must be in 1 .. 64");
  if (!(high_band_power >= 1 && high_band_power <= 8)) throw std::invalid_argument("BlendOptions: high_band_power must be in 1 .. 8");
  if (!(shared_sigma >= 0)) throw std::invalid_argument("BlendOptions: shared_sigma must not be negative");
  if (known && !keep.empty()) throw std::invalid_argument("BlendOptions: a blend of what is known beforehand is not kept");
}

BlendStats blend(const stream::Store& store, std::span<const BlendPhotograph> photographs, const BlendOptions& options,
                 const std::filesystem::path& scratch, MemoryBudget& budget, Reporter& report) {
  options.validate();
  if (photographs.size() > kMostPhotographs) throw Error(concat("blend: ", photographs.size(), " photographs, but ", kMostPhotographs, " at most can be blended together"));
  if (options.known && (options.known->gain.size() != photographs.size() || options.known->alignment.size() != photographs.size()))
    throw std::invalid_argument("blend: what is known is of other photographs");
  make_folder(scratch);
  const BlendStats stats = Blender(store, photographs, options, scratch, budget, report).run();
  for (const char* file : {Blender::kVotesFile, Blender::kSumsFile}) {
    std::error_code ignored;   // the layer is published: a scratch file that stays only costs disk
    std::filesystem::remove(scratch / file, ignored);
  }
  return stats;
}

}  // namespace chiaro::blend
