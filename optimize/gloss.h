/// A glossy surface: a body that scatters like Lambert's below a rough, clear coat (glaze, varnish, wax, polish; physics.md E.3). The coat mirrors a part of the light
/// towards the half way direction, and lets less of the rest through to the body and out again the more it grazes.
#pragma once
#include <array>

namespace chiaro::optimize {

/// What one acquisition's surfaces have in common.
struct Gloss {
  bool on = false;            ///< off: Lambert's surfaces
  double reflectance = 0.04;  ///< of the coat along the normal; its index is taken as 1.5, where this is 0.04
  double roughness = 0.25;    ///< GGX alpha
};

/// Cosines between the normal and flash, camera, and the direction half way between the two.
struct GlossAngles {
  float flash = 0, camera = 0, half = 0;
};

/// Radiosity towards the camera per unit of the flash's irradiance that a coat of reflectance 1 adds: pi D V, GGX with the height-correlated shadowing of Smith. Flash and
/// camera stand close together, so that Fresnel's factor is the one of the normal and part of the reflectance. 0 where flash or camera is below the horizon.
/// source: Heitz, "Understanding the Masking-Shadowing Function in Microfacet-Based BRDFs", JCGT 2014.
double gloss_lobe(double roughness, const GlossAngles& angles);
/// Its derivative by ln roughness.
double gloss_lobe_slope(double roughness, const GlossAngles& angles);

/// Share of the light from (or to) one direction that passes the coat, beside that along the normal; and its mean over the hemisphere. Within 0.02 of the microfacet
/// integral for roughness 0.15 to 0.4 up to 75 degrees (tests/optimize/gloss_test.cpp).
double coat_transmission(double cosine);
inline constexpr double kMeanTransmission = 0.95;
/// Share of the light from one direction that the coat sends back, over its reflectance (the integral for roughness 0.3); and its mean over the hemisphere.
double coat_reflection(double cosine);
inline constexpr double kMeanReflection = 1.4;

/// What a coat makes of the light that falls on a surface: radiosity towards the camera = albedo (direct E + other O) + direct_mirrored E + other_mirrored O, where E comes
/// from the flash and O from all around. The albedo is the body's for light and view along the normal.
struct CoatFactors {
  double direct = 1, other = 1, direct_mirrored = 0, other_mirrored = 0;
};
CoatFactors coat_factors(const Gloss& gloss, const GlossAngles& angles);

/// What is left of a radiosity below a coat that mirrors so much of it: at least a quarter, as highlights are not known better.
inline constexpr double kLeastBody = 0.25;
double below_coat(double radiosity, double mirrored);

/// Relative deviation of what is mirrored of the flash: normals, and a roughness that is not the same everywhere.
inline constexpr double kHighlightSd = 0.2;

/// What a coat does to the albedo of a pixel beside Lambert's radiosity / irradiance.
struct CoatedAlbedo {
  std::array<double, 3> factor{1, 1, 1};
  double noise = 1;                          ///< factor on the relative deviation
  double direct = 1, other = 1;              ///< factors on how ln albedo falls with either light
  double reflectance = 0, roughness = 0;     ///< how ln albedo falls with the logarithms of these
  double highlight = 0;                      ///< of the flash, over the body's radiosity
};

/// direct: irradiance by the flash; whole: of each channel, with it; radiosity: as measured. All before the coat.
CoatedAlbedo coated_reading(const Gloss& gloss, const GlossAngles& angles, double direct, const std::array<double, 3>& whole, const std::array<double, 3>& radiosity);

}  // namespace chiaro::optimize
