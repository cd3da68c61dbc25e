#include "optimize/own_light.h"

#include <algorithm>
#include <array>
#include <cmath>

#include "optimize/light_residuals.h"

namespace chiaro::optimize {
namespace {

constexpr double kStill = 1e-3;        ///< of ln factor: over
constexpr double kLongestStep = 0.7;   ///< of ln factor
constexpr double kLeastSpread = 1e-3;    ///< of ln brightness
constexpr int kSpreadRounds = 8, kSpreadSteps = 2;   ///< of expectation maximisation, and of the factors in each
constexpr double kSpreadStill = 0.03;  ///< relative
constexpr std::size_t kTrials = 9;     ///< three photographs, in each of three ways
constexpr std::size_t kAtOnce = 20;    ///< one photograph in so many is added at a time, at least one

enum Kind : std::size_t { kAmbient, kExposure, kKinds };

/// What the samples say about the factors of all photographs, at the lights that suit them best. Row kKinds * photograph + kind is a factor's.
struct Information {
  Eigen::MatrixXd beside;               ///< with the lights, then with the factors in use
  std::vector<Eigen::Matrix2d> own;     ///< of a photograph's two factors
  Eigen::VectorXd gradient;
  Eigen::MatrixXd shared;               ///< of lights and factors in use
  Eigen::LDLT<Eigen::MatrixXd> solved;  ///< of `shared`
};

class Search {
 public:
  Search(std::span<const LightSample> samples, std::span<const ReferenceSample> references, const LightSolveOptions& options, const LightSolution& solution,
         std::span<const OwnLight> known, double known_spread, const OwnLightOptions& own)
      : samples_(samples.begin(), samples.end()), references_(references.begin(), references.end()), options_(options), own_(own), groups_(groups_of(samples_)),
        layout_(layout_of(options)), solution_(solution), before_(known.begin(), known.end()), now_(before_),
        surfels_(known.size(), 0), with_flash_(known.size(), false), unlike_(kKinds * known.size(), false), spread_(known_spread) {
    residuals_ = std::max(1.0, residuals_of(groups_));
    independent_ = independent_residuals(samples_, options_);
    for (const SampleGroup& g : groups_)
      for (std::size_t i = g.begin; i < g.end; ++i) {
        ++surfels_[samples_[i].photograph];
        if (samples_[i].flash_photograph) with_flash_[samples_[i].photograph] = true;
      }
    for (std::size_t k = 0; k < known.size(); ++k) {
      compared_ += surfels_[k] >= own.least_surfels;
      for (const std::size_t kind : {kAmbient, kExposure}) prior_sd_.push_back(kind == kAmbient ? own.ambient_ln_sd : own.exposure_ln_sd);
      if (known[k].ambient != 1) free_factor(kKinds * k + kAmbient);
      if (known[k].unlike) free_factor(kKinds * k + kExposure);
      members_ += in_use(k);
    }
  }

  OwnLights run() {
    if (compared_ < 3) return found();
    if (spread_ > 0) {
      let_all_vary();
      return found();
    }
    const Search start = *this;
    add_unlike();
    if (!own_.may_vary || (members_ == 0 && asked_by_all() < own_.evidence)) return found();
    std::vector<Search> tried{*this, start};   // some are unlike the others; all vary; both
    tried[1].forget_all();
    tried[1].let_all_vary();
    if (members_ > 0) {
      tried.push_back(*this);
      tried[2].let_all_vary();
    }
    // That all vary has to be very likely beside that none does. Beside that one is unlike the others, as few photographs may leave open, it is what claims less.
    const double handicap[] = {0, members_ > 0 ? -own_.evidence : own_.evidence, own_.evidence};
    double scale = scale_;
    for (const Search& t : tried) scale = std::min(scale, t.scale_);
    std::size_t best = 0;
    double least = 0;
    for (std::size_t t = 0; t < tried.size(); ++t) {
      const double evidence = misfit(tried[t].outcome(), scale) + tried[t].occam() + handicap[t];
      if (t > 0 && (!(evidence < least) || !(tried[t].spread_ > own_.least_spread))) continue;
      least = evidence;
      best = t;
    }
    return tried[best].found();
  }

 private:
  void add_unlike() {
    settle(own_.rounds);
    while (add()) {
      settle(own_.rounds);
      if (!drop_small()) continue;
      settle(own_.rounds);
      return;
    }
  }

