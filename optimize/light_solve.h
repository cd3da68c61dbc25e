/// Flash intensity, sky and bounce factor from what surfels look like under different light: robust log-ratio Gauss-Newton with the albedos
/// eliminated (variable projection, physics.md E.1; weights prototype.md).
#pragma once
#include <Eigen/Dense>
#include <array>
#include <cstdint>
#include <optional>
#include <span>
#include <string>
#include <vector>

#include "optimize/gather.h"
#include "optimize/gloss.h"

namespace chiaro::optimize {

/// H = flash_intensity * d + sky_colour * sum_b sky[b] * T_b + bounce * G, irradiance per colour channel. The flash is grey: it is what white is measured by.
/// With a floor: T less what it hides, and what it gives back, floor_albedo * (flash_intensity * K + sky_colour * sky[0] * hidden_0).
struct Lights {
  double flash_intensity = 1;                 ///< W/sr in the photographs' radiometric unit
  std::array<double, kSkyTerms> sky{};        ///< sky[0]: ambient radiance; then the terms of sky_basis()
  std::array<double, 3> sky_colour{1, 1, 1};  ///< of the ambient light beside the flash's; green is 1
  bool floor = false;
  double floor_albedo = 0;                    ///< of a floor outside the cloud (optimize/floor.h)
  double bounce = 1;                          ///< factor on the gathered light; 1 within what the transport is good for
  Gloss gloss;                                ///< of all surfaces
};

/// One photograph's view of one surfel.
struct LightSample {
  std::uint32_t group = 0;                    ///< samples of one group share their albedo; sorted by group
  std::uint32_t photograph = 0;
  bool flash_photograph = true;               ///< taken with flash, whether it gets here or not
  std::array<float, 3> radiosity{}, gathered{};
  float flash = 0;                            ///< d
  std::array<float, kSkyTerms> sky{};         ///< T
  std::array<float, kSkyTerms> hidden{};      ///< of T by the floor
  float floor_flash = 0;                      ///< K: d by way of a white floor
  float variance = 0, spread = 0, tan_flash = 0;
  float noise = 0, gradient = 0;              ///< of `variance` the pixel noise alone; relative change of the image, 1/px
  Vec3f lean = Vec3f::Zero();                 ///< change of ln(flash) by a turn of the normal, 1/rad: towards the flash, tan_flash long
  Vec3f flash_by_shift = Vec3f::Zero();       ///< change of ln(flash) by a shift of the flash in camera axes, 1/m
  Vec2f off_axis = Vec2f::Zero(), flash_off_axis = Vec2f::Zero();   ///< optimize/falloff.h: of the camera, of the flash
  float trust = 1;                            ///< extra weight, 0..1 (pairs of unlike chroma)
  GlossAngles angles;
};

/// Something of known albedo.
struct ReferenceSample {
  LightSample sample;
  std::array<double, 3> albedo{};
  double sigma = 0.01;                        ///< relative, of the albedo and its reading together
  double normal_rad = 0.0175;                 ///< by how much its normal may be off
  double unknown_share = 0;                   ///< of its gathered light, what comes from surfaces that no photograph shows
};

struct LightSolveOptions {
  int sky_terms = 1;                          ///< 0, 1, 4 or 9
  bool sky_colour = false;                    ///< red and blue of the sky are unknowns too; needs sky_terms > 0
  bool floor = false;                         ///< there is one, of unknown albedo
  bool gloss = false;                         ///< the surfaces have a coat of unknown reflectance and roughness
  std::optional<double> flash_ln_mean, flash_ln_sd;   ///< prior on ln flash_intensity
  bool flash_is_guess = false;                ///< that prior keeps the scale sane and is no knowledge of it
  std::optional<double> ambient_guess;        ///< prior on sky[0], 35 % wide: where the flash reaches nothing, so that only this holds the scale
  double bounce_mean = 1, bounce_sd = 0.05;   ///< prior on bounce; sd 0 = fixed at the mean
  double information = 1;                     ///< most: share of the samples' information that is independent (pairs overlap)
  double independent_residuals = 2000;        ///< no more of them say something new: what normals, registration and transport get wrong is alike over whole regions
  int max_iterations = 60;
};

struct LightSolution {
  Lights lights;
  int sky_terms = 0;
  bool sky_colour = false;
  Eigen::MatrixXd covariance;                 ///< of (ln flash_intensity, sky[0..sky_terms), ln red and ln blue of the sky if solved, floor_albedo if there is one, ln reflectance and ln roughness of a coat, bounce): sandwich estimate, priors and the common error of gathered light included
  double ambient_open = 0;                    ///< variance of sky[0] beside that: between the sky's mean, its shape and a floor. What arrives at the surfaces is known better, so the albedo does not feel it
  Eigen::MatrixXd outside;                    ///< information of priors and references about the same parameters
  double outside_misfit = 0;                  ///< -ln likelihood of these
  double scatter = 0;                         ///< robust standard deviation of ln albedo between samples of a group
  std::size_t groups = 0, samples = 0;
  int iterations = 0;
  bool converged = false;
  bool scale_known = false;                   ///< a prior or a reference fixed the absolute scale
};

/// The sky's part before its colour, directly and by way of the floor.
double sky_irradiance(const Lights& lights, std::span<const float, kSkyTerms> sky, std::span<const float> hidden);

/// Irradiance of a sample, channel c: of the body below a coat if there is gloss, so that albedo = body_radiosity / irradiance.
double irradiance(const Lights& lights, const LightSample& sample, int c);
/// Of it, before a coat, what does not come straight from the flash.
double other_irradiance(const Lights& lights, const LightSample& sample, int c);
/// What a coat mirrors towards the camera, and the sample's radiosity without it: below_coat().
double mirrored_radiosity(const Lights& lights, const LightSample& sample, int c);
double body_radiosity(const Lights& lights, const LightSample& sample, int c);

/// Base weight of a sample: 1 / variance of ln(B / H) expected from noise, normals, sub-pixel spread and gather noise.
double sample_weight(const Lights& lights, const LightSample& sample);

inline constexpr double kVeryStrong = 10;     ///< of a Bayesian information criterion, twice the logarithm of the evidence: Kass and Raftery, "Bayes factors", 1995

/// -ln likelihood of the samples under `lights`, up to a constant that all lights share: robust, and counting the samples for as many independent residuals as
/// solve_lights() does. Weights and scale are those of `base`, so that two lights can be compared.
double light_misfit(std::span<const LightSample> samples, const LightSolveOptions& options, const Lights& lights, const Lights& base);
/// Independent residuals that the samples count for.
double independent_residuals(std::span<const LightSample> samples, const LightSolveOptions& options);

/// throws Error if there is nothing to solve from (no group with two samples and no reference).
LightSolution solve_lights(std::span<const LightSample> samples, std::span<const ReferenceSample> references, const LightSolveOptions& options, const Lights& start);

}  // namespace chiaro::optimize
