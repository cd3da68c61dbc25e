#include <algorithm>
#include <cmath>
#include <numeric>

#include "optimize/acquisition.h"
#include "optimize/adam.h"
#include "optimize/light_problem.h"
#include "optimize/normal_scatter.h"
#include "optimize/proxy_file.h"
#include "optimize/radiosity.h"
#include "stream/base/disk_space.h"
#include "stream/base/error.h"
#include "stream/base/file.h"

namespace chiaro::optimize {
namespace {

/// Of the factor on gathered light. With the pull of the calibrated range taken off, gathered light put the flash of three rendered scenes 0.2, 1.5 and 0.3 % beside the
/// truth (vplanes_textured, tower, chamber), that of a fourth 1.6 % (niche of tests/scenes).
constexpr double kBounceSd = 0.012;
/// Where the normals of neighbouring points scatter, the discs that face the camera fill more of its pixels: direct light is overrated by about the square of the scatter,
/// more where it grazes, and the scale that interreflections give is off by several times that, as they are a fraction of the light. Measured: 9.8 times (vplanes_textured, at
/// 1, 2 and 5 degrees alike), 5.8 (niche).
constexpr double kScaleByScatter = 10;
constexpr double kNotedScatter = 0.035;   ///< two degrees

/// Photographs that share fewer places than this tell nothing about their common lights: measured on two views from either side of a sphere, with four grazing places in common,
/// the ambient light came out 10^10 times too bright; with 87 such places it is better than that of each photograph by itself.
constexpr std::size_t kLeastShared = 20;

/// Surfels that two photographs or more see.
std::size_t shared_surfels(std::size_t n, std::size_t photographs, const std::filesystem::path& folder) {
  std::vector<std::uint8_t> times(n, 0);
  for (std::size_t k = 0; k < photographs; ++k) {
    const Observation o = read_observation(observation_path(folder, k), n);
    for (std::size_t i = 0; i < n; ++i) times[i] = static_cast<std::uint8_t>(std::min(2, times[i] + o.seen[i]));
  }
  return static_cast<std::size_t>(std::count(times.begin(), times.end(), std::uint8_t{2}));
}

/// The paper's solver on one photograph; its lights and the light it gathers from its own albedo.
LightSolution solve_with_adam(const Scene& scene, const Smoother& smoother, const AcquisitionInput& input, std::size_t k, const std::filesystem::path& folder,
                              std::vector<float>& albedo, Reporter& report) {
  const Observation o = read_observation(observation_path(folder, k), scene.proxy.size());
  if (!input.intensity_range) throw UsageError("solve.method = \"adam\" searches the flash in its calibrated range: acquisition.flash.intensity_range is missing");
  const AdamOptions options;
  const AdamResult result = solve_adam(scene.transport, o, *input.intensity_range, options, report);
  LightSolution solution;
  solution.lights.flash_intensity = result.state.flash_intensity;
  solution.lights.sky[0] = result.state.ambient;
  solution.scale_known = true;
  solution.converged = true;
  solution.iterations = options.search_steps * options.search_iterations + options.iterations;
  // The solver reports no uncertainty of its own: the calibrated interval is all that is known about its lights.
  const double sd = 0.25 * std::log((*input.intensity_range)[1] / (*input.intensity_range)[0]);
  solution.sky_terms = 1;
  solution.covariance = Eigen::MatrixXd::Zero(3, 3);
  solution.covariance(0, 0) = sd * sd;
  const std::vector<float> direct = direct_irradiance(scene.transport, o.flash, {}, solution.lights);
  const std::vector<float> b = forward_radiosity(scene.transport, result.state.albedo, direct, 1, options.scatterings);
  std::vector<float> g;
  gather_radiosity(scene.transport, b, g);
  smoother.apply(g, 3, kSmoothPasses);
  write_floats(g, gathered_path(folder, k));
  albedo = result.state.albedo;
  return solution;
}

/// What the standard way assumes: the flash in the middle of its range, nothing else.
LightSolution direct_light(const Scene& scene, const AcquisitionInput& input, const std::filesystem::path& folder) {
  LightSolution solution;
  solution.lights = start_lights(input, 0);
  guess_flash(scene, input, folder, solution.lights);
  solution.scale_known = input.intensity_range.has_value();
  solution.covariance = Eigen::MatrixXd::Zero(2, 2);
  if (input.intensity_range) solution.covariance(0, 0) = std::pow(0.25 * std::log((*input.intensity_range)[1] / (*input.intensity_range)[0]), 2);
  return solution;
}

/// One decimal, two.
double tenths(double v) { return std::round(10 * v) / 10; }
double hundredths(double v) { return std::round(100 * v) / 100; }

class AcquisitionSolver {
 public:
  AcquisitionSolver(const Scene& scene, const AcquisitionInput& input, const AcquisitionOptions& options, const std::filesystem::path& folder, Reporter& report)
      : scene_(scene), input_(input), options_(options), folder_(folder), report_(report), smoother_(make_smoother(scene.proxy, *scene.nearest)), sky_(sky_shape(input.sky)) {
    const std::size_t count = input.photographs.size();
    for (std::size_t k = 0; k < count; ++k) (input.photographs[k].flash_in_camera ? with_flash_ : without_flash_).push_back(k);
    result_.proxy_surfels = scene.proxy.size();
    result_.back_share = scene.transport.back_share;
    result_.light_of_photograph.assign(count, 0);
    result_.own_lights.assign(count, {});
    result_.strangers.assign(count, false);
    result_.sky_model = sky_.name();
  }

