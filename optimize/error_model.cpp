#include "optimize/error_model.h"

#include <algorithm>
#include <cmath>
#include <vector>

namespace chiaro::optimize {
namespace {

constexpr std::size_t kLeastGroups = 500;
constexpr int kRounds = 15, kSweeps = 200;
constexpr double kOutlier = 9;            ///< times the variance expected: larger squares count as this
constexpr double kLeastVariance = 1e-5;   ///< of a deviation, as a weight: rounding and what else no term names

using Terms = Eigen::Matrix<double, 5, 1>;   // normal, registration, other light, spread, rest

/// A deviation squared, and its causes.
struct Deviation {
  double square = 0, noise = 0;
  Terms cause = Terms::Zero();
};

struct Seen {
  double ln_albedo = 0, direct = 0;
  double highlight = 0;   ///< variance of ln_albedo by what a coat mirrors
  const LightSample* sample = nullptr;
};

/// ln albedo, mean of the channels.
bool read(const Lights& lights, const LightSample& s, Seen& seen) {
  if (!s.flash_photograph) return false;
  double ln = 0;
  for (int c = 0; c < 3; ++c) {
    const double h = irradiance(lights, s, c), b = body_radiosity(lights, s, c);
    if (!(h > 0) || !(b > 0)) return false;
    ln += std::log(b / h) / 3;
    seen.direct += lights.flash_intensity * static_cast<double>(s.flash) / h / 3;
  }
  seen.ln_albedo = ln;
  if (lights.gloss.on) {
    const double body = body_radiosity(lights, s, 1), relative = kHighlightSd * (static_cast<double>(s.radiosity[1]) - body) / body;
    seen.highlight = relative * relative;
  }
  seen.sample = &s;
  return true;
}

/// The causes of what is independent between photographs: registration, other light, spread, rest.
Terms own_causes(const Seen& s) {
  const auto gradient = static_cast<double>(s.sample->gradient), spread = s.direct * static_cast<double>(s.sample->spread);
  Terms cause;
  cause << 0, gradient * gradient, (1 - s.direct) * (1 - s.direct), spread * spread, 1;
  return cause;
}

/// Deviations from the mean of n. The mean holds 1/n of each error, so that E d_k^2 = (1 - 2/n) v_k + sum_j v_j / n^2; an error of the normal, one for all, remains by how
/// its effect differs from the mean effect.
void add_deviations(std::span<const Seen> seen, std::vector<Deviation>& out) {
  const auto n = static_cast<double>(seen.size());
  double mean = 0, noise = 0;
  Vec3d lean = Vec3d::Zero();
  Terms causes = Terms::Zero();
  for (const Seen& s : seen) {
    mean += s.ln_albedo / n;
    lean += s.direct * s.sample->lean.cast<double>() / n;
    causes += own_causes(s) / (n * n);
    noise += static_cast<double>(s.sample->noise) / (3 * n * n) + s.highlight / (n * n);   // of the mean over three channels
  }
  for (const Seen& s : seen) {
    Deviation d;
    d.square = (s.ln_albedo - mean) * (s.ln_albedo - mean);
    d.noise = noise + (1 - 2 / n) * (static_cast<double>(s.sample->noise) / 3 + s.highlight);
    d.cause = causes + (1 - 2 / n) * own_causes(s);
    d.cause[0] = (s.direct * s.sample->lean.cast<double>() - lean).squaredNorm();
    out.push_back(d);
  }
}

/// min |a x - b|^2 with x >= 0, from the normal equations; by coordinate descent, from x.
void solve_not_negative(const Eigen::Matrix<double, 5, 5>& a, const Terms& b, Terms& x) {
  for (int sweep = 0; sweep < kSweeps; ++sweep)
    for (Eigen::Index i = 0; i < x.size(); ++i)
      if (a(i, i) > 0) x[i] = std::max(0.0, x[i] + (b[i] - a.row(i).dot(x)) / a(i, i));
}

}  // namespace

ErrorModel estimate_errors(std::span<const LightSample> samples, const Lights& lights) {
  std::vector<Deviation> all;
  std::vector<Seen> seen;
  std::size_t groups = 0;
  for (std::size_t i = 0; i < samples.size();) {
    const std::uint32_t group = samples[i].group;
    seen.clear();
    for (; i < samples.size() && samples[i].group == group; ++i)
      if (Seen s; read(lights, samples[i], s)) seen.push_back(s);
    if (seen.size() < 2) continue;
    ++groups;
    add_deviations(seen, all);
  }
  ErrorModel model;
  if (groups < kLeastGroups) return model;
  Terms x = Terms::Constant(1e-4);
  for (int round = 0; round < kRounds; ++round) {
    Eigen::Matrix<double, 5, 5> a = Eigen::Matrix<double, 5, 5>::Zero();
    Terms b = Terms::Zero();
    for (const Deviation& d : all) {
      const double expected = std::max(kLeastVariance, d.noise + d.cause.dot(x)), square = std::min(d.square, kOutlier * expected);
      const Terms scaled = d.cause / expected;
      a += scaled * scaled.transpose();
      b += scaled * ((square - d.noise) / expected);
    }
    solve_not_negative(a, b, x);
  }
  x = x.cwiseSqrt();
  return {x[0], x[1], x[2], x[3], x[4], true};
}

}  // namespace chiaro::optimize
