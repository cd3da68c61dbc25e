/// What the best photographs of a surfel say of it, kept small: the ground on which a majority outvotes the rest.
///
/// A mean cannot tell a moved object from the surface behind it, since it has already been pulled; the readings themselves can. Eight of them are kept,
/// those with the largest weights, in 12 bytes each. A ballot has as many bytes however many photographs there are, and the same bits whatever the
/// threads and bands, as photographs come in the order of their names.
#pragma once
#include <array>
#include <cstdint>
#include <optional>
#include <span>

#include "blend/sample.h"

namespace chiaro::blend {

/// Colours are compared as logarithms of value / brightness + kDarkOffset, so that a factor is the same everywhere and noise in the dark is not
/// blown up. brightness: a typical value of the photographs at hand, which makes it free of units.
inline constexpr float kDarkOffset = 0.02f;
Vec3f log_value(const Vec3f& value, float brightness);
/// The logarithm after the value was multiplied by exp(log_gain).
Vec3f with_gain(const Vec3f& log, const Vec3f& log_gain);

struct Vote {
  std::uint16_t photograph = 0;
  std::uint16_t weight = 0;      ///< logarithmic; 0 = no vote
  std::uint16_t low[3] = {};     ///< log_value() of the low band
  std::int16_t detail = 0;       ///< high band over low band, mean of the channels
};
static_assert(sizeof(Vote) == 12);
float weight_of(const Vote& vote);
Vec3f log_low_of(const Vote& vote);
float detail_of(const Vote& vote);

inline constexpr std::size_t kVotes = 8;
struct Ballot {
  std::array<Vote, kVotes> votes{};
};
static_assert(sizeof(Ballot) == 96);

/// Enters a reading if its weight is among the eight largest; of equal ones those of the first photographs stay. Votes lie in the order of photographs,
/// so a ballot has the same bits in whatever order they were cast.
void cast_vote(Ballot& ballot, std::uint16_t photograph, const Sample& sample, float brightness);
/// A reading of less weight is no vote of this ballot; 0 while there is room for one.
float least_weight(const Ballot& ballot);
/// Takes a photograph's votes away. What they had displaced is not known any more: `is_whole` tells whether there was nothing.
struct Withdrawal {
  bool had_voted = false, is_whole = true;
};
Withdrawal withdraw_vote(Ballot& ballot, std::uint16_t photograph);

/// What the majority says of a surfel: the mean of the votes that lie within `tolerance` (of log_value, any channel) of each other.
struct Majority {
  Vec3f log_low = Vec3f::Zero();
  std::uint8_t members = 0;      ///< bit i: vote i is one of them
};
/// nullopt where there is none: fewer than two agree, or they do not hold more than half of the votes. A reading with a weight below a twentieth of the
/// largest has less than a whole vote.
/// log_gains: by photograph; added to what it says.
std::optional<Majority> majority_of(const Ballot& ballot, std::span<const Vec3f> log_gains, float tolerance);

/// How far a reading may lie from the majority and still be of the same surface, by its weight beside the votes'. Where more photographs see a surfel than have a vote, the
/// votes are those of its nearest neighbours in the best places, and alike even in what they have wrong; others are coarser, or see it aslant with another part of
/// what surrounds it, and differ legitimately by more.
struct Tolerance {
  static constexpr std::size_t kClasses = 5;
  static constexpr int kOctaves = 4;
  std::array<float, kClasses> by_class{};   ///< [0]: votes, and what weighs as much; then one for each kOctaves of weight below the least vote
  float of_votes() const { return by_class[0]; }
  /// least_vote: least_weight() of the ballot.
  static std::size_t class_of(float weight, float least_vote);
  float of(float weight, float least_vote) const { return by_class[class_of(weight, least_vote)]; }
  bool operator==(const Tolerance&) const = default;
};
/// How far the readings of a photograph lie from the majorities, by class of Tolerance.
struct ReadingDistances {
  std::array<float, Tolerance::kClasses> median{};
  std::array<std::uint32_t, Tolerance::kClasses> readings{};
};

/// Share of a reading's weight that is left to it: 1 within `tolerance` of the majority, 0 from twice that on, smooth between.
float agreement_weight(const Majority& majority, const Vec3f& log_low, float tolerance);

}  // namespace chiaro::blend
