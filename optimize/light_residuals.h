/// How photographs disagree under given lights: log ratios of surfels seen several times, their albedo eliminated (light_solve.h).
#pragma once
#include <span>
#include <utility>
#include <vector>

#include "optimize/light_solve.h"

namespace chiaro::optimize {

inline constexpr int kMaxLightParameters = kSkyTerms + 7;
using LightVector = Eigen::Matrix<double, kMaxLightParameters, 1>;
using LightMatrix = Eigen::Matrix<double, kMaxLightParameters, kMaxLightParameters>;

/// Parameters: 0 = ln flash, 1 .. sky_terms = sky, then ln red and ln blue of the sky if they are solved, the floor's albedo if there is one, ln reflectance and ln
/// roughness of a coat if there is one, last = bounce.
struct LightLayout {
  int sky_terms;
  bool coloured, floor, gloss;
  int red() const { return sky_terms + 1; }
  int blue() const { return sky_terms + 2; }
  int floor_albedo() const { return sky_terms + (coloured ? 3 : 1); }
  int reflectance() const { return floor_albedo() + (floor ? 1 : 0); }
  int roughness() const { return reflectance() + 1; }
  int bounce() const { return reflectance() + (gloss ? 2 : 0); }
  int size() const { return bounce() + 1; }
};

LightLayout layout_of(const LightSolveOptions& options);

/// Samples [begin, end) that share their albedo.
struct SampleGroup {
  std::size_t begin, end;
};
/// Groups of two samples or more.
std::vector<SampleGroup> groups_of(std::span<const LightSample> samples);
/// Of all channels, albedos eliminated.
double residuals_of(std::span<const SampleGroup> groups);

/// Of ln(B/H) by the parameters, where H is h; with a coat, of ln(B / (albedo H + mirrored)).
LightVector light_derivative(const Lights& lights, const LightSample& sample, int c, const LightLayout& layout, double h, double albedo);

/// One group, one channel: residuals with the shared log albedo removed.
struct Deviations {
  std::vector<std::uint32_t> sample;          ///< of each residual: its place among the samples; those that say nothing have none
  std::vector<double> r, w, robust, shadow;   ///< robust: factor on w in the mean. shadow: share of the gathered light where it prevails, else 0
  std::vector<LightVector> j;
  double mean_r = 0;
  LightVector mean_j = LightVector::Zero();
};

/// weigh: the lights that the weights belong to; held still while steps are compared, since a step could lower the objective by lowering weights alone.
/// with_derivatives false: j, mean_j and shadow stay empty.
bool deviations(const Lights& lights, const Lights& weigh, std::span<const LightSample> samples, int c, const LightLayout& layout, double cauchy_scale, bool with_derivatives, Deviations& d);

/// Robust scale of the weighted deviations, and of the plain ones.
std::pair<double, double> robust_scale(const Lights& lights, std::span<const LightSample> samples, std::span<const SampleGroup> groups, const LightLayout& layout);

inline constexpr double kCauchy = 2.385;   ///< robust scales: 95 % efficiency for normal residuals (Holland & Welsch 1977)
/// Of Cauchy's weights, for the weighted deviations.
double cauchy_scale(const Lights& lights, std::span<const LightSample> samples, std::span<const SampleGroup> groups, const LightLayout& layout);
/// By how much residuals exceed what their weights expect; squared deviations, at least 1. The excess is the model's: the samples say that much less, and as much fewer of them are independent.
double dispersion_of(double cauchy_scale);

/// The upper one of an even number; 0 of none.
double upper_median(std::vector<double> values);

}  // namespace chiaro::optimize
