#include "optimize/own_light.h"

#include <algorithm>
#include <array>
#include <cmath>

#include "optimize/own_light_fit.h"

namespace chiaro::optimize {
namespace {

constexpr double kLeastSpread = 1e-3;    ///< of ln of a factor
constexpr int kSpreadRounds = 8, kSpreadSteps = 2;   ///< of expectation maximisation, and of the factors in each
constexpr double kSpreadStill = 0.03;  ///< relative
constexpr std::size_t kTrials = 9;     ///< three photographs, in each of three ways
constexpr std::size_t kAtOnce = 20;    ///< one photograph in so many is added at a time, at least one

using Kinds = std::vector<FactorKind>;

class Search {
 public:
  Search(std::span<const LightSample> samples, std::span<const ReferenceSample> references, const LightSolveOptions& options, const LightSolution& solution,
         std::span<const OwnLight> known, const LightSpread& known_spread, const OwnLightOptions& own)
      : fit_(samples, references, options, solution, known, priors(known.size(), own)), own_(own), before_(known.begin(), known.end()),
        surfels_(known.size(), 0), with_flash_(known.size(), false), unlike_(kFactorKinds * known.size(), false), spread_(known_spread) {
    for (const SampleGroup& g : groups_of(samples))
      for (std::size_t i = g.begin; i < g.end; ++i) {
        ++surfels_[samples[i].photograph];
        if (samples[i].flash_photograph) with_flash_[samples[i].photograph] = true;
      }
    for (std::size_t k = 0; k < known.size(); ++k) {
      compared_ += surfels_[k] >= own.least_surfels;
      if (known[k].unlike_ambient) free_factor(factor_of(k, kAmbient));
      if (known[k].unlike) free_factor(factor_of(k, kExposure));
      members_ += in_use(k);
    }
  }

  OwnLights run() {
    if (compared_ < 3) return found();
    if (const Kinds known = varying_kinds(); !known.empty()) return vary_further(known);
    const Search start = *this;
    add_unlike();
    if (!own_.may_vary || (members_ == 0 && std::max(asked_by_all(kAmbient), asked_by_all(kExposure)) < own_.evidence)) return found();
    return likeliest(start);
  }

 private:
  static std::vector<double> priors(std::size_t photographs, const OwnLightOptions& own) {
    std::vector<double> sd;
    for (std::size_t k = 0; k < photographs; ++k) sd.insert(sd.end(), {own.ambient_ln_sd, own.exposure_ln_sd});
    return sd;
  }

  Kinds varying_kinds() const {
    Kinds kinds;
    for (const FactorKind kind : {kAmbient, kExposure})
      if (spread_[kind] > 0) kinds.push_back(kind);
    return kinds;
  }

  /// A way that was tried, without what it held: with many photographs that is large.
  struct Way {
    OwnLights found;
    OwnLightOutcome outcome;
    double occam = 0, handicap = 0;
    bool varies = false;   ///< by each kind that may, and by enough
  };

  Way way(double handicap) const { return {found(), fit_.outcome(), fit_.occam(), handicap, all_vary_enough()}; }

  static Way try_to_vary(Search search, const Kinds& kinds, double handicap) {
    search.let_vary(kinds);
    return search.way(handicap);
  }

  /// With what is known to vary, and with the other kind beside it if that is very likely.
  OwnLights vary_further(const Kinds& known) const {
    Search same = *this;
    same.let_vary(known);
    for (const FactorKind kind : known)
      if (!same.varies_enough(kind)) return without(kind);
    if (known.size() == kFactorKinds || !fit_.has_sky()) return same.found();
    const std::vector<Way> ways{same.way(0), try_to_vary(*this, {kAmbient, kExposure}, own_.evidence)};
    return ways[same.best_of(ways)].found;
  }

  /// Where a kind hardly varies once another one is followed as well.
  OwnLights without(FactorKind kind) const {
    Search less = *this;
    less.forget(kind);
    const Kinds left = less.varying_kinds();
    return left.empty() ? less.found() : less.vary_further(left);
  }

