#include "optimize/observe.h"

#include <gtest/gtest.h>

#include <cmath>
#include <numbers>

#include "stream/base/error.h"
#include "stream/base/parallel.h"
#include "tests/optimize/lit.h"
#include "tests/optimize/pictured_ground.h"

namespace chiaro::optimize {
namespace {

using tests::even;
using tests::Lit;
using tests::PicturedGround;

constexpr double kPi = std::numbers::pi;
constexpr int kWide = 60, kHigh = 44;
constexpr double kFootprint = 0.025;   // 1.5 m / 60 px
constexpr double kReach = 0.8 * 0.06 / kFootprint;   // of a surfel's mean, pixels: four fifths of its radius

struct Ground : PicturedGround {
  Ground() : PicturedGround(60, kWide, kHigh) { planes["footprint"] = even(kFootprint); }
  Observation observed() const {
    write();
    return observe(scene.proxy, photo);
  }
  /// The surfel nearest to what the camera looks at.
  std::size_t middle() const {
    std::size_t best = 0;
    for (std::size_t i = 1; i < scene.proxy.size(); ++i)
      if ((in_world(i) - eye).head<2>().norm() < (in_world(best) - eye).head<2>().norm()) best = i;
    return best;
  }
};

/// Sums over the pixels around a place, weighted by how near they are: a cone that ends half a pixel beyond the reach.
struct Around {
  double weight = 0, squares = 0, mean = 0, scatter = 0;
};

template <class Value>
Around around(const Vec2d& at, const Value& value) {
  Around a;
  double second = 0;
  for (int y = 0; y < kHigh; ++y)
    for (int x = 0; x < kWide; ++x) {
      const double w = 1 - (Vec2d(x + 0.5, y + 0.5) - at).norm() / (kReach + 0.5);
      if (w <= 0) continue;
      a.weight += w;
      a.squares += w * w;
      a.mean += w * value(x, y);
      second += w * value(x, y) * value(x, y);
    }
  a.mean /= a.weight;
  a.scatter = second / a.weight - a.mean * a.mean;
  return a;
}

TEST(Observe, IsTheMeanOverThePixelsThatASurfelCovers) {
  Ground s;
  const auto ramp = [](int x, int y) { return 0.2 + 0.004 * x - 0.002 * y; };
  s.planes["r"] = s.planes["g"] = s.planes["b"] = [&](int x, int y) { return static_cast<float>(ramp(x, y)); };
  s.planes["flash"] = [&](int x, int y) { return static_cast<float>(2 * ramp(x, y)); };
  const Observation o = s.observed();
  int seen = 0;
  for (std::size_t i = 0; i < s.scene.proxy.size(); ++i) {
    const Vec2d at = s.in_picture(i);
    const bool inside = at.x() >= 0 && at.y() >= 0 && at.x() < kWide && at.y() < kHigh;
    ASSERT_EQ(o.seen[i] != 0, inside) << at.transpose();
    if (!inside) continue;
    ++seen;
    const double mean = around(at, ramp).mean;
    for (std::size_t c = 0; c < 3; ++c) ASSERT_NEAR(o.radiosity[3 * i + c], kPi * mean, 1e-5) << at.transpose();
    ASSERT_NEAR(o.flash[i], 2 * mean, 1e-5);
    // Far from the borders that is the value where the surfel lies.
    if (at.x() > 4 && at.y() > 4 && at.x() < kWide - 4 && at.y() < kHigh - 4) ASSERT_NEAR(mean, 0.2 + 0.004 * (at.x() - 0.5) - 0.002 * (at.y() - 0.5), 3e-4);
  }
  EXPECT_GT(seen, 100);
}

TEST(Observe, VarianceIsThatOfTheMeanAndOfWhatAShiftOfTheCameraDoes) {
  Ground s;
  s.photo.noise = {3e-4, 2e-3};
  const auto ramp = [](int x, int) { return 0.2 + 0.004 * x; };
  s.planes["r"] = s.planes["g"] = s.planes["b"] = [&](int x, int y) { return static_cast<float>(ramp(x, y)); };
  const std::size_t i = s.middle();
  const Around a = around(s.in_picture(i), ramp);
  Observation o = s.observed();
  const double noise = (3e-4 * a.mean + 4e-6) * a.squares / (a.weight * a.weight) / (a.mean * a.mean), shift = 0.3 / kReach;
  EXPECT_NEAR(o.noise[i] / noise, 1, 1e-4);
  EXPECT_NEAR(o.variance[i] / (noise + a.scatter * shift * shift / (a.mean * a.mean)), 1, 1e-3);
  // The lens's blur by its standard deviation, a quarter of the disc's diameter.
  s.photo.camera.focus = {0.02, 1.0};
  const double blur = 0.02 * 60 * std::fabs(1 / 1.0 - 1 / s.depth_along_axis(s.in_world(i))), blurred = std::hypot(0.3, blur / 4) / kReach;
  o = s.observed();
  EXPECT_NEAR(o.variance[i] / (noise + a.scatter * blurred * blurred / (a.mean * a.mean)), 1, 1e-3);
}

// The channels have one albedo's error each: their mean counts.
TEST(Observe, VarianceIsTheMeanOfTheChannels) {
  Ground s;
  s.photo.noise = {0, 2e-3};
  s.planes["r"] = even(0.1);
  s.planes["b"] = even(0.4);
  const std::size_t i = s.middle();
  const Around a = around(s.in_picture(i), [](int, int) { return 1.0; });
  const Observation o = s.observed();
  const double expected = 4e-6 * a.squares / (a.weight * a.weight) * (1 / 0.01 + 1 / 0.04 + 1 / 0.16) / 3;
  EXPECT_NEAR(o.noise[i] / expected, 1, 1e-4);
  EXPECT_NEAR(o.variance[i] / expected, 1, 1e-4);
}

TEST(Observe, SpreadIsThatInsideThePixelsAndBetweenThem) {
  Ground s;
  s.planes["flash"] = even(0.5);
  s.planes["spread"] = even(0.3);
  const std::size_t i = s.middle();
  EXPECT_NEAR(s.observed().spread[i], 0.3, 1e-4);
  s.planes["spread"] = even(0);
  EXPECT_NEAR(s.observed().spread[i], 0, 1e-3);
  const auto stripes = [](int x, int) { return x % 2 ? 0.6 : 0.4; };
  s.planes["flash"] = [&](int x, int y) { return static_cast<float>(stripes(x, y)); };
  const Around a = around(s.in_picture(i), stripes);
  EXPECT_NEAR(s.observed().spread[i], std::sqrt(a.scatter) / a.mean, 1e-4);
}

TEST(Observe, GradientIsWhatNoiseDoesNotMake) {
  Ground s;
  s.planes["g"] = [](int x, int y) { return static_cast<float>(0.2 + 0.004 * x - 0.003 * y); };
  const std::size_t i = s.middle();
  const Vec2d at = s.in_picture(i);
  const double value = 0.2 + 0.004 * std::floor(at.x()) - 0.003 * std::floor(at.y());
  EXPECT_NEAR(s.observed().gradient[i], 0.005 / value, 1e-5);
  // Of two differences that share a pixel the larger one, squared, along two axes: 6.2 times the variance.
  s.photo.noise = {0, 1.2e-3};
  EXPECT_NEAR(s.observed().gradient[i], std::sqrt(0.005 * 0.005 - 6.2 * 1.44e-6) / value, 1e-5);
  s.photo.noise = {0, 0.1};
  EXPECT_EQ(s.observed().gradient[i], 0);
  // A neighbour of no value says nothing: the other one does.
  s.photo.noise = {};
  s.planes["mask"] = [=](int x, int) { return x == static_cast<int>(at.x()) + 1 ? 3.0f : 1.0f; };
  s.planes["g"] = [=](int x, int y) { return x == static_cast<int>(at.x()) + 1 ? 9.0f : static_cast<float>(0.2 + 0.004 * x - 0.003 * y); };
  EXPECT_NEAR(s.observed().gradient[i], 0.005 / value, 1e-5);
}

TEST(Observe, GradientIsOfTheBrightestChannel) {
  Ground s;
  s.photo.noise = {0, 1e-3};
  const std::size_t i = s.middle();
  const Vec2d at = s.in_picture(i);
  s.planes["r"] = [](int x, int y) { return static_cast<float>(0.2 + 0.004 * x - 0.003 * y); };
  s.planes["g"] = [](int x, int y) { return (x + y) % 2 ? 0.002f : 0.0003f; };   // red paint: nothing but noise
  s.planes["b"] = even(0.001);
  const double value = 0.2 + 0.004 * std::floor(at.x()) - 0.003 * std::floor(at.y());
  EXPECT_NEAR(s.observed().gradient[i], std::sqrt(0.005 * 0.005 - 6.2e-6) / value, 1e-5);
  // What is darker than its noise changes beside that, and not beside nothing.
  s.planes["r"] = s.planes["g"] = s.planes["b"] = [](int x, int y) { return (x + y) % 2 ? 0.004f : 1e-7f; };
  EXPECT_LT(s.observed().gradient[i], std::sqrt(2 * 0.004 * 0.004 - 6.2e-6) / 1e-3 * 1.001);
}

TEST(Observe, TakesNoPixelOfAnotherSurfaceOrOfNoValue) {
  Ground s;
  const std::size_t i = s.middle();
  const int column = static_cast<int>(s.in_picture(i).x());
  s.planes["r"] = s.planes["g"] = s.planes["b"] = [=](int x, int) { return x > column ? 0.8f : 0.2f; };
  ASSERT_GT(s.observed().radiosity[3 * i], 0.25 * kPi);
  const auto beside = [=](float there, float else_) -> tests::Plane { return [=](int x, int) { return x > column ? there : else_; }; };
  for (const auto& [plane, there, usual] : {std::tuple{"mask", 3.0f, 1.0f}, std::tuple{"mask", 0.0f, 1.0f}, std::tuple{"coverage", 0.9f, 1.0f}, std::tuple{"shadow", 0.6f, 0.4f}, std::tuple{"nx", 2.0f, 0.0f}, std::tuple{"nz", -1.0f, 1.0f}, std::tuple{"depth", 0.0f, 1.0f}, std::tuple{"depth", 0.9f, 1.0f}}) {
    const tests::Plane before = s.planes[plane];
    if (std::string(plane) == "depth") {
      s.planes[plane] = [=](int x, int y) { return before(x, y) * (x > column ? there : usual); };
    } else {
      s.planes[plane] = beside(there, usual);
    }
    if (std::string(plane) == "nx") s.planes["nz"] = beside(0.1f, 1);
    const Observation o = s.observed();
    EXPECT_TRUE(o.seen[i]) << plane;
    EXPECT_NEAR(o.radiosity[3 * i], 0.2 * kPi, 1e-5) << plane << ' ' << there;
    s.planes[plane] = before;
    s.planes["nz"] = even(1);
  }
}

TEST(Observe, SeesNothingBesideEdgesFromTheSideOrBelowBlack) {
  Ground s;
  const std::size_t i = s.middle();
  const auto sees = [&] { return s.observed().seen[i] != 0; };
  EXPECT_TRUE(sees());
  s.planes["edge"] = even(1.4);
  EXPECT_FALSE(sees());
  s.planes["edge"] = even(1.6);
  EXPECT_TRUE(sees());
  s.photo.camera.focus = {0.02, 1.0};   // a disc of 0.4 px reaches 0.2 farther
  EXPECT_FALSE(sees());
  s.photo.camera.focus = {};
  s.planes["edge"] = even(20);
  s.planes["cosv"] = even(0.09);
  EXPECT_FALSE(sees());
  s.planes["cosv"] = even(0.11);
  EXPECT_TRUE(sees());
  s.planes["g"] = even(-0.01);
  EXPECT_FALSE(sees());
}

TEST(Observe, RefusesAGBufferOfAnotherSize) {
  Ground s;
  s.write();
  s.photo.gbuffer = s.folder.path() / "small.raster";
  tests::write_planes(s.photo.gbuffer, 8, 8, {"depth"}, s.planes);
  EXPECT_THROW(observe(s.scene.proxy, s.photo), Error);
}

TEST(Observe, IsTheSameForAnyThreadsAndFromDisk) {
  Ground s;
  s.planes["g"] = [](int x, int y) { return 0.2f + 0.01f * static_cast<float>((3 * x + 5 * y) % 7); };
  s.write();
  const auto bytes = [&](int threads) {
    const ThreadLimit limit(threads);
    write_observation(observe(s.scene.proxy, s.photo), s.folder.path() / "observation.bin");
    return read_text(s.folder.path() / "observation.bin");
  };
  EXPECT_EQ(bytes(1), bytes(8));
  Observation o = observe(s.scene.proxy, s.photo);
  o.tan_flash.assign(o.tan_flash.size(), 0.7f);
  write_observation(o, s.folder.path() / "observation.bin");
  const Observation back = read_observation(s.folder.path() / "observation.bin", s.scene.proxy.size());
  EXPECT_EQ(back.seen, o.seen);
  for (const auto member : {&Observation::radiosity, &Observation::flash, &Observation::spread, &Observation::variance, &Observation::noise, &Observation::gradient, &Observation::tan_flash}) EXPECT_EQ(back.*member, o.*member);
  Observation changed = o;
  changed.radiosity.assign(o.radiosity.size(), 0.25f);
  write_radiosity(changed, s.folder.path() / "observation.bin");
  const Observation again = read_observation(s.folder.path() / "observation.bin", s.scene.proxy.size());
  EXPECT_EQ(again.radiosity, changed.radiosity);
  EXPECT_EQ(again.seen, o.seen);
  EXPECT_EQ(again.tan_flash, o.tan_flash);
  EXPECT_THROW(read_observation(s.folder.path() / "observation.bin", s.scene.proxy.size() + 1), Error);
}

TEST(VisibilityVotes, SayWhichSideTheCameraSees) {
  Ground s;
  s.planes["cosv"] = even(0.8);
  s.write();
  const std::size_t i = s.middle();
  s.scene.proxy.normal[i] = -Vec3f::UnitZ();   // stored the wrong way round
  std::vector<float> votes = visibility_votes(s.scene.proxy, s.photo);
  EXPECT_FLOAT_EQ(votes[i], -0.8f);
  EXPECT_FLOAT_EQ(votes[i + 1], 0.8f);
  EXPECT_EQ(votes[0], 0) << "outside the picture";
  s.scene.proxy.normal[i] = Vec3f::UnitX();    // another surface
  s.scene.proxy.position[i + 1].z() += 0.3f;
  votes = visibility_votes(s.scene.proxy, s.photo);
  EXPECT_EQ(votes[i], 0);
  EXPECT_EQ(votes[i + 1], 0);
  s.planes["edge"] = even(0.9);
  s.write();
  EXPECT_EQ(visibility_votes(s.scene.proxy, s.photo)[i + 2], 0);
}

// A flash at height 1 over a floor, and a plate between it and the half x < 0; lengths in units of half a metre.
TEST(CastFlash, IsFalloffAndCosineAndShadow) {
  auto points = tests::square_points(40, 2.0, {0, 0, 0}, {0, 0, 1}, 1);
  const auto plate = tests::square_points(40, 1.0, {-0.5, 0, 0.5}, {0, 0, 1}, 2);
  points.insert(points.end(), plate.begin(), plate.end());
  Lit s(points, 4);
  s.proxy.metres_per_unit = 0.5;
  Observation o;
  o.seen.assign(s.proxy.size(), 0);
  o.flash.assign(s.proxy.size(), -1.0f);
  o.tan_flash.assign(s.proxy.size(), -1.0f);
  o.seen[7] = 1;
  const Vec3d flash(0, 0.1, 1);
  cast_flash(s.proxy, *s.tracer, flash, o);
  EXPECT_EQ(o.flash[7], -1) << "what a photograph measured stays";
  int lit = 0, shaded = 0;
  for (std::size_t i = 0; i < s.proxy.size(); ++i) {
    const Vec3d p = s.proxy.position[i].cast<double>() + s.proxy.origin_in_world, to = flash - p;
    const double tangent = to.head<2>().norm() / to.z();
    ASSERT_NEAR(o.tan_flash[i], tangent, 1e-3 * tangent + 1e-3);
    if (i == 7 || (p.z() < 0.25 && (std::fabs(p.x()) < 0.1 || std::fabs(p.y() - 0.1) > 0.7))) continue;   // beside the shadow's edge
    const double open = to.normalized().z() / (to.squaredNorm() * 0.25);
    const bool dark = p.z() < 0.25 && p.x() < 0;
    ASSERT_NEAR(o.flash[i], dark ? 0 : open, 1e-4 * open) << p.transpose();
    ++(dark ? shaded : lit);
  }
  EXPECT_GT(lit, 500);
  EXPECT_GT(shaded, 200);
  cast_flash(s.proxy, *s.tracer, {0, 0, -1}, o);   // from below
  EXPECT_EQ(o.flash[20], 0);
  EXPECT_EQ(o.tan_flash[20], 20) << "as good as never";
}

}  // namespace
}  // namespace chiaro::optimize
