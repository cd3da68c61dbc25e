/// What a pixel of a photograph is worth: one small named function a criterion, the weight of a pixel is their product.
///
/// Adding a criterion is one function here and one line in kCriteria: the blend multiplies what stands there, the report shows a picture of each.
/// Focus counts where the project says what the lens was set to. Measured sharpness would prefer highlights, noise and edges of flash shadows to the surface.
/// The quality of a pixel is its own: sigma and the spread of the light change from pixel to pixel, and smoothing them over the surface let pixels on
/// shadow edges pass for good ones (measured on a rendered tower: error 3.5 -> 3.3 %). Ramps are smooth by construction and reach zero at what they avoid.
/// Only ratios between photographs matter: the weights of a surfel are normalised by their sum.
#pragma once
#include <algorithm>
#include <array>
#include <cmath>
#include <string_view>
#include <utility>

#include "stream/photo/camera.h"

namespace chiaro::blend {

/// 0 at a distance of 0, 1 from `width` on, with zero slope at both ends.
inline float smooth_ramp(float distance, float width) {
  if (!(distance > 0)) return 0;
  const float t = std::min(1.0f, distance / width);
  return t * t * (3 - 2 * t);
}

/// Viewing angle: the cosine between normal and view. Grazing views smear the pixel along the surface and magnify every registration error;
/// beyond 79 degrees they are not used (measured on a rendered scene with exact geometry: error 6 % there, 0.5 % below).
inline constexpr float kLeastViewCos = 0.19f;
inline float angle_weight(float cosv) {
  const float c = std::clamp(cosv, 0.0f, 1.0f);
  return c * c * smooth_ramp(c - kLeastViewCos, kLeastViewCos);
}

/// Resolution: samples a unit of area, relative to `reference` (a typical footprint, same unit). Held within 1e-4 .. 1e4.
inline float footprint_weight(float footprint, float reference) {
  if (!(footprint > 0)) return 0;
  const float ratio = reference / footprint;
  return std::clamp(ratio * ratio, 1e-4f, 1e4f);
}

/// Focus: out of focus a pixel stands for a larger spot. blur_px: diameter of the lens's blur, 0 where it is not known.
inline float focus_weight(float blur_px) { return stream::focus_share(std::max(blur_px, 0.0f)); }

/// Confidence of the albedo: inverse variance, levelled off below 2 % where other errors take over. sigma is relative; not finite counts as 1.
inline float sigma_weight(float sigma) {
  constexpr float kFloor = 0.02f;
  const float s = std::isfinite(sigma) ? std::max(sigma, 0.0f) : 1.0f;
  return kFloor * kFloor / (kFloor * kFloor + s * s);
}

/// Flash incidence: where the irradiance varies inside the pixel (grazing light, cast-shadow edges), the division by it is uncertain.
/// spread: standard deviation over mean of the irradiance in the pixel; 0 without a flash.
inline float incidence_weight(float spread) {
  constexpr float kScale = 0.1f;
  const float s = std::isfinite(spread) ? std::max(spread, 0.0f) / kScale : 10.0f;
  return 1 / (1 + s * s);
}

/// Silhouettes, holes and the image border: distance in pixels, as the G-buffer's plane `edge`. The pixels beside an edge mix two surfaces (by their
/// own footprint and the lens's blur) and are not used.
inline constexpr float kMixedPixels = 1;
inline float edge_weight(float edge_px, float border_px) { return smooth_ramp(edge_px - kMixedPixels, border_px); }

/// The mask's border: distance in pixels to the nearest pixel that must not be used.
inline float mask_weight(float distance_px, float border_px) { return smooth_ramp(distance_px, border_px); }

/// Saturated pixels: light bleeds into their surroundings. distance in pixels.
inline float saturation_weight(float distance_px, float border_px) { return smooth_ramp(distance_px, border_px); }

/// Share of the pixel that is surface. Below `kMinCoverage` the pixel shows something else too and is not used.
inline constexpr float kMinCoverage = 0.93f;
inline float coverage_weight(float coverage) { return coverage >= kMinCoverage ? std::min(coverage, 1.0f) : 0.0f; }

/// Glow around saturated pixels is narrower than the doubt about where masks and silhouettes lie.
inline float saturation_ramp_px(float border_px) { return std::max(2.0f, 0.25f * border_px); }

/// What the criteria are told of a pixel. cosv is the mean over the surface around it: noise of normals must not decide who is beyond the limit.
struct PixelEvidence {
  float footprint = 0, blur_px = 0, sigma = 0, spread = 0, coverage = 0;
  float cosv = 0, edge_px = 0, mask_px = 0, saturated_px = 0;   ///< of its surroundings: lengths are distances in pixels; edge_px from the rim of the blur
};

/// What they are measured against.
struct WeightScale {
  float footprint = 1;    ///< project units; a typical one
  float border_px = 12;
};

struct Criterion {
  std::string_view name, bright;   ///< of its picture, and what bright means there
  bool needs_surroundings = false;
  bool is_ratio = false;           ///< around 1 and to both sides of it; the others lie in 0 .. 1
  float (*worth)(const PixelEvidence&, const WeightScale&) = nullptr;
};

/// All criteria, in the order in which they are multiplied.
inline constexpr std::array kCriteria{
    Criterion{"Resolution", "pixels that are small on the surface; half of the scale: as small as the typical pixel of all photographs", false, true,
              [](const PixelEvidence& e, const WeightScale& s) { return footprint_weight(e.footprint, s.footprint); }},
    Criterion{"Focus", "in focus (everywhere, where the project does not say what the lens was set to)", false, false, [](const PixelEvidence& e, const WeightScale&) { return focus_weight(e.blur_px); }},
    Criterion{"Confidence", "a small standard deviation of the albedo (1/sigma²)", false, false, [](const PixelEvidence& e, const WeightScale&) { return sigma_weight(e.sigma); }},
    Criterion{"Flash incidence", "even light in the pixel: no grazing flash, no edge of a cast shadow", false, false, [](const PixelEvidence& e, const WeightScale&) { return incidence_weight(e.spread); }},
    Criterion{"Coverage", "the pixel shows the surface and nothing beside it", false, false, [](const PixelEvidence& e, const WeightScale&) { return coverage_weight(e.coverage); }},
    Criterion{"Silhouettes and image border", "far from them", true, false, [](const PixelEvidence& e, const WeightScale& s) { return edge_weight(e.edge_px, s.border_px); }},
    Criterion{"Mask", "far from what the mask leaves out", true, false, [](const PixelEvidence& e, const WeightScale& s) { return mask_weight(e.mask_px, s.border_px); }},
    Criterion{"Saturation", "far from saturated pixels", true, false, [](const PixelEvidence& e, const WeightScale& s) { return saturation_weight(e.saturated_px, saturation_ramp_px(s.border_px)); }},
    Criterion{"Viewing angle", "seen from the front", true, false, [](const PixelEvidence& e, const WeightScale&) { return angle_weight(e.cosv); }},
};

template <bool kSurroundings, std::size_t... kIndex>
inline float product_of_criteria(const PixelEvidence& e, const WeightScale& s, std::index_sequence<kIndex...>) {
  float product = 1;
  const auto times = [&]<std::size_t kOne>() {
    if constexpr (kCriteria[kOne].needs_surroundings == kSurroundings) product *= kCriteria[kOne].worth(e, s);
  };
  (times.template operator()<kIndex>(), ...);
  return product;
}

/// Product of the criteria that need no surroundings.
inline float pixel_quality(const PixelEvidence& e, const WeightScale& s) { return product_of_criteria<false>(e, s, std::make_index_sequence<kCriteria.size()>()); }
/// Product of those that do.
inline float surroundings_quality(const PixelEvidence& e, const WeightScale& s) { return product_of_criteria<true>(e, s, std::make_index_sequence<kCriteria.size()>()); }

}  // namespace chiaro::blend
