#include "optimize/view_detail.h"

#include <gtest/gtest.h>

#include <cmath>
#include <filesystem>
#include <functional>

#include "stream/base/error.h"

namespace chiaro::optimize {
namespace {

constexpr int kSize = 200;
constexpr float kDepth = 2, kFocal = 400, kRadius = 0.02f;   // a pixel of a photograph is 5 mm wide on the plane z = 2, a disc 2 cm

stream::Lens lens_of(int size) {
  stream::Lens l;
  l.width_px = l.height_px = size;
  l.fx = l.fy = kFocal * static_cast<float>(size) / kSize;
  l.cx = l.cy = size / 2.0;
  return l;
}

/// Distance from the origin of the point of the plane that a pixel's middle shows.
float distance_at(int x, int y) {
  return kDepth * std::sqrt(1 + static_cast<float>(std::pow((x + 0.5 - kSize / 2.0) / kFocal, 2) + std::pow((y + 0.5 - kSize / 2.0) / kFocal, 2)));
}

class Sharpening : public testing::Test {
 protected:
  void SetUp() override {
    folder_ = std::filesystem::path(testing::TempDir()) / ("chiaro_sharpening_" + std::string(testing::UnitTest::GetInstance()->current_test_info()->name()));
    std::filesystem::create_directories(folder_);
  }
  void TearDown() override { std::filesystem::remove_all(folder_); }

  /// Of an even photograph: what its pixels are worth.
  struct Worth {
    float albedo = 0.4f, sigma = 0.02f, footprint = kDepth / kFocal, cosv = 1, edge = 20;
    double aperture = 0, focus = 1;
    float strength() const {
      const float blur = aperture > 0 ? static_cast<float>(aperture * kFocal * std::fabs(1 / focus - 1 / static_cast<double>(kDepth))) : 0.0f;
      return std::pow(cosv / footprint, 2.0f) / (1 + 0.75f * blur * blur) * std::min(1.0f, (edge - 0.5f * blur) / 8) / (sigma * sigma + 0.01f);
    }
  };
  DetailPhotograph photograph(const std::string& name, const Worth& w) const {
    DetailPhotograph p;
    p.camera.photograph = name;
    p.camera.lens = lens_of(kSize);
    p.camera.focus = {w.aperture, w.focus};
    p.albedo = folder_ / (name + "_albedo.raster");
    p.gbuffer = folder_ / (name + "_gbuffer.raster");
    write(p.albedo, {"r", "g", "b", "sigma"}, kSize, [&](const std::string& plane, int, int) { return plane == "sigma" ? w.sigma : w.albedo; });
    write(p.gbuffer, {"depth", "footprint", "cosv", "edge"}, kSize, [&](const std::string& plane, int x, int y) { return plane == "depth" ? distance_at(x, y) : plane == "footprint" ? w.footprint : plane == "cosv" ? w.cosv : w.edge; });
    return p;
  }
  /// Of the pixel in the middle.
  Vec3f seen_by(const std::vector<DetailPhotograph>& photographs) const { return 0.4f * sharpening({lens_of(kSize), {}, {}}, rows_of(95, 10), photographs)[5 * kSize + 100]; }

  /// A photograph of the plane from the origin that shows `albedo(x, y)`; its depth is off by `off`.
  DetailPhotograph photograph(const std::string& name, const std::function<float(int, int)>& albedo, float off = 0, int size = kSize) const {
    DetailPhotograph p;
    p.camera.photograph = name;
    p.camera.lens = lens_of(kSize);
    p.albedo = folder_ / (name + "_albedo.raster");
    p.gbuffer = folder_ / (name + "_gbuffer.raster");
    write(p.albedo, {"r", "g", "b", "sigma"}, size, [&](const std::string& plane, int x, int y) { return plane == "sigma" ? 0.02f : albedo(x, y); });
    write(p.gbuffer, {"depth", "footprint", "cosv", "edge"}, size, [&](const std::string& plane, int x, int y) {
      return plane == "depth" ? distance_at(x, y) + off : plane == "footprint" ? kDepth / kFocal : plane == "cosv" ? 1.0f : 20.0f;
    });
    return p;
  }

