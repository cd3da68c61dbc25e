#include "optimize/pattern_fit.h"

#include <algorithm>
#include <cmath>

#include "optimize/light_residuals.h"

namespace chiaro::optimize {
namespace {

constexpr Eigen::Index kFixed = kMaxPatternUnknowns + 3;   // the pattern, the lights; then ln brightness of each photograph
constexpr int kRounds = 8;
constexpr double kLeastScale = 0.1;

/// Of the information in `rows` residuals, what counts: so many are independent, and those that scatter more than expected say less.
double share_of(std::size_t rows, double independent, double scale) { return std::min(1.0, independent / static_cast<double>(std::max<std::size_t>(1, rows))) / std::max(1.0, scale * scale); }

Vec3d lights_sd(const PatternFitOptions& options) { return {options.lights_sd, options.lights_sd, options.bounce_sd}; }

double log_determinant(const Eigen::MatrixXd& a) { return 2 * Eigen::LLT<Eigen::MatrixXd>(a).matrixLLT().diagonal().array().log().sum(); }

}  // namespace

PatternResiduals::PatternResiduals(std::span<const LightSample> samples, const Lights& lights, double independent, const PatternFitOptions& options)
    : samples_(samples), lights_(lights), independent_(independent), options_(options) {
  for (const LightSample& s : samples) photographs_ = std::max<std::size_t>(photographs_, s.photograph + 1);
}

/// Deviations from their group's mean.
std::vector<PatternResiduals::Row> PatternResiduals::rows_of(const Pattern& pattern) const {
  const auto row_of = [&](const LightSample& s, Row& row) {
    if (!s.flash_photograph) return false;
    row = {};
    row.photograph = s.photograph;
    const PatternEffect effect = pattern.effect(s);
    for (int c = 0; c < 3; ++c) {
      const double h = irradiance(lights_, s, c), b = body_radiosity(lights_, s, c);
      if (!(h > 0) || !(b > 0)) return false;
      row.residual += std::log(b / h) / 3;
      const double direct = lights_.flash_intensity * static_cast<double>(s.flash) / h, gathered = static_cast<double>(s.gathered[static_cast<std::size_t>(c)]) / h;
      row.effect.head(pattern.size()) -= (direct * effect.of_flash + effect.of_picture) / 3;
      row.effect.tail<kLights>() -= Vec3d(direct, std::max(0.0, 1 - direct - lights_.bounce * gathered), gathered) / 3;
      row.exposure -= (1 - lights_.bounce * gathered) / 3;   // what is gathered is as bright as the photograph
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
    Effect effect = Effect::Zero();
    for (const Row& r : group) {
      weight += r.weight;
      residual += r.weight * r.residual;
      effect += r.weight * r.effect;
    }
    for (Row& r : group) {
      r.residual -= residual / weight;
      r.effect -= effect / weight;
      r.in_mean = r.weight * r.exposure / weight;
      r.first = static_cast<std::uint32_t>(all.size());
      r.count = static_cast<std::uint32_t>(group.size());
    }
    all.insert(all.end(), group.begin(), group.end());
  }
  return all;
}

Eigen::Index PatternResiduals::unknowns(const Pattern& pattern) const { return kFixed + (pattern.exposure_sd > 0 ? static_cast<Eigen::Index>(photographs_) : 0); }

double PatternResiduals::residual(const std::vector<Row>& rows, const Row& row, const Eigen::VectorXd& x) const {
  double now = row.residual + row.effect.dot(x.head<kFixed>());
  if (x.size() == kFixed) return now;
  now += row.exposure * x[kFixed + row.photograph];
  for (std::uint32_t s = row.first; s < row.first + row.count; ++s) now -= rows[s].in_mean * x[kFixed + rows[s].photograph];
  return now;
}

double PatternResiduals::deviation(const std::vector<Row>& rows, const Eigen::VectorXd& x) const {
  if (rows.empty()) return 0;
  std::vector<double> sizes;
  for (const Row& r : rows) sizes.push_back(std::sqrt(r.weight) * std::fabs(residual(rows, r, x)));
  const auto mid = sizes.begin() + static_cast<std::ptrdiff_t>(sizes.size() / 2);
  std::nth_element(sizes.begin(), mid, sizes.end());
  return std::max(kLeastScale, 1.4826 * *mid);
}

/// One row into the normal equations.
void PatternResiduals::add(const std::vector<Row>& rows, const Row& row, double w, Eigen::MatrixXd& a, Eigen::VectorXd& b) const {
  a.topLeftCorner<kFixed, kFixed>() += w * row.effect * row.effect.transpose();
  b.head<kFixed>() -= w * row.residual * row.effect;
  if (b.size() == kFixed) return;
  const auto of = [&](std::uint32_t s) { return (&rows[s] == &row ? row.exposure : 0.0) - rows[s].in_mean; };
  for (std::uint32_t s = row.first; s < row.first + row.count; ++s) {
    const double e = of(s);
    const Eigen::Index k = kFixed + rows[s].photograph;
    a.col(k).head<kFixed>() += w * e * row.effect;
    b[k] -= w * e * row.residual;
    for (std::uint32_t t = row.first; t < row.first + row.count; ++t) a(kFixed + rows[t].photograph, k) += w * e * of(t);
  }
}

PatternFit PatternResiduals::fit(const Pattern& pattern) const {
  const Eigen::Index n = pattern.size(), all = unknowns(pattern), open = all - kFixed;
  PatternFit found;
  found.value = pattern.already;
  found.covariance = pattern.prior_sd.array().square().matrix().asDiagonal();
  found.beside = Eigen::VectorXd::Zero(all - kMaxPatternUnknowns);
  const std::vector<Row> rows = rows_of(pattern);
  if (rows.empty()) return found;
  Eigen::VectorXd prior = Eigen::VectorXd::Ones(all), x = Eigen::VectorXd::Zero(all);   // what this pattern does not have stays 0
  prior.head(n) = pattern.prior_sd.array().square().inverse();
  prior.segment<kLights>(kMaxPatternUnknowns) = lights_sd(options_).array().square().inverse();
  if (open > 0) prior.tail(open).setConstant(1 / (pattern.exposure_sd * pattern.exposure_sd));
  Eigen::MatrixXd information;
  for (int round = 0; round < kRounds; ++round) {
    const double scale = deviation(rows, x), share = share_of(rows.size(), independent_, scale);
    information = prior.asDiagonal();
    Eigen::VectorXd b = Eigen::VectorXd::Zero(all);
    b.head(n) = -prior.head(n).cwiseProduct(pattern.already);
    for (const Row& r : rows) {
      const double now = residual(rows, r, x);
      add(rows, r, share * r.weight / (1 + r.weight * now * now / (kCauchy * kCauchy * scale * scale)), information, b);
    }
    information.bottomLeftCorner(open, kFixed) = information.topRightCorner(kFixed, open).transpose();
    x = information.llt().solve(b);
  }
  found.before = deviation(rows, Eigen::VectorXd::Zero(all));
  found.after = deviation(rows, x);
  found.value = pattern.already + x.head(n);
  found.beside = x.tail(all - kMaxPatternUnknowns);
  if (open > 0) found.occam = log_determinant(information) - log_determinant(information.topLeftCorner<kFixed, kFixed>()) - static_cast<double>(open) * std::log(prior[kFixed]);
  const Eigen::Matrix<double, kFixed, kFixed> covariance = information.llt().solve(Eigen::MatrixXd::Identity(all, kFixed)).topRows<kFixed>();
  found.covariance = covariance.topLeftCorner(n, n);
  const Eigen::Matrix<double, 2, Eigen::Dynamic, 0, 2, kMaxPatternUnknowns> with_pattern = covariance.block(kMaxPatternUnknowns, 0, 2, n);
  found.lights_covariance = with_pattern * PatternMatrix(found.covariance.inverse()) * with_pattern.transpose();
  return found;
}

double PatternResiduals::misfit(const Pattern& pattern, const PatternFit& fit, double scale) const {
  const std::vector<Row> rows = rows_of(pattern);
  Eigen::VectorXd x = Eigen::VectorXd::Zero(unknowns(pattern));
  x.head(pattern.size()) = fit.value - pattern.already;
  x.tail(fit.beside.size()) = fit.beside;
  const double width = kCauchy * kCauchy * scale * scale;
  double sum = 0;
  for (const Row& r : rows) {
    const double now = residual(rows, r, x);
    sum += width * std::log1p(r.weight * now * now / width);
  }
  double priors = fit.beside.head<kLights>().cwiseQuotient(lights_sd(options_)).squaredNorm() + fit.value.cwiseQuotient(pattern.prior_sd).squaredNorm();
  if (pattern.exposure_sd > 0) priors += fit.beside.tail(fit.beside.size() - kLights).squaredNorm() / (pattern.exposure_sd * pattern.exposure_sd);
  return share_of(rows.size(), independent_, scale) * sum + priors;
}

double PatternFit::chi2(Eigen::Index first, Eigen::Index count) const {
  const PatternVector part = value.segment(first, count);
  const PatternMatrix information = covariance.block(first, first, count, count).inverse();
  return part.dot(information * part);
}

}  // namespace chiaro::optimize
