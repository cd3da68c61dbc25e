/// Factors on the ambient light and the brightness of single photographs, fitted beside the lights that all share: what own_light.cpp's search tries. Internal to optimize.
#pragma once
#include <array>
#include <initializer_list>
#include <vector>

#include "optimize/light_residuals.h"
#include "optimize/own_light.h"

namespace chiaro::optimize {

/// Factors of all photographs are numbered.
inline std::size_t factor_of(std::size_t photograph, FactorKind kind) { return kFactorKinds * photograph + kind; }

/// Where a fit ended.
struct OwnLightOutcome {
  Lights lights;
  double outside_misfit, scale;
  std::vector<OwnLight> own;
  std::vector<double> prior_sd;   ///< of each factor
};

class OwnLightFit {
 public:
  /// prior_sd: of ln of each factor, around 0. Parameters else as of find_own_lights(), whose spans `options` outlives.
  OwnLightFit(std::span<const LightSample> samples, std::span<const ReferenceSample> references, const LightSolveOptions& options, const LightSolution& solution, std::span<const OwnLight> known,
              std::vector<double> prior_sd);

  /// Lights and factors in use to where they suit the samples best, by so many rounds of Gauss-Newton at most.
  void settle(int rounds);

  const std::vector<OwnLight>& now() const { return now_; }
  const std::vector<std::size_t>& used() const { return used_; }   ///< factors
  bool uses(std::size_t factor) const;
  void use(std::size_t factor);
  /// The factors of a photograph are no longer free; they keep their values.
  void hold(std::size_t photograph);
  /// Changes factors of all photographs, in the samples too.
  void apply(const std::vector<OwnLight>& change);
  void set_now(std::size_t photograph, const OwnLight& own) { now_[photograph] = own; }
  void set_prior(std::size_t factor, double sd) { prior_sd_[factor] = sd; }

  bool has_sky() const { return solution_.sky_terms > 0; }
  double scale() const { return scale_; }
  /// Of residuals, those that are independent: what a criterion charges for an unknown is the logarithm of their number.
  double independent() const { return independent_; }
  bool settled() const { return at_.shared.size() > 0; }

  /// What freeing some factors of one photograph lowers twice the misfit by, with the lights and those in use following.
  double gain(std::size_t photograph, std::initializer_list<FactorKind> kinds) const;
  OwnLightOutcome outcome() const { return {solution_.lights, solution_.outside_misfit, scale_, now_, prior_sd_}; }
  /// Twice the misfit of samples, references and priors there; weights are those of where this fit is, and the scale is one for all that are compared.
  double misfit(const OwnLightOutcome& there, double scale) const;
  /// -2 ln of what Laplace's approximation of the evidence has beside the misfit: how much of their priors the unknowns leave.
  double occam() const;
  /// Of the factors in use, the lights following.
  Eigen::MatrixXd factor_covariance() const;
  /// Of ln flash and sky[0]: what they owe to the factors' uncertainty.
  Eigen::Matrix2d lights_covariance() const;

 private:
  /// What the samples say about the factors of all photographs, at the lights that suit them best. Rows are factors.
  struct Information {
    Eigen::MatrixXd beside;               ///< with the lights, then with the factors in use
    std::vector<Eigen::Matrix2d> own;     ///< of a photograph's two factors
    Eigen::VectorXd gradient;
    Eigen::MatrixXd shared;               ///< of lights and factors in use
    Eigen::LDLT<Eigen::MatrixXd> solved;  ///< of `shared`
  };
  /// A factor in use that acts on a sample of the group.
  struct UsedHere {
    std::size_t sample;
    Eigen::Index column;
    double effect;
  };

  void solve();
  double share_at(double scale) const;
  void gather(double scale, double share);
  void add_group(std::span<const LightSample> samples, const Deviations& d, Eigen::MatrixXd& lights);
  double step();
  Eigen::VectorXd shared_gradient() const;
  Eigen::MatrixXd follow() const;

  std::vector<LightSample> samples_;
  std::vector<ReferenceSample> references_;
  const LightSolveOptions& options_;
  const std::vector<SampleGroup> groups_;
  const LightLayout layout_;
  LightSolution solution_;
  std::vector<OwnLight> now_;
  std::vector<std::size_t> used_;
  std::vector<double> prior_sd_;
  std::vector<Eigen::Index> column_;        ///< of each factor among those in use; -1
  double independent_ = 0, residuals_ = 0, scale_ = 0;
  Information at_;
  std::vector<UsedHere> used_here_;
  std::vector<std::array<double, kFactorKinds>> effect_;
};

}  // namespace chiaro::optimize
