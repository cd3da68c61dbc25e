/// Sums per surfel over the photographs.
#pragma once
#include <cstdint>
#include <span>

#include "blend/leaf_file.h"
#include "blend/sample.h"

namespace chiaro::blend {

/// The high band's sums are double for their range, not their precision: weights reach down to 1e-12 beside borders and are raised to p, then squared.
struct Accumulator {
  double high_weight = 0, high[3] = {0, 0, 0};   ///< sum of w^p, w^p * high band
  double high_variance = 0;                      ///< sum of (w^p sigma)^2
  float low_weight = 0, low[3] = {0, 0, 0};      ///< sum of w, w * low band
  float low_variance = 0;                        ///< sum of (w sigma)^2
  float shared = 0;                              ///< sum of w * shared deviation
  float weight_square = 0, low_square = 0;       ///< sum of w^2, w * (low band, mean of the channels)^2: how far the readings scatter
  std::uint32_t photographs = 0;
  std::uint32_t rejected = 0;                    ///< readings that disagreed with the majority and were left out
};
static_assert(sizeof(Accumulator) == 80);

/// Sum of a band between the low and the high one: of w^q, and of w^q * the band, three channels. q grows evenly from band to band, from 1 to the high one's p.
using MiddleSum = FourFloats;

/// Adds one photograph's reading. middle: the bands below the high one, finest first; none where there are two bands.
void add_sample(Accumulator& sum, const Sample& sample, float high_band_power, std::span<MiddleSum> middle = {});

struct BlendedSurfel {
  Vec3f albedo;            ///< NaN: unseen
  float sigma = 0;         ///< relative; NaN: unseen
  float own_sigma = 0;     ///< of it what photographs do not share; 0 where all readings are exact by their own word; NaN: unseen
  std::uint16_t photographs = 0;
};
/// sigma: the larger one of what the readings' own deviations say and what their scatter says; readings that contradict each other show in it.
/// shared_sigma is a relative deviation that all photographs have in common; it joins the one that their pixels carry.
BlendedSurfel resolve(const Accumulator& sum, float shared_sigma, std::span<const MiddleSum> middle = {});

}  // namespace chiaro::blend
