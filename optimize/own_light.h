/// Photographs whose light differs from that of the others of their acquisition: a lamp was on, a cloud passed, the exposure was another; or a flash, or daylight, that is never
/// twice the same. Factors on the ambient light and on the brightness of photographs, unknowns beside the lights that all share.
#pragma once
#include <span>
#include <vector>

#include "optimize/light_solve.h"
#include "optimize/light_spread.h"

namespace chiaro::optimize {

/// Of one photograph, beside the others'.
struct OwnLight {
  double ambient = 1;         ///< factor on the ambient light
  double exposure = 1;        ///< factor on the brightness
  double ambient_ln_sd = 0, exposure_ln_sd = 0;   ///< 0 where the factor is 1
  bool unlike = false, unlike_ambient = false;   ///< its brightness, its ambient light differs by more than that of all photographs does
  double& factor(FactorKind kind) { return kind == kAmbient ? ambient : exposure; }
  double factor(FactorKind kind) const { return kind == kAmbient ? ambient : exposure; }
};

struct OwnLightOptions {
  double ambient_ln_sd = 0.7, exposure_ln_sd = 0.3;   ///< priors, around 1: half or twice the ambient light is nothing strange
  LightSpread least_spread{0.02, 0.003};   ///< over all photographs
  bool may_vary = true;              ///< whether all photographs may differ in ambient light or brightness
  double evidence = kVeryStrong;     ///< for a factor of its own, and for factors of all
  double least_ambient = 0.1, least_exposure = 0.04;   ///< of their logarithms; less is more likely the model's than the room's or the camera's
  double least_deviations = 3;       ///< squared: so many times what a factor of any other photograph would explain
  std::size_t least_surfels = 50;    ///< that a photograph shares with others
  int rounds = 12;                   ///< of Gauss-Newton on lights and factors, for each way that is tried
};

struct OwnLights {
  std::vector<OwnLight> of;   ///< one a photograph, whole: with what the samples hold already
  LightSpread spread{};
  Eigen::Matrix2d lights_covariance = Eigen::Matrix2d::Zero();   ///< of ln flash and sky[0]: what they owe to the factors' uncertainty
};

/// Adds photographs to those that have a factor one by one, with the lights and all factors free each time: of the likeliest photographs and of a factor on the ambient
/// light, on the brightness, and both, the one that explains most, as long as an information criterion speaks very strongly for it. It has to explain far more than
/// factors of the others would in the end: where all want one, it is the model that is wrong. Fewer than half of the photographs get any, and none where fewer than three can be compared: of two that differ
/// nobody knows which is right.
///
/// Then all photographs with flash get a factor of brightness, all get one on the ambient light, or both, each kind from one normal distribution around 1 whose width is what they say it is
/// (expectation maximisation, from the marginal likelihood): kept where the evidence, by Laplace's approximation, is very strong against equal light. A flash that repeats to 2 % asks for the
/// former (without, it passes for another ambient light), a window under passing clouds for the latter.
///
/// samples     sorted by group, each photograph once in a group; their light holds what `known` says, their `photograph` is an index into it.
/// references  the same.
/// solution    of these samples, or of more of the same photographs.
/// known_spread   spread of what `known` is from.
/// memory      a few copies of the samples, and for each photograph a row for each factor in use.
/// threads     one, but for solve_lights().
OwnLights find_own_lights(std::span<const LightSample> samples, std::span<const ReferenceSample> references, const LightSolveOptions& options, const LightSolution& solution,
                          std::span<const OwnLight> known, const LightSpread& known_spread = {}, const OwnLightOptions& own_options = {});

/// Puts a change of its photograph's own light into a sample: factors on the ambient light, and on the brightness to take out.
void change_own_light(LightSample& sample, double ambient, double exposure);

}  // namespace chiaro::optimize
