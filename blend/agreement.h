/// What the photographs as a whole have to do with each other: how far they scatter, and by which factor one of them is brighter than the rest.
#pragma once
#include <span>
#include <vector>

#include "blend/ballot.h"
#include "blend/blend.h"

namespace chiaro::blend {

/// Two readings of one surfel: logarithm of b less that of a.
struct ReadingPair {
  std::uint16_t a = 0, b = 0;
  Vec3f difference = Vec3f::Zero();
};
/// All pairs of a ballot, but for values in the dark (log_value within a few kDarkOffset), of which a factor says little.
void append_pairs(const Ballot& ballot, std::vector<ReadingPair>& pairs);

struct Agreement {
  std::vector<Vec3f> log_gain;   ///< by photograph: what its logarithms lack to agree with the others; 0 for none
  float scatter = 0;             ///< median distance (largest channel of log_value) between two readings of a surfel, gains applied
  std::uint64_t pairs = 0;
};

/// Gains by least absolute differences over pairs of readings of the same surfel: half of the pairs may be of moved things or highlights. Only ratios are
/// measurable; of each group of photographs that overlap the middle one keeps its brightness, and not the mean: one photograph that is off must not drag
/// the others. Gains below 2 % and below one and a half times the scatter are none (measured on a rendered chamber, where one of 1 % came from light
/// that bounced: error 4.78 -> 4.81 % with it). The result does not depend on threads.
Agreement find_agreement(std::span<const ReadingPair> pairs, std::size_t num_photographs, Gain gain);

/// How far readings of one surface may lie apart: wide enough for what photographs of the same thing differ by.
float tolerance_for(float scatter);
/// photographs: a sample of them; the first class is not asked. Of a class the middle reading counts, each photograph's taken for its median: half of them may be of something
/// else. A lighter class is allowed as much as a heavier one at least.
Tolerance tolerance_by_class(float of_votes, std::span<const ReadingDistances> photographs);

}  // namespace chiaro::blend
