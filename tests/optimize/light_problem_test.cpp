#include "optimize/light_problem.h"

#include <gtest/gtest.h>

#include <cmath>
#include <numbers>

#include "optimize/proxy_file.h"
#include "stream/base/error.h"
#include "stream/base/file.h"
#include "stream/base/rng.h"
#include "tests/optimize/picture.h"

namespace chiaro::optimize {
namespace {

using tests::even;

constexpr double kPi = std::numbers::pi;
constexpr double kFlash = 1, kSky = 0.05, kOpen = 2.6;   // W/sr, radiance, pi times the share of the sky that is seen
constexpr int kSize = 80;

/// What is true of one photograph beside the others.
struct Taken {
  double ambient = 1, brightness = 1;   ///< factors of its own
  double shutter = 1;                   ///< ambient_scale that the project knows
  bool flash = true, stranger = false;
};

/// Rough ground in the open before cameras that look down; what each photograph says of each surfel is the closed form of its light. Nothing is gathered, as nothing faces anything.
class Shooting {
 public:
  explicit Shooting(std::vector<Taken> taken) : taken_(std::move(taken)) {
    input.intensity_range = std::array<double, 2>{kFlash * std::exp(-0.02), kFlash * std::exp(0.02)};
    input.sky = SkyModel::kUniform;
    input.try_floor = false;
    input.falloff = FalloffModel::kNone;
  }

  /// What the flash stands beside its place, in camera axes; what the lens leaves in the corners of the pictures.
  Vec3d shift = Vec3d::Zero();
  double lens_loss = 0, flash_loss = 0;
  double metres_per_unit = 1;
  AcquisitionInput input;

  void write() {
    scene.proxy.metres_per_unit = metres_per_unit;
    scene.proxy.origin_in_world = Vec3d(2, -1, 0.3);
    constexpr std::size_t kSurfels = 550;   // the error model asks for 500
    for (std::size_t i = 0; i < kSurfels; ++i) {
      const auto u = uniform01x4(3, Purpose::kTest, i, 0);
      scene.proxy.position.push_back((Vec3d(static_cast<double>(u[0]) * 1.5, static_cast<double>(u[1]) * 1.5, 0) / metres_per_unit - scene.proxy.origin_in_world).cast<float>());
      scene.proxy.normal.push_back(Vec3f(u[2] - 0.5f, u[3] - 0.5f, 1).normalized());
      scene.proxy.radius.push_back(0.03f / static_cast<float>(metres_per_unit));
    }
    scene.nearest = std::make_unique<NearestPoints>(scene.proxy.position);
    smoother = make_smoother(scene.proxy, *scene.nearest);
    scene.transport.rays = 1;
    scene.transport.hits.assign(kSurfels, Transport::kSky);
    scene.transport.sky.assign(kSurfels * kSkyTerms, 0.0f);
    for (std::size_t i = 0; i < kSurfels; ++i) scene.transport.sky[i * kSkyTerms] = static_cast<float>(kOpen);
    const Vec3d eyes[] = {{0.1, 0.1, 1.2}, {1.2, 0.2, 1.0}, {0.3, 1.1, 0.7}, {0.9, 0.9, 1.5}, {0.6, 0.4, 0.9}};
    for (std::size_t k = 0; k < taken_.size(); ++k) {
      ObserveInput p;
      p.camera.photograph = "photo_" + std::to_string(k);
      p.camera.lens.width_px = p.camera.lens.height_px = kSize;
      p.camera.lens.fx = p.camera.lens.fy = 0.55 * kSize;
      p.camera.lens.cx = p.camera.lens.cy = kSize / 2.0;
      const Mat3d look_down = Vec3d(1, -1, -1).asDiagonal();
      p.camera.pose.rotation_camera_from_world = look_down * (Eigen::AngleAxisd(0.5 * static_cast<double>(k), Vec3d::UnitZ()) * Eigen::AngleAxisd(0.12, Vec3d::UnitX())).toRotationMatrix();
      p.camera.pose.translation_camera_from_world = -p.camera.pose.rotation_camera_from_world * eyes[k % 5] / metres_per_unit;
      if (taken_[k].flash) p.flash_in_camera = Vec3d(0.15, -0.1, 0.02) / metres_per_unit;
      p.ambient_scale = taken_[k].shutter;
      input.photographs.push_back(p);
      input.names.push_back(p.camera.photograph);
    }
    for (std::size_t k = 0; k < taken_.size(); ++k) write_observation(observation(k), observation_path(folder.path(), k));
  }