  AcquisitionResult solve(const stream::Store& store, MemoryBudget& budget) {
    observe_all(make_tracer(store, scene_.proxy, budget));
    const double scatter = normal_scatter_rad(scene_.proxy, *scene_.nearest);
    if (scatter > kNotedScatter)
      note(concat("the normals of neighbouring points differ by ", tenths(scatter * 57.2958), " degrees, which makes the lights less certain",
                  store.manifest().normals_from_file ? ": cloud.normals = \"estimate\" may give smoother ones than the file's" : ""));
    std::vector<float> albedo(3 * scene_.proxy.size(), 0.3f);
    if (input_.method == Method::kAdam) {
      for (const std::size_t k : with_flash_) {
        result_.light_of_photograph[k] = result_.lights.size();
        result_.lights.push_back(solve_with_adam(scene_, smoother_, input_, k, folder_, albedo, report_));
      }
    } else if (input_.method == Method::kDirect) {
      result_.lights.push_back(direct_light(scene_, input_, folder_));
    } else {
      const double bounce_sd = std::hypot(kBounceSd, kScaleByScatter * scatter * scatter);
      const auto problems = split();
      for (const auto& photographs : problems) albedo = solve_problem(photographs, problems.size() == 1, bounce_sd);
    }
    forget_observations();
    result_.errors.resize(result_.lights.size());
    write_floats(albedo, proxy_albedo_path(folder_));
    return std::move(result_);
  }

 private:
  void note(std::string text) { result_.notes.push_back(std::move(text)); }

  /// What the photographs say is kept on disk while their lights are found, and what each of them gathers until its albedo is.
  void require_space() const {
    std::uint64_t there = 0;
    for (std::size_t k = 0; k < input_.photographs.size(); ++k)
      for (const auto& file : {observation_path(folder_, k), gathered_path(folder_, k), floor_flash_path(folder_, k)}) there += allocated_bytes(file);
    const std::uint64_t each = observation_bytes(scene_.proxy.size()) + scene_.proxy.size() * (3 + (scene_.floor ? 1 : 0)) * sizeof(float);
    require_disk_space(folder_, "what is found of the photographs' light", input_.photographs.size() * each, free_disk_bytes(folder_) + there);
  }

  void forget_observations() const {
    std::error_code code;
    for (std::size_t k = 0; k < input_.photographs.size(); ++k) std::filesystem::remove(observation_path(folder_, k), code);
  }

  void observe_all(const surfels::Tracer& tracer) const {
    require_space();
    report_.begin("observe", input_.photographs.size(), "photographs");
    for (std::size_t k = 0; k < input_.photographs.size(); ++k) {
      Observation o = observe(scene_.proxy, input_.photographs[k]);
      if (const auto flash = flash_in_world(input_, k)) cast_flash(scene_.proxy, tracer, *flash, o);
      write_observation(o, observation_path(folder_, k));
      report_.progress(k + 1);
      report_.check();
    }
    if (scene_.floor) light_floor(tracer);
    report_.end();
  }

  void light_floor(const surfels::Tracer& tracer) const {
    constexpr std::size_t kTogether = 8;   // 64 bytes a surfel
    for (std::size_t first = 0; first < with_flash_.size(); first += kTogether) {
      report_.check();
      const std::span<const std::size_t> some = std::span(with_flash_).subspan(first, std::min(kTogether, with_flash_.size() - first));
      std::vector<Vec3d> flashes;
      for (const std::size_t k : some) flashes.push_back(*flash_in_world(input_, k));
      const std::vector<std::vector<float>> by_floor = flash_by_floor(scene_.proxy, scene_.transport, smoother_, tracer, *scene_.floor, flashes);
      for (std::size_t i = 0; i < some.size(); ++i) write_floats(by_floor[i], floor_flash_path(folder_, some[i]));
    }
  }

  /// The photographs whose lights are found together: all, or each with those without flash.
  std::vector<std::vector<std::size_t>> split() {
    bool joint = input_.method == Method::kJoint;
    const std::size_t count = input_.photographs.size();
    if (joint && with_flash_.size() > 1)
      if (const std::size_t shared = shared_surfels(scene_.proxy.size(), count, folder_); shared < kLeastShared) {
        joint = false;
        note(concat(input_.names[with_flash_[0]], " and the others of the acquisition show ", shared, " places of the cloud in common, too few to find their lights together: each is solved by itself"));
      }
    std::vector<std::vector<std::size_t>> problems;
    if (joint) {
      problems.emplace_back(count);
      std::iota(problems[0].begin(), problems[0].end(), std::size_t{0});
      return problems;
    }
    for (const std::size_t k : with_flash_) {
      problems.push_back({k});
      problems.back().insert(problems.back().end(), without_flash_.begin(), without_flash_.end());
    }
    return problems;
  }

