#include "optimize/light_solve.h"

#include <algorithm>
#include <cmath>
#include <tuple>

#include "optimize/light_residuals.h"
#include "stream/base/error.h"
#include "stream/base/parallel.h"

namespace chiaro::optimize {
namespace {

constexpr double kModelSd = 0.02;                    ///< relative model error that no term names
constexpr double kNormalSd = 0.01745;                ///< one degree
constexpr double kGatherSd = 0.03;                   ///< relative error of smoothed sky and bounce terms
constexpr double kShadowSd = 0.013;                  ///< relative error of the gathered light that all places where it prevails share: cuts, unseen surfaces (so much was measured)
constexpr double kUnknownSd = 0.5;                   ///< relative, of the light from surfaces whose albedo no photograph shows: that of the nearest seen one was twice too much beside a tower
constexpr double kSkyColourSd = 0.5;                 ///< of ln red and ln blue of the ambient light beside green: a candle is 1.2 off, shade -0.3
constexpr double kFloorAlbedo = 0.3, kFloorSd = 0.3, kWhitestFloor = 0.95;   ///< soil and stone to whitewash
constexpr double kGuessSd = 0.35;                    ///< relative, of an ambient light guessed from the brightest surfaces
constexpr double kReflectance = 0.04, kReflectanceSd = 0.2, kMostReflectance = 0.08;   ///< sd of its logarithm: clear coats have an index of 1.4 to 1.6
constexpr double kRoughness = 0.25, kRoughnessSd = 0.5, kSmoothest = 0.08, kRoughest = 0.6;   ///< sd of its logarithm
constexpr double kWhiteSd = 0.1;                     ///< of ln albedo above 1
constexpr std::size_t kGroupGrain = 256;

struct Normal {
  LightMatrix a = LightMatrix::Zero(), meat = LightMatrix::Zero();
  LightMatrix limit = LightMatrix::Zero();    ///< curvature of what keeps albedos below 1: it bends the steps, but a bound is no measurement
  LightVector g = LightVector::Zero();
  LightVector shadow = LightVector::Zero();   ///< change of g if the gathered light were 1 too large wherever it prevails