  static void write(const std::filesystem::path& path, const std::vector<std::string>& planes, int size, const std::function<float(const std::string&, int, int)>& value) {
    std::vector<stream::PlaneInfo> infos;
    for (const std::string& name : planes) infos.push_back({name, stream::PlaneType::kF32});
    stream::RasterWriter out(path, size, size, infos);
    for (const std::string& name : planes) {
      std::vector<float> values;
      for (int y = 0; y < size; ++y)
        for (int x = 0; x < size; ++x) values.push_back(value(name, x, y));
      out.write_rows<float>(name, 0, values);
    }
    out.commit();
  }

  /// Rows of the view from the same place, where the points all show an albedo of 0.4.
  static ViewRows rows_of(int y0, int rows) {
    ViewRows v{y0, rows, kSize, {}, {}, {}};
    for (int y = y0; y < y0 + rows; ++y)
      for (int x = 0; x < kSize; ++x) v.depth.push_back(distance_at(x, y));
    v.radius.assign(v.depth.size(), kRadius);
    v.albedo.assign(v.depth.size(), Vec3f::Constant(0.4f));
    return v;
  }

  std::filesystem::path folder_;
};

float stripes(int x, int) { return x / 4 % 2 == 0 ? 0.3f : 0.5f; }   // finer than the discs

TEST_F(Sharpening, ShowsWhatLiesBetweenThePoints) {
  const std::vector<DetailPhotograph> photographs{photograph("a", stripes)};
  const std::vector<Vec3f> factors = sharpening({lens_of(kSize), {}, {}}, rows_of(60, 70), photographs);
  for (int y = 0; y < 70; ++y)
    for (int x = 2; x < kSize - 2; ++x) {
      const Vec3f& f = factors[static_cast<std::size_t>(y * kSize + x)];
      ASSERT_NEAR(0.4f * f.x(), stripes(x, y), 0.005) << x << " " << y;
    }
}

// Waves of five pixels, seen by a camera half a pixel beside the photograph's: linear interpolation would leave 0.81 of them, a cubic one leaves 0.95.
TEST_F(Sharpening, KeepsFineDetailBetweenThePixels) {
  const auto wave = [](double x) { return static_cast<float>(0.4 + 0.1 * std::cos(2 * 3.14159265358979 * x / 5)); };
  const std::vector<DetailPhotograph> photographs{photograph("a", [&](int x, int) { return wave(x); })};
  DetailView view{lens_of(kSize), {}, {}};
  view.pose.translation_camera_from_world = Vec3d(-0.5 * kDepth / kFocal, 0, 0);
  const std::vector<Vec3f> factors = sharpening(view, rows_of(60, 20), photographs);
  for (int x = 20; x < kSize - 20; ++x) EXPECT_NEAR(0.4f * factors[static_cast<std::size_t>(10 * kSize + x)].x(), wave(x + 0.5), 0.007) << x;
}

// Where one of the pixels around has no value, or an edge is near, the next four are enough.
TEST_F(Sharpening, ReadsTheNextPixelsBesideHoles) {
  const std::vector<DetailPhotograph> photographs{photograph("a", [](int x, int) { return x == 100 ? std::nanf("") : 0.3f; })};
  DetailView view{lens_of(kSize), {}, {}};
  view.pose.translation_camera_from_world = Vec3d(-0.5 * kDepth / kFocal, 0, 0);
  const std::vector<Vec3f> factors = sharpening(view, rows_of(60, 20), photographs);
  for (const int x : {97, 98, 101, 102}) EXPECT_NEAR(0.4f * factors[static_cast<std::size_t>(10 * kSize + x)].x(), 0.3f, 0.005f) << x;
  for (const int x : {99, 100}) EXPECT_EQ(factors[static_cast<std::size_t>(10 * kSize + x)], Vec3f::Ones()) << x;
}

TEST_F(Sharpening, AViewCoarserThanThePhotographSeesTheMeanOfIts) {
  const std::vector<DetailPhotograph> photographs{photograph("a", [](int x, int y) { return (x + y) % 2 == 0 ? 0.2f : 0.6f; })};
  ViewRows rows{20, 8, kSize / 4, std::vector<float>(8 * kSize / 4, 0.0f), std::vector<float>(8 * kSize / 4, 0.05f), std::vector<Vec3f>(8 * kSize / 4, Vec3f::Constant(0.4f))};
  for (int y = 0; y < 8; ++y)
    for (int x = 0; x < kSize / 4; ++x) rows.depth[static_cast<std::size_t>(y * kSize / 4 + x)] = distance_at(4 * x + 1, 4 * (20 + y) + 1);
  const std::vector<Vec3f> factors = sharpening({lens_of(kSize / 4), {}, {}}, rows, photographs);
  for (int x = 2; x < kSize / 4 - 2; ++x) EXPECT_NEAR(0.4f * factors[static_cast<std::size_t>(3 * kSize / 4 + x)].x(), 0.4f, 0.02f) << x;
}

TEST_F(Sharpening, LeavesAloneWhatNoPhotographShows) {
  const std::vector<DetailPhotograph> photographs{photograph("elsewhere", stripes, 0.1f)};
  ViewRows rows = rows_of(90, 10);
  for (const Vec3f& f : sharpening({lens_of(kSize), {}, {}}, rows, photographs)) ASSERT_EQ(f, Vec3f::Ones());
  const std::vector<DetailPhotograph> here{photograph("here", stripes)};
  rows.depth[5 * kSize + 100] = 0;   // an edge of the view
  EXPECT_EQ(sharpening({lens_of(kSize), {}, {}}, rows, here)[5 * kSize + 100], Vec3f::Ones());
  EXPECT_NE(sharpening({lens_of(kSize), {}, {}}, rows, here)[5 * kSize + 101], Vec3f::Ones());
}

TEST_F(Sharpening, PrefersThePhotographLitFromTheSideOfTheView) {
  std::vector<DetailPhotograph> photographs{photograph("left", [](int, int) { return 0.35f; }), photograph("right", [](int, int) { return 0.45f; })};
  photographs[0].flash_in_world = Vec3d(-1, 0, 0);
  photographs[1].flash_in_world = Vec3d(1, 0, 0);
  const auto middle = [&](std::optional<Vec3d> flash) { return 0.4f * sharpening({lens_of(kSize), {}, flash}, rows_of(95, 10), photographs)[5 * kSize + 100].x(); };
  EXPECT_NEAR(middle(Vec3d(-1, 0, 0)), 0.35f, 0.005f);
  EXPECT_NEAR(middle(Vec3d(1, 0, 0)), 0.45f, 0.005f);
  EXPECT_NEAR(middle({}), 0.4f, 0.005f);
}

TEST_F(Sharpening, WhatDisagreesWithTheBlendedPointsCountsLittle) {
  const std::vector<DetailPhotograph> photographs{photograph("a", [](int, int) { return 0.4f; }), photograph("highlight", [](int, int) { return 1.6f; })};
  EXPECT_NEAR(0.4f * sharpening({lens_of(kSize), {}, {}}, rows_of(95, 10), photographs)[5 * kSize + 100].x(), 0.4f, 0.02f);
}

TEST_F(Sharpening, ReadsAPhotographAsBlendingCorrectedIt) {
  std::vector<DetailPhotograph> photographs{photograph("a", [](int x, int y) { return 1.3f * stripes(x - 3, y); })};   // brighter, and 3 pixels to the right
  photographs[0].gain = Vec3f::Constant(1 / 1.3f);
  photographs[0].shift_px = Vec2f(3, 0);
  const std::vector<Vec3f> factors = sharpening({lens_of(kSize), {}, {}}, rows_of(60, 70), photographs);
  for (int y = 0; y < 70; ++y)
    for (int x = 8; x < kSize - 8; ++x) ASSERT_NEAR(0.4f * factors[static_cast<std::size_t>(y * kSize + x)].x(), stripes(x, y), 0.005) << x << " " << y;
}

TEST_F(Sharpening, BelievesAPhotographOfLittleTrustLess) {
  std::vector<DetailPhotograph> photographs{photograph("a", [](int, int) { return 0.35f; }), photograph("b", [](int, int) { return 0.45f; })};
  photographs[1].trust = 0.01f;
  EXPECT_NEAR(0.4f * sharpening({lens_of(kSize), {}, {}}, rows_of(95, 10), photographs)[5 * kSize + 100].x(), 0.35f, 0.005f);
}

TEST_F(Sharpening, RefusesRastersOfAnotherSize) {
  const std::vector<DetailPhotograph> photographs{photograph("a", stripes, 0, kSize / 2)};
  EXPECT_THROW(sharpening({lens_of(kSize), {}, {}}, rows_of(60, 70), photographs), Error);
}

// By hand: (cos / footprint)^2, in focus, away from edges, over sigma^2 + 0.1^2, by agreement with the points (0.4); beside them the points themselves with 0.1 / (0.02^2 (0.05^2 + 0.1^2)).
TEST_F(Sharpening, WeighsPhotographsByWhatTheyAreWorth) {
  const Worth plain{.albedo = 0.36f};
  int number = 0;
  for (const Worth& other : {Worth{.albedo = 0.44f}, Worth{.albedo = 0.44f, .sigma = 0.2f}, Worth{.albedo = 0.44f, .footprint = 0.01f}, Worth{.albedo = 0.44f, .cosv = 0.5f}, Worth{.albedo = 0.44f, .edge = 3}, Worth{.albedo = 0.44f, .aperture = 0.01}}) {
    const std::string name = std::to_string(number++);
    float weight = 0, sum = 0;
    for (const Worth& w : {plain, other}) {
      const float off = std::log(w.albedo / 0.4f) / 0.4f, doubt = 1 + off * off, strength = w.strength() / (doubt * doubt);
      weight += strength;
      sum += strength * w.albedo;
    }
    const float points = 0.1f / (kRadius * kRadius * 0.0125f);
    EXPECT_NEAR(seen_by({photograph("plain" + name, plain), photograph("other" + name, other)}).x(), (sum + points * 0.4f) / (weight + points), 2e-4) << name;
  }
}

TEST_F(Sharpening, TakesNothingFromPhotographsThatShowLessOrFromBesideEdges) {
  const auto helps = [&](const char* name, const Worth& w) { return seen_by({photograph(name, w)}) != Vec3f(0.4f * Vec3f::Ones()); };
  EXPECT_FALSE(helps("coarse", {.albedo = 0.36f, .footprint = 1.05f * kRadius}));
  EXPECT_TRUE(helps("fine", {.albedo = 0.36f, .footprint = 0.95f * kRadius}));
  EXPECT_FALSE(helps("edge", {.albedo = 0.36f, .edge = 0.9f}));
  EXPECT_TRUE(helps("beside", {.albedo = 0.36f, .edge = 1.5f}));
  EXPECT_FALSE(helps("blurred", {.albedo = 0.36f, .edge = 1.5f, .aperture = 0.01})) << "a disc of 2 px reaches one farther";
}

// Four by four of its pixels in one of the view count as one.
TEST_F(Sharpening, AFinePhotographCountsNoMoreThanItIsWorth) {
  const std::vector<DetailPhotograph> photographs{photograph("a", Worth{.albedo = 0.36f})};
  ViewRows rows{20, 8, kSize / 4, std::vector<float>(8 * kSize / 4, 0.0f), std::vector<float>(8 * kSize / 4, kRadius), std::vector<Vec3f>(8 * kSize / 4, Vec3f::Constant(0.4f))};
  for (int y = 0; y < 8; ++y)
    for (int x = 0; x < kSize / 4; ++x) rows.depth[static_cast<std::size_t>(y * kSize / 4 + x)] = distance_at(4 * x + 1, 4 * (20 + y) + 1);
  const float off = std::log(0.9f) / 0.4f, doubt = 1 + off * off, strength = Worth{}.strength() / (doubt * doubt), points = 0.1f / (kRadius * kRadius * 0.0125f);
  EXPECT_NEAR(0.4f * sharpening({lens_of(kSize / 4), {}, {}}, rows, photographs)[static_cast<std::size_t>(3 * kSize / 4 + 25)].x(), (strength * 0.36f + points * 0.4f) / (strength + points), 2e-4);
}

TEST_F(Sharpening, CorrectsEachChannelByItsOwnGain) {
  std::vector<DetailPhotograph> photographs{photograph("a", Worth{})};
  photographs[0].gain = Vec3f(1.1f, 1, 0.9f);
  const Vec3f seen = seen_by(photographs);
  EXPECT_NEAR(seen.x() / seen.y(), 1.1, 0.01);
  EXPECT_NEAR(seen.z() / seen.y(), 0.9, 0.01);
}

}  // namespace
}  // namespace chiaro::optimize
