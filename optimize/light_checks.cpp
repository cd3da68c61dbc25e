#include "optimize/light_checks.h"

#include <algorithm>
#include <cmath>

#include "stream/base/error.h"

namespace chiaro::optimize {
namespace {

constexpr double kBrightest = 0.95, kBrightestAlbedo = 0.8;
constexpr double kContradiction = 2.5;    ///< deviations: one run in eighty with a right range
constexpr double kDisagree = 0.15;        ///< of ln albedo between photographs: 0.01 to 0.03 on seven scenes, 0.38 to 0.70 with cameras of another scale or focal length, or a cloud in two units
constexpr double kFaint = 0.02;           ///< share of the light below which a flash might as well not have fired

double quantile(std::vector<double>& v, double share) {
  if (v.empty()) return 0;
  const auto at = v.begin() + static_cast<std::ptrdiff_t>(share * static_cast<double>(v.size() - 1));
  std::nth_element(v.begin(), at, v.end());
  return *at;
}

/// Share of the flash in the light of the samples that it lights most.
double largest_flash_share(std::span<const LightSample> samples, const Lights& lights) {
  std::vector<double> shares;
  for (const LightSample& s : samples)
    if (const double h = irradiance(lights, s, 1); s.flash_photograph && h > 0) shares.push_back(lights.flash_intensity * static_cast<double>(s.flash) / h);
  return quantile(shares, kBrightest);
}

std::string per_cent(double relative) { return concat(static_cast<int>(std::lround(100 * relative)), " %"); }

/// Three digits: concat() writes as many as there are.
std::string number(double v) {
  if (!(v > 0)) return "0";
  const double step = std::pow(10.0, std::floor(std::log10(v)) - 2);
  return concat(std::round(v / step) * step);
}

}  // namespace

bool flash_reaches(std::span<const LightSample> samples) {
  return std::any_of(samples.begin(), samples.end(), [](const LightSample& s) { return s.flash_photograph && s.flash > 0; });
}

double guess_ambient(std::span<const LightSample> samples) {
  std::vector<double> ratios;
  for (const LightSample& s : samples)
    if (const float b = std::max({s.radiosity[0], s.radiosity[1], s.radiosity[2]}); s.sky[0] > 0 && b > 0) ratios.push_back(static_cast<double>(b) / static_cast<double>(s.sky[0]));
  return quantile(ratios, kBrightest) / kBrightestAlbedo;
}

RangeEvidence range_evidence(const std::array<double, 2>& intensity_range, const LightSolution& solution) {
  const double prior = 0.5 * (std::log(intensity_range[0]) + std::log(intensity_range[1])), prior_sd = std::max(1e-4, 0.25 * std::log(intensity_range[1] / intensity_range[0]));
  const double found = std::log(solution.lights.flash_intensity), v0 = prior_sd * prior_sd, v = solution.covariance.rows() > 0 ? solution.covariance(0, 0) : v0;
  RangeEvidence e;
  constexpr double kSaysNothing = 0.98;
  if (!(v < kSaysNothing * v0)) {
    // The photographs say nothing about the scale, or all they say is that no surface is whiter than white.
    e.deviations = (found - prior) / prior_sd;
    return e;
  }
  e.deviations = (found - prior) / std::sqrt(v0 - v);
  const double w = 1 / v - 1 / v0;
  e.ln_flash = (found / v - prior / v0) / w;
  e.sd = 1 / std::sqrt(w);
  return e;
}

std::vector<std::string> light_notes(const AcquisitionInput& input, std::span<const LightSample> samples, const LightSolution& solution, const std::string& who, bool alone, bool lit) {
  std::vector<std::string> notes;
  const double flash_sd = std::sqrt(std::max(0.0, solution.covariance(0, 0)));
  if (!lit) {
    notes.push_back(concat(who, ": the flash reaches nothing that is seen: albedo is known up to one factor, by the guess that the brightest surfaces reflect ", per_cent(kBrightestAlbedo)));
    return notes;
  }
  if (const double share = largest_flash_share(samples, solution.lights); share < kFaint)
    notes.push_back(concat(who, ": the flash gives less than ", per_cent(kFaint), " of the light by what the photographs show, where it should give more: did it fire? The scale of the albedo is not to be trusted"));
  if (!alone && solution.scatter > kDisagree)
    notes.push_back(concat(who, ": the albedo is not to be trusted: where two photographs show the same place they differ by ", per_cent(solution.scatter),
                           " (median), where a few per cent are usual. Are the cameras those of this cloud (its frame, its unit and scale, the focal length and size of these photographs), and are all clouds in one unit? Surfaces that shine like metal differ so, too"));
  if (!solution.scale_known)
    notes.push_back(concat(who, ": the flash has no calibrated range and nothing of known albedo is seen: albedo is known up to one factor (flash known to ", per_cent(flash_sd), ")"));
  if (alone)
    notes.push_back(concat(who, ": one photograph does not tell light from albedo by itself: flash known to ", per_cent(flash_sd), ", ambient light to ",
                           solution.sky_terms > 0 && solution.lights.sky[0] > 0 ? per_cent(std::sqrt(std::max(0.0, solution.covariance(1, 1))) / solution.lights.sky[0]) : std::string("nothing"),
                           ", from places of like colour"));
  if (!input.intensity_range) return notes;
  if (const RangeEvidence e = range_evidence(*input.intensity_range, solution); std::fabs(e.deviations) > kContradiction) {
    const std::string says = e.sd > 0 ? concat("by themselves they say ", number(std::exp(e.ln_flash)), " W/sr +- ", per_cent(e.sd)) : concat("they want ", number(solution.lights.flash_intensity), " W/sr or more");
    notes.push_back(concat(who, ": the photographs speak against the flash's calibrated range of ", number((*input.intensity_range)[0]), " to ", number((*input.intensity_range)[1]), " W/sr (", number(std::fabs(e.deviations)),
                           " deviations; ", says, "): range, flash position, normals or a reference are off"));
  }
  return notes;
}

}  // namespace chiaro::optimize