  /// What factors of brightness would lower twice the misfit by, each photograph for itself, added up: together they cannot do much more.
  double asked_by_all() const {
    const double sharper = dispersion_of(scale_) * dispersion_of(scale_);
    double sum = 0;
    for (std::size_t k = 0; k < now_.size(); ++k)
      if (surfels_[k] >= own_.least_surfels && with_flash_[k]) sum += sharper * gain(k, {kExposure});
    return sum;
  }

  OwnLights found() const {
    OwnLights result;
    result.of = now_;
    for (std::size_t k = 0; k < now_.size(); ++k) {
      result.of[k].ambient_ln_sd = result.of[k].exposure_ln_sd = 0;
      result.of[k].unlike = unlike_[kKinds * k + kExposure];
    }
    result.exposure_spread = spread_;
    if (!used_.empty() && at_.shared.size() > 0) uncertainty(result);
    return result;
  }

  void free_factor(std::size_t factor) {
    if (uses(factor)) return;
    used_.push_back(factor);
    unlike_[factor] = true;
  }

  /// No photograph has a factor.
  void forget_all() {
    std::vector<OwnLight> change(now_.size());
    for (std::size_t k = 0; k < now_.size(); ++k) change[k] = {1 / now_[k].ambient, 1 / now_[k].exposure};
    apply(change);
    used_.clear();
    std::fill(unlike_.begin(), unlike_.end(), false);
    members_ = 0;
  }

  /// A factor of brightness for all photographs that have none, with a prior as wide as they scatter.
  void let_all_vary() {
    if (!(spread_ > 0)) spread_ = kUsualSpread;
    std::vector<std::size_t> varying;
    for (std::size_t k = 0; k < now_.size(); ++k)
      if (const std::size_t f = kKinds * k + kExposure; surfels_[k] >= own_.least_surfels && with_flash_[k] && !unlike_[f]) {
        if (!uses(f)) used_.push_back(f);
        varying.push_back(f);
      }
    for (int round = 0; round < kSpreadRounds; ++round) {
      for (const std::size_t f : varying) prior_sd_[f] = spread_;
      settle(round == 0 ? own_.rounds : kSpreadSteps);
      const Eigen::MatrixXd covariance = factor_covariance();
      double sum = 0;
      for (std::size_t f = 0; f < used_.size(); ++f)
        if (!unlike_[used_[f]]) sum += std::pow(std::log(now_[used_[f] / kKinds].exposure), 2) + covariance(static_cast<Eigen::Index>(f), static_cast<Eigen::Index>(f));
      const double before = spread_;
      spread_ = std::clamp(std::sqrt(sum / static_cast<double>(varying.size())), kLeastSpread, own_.exposure_ln_sd);
      if (std::fabs(std::log(spread_ / before)) < kSpreadStill) break;
    }
  }

  /// -2 ln of what Laplace's approximation of the evidence has beside the misfit: how much of their priors the unknowns leave.
  double occam() const {
    double sum = at_.solved.vectorD().array().log().sum();
    for (const std::size_t f : used_) sum += 2 * std::log(prior_sd_[f]);
    return sum;
  }

  /// Lights and factors in use to where they suit the samples best.
  void settle(int rounds) {
    for (int round = 0; round < rounds; ++round) {
      solve();
      if (used_.empty() || step() < kStill) return;
    }
  }

  /// It has a factor that not all have.
  bool in_use(std::size_t k) const { return unlike_[kKinds * k + kAmbient] || unlike_[kKinds * k + kExposure]; }
  bool uses(std::size_t factor) const { return std::find(used_.begin(), used_.end(), factor) != used_.end(); }

  void solve() {
    solution_ = solve_lights(samples_, references_, options_, solution_.lights);
    scale_ = cauchy_scale(solution_.lights, samples_, groups_, layout_);
    gather(scale_, share_at(scale_));
  }

  /// Of the samples' information, what counts at that scale.
  double share_at(double scale) const { return independent_ / residuals_ / (dispersion_of(scale) * dispersion_of(scale)); }

