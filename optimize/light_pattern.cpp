#include "optimize/light_pattern.h"

#include <algorithm>
#include <cmath>
#include <vector>

#include "optimize/own_light.h"
#include "optimize/pattern_fit.h"

namespace chiaro::optimize {
namespace {

// Places of the unknowns.
constexpr Eigen::Index kShift = 0, kLens = 3, kFlash = 5, kUnknowns = 9;
static_assert(kUnknowns <= kMaxPatternUnknowns);
constexpr double kNothing = 1e-7;         ///< prior of what a pattern does not have
constexpr double kFalloffSd = 0.5, kTiltSd = 0.15;   ///< of ln, in the corners: half of the light and more may be lost there; an axis that is a few degrees off
constexpr double kPlaceChi2 = 1.5;     ///< the deviations are conservative: at most 0.7 on five scenes whose flash is where it is said to be; 1, 2 and 3 cm beside: 2.6, 8.6, 22
constexpr double kExplained = 0.5;     ///< of the residuals' deviation, in expected ones: 0.2 to 0.33 on diffuse scenes, 0.6 under a sky and a floor that no model follows, 1.5 on a glossy one
constexpr double kExplainedFalloff = 0.6;   ///< the same for a falloff, whose evidence says more
constexpr double kImproved = 0.98;     ///< of that deviation: 0.965 for 1 cm, 0.85 for 3; what only looks like a shift leaves 0.993
constexpr double kLeastFalloff = 0.03; ///< of ln in the corners

struct Candidate {
  bool shift;
  FalloffModel falloff;
  Pattern pattern;
  PatternFit fit;
  double criterion = 0;
  int unknowns() const { return (shift ? 3 : 0) + (falloff == FalloffModel::kLens ? 2 : falloff == FalloffModel::kFlash ? 4 : 0); }
};

PatternEffect effect_of(const LightSample& s) {
  PatternEffect e{PatternVector::Zero(kUnknowns), PatternVector::Zero(kUnknowns)};
  e.of_flash.segment<3>(kShift) = s.flash_by_shift.cast<double>();
  e.of_picture.segment<2>(kLens) = lens_terms(s.off_axis.cast<double>());
  e.of_flash.segment<4>(kFlash) = flash_terms(s.flash_off_axis.cast<double>());
  return e;
}

Candidate candidate(bool shift, FalloffModel falloff, const LightSpread& open, const LightPattern& already, const LightPatternOptions& options) {
  Candidate c{shift, falloff, {PatternVector::Zero(kUnknowns), PatternVector::Constant(kUnknowns, kNothing)}, {}};
  c.pattern.already.segment<3>(kShift) = already.flash_shift;
  c.pattern.already.segment<2>(kLens) = already.falloff.lens;
  c.pattern.already.segment<4>(kFlash) = already.falloff.flash;
  if (shift) c.pattern.prior_sd.segment<3>(kShift).setConstant(options.shift_prior_sd);
  if (falloff == FalloffModel::kLens) c.pattern.prior_sd.segment<2>(kLens).setConstant(kFalloffSd);
  if (falloff == FalloffModel::kFlash) c.pattern.prior_sd.segment<4>(kFlash) = Eigen::Vector4d(kTiltSd, kTiltSd, kFalloffSd, kFalloffSd);
  c.pattern.open = open;
  return c;
}

std::vector<FalloffModel> models_of(FalloffModel wanted) {
  if (wanted == FalloffModel::kNone) return {FalloffModel::kNone};
  if (wanted == FalloffModel::kAuto) return {FalloffModel::kNone, FalloffModel::kLens, FalloffModel::kFlash};
  return {FalloffModel::kNone, wanted};
}

Falloff falloff_of(const Candidate& c) {
  Falloff f;
  if (c.falloff == FalloffModel::kLens) {
    f.lens = c.fit.value.segment<2>(kLens);
    f.covariance.topLeftCorner<2, 2>() = c.fit.covariance.block<2, 2>(kLens, kLens);
  }
  if (c.falloff == FalloffModel::kFlash) {
    f.flash = c.fit.value.segment<4>(kFlash);
    f.covariance = c.fit.covariance.block<4, 4>(kFlash, kFlash);
  }
  return f;
}

using Candidates = std::vector<Candidate>;

/// Without a shift and with one, for each model of the falloff in turn.
Candidates fitted(const PatternResiduals& residuals, const LightSpread& open, const LightPattern& already, const LightPatternOptions& options) {
  Candidates all;
  for (const FalloffModel falloff : models_of(options.falloff))
    for (const bool shift : {false, true}) {
      all.push_back(candidate(shift, falloff, open, already, options));
      all.back().fit = residuals.fit(all.back().pattern);
    }
  return all;
}

bool better(const Candidate& a, const Candidate& b) { return a.criterion < b.criterion; }

/// What may be left open of the photographs' factors: what is known to vary, and beside it each kind that is not, or not.
std::vector<LightSpread> ways_to_vary(const LightSpread& known) {
  std::vector<LightSpread> ways{known};
  for (std::size_t kind = 0; kind < kFactorKinds; ++kind)
    for (std::size_t w = 0, n = ways.size(); known[kind] == 0 && w < n; ++w) {
      ways.push_back(ways[w]);
      ways.back()[kind] = kUsualSpread[kind];
    }
  return ways;
}

/// The candidates that hold: with photographs under one light, unless it very likely varies, by each kind.
Candidates fitted(const PatternResiduals& residuals, const LightPattern& already, double independent, const LightPatternOptions& options) {
  const std::vector<LightSpread> open = ways_to_vary(options.spread);
  std::vector<Candidates> ways;
  for (const LightSpread& spread : open) ways.push_back(fitted(residuals, spread, already, options));
  double scale = ways[0][0].fit.after;
  for (const Candidates& way : ways)
    for (const Candidate& c : way) scale = std::min(scale, c.fit.after);
  const double price = std::log(std::max(2.0, independent));
  for (Candidates& way : ways)
    for (Candidate& c : way) c.criterion = residuals.misfit(c.pattern, c.fit, scale) + c.fit.occam + price * c.unknowns();
  std::size_t best = 0;
  double least = 0;
  for (std::size_t w = 0; w < ways.size(); ++w) {
    double criterion = std::min_element(ways[w].begin(), ways[w].end(), better)->criterion;
    for (std::size_t kind = 0; kind < kFactorKinds; ++kind) criterion += open[w][kind] != options.spread[kind] ? kVeryStrong : 0;
    if (w > 0 && !(criterion < least)) continue;
    least = criterion;
    best = w;
  }
  return ways[best];
}

/// Of fitted(), where the two candidates of the model of the falloff are that holds.
std::size_t family_of(const Candidates& all, const LightPattern& already) {
  const Candidate& without = *std::min_element(all.begin(), all.begin() + 2, better);
  const auto best = std::min_element(all.begin() + 2, all.end(), better);
  if (best == all.end() || !(std::fabs(std::log(kept_in_corners(falloff_of(*best)))) > kLeastFalloff) || !(best->fit.after < kExplainedFalloff)) return 0;
  const bool holds = already.falloff.none() ? best->criterion < without.criterion - kVeryStrong && best->fit.after < kImproved * without.fit.after : best->criterion < without.criterion;
  return holds ? static_cast<std::size_t>(best - all.begin()) / 2 * 2 : 0;
}

/// Whether the flash stands elsewhere. Where the model explains less than expected (highlights, other light), anything that bends like the flash's light would pass for a shift.
bool shifts(const Candidate& still, const Candidate& moved, const LightPattern& already, const LightPatternOptions& options) {
  if (!(moved.fit.value.segment<3>(kShift).norm() < options.farthest_shift)) return false;
  const bool known = !already.flash_shift.isZero();
  return moved.fit.chi2(kShift, 3) > kPlaceChi2 && (known || moved.fit.after < kExplained) && moved.fit.after < (known ? 1 : kImproved) * still.fit.after;
}

LightPattern pattern_of(const Candidate& chosen, double flash_corner_sine) {
  LightPattern p;
  p.falloff = falloff_of(chosen);
  p.falloff.flash_corner_sine = flash_corner_sine;
  if (chosen.shift) p.flash_shift = chosen.fit.value.segment<3>(kShift);
  return p;
}

}  // namespace

FoundPattern find_light_pattern(std::span<const LightSample> samples, const Lights& lights, const LightPattern& already, double independent, const LightPatternOptions& options) {
  const PatternResiduals residuals(samples, lights, effect_of, independent);
  const Candidates all = fitted(residuals, already, independent, options);
  const std::size_t family = family_of(all, already);
  const Candidate& chosen = all[family + (shifts(all[family], all[family + 1], already, options) ? 1 : 0)];
  FoundPattern found{pattern_of(chosen, already.falloff.flash_corner_sine)};
  if (chosen.unknowns() > 0) found.lights_covariance = chosen.fit.lights_covariance;
  return found;
}

}  // namespace chiaro::optimize
