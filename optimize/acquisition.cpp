#include "optimize/acquisition.h"

#include <algorithm>
#include <cmath>
#include <numeric>

#include "optimize/adam.h"
#include "optimize/light_problem.h"
#include "optimize/normal_scatter.h"
#include "optimize/proxy_file.h"
#include "optimize/radiosity.h"
#include "stream/base/error.h"

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

surfels::Tracer make_tracer(const stream::Store& store, const Proxy& proxy, MemoryBudget& budget) {
  surfels::Tracer tracer(proxy.origin_in_world, budget);
  for (const std::uint32_t c : proxy.chunks) tracer.add(store.read_chunk(c));
  tracer.commit();
  return tracer;
}

std::vector<surfels::View> views_of(const AcquisitionInput& input) {
  std::vector<surfels::View> views;
  for (const ObserveInput& p : input.photographs)
    views.push_back({p.camera.lens, p.camera.pose, {0, 0, p.camera.lens.width_px, p.camera.lens.height_px}, {}});
  return views;
}
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

}  // namespace

std::filesystem::path floor_flash_path(const std::filesystem::path& folder, std::size_t k) { return folder / concat("floor_", k, ".bin"); }
std::filesystem::path gathered_path(const std::filesystem::path& folder, std::size_t k) { return folder / concat("gathered_", k, ".bin"); }
std::filesystem::path proxy_albedo_path(const std::filesystem::path& folder) { return folder / "albedo.bin"; }

std::uint64_t proxy_surfels_within(std::uint64_t bytes, int rays) {
  // hits, sky, floor, smoother, kd-tree, geometry, blocks and tree, one observation, gathered light, means, samples
  const std::uint64_t per_surfel = static_cast<std::uint64_t>(rays) * 4 + 36 + 36 + 4 + 128 + 24 + 33 + 20 + 74 + 24 + 40 + 40;
  return bytes / per_surfel;
}

namespace {

/// What the cloud can see of a floor below this share does not matter.
constexpr float kLeastFloorShare = 0.005f;

void write_floor_of(const Proxy& proxy, const Transport& transport, const Smoother& smoother, const AcquisitionInput& input, const std::filesystem::path& path) {
  std::optional<Floor> floor;
  std::vector<float> hidden;
  if (input.floor_plane) {
    const Vec3d n((*input.floor_plane)[0], (*input.floor_plane)[1], (*input.floor_plane)[2]);
    floor = Floor{n.normalized().cast<float>(), static_cast<float>((*input.floor_plane)[3] / n.norm() - n.normalized().dot(proxy.origin_in_world))};
  } else if (input.try_floor) {
    std::vector<Mat3d> rotations;
    for (const ObserveInput& p : input.photographs) rotations.push_back(p.camera.pose.rotation_camera_from_world);
    floor = find_floor(proxy, rotations);
  }
  if (floor) {
    hidden = hidden_by_floor(proxy, transport, smoother, *floor);
    double mean = 0;
    for (std::size_t i = 0; i < proxy.size(); ++i) mean += static_cast<double>(hidden[i * kSkyTerms]) / (3.14159265 * static_cast<double>(proxy.size()));
    if (mean < static_cast<double>(kLeastFloorShare)) floor.reset();
  }
  write_floor(floor, hidden, path);
}

}  // namespace

void gather_scene(const stream::Store& store, const AcquisitionInput& input, const AcquisitionOptions& options, const std::filesystem::path& folder,
                  MemoryBudget& budget, Reporter& report) {
  const std::uint64_t most = std::min<std::uint64_t>(options.max_proxy_surfels, proxy_surfels_within(budget.free_bytes() * 3 / 4, options.rays));
  const auto views = views_of(input);
  Proxy proxy = load_proxy(store, surfels::select_proxy(store, views, std::min(options.proxy_surfels, most), most));
  const BudgetLease lease(budget, proxy.size() * (static_cast<std::uint64_t>(options.rays) * 4 + 300), "light transport");
  const NearestPoints nearest(proxy.position);
  std::vector<float> votes(proxy.size(), 0.0f);
  for (const ObserveInput& photo : input.photographs) {
    const std::vector<float> v = visibility_votes(proxy, photo);
    for (std::size_t i = 0; i < votes.size(); ++i) votes[i] += v[i];
    report.check();
  }
  orient(proxy, votes, nearest);
  const Smoother smoother = make_smoother(proxy, nearest);
  const surfels::Tracer tracer = make_tracer(store, proxy, budget);
  const Transport transport = gather(proxy, tracer, smoother, {options.rays, options.seed, kSmoothPasses}, report);
  write_proxy(proxy, store.manifest().key, folder / "proxy.bin");
  write_transport(transport, folder / "transport.bin");
  write_floor_of(proxy, transport, smoother, input, folder / "floor.bin");
}

