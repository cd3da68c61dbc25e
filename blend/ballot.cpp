#include "blend/ballot.h"

#include <algorithm>
#include <cmath>

#include "blend/view_weights.h"

namespace chiaro::blend {
namespace {

constexpr float kLeastLog = -4, kLogSteps = 6000;          // to 6.9: values up to a thousand times the typical one, steps of 0.02 %
constexpr float kLeastLog2Weight = -64, kWeightSteps = 512;
constexpr float kDetailSteps = 8192;                       // +-4 times the low band
constexpr float kWholeVote = 0.05f;                        // of the largest weight

std::uint16_t quantised(float value, float least, float steps) {
  return static_cast<std::uint16_t>(std::clamp(std::lround((value - least) * steps), 1L, 65535L));
}

float distance(const Vec3f& a, const Vec3f& b) { return (a - b).cwiseAbs().maxCoeff(); }

}  // namespace

Vec3f log_value(const Vec3f& value, float brightness) {
  Vec3f log;
  for (int c = 0; c < 3; ++c) log[c] = std::log(std::max(0.0f, value[c] / brightness) + kDarkOffset);
  return log;
}

Vec3f with_gain(const Vec3f& log, const Vec3f& log_gain) {
  if (log_gain == Vec3f::Zero()) return log;
  Vec3f result;
  for (int c = 0; c < 3; ++c) result[c] = std::log(std::max(0.0f, std::exp(log[c]) - kDarkOffset) * std::exp(log_gain[c]) + kDarkOffset);
  return result;
}

float weight_of(const Vote& vote) { return vote.weight == 0 ? 0 : std::exp2(static_cast<float>(vote.weight) / kWeightSteps + kLeastLog2Weight); }

Vec3f log_low_of(const Vote& vote) {
  Vec3f log;
  for (int c = 0; c < 3; ++c) log[c] = static_cast<float>(vote.low[c]) / kLogSteps + kLeastLog;
  return log;
}

float detail_of(const Vote& vote) { return static_cast<float>(vote.detail) / kDetailSteps; }

void cast_vote(Ballot& ballot, std::uint16_t photograph, const Sample& sample, float brightness) {
  const std::uint16_t weight = quantised(std::log2(sample.weight), kLeastLog2Weight, kWeightSteps);
  auto end = std::find_if(ballot.votes.begin(), ballot.votes.end(), [](const Vote& v) { return v.weight == 0; });
  if (end == ballot.votes.end()) {
    const auto last = std::min_element(ballot.votes.begin(), end, [](const Vote& a, const Vote& b) { return a.weight != b.weight ? a.weight < b.weight : a.photograph > b.photograph; });
    if (weight != last->weight ? weight < last->weight : photograph >= last->photograph) return;
    std::move(last + 1, end, last);
    --end;
  }
  const auto at = std::find_if(ballot.votes.begin(), end, [&](const Vote& v) { return v.photograph > photograph; });
  std::move_backward(at, end, end + 1);
  const Vec3f log = log_value(sample.low, brightness);
  *at = {photograph, weight, {}, 0};
  for (int c = 0; c < 3; ++c) at->low[c] = quantised(log[c], kLeastLog, kLogSteps);
  const float low = sample.low.mean(), detail = low > 0 ? sample.high.mean() / low : 0;
  at->detail = static_cast<std::int16_t>(std::lround(std::clamp(detail * kDetailSteps, -32767.0f, 32767.0f)));
}

float least_weight(const Ballot& ballot) {
  std::uint16_t least = 65535;
  for (const Vote& v : ballot.votes) least = std::min(least, v.weight);
  return least < 2 ? 0 : std::exp2(static_cast<float>(least - 1) / kWeightSteps + kLeastLog2Weight);   // a step below: codes are rounded
}

Withdrawal withdraw_vote(Ballot& ballot, std::uint16_t photograph) {
  const bool was_full = ballot.votes.back().weight != 0;
  const auto kept = std::remove_if(ballot.votes.begin(), ballot.votes.end(), [&](const Vote& v) { return v.weight != 0 && v.photograph == photograph; });
  const bool had_voted = kept != ballot.votes.end();
  std::fill(kept, ballot.votes.end(), Vote{});
  return {had_voted, !(had_voted && was_full)};
}

std::optional<Majority> majority_of(const Ballot& ballot, std::span<const Vec3f> log_gains, float tolerance) {
  std::array<Vec3f, kVotes> log;
  std::array<float, kVotes> power{};
  std::uint16_t largest = 0;
  for (const Vote& v : ballot.votes) largest = std::max(largest, v.weight);
  if (largest == 0) return std::nullopt;
  float all = 0;
  for (std::size_t i = 0; i < kVotes; ++i) {
    const Vote& v = ballot.votes[i];
    log[i].setZero();
    if (v.weight == 0) continue;
    log[i] = with_gain(log_low_of(v), log_gains[v.photograph]);
    power[i] = std::min(1.0f, std::exp2(static_cast<float>(v.weight - largest) / kWeightSteps) / kWholeVote);
    all += power[i];
  }
  // The vote with most power around it, then the mean of those around it.
  std::size_t middle = 0;
  float most = -1;
  for (std::size_t i = 0; i < kVotes; ++i) {
    if (!(power[i] > 0)) continue;
    float around = 0;
    for (std::size_t j = 0; j < kVotes; ++j)
      if (distance(log[i], log[j]) <= tolerance) around += power[j];
    if (around > most) {
      most = around;
      middle = i;
    }
  }
  Majority result;
  float members = 0;
  int count = 0;
  for (std::size_t i = 0; i < kVotes; ++i) {
    if (!(power[i] > 0) || distance(log[i], log[middle]) > tolerance) continue;
    result.members |= static_cast<std::uint8_t>(1u << i);
    result.log_low += power[i] * log[i];
    members += power[i];
    ++count;
  }
  constexpr float kMoreThanHalf = 0.5f * (1 + 1e-4f);
  if (count < 2 || !(members > kMoreThanHalf * all)) return std::nullopt;
  result.log_low /= members;
  return result;
}

std::size_t Tolerance::class_of(float weight, float least_vote) {
  if (!(weight < least_vote)) return 0;
  const auto octaves = static_cast<std::size_t>(std::ilogb(least_vote / weight));
  return std::min(kClasses - 1, 1 + octaves / kOctaves);
}

float agreement_weight(const Majority& majority, const Vec3f& log_low, float tolerance) {
  return smooth_ramp(2 - distance(log_low, majority.log_low) / tolerance, 1);
}

}  // namespace chiaro::blend
