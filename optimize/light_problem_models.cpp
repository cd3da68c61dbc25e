/// LightProblem: which model of the light the photographs support.
#include <algorithm>
#include <array>
#include <cmath>

#include "optimize/light_jackknife.h"
#include "optimize/light_problem.h"

namespace chiaro::optimize {
namespace {

constexpr double kNoBouncesEvidence = 8;   ///< of ln likelihood: 16 to 115 on photographs without interreflections, -3 and less on eleven with them, 0 on a sphere
constexpr std::array kRoughnessStarts{0.12, 0.2, 0.3, 0.45};   ///< a broad lobe is another minimum: it passes for a change of the lights
constexpr std::size_t kGlossLooks = 3;     ///< photographs of one place that tell a highlight from the rest

/// Half of the groups or more have so many samples.
bool seen_often(const std::vector<LightSample>& samples, std::size_t times) {
  std::size_t often = 0, groups = 0;
  for (std::size_t i = 0; i < samples.size(); ++groups) {
    std::size_t e = i;
    while (e < samples.size() && samples[e].group == samples[i].group) ++e;
    often += e - i >= times;
    i = e;
  }
  return groups > 0 && 2 * often >= groups;
}

}  // namespace

/// Tries a coat over all surfaces, and takes it if its criterion is the smaller one (choose_richer_sky). Returns whether it was taken.
bool LightProblem::choose_gloss(const Lights& start, LightSolution& solution) {
  if (use_pairs_ || !lit_ || !seen_often(samples_, kGlossLooks)) return false;
  const LightSolveOptions plain = current_options(start);
  const Lights base = solution.lights;
  Lights coated = base;
  gloss_ = true;
  LightSolveOptions options = current_options(start);
  options.max_iterations = kTrialIterations;
  const std::vector<LightSample> some = thinned(samples_, kTrialGroups);
  for (const double roughness : kRoughnessStarts) {
    Lights from = base;
    from.gloss.on = true;
    from.gloss.roughness = roughness;
    const Lights tried = solve_lights(some, current_references(), options, from).lights;
    const double criterion = gloss_criterion(some, plain, base, tried);
    if (gloss_evidence_ && !(criterion < *gloss_evidence_)) continue;
    gloss_evidence_ = criterion;
    coated = tried;
  }
  if (*gloss_evidence_ < 0) {   // now with all that there is
    const LightSolution whole = solve_lights(samples_, current_references(), options, coated);
    gloss_evidence_ = gloss_criterion(samples_, plain, base, whole.lights);
    if (*gloss_evidence_ < 0) solution = whole;
  }
  gloss_ = *gloss_evidence_ < 0;
  return gloss_;
}

/// Tries richer models of the ambient light on what is gathered now, and takes the one with the smallest Bayesian information criterion (misfit, and
/// ln(residuals) / 2 for each parameter) if it is very much smaller. One photograph supports none (physics.md E.4). Returns whether the model has changed.
bool LightProblem::choose_richer_sky(const Lights& start, LightSolution& solution) {
  if (use_pairs_) return false;
  const SkyShape plain = sky_;
  const LightSolveOptions plain_options = current_options(start);
  const Lights base = solution.lights;
  const double price = std::log(std::max(2.0, independent_residuals(samples_, plain_options))), reference = 2 * light_misfit(samples_, plain_options, base, base) + price * plain.parameters();
  SkyShape best = plain;
  double least = -kVeryStrong;   // what a richer sky gains is small, and what it loses where it is wrong is not
  sky_evidence_ = {{plain.name(), plain.parameters(), 0}};
  for (const SkyShape& candidate : richer_skies(plain, input_.sky, scene_.floor && input_.try_floor)) {
    sky_ = candidate;
    LightSolveOptions candidate_options = current_options(start);
    candidate_options.max_iterations = kTrialIterations;
    const LightSolution tried = solve_lights(samples_, current_references(), candidate_options, base);
    const double criterion = 2 * light_misfit(samples_, plain_options, tried.lights, base) + price * candidate.parameters() - reference;
    sky_evidence_.push_back({candidate.name(), candidate.parameters(), criterion});
    if (!(criterion < least)) continue;
    least = criterion;
    best = candidate;
    solution = tried;
  }
  sky_ = best;
  return best.name() != plain.name();
}

/// How far photographs leave open what of the ambient light is its mean: which of them are asked, and, where they speak against an even grey sky alone, what shape
/// it has instead (by the richest model there is: that a sparse one explains as much is no reason to believe its shape).
double LightProblem::ambient_open(const Lights& start, const LightSolution& solution) {
  if (use_pairs_ || !lit_ || solution.sky_terms == 0) return 0;
  const std::vector<LightSample> some = thinned(samples_, kTrialGroups);
  const std::vector<ReferenceSample> references = current_references();
  LightSolveOptions options = current_options(start);
  options.max_iterations = kTrialIterations;
  const LightSolution plain = solve_lights(some, references, options, solution.lights);
  const double variance = plain.covariance(1, 1);
  double open = 0;
  if (const auto by_photographs = ambient_variance_by_photographs(some, references, options, plain)) open += std::max(0.0, *by_photographs - variance);
  if (input_.sky != SkyModel::kAuto || sky_.name() == sky_shape(input_.sky).name()) return open;
  const SkyShape chosen = sky_;
  sky_ = {kSkyTerms, true, chosen.floor};
  LightSolveOptions richest = current_options(start);
  sky_ = chosen;
  richest.max_iterations = kTrialIterations;
  const LightSolution rich = solve_lights(some, references, richest, plain.lights);
  const double moved = rich.lights.sky[0] - plain.lights.sky[0];
  return open + std::max(0.0, rich.covariance(1, 1) + moved * moved - variance);
}

/// Photographs may hold no interreflection at all (they were corrected before, or composed). If they clearly speak for leaving it out, it is left out.
void LightProblem::check_bounces(const LightSolveOptions& options, LightSolution& solution) {
  LightSolveOptions no_bounces = options;
  no_bounces.bounce_mean = no_bounces.bounce_sd = 0;
  Lights start = solution.lights;
  start.bounce = 0;
  // References do not take part: one that is misread must not decide.
  const Lights without = solve_lights(samples_, {}, no_bounces, start).lights, with = references_.empty() ? solution.lights : solve_lights(samples_, {}, options, solution.lights).lights;
  // By the weights of either: shadows and texture scatter alike under both, so only the difference speaks.
  const auto gain = [&](const Lights& base) { return light_misfit(samples_, options, with, base) - light_misfit(samples_, options, without, base); };
  if (!(std::min(gain(with), gain(without)) > kNoBouncesEvidence)) return;
  without_bounces_ = true;
  solution = solve_lights(samples_, current_references(), no_bounces, start);
}

}  // namespace chiaro::optimize