  /// Of this search, in which single photographs are unlike the others, and of all varying instead or beside it, what the evidence speaks for. start: before there were any.
  OwnLights likeliest(Search start) const {
    start.forget_all();
    std::vector<Way> ways{way(0)};
    const auto try_kinds = [&](const Kinds& kinds) {
      ways.push_back(try_to_vary(start, kinds, handicap(kinds)));
      if (members_ > 0) ways.push_back(try_to_vary(*this, kinds, own_.evidence * static_cast<double>(kinds.size())));
    };
    try_kinds({kExposure});
    if (fit_.has_sky()) try_kinds({kAmbient});
    if (fit_.has_sky() && best_of(ways) > 0) try_kinds({kAmbient, kExposure});
    return ways[best_of(ways)].found;
  }

  /// That all vary has to be very likely beside that none does. That they do claims less, where few photographs leave it open, than that one is unlike the others.
  double handicap(const Kinds& kinds) const {
    const auto n = static_cast<double>(kinds.size());
    return own_.evidence * (members_ == 0 ? n : n == 1 ? -1 : 1);
  }

  bool varies_enough(FactorKind kind) const { return spread_[kind] > own_.least_spread[kind]; }
  bool all_vary_enough() const {
    const Kinds kinds = varying_kinds();
    return !kinds.empty() && std::all_of(kinds.begin(), kinds.end(), [&](FactorKind kind) { return varies_enough(kind); });
  }

  /// By twice the negative logarithm of the evidence. The first stands unless another is better in which something varies.
  std::size_t best_of(const std::vector<Way>& ways) const {
    double scale = fit_.scale(), least = 0;
    for (const Way& w : ways) scale = std::min(scale, w.outcome.scale);
    std::size_t best = 0;
    for (std::size_t w = 0; w < ways.size(); ++w) {
      const double evidence = fit_.misfit(ways[w].outcome, scale) + ways[w].occam + ways[w].handicap;
      if (w > 0 && (!(evidence < least) || !ways[w].varies)) continue;
      least = evidence;
      best = w;
    }
    return best;
  }

  void add_unlike() {
    fit_.settle(own_.rounds);
    while (add()) {
      fit_.settle(own_.rounds);
      if (!drop_small()) continue;
      fit_.settle(own_.rounds);
      return;
    }
  }

  bool may_have(std::size_t k, FactorKind kind) const { return surfels_[k] >= own_.least_surfels && (kind == kExposure ? with_flash_[k] : fit_.has_sky()); }

  /// What factors of a kind would lower twice the misfit by, each photograph for itself, added up: together they cannot do much more.
  double asked_by_all(FactorKind kind) const {
    const double sharper = dispersion_of(fit_.scale()) * dispersion_of(fit_.scale());
    double sum = 0;
    for (std::size_t k = 0; k < before_.size(); ++k)
      if (may_have(k, kind)) sum += sharper * fit_.gain(k, {kind});
    return sum;
  }

  OwnLights found() const {
    OwnLights result;
    result.of = fit_.now();
    for (std::size_t k = 0; k < result.of.size(); ++k) {
      result.of[k].ambient_ln_sd = result.of[k].exposure_ln_sd = 0;
      result.of[k].unlike = unlike_[factor_of(k, kExposure)];
      result.of[k].unlike_ambient = unlike_[factor_of(k, kAmbient)];
    }
    result.spread = spread_;
    if (fit_.used().empty() || !fit_.settled()) return result;
    const Eigen::MatrixXd covariance = fit_.factor_covariance();
    for (std::size_t f = 0; f < fit_.used().size(); ++f) {
      OwnLight& own = result.of[fit_.used()[f] / kFactorKinds];
      (fit_.used()[f] % kFactorKinds == kAmbient ? own.ambient_ln_sd : own.exposure_ln_sd) = std::sqrt(std::max(0.0, covariance(static_cast<Eigen::Index>(f), static_cast<Eigen::Index>(f))));
    }
    result.lights_covariance = fit_.lights_covariance();
    return result;
  }

  void free_factor(std::size_t factor) {
    if (fit_.uses(factor)) return;
    fit_.use(factor);
    unlike_[factor] = true;
  }