  /// Returns the albedo of the proxy.
  std::vector<float> solve_problem(const std::vector<std::size_t>& photographs, bool only, double bounce_sd) {
    LightProblem problem(scene_, smoother_, input_, options_, photographs, folder_, bounce_sd);
    Lights start = start_lights(input_, sky_.terms);
    guess_flash(scene_, input_, folder_, start);
    report_.begin(only ? "light" : concat("light ", input_.names[photographs[0]]), static_cast<std::uint64_t>(options_.outer_iterations), "iterations");
    const std::size_t number = result_.lights.size();
    result_.lights.push_back(problem.solve(sky_, start, result_.outer_iterations, result_.last_change, report_));
    report_.end();
    for (const std::size_t k : photographs) {
      if (number == 0 || input_.photographs[k].flash_in_camera) result_.light_of_photograph[k] = number;
      if (const OwnLight& own = problem.own_lights()[k]; own.exposure != 1 || own.ambient != 1) result_.own_lights[k] = own;
      if (problem.strangers_found()[k]) result_.strangers[k] = true;
    }
    result_.sky_model = problem.sky().name();
    result_.sky_evidence = problem.sky_evidence();
    result_.gloss_evidence = problem.gloss_evidence();
    result_.errors.push_back(problem.errors());
    for (const std::uint16_t t : problem.times_seen()) result_.proxy_seen += t > 0;
    note_findings(problem, photographs, only);
    return problem.albedo();
  }

  void note_findings(LightProblem& problem, const std::vector<std::size_t>& photographs, bool only) {
    const LightSolution& solution = result_.lights.back();
    const std::string& first = input_.names[photographs[0]];
    const bool several = photographs.size() > 1;
    if (several) {
      take_pattern(problem.pattern());
      result_.spread = problem.light_spread();
    }
    if (const Gloss& gloss = solution.lights.gloss; gloss.on)
      note(concat("the surfaces are glossy: a clear coat that mirrors ", tenths(100 * static_cast<double>(gloss.reflectance)), " % (roughness ", hundredths(static_cast<double>(gloss.roughness)),
                  ") explains the photographs better, and was taken off the albedo everywhere; the scale of the albedo is less certain"));
    if (!solution.converged)
      note(concat(first, several ? " and the others of the acquisition" : "", ": the lights had not settled after ", result_.outer_iterations, " iterations, last change ", result_.last_change));
    for (std::string& text : problem.notes(solution)) note(std::move(text));
    if (problem.without_bounces()) note(concat(first, several ? " and the others of the acquisition show" : " shows", " no interreflection: bounced light was left out"));
    if (problem.num_references() < input_.references.size() && only)
      note(concat(input_.references.size() - problem.num_references(), " reference targets cover no usable pixel and were left out"));
  }

  void take_pattern(const LightPattern& pattern) {
    result_.pattern = pattern;
    if (const Vec3d& shift = pattern.flash_shift; !shift.isZero()) {
      const double mm_per_unit = 1000 * scene_.proxy.metres_per_unit;
      const auto mm = [&](int axis) { return std::lround(mm_per_unit * shift[axis]); };
      note(concat("the flash stands ", std::lround(mm_per_unit * shift.norm()), " mm from where the project has it, by what the photographs show (right, down, forward: ", mm(0), ", ", mm(1), ", ", mm(2),
                  " mm): this was taken into account; is offset_in_camera right?"));
    }
    const Falloff& falloff = pattern.falloff;
    const double lost = 1 - kept_in_corners(falloff);
    const std::string by = concat(lost > 0 ? "by " : "brighter by ", std::lround(100 * std::fabs(lost)), " %");
    if (falloff.of_lens()) note(concat("the photographs are ", lost > 0 ? "darker towards their corners, " : "", by, lost > 0 ? " there" : " in their corners", ", as a lens makes them: this was taken off"));
    if (falloff.of_flash()) note(concat("the flash is ", lost > 0 ? "weaker off its axis, " : "", by, " in the pictures' corners: this was taken into account"));
  }

  const Scene& scene_;
  const AcquisitionInput& input_;
  const AcquisitionOptions& options_;
  const std::filesystem::path& folder_;
  Reporter& report_;
  const Smoother smoother_;
  const SkyShape sky_;
  std::vector<std::size_t> with_flash_, without_flash_;
  AcquisitionResult result_;
};

}  // namespace

AcquisitionResult solve_acquisition(const stream::Store& store, const Scene& scene, const AcquisitionInput& input, const AcquisitionOptions& options,
                                    const std::filesystem::path& folder, MemoryBudget& budget, Reporter& report) {
  return AcquisitionSolver(scene, input, options, folder, report).solve(store, budget);
}

}  // namespace chiaro::optimize
