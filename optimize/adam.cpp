#include "optimize/adam.h"

#include <algorithm>
#include <cmath>
#include <numbers>

#include "optimize/radiosity.h"
#include "stream/base/parallel.h"

namespace chiaro::optimize {
namespace {

constexpr double kPi = std::numbers::pi;
constexpr std::size_t kGrain = 8192;

/// Moments of one parameter vector.
struct Moments {
  std::vector<float> first, second;
};

void adam_step(std::span<float> x, std::span<const float> gradient, Moments& m, const AdamOptions& o, int step) {
  if (m.first.empty()) m = {std::vector<float>(x.size(), 0.0f), std::vector<float>(x.size(), 0.0f)};
  const double c1 = 1 - std::pow(o.beta1, step), c2 = 1 - std::pow(o.beta2, step);
  parallel_blocks(x.size(), kGrain, [&](std::size_t b, std::size_t e) {
    for (std::size_t i = b; i < e; ++i) {
      const double g = static_cast<double>(gradient[i]);
      const double first = o.beta1 * static_cast<double>(m.first[i]) + (1 - o.beta1) * g, second = o.beta2 * static_cast<double>(m.second[i]) + (1 - o.beta2) * g * g;
      m.first[i] = static_cast<float>(first);
      m.second[i] = static_cast<float>(second);
      x[i] -= static_cast<float>(o.rate * (first / c1) / (std::sqrt(second / c2) + o.epsilon));
    }
  });
}

class Optimiser {
 public:
  Optimiser(const Transport& transport, const Observation& o, const AdamOptions& options, bool flash_free)
      : transport_(transport), observation_(o), options_(options), flash_free_(flash_free) {}

  double iterate(AdamState& x, const std::array<double, 2>& range, int iterations, Reporter& report) {
    double loss = 0;
    for (int i = 0; i < iterations; ++i) {
      report.check();
      AdamGradient g;
      loss = adam_loss(transport_, observation_, x, options_.scatterings, &g);
      ++step_;
      adam_step(x.albedo, g.albedo, albedo_, options_, step_);
      // The scalars wander through the same code as one-element vectors.
      scalar(x.ambient, g.ambient, ambient_);
      x.ambient = std::clamp(x.ambient, 0.0, 1.0);
      if (flash_free_) {
        scalar(x.flash_intensity, g.flash_intensity, flash_);
        x.flash_intensity = std::clamp(x.flash_intensity, range[0], range[1]);
      }
      for (float& a : x.albedo) a = std::clamp(a, 0.0f, 1.0f);
    }
    return loss;
  }

 private:
  void scalar(double& value, double gradient, Moments& m) const {
    float v = static_cast<float>(value);
    const float g = static_cast<float>(gradient);
    adam_step({&v, 1}, {&g, 1}, m, options_, step_);
    value = static_cast<double>(v);
  }

  const Transport& transport_;
  const Observation& observation_;
  const AdamOptions& options_;
  const bool flash_free_;
  int step_ = 0;
  Moments albedo_, ambient_, flash_;
};

/// The paper starts from the projected photograph.
AdamState start_state(const Transport& transport, const Observation& o, double flash) {
  AdamState x;
  x.flash_intensity = flash;
  x.albedo.assign(3 * transport.size(), 0.5f);
  for (std::size_t i = 0; i < transport.size(); ++i)
    if (o.seen[i])
      for (std::size_t c = 3 * i; c < 3 * i + 3; ++c) x.albedo[c] = std::clamp(o.radiosity[c] / static_cast<float>(kPi), 0.0f, 1.0f);
  return x;
}

}  // namespace

double adam_loss(const Transport& transport, const Observation& o, const AdamState& x, int scatterings, AdamGradient* gradient) {
  const std::size_t n = transport.size();
  Lights lights;
  lights.flash_intensity = x.flash_intensity;
  lights.sky[0] = x.ambient;
  const std::vector<float> direct = direct_irradiance(transport, o.flash, {}, lights);
  // Series B_k = rho (E + F B_{k-1}); the adjoint walks it backwards, so each B_k is kept (as G_k = F B_{k-1}).
  std::vector<std::vector<float>> gathered(static_cast<std::size_t>(scatterings), std::vector<float>(3 * n, 0.0f));
  std::vector<float> b(3 * n, 0.0f);
  for (std::size_t k = 0; k < gathered.size(); ++k) {
    if (k > 0) gather_radiosity(transport, b, gathered[k]);
    for (std::size_t i = 0; i < n; ++i)
      for (std::size_t c = 3 * i; c < 3 * i + 3; ++c) b[c] = x.albedo[c] * (direct[c] + gathered[k][c]);
  }
  std::size_t count = 0;
  for (const std::uint8_t s : o.seen) count += s;
  const double scale = count > 0 ? 1.0 / (3.0 * static_cast<double>(count)) : 0.0;
  std::vector<float> lambda(3 * n, 0.0f);
  double loss = 0;
  for (std::size_t i = 0; i < n; ++i) {
    if (!o.seen[i]) continue;
    for (std::size_t c = 3 * i; c < 3 * i + 3; ++c) {
      const double e = static_cast<double>(b[c] - o.radiosity[c]) / kPi;
      loss += scale * e * e;
      lambda[c] = static_cast<float>(2 * scale * e / kPi);
    }
  }
  if (!gradient) return loss;
  gradient->albedo.assign(3 * n, 0.0f);
  gradient->flash_intensity = gradient->ambient = 0;
  std::vector<float> weighted(3 * n);
  for (std::size_t k = gathered.size(); k-- > 0;) {
    for (std::size_t i = 0; i < n; ++i)
      for (std::size_t c = 3 * i; c < 3 * i + 3; ++c) {
        gradient->albedo[c] += lambda[c] * (direct[c] + gathered[k][c]);
        weighted[c] = lambda[c] * x.albedo[c];
        gradient->flash_intensity += static_cast<double>(weighted[c] * o.flash[i]);
        gradient->ambient += static_cast<double>(weighted[c] * transport.sky[i * kSkyTerms]);
      }
    if (k > 0) gather_adjoint(transport, weighted, lambda);
  }
  return loss;
}

AdamResult solve_adam(const Transport& transport, const Observation& o, const std::array<double, 2>& range, const AdamOptions& options, Reporter& report) {
  const int total = options.search_steps * options.search_iterations + options.iterations;
  report.begin("adam", static_cast<std::uint64_t>(total), "iterations");
  AdamResult best;
  best.loss = 1e300;
  int done = 0;
  for (int s = 0; s < options.search_steps; ++s) {
    const double t = options.search_steps > 1 ? static_cast<double>(s) / (options.search_steps - 1) : 0.5;
    AdamState x = start_state(transport, o, range[0] * std::pow(range[1] / range[0], t));
    Optimiser optimiser(transport, o, options, false);
    const double loss = optimiser.iterate(x, range, options.search_iterations, report);
    if (s == 0) best.search_loss_low = loss;
    if (s + 1 == options.search_steps) best.search_loss_high = loss;
    if (loss < best.loss) {
      best.loss = loss;
      best.state = std::move(x);
    }
    report.progress(static_cast<std::uint64_t>(done += options.search_iterations));
  }
  Optimiser optimiser(transport, o, options, true);
  optimiser.iterate(best.state, range, options.iterations, report);
  best.loss = adam_loss(transport, o, best.state, options.scatterings, nullptr);
  report.end();
  return best;
}

}  // namespace chiaro::optimize