  void gather(double scale, double share) {
    const auto p = static_cast<Eigen::Index>(layout_.size()), rows = static_cast<Eigen::Index>(kKinds * now_.size()), free = static_cast<Eigen::Index>(used_.size());
    at_ = Information();
    column_.assign(kKinds * now_.size(), -1);
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
      for (std::size_t kind = 0; kind < kKinds; ++kind) {
        at_.own[k](static_cast<Eigen::Index>(kind), static_cast<Eigen::Index>(kind)) += weight(kKinds * k + kind);
        at_.gradient[static_cast<Eigen::Index>(kKinds * k + kind)] -= weight(kKinds * k + kind) * std::log(kind == kAmbient ? now_[k].ambient : now_[k].exposure);
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
  void add_group(std::span<const LightSample> samples, const Deviations& d, Eigen::MatrixXd& lights) {
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
      for (std::size_t kind = 0; kind < kKinds; ++kind)
        if (const Eigen::Index column = column_[kKinds * samples[d.sample[t]].photograph + kind]; column >= 0) used_here_.push_back({t, column, effect_[t][kind]});
    for (std::size_t t = 0; t < d.r.size(); ++t) {
      const double v = d.w[t] * d.robust[t];
      const std::size_t k = samples[d.sample[t]].photograph;
      const Eigen::VectorXd j = (d.j[t] - d.mean_j).head(p);
      lights += v * j * j.transpose();
      for (std::size_t kind = 0; kind < kKinds; ++kind) {
        const auto row = static_cast<Eigen::Index>(kKinds * k + kind);
        const double u = v * effect_[t][kind];
        at_.gradient[row] -= u * (d.r[t] - d.mean_r);
        at_.beside.row(row).head(p) += u * j.transpose();
        for (std::size_t other = 0; other < kKinds; ++other)
          at_.own[k](static_cast<Eigen::Index>(kind), static_cast<Eigen::Index>(other)) += u * effect_[t][other] * (1 - v / sum);
        for (const UsedHere& f : used_here_) at_.beside(row, p + f.column) += u * f.effect * ((f.sample == t ? 1.0 : 0.0) - d.w[f.sample] * d.robust[f.sample] / sum);
      }
    }
  }

  /// One step of the factors in use, the lights following. Returns how far the farthest moved.
  double step() {
    if (used_.empty()) return 0;
    const Eigen::VectorXd x = at_.solved.solve(shared_gradient());
    double farthest = 0;
    std::vector<OwnLight> change(now_.size());
    for (std::size_t f = 0; f < used_.size(); ++f) {
      const double by = std::clamp(x[static_cast<Eigen::Index>(layout_.size()) + static_cast<Eigen::Index>(f)], -kLongestStep, kLongestStep);
      (used_[f] % kKinds == kAmbient ? change[used_[f] / kKinds].ambient : change[used_[f] / kKinds].exposure) *= std::exp(by);
      farthest = std::max(farthest, std::fabs(by));
    }
    apply(change);
    return farthest;
  }

  void apply(const std::vector<OwnLight>& change) {
    for (std::size_t k = 0; k < now_.size(); ++k) {
      now_[k].ambient *= change[k].ambient;
      now_[k].exposure *= change[k].exposure;
    }
    for (LightSample& s : samples_) change_own_light(s, change[s.photograph].ambient, change[s.photograph].exposure);
    for (ReferenceSample& r : references_) change_own_light(r.sample, change[r.sample.photograph].ambient, change[r.sample.photograph].exposure);
  }

  /// The lights are where theirs is nothing.
  Eigen::VectorXd shared_gradient() const {
    Eigen::VectorXd g = Eigen::VectorXd::Zero(at_.shared.rows());
    for (std::size_t f = 0; f < used_.size(); ++f) g[static_cast<Eigen::Index>(layout_.size()) + static_cast<Eigen::Index>(f)] = at_.gradient[static_cast<Eigen::Index>(used_[f])];
    return g;
  }

  /// What freeing some factors of one photograph lowers twice the misfit by, with the lights and those in use following.
  double gain(std::size_t k, std::initializer_list<Kind> kinds) const {
    const auto n = static_cast<Eigen::Index>(kinds.size());
    Eigen::MatrixXd beside(n, at_.shared.rows()), own(n, n);
    Eigen::VectorXd g(n);
    Eigen::Index row = 0;
    for (const Kind a : kinds) {
      beside.row(row) = at_.beside.row(static_cast<Eigen::Index>(kKinds * k + a));
      g[row] = at_.gradient[static_cast<Eigen::Index>(kKinds * k + a)];
      Eigen::Index column = 0;
      for (const Kind b : kinds) own(row, column++) = at_.own[k](static_cast<Eigen::Index>(a), static_cast<Eigen::Index>(b));
      ++row;
    }
    const Eigen::MatrixXd left = own - beside * at_.solved.solve(beside.transpose());
    g -= beside * at_.solved.solve(shared_gradient());
    return g.dot(left.ldlt().solve(g));
  }

  /// Photographs whose factors are small, or say little more than factors of the photographs that have none would say, lose them again. Returns whether there were any.
  bool drop_small() {
    std::vector<double> others;
    for (std::size_t k = 0; k < now_.size(); ++k)
      if (surfels_[k] >= own_.least_surfels && with_flash_[k] && !in_use(k)) others.push_back(std::max(gain(k, {kAmbient}), gain(k, {kExposure})));
    const double least = own_.least_deviations * own_.least_deviations * upper_median(others);
    std::vector<OwnLight> change(now_.size());
    bool any = false;
    for (const Added& a : added_) {
      const std::size_t k = a.photograph;
      const bool large = std::fabs(std::log(now_[k].ambient)) >= own_.least_ambient || std::fabs(std::log(now_[k].exposure)) >= own_.least_exposure;
      if (!in_use(k) || (large && a.chi2 >= least)) continue;
      any = true;
      --members_;
      change[k] = {before_[k].ambient / now_[k].ambient, before_[k].exposure / now_[k].exposure};
      std::erase_if(used_, [&](std::size_t f) { return f / kKinds == k; });
      unlike_[kKinds * k + kAmbient] = unlike_[kKinds * k + kExposure] = false;
    }
    if (!any) return false;
    apply(change);
    for (std::size_t k = 0; k < now_.size(); ++k)
      if (!in_use(k)) now_[k] = before_[k];   // to the last digit
    return true;
  }

  /// A way to free factors of a photograph.
  struct Candidate {
    std::size_t photograph;
    bool ambient, exposure;
    double criterion;   ///< by the slope and the curvature of the misfit where it is; smaller is better
  };

  void consider(std::size_t k, std::vector<Candidate>& all) const {
    if (surfels_[k] < own_.least_surfels || (!in_use(k) && 2 * (members_ + 1) >= compared_)) return;
    // What a wrong factor adds to the scatter must not hide it.
    const double price = std::log(std::max(2.0, independent_)), sharper = dispersion_of(scale_) * dispersion_of(scale_);
    const bool ambient = solution_.sky_terms > 0 && !uses(kKinds * k + kAmbient), exposure = with_flash_[k] && !uses(kKinds * k + kExposure);   // without flash nothing tells one from the other
    if (ambient) all.push_back({k, true, false, price - sharper * gain(k, {kAmbient})});
    if (exposure) all.push_back({k, false, true, price - sharper * gain(k, {kExposure})});
    if (ambient && exposure) all.push_back({k, true, true, 2 * price - sharper * gain(k, {kAmbient, kExposure})});
  }

  /// chi2: what it lowers twice the misfit by.
  void use(const Candidate& c, double chi2) {
    if (!in_use(c.photograph)) {
      added_.push_back({c.photograph, chi2});
      ++members_;
    }
    if (c.ambient) free_factor(kKinds * c.photograph + kAmbient);
    if (c.exposure) free_factor(kKinds * c.photograph + kExposure);
  }

  /// Where a way that was tried ended.
  struct Outcome {
    Lights lights;
    double outside_misfit, scale;
    std::vector<OwnLight> own;
    std::vector<double> prior_sd;
  };
  Outcome outcome() const { return {solution_.lights, solution_.outside_misfit, scale_, now_, prior_sd_}; }

  /// Twice the misfit of samples, references and priors there; weights are those of where it was tried from, and the scale is one for all ways.
  double misfit(const Outcome& there, double scale) const {
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
      factors += std::pow(std::log(there.own[k].ambient) / there.prior_sd[kKinds * k + kAmbient], 2) + std::pow(std::log(there.own[k].exposure) / there.prior_sd[kKinds * k + kExposure], 2);
    return share_at(scale) * sum + 2 * there.outside_misfit + factors;
  }

  /// Frees factors of the photograph that asks most: of the likeliest candidates the one that explains most once all is settled. Returns whether there was one.
  bool add() {
    std::vector<Candidate> candidates;
    for (std::size_t k = 0; k < now_.size(); ++k) consider(k, candidates);
    std::erase_if(candidates, [&](const Candidate& c) { return !(c.criterion < -own_.evidence); });
    if (candidates.empty()) return false;
    std::stable_sort(candidates.begin(), candidates.end(), [](const Candidate& a, const Candidate& b) { return a.criterion < b.criterion; });
    std::vector<Outcome> tried;
    double scale = scale_;
    for (std::size_t t = 0; t < std::min(kTrials, candidates.size()); ++t) {
      Search trial = *this;
      trial.use(candidates[t], 0);
      trial.settle(own_.rounds);
      tried.push_back(trial.outcome());
      scale = std::min(scale, trial.scale_);
    }
    const double price = std::log(std::max(2.0, independent_)), reference = misfit(outcome(), scale);
    std::size_t best = 0;
    double least = 0;
    for (std::size_t t = 0; t < tried.size(); ++t) {
      const double criterion = misfit(tried[t], scale) - reference + price * static_cast<double>(candidates[t].ambient + candidates[t].exposure);
      if (t > 0 && !(criterion < least)) continue;
      least = criterion;
      best = t;
    }
    const Candidate c = candidates[best];
    if (!(least < -own_.evidence)) return false;
    use(c, price * static_cast<double>(c.ambient + c.exposure) - least);
    // With many photographs several at once: what was too much is dropped again.
    std::size_t places = compared_ / kAtOnce;
    for (const Candidate& more : candidates) {
      if (places <= 1 || !(more.criterion < 0.5 * candidates[0].criterion)) break;
      if (in_use(more.photograph) || 2 * (members_ + 1) >= compared_) continue;
      use(more, -more.criterion);
      --places;
    }
    return true;
  }

  Eigen::MatrixXd follow() const {
    const auto p = static_cast<Eigen::Index>(layout_.size()), free = static_cast<Eigen::Index>(used_.size());
    return Eigen::LDLT<Eigen::MatrixXd>(at_.shared.topLeftCorner(p, p)).solve(at_.shared.topRightCorner(p, free));
  }

  /// Of the factors in use, the lights following.
  Eigen::MatrixXd factor_covariance() const {
    const auto p = static_cast<Eigen::Index>(layout_.size()), free = static_cast<Eigen::Index>(used_.size());
    return (at_.shared.bottomRightCorner(free, free) - at_.shared.bottomLeftCorner(free, p) * follow()).ldlt().solve(Eigen::MatrixXd::Identity(free, free));
  }

  void uncertainty(OwnLights& found) const {
    const Eigen::MatrixXd covariance = factor_covariance(), lights = follow().topRows(2);
    for (std::size_t f = 0; f < used_.size(); ++f) {
      OwnLight& own = found.of[used_[f] / kKinds];
      (used_[f] % kKinds == kAmbient ? own.ambient_ln_sd : own.exposure_ln_sd) = std::sqrt(std::max(0.0, covariance(static_cast<Eigen::Index>(f), static_cast<Eigen::Index>(f))));
    }
    found.lights_covariance = lights * covariance * lights.transpose();
  }

  std::vector<LightSample> samples_;
  std::vector<ReferenceSample> references_;
  const LightSolveOptions& options_;
  const OwnLightOptions& own_;
  const std::vector<SampleGroup> groups_;
  const LightLayout layout_;
  LightSolution solution_;
  const std::vector<OwnLight> before_;
  std::vector<OwnLight> now_;
  std::vector<std::size_t> surfels_, used_;   ///< used_: rows of Information
  struct Added {
    std::size_t photograph;
    double chi2;
  };
  std::vector<Added> added_;   ///< in this search
  std::vector<bool> with_flash_, unlike_;   ///< unlike_: of each factor, one that not all photographs have
  std::vector<double> prior_sd_;            ///< of each factor
  /// A factor in use that acts on a sample of the group.
  struct UsedHere {
    std::size_t sample;
    Eigen::Index column;
    double effect;
  };
  std::vector<UsedHere> used_here_;
  std::vector<Eigen::Index> column_;        ///< of each factor among those in use; -1
  double spread_ = 0;
  std::size_t compared_ = 0, members_ = 0;
  double independent_ = 0, residuals_ = 0, scale_ = 0;
  Information at_;
  std::vector<std::array<double, kKinds>> effect_;
};

}  // namespace

void change_own_light(LightSample& s, double ambient, double exposure) {
  const auto by = static_cast<float>(ambient), even = static_cast<float>(1 / exposure);
  for (float& t : s.sky) t *= by;
  for (float& t : s.hidden) t *= by;
  for (float& b : s.radiosity) b *= even;
  for (float& g : s.gathered) g *= even;
}

OwnLights find_own_lights(std::span<const LightSample> samples, std::span<const ReferenceSample> references, const LightSolveOptions& options, const LightSolution& solution,
                          std::span<const OwnLight> known, double known_spread, const OwnLightOptions& own_options) {
  return Search(samples, references, options, solution, known, known_spread, own_options).run();
}

}  // namespace chiaro::optimize
