/// Photographs whose light differs from that of the others of their acquisition: a lamp was on, a cloud passed, the exposure was another. Factors on the ambient light
/// and on the brightness of single photographs, unknowns beside the lights that all share.
#pragma once
#include <span>
#include <vector>

#include "optimize/light_solve.h"

namespace chiaro::optimize {

/// Of one photograph, beside the others'.
struct OwnLight {
  double ambient = 1;         ///< factor on the ambient light
  double exposure = 1;        ///< factor on the brightness
  double ambient_ln_sd = 0;   ///< 0 where ambient is 1
};

struct OwnLightOptions {
  double ambient_ln_sd = 0.7, exposure_ln_sd = 0.3;   ///< priors, around 1: half or twice the ambient light is nothing strange
  double evidence = 10;              ///< of the Bayesian information criterion, for a factor of its own: very strong (Kass and Raftery, "Bayes factors", 1995)
  double least_ambient = 0.1, least_exposure = 0.04;   ///< of their logarithms; less is more likely the model's than the room's or the camera's
  double least_deviations = 3;       ///< squared: so many times what a factor of any other photograph would explain
  std::size_t least_surfels = 50;    ///< that a photograph shares with others
  int rounds = 12;                   ///< of Gauss-Newton on lights and factors, for each way that is tried
};

struct OwnLights {
  std::vector<OwnLight> of;   ///< one a photograph, whole: with what the samples hold already
  Eigen::Matrix2d lights_covariance = Eigen::Matrix2d::Zero();   ///< of ln flash and sky[0]: what they owe to the factors' uncertainty
};

/// Adds photographs to those that have a factor one by one, with the lights and all factors free each time: of the likeliest photographs and of a factor on the ambient
/// light, on the brightness, and both, the one that explains most, as long as an information criterion speaks very strongly for it. It has to explain far more than
/// factors of the others would in the end: where all want one, it is the model that is wrong. Fewer than half of the photographs get any, and none where fewer than three can be compared: of two that differ
/// nobody knows which is right.
///
/// samples     sorted by group, each photograph once in a group; their light holds what `known` says, their `photograph` is an index into it.
/// references  the same.
/// solution    of these samples, or of more of the same photographs.
/// memory      a copy of the samples, and for each photograph a row for each factor in use.
/// threads     one, but for solve_lights().
OwnLights find_own_lights(std::span<const LightSample> samples, std::span<const ReferenceSample> references, const LightSolveOptions& options, const LightSolution& solution,
                          std::span<const OwnLight> known, const OwnLightOptions& own_options = {});

/// Puts a change of its photograph's own light into a sample: factors on the ambient light, and on the brightness to take out.
void change_own_light(LightSample& sample, double ambient, double exposure);

}  // namespace chiaro::optimize