Scene load_scene(const stream::Store& store, const std::filesystem::path& folder) {
  Scene scene;
  scene.proxy = read_proxy(store, folder / "proxy.bin");
  scene.transport = read_transport(folder / "transport.bin", scene.proxy.size());
  scene.floor = read_floor(folder / "floor.bin", scene.proxy.size(), scene.transport.hidden);
  scene.nearest = std::make_unique<NearestPoints>(scene.proxy.position);
  return scene;
}

AcquisitionResult solve_acquisition(const stream::Store& store, const Scene& scene, const AcquisitionInput& input, const AcquisitionOptions& options,
                                    const std::filesystem::path& folder, MemoryBudget& budget, Reporter& report) {
  AcquisitionResult result;
  const std::size_t count = input.photographs.size();
  result.proxy_surfels = scene.proxy.size();
  result.back_share = scene.transport.back_share;
  const Smoother smoother = make_smoother(scene.proxy, *scene.nearest);
  {
    const surfels::Tracer tracer = make_tracer(store, scene.proxy, budget);
    report.begin("observe", count, "photographs");
    for (std::size_t k = 0; k < count; ++k) {
      Observation o = observe(scene.proxy, input.photographs[k]);
      if (const auto flash = flash_in_world(input, k)) {
        cast_flash(scene.proxy, tracer, *flash, o);
        if (scene.floor) write_floats(flash_by_floor(scene.proxy, scene.transport, smoother, tracer, *scene.floor, *flash), floor_flash_path(folder, k));
      }
      write_observation(o, observation_path(folder, k));
      report.progress(k + 1);
      report.check();
    }
    report.end();
  }
  result.light_of_photograph.assign(count, 0);
  result.own_lights.assign(count, {});
  result.strangers.assign(count, false);
  std::vector<std::size_t> with_flash, without_flash;
  for (std::size_t k = 0; k < count; ++k) (input.photographs[k].flash_in_camera ? with_flash : without_flash).push_back(k);
  const double scatter = normal_scatter_rad(scene.proxy, *scene.nearest);
  const double bounce_sd = std::hypot(kBounceSd, kScaleByScatter * scatter * scatter);
  if (scatter > kNotedScatter)
    result.notes.push_back(concat("the normals of neighbouring points differ by ", std::lround(scatter * 572.958) / 10.0, " degrees, which makes the lights less certain",
                                  store.manifest().normals_from_file ? ": cloud.normals = \"estimate\" may give smoother ones than the file's" : ""));
  const SkyShape sky = sky_shape(input.sky);
  result.sky_model = sky.name();
  std::vector<float> albedo(3 * scene.proxy.size(), 0.3f);
  if (input.method == Method::kAdam) {
    for (const std::size_t k : with_flash) {
      result.light_of_photograph[k] = result.lights.size();
      result.lights.push_back(solve_with_adam(scene, smoother, input, k, folder, albedo, report));
    }
  } else if (input.method == Method::kDirect) {
    LightSolution solution;
    solution.lights = start_lights(input, 0);
    guess_flash(scene, input, folder, solution.lights);
    solution.scale_known = input.intensity_range.has_value();
    solution.covariance = Eigen::MatrixXd::Zero(2, 2);
    if (input.intensity_range) solution.covariance(0, 0) = std::pow(0.25 * std::log((*input.intensity_range)[1] / (*input.intensity_range)[0]), 2);
    result.lights.push_back(solution);
  } else {
    std::vector<std::vector<std::size_t>> problems;
    bool joint = input.method == Method::kJoint;
    if (joint && with_flash.size() > 1)
      if (const std::size_t shared = shared_surfels(scene.proxy.size(), count, folder); shared < kLeastShared) {
        joint = false;
        result.notes.push_back(concat(input.names[with_flash[0]], " and the others of the acquisition show ", shared, " places of the cloud in common, too few to find their lights together: each is solved by itself"));
      }
    if (joint) {
      problems.emplace_back(count);
      std::iota(problems[0].begin(), problems[0].end(), std::size_t{0});
    } else {
      for (const std::size_t k : with_flash) {
        problems.push_back({k});
        problems.back().insert(problems.back().end(), without_flash.begin(), without_flash.end());
      }
    }
    for (const auto& photographs : problems) {
      LightProblem problem(scene, smoother, input, options, photographs, folder, bounce_sd);
      Lights start = start_lights(input, sky.terms);
      guess_flash(scene, input, folder, start);
      report.begin(problems.size() > 1 ? concat("light ", input.names[photographs[0]]) : "light", static_cast<std::uint64_t>(options.outer_iterations), "iterations");
      const std::size_t number = result.lights.size();
      result.lights.push_back(problem.solve(sky, start, result.outer_iterations, result.last_change, report));
      report.end();
      for (const std::size_t k : photographs)
        if (number == 0 || input.photographs[k].flash_in_camera) result.light_of_photograph[k] = number;
      for (const std::size_t k : photographs)
        if (const OwnLight& own = problem.own_lights()[k]; own.exposure != 1 || own.ambient != 1) result.own_lights[k] = own;
      for (const std::size_t k : photographs)
        if (problem.strangers_found()[k]) result.strangers[k] = true;
      if (const Vec3d& shift = problem.flash_shift(); !shift.isZero()) {
        result.flash_shift = shift;
        const double mm_per_unit = 1000 * input.metres_per_unit;
        const auto mm = [&](int axis) { return std::lround(mm_per_unit * shift[axis]); };
        result.notes.push_back(concat("the flash stands ", std::lround(mm_per_unit * shift.norm()), " mm from where the project has it, by what the photographs show (right, down, forward: ", mm(0), ", ", mm(1), ", ", mm(2),
                                      " mm): this was taken into account; is offset_in_camera right?"));
      }
      result.sky_model = problem.sky().name();
      result.sky_evidence = problem.sky_evidence();
      result.gloss_evidence = problem.gloss_evidence();
      if (const Gloss& gloss = result.lights.back().lights.gloss; gloss.on)
        result.notes.push_back(concat("the surfaces are glossy: a clear coat that mirrors ", std::lround(1000 * gloss.reflectance) / 10.0, " % (roughness ", std::lround(100 * gloss.roughness) / 100.0,
                                      ") explains the photographs better, and was taken off the albedo everywhere; the scale of the albedo is less certain"));
      albedo = problem.albedo();
      result.errors.push_back(problem.errors());
      if (!result.lights.back().converged)
        result.notes.push_back(concat(input.names[photographs[0]], photographs.size() > 1 ? " and the others of the acquisition" : "", ": the lights had not settled after ", result.outer_iterations,
                                      " iterations, last change ", result.last_change));
      for (std::string& note : problem.notes(result.lights.back())) result.notes.push_back(std::move(note));
      if (problem.without_bounces())
        result.notes.push_back(concat(input.names[photographs[0]], photographs.size() > 1 ? " and the others of the acquisition show" : " shows",
                                      " no interreflection: bounced light was left out"));
      for (const std::uint16_t t : problem.times_seen()) result.proxy_seen += t > 0;
      if (problem.num_references() < input.references.size() && problems.size() == 1)
        result.notes.push_back(concat(input.references.size() - problem.num_references(), " reference targets cover no usable pixel and were left out"));
    }
  }
  result.errors.resize(result.lights.size());
  write_floats(albedo, proxy_albedo_path(folder));
  return result;
}

}  // namespace chiaro::optimize
