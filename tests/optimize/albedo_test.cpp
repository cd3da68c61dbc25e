#include "optimize/albedo.h"

#include <gtest/gtest.h>

#include <cmath>
#include <numbers>

#include "optimize/gloss_light.h"
#include "optimize/proxy_file.h"
#include "stream/base/parallel.h"
#include "tests/optimize/pictured_ground.h"

namespace chiaro::optimize {
namespace {

using tests::even;
using tests::kHeight;
using tests::kWidth;

constexpr double kPi = std::numbers::pi;
constexpr int kX = 6, kY = 2;   // the pixel that is asked: beside the middle on both axes

/// A ground before a camera; all that is gathered is even, so that every pixel's light is a closed form.
struct Ground : tests::PicturedGround {
  Ground() {
    const std::size_t n = scene.proxy.size();
    for (std::size_t i = 0; i < n; ++i) {
      scene.transport.sky.insert(scene.transport.sky.end(), sky.begin(), sky.end());
      scene.transport.hidden.insert(scene.transport.hidden.end(), hidden.begin(), hidden.end());
      gathered.insert(gathered.end(), g.begin(), g.end());
    }
    floor_flash.assign(n, k);
    lights.covariance = Eigen::MatrixXd::Zero(3, 3);
    lights.sky_terms = 1;
    lights.lights.flash_intensity = 4;
    lights.lights.sky[0] = 0.3;
    planes["flash"] = even(flash);
    planes["r"] = even(colour[0]);
    planes["g"] = even(colour[1]);
    planes["b"] = even(colour[2]);
  }

  Vec3d moved_flash() const { return flash_at + photo.camera.pose.rotation_camera_from_world.transpose() * inputs.pattern.flash_shift; }

  /// Of light l on the pixel: 1 / r^2 and the cosine beside the recorded place of the flash, and the flash's pattern.
  double flash_there() const {
    const auto law = [&](const Vec3d& from) { return (from - place(kX, kY)).z() / std::pow((from - place(kX, kY)).norm(), 3); };
    const Falloff& f = inputs.pattern.falloff;
    const Vec3d along = photo.camera.pose.rotation_camera_from_world * (place(kX, kY) - moved_flash()).normalized();
    const double x = along.x() / f.flash_corner_sine, y = along.y() / f.flash_corner_sine, q = x * x + y * y;
    return flash * law(moved_flash()) / law(flash_at) * std::exp(f.flash[0] * x + f.flash[1] * y + f.flash[2] * q + f.flash[3] * q * q);
  }
  struct Light {
    double flash = 0, ambient = 0, indirect = 0, by_floor = 0;
    double all() const { return flash + ambient + indirect; }
  };
  Light light(const Lights& l, std::size_t c) const {
    Light e;
    double open = 0;
    for (std::size_t term = 0; term < kSkyTerms; ++term) open += l.sky[term] * static_cast<double>(sky[term] - (l.floor ? hidden[term] : 0.0f));
    if (l.floor) open += l.floor_albedo * l.sky[0] * static_cast<double>(hidden[0]);
    e.flash = l.flash_intensity * flash_there();
    e.ambient = photo.ambient_scale * inputs.own.ambient * l.sky_colour[c] * open;
    e.by_floor = l.floor ? l.floor_albedo * l.flash_intensity * static_cast<double>(k) : 0;
    e.indirect = l.bounce * static_cast<double>(g[c]) + e.by_floor;
    return e;
  }
  double mean_light(const Lights& l) const { return (light(l, 0).all() + light(l, 1).all() + light(l, 2).all()) / 3; }
  /// What the lens leaves, and the brightness that is the photograph's own.
  double brightness() const {
    const Vec3d along = photo.camera.pose.rotation_camera_from_world * (place(kX, kY) - eye).normalized();
    const double corner = std::hypot(kWidth, photo.camera.lens.height_px) / 2 / 14, sine = corner / std::sqrt(1 + corner * corner), q = along.head<2>().squaredNorm() / (sine * sine);
    return inputs.own.exposure * std::exp(inputs.pattern.falloff.lens[0] * q + inputs.pattern.falloff.lens[1] * q * q);
  }
  double albedo(std::size_t c) const { return kPi * colour[c] / brightness() / light(lights.lights, c).all(); }

