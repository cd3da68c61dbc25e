#include "optimize/light_step.h"

#include <algorithm>
#include <cmath>

namespace chiaro::optimize {

LightStep light_step(const Lights& from, const Lights& to) {
  LightStep v;
  v[0] = std::log(to.flash_intensity / from.flash_intensity);
  for (std::size_t k = 0; k < kSkyTerms; ++k)
    v[1 + static_cast<Eigen::Index>(k)] = to.sky[k] / to.flash_intensity - from.sky[k] / from.flash_intensity;
  v[kSkyTerms + 1] = to.sky_colour[0] - from.sky_colour[0];
  v[kSkyTerms + 2] = to.sky_colour[2] - from.sky_colour[2];
  v[kSkyTerms + 3] = to.bounce - from.bounce;
  v[kSkyTerms + 4] = to.floor_albedo - from.floor_albedo;
  return v;
}

double light_change(const Lights& a, const Lights& b) {
  return std::fabs(std::log(b.flash_intensity / a.flash_intensity)) + std::fabs(b.bounce - a.bounce) + std::fabs(b.floor_albedo - a.floor_albedo) + std::fabs(b.sky_colour[0] - a.sky_colour[0]) + std::fabs(b.sky_colour[2] - a.sky_colour[2]) +
         std::fabs(b.sky[0] - a.sky[0]) / std::max(1e-9, b.sky[0] + 0.01 * b.flash_intensity);
}

void Relaxation::observe(const LightStep& step) {
  if (const double squares = last_.squaredNorm(); squares > 0) share_ = std::clamp(share_ / std::max(1e-9, 1 - step.dot(last_) / squares), kLeast, 1.0);
  last_ = step;
}

}  // namespace chiaro::optimize
