#include "optimize/radiosity.h"

#include <algorithm>
#include <cmath>

#include "stream/base/parallel.h"

namespace chiaro::optimize {

std::vector<float> direct_irradiance(const Transport& transport, std::span<const float> flash, const Lights& lights) {
  std::vector<float> e(transport.size());
  parallel_blocks(e.size(), 8192, [&](std::size_t b, std::size_t end) {
    for (std::size_t i = b; i < end; ++i) {
      double sky = 0;
      for (std::size_t k = 0; k < kSkyTerms; ++k) sky += lights.sky[k] * static_cast<double>(transport.sky[i * kSkyTerms + k]);
      e[i] = static_cast<float>(lights.flash_intensity * static_cast<double>(flash[i]) + std::max(0.0, sky));
    }
  });
  return e;
}

std::vector<float> complete_radiosity(const Transport& transport, const Smoother& smoother, int smooth_passes, const Lights& lights, std::span<const float> albedo,
                                      Observation& o, int max_sweeps, double tolerance, int* sweeps) {
  const std::size_t n = transport.size();
  const std::vector<float> direct = direct_irradiance(transport, o.flash, lights);
  const float bounce = static_cast<float>(lights.bounce);
  std::vector<float> g;
  int sweep = 0;
  constexpr std::size_t kGrain = 8192;
  for (; sweep < max_sweeps; ++sweep) {
    gather_radiosity(transport, o.radiosity, g);
    std::vector<double> moved((n + kGrain - 1) / kGrain, 0.0), total(moved.size(), 0.0);
    parallel_blocks(n, kGrain, [&](std::size_t b, std::size_t e) {
      double m = 0, t = 0;
      for (std::size_t i = b; i < e; ++i)
        for (std::size_t c = 3 * i; c < 3 * i + 3; ++c) {
          t += static_cast<double>(o.radiosity[c]);
          if (o.seen[i]) continue;
          const float value = albedo[c] * (direct[i] + bounce * g[c]);
          m += static_cast<double>(std::fabs(value - o.radiosity[c]));
          o.radiosity[c] = value;
        }
      moved[b / kGrain] = m;
      total[b / kGrain] = t;
    });
    double m = 0, t = 0;
    for (std::size_t k = 0; k < moved.size(); ++k) {
      m += moved[k];
      t += total[k];
    }
    if (m <= tolerance * t) {
      ++sweep;
      break;
    }
  }
  gather_radiosity(transport, o.radiosity, g);
  smoother.apply(g, 3, smooth_passes);
  if (sweeps) *sweeps = sweep;
  return g;
}

std::vector<float> forward_radiosity(const Transport& transport, std::span<const float> albedo, std::span<const float> direct, double bounce, int scatterings) {
  const std::size_t n = transport.size();
  std::vector<float> b(3 * n, 0.0f), g(3 * n, 0.0f);
  for (int k = 0; k < scatterings; ++k) {
    if (k > 0) gather_radiosity(transport, b, g);
    parallel_blocks(n, 8192, [&](std::size_t first, std::size_t end) {
      for (std::size_t i = first; i < end; ++i)
        for (std::size_t c = 3 * i; c < 3 * i + 3; ++c) b[c] = albedo[c] * (direct[i] + static_cast<float>(bounce) * g[c]);
    });
  }
  return b;
}

}  // namespace chiaro::optimize