  double objective = 0;
  Normal& operator+=(const Normal& o) {
    a += o.a;
    meat += o.meat;
    limit += o.limit;
    g += o.g;
    shadow += o.shadow;
    objective += o.objective;
    return *this;
  }
};

/// Lower triangle of a += w * j * j^T, of the parameters there are.
void add_outer(LightMatrix& a, double w, const LightVector& j, int p) {
  for (int row = 0; row < p; ++row)
    for (int column = 0; column <= row; ++column) a(row, column) += w * j[row] * j[column];
}

/// No surface gives back more than it receives: a shared albedo above 1 pulls the lights up. Robust, since highlights exist.
void add_white_limit(const Deviations& d, double cauchy_scale, int p, Normal& n) {
  if (!(d.mean_r > 0)) return;
  constexpr double kWeight = 1 / (kWhiteSd * kWhiteSd);
  const double u2 = kWeight * d.mean_r * d.mean_r / (cauchy_scale * cauchy_scale), w = kWeight / (1.0 + u2);
  add_outer(n.limit, w, d.mean_j, p);
  n.g -= w * d.mean_r * d.mean_j;
  n.objective += 0.5 * cauchy_scale * cauchy_scale * std::log1p(u2);
}

Normal accumulate(const Lights& x, const Lights& weigh, std::span<const LightSample> samples, const std::vector<SampleGroup>& groups, const LightLayout& layout, double cauchy_scale,
                  bool with_derivatives) {
  return deterministic_sum<Normal>(groups.size(), kGroupGrain, Normal{}, [&](std::size_t b, std::size_t e) {
    Normal n;
    Deviations d;
    for (std::size_t g = b; g < e; ++g) {
      LightVector score = LightVector::Zero();
      for (int c = 0; c < 3; ++c) {
        if (!deviations(x, weigh, samples.subspan(groups[g].begin, groups[g].end - groups[g].begin), c, layout, cauchy_scale, with_derivatives, d)) continue;
        for (std::size_t k = 0; k < d.r.size(); ++k) {
          const double r = d.r[k] - d.mean_r;
          const double u2 = d.w[k] * r * r / (cauchy_scale * cauchy_scale);
          n.objective += 0.5 * cauchy_scale * cauchy_scale * std::log1p(u2);
          if (!with_derivatives) continue;
          const double w = d.w[k] / (1.0 + u2);
          const LightVector j = d.j[k] - d.mean_j;
          add_outer(n.a, w, j, layout.size());
          n.g -= w * r * j;
          n.shadow += w * d.shadow[k] * j;
          score += w * r * j;
        }
        add_white_limit(d, cauchy_scale, layout.size(), n);
      }
      add_outer(n.meat, 1, score, layout.size());
    }
    return n;
  });
}

/// Of ln(B / H), from noise, normals, sub-pixel spread and gather noise.
double light_variance(const Lights& lights, const LightSample& s, double normal_rad = kNormalSd) {
  const double h = irradiance(lights, s, 1);
  const double direct = h > 0 ? lights.flash_intensity * static_cast<double>(s.flash) / h : 0;
  const double normal = direct * static_cast<double>(s.tan_flash) * normal_rad, spread = 0.3 * direct * static_cast<double>(s.spread), gather = kGatherSd * (1 - direct);
  // Not of highlights: a coat that makes them larger would have fewer of them count.
  return static_cast<double>(s.variance) + normal * normal + spread * spread + gather * gather;
}

void add_references(const Lights& x, const Lights& weigh, std::span<const ReferenceSample> references, const LightLayout& layout, Normal& n) {
  for (const ReferenceSample& ref : references)
    for (int c = 0; c < 3; ++c) {
      const auto at = static_cast<std::size_t>(c);
      const double h = irradiance(x, ref.sample, c), b = body_radiosity(x, ref.sample, c);
      if (!(h > 0) || !(b > 0)) continue;
      const double r = std::log(b / h) - std::log(ref.albedo[at]);
      const LightVector j = light_derivative(x, ref.sample, c, layout, h, b / h);
      // The channels of one target share its error: together they count once. What the light model is good for at that place counts too: a target in
      // shadow, seen by a grazing flash, or lit by surfaces that no photograph shows, says less.
      const double unknown = kUnknownSd * ref.unknown_share * weigh.bounce * static_cast<double>(ref.sample.gathered[at]) / irradiance(weigh, ref.sample, c);
      const double w = 1.0 / (3.0 * (ref.sigma * ref.sigma + unknown * unknown + light_variance(weigh, ref.sample, ref.normal_rad)));
      add_outer(n.a, w, j, layout.size());
      n.g -= w * r * j;
      n.objective += 0.5 * w * r * r;
    }
}

void add_priors(const Lights& x, const Lights& weigh, const LightSolveOptions& options, const LightLayout& layout, Normal& n) {
  if (options.flash_ln_mean) {
    const double w = 1.0 / (*options.flash_ln_sd * *options.flash_ln_sd), r = std::log(x.flash_intensity) - *options.flash_ln_mean;
    n.a(0, 0) += w;
    n.g[0] -= w * r;
    n.objective += 0.5 * w * r * r;
  }
  if (options.ambient_guess && layout.sky_terms > 0) {
    const double sd = kGuessSd * *options.ambient_guess, ws = 1.0 / (sd * sd), e = x.sky[0] - *options.ambient_guess;
    n.a(1, 1) += ws;
    n.g[1] -= ws * e;
    n.objective += 0.5 * ws * e * e;
  }
  const int b = layout.bounce();
  const double w = options.bounce_sd > 0 ? 1.0 / (options.bounce_sd * options.bounce_sd) : 1e12, r = x.bounce - options.bounce_mean;
  n.a(b, b) += w;
  n.g[b] -= w * r;
  n.objective += 0.5 * w * r * r;
  if (layout.coloured)
    for (const auto& [at, colour] : {std::pair{layout.red(), x.sky_colour[0]}, std::pair{layout.blue(), x.sky_colour[2]}}) {
      constexpr double kWeight = 1 / (kSkyColourSd * kSkyColourSd);
      n.a(at, at) += kWeight;
      n.g[at] -= kWeight * std::log(colour);
      n.objective += 0.5 * kWeight * std::log(colour) * std::log(colour);
    }
  if (layout.floor) {
    constexpr double kWeight = 1 / (kFloorSd * kFloorSd);
    const double e = x.floor_albedo - kFloorAlbedo;
    n.a(layout.floor_albedo(), layout.floor_albedo()) += kWeight;
    n.g[layout.floor_albedo()] -= kWeight * e;
    n.objective += 0.5 * kWeight * e * e;
  }
  if (layout.gloss)
    for (const auto& [at, off, sd] : {std::tuple{layout.reflectance(), std::log(x.gloss.reflectance / kReflectance), kReflectanceSd}, std::tuple{layout.roughness(), std::log(x.gloss.roughness / kRoughness), kRoughnessSd}}) {
      n.a(at, at) += 1 / (sd * sd);
      n.g[at] -= off / (sd * sd);
      n.objective += 0.5 * off * off / (sd * sd);
    }
  // Directional sky terms are small against the mean: a weak pull to zero keeps unseen directions quiet.
  for (int k = 1; k < layout.sky_terms; ++k) {
    const double scale = std::max(weigh.sky[0], 1e-6 * weigh.flash_intensity), ws = 1.0 / (scale * scale), value = x.sky[static_cast<std::size_t>(k)];
    n.a(1 + k, 1 + k) += ws;
    n.g[1 + k] -= ws * value;
    n.objective += 0.5 * ws * value * value;
  }
}

Lights stepped(const Lights& x, const LightVector& step, const LightLayout& layout) {
  Lights y = x;
  y.flash_intensity *= std::exp(std::clamp(step[0], -1.0, 1.0));
  for (int k = 0; k < layout.sky_terms; ++k) y.sky[static_cast<std::size_t>(k)] += step[1 + k];
  if (layout.sky_terms > 0) y.sky[0] = std::max(0.0, y.sky[0]);
  if (layout.coloured) {
    y.sky_colour[0] *= std::exp(std::clamp(step[layout.red()], -0.5, 0.5));
    y.sky_colour[2] *= std::exp(std::clamp(step[layout.blue()], -0.5, 0.5));
  }
  if (layout.floor) y.floor_albedo = std::clamp(y.floor_albedo + step[layout.floor_albedo()], 0.0, kWhitestFloor);
  if (layout.gloss) {
    y.gloss.reflectance = std::min(kMostReflectance, y.gloss.reflectance * std::exp(std::clamp(step[layout.reflectance()], -0.5, 0.5)));
    y.gloss.roughness = std::clamp(y.gloss.roughness * std::exp(std::clamp(step[layout.roughness()], -0.3, 0.3)), kSmoothest, kRoughest);
  }
  y.bounce = std::clamp(y.bounce + step[layout.bounce()], 0.0, 2.0);
  return y;
}

/// The matrix of which only the lower triangle was summed.
Eigen::MatrixXd whole(const LightMatrix& lower, int p) { return lower.topLeftCorner(p, p).selfadjointView<Eigen::Lower>(); }

double information_of(const std::vector<SampleGroup>& groups, const LightSolveOptions& options) {
  return std::min(options.information, options.independent_residuals / std::max(1.0, residuals_of(groups)));
}

}  // namespace

double sky_irradiance(const Lights& lights, std::span<const float, kSkyTerms> sky, std::span<const float> hidden) {
  double h = 0;
  for (std::size_t k = 0; k < kSkyTerms; ++k) h += lights.sky[k] * static_cast<double>(sky[k]);
  if (!lights.floor || hidden.empty()) return h;
  for (std::size_t k = 0; k < kSkyTerms; ++k) h -= lights.sky[k] * static_cast<double>(hidden[k]);
  return h + lights.floor_albedo * lights.sky[0] * static_cast<double>(hidden[0]);
}

double irradiance(const Lights& lights, const LightSample& s, int c) {
  const auto at = static_cast<std::size_t>(c);
  const double by_floor = lights.floor ? lights.floor_albedo * static_cast<double>(s.floor_flash) : 0.0;
  if (lights.gloss.on) {
    const CoatFactors f = coat_factors(lights.gloss, s.angles);
    return f.direct * lights.flash_intensity * static_cast<double>(s.flash) + f.other * other_irradiance(lights, s, c);
  }
  return lights.flash_intensity * (static_cast<double>(s.flash) + by_floor) + lights.bounce * static_cast<double>(s.gathered[at]) +
         lights.sky_colour[at] * sky_irradiance(lights, s.sky, s.hidden);
}

double other_irradiance(const Lights& lights, const LightSample& s, int c) {
  const auto at = static_cast<std::size_t>(c);
  const double by_floor = lights.floor ? lights.floor_albedo * static_cast<double>(s.floor_flash) : 0.0;
  return lights.flash_intensity * by_floor + lights.bounce * static_cast<double>(s.gathered[at]) + lights.sky_colour[at] * sky_irradiance(lights, s.sky, s.hidden);
}

double mirrored_radiosity(const Lights& lights, const LightSample& s, int c) {
  if (!lights.gloss.on) return 0;
  const CoatFactors f = coat_factors(lights.gloss, s.angles);
  return f.direct_mirrored * lights.flash_intensity * static_cast<double>(s.flash) + f.other_mirrored * other_irradiance(lights, s, c);
}

double body_radiosity(const Lights& lights, const LightSample& s, int c) {
  const auto b = static_cast<double>(s.radiosity[static_cast<std::size_t>(c)]);
  return lights.gloss.on ? below_coat(b, mirrored_radiosity(lights, s, c)) : b;
}

double sample_weight(const Lights& lights, const LightSample& s) {
  if (!(irradiance(lights, s, 1) > 0)) return 0;
  return 1.0 / (kModelSd * kModelSd + light_variance(lights, s));
}

double independent_residuals(std::span<const LightSample> samples, const LightSolveOptions& options) {
  const std::vector<SampleGroup> groups = groups_of(samples);
  return information_of(groups, options) * residuals_of(groups);
}

double light_misfit(std::span<const LightSample> samples, const LightSolveOptions& options, const Lights& lights, const Lights& base) {
  const LightLayout layout = layout_of(options);
  const std::vector<SampleGroup> groups = groups_of(samples);
  const double scale = cauchy_scale(base, samples, groups, layout), dispersion = dispersion_of(scale);
  return accumulate(lights, base, samples, groups, layout, scale, false).objective * information_of(groups, options) / (dispersion * dispersion);
}

LightSolution solve_lights(std::span<const LightSample> samples, std::span<const ReferenceSample> references, const LightSolveOptions& options, const Lights& start) {
  const LightLayout layout = layout_of(options);
  const std::vector<SampleGroup> groups = groups_of(samples);
  if (groups.empty() && references.empty() && !options.flash_ln_mean)
    throw Error("lights: no surfel is seen twice, nothing of known albedo is given and the flash has no calibrated range: the light cannot be found");
  LightSolution solution;
  solution.groups = groups.size();
  solution.samples = samples.size();
  solution.scale_known = (options.flash_ln_mean && !options.flash_is_guess && !options.ambient_guess) || !references.empty();
  solution.sky_terms = layout.sky_terms;
  solution.sky_colour = layout.coloured;
  const double information = information_of(groups, options);
  Lights x = start;
  if (!layout.coloured) x.sky_colour = {1, 1, 1};
  if (layout.floor && !x.floor) x.floor_albedo = kFloorAlbedo;
  x.floor = layout.floor;
  x.gloss.on = layout.gloss;
  for (int k = options.sky_terms; k < kSkyTerms; ++k) x.sky[static_cast<std::size_t>(k)] = 0;
  const int p = layout.size();
  double damping = 1e-4;
  const auto build = [&](const Lights& at, const Lights& weigh, double scale, bool with_derivatives) {
    Normal n = accumulate(at, weigh, samples, groups, layout, scale, with_derivatives);
    const double dispersion = dispersion_of(scale), independent = information / dispersion;
    n.a *= independent / dispersion;
    n.limit *= independent / dispersion;
    n.g *= independent / dispersion;
    n.shadow *= independent / dispersion;
    n.objective *= independent / dispersion;
    n.meat *= independent / (dispersion * dispersion);
    add_references(at, weigh, references, layout, n);
    add_priors(at, weigh, options, layout, n);
    return n;
  };
  double scale = cauchy_scale(x, samples, groups, layout);
  Normal here = build(x, x, scale, true);
  for (int it = 0; it < options.max_iterations; ++it) {
    solution.iterations = it + 1;
    bool pinned = false;   // the sky cannot become darker than black
    if (layout.sky_terms > 0 && x.sky[0] <= 0 && here.g[1] < 0) pinned = true;
    Eigen::MatrixXd a = whole(here.a + here.limit, p);
    Eigen::VectorXd g = here.g.head(p);
    for (int k = 0; k < p; ++k) a(k, k) += damping * std::max(a(k, k), 1e-12) + 1e-30;
    if (pinned) {
      a.row(1).setZero();
      a.col(1).setZero();
      a(1, 1) = 1;
      g[1] = 0;
    }
    const Eigen::VectorXd solved = a.ldlt().solve(g);
    LightVector step = LightVector::Zero();
    step.head(p) = solved;
    const Lights y = stepped(x, step, layout);
    const Normal there = build(y, x, scale, false);
    if (!(there.objective <= here.objective * (1 + 1e-12))) {
      damping = std::max(damping * 10, 1e-6);
      if (damping < 1e8) continue;
      solution.converged = true;   // no step is short enough to improve it
      break;
    }
    const double change = std::fabs(std::log(y.flash_intensity / x.flash_intensity)) + std::fabs(y.sky[0] - x.sky[0]) / std::max(1e-9, y.sky[0] + 1e-3 * y.flash_intensity) +
                          std::fabs(y.sky_colour[0] - x.sky_colour[0]) + std::fabs(y.sky_colour[2] - x.sky_colour[2]);
    x = y;
    damping = std::max(damping * 0.1, 1e-9);
    if (change < 1e-7 && it > 3) {
      solution.converged = true;
      break;
    }
    // The scale follows the residuals while they still shrink.
    if (it < 8) scale = cauchy_scale(x, samples, groups, layout);
    here = build(x, x, scale, true);
  }
  solution.lights = x;
  solution.scatter = robust_scale(x, samples, groups, layout).second;
  // Sandwich: the scatter of the groups' scores is what the data say about their own reliability.
  Eigen::MatrixXd a = whole(here.a, p), bread;
  for (int k = 0; k < p; ++k) a(k, k) += 1e-12;
  bread = a.ldlt().solve(Eigen::MatrixXd::Identity(p, p));
  Normal outside;
  add_references(x, x, references, layout, outside);
  add_priors(x, x, options, layout, outside);
  solution.outside = whole(outside.a, p);
  solution.outside_misfit = outside.objective;
  const Eigen::MatrixXd meat = whole(here.meat, p) + solution.outside;
  const Eigen::VectorXd systematic = kShadowSd * (bread * here.shadow.head(p));
  solution.covariance = bread * meat * bread.transpose() + systematic * systematic.transpose();
  return solution;
}

}  // namespace chiaro::optimize
