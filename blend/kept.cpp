#include "blend/kept.h"

#include <algorithm>
#include <cstring>
#include <map>

#include "stream/base/error.h"
#include "stream/base/file.h"
#include "stream/base/hash.h"

namespace chiaro::blend {
namespace {
namespace fs = std::filesystem;

constexpr char kMagic[8] = {'C', 'H', 'R', 'K', 'E', 'P', 'T', '3'};
constexpr const char *kStateFile = "state", *kVotesFile = "votes", *kSumsFile = "sums";
constexpr std::size_t kKeyBytes = 32;

struct StateHeader {
  char magic[8];
  char options_key[kKeyBytes], votes_key[kKeyBytes], sums_key[kKeyBytes];
  float footprint, brightness;
  Tolerance tolerance;
  std::uint32_t inspected, photographs, crc;   // crc: of the records
};
struct PhotographRecord {
  char key[kKeyBytes];
  float log_gain[3];
  float found_shift[2], spread, correlation, shift[2], trust;
  std::int32_t region[4];
  std::uint32_t has_shift, has_region;
  float sd, chance;
  float distances[Tolerance::kClasses];
  std::uint32_t distance_readings[Tolerance::kClasses];
  std::uint64_t readings, outvoted, judged;
};
static_assert(std::is_trivially_copyable_v<PhotographRecord>);

void put_key(char (&to)[kKeyBytes], const std::string& key) { std::memcpy(to, key.data(), std::min(key.size(), kKeyBytes)); }
std::string key_of(const char (&from)[kKeyBytes]) { return {from, kKeyBytes}; }

PhotographRecord record_of(const PhotographState& p) {
  PhotographRecord r{};
  put_key(r.key, p.key);
  for (int c = 0; c < 3; ++c) r.log_gain[c] = p.log_gain[c];
  std::copy(p.distances.median.begin(), p.distances.median.end(), r.distances);
  std::copy(p.distances.readings.begin(), p.distances.readings.end(), r.distance_readings);
  const Inspection& i = p.inspection;
  r.has_shift = i.shift_px.has_value();
  if (i.shift_px) r.found_shift[0] = i.shift_px->x(), r.found_shift[1] = i.shift_px->y();
  r.spread = i.shift_spread_px;
  r.sd = i.shift_sd_px;
  r.correlation = i.correlation;
  r.readings = i.shift_readings;
  r.has_region = i.disturbed.has_value();
  if (const auto& d = i.disturbed) {
    r.region[0] = d->x0, r.region[1] = d->y0, r.region[2] = d->x1, r.region[3] = d->y1;
    r.outvoted = d->outvoted;
    r.judged = d->judged;
    r.chance = d->chance;
  }
  r.shift[0] = p.alignment.shift_px.x(), r.shift[1] = p.alignment.shift_px.y();
  r.trust = p.alignment.trust;
  return r;
}

PhotographState state_of(const PhotographRecord& r) {
  PhotographState p;
  p.key = key_of(r.key);
  p.log_gain = {r.log_gain[0], r.log_gain[1], r.log_gain[2]};
  std::copy_n(r.distances, Tolerance::kClasses, p.distances.median.begin());
  std::copy_n(r.distance_readings, Tolerance::kClasses, p.distances.readings.begin());
  if (r.has_shift) p.inspection.shift_px = Vec2f(r.found_shift[0], r.found_shift[1]);
  p.inspection.shift_spread_px = r.spread;
  p.inspection.shift_sd_px = r.sd;
  p.inspection.correlation = r.correlation;
  p.inspection.shift_readings = r.readings;
  if (r.has_region) p.inspection.disturbed = Inspection::Region{r.region[0], r.region[1], r.region[2], r.region[3], r.outvoted, r.judged, r.chance};
  p.alignment = {Vec2f(r.shift[0], r.shift[1]), r.trust};
  return p;
}

/// nullopt if it is missing or damaged: then there is nothing to go on from.
std::optional<BlendState> read_state(const fs::path& path) {
  std::error_code code;
  if (!fs::is_regular_file(path, code)) return std::nullopt;
  const File file(path, File::Mode::kRead);
  StateHeader h{};
  if (file.read_some_at(0, &h, sizeof h) != sizeof h || std::memcmp(h.magic, kMagic, sizeof kMagic) != 0) return std::nullopt;
  if (file.size() != sizeof h + std::uint64_t{h.photographs} * sizeof(PhotographRecord)) return std::nullopt;
  std::vector<PhotographRecord> records(h.photographs);
  file.read_at(sizeof h, records.data(), records.size() * sizeof(PhotographRecord));
  if (crc32c(records.data(), records.size() * sizeof(PhotographRecord)) != h.crc) return std::nullopt;
  BlendState state{key_of(h.options_key), key_of(h.votes_key), key_of(h.sums_key), h.footprint, h.brightness, h.tolerance, h.inspected != 0, {}};
  for (const PhotographRecord& r : records) state.photographs.push_back(state_of(r));
  return state;
}

}  // namespace

std::optional<std::vector<std::uint32_t>> numbers_now(std::span<const PhotographState> then, std::span<const std::string> now) {
  std::vector<std::uint32_t> numbers;
  std::multimap<std::string, std::uint32_t> places;   // equal keys (the same photograph twice) keep their order
  for (std::uint32_t k = 0; k < now.size(); ++k) places.emplace(now[k], k);
  std::int64_t last = -1;
  for (const PhotographState& p : then) {
    const auto found = places.find(p.key) == places.end() ? places.end() : places.lower_bound(p.key);
    if (found == places.end()) {
      numbers.push_back(0xffffffffu);
      continue;
    }
    if (std::int64_t{found->second} <= last) return std::nullopt;
    last = found->second;
    numbers.push_back(found->second);
    places.erase(found);
  }
  return numbers;
}

std::optional<KeptBlend> KeptBlend::open(const fs::path& folder, const std::string& options_key, std::span<const std::string> photograph_keys,
                                         const std::vector<std::uint32_t>& surfels_of_leaf, std::uint32_t middle_bands) {
  auto state = read_state(folder / kStateFile);
  if (!state || state->options_key != options_key) return std::nullopt;
  auto numbers = numbers_now(state->photographs, photograph_keys);
  if (!numbers) return std::nullopt;
  const auto n = static_cast<std::uint32_t>(state->photographs.size());
  auto votes = LeafFile::existing(folder / kVotesFile, state->votes_key, {surfels_of_leaf, n, 0, sizeof(Ballot), 0});
  auto sums = LeafFile::existing(folder / kSumsFile, state->sums_key, {surfels_of_leaf, n, 2 * n, sizeof(Accumulator), middle_bands});
  if (!votes || !sums || votes->photographs_done() != n || sums->photographs_done() != n) return std::nullopt;
  KeptBlend kept(std::move(*state), std::move(*votes), std::move(*sums));
  kept.now_of_then_ = std::move(*numbers);
  kept.then_of_now_.assign(photograph_keys.size(), kNone);
  for (std::uint32_t j = 0; j < n; ++j)
    if (kept.now_of_then_[j] != kNone) kept.then_of_now_[kept.now_of_then_[j]] = j;
  return kept;
}

void KeptBlend::save(const fs::path& folder, const BlendState& state, const fs::path& votes, const fs::path& sums) {
  make_folder(folder);
  std::error_code ignored;
  fs::remove(folder / kStateFile, ignored);   // first out and last in: a state never speaks of other files
  std::vector<PhotographRecord> records;
  for (const PhotographState& p : state.photographs) records.push_back(record_of(p));
  StateHeader h{};
  std::memcpy(h.magic, kMagic, sizeof kMagic);
  put_key(h.options_key, state.options_key);
  put_key(h.votes_key, state.votes_key);
  put_key(h.sums_key, state.sums_key);
  h.footprint = state.footprint;
  h.brightness = state.brightness;
  h.tolerance = state.tolerance;
  h.inspected = state.inspected;
  h.photographs = static_cast<std::uint32_t>(records.size());
  h.crc = crc32c(records.data(), records.size() * sizeof(PhotographRecord));
  for (const auto& [from, to] : {std::pair{votes, folder / kVotesFile}, std::pair{sums, folder / kSumsFile}}) {
    std::error_code code;
    fs::rename(from, to, code);
    if (code) throw Error(concat(to.string(), ": cannot be moved there from ", from.string(), ": ", code.message()));
  }
  AtomicFile file(folder / kStateFile);
  file.append(&h, sizeof h);
  file.append(records.data(), records.size() * sizeof(PhotographRecord));
  file.commit();
}

KeptBlend::Votes KeptBlend::votes(std::size_t leaf) const {
  Votes result{votes_.read<Ballot>(leaf), votes_.is_written(leaf)};
  for (Ballot& ballot : result.record.surfels) {
    for (std::size_t i = 0; i < kVotes;) {
      const Vote& v = ballot.votes[i];
      if (v.weight == 0 || now_of_then_[v.photograph] != kNone) {
        ++i;
        continue;
      }
      result.withdrawn = true;
      result.is_whole &= withdraw_vote(ballot, v.photograph).is_whole;
    }
    for (Vote& v : ballot.votes)
      if (v.weight != 0) v.photograph = static_cast<std::uint16_t>(now_of_then_[v.photograph]);
  }
  return result;
}

KeptBlend::Sums KeptBlend::sums(std::size_t leaf) const {
  Sums result{sums_.read<Accumulator>(leaf), sums_.is_written(leaf)};
  const std::vector<std::uint32_t> then = result.record.counters;
  const std::size_t n_then = now_of_then_.size(), n_now = then_of_now_.size();
  result.record.counters.assign(2 * n_now, 0);
  for (std::size_t j = 0; j < n_then; ++j) {
    if (now_of_then_[j] == kNone) {
      result.holds_removed |= then[j] > 0 || then[n_then + j] > 0;
      continue;
    }
    result.record.counters[now_of_then_[j]] = then[j];
    result.record.counters[n_now + now_of_then_[j]] = then[n_then + j];
  }
  return result;
}

}  // namespace chiaro::blend