  void solve() {
    write();
    inputs.gathered = folder.path() / "gathered.bin";
    inputs.floor_flash = folder.path() / "floor.bin";
    write_floats(gathered, inputs.gathered);
    write_floats(floor_flash, inputs.floor_flash);
    stats = solve_albedo(scene, photo, lights, flash_at, inputs, options, folder.path() / "albedo.raster", silent_reporter());
  }
  double value(const char* plane, int x = kX, int y = kY) const {
    return static_cast<double>(stream::RasterReader(folder.path() / "albedo.raster").rows<float>(plane, y, 1)[static_cast<std::size_t>(x)]);
  }
  double solved(const char* plane) {
    solve();
    return value(plane);
  }

  /// Nothing is uncertain until a test says so.
  void be_certain() {
    options.errors = {0, 0, 0, 0, 0, true};
    lights.covariance.setZero();
  }

  const Vec3d flash_at{0.4, 0.2, 1.3};
  static constexpr double flash = 0.35, colour[3] = {0.21, 0.17, 0.11};
  static constexpr float k = 0.04f;
  const std::array<float, kSkyTerms> sky{2.9f, 0.3f, 1.1f, -0.2f, 0.05f, 0.12f, 0.4f, -0.3f, 0.2f}, hidden{0.7f, -0.1f, -0.3f, 0.1f, 0.02f, -0.06f, 0.1f, 0.03f, 0.05f};
  const std::array<float, 3> g{0.5f, 0.4f, 0.25f};
  std::vector<float> gathered, floor_flash;
  LightSolution lights;
  AlbedoInputs inputs;
  AlbedoOptions options;
  AlbedoStats stats;
};

constexpr double kRelTol = 0x1p-16 + 2e-6;   // planes keep 15 bits of the fraction; float pixels and positions

void expect_relative(double found, double expected, const char* what, double tolerance = kRelTol) { EXPECT_NEAR(found / expected, 1, tolerance) << what << ": " << found << ", expected " << expected; }

void expect_albedo(Ground& s) {
  s.solve();
  const char* names[] = {"r", "g", "b"};
  for (std::size_t c = 0; c < 3; ++c) expect_relative(s.value(names[c]), s.albedo(c), names[c]);
  double flash = 0, ambient = 0, indirect = 0;
  for (std::size_t c = 0; c < 3; ++c) {
    const Ground::Light e = s.light(s.lights.lights, c);
    flash += e.flash / 3;
    ambient += e.ambient / 3;
    indirect += e.indirect / 3;
  }
  const double all = s.mean_light(s.lights.lights);
  expect_relative(s.value("direct"), flash / all, "direct");
  expect_relative(s.value("ambient"), ambient / all, "ambient");
  expect_relative(s.value("indirect"), indirect / all, "indirect");
}

/// All the light that there can be: a coloured sky of a shape over a floor, and bounces a little stronger than gathered.
void light_everything(Ground& s) {
  Lights& l = s.lights.lights;
  l.sky = {0.3, 0.05, -0.04, 0.02, 0.03, 0.01, 0.02, -0.02, 0.04};
  l.sky_colour = {1.6, 1, 0.5};
  l.bounce = 1.1;
  l.floor = true;
  l.floor_albedo = 0.45;
  s.lights.sky_terms = kSkyTerms;
  s.lights.sky_colour = true;
  s.lights.covariance = Eigen::MatrixXd::Zero(14, 14);
  s.photo.ambient_scale = 0.8;
  s.inputs.own.ambient = 1.4;
  s.inputs.own.exposure = 1.25;
}

TEST(Albedo, IsRadiosityOverIrradiance) {
  Ground s;
  expect_albedo(s);
  light_everything(s);
  expect_albedo(s);
}

TEST(Albedo, IsFreeOfWhatTheLensLoses) {
  Ground s;
  s.inputs.pattern.falloff.lens = {-0.3, -0.1};
  expect_albedo(s);
}

TEST(Albedo, IsLitByTheFlashWhereItWasFoundAndAsItSendsOut) {
  Ground s;
  s.inputs.pattern.flash_shift = {0.03, -0.02, 0.05};
  expect_albedo(s);
  s.inputs.pattern.falloff.flash = {0.1, -0.06, -0.3, 0.05};
  s.inputs.pattern.falloff.flash_corner_sine = 0.6;
  expect_albedo(s);
}

TEST(Albedo, TheStandardWayKnowsNoOtherLight) {
  Ground s;
  light_everything(s);
  s.options.direct_only = true;
  s.solve();
  expect_relative(s.value("g"), kPi * Ground::colour[1] / 1.25 / (4 * Ground::flash), "g");
  EXPECT_EQ(s.value("direct"), 1);
  EXPECT_EQ(s.value("ambient"), 0);
}

TEST(Albedo, BelowACoatIsTheBodys) {
  Ground s;
  s.lights.lights.gloss = {true, 0.05, 0.3};
  s.lights.covariance = Eigen::MatrixXd::Zero(5, 5);
  s.inputs.own.exposure = 1.3;
  const CoatFactors f = coat_factors(s.lights.lights.gloss, gloss_angles(s.place(kX, kY).cast<float>(), Vec3f::UnitZ(), {s.eye.cast<float>(), s.flash_at.cast<float>()}));
  s.solve();
  const char* names[] = {"r", "g", "b"};
  for (std::size_t c = 0; c < 3; ++c) {
    const Ground::Light e = s.light(s.lights.lights, c);
    const double other = e.ambient + e.indirect;
    expect_relative(s.value(names[c]), (kPi * Ground::colour[c] / 1.3 - f.direct_mirrored * e.flash - f.other_mirrored * other) / (f.direct * e.flash + f.other * other), names[c], 1e-5);
  }
}

TEST(Albedo, IsGivenToPixelsThatMeasureASurface) {
  Ground s;
  s.planes["mask"] = [](int x, int) { return x == 0 ? 0.0f : x == 1 ? 3.0f : x == 2 ? 4.0f : 1.0f; };   // masked out, saturated, not finite
  s.planes["depth"] = [depth = s.planes["depth"]](int x, int y) { return x == 3 ? 0.0f : depth(x, y); };
  s.solve();
  for (int x = 0; x < kWidth; ++x)
    for (const char* plane : {"r", "g", "b", "sigma", "shared"}) EXPECT_EQ(std::isnan(s.value(plane, x)), x < 4) << plane << ' ' << x;
  EXPECT_EQ(s.stats.pixels, static_cast<std::uint64_t>(kWidth * kHeight));
  EXPECT_EQ(s.stats.pixels_solved, static_cast<std::uint64_t>((kWidth - 4) * kHeight));
  EXPECT_EQ(s.stats.pixels_impossible, 0u);
}

// Irradiance 2.67 (green): an albedo of 2 is a radiance of 1.7.
TEST(Albedo, OfTwoOrFarBelowBlackIsNone) {
  Ground s;
  s.photo.noise.read_sigma = 0.01;
  const double white = s.light(s.lights.lights, 1).all() / kPi;
  s.planes["g"] = [white](int x, int) { return static_cast<float>(x == 0 ? 2.02 * white : x == 1 ? 1.98 * white : x == 2 ? -0.061 : x == 3 ? -0.059 : 0.1 * white); };
  s.solve();
  EXPECT_TRUE(std::isnan(s.value("g", 0)));
  EXPECT_NEAR(s.value("g", 1), 1.98, 1e-4);
  EXPECT_TRUE(std::isnan(s.value("g", 2)));
  EXPECT_LT(s.value("g", 3), 0);
  EXPECT_EQ(s.stats.pixels_impossible, static_cast<std::uint64_t>(2 * kHeight));
  EXPECT_EQ(s.stats.pixels_above_one, static_cast<std::uint64_t>(kHeight));
}

// One cause at a time.
TEST(AlbedoSigma, IsPixelNoiseOverTheSignal) {
  Ground s;
  s.be_certain();
  s.photo.noise = {2e-4, 3e-3};
  double expected = 0;
  for (const double z : Ground::colour) expected += (2e-4 * z + 9e-6) / (z * z) / 3;
  expect_relative(s.solved("sigma"), std::sqrt(expected), "sigma");
  EXPECT_EQ(s.value("shared"), 0);
  s.planes["b"] = even(1e-3);   // below its noise: known to be dark, and no more
  expected = ((2e-4 * 0.21 + 9e-6) / (0.21 * 0.21) + (2e-4 * 0.17 + 9e-6) / (0.17 * 0.17) + 1) / 3;
  expect_relative(s.solved("sigma"), std::sqrt(expected), "sigma");
}

TEST(AlbedoSigma, UnderACoatOneOfTheBodyAlone) {
  Ground s;
  s.be_certain();
  s.lights.lights.gloss = {true, 0.05, 0.3};
  s.lights.covariance = Eigen::MatrixXd::Zero(5, 5);
  s.photo.noise = {0, 3e-3};
  const CoatFactors f = coat_factors(s.lights.lights.gloss, gloss_angles(s.place(kX, kY).cast<float>(), Vec3f::UnitZ(), {s.eye.cast<float>(), s.flash_at.cast<float>()}));
  double noise = 0, body = 0, measured = 0, direct = 0;
  for (std::size_t c = 0; c < 3; ++c) {
    const Ground::Light e = s.light(s.lights.lights, c);
    noise += 9e-6 / (Ground::colour[c] * Ground::colour[c]) / 3;
    measured += kPi * Ground::colour[c];
    body += kPi * Ground::colour[c] - f.direct_mirrored * e.flash - f.other_mirrored * (e.ambient + e.indirect);
    direct += f.direct_mirrored * e.flash;
  }
  const double highlight = 0.2 * direct / body;   // of what is mirrored of the flash, a fifth
  ASSERT_GT(highlight, 0.01);
  expect_relative(s.solved("sigma"), std::hypot(std::sqrt(noise) * measured / body, highlight), "sigma", 1e-5);
}

TEST(AlbedoSigma, HasTheCausesThatTheErrorModelNames) {
  Ground s;
  const Ground::Light e = s.light(s.lights.lights, 1);
  const double direct = e.flash / s.mean_light(s.lights.lights);
  const auto with = [&](const ErrorModel& errors) {
    s.be_certain();
    s.options.errors = errors;
    s.solve();
  };
  with({0, 0, 0.06, 0, 0, true});
  expect_relative(s.value("sigma"), 0.06 * (1 - direct), "other light");
  expect_relative(s.value("shared"), 0.5 * 0.06 * (1 - direct), "a quarter of the variance is common to all photographs");
  with({0, 0, 0, 0, 0.02, true});
  expect_relative(s.value("sigma"), 0.02, "rest");
  s.planes["spread"] = even(0.4);
  with({0, 0, 0, 0.3, 0, true});
  expect_relative(s.value("sigma"), 0.3 * 0.4 * direct, "spread");
  const Vec3d to_flash = s.flash_at - s.place(kX, kY);
  with({0.03, 0, 0, 0, 0, true});
  EXPECT_EQ(s.value("sigma"), 0);
  expect_relative(s.value("shared"), 0.03 * direct * to_flash.head<2>().norm() / to_flash.z(), "normal");
}

TEST(AlbedoSigma, FollowsTheGradientWhereTheCameraMayBeOff) {
  Ground s;
  s.planes["g"] = [](int x, int y) { return static_cast<float>(0.2 + 0.01 * x + 0.004 * y); };
  s.be_certain();
  s.options.errors.registration_px = 0.3;
  const double value = 0.2 + 0.01 * kX + 0.004 * kY, gradient = std::hypot(0.01, 0.004) / value;
  expect_relative(s.solved("sigma"), 0.3 * gradient, "registration", 1e-4);
  // What the lens blurs, by its standard deviation: a quarter of the disc's diameter.
  s.photo.camera.focus = {0.02, 1.0};
  const double depth = s.depth_along_axis(s.place(kX, kY)), blur = 0.02 * 14 * std::fabs(1 / 1.0 - 1 / depth);
  expect_relative(s.solved("sigma"), std::hypot(0.3, blur / 4) * gradient, "blur", 1e-4);
}

TEST(AlbedoSigma, IsTheSameInEveryRowOfAPictureOfManyRows) {
  Ground s;
  s.be_certain();
  s.options.errors.registration_px = 0.3;
  constexpr int kRows = 300;
  s.photo.camera.lens.cy = kRows / 2.0;
  s.photo.camera.lens.fx = s.photo.camera.lens.fy = 400;
  s.planes["r"] = s.planes["b"] = even(0.1);
  s.planes["g"] = [](int, int y) { return static_cast<float>(0.2 + (y % 2 ? 1e-3 : 0)); };
  s.photo.camera.lens.height_px = kRows;
  s.solve();
  for (int y = 1; y < kRows - 1; ++y) ASSERT_NEAR(s.value("sigma", kX, y), 0.3 * 1e-3 / (0.2 + (y % 2 ? 1e-3 : 0)), 1e-6) << y;
  for (const int step : {64, 127, 128, 129}) {   // one step from a row to the next: both have it
    s.planes["g"] = [=](int, int y) { return y < step ? 0.2f : 0.21f; };
    s.solve();
    EXPECT_NEAR(s.value("sigma", kX, step - 1), 0.3 * 0.01 / 0.2, 1e-5) << step;
    EXPECT_NEAR(s.value("sigma", kX, step), 0.3 * 0.01 / 0.21, 1e-5) << step;
  }
}

TEST(AlbedoSigma, IsLargeBesideACastShadowAndAboveWhite) {
  Ground s;
  s.be_certain();
  s.planes["shadow"] = even(0.5);
  const Vec3d to_flash = s.flash_at - s.place(kX, kY);
  const double all = s.mean_light(s.lights.lights), direct = 4 * Ground::flash, lit = 4 * to_flash.z() / std::pow(to_flash.norm(), 3);
  expect_relative(s.solved("sigma"), 0.7 * 0.5 * std::max(direct, lit - direct) / all, "lit by as much as it receives");
  s.scene.proxy.metres_per_unit = 0.5;   // irradiance is per square metre: four times as much of an unshadowed flash
  ASSERT_GT(4 * lit - direct, direct);
  expect_relative(s.solved("sigma"), 0.7 * 0.5 * (4 * lit - direct) / all, "shaded from");
  s.planes["shadow"] = even(0);
  s.planes["r"] = even(1.25 * s.light(s.lights.lights, 0).all() / kPi);
  expect_relative(s.solved("sigma"), 2 * (1 - 1 / 1.25), "an albedo of 1.25", 1e-5);
}

TEST(AlbedoSigma, HoldsWhatIsOpenOfThePhotographsOwnLight) {
  Ground s;
  light_everything(s);
  s.be_certain();
  s.inputs.own.exposure_ln_sd = 0.03;
  expect_relative(s.solved("sigma"), 0.03, "brightness");
  s.inputs.own.exposure_ln_sd = 0;
  s.inputs.own.ambient_ln_sd = 0.2;
  double ambient = 0;
  for (std::size_t c = 0; c < 3; ++c) ambient += s.light(s.lights.lights, c).ambient / 3;
  expect_relative(s.solved("sigma"), 0.2 * ambient / s.mean_light(s.lights.lights), "ambient light");
  EXPECT_EQ(s.value("shared"), 0);
}

/// Where a parameter of the lights lies in their covariance, and what a small change of it is.
struct Parameter {
  const char* name;
  std::function<void(Lights&, double)> change;
};

/// One parameter open at a time: the deviation of the albedo is that of the parameter times the change of ln irradiance by it, here by differences of the closed form.
void expect_effects(Ground& s, const std::vector<Parameter>& parameters) {
  constexpr double kStep = 1e-5, kSd = 0.02;
  ASSERT_EQ(static_cast<std::size_t>(s.lights.covariance.rows()), parameters.size());
  for (std::size_t i = 0; i < parameters.size(); ++i) {
    Lights up = s.lights.lights, down = up;
    parameters[i].change(up, kStep);
    parameters[i].change(down, -kStep);
    const double effect = (std::log(s.mean_light(up)) - std::log(s.mean_light(down))) / (2 * kStep);
    s.be_certain();
    s.lights.covariance(static_cast<Eigen::Index>(i), static_cast<Eigen::Index>(i)) = kSd * kSd;
    expect_relative(s.solved("shared"), kSd * std::fabs(effect), parameters[i].name, 1e-4);
    EXPECT_EQ(s.value("sigma"), 0);
  }
}

std::vector<Parameter> flash_and_sky(int terms) {
  std::vector<Parameter> all{{"flash", [](Lights& l, double by) { l.flash_intensity *= std::exp(by); }}};
  for (std::size_t k = 0; k < static_cast<std::size_t>(terms); ++k) all.push_back({"sky", [k](Lights& l, double by) { l.sky[k] += by; }});
  return all;
}
const Parameter kBounce{"bounce", [](Lights& l, double by) { l.bounce += by; }};

TEST(AlbedoShared, FollowsFromTheLightsUncertainty) {
  Ground s;
  std::vector<Parameter> parameters = flash_and_sky(1);
  parameters.push_back(kBounce);
  expect_effects(s, parameters);
}

TEST(AlbedoShared, FollowsFromThatOfEveryParameterThatTheLightsMayHave) {
  Ground s;
  light_everything(s);
  std::vector<Parameter> parameters = flash_and_sky(kSkyTerms);
  parameters.push_back({"red", [](Lights& l, double by) { l.sky_colour[0] *= std::exp(by); }});
  parameters.push_back({"blue", [](Lights& l, double by) { l.sky_colour[2] *= std::exp(by); }});
  parameters.push_back({"floor", [](Lights& l, double by) { l.floor_albedo += by; }});
  parameters.push_back(kBounce);
  expect_effects(s, parameters);
}

TEST(AlbedoShared, ErrorsOfLightsThatGoTogetherAddUp) {
  Ground s;
  s.be_certain();
  s.lights.covariance << 4e-4, 1e-4, 0, 1e-4, 9e-4, 0, 0, 0, 0;
  const double all = s.mean_light(s.lights.lights), a = 4 * Ground::flash / all, b = static_cast<double>(s.sky[0]) / all;
  expect_relative(s.solved("shared"), std::sqrt(a * a * 4e-4 + 2 * a * b * 1e-4 + b * b * 9e-4), "both");
}

TEST(AlbedoShared, HoldsTheFalloffsOwn) {
  Ground s;
  s.be_certain();
  s.inputs.pattern.falloff.lens = {-0.3, 0};
  s.inputs.pattern.falloff.covariance(0, 0) = 1e-4;
  const double q = -std::log(s.brightness()) / 0.3;
  expect_relative(s.solved("shared"), 0.01 * q, "lens", 1e-5);
  s.inputs.pattern.falloff.lens.setZero();
  s.inputs.pattern.falloff.flash = {0, 0, -0.3, 0};
  s.inputs.pattern.falloff.covariance.setZero();
  s.inputs.pattern.falloff.covariance(2, 2) = 1e-4;
  const double there = s.flash_there(), of_flash = -std::log(there / Ground::flash) / 0.3;
  expect_relative(s.solved("shared"), 0.01 * of_flash * 4 * there / s.mean_light(s.lights.lights), "flash", 1e-5);
}

TEST(AlbedoShared, HoldsTheCoatsOwn) {
  Ground s;
  s.lights.lights.gloss = {true, 0.05, 0.3};
  s.lights.covariance = Eigen::MatrixXd::Zero(5, 5);   // flash, sky, reflectance, roughness, bounce
  for (const char* name : {"r", "g", "b"}) s.planes[name] = even(0.2);
  s.gathered.assign(s.gathered.size(), 0.4f);
  const GlossAngles angles = gloss_angles(s.place(kX, kY).cast<float>(), Vec3f::UnitZ(), {s.eye.cast<float>(), s.flash_at.cast<float>()});
  const double sky = static_cast<double>(s.sky[0]);
  const auto ln_albedo = [&](const std::array<double, 5>& by) {
    Gloss gloss = s.lights.lights.gloss;
    gloss.reflectance *= std::exp(by[2]);
    gloss.roughness *= std::exp(by[3]);
    const CoatFactors f = coat_factors(gloss, angles);
    const double direct = 4 * std::exp(by[0]) * Ground::flash, other = (0.3 + by[1]) * sky + (1 + by[4]) * 0.4;
    return std::log((kPi * 0.2 - f.direct_mirrored * direct - f.other_mirrored * other) / (f.direct * direct + f.other * other));
  };
  const CoatFactors f = coat_factors(s.lights.lights.gloss, angles);
  const double direct = 4 * Ground::flash, other = 0.3 * sky + 0.4, body = kPi * 0.2 - f.direct_mirrored * direct - f.other_mirrored * other;
  const double common = 0.5 * 0.2 * f.direct_mirrored * direct / body;   // half of the highlight's deviation
  for (std::size_t i = 0; i < 5; ++i) {
    constexpr double kStep = 1e-4;
    std::array<double, 5> up{}, down{};
    up[i] = kStep;
    down[i] = -kStep;
    s.be_certain();
    s.lights.covariance(static_cast<Eigen::Index>(i), static_cast<Eigen::Index>(i)) = 4e-4;
    expect_relative(s.solved("shared"), std::hypot(0.02 * (ln_albedo(up) - ln_albedo(down)) / (2 * kStep), common), "coat", 1e-4);
  }
}

TEST(Albedo, CountsWhatTheFlashHardlyReachesAndSaysTheMiddleOfItsDeviations) {
  Ground s;
  s.be_certain();
  s.planes["flash"] = [](int x, int) { return x < 2 ? 0.01f : 0.1f; };
  s.options.errors.rest = 0.03;
  s.photo.camera.lens.height_px = 97;
  s.solve();
  EXPECT_EQ(s.stats.pixels_dark, static_cast<std::uint64_t>(2 * 97));
  EXPECT_NEAR(s.stats.median_sigma, std::hypot(0.03, 0.015), 1e-6);
}

TEST(Albedo, HasTheSameBytesForAnyThreads) {
  Ground s;
  light_everything(s);
  const auto bytes = [&](int threads) {
    const ThreadLimit limit(threads);
    s.solve();
    return read_text(s.folder.path() / "albedo.raster");
  };
  EXPECT_EQ(bytes(1), bytes(8));
}

}  // namespace
}  // namespace chiaro::optimize
