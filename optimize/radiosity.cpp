#include "optimize/radiosity.h"

#include <algorithm>
#include <cmath>

#include "stream/base/parallel.h"

namespace chiaro::optimize {

std::vector<float> direct_irradiance(const Transport& transport, std::span<const float> flash, std::span<const float> floor_flash, const Lights& lights) {
  const bool floor = lights.floor && !floor_flash.empty();
  std::vector<float> e(3 * transport.size());
  parallel_blocks(transport.size(), 8192, [&](std::size_t b, std::size_t end) {
    for (std::size_t i = b; i < end; ++i) {
      const std::span<const float> hidden = transport.hidden.empty() ? std::span<const float>() : std::span<const float>(transport.hidden).subspan(i * kSkyTerms, kSkyTerms);
      const double sky = sky_irradiance(lights, std::span<const float, kSkyTerms>(transport.sky.data() + i * kSkyTerms, kSkyTerms), hidden);
      const double lit = static_cast<double>(flash[i]) + (floor ? lights.floor_albedo * static_cast<double>(floor_flash[i]) : 0.0);
      for (std::size_t c = 0; c < 3; ++c) e[3 * i + c] = static_cast<float>(lights.flash_intensity * lit + lights.sky_colour[c] * std::max(0.0, sky));
    }
  });
  return e;
}

namespace {

/// One Jacobi sweep over the unseen surfels: `next` (3 values each) from what o.radiosity holds. Returns how far they move, and their sum.
std::pair<double, double> sweep_unseen(const Transport& transport, std::span<const std::uint32_t> unseen, std::span<const float> albedo, std::span<const float> direct, float bounce,
                                       const Observation& o, std::vector<float>& next) {
  const auto rays = static_cast<std::size_t>(transport.rays);
  struct Moved {
    double by = 0, sum = 0;
    Moved& operator+=(const Moved& other) {
      by += other.by;
      sum += other.sum;
      return *this;
    }
  };
  const Moved moved = deterministic_sum<Moved>(unseen.size(), 2048, Moved{}, [&](std::size_t b, std::size_t e) {
    Moved m;
    for (std::size_t u = b; u < e; ++u) {
      const std::size_t i = unseen[u];
      float g[3] = {0, 0, 0};
      for (std::size_t r = i * rays; r < (i + 1) * rays; ++r) {
        const std::uint32_t j = transport.hits[r];
        if (j == Transport::kSky) continue;
        for (std::size_t c = 0; c < 3; ++c) g[c] += o.radiosity[3 * j + c];
      }
      for (std::size_t c = 0; c < 3; ++c) {
        const float value = albedo[3 * i + c] * (direct[3 * i + c] + bounce * g[c] / static_cast<float>(rays));
        m.by += static_cast<double>(std::fabs(value - o.radiosity[3 * i + c]));
        m.sum += static_cast<double>(value);
        next[3 * u + c] = value;
      }
    }
    return m;
  });
  return {moved.by, moved.sum};
}

}  // namespace

std::vector<float> complete_radiosity(const Transport& transport, const Smoother& smoother, int smooth_passes, const Lights& lights, std::span<const float> albedo,
                                      Observation& o, int max_sweeps, double tolerance, int* sweeps) {
  const std::vector<float> direct = direct_irradiance(transport, o.flash, o.floor_flash, lights);
  std::vector<std::uint32_t> unseen;
  double seen_sum = 0;
  for (std::size_t i = 0; i < transport.size(); ++i) {
    if (!o.seen[i]) unseen.push_back(static_cast<std::uint32_t>(i));
    else for (std::size_t c = 0; c < 3; ++c) seen_sum += static_cast<double>(o.radiosity[3 * i + c]);
  }
  std::vector<float> next(3 * unseen.size());
  int sweep = 0;
  for (bool moving = true; moving && sweep < max_sweeps; ++sweep) {
    const auto [moved, sum] = sweep_unseen(transport, unseen, albedo, direct, static_cast<float>(lights.bounce), o, next);
    for (std::size_t u = 0; u < unseen.size(); ++u) std::copy_n(next.begin() + static_cast<std::ptrdiff_t>(3 * u), 3, o.radiosity.begin() + 3 * static_cast<std::ptrdiff_t>(unseen[u]));
    moving = moved > tolerance * (sum + seen_sum);
  }
  std::vector<float> g;
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
        for (std::size_t c = 3 * i; c < 3 * i + 3; ++c) b[c] = albedo[c] * (direct[c] + static_cast<float>(bounce) * g[c]);
    });
  }
  return b;
}

}  // namespace chiaro::optimize
