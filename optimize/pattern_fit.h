/// Unknowns that show as a pattern in how photographs disagree: where the flash stands, how light falls off over the picture. Found beside the lights.
#pragma once
#include <Eigen/Dense>
#include <array>
#include <functional>
#include <span>
#include <vector>

#include "optimize/light_solve.h"
#include "optimize/light_spread.h"

namespace chiaro::optimize {

inline constexpr int kMaxPatternUnknowns = 9;
using PatternVector = Eigen::Matrix<double, Eigen::Dynamic, 1, 0, kMaxPatternUnknowns, 1>;
using PatternMatrix = Eigen::Matrix<double, Eigen::Dynamic, Eigen::Dynamic, 0, kMaxPatternUnknowns, kMaxPatternUnknowns>;

/// What the unknowns change in a sample, of each: ln of the flash's irradiance, and ln of all that the photograph shows.
struct PatternEffect {
  PatternVector of_flash, of_picture;
};

/// What is known of them before, in the order of PatternEffect's vectors.
struct Pattern {
  PatternVector already;    ///< what the samples hold
  PatternVector prior_sd;   ///< of the whole, around 0
  LightSpread open{};       ///< not 0: factors of each photograph are left open beside them, ln of them by so much
  Eigen::Index size() const { return already.size(); }
};

struct PatternFitOptions {
  double lights_sd = 0.1, bounce_sd = 0.02;   ///< of what is left open beside: ln flash, ln ambient; the factor on gathered light
};

struct PatternFit {
  PatternVector value;       ///< the whole, not what is to be added
  PatternMatrix covariance;
  Eigen::VectorXd beside;    ///< steps of ln flash, ln ambient, bounce; then of ln of the photographs' factors, kind by kind, where they are open
  double before = 0, after = 0;   ///< robust deviation of the residuals, in expected ones, as the samples are and with the above
  double occam = 0;          ///< -2 ln of what the openness of factors takes off the evidence (Laplace)
  Eigen::Matrix2d lights_covariance = Eigen::Matrix2d::Zero();   ///< of ln flash and ln ambient: what they owe to the uncertainty of `value`
  /// Of `count` unknowns from `first` on being nothing.
  double chi2(Eigen::Index first, Eigen::Index count) const;
};

/// Residuals of ln(B / H) within groups, mean of the channels, of photographs with flash.
class PatternResiduals {
 public:
  /// independent: residuals that the samples count for (independent_residuals()).
  PatternResiduals(std::span<const LightSample> samples, const Lights& lights, const std::function<PatternEffect(const LightSample&)>& effect, double independent, const PatternFitOptions& options = {});

  /// Least squares, robust, linear in the unknowns; lights are free beside them. threads: one.
  PatternFit fit(const Pattern& pattern) const;

  /// Twice the misfit of what `fit` left, priors included, weighed as if residuals scattered by `scale`: for comparing patterns at one scale.
  double misfit(const Pattern& pattern, const PatternFit& fit, double scale) const;

 private:
  static constexpr int kLights = 3;   // ln flash, ln ambient, bounce
  using Effect = Eigen::Matrix<double, kMaxPatternUnknowns + kLights, 1>;
  struct Row {
    double residual = 0, weight = 0;
    Effect effect = Effect::Zero();      ///< of the pattern's unknowns, then of the lights
    std::array<double, kFactorKinds> own{}, in_mean{};   ///< of ln of its photograph's factors: on the row itself, and of the group's mean on all its rows
    std::uint32_t photograph = 0;
  };
  std::size_t groups() const { return begins_.size() - 1; }
  std::span<const Row> group(std::size_t g) const { return std::span(rows_).subspan(begins_[g], begins_[g + 1] - begins_[g]); }
  static bool row_of(const LightSample& sample, const Lights& lights, const PatternEffect& effect, Row& row);
  void add_rows(std::vector<Row>& group);
  /// Where the unknowns of the photographs' factors begin, of each kind; 0: they are not open. All unknowns.
  struct Places {
    std::array<Eigen::Index, kFactorKinds> first{};
    Eigen::Index all = 0;
  };
  Places places(const LightSpread& open) const;
  std::vector<double> residuals(const Eigen::VectorXd& x, const Places& places) const;
  double deviation(const std::vector<double>& residuals) const;
  static void add_group(std::span<const Row> group, std::span<const double> weights, const Places& places, Eigen::MatrixXd& a, Eigen::VectorXd& b);

  double independent_;
  PatternFitOptions options_;
  std::size_t photographs_ = 0;
  std::vector<Row> rows_;
  std::vector<std::size_t> begins_{0};   ///< of the groups that share their albedo; the end of the last
};

}  // namespace chiaro::optimize
