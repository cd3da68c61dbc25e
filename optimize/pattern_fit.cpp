#include "optimize/pattern_fit.h"

#include <algorithm>
#include <cmath>

#include "optimize/light_residuals.h"

namespace chiaro::optimize {
namespace {

constexpr Eigen::Index kFixed = kMaxPatternUnknowns + 3;   // the pattern, the lights; then ln of the photographs' factors
constexpr int kRounds = 8;
constexpr double kLeastScale = 0.1;

/// Of the information in `rows` residuals, what counts: so many are independent, and those that scatter more than expected say less.
double share_of(std::size_t rows, double independent, double scale) { return std::min(1.0, independent / static_cast<double>(std::max<std::size_t>(1, rows))) / std::max(1.0, scale * scale); }

Vec3d lights_sd(const PatternFitOptions& options) { return {options.lights_sd, options.lights_sd, options.bounce_sd}; }

double log_determinant(const Eigen::MatrixXd& a) { return 2 * Eigen::LLT<Eigen::MatrixXd>(a).matrixLLT().diagonal().array().log().sum(); }

}  // namespace

PatternResiduals::PatternResiduals(std::span<const LightSample> samples, const Lights& lights, const std::function<PatternEffect(const LightSample&)>& effect, double independent, const PatternFitOptions& options)
    : independent_(independent), options_(options) {
  for (const LightSample& s : samples) photographs_ = std::max<std::size_t>(photographs_, s.photograph + 1);
  std::vector<Row> group;
  for (std::size_t i = 0; i < samples.size();) {
    const std::uint32_t id = samples[i].group;
    group.clear();
    for (; i < samples.size() && samples[i].group == id; ++i)
      if (Row r; samples[i].flash_photograph && row_of(samples[i], lights, effect(samples[i]), r)) group.push_back(r);
    if (group.size() > 1) add_rows(group);
  }
}

/// False where the sample says nothing.
bool PatternResiduals::row_of(const LightSample& s, const Lights& lights, const PatternEffect& effect, Row& row) {
  row.photograph = s.photograph;
  for (int c = 0; c < 3; ++c) {
    const double h = irradiance(lights, s, c), b = body_radiosity(lights, s, c);
    if (!(h > 0) || !(b > 0)) return false;
    row.residual += std::log(b / h) / 3;
    const double direct = lights.flash_intensity * static_cast<double>(s.flash) / h, gathered = static_cast<double>(s.gathered[static_cast<std::size_t>(c)]) / h;
    row.effect.head(effect.of_flash.size()) -= (direct * effect.of_flash + effect.of_picture) / 3;
    row.effect.tail<kLights>() -= Vec3d(direct, std::max(0.0, 1 - direct - lights.bounce * gathered), gathered) / 3;
    row.own[kAmbient] -= std::max(0.0, 1 - direct - lights.bounce * gathered) / 3;
    row.own[kExposure] -= (1 - lights.bounce * gathered) / 3;   // what is gathered is as bright as the photograph
  }
  row.weight = sample_weight(lights, s) * static_cast<double>(s.trust);
  return row.weight > 0;
}

/// As deviations from the group's mean.
void PatternResiduals::add_rows(std::vector<Row>& group) {
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
    for (std::size_t kind = 0; kind < kFactorKinds; ++kind) r.in_mean[kind] = r.weight * r.own[kind] / weight;
  }
  rows_.insert(rows_.end(), group.begin(), group.end());
  begins_.push_back(rows_.size());
}

PatternResiduals::Places PatternResiduals::places(const LightSpread& open) const {
  Places p;
  p.all = kFixed;
  for (std::size_t kind = 0; kind < kFactorKinds; ++kind) {
    if (!(open[kind] > 0)) continue;
    p.first[kind] = p.all;
    p.all += static_cast<Eigen::Index>(photographs_);
  }
  return p;
}

std::vector<double> PatternResiduals::residuals(const Eigen::VectorXd& x, const Places& places) const {
  std::vector<double> now;
  const auto by_factors = [&](const Row& r, const std::array<double, kFactorKinds>& effect) {
    double sum = 0;
    for (std::size_t kind = 0; kind < kFactorKinds; ++kind)
      if (places.first[kind] > 0) sum += effect[kind] * x[places.first[kind] + r.photograph];
    return sum;
  };
  for (std::size_t g = 0; g < groups(); ++g) {
    double mean = 0;
    for (const Row& r : group(g)) mean += by_factors(r, r.in_mean);
    for (const Row& r : group(g)) now.push_back(r.residual + r.effect.dot(x.head<kFixed>()) + by_factors(r, r.own) - mean);
  }
  return now;
}

double PatternResiduals::deviation(const std::vector<double>& residuals) const {
  std::vector<double> sizes;
  for (std::size_t i = 0; i < residuals.size(); ++i) sizes.push_back(std::sqrt(rows_[i].weight) * std::fabs(residuals[i]));
  const auto mid = sizes.begin() + static_cast<std::ptrdiff_t>(sizes.size() / 2);
  std::nth_element(sizes.begin(), mid, sizes.end());
  return std::max(kLeastScale, 1.4826 * *mid);
}

