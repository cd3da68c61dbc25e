#include "optimize/fields.h"

#include <algorithm>
#include <cmath>

namespace chiaro::optimize {

Stencil stencil_at(const Proxy& proxy, const NearestPoints& nearest, const Vec3f& point, const Vec3f& normal) {
  Stencil s;
  std::array<float, kStencil> d2{};
  const std::size_t n = nearest.find(point, kStencil, s.index.data(), d2.data());
  constexpr float kNormalSigma = 0.2f;
  float sum = 0;
  const float reach2 = 0.5f * d2[n - 1] + 1e-20f;
  for (std::size_t j = 0; j < n; ++j) {
    const std::uint32_t i = s.index[j];
    const float off = proxy.normal[i].dot(point - proxy.position[i]) / proxy.radius[i];
    s.weight[j] = std::exp(-(proxy.normal[i] - normal).squaredNorm() / (2 * kNormalSigma * kNormalSigma) - 0.5f * off * off - d2[j] / reach2);
    sum += s.weight[j];
  }
  if (!(sum > 1e-6f)) {
    // No like normal near: the one that is least unlike.
    std::size_t best = 0;
    for (std::size_t j = 1; j < n; ++j)
      if (proxy.normal[s.index[j]].dot(normal) > proxy.normal[s.index[best]].dot(normal) + 0.1f) best = j;
    s.weight.fill(0);
    s.weight[best] = sum = 1;
  }
  for (std::size_t j = 0; j < kStencil; ++j) {
    if (j >= n) s.index[j] = s.index[0];
    s.weight[j] = j < n ? s.weight[j] / sum : 0.0f;
  }
  return s;
}

}  // namespace chiaro::optimize
