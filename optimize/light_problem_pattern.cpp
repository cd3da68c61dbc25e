/// LightProblem: a flash beside its place, and light that falls off towards the corners of the pictures.
#include <algorithm>
#include <cmath>

#include "optimize/flash_place.h"
#include "optimize/light_problem.h"

namespace chiaro::optimize {
namespace {

constexpr double kPlaceSdMetres = 0.03, kFarthestMetres = 0.06;   ///< how well people measure where the flash is; nobody mistakes more
constexpr double kLeastStepMetres = 5e-4;
constexpr std::size_t kMisreadingGroups = 1500;
constexpr double kLeastFalloffStep = 5e-4;   ///< of ln

}  // namespace

Vec2d LightProblem::off_axis_of(std::size_t k, const Vec3f& place) const {
  return off_axis(input_.photographs[k].camera.pose.camera_from_world(place.cast<double>() + scene_.proxy.origin_in_world), corner_sines_[k]);
}

/// By where the flash stands now. The photograph has one.
Vec2d LightProblem::flash_off_axis_of(std::size_t k, const Vec3f& place) const {
  const Vec3d from_flash = place.cast<double>() + scene_.proxy.origin_in_world - *flash_of(k);
  return off_axis(input_.photographs[k].camera.pose.rotation_camera_from_world * from_flash, found_.pattern.falloff.flash_corner_sine);
}

/// Looks for what of the light the project does not say, and takes it into account. Returns whether anything has changed.
bool LightProblem::find_pattern(const LightSolution& solution, const LightSolveOptions& options) {
  ++pattern_rounds_;
  if (use_pairs_ || !lit_) return false;
  const double metres = scene_.proxy.metres_per_unit;
  LightPatternOptions pattern_options;
  pattern_options.shift_prior_sd = kPlaceSdMetres / metres;
  pattern_options.farthest_shift = kFarthestMetres / metres;
  pattern_options.falloff = input_.falloff;
  pattern_options.spread = spread_;
  const LightPattern before = found_.pattern;
  const FoundPattern found = find_light_pattern(thinned(samples_, kTrialGroups), solution.lights, before, independent_residuals(samples_, options), pattern_options);
  const Falloff &was = before.falloff, &is = found.pattern.falloff;
  const double falloff_step = std::max((is.lens - was.lens).cwiseAbs().maxCoeff(), (is.flash - was.flash).cwiseAbs().maxCoeff());
  found_.lights_covariance = found.lights_covariance;
  found_.pattern.falloff.covariance = is.covariance;
  if ((found.pattern.flash_shift - before.flash_shift).norm() * metres < kLeastStepMetres && falloff_step < kLeastFalloffStep) return false;
  own_light_settled_ = variation_settled_ = false;
  if (was.none() && !is.none()) forget_own_lights();   // they may have stood for a part of it
  apply_pattern(found.pattern);
  return true;
}

/// Whether the offset of the flash is written in other axes or another unit, or the values' curve is not what it was taken for. Asked before anything is taken out that may have stood
/// for a part of it.
void LightProblem::look_for_misreading(const LightSolution& solution, const LightSolveOptions& options) {
  if (use_pairs_ || !lit_) return;
  const auto flash_under = [&](std::size_t k, const Mat3d& offset_from_written) {
    const ObserveInput& photo = input_.photographs[k];
    return Vec3d(photo.camera.pose.world_from_camera(offset_from_written * *photo.flash_in_camera) - scene_.proxy.origin_in_world);
  };
  LightSolveOptions trial = options;
  trial.max_iterations = kTrialIterations;
  const std::vector<LightSample> some = thinned(samples_, kMisreadingGroups);
  scatter_before_ = solution.scatter;
  wrong_encoding_ = find_encoding_misreading(some, trial, solution.lights);
  if (!wrong_encoding_) misreading_ = find_misreading(some, scene_.proxy.position, scene_.proxy.normal, flash_under, current_references(), trial, solution.lights);
}

/// What has been taken out since may explain the photographs as well.
void LightProblem::weigh_misreadings(const LightSolution& solution) {
  const double left = scatter_before_ > 0 ? std::min(1.0, solution.scatter / scatter_before_) : 1;
  if (misreading_) misreading_->scatter_corrected = left * misreading_->scatter_as_written;
  if (misreading_ && !is_worth_telling(*misreading_, varies())) misreading_.reset();
  if (wrong_encoding_) wrong_encoding_->scatter_as_taken *= left;
  if (wrong_encoding_ && !explains_far_better(wrong_encoding_->scatter, wrong_encoding_->scatter_as_taken)) wrong_encoding_.reset();
}

/// Of the first photograph that has one.
Vec3d LightProblem::written_offset() const {
  for (const ObserveInput& p : input_.photographs)
    if (p.flash_in_camera) return *p.flash_in_camera;
  return Vec3d::Zero();
}

/// A falloff may have stood for light that varies: it is asked anew, once, beside what varies.
void LightProblem::doubt_falloff() {
  if (doubted_falloff_ || found_.pattern.falloff.none()) return;
  doubted_falloff_ = true;
  pattern_rounds_ = 0;
  LightPattern without = found_.pattern;
  without.falloff = Falloff();
  without.falloff.flash_corner_sine = found_.pattern.falloff.flash_corner_sine;
  apply_pattern(without);
}

/// Observations and targets as if the light were the model's. Shadows stay where they were cast.
void LightProblem::apply_pattern(const LightPattern& pattern) {
  const Vec3d origin = scene_.proxy.origin_in_world;
  const LightPattern before = found_.pattern;
  std::vector<std::optional<Vec3d>> flash_before;
  for (std::size_t k = 0; k < input_.photographs.size(); ++k) flash_before.push_back(flash_of(k));
  found_.pattern = pattern;
  const auto picture_factor = [&](std::size_t k, const Vec3f& place) {
    const Vec2d w = off_axis_of(k, place);
    return static_cast<float>(lens_factor(before.falloff, w) / lens_factor(pattern.falloff, w));
  };
  const auto factor_of_flash = [&](std::size_t k, const Vec3f& place, const Vec3f& normal) {
    const Vec2d w = flash_off_axis_of(k, place);
    return static_cast<float>(flash_factor(place.cast<double>() + origin, normal.cast<double>(), *flash_before[k], *flash_of(k)) * flash_pattern(pattern.falloff, w) / flash_pattern(before.falloff, w));
  };
  for (const std::size_t k : photographs_) {
    Observation o = read(k);
    for (std::size_t i = 0; i < o.flash.size(); ++i) {
      if (flash_before[k]) o.flash[i] *= factor_of_flash(k, scene_.proxy.position[i], scene_.proxy.normal[i]);
      const float by = o.seen[i] ? picture_factor(k, scene_.proxy.position[i]) : 1.0f;
      for (std::size_t c = 3 * i; by != 1 && c < 3 * i + 3; ++c) o.radiosity[c] *= by;
    }
    write_observation(o, observation_path(folder_, k));
    for (ReferenceReading& r : references_) {
      if (r.photograph != k) continue;
      if (flash_before[k]) r.reference.sample.flash *= factor_of_flash(k, r.place, r.normal);
      for (float& b : r.reference.sample.radiosity) b *= picture_factor(k, r.place);
    }
  }
}

}  // namespace chiaro::optimize
