#include "optimize/light_samples.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <numeric>

#include "stream/base/rng.h"
#include "tests/optimize/pictured_ground.h"

namespace chiaro::optimize {
namespace {

std::size_t readings(const std::vector<std::uint16_t>& times_seen, const std::vector<std::uint32_t>& chosen) {
  return std::accumulate(chosen.begin(), chosen.end(), std::size_t{0}, [&](std::size_t sum, std::uint32_t i) { return sum + times_seen[i]; });
}

TEST(ChooseSurfels, TakesThoseSeenOftenEnoughAndNoMoreThanAskedFor) {
  std::vector<std::uint16_t> times_seen(1000);
  for (std::size_t i = 0; i < times_seen.size(); ++i) times_seen[i] = static_cast<std::uint16_t>(i % 4);
  const auto chosen = choose_surfels(times_seen, 2, 300, 1);
  EXPECT_EQ(chosen.size(), 300u);
  EXPECT_TRUE(std::is_sorted(chosen.begin(), chosen.end()));
  for (const std::uint32_t i : chosen) EXPECT_GE(times_seen[i], 2);
  EXPECT_EQ(choose_surfels(times_seen, 2, 3000, 1).size(), 500u);
}

// A thousand photographs that each see a quarter of everything: memory must not follow them.
TEST(ChooseSurfels, TakesFewerWhereEachIsSeenByHundreds) {
  const std::vector<std::uint16_t> times_seen(20000, 250);
  const auto all = choose_surfels(times_seen, 2, 20000, 1), few = choose_surfels(times_seen, 2, 20000, 1, 400000);
  EXPECT_EQ(readings(times_seen, all), 5000000u);
  EXPECT_EQ(readings(times_seen, few), 400000u);
  EXPECT_TRUE(std::includes(all.begin(), all.end(), few.begin(), few.end()));
  EXPECT_EQ(choose_surfels(times_seen, 2, 20000, 1, 10).size(), 1u);
}

TEST(UnknownShare, CountsTheLightOfSurfacesThatNoPhotographShows) {
  Transport transport;
  transport.rays = 4;
  transport.sky.assign(3 * kSkyTerms, 0.0f);
  transport.hits = {1, 2, Transport::kSky, 2, 0, 0, 0, 0, Transport::kSky, Transport::kSky, Transport::kSky, Transport::kSky};
  const std::vector<float> radiosity{1, 1, 1, 2, 1, 0, 0.5f, 0.5f, 0};   // sums 3, 3, 1
  const std::vector<std::uint16_t> times_seen{2, 1, 0};
  Stencil stencil;   // surfel 0 meets surfel 1 and twice 2; surfel 1 meets 0 alone
  stencil.weight[0] = 0.5f;
  stencil.index[1] = 1;
  stencil.weight[1] = 0.5f;
  EXPECT_NEAR(unknown_share(transport, stencil, radiosity, times_seen), 2.0 / (3 + 2 + 12), 1e-6);
  stencil.index.fill(2);   // and 2 nothing
  EXPECT_EQ(unknown_share(transport, stencil, radiosity, times_seen), 0);
}

TEST(Thinned, KeepsWholeGroupsFromEverywhere) {
  std::vector<LightSample> samples;
  for (std::uint32_t group = 0; group < 900; ++group)
    for (std::uint32_t k = 0; k < 2 + group % 3; ++k) {
      samples.emplace_back();
      samples.back().group = 7 * group;
      samples.back().photograph = k;
    }
  const std::vector<LightSample> some = thinned(samples, 300);
  std::vector<std::uint32_t> groups;
  for (std::size_t i = 0; i < some.size(); ++i)
    if (i == 0 || some[i].group != some[i - 1].group) {
      groups.push_back(some[i].group / 7);
      EXPECT_EQ(some[i].photograph, 0u);
      EXPECT_TRUE(i == 0 || some[i - 1].photograph == 1 + (some[i - 1].group / 7) % 3);
    }
  EXPECT_EQ(groups.size(), 300u);
  EXPECT_GT(groups.back(), 890u);
  EXPECT_EQ(thinned(samples, 900).size(), samples.size());
  EXPECT_EQ(thinned(samples, 5000).size(), samples.size());
  EXPECT_TRUE(thinned({}, 10).empty());
}

/// A target on the pixels 20 to 30 and 10 to 18 of a picture of the ground, under a flash.
struct Target : tests::PicturedGround {
  Target() : PicturedGround(60, 60, 44) {
    input.photographs = {photo, photo};
    target.photograph = 1;
    target.polygon = {{20, 10}, {30, 10}, {30, 18}, {20, 18}};
    target.albedo = {0.5, 0.45, 0.4};
    input.photographs[1].flash_in_camera = Vec3d(0.2, -0.1, 0.05);
    planes["flash"] = [](int x, int y) { return x >= 20 && x < 30 && y >= 10 && y < 18 ? 0.4f : 5.0f; };
    for (std::size_t i = 0; i < scene.proxy.size(); ++i)
      for (std::size_t k = 0; k < kSkyTerms; ++k) scene.transport.sky.push_back(0.5f * static_cast<float>(k + 1));
    for (const float t : scene.transport.sky) scene.transport.hidden.push_back(0.1f * t);
  }
  std::optional<ReferenceReading> read() {
    write();
    return read_reference(scene, input, target);
  }
  AcquisitionInput input;
  ReferenceTarget target;
};

TEST(ReadReference, IsTheMeanOverTheTargetsPixels) {
  Target s;
  s.planes["r"] = [](int x, int y) { return x >= 20 && x < 30 && y >= 10 && y < 18 ? 0.3f : 9.0f; };
  s.planes["g"] = [](int x, int y) { return x >= 20 && x < 30 && y >= 10 && y < 18 ? 0.2f : 9.0f; };
  s.planes["b"] = [](int x, int y) { return x >= 20 && x < 30 && y >= 10 && y < 18 ? 0.1f : 9.0f; };
  s.input.photographs[1].noise = {2e-4, 1e-3};
  s.input.photographs[1].ambient_scale = 0.7;
  s.scene.floor = Floor{};
  const auto r = s.read();
  ASSERT_TRUE(r);
  const LightSample& sample = r->reference.sample;
  EXPECT_EQ(r->photograph, 1u);
  EXPECT_EQ(sample.photograph, 1u);
  EXPECT_EQ(r->reference.albedo, s.target.albedo);
  for (std::size_t c = 0; c < 3; ++c) EXPECT_NEAR(sample.radiosity[c], 3.14159265 * (0.3 - 0.1 * static_cast<double>(c)), 1e-5);
  EXPECT_NEAR(sample.flash, 0.4, 1e-6);
  EXPECT_NEAR(sample.variance, (2e-4 * 0.2 + 1e-6) / (0.04 * 80), 1e-9) << "of the mean of 80 pixels";
  for (std::size_t k = 0; k < kSkyTerms; ++k) {
    EXPECT_NEAR(sample.sky[k], 0.7 * 0.5 * static_cast<double>(k + 1), 1e-5);
    EXPECT_NEAR(sample.hidden[k], 0.7 * 0.05 * static_cast<double>(k + 1), 1e-5);
  }
  // Where it lies: in the middle of the places that its pixels show.
  Vec3d middle = Vec3d::Zero();
  for (int y = 10; y < 18; ++y)
    for (int x = 20; x < 30; ++x) middle += s.place(x, y) / 80;
  const Vec3d place = r->place.cast<double>() + s.scene.proxy.origin_in_world;
  EXPECT_NEAR((place - middle).norm(), 0, 1e-4);
  const Vec3d to_flash = s.photo.camera.pose.world_from_camera({0.2, -0.1, 0.05}) - middle;
  EXPECT_NEAR(sample.tan_flash, to_flash.head<2>().norm() / to_flash.z(), 1e-3);
}

TEST(ReadReference, IsAsUncertainAsItsPixelsAreUnevenBesideTheirNoise) {
  Target s;
  s.target.sigma = 0.02;
  const auto sigma = [&] { return s.read()->reference.sigma; };
  EXPECT_NEAR(sigma(), std::hypot(0.02, 0.003), 1e-5) << "even";
  s.planes["g"] = [](int x, int) { return x % 2 ? 0.22f : 0.18f; };   // 10 % of scatter
  EXPECT_NEAR(sigma(), std::hypot(0.02, 0.003, 0.5 * 0.1), 1e-4);
  s.input.photographs[1].noise = {0, 0.02};
  EXPECT_NEAR(sigma(), std::hypot(0.02, 0.003), 1e-4) << "noise explains it";
  s.input.photographs[1].noise = {1e-3, 0};   // variance 2e-4 of 4e-4
  EXPECT_NEAR(sigma(), std::hypot(0.02, 0.003, 0.5 * std::sqrt(2e-4) / 0.2), 1e-4);
}

TEST(ReadReference, ItsNormalIsOffByWhatItsPixelsScatterBy) {
  Target s;
  const auto tilted = [&](double angle) {   // half of the pixels to one side, half to the other
    s.planes["nx"] = [=](int x, int) { return static_cast<float>(std::sin(x % 2 ? angle : -angle)); };
    s.planes["nz"] = tests::even(std::cos(angle));
    return s.read()->reference.normal_rad;
  };
  EXPECT_NEAR(tilted(0.014), 0.014 / std::sqrt(2.0), 2e-4) << "along one of two directions";
  EXPECT_EQ(tilted(0.001), 0.005) << "no target is flatter";
  EXPECT_EQ(tilted(0.3), 0.0175) << "no worse than any other surface";
}

TEST(ReadReference, CountsUsablePixelsInsideItsOutlineAlone) {
  Target s;
  for (const char* plane : {"r", "g", "b"}) s.planes[plane] = [](int x, int y) { return x - 20 >= 2 * (y - 10) ? 0.2f : 0.7f; };
  s.target.polygon = {{20, 10}, {36, 10}, {36, 18}};   // below its slope lies something else
  EXPECT_NEAR(s.read()->reference.sample.radiosity[1], 3.14159265 * 0.2, 0.01);
  Target masked;
  masked.planes["mask"] = [](int x, int) { return x < 25 ? 1.0f : 3.0f; };
  for (const char* plane : {"r", "g", "b"}) masked.planes[plane] = [](int x, int) { return x < 25 ? 0.2f : 0.7f; };
  EXPECT_NEAR(masked.read()->reference.sample.radiosity[1], 3.14159265 * 0.2, 1e-5);
  masked.planes["mask"] = tests::even(0);
  EXPECT_FALSE(masked.read());
  Target between;   // corners inside pixels: those whose middles it holds count
  between.target.polygon = {{20.6, 10.6}, {29.4, 10.6}, {29.4, 17.4}, {20.6, 17.4}};
  for (const char* plane : {"r", "g", "b"}) between.planes[plane] = [](int x, int y) { return x >= 21 && x < 29 && y >= 11 && y < 17 ? 0.2f : 0.9f; };
  EXPECT_NEAR(between.read()->reference.sample.radiosity[1], 3.14159265 * 0.2, 1e-5);
  masked.target.polygon = {{70, 10}, {80, 10}, {80, 20}};
  EXPECT_FALSE(masked.read()) << "beside the picture";
}

TEST(SampleOf, HoldsWhatBelongsToTheSurfel) {
  Transport transport;
  Observation o;
  std::vector<float> gathered;
  constexpr std::size_t kSurfels = 3, kAt = 1;
  const auto number = [](std::vector<float>& v, std::size_t count, float first) {
    for (std::size_t i = 0; i < count; ++i) v.push_back(first + static_cast<float>(i));
  };
  number(transport.sky, kSurfels * kSkyTerms, 100);
  number(transport.hidden, kSurfels * kSkyTerms, 200);
  number(gathered, 3 * kSurfels, 300);
  number(o.radiosity, 3 * kSurfels, 400);
  float first = 500;
  for (auto* v : {&o.flash, &o.spread, &o.variance, &o.noise, &o.gradient, &o.tan_flash, &o.floor_flash}) number(*v, kSurfels, first += 10);
  const LightSample s = sample_of(transport, o, gathered, kAt);
  for (std::size_t k = 0; k < kSkyTerms; ++k) {
    EXPECT_EQ(s.sky[k], 109 + static_cast<float>(k));
    EXPECT_EQ(s.hidden[k], 209 + static_cast<float>(k));
  }
  for (std::size_t c = 0; c < 3; ++c) {
    EXPECT_EQ(s.gathered[c], 303 + static_cast<float>(c));
    EXPECT_EQ(s.radiosity[c], 403 + static_cast<float>(c));
  }
  EXPECT_EQ(s.flash, 511);
  EXPECT_EQ(s.spread, 521);
  EXPECT_EQ(s.variance, 531);
  EXPECT_EQ(s.noise, 541);
  EXPECT_EQ(s.gradient, 551);
  EXPECT_EQ(s.tan_flash, 561);
  EXPECT_EQ(s.floor_flash, 571);
}

// Two paints of like brightness and unlike chroma, side by side: pairs across the border are few and hardly trusted.
TEST(ChoosePairs, AreOfSeenSurfelsOfLikeChroma) {
  tests::PicturedGround s;
  Observation o;
  const std::size_t n = s.scene.proxy.size();
  const auto left = [&](std::size_t i) { return s.in_world(i).x() < 0.001; };
  for (std::size_t i = 0; i < n; ++i) {
    o.seen.push_back(s.in_world(i).y() > -0.5);
    const float shade = 0.3f + 0.5f * uniform01(1, Purpose::kTest, i, 0);
    for (const float c : {left(i) ? 0.5f : 0.53f, 0.4f, 0.4f}) o.radiosity.push_back(c * shade);
  }
  const std::vector<Pair> pairs = choose_pairs(s.scene, o, 400, 1);
  const auto chroma = [](double red) -> Vec3d { return Vec3d(red, 0.4, 0.4) / (red + 0.8); };
  const double trust = std::exp(-0.5 * (chroma(0.5) - chroma(0.53)).squaredNorm() / (0.02 * 0.02));
  std::size_t across = 0, far = 0;
  for (const Pair& p : pairs) {
    ASSERT_NE(p.a, p.b);
    ASSERT_TRUE(o.seen[p.a] && o.seen[p.b]);
    ASSERT_NEAR(p.trust, left(p.a) == left(p.b) ? 1 : trust, 1e-3);
    across += left(p.a) != left(p.b);
    far += (s.in_world(p.a) - s.in_world(p.b)).norm() > 0.5;
  }
  EXPECT_GT(pairs.size(), 300u);
  EXPECT_GT(across, 20u);
  EXPECT_GT(far, pairs.size() / 4);
  for (std::size_t i = 0; i < n; ++i) o.radiosity[3 * i] *= left(i) ? 1.0f : 3.0f;
  for (const Pair& p : choose_pairs(s.scene, o, 400, 1)) ASSERT_EQ(left(p.a), left(p.b)) << "too unlike";
}

}  // namespace
}  // namespace chiaro::optimize
