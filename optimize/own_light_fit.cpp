#include "optimize/own_light_fit.h"

#include <algorithm>
#include <cmath>

namespace chiaro::optimize {
namespace {

constexpr double kStill = 1e-3;        ///< of ln factor: over
constexpr double kLongestStep = 0.7;   ///< of ln factor

}  // namespace

OwnLightFit::OwnLightFit(std::span<const LightSample> samples, std::span<const ReferenceSample> references, const LightSolveOptions& options, const LightSolution& solution,
                         std::span<const OwnLight> known, std::vector<double> prior_sd)
    : samples_(samples.begin(), samples.end()), references_(references.begin(), references.end()), options_(options), groups_(groups_of(samples_)), layout_(layout_of(options)), solution_(solution),
      now_(known.begin(), known.end()), prior_sd_(std::move(prior_sd)) {
  residuals_ = std::max(1.0, residuals_of(groups_));
  independent_ = independent_residuals(samples_, options_);
}

bool OwnLightFit::uses(std::size_t factor) const { return std::find(used_.begin(), used_.end(), factor) != used_.end(); }

void OwnLightFit::use(std::size_t factor) {
  if (!uses(factor)) used_.push_back(factor);
}

void OwnLightFit::hold(std::size_t photograph) {
  std::erase_if(used_, [&](std::size_t f) { return f / kFactorKinds == photograph; });
}

void OwnLightFit::settle(int rounds) {
  for (int round = 0; round < rounds; ++round) {
    solve();
    if (used_.empty() || step() < kStill) return;
  }
}

void OwnLightFit::solve() {
  solution_ = solve_lights(samples_, references_, options_, solution_.lights);
  scale_ = cauchy_scale(solution_.lights, samples_, groups_, layout_);
  gather(scale_, share_at(scale_));
}

/// Of the samples' information, what counts at that scale.
double OwnLightFit::share_at(double scale) const { return independent_ / residuals_ / (dispersion_of(scale) * dispersion_of(scale)); }

void OwnLightFit::gather(double scale, double share) {
  const auto p = static_cast<Eigen::Index>(layout_.size()), rows = static_cast<Eigen::Index>(kFactorKinds * now_.size()), free = static_cast<Eigen::Index>(used_.size());
  at_ = Information();
  column_.assign(kFactorKinds * now_.size(), -1);
  for (std::size_t f = 0; f < used_.size(); ++f) column_[used_[f]] = static_cast<Eigen::Index>(f);
  at_.beside = Eigen::MatrixXd::Zero(rows, p + free);
  at_.own.assign(now_.size(), Eigen::Matrix2d::Zero());
  at_.gradient = Eigen::VectorXd::Zero(rows);
  Eigen::MatrixXd lights = Eigen::MatrixXd::Zero(p, p);
  Deviations d;
  for (const SampleGroup& g : groups_)
    for (int c = 0; c < 3; ++c)
      if (const auto samples = std::span(samples_).subspan(g.begin, g.end - g.begin); deviations(solution_.lights, solution_.lights, samples, c, layout_, scale, true, d)) add_group(samples, d, lights);
  for (auto* m : {&at_.beside, &lights}) *m *= share;
  at_.gradient *= share;
  for (Eigen::Matrix2d& m : at_.own) m *= share;
  const auto weight = [&](std::size_t factor) { return 1 / (prior_sd_[factor] * prior_sd_[factor]); };
  for (std::size_t k = 0; k < now_.size(); ++k)
    for (std::size_t kind = 0; kind < kFactorKinds; ++kind) {
      at_.own[k](static_cast<Eigen::Index>(kind), static_cast<Eigen::Index>(kind)) += weight(kFactorKinds * k + kind);
      at_.gradient[static_cast<Eigen::Index>(kFactorKinds * k + kind)] -= weight(kFactorKinds * k + kind) * std::log(now_[k].factor(static_cast<FactorKind>(kind)));
    }
  at_.shared = Eigen::MatrixXd::Zero(p + free, p + free);
  at_.shared.topLeftCorner(p, p) = lights + solution_.outside;
  for (Eigen::Index f = 0; f < free; ++f) {
    const auto row = static_cast<Eigen::Index>(used_[static_cast<std::size_t>(f)]);
    at_.beside(row, p + f) += weight(used_[static_cast<std::size_t>(f)]);
    at_.shared.row(p + f) = at_.beside.row(row);
    at_.shared.block(0, p + f, p, 1) = at_.beside.block(row, 0, 1, p).transpose();
  }
  for (Eigen::Index k = 0; k < p; ++k) at_.shared(k, k) += 1e-12;
  at_.solved.compute(at_.shared);
}

/// The albedo that the samples share is eliminated: a change of one of them moves their mean.
void OwnLightFit::add_group(std::span<const LightSample> samples, const Deviations& d, Eigen::MatrixXd& lights) {
  const Lights& x = solution_.lights;
  const auto p = static_cast<Eigen::Index>(layout_.size());
  double sum = 0;
  effect_.resize(d.r.size());
  for (std::size_t t = 0; t < d.r.size(); ++t) {
    sum += d.w[t] * d.robust[t];
    effect_[t] = {0.0, -1.0 - x.bounce * d.j[t][layout_.bounce()]};   // what is gathered is as bright as the photograph
    for (int k = 0; k < layout_.sky_terms; ++k) effect_[t][kAmbient] += x.sky[static_cast<std::size_t>(k)] * d.j[t][1 + k];
  }
  used_here_.clear();
  for (std::size_t t = 0; t < d.r.size(); ++t)
    for (std::size_t kind = 0; kind < kFactorKinds; ++kind)
      if (const Eigen::Index column = column_[kFactorKinds * samples[d.sample[t]].photograph + kind]; column >= 0) used_here_.push_back({t, column, effect_[t][kind]});
  for (std::size_t t = 0; t < d.r.size(); ++t) {
    const double v = d.w[t] * d.robust[t];
    const std::size_t k = samples[d.sample[t]].photograph;
    const Eigen::VectorXd j = (d.j[t] - d.mean_j).head(p);
    lights += v * j * j.transpose();
    for (std::size_t kind = 0; kind < kFactorKinds; ++kind) {
      const auto row = static_cast<Eigen::Index>(kFactorKinds * k + kind);
      const double u = v * effect_[t][kind];
      at_.gradient[row] -= u * (d.r[t] - d.mean_r);
      at_.beside.row(row).head(p) += u * j.transpose();
      for (std::size_t other = 0; other < kFactorKinds; ++other)
        at_.own[k](static_cast<Eigen::Index>(kind), static_cast<Eigen::Index>(other)) += u * effect_[t][other] * (1 - v / sum);
      for (const UsedHere& f : used_here_) at_.beside(row, p + f.column) += u * f.effect * ((f.sample == t ? 1.0 : 0.0) - d.w[f.sample] * d.robust[f.sample] / sum);
    }
  }
}

/// One step of the factors in use, the lights following. Returns how far the farthest moved.
double OwnLightFit::step() {
  if (used_.empty()) return 0;
  const Eigen::VectorXd x = at_.solved.solve(shared_gradient());
  double farthest = 0;
  std::vector<OwnLight> change(now_.size());
  for (std::size_t f = 0; f < used_.size(); ++f) {
    const double by = std::clamp(x[static_cast<Eigen::Index>(layout_.size()) + static_cast<Eigen::Index>(f)], -kLongestStep, kLongestStep);
    change[used_[f] / kFactorKinds].factor(static_cast<FactorKind>(used_[f] % kFactorKinds)) *= std::exp(by);
    farthest = std::max(farthest, std::fabs(by));
  }
  apply(change);
  return farthest;
}

void OwnLightFit::apply(const std::vector<OwnLight>& change) {
  for (std::size_t k = 0; k < now_.size(); ++k) {
    now_[k].ambient *= change[k].ambient;
    now_[k].exposure *= change[k].exposure;
  }
  for (LightSample& s : samples_) change_own_light(s, change[s.photograph].ambient, change[s.photograph].exposure);
  for (ReferenceSample& r : references_) change_own_light(r.sample, change[r.sample.photograph].ambient, change[r.sample.photograph].exposure);
}

/// The lights are where theirs is nothing.
Eigen::VectorXd OwnLightFit::shared_gradient() const {
  Eigen::VectorXd g = Eigen::VectorXd::Zero(at_.shared.rows());
  for (std::size_t f = 0; f < used_.size(); ++f) g[static_cast<Eigen::Index>(layout_.size()) + static_cast<Eigen::Index>(f)] = at_.gradient[static_cast<Eigen::Index>(used_[f])];
  return g;
}

double OwnLightFit::gain(std::size_t k, std::initializer_list<FactorKind> kinds) const {
  const auto n = static_cast<Eigen::Index>(kinds.size());
  Eigen::MatrixXd beside(n, at_.shared.rows()), own(n, n);
  Eigen::VectorXd g(n);
  Eigen::Index row = 0;
  for (const FactorKind a : kinds) {
    beside.row(row) = at_.beside.row(static_cast<Eigen::Index>(kFactorKinds * k + a));
    g[row] = at_.gradient[static_cast<Eigen::Index>(kFactorKinds * k + a)];
    Eigen::Index column = 0;
    for (const FactorKind b : kinds) own(row, column++) = at_.own[k](static_cast<Eigen::Index>(a), static_cast<Eigen::Index>(b));
    ++row;
  }
  const Eigen::MatrixXd left = own - beside * at_.solved.solve(beside.transpose());
  g -= beside * at_.solved.solve(shared_gradient());
  return g.dot(left.ldlt().solve(g));
}

double OwnLightFit::misfit(const OwnLightOutcome& there, double scale) const {
  double sum = 0, factors = 0;
  Deviations d, weigh;
  std::vector<LightSample> changed;
  for (const SampleGroup& g : groups_) {
    const auto samples = std::span(samples_).subspan(g.begin, g.end - g.begin);
    changed.assign(samples.begin(), samples.end());
    for (LightSample& s : changed) change_own_light(s, there.own[s.photograph].ambient / now_[s.photograph].ambient, there.own[s.photograph].exposure / now_[s.photograph].exposure);
    for (int c = 0; c < 3; ++c) {
      if (!deviations(solution_.lights, solution_.lights, samples, c, layout_, scale, false, weigh) || !deviations(there.lights, there.lights, changed, c, layout_, scale, false, d) || d.r.size() != weigh.r.size()) continue;
      for (std::size_t k = 0; k < d.r.size(); ++k) sum += scale * scale * std::log1p(weigh.w[k] * (d.r[k] - d.mean_r) * (d.r[k] - d.mean_r) / (scale * scale));
    }
  }
  for (std::size_t k = 0; k < there.own.size(); ++k)
    factors += std::pow(std::log(there.own[k].ambient) / there.prior_sd[kFactorKinds * k + kAmbient], 2) + std::pow(std::log(there.own[k].exposure) / there.prior_sd[kFactorKinds * k + kExposure], 2);
  return share_at(scale) * sum + 2 * there.outside_misfit + factors;
}

double OwnLightFit::occam() const {
  double sum = at_.solved.vectorD().array().log().sum();
  for (const std::size_t f : used_) sum += 2 * std::log(prior_sd_[f]);
  return sum;
}

Eigen::MatrixXd OwnLightFit::follow() const {
  const auto p = static_cast<Eigen::Index>(layout_.size()), free = static_cast<Eigen::Index>(used_.size());
  return Eigen::LDLT<Eigen::MatrixXd>(at_.shared.topLeftCorner(p, p)).solve(at_.shared.topRightCorner(p, free));
}

Eigen::MatrixXd OwnLightFit::factor_covariance() const {
  const auto p = static_cast<Eigen::Index>(layout_.size()), free = static_cast<Eigen::Index>(used_.size());
  return (at_.shared.bottomRightCorner(free, free) - at_.shared.bottomLeftCorner(free, p) * follow()).ldlt().solve(Eigen::MatrixXd::Identity(free, free));
}

Eigen::Matrix2d OwnLightFit::lights_covariance() const {
  const Eigen::MatrixXd lights = follow().topRows(2);
  return lights * factor_covariance() * lights.transpose();
}

}  // namespace chiaro::optimize
