#include "optimize/light_residuals.h"

#include <algorithm>
#include <cmath>

namespace chiaro::optimize {
namespace {

/// What a coat makes of the derivatives of ln(albedo H + mirrored): the light that both hold is divided by direct and other.
struct CoatEffect {
  double direct, other, reflectance = 0, roughness = 0;
};

CoatEffect coat_effect(const Lights& x, const LightSample& s, int c, double h, double albedo) {
  if (!x.gloss.on) return {h, h};
  const CoatFactors f = coat_factors(x.gloss, s.angles);
  const double mirrored = mirrored_radiosity(x, s, c), whole = albedo * h + mirrored, lit = x.flash_intensity * static_cast<double>(s.flash);
  return {whole / (albedo * f.direct + f.direct_mirrored), whole / (albedo * f.other + f.other_mirrored), -mirrored / whole,
          -x.gloss.reflectance * lit * gloss_lobe_slope(x.gloss.roughness, s.angles) / whole};
}

/// Below a coat ln albedo is no mean of ln(body / H), which noise and a highlight that is a little off would bend: Gauss-Newton on ln(B / (albedo H + mirrored)).
/// r and j are put so that less their means they are the residuals and their derivatives with the albedo following, as without a coat.
void fit_coated(const Lights& x, std::span<const LightSample> samples, int c, const LightLayout& layout, double cauchy_scale, Deviations& d) {
  struct Term {
    const LightSample* sample;
    double h, mirrored, ln_b, body = 0;   // body: its share of what is predicted
  };
  std::vector<Term> terms;
  for (const LightSample& s : samples)
    if (const double h = irradiance(x, s, c), b = static_cast<double>(s.radiosity[static_cast<std::size_t>(c)]); h > 0 && b > 0) terms.push_back({&s, h, mirrored_radiosity(x, s, c), std::log(b)});
  const auto predict = [&] {
    const double albedo = std::exp(d.mean_r);
    for (std::size_t k = 0; k < terms.size(); ++k) {
      const double whole = albedo * terms[k].h + terms[k].mirrored;
      terms[k].body = albedo * terms[k].h / whole;
      d.r[k] = terms[k].ln_b - std::log(whole);
    }
  };
  double down = 0;
  constexpr int kRounds = 4;
  for (int round = 0; round < kRounds; ++round) {
    predict();
    double up = down = 0;
    for (std::size_t k = 0; k < terms.size(); ++k) {
      d.robust[k] = cauchy_scale > 0 ? 1.0 / (1.0 + d.w[k] * d.r[k] * d.r[k] / (cauchy_scale * cauchy_scale)) : 1.0;
      up += d.w[k] * d.robust[k] * terms[k].body * d.r[k];
      down += d.w[k] * d.robust[k] * terms[k].body * terms[k].body;
    }
    d.mean_r += std::clamp(up / down, -0.5, 0.5);
  }
  predict();
  for (double& r : d.r) r += d.mean_r;
  if (d.j.empty()) return;
  d.mean_j.setZero();
  for (std::size_t k = 0; k < terms.size(); ++k) {
    d.j[k] = light_derivative(x, *terms[k].sample, c, layout, terms[k].h, std::exp(d.mean_r));
    d.mean_j += (d.w[k] * d.robust[k] * terms[k].body / down) * d.j[k];
  }
  for (std::size_t k = 0; k < terms.size(); ++k) d.j[k] += (1 - terms[k].body) * d.mean_j;
}

}  // namespace

LightLayout layout_of(const LightSolveOptions& options) { return {options.sky_terms, options.sky_colour && options.sky_terms > 0, options.floor, options.gloss}; }

std::vector<SampleGroup> groups_of(std::span<const LightSample> samples) {
  std::vector<SampleGroup> groups;
  for (std::size_t i = 0; i < samples.size();) {
    std::size_t e = i + 1;
    while (e < samples.size() && samples[e].group == samples[i].group) ++e;
    if (e - i >= 2) groups.push_back({i, e});
    i = e;
  }
  return groups;
}

double residuals_of(std::span<const SampleGroup> groups) {
  double residuals = 0;
  for (const SampleGroup& g : groups) residuals += 3.0 * static_cast<double>(g.end - g.begin - 1);
  return residuals;
}

LightVector light_derivative(const Lights& x, const LightSample& s, int c, const LightLayout& layout, double h, double albedo) {
  LightVector j = LightVector::Zero();
  const CoatEffect by = coat_effect(x, s, c, h, albedo);
  const double colour = x.sky_colour[static_cast<std::size_t>(c)], by_floor = x.floor ? static_cast<double>(s.floor_flash) : 0.0;
  j[0] = by.direct == by.other ? -x.flash_intensity * (static_cast<double>(s.flash) + x.floor_albedo * by_floor) / h
                               : -x.flash_intensity * (static_cast<double>(s.flash) / by.direct + x.floor_albedo * by_floor / by.other);
  for (int k = 0; k < layout.sky_terms; ++k) {
    const auto at = static_cast<std::size_t>(k);
    const double hidden = x.floor ? static_cast<double>(s.hidden[at]) : 0.0;
    j[1 + k] = -colour * (static_cast<double>(s.sky[at]) - (k == 0 ? 1 - x.floor_albedo : 1.0) * hidden) / by.other;
  }
  if (layout.coloured && c != 1) j[c == 0 ? layout.red() : layout.blue()] = -colour * sky_irradiance(x, s.sky, s.hidden) / by.other;
  if (layout.floor) j[layout.floor_albedo()] = -(x.flash_intensity * by_floor + colour * x.sky[0] * static_cast<double>(s.hidden[0])) / by.other;
  if (layout.gloss) {
    j[layout.reflectance()] = by.reflectance;
    j[layout.roughness()] = by.roughness;
  }
  j[layout.bounce()] = -static_cast<double>(s.gathered[static_cast<std::size_t>(c)]) / by.other;
  return j;
}

bool deviations(const Lights& x, const Lights& weigh, std::span<const LightSample> samples, int c, const LightLayout& layout, double cauchy_scale, bool with_derivatives, Deviations& d) {
  d.sample.clear();
  d.r.clear();
  d.w.clear();
  d.shadow.clear();
  d.j.clear();
  for (std::size_t i = 0; i < samples.size(); ++i) {
    const LightSample& s = samples[i];
    const double h = irradiance(x, s, c), b = body_radiosity(x, s, c);
    if (!(h > 0) || !(b > 0)) continue;
    d.sample.push_back(static_cast<std::uint32_t>(i));
    d.r.push_back(std::log(b / h));
    d.w.push_back(sample_weight(weigh, s) * static_cast<double>(s.trust));
    if (!with_derivatives) continue;
    d.j.push_back(light_derivative(x, s, c, layout, h, b / h));
    const double gathered = -x.bounce * d.j.back()[layout.bounce()];
    d.shadow.push_back(gathered > 0.5 ? gathered : 0);
  }
  if (d.r.size() < 2) return false;
  // The mean decides the weights, the weights the mean.
  d.robust.assign(d.r.size(), 1.0);
  double sw = 0;
  for (int round = 0; round < 3; ++round) {
    double swr = 0;
    sw = 0;
    for (std::size_t k = 0; k < d.r.size(); ++k) {
      if (round > 0 && cauchy_scale > 0) d.robust[k] = 1.0 / (1.0 + d.w[k] * (d.r[k] - d.mean_r) * (d.r[k] - d.mean_r) / (cauchy_scale * cauchy_scale));
      sw += d.w[k] * d.robust[k];
      swr += d.w[k] * d.robust[k] * d.r[k];
    }
    d.mean_r = swr / sw;
  }
  d.mean_j.setZero();
  for (std::size_t k = 0; k < d.j.size(); ++k) d.mean_j += (d.w[k] * d.robust[k] / sw) * d.j[k];
  if (x.gloss.on) fit_coated(x, samples, c, layout, cauchy_scale, d);
  return true;
}

std::pair<double, double> robust_scale(const Lights& x, std::span<const LightSample> samples, std::span<const SampleGroup> groups, const LightLayout& layout) {
  std::vector<double> weighted, plain;
  Deviations d;
  const std::size_t stride = std::max<std::size_t>(1, groups.size() / 20000);
  for (std::size_t g = 0; g < groups.size(); g += stride)
    for (int c = 0; c < 3; ++c) {
      if (!deviations(x, x, samples.subspan(groups[g].begin, groups[g].end - groups[g].begin), c, layout, 0, false, d)) continue;
      const double freedom = std::sqrt(static_cast<double>(d.r.size()) / static_cast<double>(d.r.size() - 1));
      for (std::size_t k = 0; k < d.r.size(); ++k) {
        const double e = std::fabs(d.r[k] - d.mean_r) * freedom;
        weighted.push_back(e * std::sqrt(d.w[k]));
        plain.push_back(e);
      }
    }
  return {1.4826 * upper_median(std::move(weighted)), 1.4826 * upper_median(std::move(plain))};
}

double cauchy_scale(const Lights& lights, std::span<const LightSample> samples, std::span<const SampleGroup> groups, const LightLayout& layout) {
  constexpr double kLeast = 0.1;
  return kCauchy * std::max(robust_scale(lights, samples, groups, layout).first, kLeast);
}

double dispersion_of(double scale) { return std::max(1.0, scale * scale / (kCauchy * kCauchy)); }

double upper_median(std::vector<double> v) {
  if (v.empty()) return 0;
  const auto mid = v.begin() + static_cast<std::ptrdiff_t>(v.size() / 2);
  std::nth_element(v.begin(), mid, v.end());
  return *mid;
}

}  // namespace chiaro::optimize
