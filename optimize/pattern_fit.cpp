#include "optimize/pattern_fit.h"

#include <algorithm>
#include <cmath>
#include <vector>

#include "optimize/light_residuals.h"

namespace chiaro::optimize {
namespace {

constexpr int kLightUnknowns = 3;   // ln flash, ln ambient, bounce
constexpr int kMostUnknowns = kMaxPatternUnknowns + kLightUnknowns;
constexpr int kRounds = 8;
constexpr double kLeastScale = 0.1;
using Vec = Eigen::Matrix<double, kMostUnknowns, 1>;
using Mat = Eigen::Matrix<double, kMostUnknowns, kMostUnknowns>;

template <class Rows>
double deviation_of(const Rows& rows, const Vec& x) {
  if (rows.empty()) return 0;
  std::vector<double> sizes;
  for (const auto& r : rows) sizes.push_back(std::sqrt(r.weight) * std::fabs(r.residual + r.effect.dot(x)));
  const auto mid = sizes.begin() + static_cast<std::ptrdiff_t>(sizes.size() / 2);
  std::nth_element(sizes.begin(), mid, sizes.end());
  return std::max(kLeastScale, 1.4826 * *mid);
}

/// Of the information in `rows` residuals, what counts: so many are independent, and those that scatter more than expected say less.
double share_of(std::size_t rows, double independent, double scale) { return std::min(1.0, independent / static_cast<double>(std::max<std::size_t>(1, rows))) / std::max(1.0, scale * scale); }

Vec3d lights_sd(const PatternFitOptions& options) { return {options.lights_sd, options.lights_sd, options.bounce_sd}; }

}  // namespace

PatternResiduals::PatternResiduals(std::span<const LightSample> samples, const Lights& lights, double independent, const PatternFitOptions& options)
    : samples_(samples), lights_(lights), independent_(independent), options_(options) {}

/// Deviations from their group's mean.
std::vector<PatternResiduals::Row> PatternResiduals::rows_of(const Pattern& pattern) const {
  const auto row_of = [&](const LightSample& s, Row& row) {
    if (!s.flash_photograph) return false;
    row = {};
    const PatternEffect effect = pattern.effect(s);
    for (int c = 0; c < 3; ++c) {
      const double h = irradiance(lights_, s, c), b = body_radiosity(lights_, s, c);
      if (!(h > 0) || !(b > 0)) return false;
      row.residual += std::log(b / h) / 3;
      const double direct = lights_.flash_intensity * static_cast<double>(s.flash) / h, gathered = static_cast<double>(s.gathered[static_cast<std::size_t>(c)]) / h;
      row.effect.head(pattern.size()) -= (direct * effect.of_flash + effect.of_picture) / 3;
      row.effect.segment<kLightUnknowns>(kMaxPatternUnknowns) -= Vec3d(direct, std::max(0.0, 1 - direct - lights_.bounce * gathered), gathered) / 3;
    }
    row.weight = sample_weight(lights_, s) * static_cast<double>(s.trust);
    return row.weight > 0;
  };
  std::vector<Row> all, group;
  for (std::size_t i = 0; i < samples_.size();) {
    const std::uint32_t id = samples_[i].group;
    group.clear();
    for (; i < samples_.size() && samples_[i].group == id; ++i)
      if (Row r; row_of(samples_[i], r)) group.push_back(r);
    if (group.size() < 2) continue;
    double weight = 0, residual = 0;
    Vec effect = Vec::Zero();
    for (const Row& r : group) {
      weight += r.weight;
      residual += r.weight * r.residual;
      effect += r.weight * r.effect;
    }
    for (Row& r : group) {
      r.residual -= residual / weight;
      r.effect -= effect / weight;
    }
    all.insert(all.end(), group.begin(), group.end());
  }
  return all;
}

PatternFit PatternResiduals::fit(const Pattern& pattern) const {
  const Eigen::Index n = pattern.size();
  PatternFit found;
  found.value = pattern.already;
  found.covariance = pattern.prior_sd.array().square().matrix().asDiagonal();
  const std::vector<Row> rows = rows_of(pattern);
  if (rows.empty()) return found;
  Vec prior = Vec::Ones(), x = Vec::Zero();   // what this pattern does not have stays 0
  prior.head(n) = pattern.prior_sd.array().square().inverse();
  prior.tail<kLightUnknowns>() = lights_sd(options_).array().square().inverse();
  Mat information;
  for (int round = 0; round < kRounds; ++round) {
    const double scale = deviation_of(rows, x), share = share_of(rows.size(), independent_, scale);
    information = prior.asDiagonal();
    Vec b = Vec::Zero();
    b.head(n) = -prior.head(n).cwiseProduct(pattern.already);
    for (const Row& r : rows) {
      const double now = r.residual + r.effect.dot(x), w = share * r.weight / (1 + r.weight * now * now / (kCauchy * kCauchy * scale * scale));
      information += w * r.effect * r.effect.transpose();
      b -= w * r.residual * r.effect;
    }
    x = information.ldlt().solve(b);
  }
  found.before = deviation_of(rows, Vec::Zero());
  found.after = deviation_of(rows, x);
  const Mat covariance = information.inverse();
  found.value = pattern.already + x.head(n);
  found.lights_step = x.tail<kLightUnknowns>();
  found.covariance = covariance.topLeftCorner(n, n);
  const Eigen::Matrix<double, 2, Eigen::Dynamic, 0, 2, kMaxPatternUnknowns> with_pattern = covariance.block(kMaxPatternUnknowns, 0, 2, n);
  found.lights_covariance = with_pattern * PatternMatrix(found.covariance.inverse()) * with_pattern.transpose();
  return found;
}

double PatternResiduals::misfit(const Pattern& pattern, const PatternFit& fit, double scale) const {
  const std::vector<Row> rows = rows_of(pattern);
  Vec x = Vec::Zero();
  x.head(pattern.size()) = fit.value - pattern.already;
  x.tail<kLightUnknowns>() = fit.lights_step;
  const double width = kCauchy * kCauchy * scale * scale;
  double sum = 0;
  for (const Row& r : rows) {
    const double now = r.residual + r.effect.dot(x);
    sum += width * std::log1p(r.weight * now * now / width);
  }
  return share_of(rows.size(), independent_, scale) * sum + fit.lights_step.cwiseQuotient(lights_sd(options_)).squaredNorm() + fit.value.cwiseQuotient(pattern.prior_sd).squaredNorm();
}

double PatternFit::chi2(Eigen::Index first, Eigen::Index count) const {
  const PatternVector part = value.segment(first, count);
  const PatternMatrix information = covariance.block(first, first, count, count).inverse();
  return part.dot(information * part);
}

}  // namespace chiaro::optimize
