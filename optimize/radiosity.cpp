#include "optimize/radiosity.h"

#include <algorithm>
#include <cmath>
#include <numeric>

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

typedef float Four __attribute__((vector_size(16)));   // a GCC and Clang extension

template <std::size_t kFours>
struct Fours {
  Four part[kFours];
  void load(const float* from) { __builtin_memcpy(part, from, sizeof part); }
  void store(float* to) const { __builtin_memcpy(to, part, sizeof part); }
};

/// Of each surfel, the sum over its rays of what stands where they hit.
template <std::size_t kFours>
void sum_hits_of(const Transport& transport, std::span<const std::uint32_t> surfels, const float* values, float* sums) {
  const auto rays = static_cast<std::size_t>(transport.rays);
  parallel_blocks(surfels.size(), 512, [&](std::size_t b, std::size_t e) {
    for (std::size_t u = b; u < e; ++u) {
      const std::size_t i = surfels[u];
      Fours<kFours> sum{}, hit;
      for (std::size_t r = i * rays; r < (i + 1) * rays; ++r) {
        const std::uint32_t j = transport.hits[r];
        if (j == Transport::kSky) continue;
        hit.load(values + j * 4 * kFours);
        for (std::size_t k = 0; k < kFours; ++k) sum.part[k] += hit.part[k];
      }
      sum.store(sums + i * 4 * kFours);
    }
  });
}

template <std::size_t kFours>
void smooth_once(const Smoother& smoother, const float* values, float* out) {
  parallel_blocks(smoother.index.size() / smoother.k, 2048, [&](std::size_t b, std::size_t e) {
    for (std::size_t i = b; i < e; ++i) {
      Fours<kFours> sum{}, near;
      for (std::size_t n = i * smoother.k; n < (i + 1) * smoother.k; ++n) {
        near.load(values + smoother.index[n] * 4 * kFours);
        for (std::size_t k = 0; k < kFours; ++k) sum.part[k] += smoother.weight[n] * near.part[k];
      }
      sum.store(out + i * 4 * kFours);
    }
  });
}

struct Moved {
  double by = 0, sum = 0;
  Moved& operator+=(const Moved& other) {
    by += other.by;
    sum += other.sum;
    return *this;
  }
};

}  // namespace

Completion::Completion(const Transport& transport, const Smoother& smoother, int smooth_passes, std::size_t photographs)
    : transport_(transport), smoother_(smoother), smooth_passes_(smooth_passes), floats_(photographs == 1 ? 4 : 16), radiosity_(make_lines()), gathered_(make_lines()) {}

Completion::Lines Completion::make_lines() const { return Lines((transport_.size() * floats_ + std::size(Line{}.values) - 1) / std::size(Line{}.values)); }

void Completion::add(const Lights& lights, std::span<const float> albedo, const Observation& o) {
  Photograph p{albedo, static_cast<float>(lights.bounce), direct_irradiance(transport_, o.flash, o.floor_flash, lights), {}};
  const std::size_t place = 3 * photographs_.size();
  for (std::size_t i = 0; i < transport_.size(); ++i) {
    std::copy_n(o.radiosity.begin() + static_cast<std::ptrdiff_t>(3 * i), 3, at(radiosity_, i) + place);
    if (!o.seen[i]) p.unseen.push_back(static_cast<std::uint32_t>(i));
    else for (std::size_t c = 0; c < 3; ++c) p.seen_sum += static_cast<double>(o.radiosity[3 * i + c]);
  }
  photographs_.push_back(std::move(p));
}

std::vector<std::uint32_t> Completion::unseen_of_moving() const {
  std::vector<std::uint8_t> wanted(transport_.size(), 0);
  for (const Photograph& p : photographs_)
    if (p.moving)
      for (const std::uint32_t i : p.unseen) wanted[i] = 1;
  std::vector<std::uint32_t> all;
  for (std::size_t i = 0; i < wanted.size(); ++i)
    if (wanted[i]) all.push_back(static_cast<std::uint32_t>(i));
  return all;
}

void Completion::sum_hits(std::span<const std::uint32_t> surfels) {
  (floats_ == 4 ? sum_hits_of<1> : sum_hits_of<4>)(transport_, surfels, at(radiosity_, 0), at(gathered_, 0));
}

/// Unseen surfels of a photograph from what was gathered: a Jacobi step. Returns how far they move.
double Completion::move_unseen(std::size_t photograph, double& sum) {
  const Photograph& p = photographs_[photograph];
  const auto rays = static_cast<float>(transport_.rays);
  const Moved moved = deterministic_sum<Moved>(p.unseen.size(), 2048, Moved{}, [&](std::size_t b, std::size_t e) {
    Moved m;
    for (std::size_t u = b; u < e; ++u) {
      const std::size_t i = p.unseen[u];
      const float* g = at(gathered_, i) + 3 * photograph;
      float* radiosity = at(radiosity_, i) + 3 * photograph;
      for (std::size_t c = 0; c < 3; ++c) {
        const float value = p.albedo[3 * i + c] * (p.direct[3 * i + c] + p.bounce * g[c] / rays);
        m.by += static_cast<double>(std::fabs(value - radiosity[c]));
        m.sum += static_cast<double>(value);
        radiosity[c] = value;
      }
    }
    return m;
  });
  sum = moved.sum;
  return moved.by;
}

void Completion::smooth() {
  Lines out = make_lines();
  for (int pass = 0; pass < smooth_passes_; ++pass) {
    (floats_ == 4 ? smooth_once<1> : smooth_once<4>)(smoother_, at(gathered_, 0), at(out, 0));
    gathered_.swap(out);
  }
}

void Completion::solve(int max_sweeps, double tolerance) {
  for (int sweep = 0; sweep < max_sweeps; ++sweep) {
    const std::vector<std::uint32_t> unseen = unseen_of_moving();
    sum_hits(unseen);
    for (std::size_t k = 0; k < photographs_.size(); ++k) {
      Photograph& p = photographs_[k];
      if (!p.moving) continue;
      double sum = 0;
      const double moved = move_unseen(k, sum);
      p.moving = moved > tolerance * (sum + p.seen_sum);
      ++p.sweeps;
    }
    if (std::none_of(photographs_.begin(), photographs_.end(), [](const Photograph& p) { return p.moving; })) break;
  }
  for (Photograph& p : photographs_) p.direct = {};
  std::vector<std::uint32_t> all(transport_.size());
  std::iota(all.begin(), all.end(), 0u);
  sum_hits(all);
  const auto rays = static_cast<float>(transport_.rays);
  for (Line& line : gathered_)
    for (float& v : line.values) v /= rays;
  smooth();
}

void Completion::take_unseen(std::size_t photograph, Observation& o) const {
  for (const std::uint32_t i : photographs_[photograph].unseen) std::copy_n(at(radiosity_, i) + 3 * photograph, 3, o.radiosity.begin() + 3 * static_cast<std::ptrdiff_t>(i));
}

std::vector<float> Completion::gathered(std::size_t photograph) const {
  std::vector<float> g(3 * transport_.size());
  for (std::size_t i = 0; i < transport_.size(); ++i) std::copy_n(at(gathered_, i) + 3 * photograph, 3, g.begin() + static_cast<std::ptrdiff_t>(3 * i));
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