  double albedo_of(std::size_t i, std::size_t c) const { return 0.2 + 0.5 * static_cast<double>(uniform01x4(3, Purpose::kTest, i, 1)[c]); }

  /// Square of the distance off the axis, 1 in the corners.
  double off_axis2(std::size_t k, const Vec3d& from, const Vec3d& place) const {
    const Vec3d d = (input.photographs[k].camera.pose.rotation_camera_from_world * (place - from)).normalized();
    const double corner = std::sqrt(2.0) / 2 / 0.55, sine = corner / std::sqrt(1 + corner * corner);
    return std::min(1.21, d.head<2>().squaredNorm() / (sine * sine));
  }
  /// Irradiance by a flash of 1 W/sr at a place of the world: said is where the project has it.
  double flash_at(std::size_t k, const Vec3d& place, const Vec3d& normal, bool said) const {
    const ObserveInput& p = input.photographs[k];
    if (!p.flash_in_camera) return 0;
    const Vec3d from = p.camera.pose.world_from_camera(*p.flash_in_camera + (said ? Vec3d(Vec3d::Zero()) : shift)), to = (from - place) * metres_per_unit;
    const double falloff = said ? 1 : std::pow(1 - flash_loss, off_axis2(k, from, place));
    return falloff * std::max(0.0, normal.dot(to)) / std::pow(to.norm(), 3);
  }
  /// Radiosity that the photograph shows.
  double shown(std::size_t k, const Vec3d& place, const Vec3d& normal, double albedo) const {
    const double lens = std::pow(1 - lens_loss, off_axis2(k, input.photographs[k].camera.pose.centre_in_world(), place));
    return taken_[k].brightness * lens * albedo * (kFlash * flash_at(k, place, normal, false) + taken_[k].shutter * taken_[k].ambient * kSky * kOpen);
  }
  Vec3d place(std::size_t i) const { return scene.proxy.position[i].cast<double>() + scene.proxy.origin_in_world; }

  Observation observation(std::size_t k) const {
    const std::size_t n = scene.proxy.size();
    Observation o;
    o.seen.assign(n, 1);
    for (auto* v : {&o.spread, &o.gradient, &o.tan_flash}) v->assign(n, 0.0f);
    for (auto* v : {&o.variance, &o.noise}) v->assign(n, 2.5e-5f);
    for (std::size_t i = 0; i < n; ++i) {
      const Vec3d normal = scene.proxy.normal[i].cast<double>();
      o.flash.push_back(static_cast<float>(flash_at(k, place(i), normal, true)));
      for (std::size_t c = 0; c < 3; ++c) {
        const double noise = std::exp(0.005 * normal01(7, Purpose::kTest, 10 * i + k, static_cast<std::uint32_t>(c)));
        const double albedo = taken_[k].stranger ? albedo_of((7 * i + 5) % n, 0) : albedo_of(i, c);
        o.radiosity.push_back(static_cast<float>(noise * shown(k, place(i), normal, albedo)));
      }
    }
    return o;
  }

  /// Something grey and flat of known albedo, all over one picture; it is read at the pixels given.
  void add_target(std::size_t k, double albedo, int x0, int y0) {
    ObserveInput& p = input.photographs[k];
    p.radiance = folder.path() / concat("radiance_", k);
    p.gbuffer = folder.path() / concat("gbuffer_", k);
    const Vec3d eye = p.camera.pose.centre_in_world();
    const auto on_ground = [=, &p](int x, int y) -> Vec3d {
      const Vec3d d = p.camera.pose.rotation_camera_from_world.transpose() * Vec3d((x + 0.5 - p.camera.lens.cx) / p.camera.lens.fx, (y + 0.5 - p.camera.lens.cy) / p.camera.lens.fy, 1);
      return eye - d * (eye.z() / d.z());
    };
    std::map<std::string, tests::Plane> planes;
    for (const char* name : {"nx", "ny", "shadow", "spread"}) planes[name] = even(0);
    for (const char* name : {"nz", "cosv", "coverage", "mask", "lit"}) planes[name] = even(1);
    for (const char* name : {"radius", "footprint", "edge"}) planes[name] = even(0.02);
    for (const char* name : {"r", "g", "b"}) planes[name] = [=, this](int x, int y) { return static_cast<float>(shown(k, on_ground(x, y), Vec3d::UnitZ(), albedo) / kPi); };
    planes["flash"] = [=, this](int x, int y) { return static_cast<float>(flash_at(k, on_ground(x, y), Vec3d::UnitZ(), true)); };
    planes["depth"] = [=](int x, int y) { return static_cast<float>((on_ground(x, y) - eye).norm()); };
    tests::write_picture(p.radiance, p.gbuffer, kSize, kSize, planes);
    ReferenceTarget target;
    target.photograph = k;
    target.albedo = {albedo, albedo, albedo};
    target.sigma = 0.003;
    const double x = x0, y = y0;
    target.polygon = {{x, y}, {x + 3, y}, {x + 3, y + 3}, {x, y + 3}};
    input.references.push_back(target);
  }

