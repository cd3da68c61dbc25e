#include "tools/light_spread_json.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <Eigen/Dense>
#include <cmath>
#include <nlohmann/json.hpp>
#include <sstream>

namespace chiaro::tools {
namespace {

using Json = nlohmann::ordered_json;
using testing::HasSubstr;

optimize::LightSolution solution(double flash_sd, double ambient_sd, double correlation) {
  optimize::LightSolution s;
  s.lights.flash_intensity = 20;
  s.lights.sky[0] = 0.2;
  s.sky_terms = 1;
  s.covariance = Eigen::MatrixXd::Zero(3, 3);
  s.covariance(0, 0) = flash_sd * flash_sd;
  s.covariance(1, 1) = std::pow(0.2 * ambient_sd, 2);
  s.covariance(0, 1) = s.covariance(1, 0) = correlation * flash_sd * 0.2 * ambient_sd;
  return s;
}

// An unknown scale: flash and ambient go up and down together, and every albedo the other way by the same factor.
TEST(LightSpread, AnUnknownScaleMovesBothLightsAlike) {
  const LightSpread s = light_spread(solution(0.04, 0.04, 0.9999));
  EXPECT_NEAR(s.flash_intensity[0], 20 * std::exp(-0.08), 1e-3);
  EXPECT_NEAR(s.flash_intensity[1], 20 * std::exp(0.08), 1e-3);
  EXPECT_NEAR(s.ambient[1], 0.2 * std::exp(0.08), 1e-5);
  EXPECT_NEAR(s.albedo_in_flash[1], std::exp(-0.08) - 1, 1e-4);
  EXPECT_NEAR(s.albedo_in_ambient[1], s.albedo_in_flash[1], 1e-4);
  EXPECT_GT(s.albedo_in_flash[0], 0);
}

// A known flash and an ambient light that is off by a tenth: what the flash lights hardly moves.
TEST(LightSpread, AnUnknownAmbientLightMovesWhatItAloneReaches) {
  const LightSpread s = light_spread(solution(0.002, 0.1, 0));
  EXPECT_NEAR(s.albedo_in_flash[1], 0, 1e-6);
  EXPECT_NEAR(std::abs(s.albedo_in_ambient[1]), 0.2, 0.025);
  EXPECT_NEAR(s.flash_intensity[0], 20, 1e-6);
}

TEST(LightSpread, StandsLightsWithoutSkyOrKnowledge) {
  optimize::LightSolution s = solution(0.05, 3, 0);   // the ambient light by a factor of twenty
  EXPECT_NEAR(light_spread(s).flash_intensity[1], 20 * std::exp(0.1), 1e-9);
  s.lights.sky[0] = 0;
  EXPECT_NEAR(light_spread(s).flash_intensity[1], 20 * std::exp(0.1), 1e-9);
  EXPECT_EQ(light_spread(s).ambient[1], 0);
  s.sky_terms = 0;
  s.covariance = Eigen::MatrixXd::Zero(2, 2);
  EXPECT_EQ(light_spread(s).flash_intensity[0], 20);
  EXPECT_EQ(light_spread({}).flash_intensity[0], light_spread({}).flash_intensity[1]);
}

TEST(LightSpread, DrawsWhatItIsGivenAndNothingElse) {
  const Json light{{"flash_intensity", 20}, {"ambient", 0.2}, {"covariance_of", {"ln_flash_intensity", "sky_0", "bounce"}},
                   {"covariance", {{0.0016, 0.0003, 0}, {0.0003, 0.0001, 0}, {0, 0, 0.01}}}};
  const std::string svg = light_spread_svg(light, Json{19.0, 23.0});
  EXPECT_THAT(svg, HasSubstr("<svg"));
  EXPECT_THAT(svg, HasSubstr("</svg>"));
  EXPECT_THAT(svg, HasSubstr("calibrated range"));
  EXPECT_THAT(light_spread_svg(light, nullptr), HasSubstr("no calibrated range"));
  EXPECT_THAT(svg, testing::Not(HasSubstr("nan")));
  for (const char* path : {"/flash_intensity", "/ambient", "/covariance", "/covariance_of", "/covariance/0", "/covariance/1", "/covariance/0/0", "/covariance/1/1"})
    for (const Json& value : {Json(nullptr), Json("x"), Json(-1e300), Json::array()}) {
      Json damaged = light;
      damaged[Json::json_pointer(path)] = value;
      EXPECT_THAT(light_spread_svg(damaged, Json{19.0, 23.0}), testing::Not(HasSubstr("nan"))) << path << ' ' << value;
    }
}

/// Points of the paths that are ellipses, in the picture's coordinates: the first is that of two deviations, the second of one.
std::vector<std::vector<Eigen::Vector2d>> ellipses(const std::string& svg) {
  std::vector<std::vector<Eigen::Vector2d>> all;
  for (std::size_t at = svg.find("<path d=\"M"); at != std::string::npos; at = svg.find("<path d=\"M", at + 1)) {
    std::string path = svg.substr(at + 10, svg.find('"', at + 10) - at - 10);
    if (path.find(" Z") == std::string::npos) continue;
    for (char& c : path)
      if (c == 'L' || c == 'Z') c = ' ';
    std::istringstream in(path);
    std::vector<Eigen::Vector2d> points;
    for (double x, y; in >> x >> y;) points.emplace_back(x, y);
    all.push_back(points);
  }
  return all;
}

// Where the picture ends to the right is the flash's mean and three deviations, where it ends on top the ambient light's: by these the ellipses can be read.
TEST(LightSpread, DrawsTheEllipsesOfTheCovariance) {
  const Json light{{"flash_intensity", 20}, {"ambient", 0.2}, {"covariance_of", {"ln_flash_intensity", "sky_0", "bounce"}},
                   {"covariance", {{0.0016, 0.0003, 0}, {0.0003, 0.0001, 0}, {0, 0, 0.01}}}};
  const auto paths = ellipses(light_spread_svg(light, nullptr));
  ASSERT_EQ(paths.size(), 2u);
  Eigen::Matrix2d covariance;   // of flash and ambient light
  covariance << 0.0016 * 400, 0.0003 * 20, 0.0003 * 20, 0.0001;
  const double reach_flash = 3 * 0.8, reach_ambient = 3 * 0.01;
  constexpr double kLeft = 64, kRight = 408, kTop = 12, kBottom = 216;
  for (std::size_t p = 0; p < 2; ++p) {
    const double deviations = p == 0 ? 2 : 1;
    ASSERT_EQ(paths[p].size(), 72u);
    for (const Eigen::Vector2d& at : paths[p]) {
      const Eigen::Vector2d off((2 * (at.x() - kLeft) / (kRight - kLeft) - 1) * reach_flash, (2 * (kBottom - at.y()) / (kBottom - kTop) - 1) * reach_ambient);
      ASSERT_NEAR(std::sqrt(off.dot(covariance.inverse() * off)), deviations, 0.01);
    }
  }
}

}  // namespace
}  // namespace chiaro::tools