  /// A kind does not vary; photographs that are unlike the others keep their factors of it.
  void forget(FactorKind kind) {
    std::vector<OwnLight> change(before_.size());
    for (std::size_t k = 0; k < before_.size(); ++k)
      if (!unlike_[factor_of(k, kind)]) change[k].factor(kind) = 1 / fit_.now()[k].factor(kind);
    fit_.apply(change);
    for (std::size_t k = 0; k < before_.size(); ++k) {
      if (unlike_[factor_of(k, kind)]) continue;
      OwnLight now = fit_.now()[k];
      now.factor(kind) = 1;   // to the last digit
      fit_.set_now(k, now);
    }
    spread_[kind] = 0;
  }

  /// No photograph has a factor.
  void forget_all() {
    std::vector<OwnLight> change(before_.size());
    for (std::size_t k = 0; k < before_.size(); ++k) change[k] = {1 / fit_.now()[k].ambient, 1 / fit_.now()[k].exposure};
    fit_.apply(change);
    for (std::size_t k = 0; k < before_.size(); ++k) fit_.hold(k);
    std::fill(unlike_.begin(), unlike_.end(), false);
    members_ = 0;
  }

  /// Factors of these kinds for all photographs that have none of their own, with a prior as wide as they scatter.
  void let_vary(const Kinds& kinds) {
    std::array<std::size_t, kFactorKinds> varying{};
    for (const FactorKind kind : kinds) {
      if (!(spread_[kind] > 0)) spread_[kind] = kUsualSpread[kind];
      for (std::size_t k = 0; k < before_.size(); ++k)
        if (const std::size_t f = factor_of(k, kind); may_have(k, kind) && !unlike_[f]) {
          fit_.use(f);
          ++varying[kind];
        }
    }
    for (int round = 0; round < kSpreadRounds; ++round) {
      for (const std::size_t f : fit_.used())
        if (!unlike_[f]) fit_.set_prior(f, spread_[f % kFactorKinds]);
      fit_.settle(round == 0 ? own_.rounds : kSpreadSteps);
      if (widen(kinds, varying)) break;
    }
  }

  /// How far the factors scatter now. Returns whether that has not changed.
  bool widen(const Kinds& kinds, const std::array<std::size_t, kFactorKinds>& varying) {
    const Eigen::MatrixXd covariance = fit_.factor_covariance();
    std::array<double, kFactorKinds> sum{};
    for (std::size_t f = 0; f < fit_.used().size(); ++f) {
      const std::size_t factor = fit_.used()[f];
      const auto kind = static_cast<FactorKind>(factor % kFactorKinds);
      if (!unlike_[factor]) sum[kind] += std::pow(std::log(fit_.now()[factor / kFactorKinds].factor(kind)), 2) + covariance(static_cast<Eigen::Index>(f), static_cast<Eigen::Index>(f));
    }
    bool still = true;
    for (const FactorKind kind : kinds) {
      const double before = spread_[kind];
      if (varying[kind] > 0) spread_[kind] = std::clamp(std::sqrt(sum[kind] / static_cast<double>(varying[kind])), kLeastSpread, kind == kAmbient ? own_.ambient_ln_sd : own_.exposure_ln_sd);
      still = still && std::fabs(std::log(spread_[kind] / before)) < kSpreadStill;
    }
    return still;
  }

  /// It has a factor that not all have.
  bool in_use(std::size_t k) const { return unlike_[factor_of(k, kAmbient)] || unlike_[factor_of(k, kExposure)]; }

  /// Photographs whose factors are small, or say little more than factors of the photographs that have none would say, lose them again. Returns whether there were any.
  bool drop_small() {
    std::vector<double> others;
    for (std::size_t k = 0; k < before_.size(); ++k)
      if (surfels_[k] >= own_.least_surfels && with_flash_[k] && !in_use(k)) others.push_back(std::max(fit_.gain(k, {kAmbient}), fit_.gain(k, {kExposure})));
    const double least = own_.least_deviations * own_.least_deviations * upper_median(others);
    std::vector<OwnLight> change(before_.size());
    bool any = false;
    for (const Added& a : added_) {
      const std::size_t k = a.photograph;
      const OwnLight& now = fit_.now()[k];
      const bool large = std::fabs(std::log(now.ambient)) >= own_.least_ambient || std::fabs(std::log(now.exposure)) >= own_.least_exposure;
      if (!in_use(k) || (large && a.chi2 >= least)) continue;
      any = true;
      --members_;
      change[k] = {before_[k].ambient / now.ambient, before_[k].exposure / now.exposure};
      fit_.hold(k);
      unlike_[factor_of(k, kAmbient)] = unlike_[factor_of(k, kExposure)] = false;
    }
    if (!any) return false;
    fit_.apply(change);
    for (std::size_t k = 0; k < before_.size(); ++k)
      if (!in_use(k)) fit_.set_now(k, before_[k]);   // to the last digit
    return true;
  }