  struct Found {
    LightSolution solution;
    std::vector<OwnLight> own;
    LightPattern pattern;
    std::vector<bool> strangers;
    std::vector<float> albedo;
    std::vector<std::string> notes;
    ErrorModel errors;
  };
  Found solve() {
    std::vector<std::size_t> all;
    for (std::size_t k = 0; k < taken_.size(); ++k) all.push_back(k);
    const AcquisitionOptions options;
    LightProblem problem(scene, smoother, input, options, all, folder.path(), 0.012);
    Lights start = start_lights(input, 1);
    guess_flash(scene, input, folder.path(), start);
    int outer = 0;
    double change = 0;
    Found f;
    f.solution = problem.solve(sky_shape(input.sky), start, outer, change, silent_reporter());
    f.own = problem.own_lights();
    f.pattern = problem.pattern();
    f.strangers = problem.strangers_found();
    f.albedo = problem.albedo();
    f.notes = problem.notes(f.solution);
    f.errors = problem.errors();
    return f;
  }

  /// Median of |ln found / true|.
  double albedo_error(const std::vector<float>& found) const {
    std::vector<double> off;
    for (std::size_t i = 0; i < scene.proxy.size(); ++i)
      for (std::size_t c = 0; c < 3; ++c) off.push_back(std::fabs(std::log(static_cast<double>(found[3 * i + c]) / albedo_of(i, c))));
    std::nth_element(off.begin(), off.begin() + static_cast<std::ptrdiff_t>(off.size() / 2), off.end());
    return off[off.size() / 2];
  }

  ScratchFolder folder;
  Scene scene;
  Smoother smoother;

