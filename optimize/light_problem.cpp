#include "optimize/light_problem.h"

#include <algorithm>
#include <cmath>

#include "optimize/albedo_mean.h"
#include "optimize/light_checks.h"
#include "optimize/proxy_file.h"
#include "optimize/radiosity.h"
#include "stream/base/error.h"
#include "stream/base/parallel.h"

namespace chiaro::optimize {
namespace {

constexpr int kFirstSweeps = 14, kLaterSweeps = 4;
constexpr double kSweepTolerance = 1e-5;
/// Pairs of one photograph overlap and texture is not noise: so much of their information counts as independent. With half of it the ambient light of single photographs
/// (tower, vplanes_textured, chamber) was off by 0.65 of its deviations, rms.
constexpr double kPairInformation = 0.04;
constexpr double kGuessSd = 0.35;   // of ln flash, around the guess that the brightest surfels reflect 80 %
constexpr int kPatternRounds = 8;
constexpr double kGlossyBounceSd = 0.05;   ///< least deviation of the factor on gathered light where surfaces mirror: they throw more one way than another
constexpr int kBounceCheck = 2;   ///< outer iteration after which the alternative is tried

LightSolveOptions solve_options(const AcquisitionInput& input, const Lights& start, bool scale_is_given, int sky_terms, bool pairs, double bounce_sd) {
  LightSolveOptions o;
  o.bounce_sd = bounce_sd;
  o.sky_terms = sky_terms;
  if (input.intensity_range) {
    const auto [low, high] = *input.intensity_range;
    o.flash_ln_mean = 0.5 * (std::log(low) + std::log(high));
    o.flash_ln_sd = std::max(1e-4, 0.25 * std::log(high / low));   // the range is +-2 sigma
  }
  // With nothing known, "all light is bounced light between white surfaces" explains any photograph of rough geometry: the guess at the start holds against it.
  if (!input.intensity_range && !scale_is_given) {
    o.flash_ln_mean = std::log(start.flash_intensity);
    o.flash_ln_sd = kGuessSd;
    o.flash_is_guess = true;
  }
  if (pairs) o.information = kPairInformation;
  return o;
}

/// share of `values`, the rest of `before`.
void blend_into(std::vector<float>& values, const std::vector<float>& before, double share) {
  const float s = static_cast<float>(share);
  parallel_blocks(values.size(), 65536, [&](std::size_t b, std::size_t e) {
    for (std::size_t i = b; i < e; ++i) values[i] = before[i] + s * (values[i] - before[i]);
  });
}

/// The same under an even grey sky, on surfaces without a coat.
Lights plainer(Lights lights) {
  lights.gloss = {};
  std::fill(lights.sky.begin() + 1, lights.sky.end(), 0.0);
  lights.sky_colour = {1, 1, 1};
  lights.floor = false;
  lights.floor_albedo = 0;
  return lights;
}

/// What else leaves the lights open: covariance of ln flash and of the ambient light, the second in units of `ambient`.
void add_uncertainty(const Eigen::Matrix2d& covariance, double ambient, LightSolution& solution) {
  solution.covariance(0, 0) += covariance(0, 0);
  if (solution.sky_terms == 0) return;
  solution.covariance(1, 1) += ambient * ambient * covariance(1, 1);
  solution.covariance(0, 1) += ambient * covariance(0, 1);
  solution.covariance(1, 0) = solution.covariance(0, 1);
}

}  // namespace

std::filesystem::path observation_path(const std::filesystem::path& folder, std::size_t k) { return folder / concat("observation_", k, ".bin"); }

Lights start_lights(const AcquisitionInput& input, int sky_terms) {
  Lights x;
  x.flash_intensity = input.intensity_range ? std::sqrt((*input.intensity_range)[0] * (*input.intensity_range)[1]) : 1.0;
  if (sky_terms > 0) x.sky[0] = 0.01 * x.flash_intensity / 4;
  return x;
}

void guess_flash(const Scene& scene, const AcquisitionInput& input, const std::filesystem::path& folder, Lights& lights) {
  if (input.intensity_range) return;
  const std::size_t n = scene.proxy.size();
  if (n == 0) return;
  std::vector<float> ln_sum(n, 0.0f);
  std::vector<std::uint16_t> times(n, 0);
  for (std::size_t k = 0; k < input.photographs.size(); ++k) {
    const Observation o = read_observation(observation_path(folder, k), n);
    for (std::size_t i = 0; i < n; ++i) {
      if (!o.seen[i] || !(o.flash[i] > 0) || !(o.radiosity[3 * i + 1] > 0)) continue;
      ln_sum[i] += std::log(o.radiosity[3 * i + 1] / o.flash[i]);
      ++times[i];
    }
  }
  const std::uint16_t least = *std::max_element(times.begin(), times.end()) >= 2 ? 2 : 1;
  std::vector<float> ratios;
  for (std::size_t i = 0; i < n; ++i)
    if (times[i] >= least) ratios.push_back(std::exp(ln_sum[i] / static_cast<float>(times[i])));
  if (ratios.empty()) return;
  const auto at = ratios.begin() + static_cast<std::ptrdiff_t>(ratios.size() * 95 / 100);
  std::nth_element(ratios.begin(), at, ratios.end());
  lights.flash_intensity = std::max(1e-9, static_cast<double>(*at) / 0.8);
  lights.sky[0] = std::min(lights.sky[0], 0.0025 * lights.flash_intensity);
}

LightProblem::LightProblem(const Scene& scene, const Smoother& smoother, const AcquisitionInput& input, const AcquisitionOptions& options, std::vector<std::size_t> photographs,
                           const std::filesystem::path& folder, double bounce_sd)
    : bounce_sd_(bounce_sd), scene_(scene), smoother_(smoother), input_(input), options_(options), photographs_(std::move(photographs)), folder_(folder), times_seen_(scene.proxy.size(), 0), own_(input.photographs.size()), strangers_(input.photographs.size(), false) {
  for (const std::size_t k : photographs_) {
    const Observation o = read(k);
    for (std::size_t i = 0; i < times_seen_.size(); ++i) times_seen_[i] = static_cast<std::uint16_t>(times_seen_[i] + o.seen[i]);
  }
  for (const ObserveInput& p : input.photographs) corner_sines_.push_back(corner_sine(p.camera.lens));
  found_.pattern.falloff.flash_corner_sine = *std::max_element(corner_sines_.begin(), corner_sines_.end());
  nearest_seen_ = nearest_seen_surfels(scene.proxy, times_seen_);
  use_pairs_ = photographs_.size() == 1;
  if (use_pairs_) {
    pairs_ = choose_pairs(scene, read(photographs_[0]), options.light_samples / 4, options.seed);
  } else {
    chosen_ = choose_surfels(times_seen_, 2, options.light_samples, options.seed, options.max_light_samples);
  }
  for (const ReferenceTarget& t : input.references)
    if (std::find(photographs_.begin(), photographs_.end(), t.photograph) != photographs_.end())
      if (auto reading = read_reference(scene, input, t)) {
        reading->reference.sample.angles = gloss_angles(reading->place, reading->normal, viewpoint(reading->photograph));
        references_.push_back(*reading);
      }
}

LightSolution LightProblem::solve(SkyShape sky, const Lights& start, int& outer, double& change, Reporter& report) {
  sky_ = sky;
  const bool may_be_richer = !richer_skies(sky, input_.sky, scene_.floor && input_.try_floor).empty();
  bool try_gloss = true, choose_sky = may_be_richer;
  LightSolution solution;
  solution.lights = start;
  std::vector<float> albedo(3 * scene_.proxy.size(), 0.3f);
  Relaxation relaxation;
  int most = options_.outer_iterations;
  for (outer = 0; outer < most; ++outer) {
    report.check();
    sweep(solution.lights, albedo, outer < 2 ? kFirstSweeps : kLaterSweeps, relaxation.share());
    if (outer == 0) look_for_flash(solution.lights);
    const Lights before = solution.lights;
    const LightSolveOptions light_options = current_options(start);
    solution = solve_lights(samples_, current_references(), light_options, before);
    if (outer == kBounceCheck && !without_bounces_) check_bounces(light_options, solution);
    change = light_change(before, solution.lights);
    report.progress(static_cast<std::uint64_t>(std::min(outer + 1, options_.outer_iterations)));
    const bool settled = outer > kBounceCheck && change < kOuterTolerance;
    if (outer == kBounceCheck) look_for_misreading(solution, light_options);
    const bool estranged = outer == kBounceCheck && leave_out_strangers(solution.lights);
    const bool near = outer > kBounceCheck && change < kSettled;
    const bool decided = !try_gloss && !choose_sky, varied = varies();
    const bool evened = estranged || (near && even_out(start, solution, light_options, decided));
    if (!varied && varies() && (gloss_ || sky_.name() != sky.name())) {   // a coat or a richer sky may have stood for it
      sky_ = sky;
      solution.lights = plainer(solution.lights);
      gloss_ = false;
      gloss_evidence_.reset();
      try_gloss = true;
      choose_sky = may_be_richer;
    }
    bool chose = false, richer = false;
    const bool decide = !evened && (change < kSettled || outer + 1 == most) && outer > kBounceCheck;
    if (decide && try_gloss) {
      try_gloss = false;
      chose = richer = choose_gloss(start, solution);
    }
    if (decide && choose_sky && !chose) {
      choose_sky = false;
      chose = true;
      richer = choose_richer_sky(start, solution);
    }
    albedo = mean_albedo(solution.lights);
    if (richer) {
      own_light_settled_ = variation_settled_ = false;
      pattern_rounds_ = 0;
    }
    if (!evened && settled && !richer && decided) break;
    if (evened || chose) most = outer + 1 + options_.outer_iterations;
    if (!evened && outer > 0) relaxation.observe(light_step(before, solution.lights));
  }
  solution.converged = solution.converged && change < kSettled;
  // With the lights final: the gathered light that the albedo stage reads.
  sweep(solution.lights, albedo, kFirstSweeps, relaxation.share(), true);
  albedo_ = mean_albedo(solution.lights);
  if (!use_pairs_) errors_ = estimate_errors(samples_, solution.lights);
  weigh_misreadings(solution);
  solution.ambient_open = ambient_open(start, solution);
  add_uncertainty(found_.lights_covariance, solution.lights.sky[0], solution);
  add_uncertainty(own_lights_covariance_, 1, solution);
  return solution;
}

/// Takes out what the photographs do not share, or what of their light the project does not say. What single photographs, the light's pattern or its model (decided) explain must not
/// pass for a flash that is never the same: that comes last. Returns whether anything has changed.
bool LightProblem::even_out(const Lights& start, const LightSolution& solution, const LightSolveOptions& options, bool decided) {
  return find_own_light(start, solution, varies()) || (pattern_rounds_ < kPatternRounds && find_pattern(solution, options)) || (decided && find_own_light(start, solution, true));
}

/// Where the flash reaches nothing that is seen, its intensity says nothing about the scale: the ambient light starts from a guess that holds it.
void LightProblem::look_for_flash(Lights& lights) {
  lit_ = flash_reaches(samples_);
  if (lit_ || sky_.terms == 0 || !references_.empty()) return;
  const double guess = guess_ambient(samples_);
  if (!(guess > 0)) return;
  ambient_guess_ = guess;
  lights.sky[0] = guess;
}

std::vector<std::string> LightProblem::notes(const LightSolution& solution) const {
  const std::string who = concat(input_.names[photographs_[0]], photographs_.size() > 1 ? " and the others of the acquisition" : "");
  std::vector<std::string> notes = light_notes(input_, samples_, solution, who, use_pairs_, lit_);
  if (wrong_encoding_) notes.push_back(encoding_note(*wrong_encoding_));
  if (misreading_) notes.push_back(misreading_note(*misreading_, written_offset()));
  return notes;
}

/// Where the flash stands by what has been found so far.
std::optional<Vec3d> LightProblem::flash_of(std::size_t k) const {
  const auto flash = flash_in_world(input_, k);
  if (!flash) return flash;
  return Vec3d(*flash + input_.photographs[k].camera.pose.rotation_camera_from_world.transpose() * found_.pattern.flash_shift);
}

Viewpoint LightProblem::viewpoint(std::size_t k) const {
  const Vec3d& origin = scene_.proxy.origin_in_world;
  Viewpoint from{(input_.photographs[k].camera.pose.centre_in_world() - origin).cast<float>(), {}};
  if (const auto flash = flash_of(k)) from.flash = (*flash - origin).cast<float>();
  return from;
}

LightSolveOptions LightProblem::current_options(const Lights& start) const {
  LightSolveOptions o = solve_options(input_, start, !references_.empty(), sky_.terms, use_pairs_, bounce_sd_);
  o.sky_colour = sky_.coloured;
  o.ambient_guess = ambient_guess_;
  o.floor = sky_.floor;
  o.gloss = gloss_;
  if (gloss_) o.bounce_sd = std::max(o.bounce_sd, kGlossyBounceSd);
  if (without_bounces_) o.bounce_mean = o.bounce_sd = 0;
  return o;
}

void LightProblem::add_sample(std::size_t k, const Observation& o, const std::vector<float>& g, std::size_t i, std::uint32_t group) {
  LightSample s = sample_of(scene_.transport, o, g, i);
  s.group = group;
  s.photograph = static_cast<std::uint32_t>(k);
  s.flash_photograph = input_.photographs[k].flash_in_camera.has_value();
  s.angles = gloss_angles(scene_.proxy.position[i], scene_.proxy.normal[i], viewpoint(k));
  s.off_axis = off_axis_of(k, scene_.proxy.position[i]).cast<float>();
  if (const auto flash = flash_of(k)) {
    s.flash_off_axis = flash_off_axis_of(k, scene_.proxy.position[i]).cast<float>();
    const Vec3f offset = (*flash - scene_.proxy.origin_in_world).cast<float>() - scene_.proxy.position[i], &normal = scene_.proxy.normal[i];
    const float distance = offset.norm();
    const Vec3f to_flash = offset / distance;
    if (const float cosine = normal.dot(to_flash); cosine > 0.05f) {
      s.lean = to_flash / cosine - normal;
      s.flash_by_shift = input_.photographs[k].camera.pose.rotation_camera_from_world.cast<float>() * (normal / cosine - 3 * to_flash) / distance;
    }
  }
  for (float& t : s.sky) t *= static_cast<float>(ambient_scale(k));
  for (float& t : s.hidden) t *= static_cast<float>(ambient_scale(k));
  samples_.push_back(s);
}

Observation LightProblem::read(std::size_t k) const {
  Observation o = read_observation(observation_path(folder_, k), scene_.proxy.size());
  if (scene_.floor && input_.photographs[k].flash_in_camera) o.floor_flash = read_floats(floor_flash_path(folder_, k), scene_.proxy.size());
  return o;
}

/// One pass over the photographs: completes their radiosity under the lights (`share` of it new) and refreshes the samples. last: what is gathered now stays.
void LightProblem::sweep(const Lights& lights, const std::vector<float>& albedo, int max_sweeps, double share, bool last) {
  samples_.clear();
  const std::vector<float> sent_back = lights.gloss.on ? coated_albedo(lights.gloss, albedo) : std::vector<float>();
  for (std::size_t first = 0; first < photographs_.size(); first += Completion::kMost) {
    const std::span<const std::size_t> some = std::span(photographs_).subspan(first, std::min(Completion::kMost, photographs_.size() - first));
    Completion completion(scene_.transport, smoother_, kSmoothPasses, some.size());
    for (const std::size_t k : some) {
      Observation o = read(k);
      const Lights here = exposed(lights, ambient_scale(k));
      if (here.gloss.on) send_out(scene_.proxy, scene_.transport, viewpoint(k), read_floats(gathered_path(folder_, k), 3 * o.seen.size()), here, o);
      completion.add(here, here.gloss.on ? sent_back : albedo, o);
    }
    completion.solve(max_sweeps, kSweepTolerance);
    for (std::size_t i = 0; i < some.size(); ++i) refresh(some[i], completion, i, share, last);
  }
  std::stable_sort(samples_.begin(), samples_.end(), [](const LightSample& a, const LightSample& b) { return a.group < b.group; });
}

/// What a pass found of a photograph, into its files, samples and references.
void LightProblem::refresh(std::size_t k, const Completion& completion, std::size_t place, double share, bool last) {
  Observation o = read(k);
  std::vector<float> before;
  if (share < 1) before = o.radiosity;
  completion.take_unseen(place, o);
  std::vector<float> g = completion.gathered(place);
  if (share < 1) {   // gathering is linear: what holds for the radiosity holds for G
    blend_into(o.radiosity, before, share);
    blend_into(g, read_floats(gathered_path(folder_, k), g.size()), share);
  }
  if (use_pairs_) {
    for (std::size_t p = 0; p < pairs_.size(); ++p)
      for (const std::uint32_t i : {pairs_[p].a, pairs_[p].b}) {
        add_sample(k, o, g, i, static_cast<std::uint32_t>(p));
        samples_.back().trust = pairs_[p].trust;
      }
  } else {
    for (const std::uint32_t i : chosen_)
      if (o.seen[i] && !strangers_[k]) add_sample(k, o, g, i, i);
  }
  for (ReferenceReading& r : references_)
    if (r.photograph == k) {
      r.reference.sample.gathered = interpolate<3>(r.stencil, g);
      r.reference.unknown_share = unknown_share(scene_.transport, r.stencil, o.radiosity, times_seen_);
      if (!o.floor_flash.empty()) r.reference.sample.floor_flash = interpolate<1>(r.stencil, o.floor_flash)[0];
    }
  write_radiosity(o, observation_path(folder_, k));
  (last ? write_floats : write_floats_for_now)(g, gathered_path(folder_, k));
}

/// The albedo that the photographs have under these lights, with the light gathered last: what unseen surfels radiate must not lag behind the lights by a step,
/// or the iteration overshoots.
std::vector<float> LightProblem::mean_albedo(const Lights& lights) const {
  AlbedoMean mean(scene_.proxy.size());
  for (const std::size_t k : photographs_)
    if (!strangers_[k]) mean.add(scene_.transport, read(k), read_floats(gathered_path(folder_, k), 3 * scene_.proxy.size()), exposed(lights, ambient_scale(k)), scene_.proxy, viewpoint(k));
  return mean.albedo(nearest_seen_);
}

std::vector<ReferenceSample> LightProblem::current_references() const {
  std::vector<ReferenceSample> r;
  for (const ReferenceReading& reading : references_) r.push_back(reading.reference);
  return r;
}

}  // namespace chiaro::optimize