  /// A way to free factors of a photograph.
  struct Candidate {
    std::size_t photograph;
    bool ambient, exposure;
    double criterion;   ///< by the slope and the curvature of the misfit where it is; smaller is better
  };

  double price() const { return std::log(std::max(2.0, fit_.independent())); }

  void consider(std::size_t k, std::vector<Candidate>& all) const {
    if (surfels_[k] < own_.least_surfels || (!in_use(k) && 2 * (members_ + 1) >= compared_)) return;
    // What a wrong factor adds to the scatter must not hide it.
    const double sharper = dispersion_of(fit_.scale()) * dispersion_of(fit_.scale());
    const bool ambient = fit_.has_sky() && !fit_.uses(factor_of(k, kAmbient)), exposure = with_flash_[k] && !fit_.uses(factor_of(k, kExposure));   // without flash nothing tells one from the other
    if (ambient) all.push_back({k, true, false, price() - sharper * fit_.gain(k, {kAmbient})});
    if (exposure) all.push_back({k, false, true, price() - sharper * fit_.gain(k, {kExposure})});
    if (ambient && exposure) all.push_back({k, true, true, 2 * price() - sharper * fit_.gain(k, {kAmbient, kExposure})});
  }

  /// chi2: what it lowers twice the misfit by.
  void use(const Candidate& c, double chi2) {
    if (!in_use(c.photograph)) {
      added_.push_back({c.photograph, chi2});
      ++members_;
    }
    if (c.ambient) free_factor(factor_of(c.photograph, kAmbient));
    if (c.exposure) free_factor(factor_of(c.photograph, kExposure));
  }

  /// Frees factors of the photograph that asks most: of the likeliest candidates the one that explains most once all is settled. Returns whether there was one.
  bool add() {
    std::vector<Candidate> candidates;
    for (std::size_t k = 0; k < before_.size(); ++k) consider(k, candidates);
    std::erase_if(candidates, [&](const Candidate& c) { return !(c.criterion < -own_.evidence); });
    if (candidates.empty()) return false;
    std::stable_sort(candidates.begin(), candidates.end(), [](const Candidate& a, const Candidate& b) { return a.criterion < b.criterion; });
    std::vector<OwnLightOutcome> tried;
    double scale = fit_.scale();
    for (std::size_t t = 0; t < std::min(kTrials, candidates.size()); ++t) {
      Search trial = *this;
      trial.use(candidates[t], 0);
      trial.fit_.settle(own_.rounds);
      tried.push_back(trial.fit_.outcome());
      scale = std::min(scale, trial.fit_.scale());
    }
    const double reference = fit_.misfit(fit_.outcome(), scale);
    std::size_t best = 0;
    double least = 0;
    for (std::size_t t = 0; t < tried.size(); ++t) {
      const double criterion = fit_.misfit(tried[t], scale) - reference + price() * static_cast<double>(candidates[t].ambient + candidates[t].exposure);
      if (t > 0 && !(criterion < least)) continue;
      least = criterion;
      best = t;
    }
    const Candidate c = candidates[best];
    if (!(least < -own_.evidence)) return false;
    use(c, price() * static_cast<double>(c.ambient + c.exposure) - least);
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

  OwnLightFit fit_;
  const OwnLightOptions& own_;
  const std::vector<OwnLight> before_;
  std::vector<std::size_t> surfels_;
  struct Added {
    std::size_t photograph;
    double chi2;
  };
  std::vector<Added> added_;   ///< in this search
  std::vector<bool> with_flash_, unlike_;   ///< unlike_: of each factor, one that not all photographs have
  LightSpread spread_{};
  std::size_t compared_ = 0, members_ = 0;
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
                          std::span<const OwnLight> known, const LightSpread& known_spread, const OwnLightOptions& own_options) {
  return Search(samples, references, options, solution, known, known_spread, own_options).run();
}

}  // namespace chiaro::optimize
