/// LightProblem: photographs that are unlike the others of their acquisition.
#include <algorithm>
#include <cmath>

#include "optimize/light_problem.h"
#include "optimize/strangers.h"

namespace chiaro::optimize {
namespace {

constexpr int kOwnLightRounds = 5;     ///< each one sees what the lights had taken for their own before

}  // namespace

/// A photograph of something else takes no part in finding the lights. Returns whether there is one.
bool LightProblem::leave_out_strangers(const Lights& lights) {
  if (use_pairs_) return false;
  const std::vector<bool> found = strangers(samples_, lights, input_.photographs.size());
  for (std::size_t k = 0; k < found.size(); ++k) strangers_[k] = strangers_[k] || found[k];
  return std::any_of(found.begin(), found.end(), [](bool b) { return b; });
}

void LightProblem::take_out_exposure(std::size_t k, double factor) {
  own_[k].exposure *= factor;
  const float by = static_cast<float>(1 / factor);
  Observation o = read(k);
  for (std::size_t i = 0; i < o.seen.size(); ++i)
    for (std::size_t c = 3 * i; o.seen[i] && c < 3 * i + 3; ++c) o.radiosity[c] *= by;
  write_observation(o, observation_path(folder_, k));
  for (ReferenceReading& r : references_)
    if (r.photograph == k)
      for (float& b : r.reference.sample.radiosity) b *= by;
}

void LightProblem::forget_own_lights() {
  for (const std::size_t k : photographs_) {
    for (ReferenceReading& r : references_)
      if (r.photograph == k) change_own_light(r.reference.sample, 1 / own_[k].ambient, 1);
    if (own_[k].exposure != 1) take_out_exposure(k, 1 / own_[k].exposure);
    own_[k] = {};
  }
  own_lights_covariance_.setZero();
  spread_ = {};
}

/// Gives photographs factors on their ambient light and brightness where that clearly explains them better, or corrects those. Returns whether any has changed.
bool LightProblem::find_own_light(const Lights& start, const LightSolution& solution, bool may_vary) {
  bool& settled = may_vary ? variation_settled_ : own_light_settled_;
  int& rounds = may_vary ? variation_rounds_ : own_light_rounds_;
  if (settled || rounds >= kOwnLightRounds) return false;
  ++rounds;
  settled = true;
  if (input_.method != Method::kJoint || use_pairs_ || !lit_) return false;
  LightSolveOptions options = current_options(start);
  options.max_iterations = kTrialIterations;
  OwnLightOptions own_options;
  own_options.may_vary = may_vary;
  const OwnLights found = find_own_lights(thinned(samples_, kTrialGroups), current_references(), options, solution, own_, spread_, own_options);
  const bool varied = varies();
  spread_ = found.spread;
  if (!varied && varies()) doubt_falloff();
  own_lights_covariance_ = found.lights_covariance;
  bool any = false;
  for (const std::size_t k : photographs_) {
    const double ambient = found.of[k].ambient / own_[k].ambient, exposure = found.of[k].exposure / own_[k].exposure;
    own_[k].ambient_ln_sd = found.of[k].ambient_ln_sd;
    own_[k].exposure_ln_sd = found.of[k].exposure_ln_sd;
    own_[k].unlike = found.of[k].unlike;
    own_[k].unlike_ambient = found.of[k].unlike_ambient;
    if (std::fabs(std::log(ambient)) < kSettled && std::fabs(std::log(exposure)) < kSettled) continue;
    any = true;
    settled = false;
    own_[k].ambient *= ambient;
    for (ReferenceReading& r : references_)
      if (r.photograph == k) change_own_light(r.reference.sample, ambient, 1);
    if (exposure != 1) take_out_exposure(k, exposure);
  }
  return any;
}

}  // namespace chiaro::optimize
