/// One set of photographs that share their lights: the whole acquisition, or a single photograph.
#pragma once
#include <cstdint>
#include <filesystem>
#include <optional>
#include <string>
#include <vector>

#include "optimize/encoding_misreading.h"
#include "optimize/error_model.h"
#include "optimize/flash_misreading.h"
#include "optimize/gloss_light.h"
#include "optimize/light_pattern.h"
#include "optimize/light_samples.h"
#include "optimize/light_step.h"
#include "optimize/own_light.h"
#include "optimize/radiosity.h"
#include "optimize/sky_shape.h"

namespace chiaro::optimize {

inline constexpr double kOuterTolerance = 3e-5, kSettled = 1e-3;   ///< of light_change(): over, and near enough
inline constexpr int kTrialIterations = 15;           ///< from a settled start: enough to compare models
inline constexpr std::size_t kTrialGroups = 5000;     ///< of surfels: no more than a few hundred of them are independent

class LightProblem {
 public:
  /// photographs: indices into input.photographs, whose observations lie in `folder`. bounce_sd: prior of the factor on gathered light.
  LightProblem(const Scene& scene, const Smoother& smoother, const AcquisitionInput& input, const AcquisitionOptions& options, std::vector<std::size_t> photographs,
               const std::filesystem::path& folder, double bounce_sd);

  /// Alternates between what unseen surfels radiate and the lights until nothing moves. Plain alternation overshoots where unseen surfaces give most of the light (in a
  /// closed room it ends in a cycle), so the step is relaxed. Leaves folder/gathered_K.bin. throws Error, Cancelled.
  LightSolution solve(SkyShape sky, const Lights& start, int& outer, double& change, Reporter& report);

  const std::vector<std::uint16_t>& times_seen() const { return times_seen_; }
  std::size_t num_references() const { return references_.size(); }
  /// Of the photographs of the input: factors on their ambient light, and of brightness that were taken out.
  const std::vector<OwnLight>& own_lights() const { return own_; }
  /// By how much they vary over all of them.
  const LightSpread& light_spread() const { return spread_; }
  /// Of the photographs of the input: those that show something else than the others (optimize/strangers.h) and took no part.
  const std::vector<bool>& strangers_found() const { return strangers_; }
  /// How far the flash stands from where the project has it, and how light falls off over the pictures; nothing where photographs do not ask for it.
  const LightPattern& pattern() const { return found_.pattern; }
  SkyShape sky() const { return sky_; }
  const std::vector<SkyEvidence>& sky_evidence() const { return sky_evidence_; }
  /// Criterion of a coat beside none, as of SkyEvidence; absent where photographs could not tell.
  const std::optional<double>& gloss_evidence() const { return gloss_evidence_; }
  const std::vector<float>& albedo() const { return albedo_; }
  bool without_bounces() const { return without_bounces_; }
  const ErrorModel& errors() const { return errors_; }
  /// What the photographs leave open or contradict (optimize/light_checks.h).
  std::vector<std::string> notes(const LightSolution& solution) const;

 private:
  void look_for_flash(Lights& lights);
  void look_for_misreading(const LightSolution& solution, const LightSolveOptions& options);
  void weigh_misreadings(const LightSolution& solution);
  Vec3d written_offset() const;
  bool leave_out_strangers(const Lights& lights);
  void take_out_exposure(std::size_t k, double factor);
  bool find_own_light(const Lights& start, const LightSolution& solution, bool may_vary);
  void forget_own_lights();
  bool even_out(const Lights& start, const LightSolution& solution, const LightSolveOptions& options, bool decided);
  std::optional<Vec3d> flash_of(std::size_t k) const;
  bool find_pattern(const LightSolution& solution, const LightSolveOptions& options);
  void doubt_falloff();
  void apply_pattern(const LightPattern& pattern);
  LightSolveOptions current_options(const Lights& start) const;
  Viewpoint viewpoint(std::size_t k) const;
  Vec2d off_axis_of(std::size_t k, const Vec3f& place) const;
  Vec2d flash_off_axis_of(std::size_t k, const Vec3f& place) const;
  bool choose_gloss(const Lights& start, LightSolution& solution);
  bool choose_richer_sky(const Lights& start, LightSolution& solution);
  double ambient_open(const Lights& start, const LightSolution& solution);
  void check_bounces(const LightSolveOptions& options, LightSolution& solution);
  bool varies() const { return spread_[kAmbient] > 0 || spread_[kExposure] > 0; }
  double ambient_scale(std::size_t k) const { return input_.photographs[k].ambient_scale * own_[k].ambient; }
  void add_sample(std::size_t k, const Observation& o, const std::vector<float>& g, std::size_t i, std::uint32_t group);
  Observation read(std::size_t k) const;
  void sweep(const Lights& lights, const std::vector<float>& albedo, int max_sweeps, double share, bool last = false);
  void refresh(std::size_t k, const Completion& completion, std::size_t place, double share, bool last);
  std::vector<float> mean_albedo(const Lights& lights) const;
  std::vector<ReferenceSample> current_references() const;

  const double bounce_sd_;
  const Scene& scene_;
  const Smoother& smoother_;
  const AcquisitionInput& input_;
  const AcquisitionOptions& options_;
  const std::vector<std::size_t> photographs_;
  const std::filesystem::path folder_;
  std::vector<std::uint16_t> times_seen_;
  std::vector<OwnLight> own_;
  Eigen::Matrix2d own_lights_covariance_ = Eigen::Matrix2d::Zero();
  std::vector<bool> strangers_;
  std::vector<std::uint32_t> nearest_seen_, chosen_;
  std::vector<Pair> pairs_;
  std::vector<ReferenceReading> references_;
  std::vector<LightSample> samples_;
  std::vector<float> albedo_;
  SkyShape sky_;
  std::vector<SkyEvidence> sky_evidence_;
  ErrorModel errors_;
  std::optional<double> ambient_guess_;
  FoundPattern found_;
  std::optional<Misreading> misreading_;
  std::optional<EncodingMisreading> wrong_encoding_;
  double scatter_before_ = 0;            ///< LightSolution::scatter when they were looked for
  std::vector<double> corner_sines_;   ///< of each photograph
  LightSpread spread_{};
  int own_light_rounds_ = 0, pattern_rounds_ = 0, variation_rounds_ = 0;
  std::optional<double> gloss_evidence_;
  bool gloss_ = false, use_pairs_ = false, own_light_settled_ = false, variation_settled_ = false, without_bounces_ = false, lit_ = true, doubted_falloff_ = false;
};

/// The lights that a search starts from.
Lights start_lights(const AcquisitionInput& input, int sky_terms);
/// A flash of unknown strength starts where the brightest surfels have albedo 0.8: only the scale, never a result. A surfel's brightness is its geometric mean
/// over the photographs, so that highlights, which move, count little.
void guess_flash(const Scene& scene, const AcquisitionInput& input, const std::filesystem::path& folder, Lights& lights);

/// State between iterations: observation K of an acquisition.
std::filesystem::path observation_path(const std::filesystem::path& folder, std::size_t photograph);

}  // namespace chiaro::optimize