/// Into the normal equations. On each row, a factor acts by its own photograph less the group's mean.
void PatternResiduals::add_group(std::span<const Row> group, std::span<const double> weights, const Places& places, Eigen::MatrixXd& a, Eigen::VectorXd& b) {
  double weight = 0, residual = 0;
  Effect effect = Effect::Zero();
  for (std::size_t r = 0; r < group.size(); ++r) {
    const Row& row = group[r];
    a.topLeftCorner<kFixed, kFixed>() += weights[r] * row.effect * row.effect.transpose();
    b.head<kFixed>() -= weights[r] * row.residual * row.effect;
    weight += weights[r];
    residual += weights[r] * row.residual;
    effect += weights[r] * row.effect;
  }
  for (std::size_t kind = 0; kind < kFactorKinds; ++kind) {
    if (places.first[kind] == 0) continue;
    for (std::size_t s = 0; s < group.size(); ++s) {
      const Row& own = group[s];
      const Eigen::Index k = places.first[kind] + own.photograph;
      const double v = weights[s] * own.own[kind], in_mean = own.in_mean[kind];
      a.col(k).head<kFixed>() += v * own.effect - in_mean * effect;
      b[k] -= v * own.residual - in_mean * residual;
      for (std::size_t other = 0; other < kFactorKinds; ++other) {
        const Eigen::Index first = places.first[other];
        if (first == 0) continue;
        a(first + own.photograph, k) += v * own.own[other];
        for (std::size_t t = 0; t < group.size(); ++t)
          a(first + group[t].photograph, k) += weight * in_mean * group[t].in_mean[other] - v * group[t].in_mean[other] - weights[t] * group[t].own[other] * in_mean;
      }
    }
  }
}

PatternFit PatternResiduals::fit(const Pattern& pattern) const {
  const Places places = this->places(pattern.open);
  const Eigen::Index n = pattern.size(), all = places.all, open = all - kFixed;
  PatternFit found;
  found.value = pattern.already;
  found.covariance = pattern.prior_sd.array().square().matrix().asDiagonal();
  found.beside = Eigen::VectorXd::Zero(all - kMaxPatternUnknowns);
  if (rows_.empty()) return found;
  Eigen::VectorXd prior = Eigen::VectorXd::Ones(all), x = Eigen::VectorXd::Zero(all);   // what this pattern does not have stays 0
  prior.head(n) = pattern.prior_sd.array().square().inverse();
  prior.segment<kLights>(kMaxPatternUnknowns) = lights_sd(options_).array().square().inverse();
  for (std::size_t kind = 0; kind < kFactorKinds; ++kind)
    if (places.first[kind] > 0) prior.segment(places.first[kind], static_cast<Eigen::Index>(photographs_)).setConstant(1 / (pattern.open[kind] * pattern.open[kind]));
  Eigen::MatrixXd information;
  std::vector<double> now = residuals(x, places), weights(now.size());
  found.before = deviation(now);
  for (int round = 0; round < kRounds; ++round) {
    const double scale = deviation(now), share = share_of(now.size(), independent_, scale);
    information = prior.asDiagonal();
    Eigen::VectorXd b = Eigen::VectorXd::Zero(all);
    b.head(n) = -prior.head(n).cwiseProduct(pattern.already);
    for (std::size_t i = 0; i < now.size(); ++i) weights[i] = share * rows_[i].weight / (1 + rows_[i].weight * now[i] * now[i] / (kCauchy * kCauchy * scale * scale));
    for (std::size_t g = 0; g < groups(); ++g) add_group(group(g), std::span(weights).subspan(begins_[g], group(g).size()), places, information, b);
    information.bottomLeftCorner(open, kFixed) = information.topRightCorner(kFixed, open).transpose();
    x = information.llt().solve(b);
    now = residuals(x, places);
  }
  found.after = deviation(now);
  found.value = pattern.already + x.head(n);
  found.beside = x.tail(all - kMaxPatternUnknowns);
  if (open > 0) found.occam = log_determinant(information) - log_determinant(information.topLeftCorner<kFixed, kFixed>()) - prior.tail(open).array().log().sum();
  const Eigen::Matrix<double, kFixed, kFixed> covariance = information.llt().solve(Eigen::MatrixXd::Identity(all, kFixed)).topRows<kFixed>();
  found.covariance = covariance.topLeftCorner(n, n);
  const Eigen::Matrix<double, 2, Eigen::Dynamic, 0, 2, kMaxPatternUnknowns> with_pattern = covariance.block(kMaxPatternUnknowns, 0, 2, n);
  found.lights_covariance = with_pattern * PatternMatrix(found.covariance.inverse()) * with_pattern.transpose();
  return found;
}

double PatternResiduals::misfit(const Pattern& pattern, const PatternFit& fit, double scale) const {
  const Places places = this->places(pattern.open);
  Eigen::VectorXd x = Eigen::VectorXd::Zero(places.all);
  x.head(pattern.size()) = fit.value - pattern.already;
  x.tail(fit.beside.size()) = fit.beside;
  const double width = kCauchy * kCauchy * scale * scale;
  double sum = 0;
  const std::vector<double> now = residuals(x, places);
  for (std::size_t i = 0; i < now.size(); ++i) sum += width * std::log1p(rows_[i].weight * now[i] * now[i] / width);
  double priors = fit.beside.head<kLights>().cwiseQuotient(lights_sd(options_)).squaredNorm() + fit.value.cwiseQuotient(pattern.prior_sd).squaredNorm();
  for (std::size_t kind = 0; kind < kFactorKinds; ++kind)
    if (places.first[kind] > 0) priors += x.segment(places.first[kind], static_cast<Eigen::Index>(photographs_)).squaredNorm() / (pattern.open[kind] * pattern.open[kind]);
  return share_of(now.size(), independent_, scale) * sum + priors;
}

double PatternFit::chi2(Eigen::Index first, Eigen::Index count) const {
  const PatternVector part = value.segment(first, count);
  const PatternMatrix information = covariance.block(first, first, count, count).inverse();
  return part.dot(information * part);
}

}  // namespace chiaro::optimize
