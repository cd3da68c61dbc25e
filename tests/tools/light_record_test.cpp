#include "tools/light_record_json.h"

#include <gtest/gtest.h>

#include <cmath>

namespace chiaro::tools {
namespace {

/// Every value another one, so that none can stand for another.
class Numbers {
 public:
  double next() { return value_ += 0.0137; }
  template <class Values>
  void fill(Values& values) {
    for (auto& v : values) v = next();
  }

 private:
  double value_ = 0.1;
};

optimize::LightSolution some_solution(Numbers& n, bool rich) {
  optimize::LightSolution s;
  s.lights.flash_intensity = n.next();
  n.fill(s.lights.sky);
  n.fill(s.lights.sky_colour);
  s.lights.floor = rich;
  s.lights.floor_albedo = n.next();
  s.lights.bounce = n.next();
  if (rich) s.lights.gloss = {true, n.next(), n.next()};
  s.sky_terms = rich ? 9 : 1;
  s.sky_colour = rich;
  s.covariance.resize(3, 3);
  for (Eigen::Index i = 0; i < 3; ++i)
    for (Eigen::Index k = 0; k < 3; ++k) s.covariance(i, k) = n.next();
  s.ambient_open = n.next();
  s.scatter = n.next();
  s.groups = 11;
  s.samples = 12;
  s.iterations = 13;
  s.converged = rich;
  s.scale_known = !rich;
  return s;
}

void expect_same(const optimize::LightSolution& a, const optimize::LightSolution& b) {
  EXPECT_EQ(a.lights.flash_intensity, b.lights.flash_intensity);
  EXPECT_EQ(a.lights.sky, b.lights.sky);
  EXPECT_EQ(a.lights.sky_colour, b.lights.sky_colour);
  EXPECT_EQ(a.lights.floor, b.lights.floor);
  EXPECT_EQ(a.lights.floor_albedo, b.lights.floor_albedo);
  EXPECT_EQ(a.lights.bounce, b.lights.bounce);
  EXPECT_EQ(a.lights.gloss.on, b.lights.gloss.on);
  EXPECT_EQ(a.lights.gloss.reflectance, b.lights.gloss.reflectance);
  EXPECT_EQ(a.lights.gloss.roughness, b.lights.gloss.roughness);
  EXPECT_EQ(a.sky_terms, b.sky_terms);
  EXPECT_EQ(a.sky_colour, b.sky_colour);
  EXPECT_EQ(a.covariance, b.covariance);
  EXPECT_EQ(a.ambient_open, b.ambient_open);
  EXPECT_EQ(a.scatter, b.scatter);
  EXPECT_EQ(a.groups, b.groups);
  EXPECT_EQ(a.samples, b.samples);
  EXPECT_EQ(a.iterations, b.iterations);
  EXPECT_EQ(a.converged, b.converged);
  EXPECT_EQ(a.scale_known, b.scale_known);
}

// A run that goes on from it has to have the same lights, to the last digit.
TEST(LightRecord, ComesBackAsItWas) {
  Numbers n;
  optimize::AcquisitionResult r;
  r.lights = {some_solution(n, true), some_solution(n, false)};
  r.light_of_photograph = {0, 1, 0};
  for (int k = 0; k < 3; ++k) {
    optimize::OwnLight own{n.next(), n.next(), n.next(), n.next(), k == 1, k == 2};
    r.own_lights.push_back(own);
  }
  r.spread[optimize::kAmbient] = n.next();
  r.spread[optimize::kExposure] = n.next();
  for (Eigen::Index i = 0; i < 3; ++i) r.pattern.flash_shift[i] = n.next();
  r.strangers = {false, true, false};
  r.proxy_surfels = 101;
  r.proxy_seen = 57;
  r.back_share = n.next();
  r.outer_iterations = 9;
  r.last_change = n.next();
  r.sky_model = "sh2 coloured + floor";
  r.sky_evidence = {{"uniform", 1, 0}, {"sh1", 4, -n.next()}};
  r.gloss_evidence = -n.next();
  r.errors = {{n.next(), n.next(), n.next(), n.next(), n.next(), true}, {}};
  r.notes = {"one", "two"};
  for (const bool of_lens : {true, false}) {
    r.pattern.falloff = {};
    if (of_lens) {
      r.pattern.falloff.lens = {-n.next(), n.next()};
    } else {
      for (Eigen::Index i = 0; i < 4; ++i) r.pattern.falloff.flash[i] = -n.next();
      r.pattern.falloff.flash_corner_sine = n.next();
    }
    for (Eigen::Index i = 0; i < 16; ++i) r.pattern.falloff.covariance.data()[i] = n.next();
    r.pattern.falloff.covariance = Eigen::Matrix4d(r.pattern.falloff.covariance + r.pattern.falloff.covariance.transpose());
    const optimize::AcquisitionResult back = lights_from_json(nlohmann::ordered_json::parse(light_json(r).dump()));
    ASSERT_EQ(back.lights.size(), 2u);
    for (std::size_t k = 0; k < 2; ++k) expect_same(back.lights[k], r.lights[k]);
    EXPECT_EQ(back.light_of_photograph, r.light_of_photograph);
    ASSERT_EQ(back.own_lights.size(), 3u);
    for (std::size_t k = 0; k < 3; ++k) {
      EXPECT_EQ(back.own_lights[k].ambient, r.own_lights[k].ambient);
      EXPECT_EQ(back.own_lights[k].exposure, r.own_lights[k].exposure);
      EXPECT_EQ(back.own_lights[k].ambient_ln_sd, r.own_lights[k].ambient_ln_sd);
      EXPECT_EQ(back.own_lights[k].exposure_ln_sd, r.own_lights[k].exposure_ln_sd);
      EXPECT_EQ(back.own_lights[k].unlike, r.own_lights[k].unlike);
      EXPECT_EQ(back.own_lights[k].unlike_ambient, r.own_lights[k].unlike_ambient);
    }
    EXPECT_EQ(back.spread, r.spread);
    EXPECT_EQ(back.pattern.flash_shift, r.pattern.flash_shift);
    EXPECT_EQ(back.pattern.falloff.lens, r.pattern.falloff.lens);
    EXPECT_EQ(back.pattern.falloff.flash, r.pattern.falloff.flash);
    EXPECT_EQ(back.pattern.falloff.flash_corner_sine, r.pattern.falloff.flash_corner_sine);
    EXPECT_EQ(back.pattern.falloff.covariance, r.pattern.falloff.covariance);
    EXPECT_EQ(back.strangers, r.strangers);
    EXPECT_EQ(back.proxy_surfels, r.proxy_surfels);
    EXPECT_EQ(back.proxy_seen, r.proxy_seen);
    EXPECT_EQ(back.back_share, r.back_share);
    EXPECT_EQ(back.outer_iterations, r.outer_iterations);
    EXPECT_EQ(back.last_change, r.last_change);
    EXPECT_EQ(back.sky_model, r.sky_model);
    ASSERT_EQ(back.sky_evidence.size(), 2u);
    EXPECT_EQ(back.sky_evidence[1].model, "sh1");
    EXPECT_EQ(back.sky_evidence[1].parameters, 4);
    EXPECT_EQ(back.sky_evidence[1].criterion, r.sky_evidence[1].criterion);
    EXPECT_EQ(back.gloss_evidence, r.gloss_evidence);
    ASSERT_EQ(back.errors.size(), 2u);
    EXPECT_EQ(back.errors[0].normal_rad, r.errors[0].normal_rad);
    EXPECT_EQ(back.errors[0].registration_px, r.errors[0].registration_px);
    EXPECT_EQ(back.errors[0].other_light, r.errors[0].other_light);
    EXPECT_EQ(back.errors[0].spread, r.errors[0].spread);
    EXPECT_EQ(back.errors[0].rest, r.errors[0].rest);
    EXPECT_TRUE(back.errors[0].estimated);
    EXPECT_FALSE(back.errors[1].estimated);
    EXPECT_EQ(back.notes, r.notes);
  }
}

TEST(LightRecord, OfNoneIsNone) {
  const optimize::AcquisitionResult back = lights_from_json(light_json({}));
  EXPECT_TRUE(back.lights.empty());
  EXPECT_FALSE(back.gloss_evidence);
  EXPECT_TRUE(back.pattern.falloff.none());
  EXPECT_TRUE(back.pattern.flash_shift.isZero());
}

TEST(LightRecord, SaysWhatIsLeftInTheCorners) {
  optimize::Falloff f;
  f.lens = {-0.2, -0.1};
  EXPECT_EQ(falloff_json(f).at("of"), "lens");
  EXPECT_NEAR(falloff_json(f).at("kept_in_corners").get<double>(), std::exp(-0.3), 1e-12);
}

}  // namespace
}  // namespace chiaro::tools