 private:
  std::vector<Taken> taken_;
};

TEST(LightProblem, FindsLightsAndAlbedoOfPhotographsThatAreAlike) {
  Shooting s(std::vector<Taken>(5));
  s.write();
  const auto f = s.solve();
  EXPECT_TRUE(f.solution.converged);
  EXPECT_NEAR(f.solution.lights.flash_intensity / kFlash, 1, 0.01);
  EXPECT_NEAR(f.solution.lights.sky[0] / kSky, 1, 0.01);
  EXPECT_LE(std::sqrt(f.solution.covariance(0, 0)), 0.0102) << "the range is four deviations wide";
  EXPECT_GE(std::sqrt(f.solution.covariance(0, 0)), 0.008) << "nothing else fixes the scale";
  EXPECT_LE(s.albedo_error(f.albedo), 0.01);
  EXPECT_TRUE(f.notes.empty());
  EXPECT_TRUE(f.errors.estimated);
  for (const OwnLight& own : f.own) {
    EXPECT_EQ(own.ambient, 1);
    EXPECT_EQ(own.exposure, 1);
  }
}

TEST(LightProblem, AShutterThatTheProjectKnowsIsNoOtherLight) {
  std::vector<Taken> taken(5);
  taken[1].shutter = 2.5;
  taken[4] = {.shutter = 1.5, .flash = false};
  Shooting s(taken);
  s.input.intensity_range = std::array<double, 2>{0.5 * kFlash, 2 * kFlash};   // the middle of their logarithms
  s.write();
  const auto f = s.solve();
  EXPECT_NEAR(f.solution.lights.flash_intensity / kFlash, 1, 0.01);
  EXPECT_NEAR(f.solution.lights.sky[0] / kSky, 1, 0.01);
  EXPECT_LE(s.albedo_error(f.albedo), 0.01);
  for (const OwnLight& own : f.own) EXPECT_EQ(own.ambient, 1);
}

TEST(LightProblem, AStrangerTakesNoPart) {
  std::vector<Taken> taken(5);
  taken[2].stranger = true;
  Shooting s(taken);
  s.write();
  const auto f = s.solve();
  EXPECT_EQ(f.strangers, (std::vector<bool>{false, false, true, false, false}));
  EXPECT_LT(f.errors.rest, 0.01) << "nor in how far the others disagree";
  EXPECT_LT(f.errors.other_light, 0.03);
  EXPECT_NEAR(f.solution.lights.sky[0] / kSky, 1, 0.01);
  EXPECT_LE(s.albedo_error(f.albedo), 0.01);
}

// The target lies in the photograph that is unlike the others: what is taken out of that is taken out of the target's reading.
TEST(LightProblem, ATargetInAPhotographOfAnotherLightHasIt) {
  const Taken unlike{.ambient = 0.4, .brightness = 0.7};
  std::vector<Taken> taken(5);
  taken[3] = unlike;
  Shooting s(taken);
  s.input.intensity_range.reset();
  s.write();
  s.add_target(3, 0.4, 40, 44);
  const auto f = s.solve();
  EXPECT_NEAR(f.own[3].ambient / unlike.ambient, 1, 0.02);
  EXPECT_NEAR(f.own[3].exposure / unlike.brightness, 1, 0.01);
  EXPECT_TRUE(f.own[3].unlike);
  EXPECT_TRUE(f.own[3].unlike_ambient);
  EXPECT_GT(f.own[3].ambient_ln_sd, 0);
  EXPECT_GT(f.own[3].exposure_ln_sd, 0);
  EXPECT_NEAR(f.solution.lights.flash_intensity / kFlash, 1, 0.01);
  EXPECT_NEAR(f.solution.lights.sky[0] / kSky, 1, 0.015);
  EXPECT_LE(s.albedo_error(f.albedo), 0.01);
  EXPECT_TRUE(f.solution.scale_known);
}

// The mean of five factors whose logarithms scatter by so much is no better known than that over the root of five.
TEST(LightProblem, AnAmbientLightThatVariesIsLeftOpenByItsMean) {
  std::vector<Taken> taken(5);
  const double scatter[] = {-0.3, 0.225, 0.1, -0.15, 0.125};
  for (std::size_t k = 0; k < 5; ++k) taken[k].ambient = std::exp(scatter[k]);
  Shooting s(taken);
  s.write();
  const auto f = s.solve();
  for (std::size_t k = 1; k < 5; ++k) EXPECT_NEAR(std::log(f.own[k].ambient / f.own[0].ambient), scatter[k] - scatter[0], 0.02);
  const double expected = 0.2 / std::sqrt(5.0) * f.solution.lights.sky[0], sd = std::sqrt(f.solution.covariance(1, 1));
  EXPECT_GT(sd, 0.6 * expected);
  EXPECT_LT(sd, 1.6 * expected);
  EXPECT_LE(s.albedo_error(f.albedo), 0.01);
}

// Far from the axis the lens keeps four fifths: of the target as of the surfels.
TEST(LightProblem, ATargetIsFreeOfWhatTheLensLoses) {
  Shooting s(std::vector<Taken>(5));
  s.input.intensity_range.reset();
  s.input.falloff = FalloffModel::kLens;
  s.lens_loss = 0.4;
  s.write();
  s.add_target(3, 0.4, 66, 62);
  const auto f = s.solve();
  ASSERT_TRUE(f.pattern.falloff.of_lens());
  EXPECT_NEAR(lens_factor(f.pattern.falloff, {1, 0}), 0.6, 0.03);
  const double ambient_sd = std::sqrt(f.solution.covariance(1, 1)) / kSky;
  EXPECT_LT(ambient_sd, 0.03) << "in its own unit";
  EXPECT_LT(std::fabs(f.solution.covariance(0, 1)), std::sqrt(f.solution.covariance(0, 0) * f.solution.covariance(1, 1))) << "no more than certain";
  EXPECT_NEAR(f.solution.lights.flash_intensity / kFlash, 1, 0.015);
  EXPECT_NEAR(f.solution.lights.sky[0] / kSky, 1, 0.03);
  EXPECT_LE(s.albedo_error(f.albedo), 0.015);
}

TEST(LightProblem, ATargetIsLitByAFlashThatIsWeakerOffItsAxis) {
  Shooting s(std::vector<Taken>(5));
  s.input.intensity_range.reset();
  s.input.falloff = FalloffModel::kFlash;
  s.flash_loss = 0.4;
  s.write();
  s.add_target(3, 0.4, 62, 58);
  const auto f = s.solve();
  ASSERT_TRUE(f.pattern.falloff.of_flash());
  EXPECT_NEAR(flash_pattern(f.pattern.falloff, {0, 1}), 0.6, 0.05);
  EXPECT_NEAR(f.solution.lights.flash_intensity / kFlash, 1, 0.02);
  EXPECT_NEAR(f.solution.lights.sky[0] / kSky, 1, 0.03);
}

// Three centimetres, whatever the unit.
TEST(LightProblem, FindsAFlashBesideItsPlaceInAnyUnit) {
  for (const double unit : {1.0, 0.01}) {
    Shooting s(std::vector<Taken>(5));
    s.metres_per_unit = unit;
    s.shift = Vec3d(0.02, -0.015, 0.015) / unit;
    s.write();
    s.add_target(3, 0.4, 44, 40);
    const auto f = s.solve();
    EXPECT_LE((f.pattern.flash_shift - s.shift).norm() * unit, 0.003) << f.pattern.flash_shift.transpose();
    EXPECT_NEAR(f.solution.lights.flash_intensity / kFlash, 1, 0.01);
    EXPECT_LE(s.albedo_error(f.albedo), 0.01);
  }
}

// Nobody misplaces a flash by half a metre: in centimetres as in metres.
TEST(LightProblem, AFlashHalfAMetreBesideItsPlaceIsSomethingElse) {
  Shooting s(std::vector<Taken>(5));
  s.metres_per_unit = 0.01;
  s.shift = Vec3d(20, -15, 10);
  s.write();
  EXPECT_TRUE(s.solve().pattern.flash_shift.isZero());
}

TEST(StartLights, AreTheMiddleOfTheRange) {
  AcquisitionInput input;
  EXPECT_EQ(start_lights(input, 0).flash_intensity, 1);
  EXPECT_EQ(start_lights(input, 0).sky[0], 0);
  input.intensity_range = std::array<double, 2>{4, 9};
  EXPECT_NEAR(start_lights(input, 1).flash_intensity, 6, 1e-12);
  EXPECT_GT(start_lights(input, 1).sky[0], 0);
}

// Without a range the brightest surfels reflect 80 %: the 95th of a hundred, by the geometric mean of those that photographs with flash see twice.
TEST(GuessFlash, MakesTheBrightestReflectFourFifths) {
  ScratchFolder folder;
  Scene scene;
  constexpr std::size_t kSurfels = 100;
  for (std::size_t i = 0; i < kSurfels; ++i) {
    scene.proxy.position.push_back(Vec3f(static_cast<float>(i), 0, 0));
    scene.proxy.normal.push_back(Vec3f::UnitZ());
    scene.proxy.radius.push_back(1);
  }
  AcquisitionInput input;
  input.photographs.resize(3);
  for (std::size_t k = 0; k < 3; ++k) {
    Observation o;
    o.seen.assign(kSurfels, 1);
    o.seen[7] = k == 0;   // brighter than all, and seen once
    for (auto* v : {&o.spread, &o.variance, &o.noise, &o.gradient, &o.tan_flash}) v->assign(kSurfels, 0.0f);
    o.flash.assign(kSurfels, k == 2 ? 0.0f : 0.5f);   // the last one has none
    for (std::size_t i = 0; i < kSurfels; ++i)
      for (int c = 0; c < 3; ++c) o.radiosity.push_back(i == 7 ? 1e3f : static_cast<float>(i + 1) * (k == 0 ? 0.5f : 2.0f) * 0.5f * 0.1f);
    write_observation(o, observation_path(folder.path(), k));
  }
  Lights lights;
  guess_flash(scene, input, folder.path(), lights);
  // Ratios 0.1 (i + 1) without surfel 7: 99 of them, the 94th in order (from 0) is that of surfel 95.
  EXPECT_NEAR(lights.flash_intensity, 0.1 * 96 / 0.8, 1e-4);
  input.intensity_range = std::array<double, 2>{4, 9};
  lights.flash_intensity = 6;
  guess_flash(scene, input, folder.path(), lights);
  EXPECT_EQ(lights.flash_intensity, 6);
}

}  // namespace
}  // namespace chiaro::optimize
