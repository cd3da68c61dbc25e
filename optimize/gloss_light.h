/// Gloss on the proxy: under which angles a photograph sees its surfels, and what they send to each other.
#pragma once
#include <cstdint>
#include <optional>
#include <span>
#include <vector>

#include "optimize/gather.h"
#include "optimize/light_solve.h"
#include "optimize/observe.h"

namespace chiaro::optimize {

/// Where a photograph was taken from, and where its flash stood; scene frame of the proxy.
struct Viewpoint {
  Vec3f camera = Vec3f::Zero();
  std::optional<Vec3f> flash;
};

/// Without a flash its cosines are 0.
GlossAngles gloss_angles(const Vec3f& place, const Vec3f& normal, const Viewpoint& from);

/// A camera beside the flash sees more highlights and less of what grazes than the other surfaces do: puts the mean over all directions in place of the radiosity of the
/// seen surfels. Highlights are spread evenly, as bounces stay diffuse. Returns what stood there before, all 3 N.
///
/// gathered     G of the photograph, 3 N, as known so far.
std::vector<float> send_out(const Proxy& proxy, const Transport& transport, const Viewpoint& from, const std::vector<float>& gathered, const Lights& lights, Observation& o);

/// Share of the light from all around that a coated surface sends back to all around, from its albedo.
std::vector<float> coated_albedo(const Gloss& gloss, std::vector<float> albedo);

/// Bayesian information criterion of a coat over all surfaces beside none: 2 ln likelihood ratio and ln(independent residuals) for each parameter; below 0 speaks for it.
/// plain: options of the solution without a coat.
double gloss_criterion(std::span<const LightSample> samples, const LightSolveOptions& plain, const Lights& without, const Lights& coated);

}  // namespace chiaro::optimize
