#include "tools/run_lights.h"

#include <gtest/gtest.h>

#include <cmath>
#include <nlohmann/json.hpp>

#include "stream/base/file.h"
#include "tools/run_context_json.h"

namespace chiaro::tools {
namespace {

using Json = nlohmann::ordered_json;

/// A project of photographs with flash, two of them without, whose lights a test writes down; what lights.json makes of them.
struct Solved {
  Solved() {
    project.acquisitions.resize(2);
    Acquisition &lit = project.acquisitions[0], &dark = project.acquisitions[1];
    lit.name = "lit";
    lit.flash = FlashInput{};
    lit.flash->intensity_range = std::array<double, 2>{18, 22};
    dark.name = "dark";
    dark.role = AcquisitionRole::kNoFlash;
    dark.lights_of = 0;
    for (const char* key : {"a", "b", "c"}) lit.photographs.push_back({key, key, key, {}});
    for (const char* key : {"d", "e"}) dark.photographs.push_back({key, key, key, {}});
    for (std::size_t s = 0; s < 2; ++s) {
      Shoot shoot;
      shoot.acquisition = &project.acquisitions[s];
      for (const PhotographInput& p : shoot.acquisition->photographs) {
        Photo photo;
        photo.input = &p;
        photo.index_in_acquisition = shoot.photos.size();
        photo.index_in_lights = shoot.photos.size() + 3 * s;
        shoot.photos.push_back(photo);
      }
      shoots.push_back(shoot);
    }
    optimize::AcquisitionResult& r = shoots[0].lights;
    r.lights = {light(20, 0.5)};
    r.errors = {{0.011, 0.12, 0.013, 0.14, 0.015, true}};
    r.light_of_photograph.assign(5, 0);
    r.own_lights.assign(5, {});
    r.strangers.assign(5, false);
    r.sky_model = "uniform";
  }
  static optimize::LightSolution light(double flash, double ambient) {
    optimize::LightSolution s;
    s.lights.flash_intensity = flash;
    s.lights.sky[0] = ambient;
    s.sky_terms = 1;
    s.covariance = Eigen::MatrixXd::Zero(3, 3);
    s.covariance.diagonal() << 0.0009, 0.0016, 0.01;   // 3 % of the flash, 0.04 of the ambient light
    s.ambient_open = 0.0009;                           // 0.03: with it 0.05
    s.scale_known = true;
    return s;
  }
  Json written(std::size_t shoot = 0) {
    const RunContext run{project, RunFolder{folder.path()}, TaskLog(folder.path() / "tasks"), budget, record, silent_reporter(), ProgressLog(folder.path() / "progress")};
    write_run_lights(run, shoots);
    return Json::parse(read_text(folder.path() / "lights.json"))["acquisitions"][shoot];
  }
  ScratchFolder folder;
  Project project;
  std::vector<Shoot> shoots;
  MemoryBudget budget{1u << 20};
  RunRecord record{"run", {}};
};

TEST(RunLights, SayWhatIsFoundAndHowCertainItIs) {
  Solved s;
  const Json j = s.written();
  EXPECT_EQ(j["flash_intensity"], 20);
  EXPECT_NEAR(j["flash_intensity_sd"].get<double>(), 0.6, 1e-9);
  EXPECT_EQ(j["ambient"], 0.5);
  EXPECT_NEAR(j["ambient_sd"].get<double>(), 0.05, 1e-9);
  EXPECT_NEAR(j["allowed"]["flash_intensity"][0].get<double>(), 20 * std::exp(-0.06), 1e-9);
  EXPECT_NEAR(j["allowed"]["flash_intensity"][1].get<double>(), 20 * std::exp(0.06), 1e-9);
  EXPECT_NEAR(j["allowed"]["ambient"][0].get<double>(), 0.4, 1e-9);
  EXPECT_NEAR(j["allowed"]["ambient"][1].get<double>(), 0.6, 1e-9);
  EXPECT_EQ(j["calibrated_range"], Json({18, 22}));
  EXPECT_EQ(j["absolute_scale"], "calibrated");
  EXPECT_EQ(j["errors"]["registration_px"], 0.12);
  EXPECT_EQ(j["how"], "jointly over 3 photographs and 2 without flash: log ratios of surfels seen at least twice");
  EXPECT_FALSE(j.contains("exposures"));
  EXPECT_FALSE(j.contains("gloss"));
  EXPECT_EQ(s.written(1)["lights_of"], "lit");
  s.shoots[0].lights.lights[0].lights.sky[0] = 0.02;
  EXPECT_EQ(s.written()["allowed"]["ambient"][0], 0) << "no light is darker than none";
  s.shoots[0].lights.lights[0].scale_known = false;
  EXPECT_NE(s.written()["absolute_scale"], "calibrated");
}

TEST(RunLights, NameEachUnknownOfTheCovariance) {
  using Names = std::vector<std::string>;
  Solved s;
  optimize::LightSolution& light = s.shoots[0].lights.lights[0];
  EXPECT_EQ(s.written()["covariance_of"], Names({"ln_flash_intensity", "sky_0", "bounce"}));
  light.sky_terms = 4;
  light.sky_colour = light.lights.floor = light.lights.gloss.on = true;
  light.lights.floor_albedo = 0.35;
  light.covariance = Eigen::MatrixXd::Zero(11, 11);
  const Json j = s.written();
  EXPECT_EQ(j["covariance_of"], Names({"ln_flash_intensity", "sky_0", "sky_1", "sky_2", "sky_3", "ln_sky_red", "ln_sky_blue", "floor_albedo", "ln_gloss_reflectance", "ln_gloss_roughness", "bounce"}));
  EXPECT_EQ(j["covariance"].size(), 11u);
  EXPECT_EQ(j["floor_albedo"], 0.35);
  EXPECT_EQ(j["gloss"]["roughness"], 0.25);
}

TEST(RunLights, NamePhotographsOfAnotherLight) {
  Solved s;
  s.shoots[0].lights.own_lights[1] = {1, 0.8, 0, 0.01, true, false};
  s.shoots[0].lights.own_lights[2] = {2, 1, 0.1, 0, false, true};
  s.shoots[0].lights.spread[optimize::kAmbient] = 0.2;
  s.shoots[0].lights.spread[optimize::kExposure] = 0.03;
  const Json j = s.written();
  EXPECT_EQ(j["exposures"], Json({{"b", 0.8}}));
  EXPECT_EQ(j["ambient_factors"].size(), 1u);
  EXPECT_EQ(j["ambient_factors"]["c"]["factor"], 2);
  EXPECT_NEAR(j["ambient_factors"]["c"]["sd"].get<double>(), 0.2, 1e-12) << "a tenth of two";
  EXPECT_EQ(j["ambient_spread"], 0.2);
  EXPECT_EQ(j["exposure_spread"], 0.03);
}

// Solved one by one: the lights of each photograph stand beside its name, whatever the order they were found in.
TEST(RunLights, OfSinglePhotographsAreTheirOwn) {
  Solved s;
  s.project.method = SolveMethod::kSingle;
  optimize::AcquisitionResult& r = s.shoots[0].lights;
  r.lights = {Solved::light(10, 0.1), Solved::light(11, 0.2), Solved::light(12, 0.3)};
  r.errors = {{0.1, 0, 0, 0, 0, true}, {0.2, 0, 0, 0, 0, true}, {0.3, 0, 0, 0, 0, true}};
  r.light_of_photograph = {2, 0, 1, 0, 0};
  const Json j = s.written();
  ASSERT_EQ(j["photographs"].size(), 3u);
  for (const auto& [at, name, flash, normal] : {std::tuple{0, "a", 12, 0.3}, std::tuple{1, "b", 10, 0.1}, std::tuple{2, "c", 11, 0.2}}) {
    EXPECT_EQ(j["photographs"][at]["photograph"], name);
    EXPECT_EQ(j["photographs"][at]["flash_intensity"], flash);
    EXPECT_EQ(j["photographs"][at]["errors"]["normal_rad"], normal);
  }
}

TEST(RunLights, SayWherePhotographsWereTakenAsTheColour) {
  Solved s;
  s.project.method = SolveMethod::kNone;
  EXPECT_FALSE(s.written().contains("flash_intensity"));
}

}  // namespace
}  // namespace chiaro::tools
