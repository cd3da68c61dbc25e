#include "optimize/gloss.h"

#include <cmath>
#include <numbers>

namespace chiaro::optimize {
namespace {

double grazing(double cosine) {
  const double g = 1 - std::fmin(1.0, std::fmax(0.0, cosine));
  return g * g;
}

}  // namespace

double gloss_lobe(double roughness, const GlossAngles& angles) {
  const double l = static_cast<double>(angles.flash), v = static_cast<double>(angles.camera), h = static_cast<double>(angles.half);
  if (!(l > 0) || !(v > 0)) return 0;
  const double a2 = roughness * roughness, t = 1 + h * h * (a2 - 1);
  const double visible = 0.5 / (l * std::sqrt(v * v * (1 - a2) + a2) + v * std::sqrt(l * l * (1 - a2) + a2));
  return a2 / (t * t) * visible;   // D = a2 / (pi t^2)
}

double gloss_lobe_slope(double roughness, const GlossAngles& angles) {
  constexpr double kStep = 1e-3;
  return (gloss_lobe(roughness * std::exp(kStep), angles) - gloss_lobe(roughness * std::exp(-kStep), angles)) / (2 * kStep);
}

// Both curves: least squares to the single-scattering integral of a rough dielectric of index 1.49.
double coat_transmission(double cosine) { return 1 - 0.3 * grazing(cosine); }
double coat_reflection(double cosine) { return 0.9 + 3 * grazing(cosine); }

CoatFactors coat_factors(const Gloss& gloss, const GlossAngles& angles) {
  if (!gloss.on) return {};
  const double out = coat_transmission(static_cast<double>(angles.camera));
  return {coat_transmission(static_cast<double>(angles.flash)) * out, kMeanTransmission * out, gloss.reflectance * gloss_lobe(gloss.roughness, angles),
          gloss.reflectance * coat_reflection(static_cast<double>(angles.camera))};
}

double below_coat(double radiosity, double mirrored) { return std::fmax(kLeastBody * radiosity, radiosity - mirrored); }

CoatedAlbedo coated_reading(const Gloss& gloss, const GlossAngles& angles, double direct, const std::array<double, 3>& whole, const std::array<double, 3>& radiosity) {
  CoatedAlbedo r;
  const CoatFactors coat = coat_factors(gloss, angles);
  double irradiance = 0, coated = 0, measured = 0, body = 0, mirrored = 0;   // sums over the channels
  for (std::size_t c = 0; c < 3; ++c) {
    const double other = whole[c] - direct, below = coat.direct * direct + coat.other * other, back = coat.direct_mirrored * direct + coat.other_mirrored * other;
    const double b = below_coat(radiosity[c], back);
    if (radiosity[c] > 0 && below > 0) r.factor[c] = b / radiosity[c] * (whole[c] / below);
    irradiance += whole[c];
    coated += below;
    measured += radiosity[c];
    body += b;
    mirrored += back;
  }
  if (!(body > 0) || !(coated > 0)) return r;
  r.noise = measured / body;
  r.direct = irradiance * (coat.direct / coated + coat.direct_mirrored / body);
  r.other = irradiance * (coat.other / coated + coat.other_mirrored / body);
  r.reflectance = mirrored / body;
  r.highlight = coat.direct_mirrored * 3 * direct / body;
  r.roughness = gloss.reflectance * 3 * direct / body * gloss_lobe_slope(gloss.roughness, angles);
  return r;
}

}  // namespace chiaro::optimize
