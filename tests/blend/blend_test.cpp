#include "blend/blend.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <map>

#include "blend/accumulate.h"
#include "blend/ballot.h"
#include "blend/leaf_file.h"
#include "blend/photo_window.h"
#include "stream/base/error.h"
#include "stream/base/file.h"
#include "stream/base/parallel.h"
#include "stream/photo/raster.h"
#include "tests/blend/stopping_reporter.h"
#include "tests/blend/workplace.h"

namespace chiaro::blend {
namespace {

using namespace testing;

TEST(Blend, OnePhotographComesOutAsItWentIn) {
  const Workplace w(plane_scene());
  const BlendPhotograph photo = w.photograph("a", Vec3d(0.5, 0.5, 1), Vec3d(0.5, 0.5, 0));
  const BlendStats stats = w.run({photo});
  EXPECT_GT(stats.points_seen, stats.points / 2);
  EXPECT_EQ(stats.samples, stats.points_seen);
  const stream::RasterReader raster(photo.albedo);
  const auto red = raster.all<float>("r"), green = raster.all<float>("g");
  for (const Seen& s : w.result()) {
    const Vec3d inside = (s.position - Vec3d(0.5, 0.5, 0)).cwiseAbs();
    if (s.photos == 0 || inside.x() > 0.47 || inside.y() > 0.37) continue;   // beside borders fewer than four pixels are read
    const Vec2d at = *stream::project(photo.camera.lens, photo.camera.pose.camera_from_world(s.position)) - Vec2d(0.5, 0.5);
    const int x = static_cast<int>(std::floor(at.x())), y = static_cast<int>(std::floor(at.y()));
    const double fx = at.x() - x, fy = at.y() - y;
    const auto read = [&](const std::vector<float>& v) {
      const auto p = [&](int dx, int dy) { return v[static_cast<std::size_t>((y + dy) * 160 + x + dx)]; };
      return (1 - fy) * ((1 - fx) * p(0, 0) + fx * p(1, 0)) + fy * ((1 - fx) * p(0, 1) + fx * p(1, 1));
    };
    ASSERT_NEAR(s.albedo[0], read(red), 1e-5);
    ASSERT_NEAR(s.albedo[1], read(green), 1e-5);
    ASSERT_NEAR((s.albedo - smooth_paint(s.position)).cwiseAbs().maxCoeff(), 0, 1e-3);
    ASSERT_NEAR(s.sigma, 0.02f, 1e-5f);
    ASSERT_EQ(s.photos, 1);
  }
}

/// Paint with detail of every size.
AnalyticScene painted_plane() {
  AnalyticScene scene = plane_scene();
  scene.albedo = [](const Vec3d& p) -> Vec3f {
    const double detail = std::sin(200 * p.x()) * std::sin(170 * p.y()) + std::sin(60 * p.x() + 40 * p.y()) + std::sin(20 * p.y());
    return smooth_paint(p) + Vec3f::Constant(0.05f * static_cast<float>(detail));
  };
  return scene;
}

TEST(Blend, OnePhotographIsTheSameInAnyNumberOfBands) {
  const Workplace w(painted_plane());
  const BlendPhotograph photo = w.photograph("a", Vec3d(0.4, 0.5, 0.8), Vec3d(0.5, 0.5, 0));
  w.run({photo});
  const auto two = w.result();
  for (const int bands : {3, 4}) {
    BlendOptions options;
    options.bands = bands;
    w.run({photo}, options);
    const auto more = w.result();
    ASSERT_EQ(more.size(), two.size());
    std::size_t seen = 0;
    for (std::size_t i = 0; i < two.size(); ++i) {
      ASSERT_EQ(more[i].photos, two[i].photos);
      if (two[i].photos == 0) continue;
      ++seen;
      ASSERT_LE((more[i].albedo - two[i].albedo).cwiseAbs().maxCoeff(), 1e-6f) << bands;
    }
    EXPECT_GT(seen, 3000u);
  }
}

TEST(Blend, FurtherBandsHaveWeightsOfTheirOwn) {
  // One of two photographs is brighter by 10 %: all bands say something between the two, each by its own share.
  const Workplace w(plane_scene());
  const std::vector<BlendPhotograph> photos{w.photograph("a", Vec3d(0.3, 0.5, 0.7), Vec3d(0.3, 0.5, 0)), w.photograph("b", Vec3d(0.7, 0.5, 0.7), Vec3d(0.7, 0.5, 0), gained(1.1f))};
  std::vector<std::vector<float>> ratio;
  for (const int bands : {2, 3, 4}) {
    BlendOptions options;
    options.bands = bands;
    options.gain = Gain::kNone;
    options.reject = false;
    w.run(photos, options);
    ratio.emplace_back();
    for (const Seen& s : w.result()) ratio.back().push_back(s.photos == 2 ? s.albedo[1] / smooth_paint(s.position)[1] : 1);
  }
  double apart = 0;
  for (std::size_t i = 0; i < ratio[0].size(); ++i) {
    for (std::size_t b = 0; b < 3; ++b) ASSERT_TRUE(ratio[b][i] > 0.98f && ratio[b][i] < 1.12f);   // between what the two say
    apart = std::max(apart, static_cast<double>(std::abs(ratio[2][i] - ratio[0][i])));
  }
  EXPECT_GT(apart, 1e-4);   // bands are blended by weights of their own
}

TEST(Blend, AFactorIsAppliedToAllBands) {
  AnalyticScene detailed = plane_scene();
  detailed.albedo = [](const Vec3d& p) -> Vec3f { return smooth_paint(p) + Vec3f::Constant(0.1f * static_cast<float>(std::sin(110 * p.x()) * std::sin(105 * p.y()))); };
  const Workplace w(detailed);
  // The one that is off is nearer: it counts more the higher the band.
  const auto at = [&](const std::string& name, const Vec3d& eye, float gain) { return w.photograph(name, eye, Vec3d(0.5, 0.5, 0), gained(gain)); };
  const auto photographs = [&](float gain) { return std::vector{at("a", Vec3d(0.4, 0.5, 0.8), 1), at("b", Vec3d(0.5, 0.5, 0.8), 1), at("c", Vec3d(0.5, 0.5, 0.6), gain)}; };
  for (const int bands : {2, 3, 4}) {
    BlendOptions options;
    options.bands = bands;
    options.high_band_power = 4;
    w.run(photographs(1), options);
    const std::vector<Seen> alike = w.result();
    const BlendStats stats = w.run(photographs(1.3f), options);
    EXPECT_NEAR(stats.photographs[2].gain[0], 1 / 1.3, 0.005) << bands;
    const std::vector<Seen> found = w.result();
    double error = 0, seen = 0;
    for (std::size_t i = 0; i < found.size(); ++i)
      if (found[i].photos == 3 && alike[i].photos == 3) error += static_cast<double>((found[i].albedo.cwiseQuotient(alike[i].albedo).array() - 1).abs().maxCoeff()), ++seen;
    EXPECT_GT(seen, 2000) << bands;
    EXPECT_LT(error / seen, 0.005) << bands;
  }
}

TEST(Blend, WhatIsTrustedLessCountsLess) {
  const Workplace w(plane_scene());
  const auto shot = [&](const std::string& name, float gain) { return w.photograph(name, Vec3d(0.5, 0.5, 0.8), Vec3d(0.5, 0.5, 0), gained(gain)); };
  BlendOptions options;
  options.reject = false;
  options.known = Findings{{{1, 1, 1}, {1, 1, 1}}, {Alignment{}, Alignment{Vec2f::Zero(), 0.25f}}, 0.01, {}};
  w.run({shot("a", 1), shot("b", 1.5f)}, options);
  double factor = 0, seen = 0;
  for (const Seen& s : w.result())
    if (s.photos == 2) factor += static_cast<double>(s.albedo.cwiseQuotient(smooth_paint(s.position)).mean()), ++seen;
  EXPECT_NEAR(factor / seen, (1 + 0.25 * 1.5) / 1.25, 0.002);
}

TEST(Blend, ThreeBandsHaveTheSameBytesForAnyBudgetAndAfterStops) {
  const Workplace w(painted_plane());
  const std::vector<BlendPhotograph> photos{w.photograph("a", Vec3d(0.3, 0.5, 0.7), Vec3d(0.3, 0.5, 0)), w.photograph("b", Vec3d(0.7, 0.4, 0.5), Vec3d(0.7, 0.5, 0), gained(1.1f)),
                                            w.photograph("c", Vec3d(0.5, 0.9, 0.8), Vec3d(0.5, 0.5, 0), gained(0.95f))};
  BlendOptions options;
  options.bands = 3;
  w.run(photos);
  const auto two = w.bytes();
  w.run(photos, options);
  const auto expected = w.bytes();
  EXPECT_NE(expected, two);
  w.run(photos, options, 3 << 20);
  EXPECT_EQ(w.bytes(), expected);
  const int stops = stops_until_done(3, 9, [&](Reporter& report, int before) { w.run(photos, options, before % 2 == 0 ? kPlenty : 3 << 20, report); });
  ASSERT_LT(stops, 100);
  EXPECT_GE(stops, 3);
  EXPECT_EQ(w.bytes(), expected);
  options.low_band_px = 40;
  EXPECT_THROW(w.run(photos, options), std::invalid_argument);
  options = {};
  options.bands = 5;
  EXPECT_THROW(w.run(photos, options), std::invalid_argument);
}

TEST(Blend, TellsWhatDenoisingDidToSigma) {
  const Workplace w(plane_scene());
  const std::vector<BlendPhotograph> photos{w.photograph("a", Vec3d(0.4, 0.5, 0.7), Vec3d(0.5, 0.5, 0)), w.photograph("b", Vec3d(0.6, 0.5, 0.7), Vec3d(0.5, 0.5, 0))};
  EXPECT_FALSE(w.run(photos).denoising);
  double before = 0, after = 0;
  for (const Seen& s : w.result()) before += s.photos > 0 ? static_cast<double>(s.sigma) : 0;
  BlendOptions options;
  options.denoise = true;
  const BlendStats stats = w.run(photos, options);
  for (const Seen& s : w.result()) after += s.photos > 0 ? static_cast<double>(s.sigma) : 0;
  ASSERT_TRUE(stats.denoising);
  EXPECT_EQ(stats.denoising->points, stats.points_seen);
  EXPECT_GT(stats.denoising->points_changed, stats.points_seen / 2);
  EXPECT_LE(stats.denoising->points_changed, stats.points_seen);
  EXPECT_NEAR(stats.denoising->sigma_before, before, 1e-9 * before);
  EXPECT_NEAR(stats.denoising->sigma_after, after, 1e-9 * after);
  EXPECT_LT(after, 0.8 * before);
}

TEST(Blend, UnseenPointsAreNaNAndSharedSigmaIsAdded) {
  const Workplace w(plane_scene());
  BlendOptions options;
  options.shared_sigma = 0.05;
  const BlendStats stats = w.run({w.photograph("a", Vec3d(0.5, 0.5, 0.5), Vec3d(0.5, 0.5, 0))}, options);
  EXPECT_LT(stats.points_seen, stats.points);
  std::uint64_t unseen = 0;
  for (const Seen& s : w.result()) {
    if (s.photos > 0) {
      ASSERT_NEAR(s.sigma, std::hypot(0.02f, 0.05f), 1e-5f);
      continue;
    }
    ++unseen;
    ASSERT_TRUE(s.albedo.array().isNaN().all() && std::isnan(s.sigma));
    ASSERT_TRUE(std::abs(s.position.x() - 0.5) > 0.24 || std::abs(s.position.y() - 0.5) > 0.18);
  }
  EXPECT_EQ(unseen, stats.points - stats.points_seen);
}

/// Largest step of value / truth between surfels that are neighbours in x.
float largest_step(std::vector<Seen> seen) {
  std::erase_if(seen, [](const Seen& s) { return s.photos == 0 || std::abs(s.position.y() - 0.5) > 0.01; });
  std::sort(seen.begin(), seen.end(), [](const Seen& a, const Seen& b) { return a.position.x() < b.position.x(); });
  float largest = 0;
  for (std::size_t i = 1; i < seen.size(); ++i)
    if (seen[i].position.x() - seen[i - 1].position.x() < 0.02)
      largest = std::max(largest, std::abs(seen[i].albedo[0] / smooth_paint(seen[i].position)[0] - seen[i - 1].albedo[0] / smooth_paint(seen[i - 1].position)[0]));
  return largest;
}

TEST(Blend, AGainStepOfTenPerCentBecomesASmoothTransition) {
  const Workplace w(plane_scene());
  w.run({w.photograph("a", Vec3d(0.3, 0.5, 0.6), Vec3d(0.3, 0.5, 0)), w.photograph("b", Vec3d(0.7, 0.5, 0.6), Vec3d(0.7, 0.5, 0), gained(1.1f))});
  const auto seen = w.result();
  int both = 0;
  for (const Seen& s : seen) both += s.photos == 2;
  EXPECT_GT(both, 500);
  // the best photograph alone would step by 0.1
  EXPECT_LT(largest_step(seen), 0.02f);
}

TEST(Blend, HiddenSurfacesTakeNothingFromTheSurfaceInFront) {
  AnalyticScene scene;
  scene.rectangles.push_back({Vec3d(0, 0, 0), Vec3d(1, 0, 0), Vec3d(0, 1, 0)});               // wall
  scene.rectangles.push_back({Vec3d(0.35, 0.35, 0.06), Vec3d(0.3, 0, 0), Vec3d(0, 0.3, 0)});   // board 6 spacings before it
  scene.albedo = [](const Vec3d& p) { return p.z() > 0.03 ? Vec3f(0.9f, 0.1f, 0.1f) : Vec3f(0.1f, 0.1f, 0.9f); };
  scene.spacing = 0.01;
  for (const bool oriented : {true, false}) {
    const Workplace w(scene, oriented);
    w.run({w.photograph("a", Vec3d(0.5, 0.5, 1.2), Vec3d(0.5, 0.5, 0)), w.photograph("b", Vec3d(1.1, 0.5, 0.9), Vec3d(0.5, 0.5, 0)),
           w.photograph("c", Vec3d(0.5, -0.1, 0.9), Vec3d(0.5, 0.5, 0))});
    int wall = 0, board = 0;
    for (const Seen& s : w.result()) {
      if (s.photos == 0) continue;
      const bool on_board = s.position.z() > 0.03;
      ++(on_board ? board : wall);
      ASSERT_NEAR(s.albedo[0], on_board ? 0.9f : 0.1f, 1e-3f) << s.position.transpose();
      ASSERT_NEAR(s.albedo[2], on_board ? 0.1f : 0.9f, 1e-3f) << s.position.transpose();
    }
    EXPECT_GT(wall, 4000);
    EXPECT_GT(board, 700);
  }
}

TEST(Blend, TheBackOfASphereIsNotSeenThroughItsFront) {
  AnalyticScene scene;
  scene.spheres.push_back({Vec3d(0, 0, 0), 0.5});
  scene.albedo = [](const Vec3d& p) { return Vec3f::Constant(p.z() > 0 ? 0.8f : 0.2f); };
  scene.spacing = 0.015;
  for (const bool oriented : {true, false}) {
    const Workplace w(scene, oriented);
    const BlendStats stats = w.run({w.photograph("a", Vec3d(0, 0, 2), Vec3d(0, 0, 0))});
    for (const Seen& s : w.result())
      if (s.photos > 0) {
        ASSERT_GT(s.position.z(), 0.05) << s.position.transpose();
      }
    EXPECT_GT(stats.points_seen, stats.points / 4);
  }
}

TEST(Blend, MaskedAndSaturatedPixelsAndWhatIsNotFiniteTakeNoPart) {
  const Workplace w(plane_scene());
  const auto paint = [](int x, int y, const Vec3f& a) -> Vec3f {
    if (x > 100) return Vec3f::Constant(50);                                   // masked below
    if (x < 30) return Vec3f::Constant(9);                                     // saturated below
    return y < 20 ? Vec3f::Constant(std::nanf("")) : a;
  };
  const auto mask = [](int x, int) -> std::uint8_t { return x > 100 ? 0 : x < 30 ? 1 | 2 : 1; };
  ShotOptions disturbed;
  disturbed.mask = mask;
  disturbed.paint = paint;
  const BlendStats stats = w.run({w.photograph("a", Vec3d(0.5, 0.5, 0.8), Vec3d(0.5, 0.5, 0), disturbed)});
  EXPECT_GT(stats.points_seen, 1000u);
  for (const Seen& s : w.result())
    if (s.photos > 0) {
      ASSERT_NEAR((s.albedo - smooth_paint(s.position)).cwiseAbs().maxCoeff(), 0, 1e-2);   // beside borders the next pixel is read
    }
}

/// Mean error of the first channel around (0.5, 0.5).
double error_in_the_middle(const Workplace& w) {
  double sum = 0;
  int n = 0;
  for (const Seen& s : w.result())
    if (std::abs(s.position.x() - 0.5) < 0.1 && std::abs(s.position.y() - 0.5) < 0.1) sum += std::abs(s.albedo[0] - w.scene.albedo(s.position)[0]), ++n;
  return sum / n;
}

TEST(Blend, TheSharperPhotographDecidesTheDetail) {
  AnalyticScene scene = plane_scene();
  scene.albedo = [](const Vec3d& p) { return Vec3f::Constant(static_cast<float>(0.5 + 0.3 * std::sin(2 * 3.14159265 * p.x() / 0.035))); };
  const Workplace w(scene);
  const auto near = w.photograph("near", Vec3d(0.5, 0.5, 0.5), Vec3d(0.5, 0.5, 0));
  const auto far = w.photograph("far", Vec3d(0.5, 0.5, 3), Vec3d(0.5, 0.5, 0));
  const auto error = [&] { return error_in_the_middle(w); };
  w.run({near});
  const double near_alone = error();
  w.run({far});
  const double far_alone = error();
  w.run({near, far});
  EXPECT_GT(far_alone, 4 * near_alone);
  EXPECT_LT(error(), 1.1 * near_alone);
}

TEST(Blend, APhotographOutOfFocusDoesNot) {
  AnalyticScene scene = plane_scene();
  scene.albedo = [](const Vec3d& p) { return Vec3f::Constant(static_cast<float>(0.5 + 0.3 * std::sin(2 * 3.14159265 * p.x() / 0.05))); };
  const Workplace w(scene);
  ShotOptions blurred;   // stripes of 15 pixels from near, under a blur of 30: nothing is left of them
  blurred.paint = [](int, int, const Vec3f&) { return Vec3f::Constant(0.5f); };
  auto near = w.photograph("near", Vec3d(0.5, 0.5, 0.5), Vec3d(0.5, 0.5, 0), blurred);
  const auto far = w.photograph("far", Vec3d(0.5, 0.5, 1.2), Vec3d(0.5, 0.5, 0));
  const auto error = [&] { return error_in_the_middle(w); };
  w.run({far});
  const double far_alone = error();
  w.run({near, far});
  const double not_known = error();
  near.camera.focus = {0.17, 1.2};   // 150 px * 0.17 * |1 / 1.2 - 1 / 0.5| = 30 px
  w.run({near, far});
  EXPECT_GT(not_known, 4 * far_alone);
  EXPECT_LT(error(), 1.1 * far_alone + 0.001);
}

TEST(Blend, AWindowsPixelsDoNotDependOnWhereItBegins) {
  const Workplace w(plane_scene());
  BlendPhotograph a = w.photograph("a", Vec3d(0.3, 0.5, 0.7), Vec3d(0.4, 0.5, 0));
  a.camera.focus = {0.03, 1};
  const PhotographRasters rasters(a.camera.lens, a.gbuffer, a.albedo, a.radiance);
  const WindowOptions options{.low_radius = 0.05f, .reference_footprint = 0.005f, .border_px = 12};
  const int halo = halo_rows(options, footprints(rasters).smallest());
  const PhotoWindow whole = load_window(rasters, a.camera, 0, 120, 1, halo, options);
  for (const int y0 : {0, 37, 50, 61, 104}) {
    const PhotoWindow part = load_window(rasters, a.camera, y0, std::min(120, y0 + 9), 1, halo, options);
    for (int y = std::max(0, y0 - 1); y < std::min(120, y0 + 10); ++y)
      for (int x = 0; x < 160; ++x) {
        ASSERT_EQ(part.at(x, y)->weight, whole.at(x, y)->weight) << x << " " << y;
        ASSERT_EQ(part.at(x, y)->low, whole.at(x, y)->low) << x << " " << y;
      }
  }
}

TEST(Blend, MemoryThatIsUsedAgainLeavesNoTrace) {
  const Workplace w(plane_scene());
  ShotOptions masked;
  masked.mask = [](int x, int y) -> std::uint8_t { return x > 120 ? 0 : y > 100 ? 1 | 2 : 1; };
  const std::vector<BlendPhotograph> all{w.photograph("a", Vec3d(0.3, 0.5, 0.7), Vec3d(0.4, 0.5, 0)), w.photograph("b", Vec3d(0.1, 0.5, 0.5), Vec3d(0.3, 0.5, 0), masked),
                                         shoot(w.scene, look_at("c", Vec3d(0.5, 0.5, 0.4), Vec3d(0.5, 0.5, 0), 61, 45, 60), w.folder.path())};
  WindowRoom room;
  const auto compare = [&](std::size_t k, int y0, int y1, int wider) {
    const BlendPhotograph& p = all[k];
    const PhotographRasters rasters(p.camera.lens, p.gbuffer, p.albedo, p.radiance);
    const WindowOptions options{.low_radius = 0.03f, .reference_footprint = 0.005f, .border_px = 12, .wider = wider};
    const int halo = halo_rows(options, footprints(rasters).smallest()), last = std::min(y1, rasters.height());
    const PhotoWindow again = load_window(rasters, p.camera, y0, last, 1, halo, options, room), fresh = load_window(rasters, p.camera, y0, last, 1, halo, options);
    std::size_t read = 0;
    ASSERT_EQ(again.pixels.size(), fresh.pixels.size());
    for (std::size_t i = 0; i < fresh.pixels.size(); ++i) {
      ASSERT_EQ(again.pixels[i].weight, fresh.pixels[i].weight) << k << " " << i;
      ASSERT_EQ(again.pixels[i].low, fresh.pixels[i].low) << k << " " << i;
      ASSERT_EQ(again.pixels[i].high, fresh.pixels[i].high) << k << " " << i;
      read += fresh.pixels[i].weight > 0;
    }
    EXPECT_EQ(again.wider_means, fresh.wider_means);
    EXPECT_GT(read, fresh.pixels.size() / 4);
  };
  for (const std::size_t k : {0u, 1u, 0u, 2u, 1u}) compare(k, 0, 120, k == 0 ? 2 : 0);
  compare(0, 20, 60, 0);
  compare(1, 40, 60, 1);
}

TEST(Blend, EvidenceOfAPixelMultipliesToItsWeight) {
  const Workplace w(plane_scene());
  ShotOptions shot;
  shot.mask = [](int x, int y) -> std::uint8_t { return x > 120 ? 0 : y > 100 ? 1 | 2 : 1; };
  BlendPhotograph a = w.photograph("a", Vec3d(0.1, 0.5, 0.5), Vec3d(0.3, 0.5, 0), shot);
  a.camera.focus = {0.03, 1};
  const PhotographRasters rasters(a.camera.lens, a.gbuffer, a.albedo, a.radiance);
  const WindowOptions options{.low_radius = 0.05f, .reference_footprint = 0.005f, .border_px = 12};
  const int halo = halo_rows(options, footprints(rasters).smallest());
  const PhotoWindow window = load_window(rasters, a.camera, 0, 120, 1, halo, options);
  for (const int step : {1, 3}) {
    std::vector<SeenEvidence> all;
    for (const int y0 : {0, 30, 93})
      for (const SeenEvidence& one : load_evidence(rasters, a.camera, y0, y0 == 0 ? 30 : y0 == 30 ? 93 : 120, step, halo, options)) all.push_back(one);
    const int across = (160 + step - 1) / step;
    ASSERT_EQ(all.size(), static_cast<std::size_t>(across * (120 / step)));
    std::size_t read = 0;
    for (std::size_t i = 0; i < all.size(); ++i) {
      const int x = static_cast<int>(i) % across * step, y = static_cast<int>(i) / across * step;
      const float weight = all[i].is_read ? pixel_quality(all[i].evidence, options.scale()) * surroundings_quality(all[i].evidence, options.scale()) : 0;
      ASSERT_EQ(weight, window.at(x, y)->weight) << x << " " << y;
      ASSERT_EQ(all[i].is_on_surface, window.at(x, y)->depth > 0);
      read += all[i].is_read;
    }
    EXPECT_GT(read, all.size() / 4);
    EXPECT_LT(read, all.size());
  }
}

TEST(Blend, OrderThreadsAndBudgetDoNotChangeTheBytes) {
  const Workplace w(plane_scene());
  std::vector<BlendPhotograph> photos{w.photograph("a", Vec3d(0.3, 0.5, 0.7), Vec3d(0.3, 0.5, 0)), w.photograph("b", Vec3d(0.7, 0.4, 0.5), Vec3d(0.7, 0.5, 0), gained(1.1f)),
                                      w.photograph("c", Vec3d(0.5, 0.9, 0.8), Vec3d(0.5, 0.5, 0), gained(0.95f))};
  const BlendStats first = w.run(photos);
  const auto expected = w.bytes();
  std::swap(photos[0], photos[2]);
  const BlendStats swapped = w.run(photos);
  EXPECT_EQ(w.bytes(), expected);
  EXPECT_EQ(swapped.photographs[0].samples, first.photographs[2].samples);
  {
    const ThreadLimit one(1);
    w.run(photos);
    EXPECT_EQ(w.bytes(), expected);
  }
  const BlendStats small = w.run(photos, {}, 2400 << 10);
  EXPECT_EQ(w.bytes(), expected);
  EXPECT_GT(small.chunks_visited, first.chunks_visited);   // it did work in bands
  EXPECT_EQ(small.samples, first.samples);
}

TEST(Blend, AStoppedBlendContinuesToTheSameBytes) {
  const Workplace w(plane_scene());
  const std::vector<BlendPhotograph> photos{w.photograph("a", Vec3d(0.3, 0.5, 0.7), Vec3d(0.3, 0.5, 0)), w.photograph("b", Vec3d(0.7, 0.4, 0.5), Vec3d(0.7, 0.5, 0), gained(1.1f)),
                                            w.photograph("c", Vec3d(0.5, 0.9, 0.8), Vec3d(0.5, 0.5, 0), gained(0.95f))};
  const BlendStats whole = w.run(photos);
  const auto expected = w.bytes();
  const int stops = stops_until_done(3, 9, [&](Reporter& report, int before) {
    const BlendStats stats = w.run(photos, {}, before % 2 == 0 ? kPlenty : 2400 << 10, report);   // bands of different heights before and after each stop
    for (std::size_t k = 0; k < photos.size(); ++k) EXPECT_EQ(stats.photographs[k].samples, whole.photographs[k].samples);
  });
  ASSERT_LT(stops, 100);
  EXPECT_GE(stops, 3);
  EXPECT_EQ(w.bytes(), expected);
}

TEST(Blend, MorePhotographsThanVotesCanNameAreRefused) {
  const Workplace w(plane_scene());
  MemoryBudget budget(kPlenty);
  const std::vector<BlendPhotograph> photos(65537);
  try {
    blend(*w.store, photos, {}, w.folder.path() / "scratch", budget, silent_reporter());
    FAIL();
  } catch (const Error& e) {
    EXPECT_NE(std::string(e.what()).find("65537 photographs, but 65536"), std::string::npos) << e.what();
  }
}

TEST(Blend, APhotographThatSeesNothingAndTheSameOneTwiceAreLegal) {
  const Workplace w(plane_scene());
  const auto a = w.photograph("a", Vec3d(0.5, 0.5, 0.6), Vec3d(0.5, 0.5, 0)), away = w.photograph("away", Vec3d(0.5, 0.5, 1), Vec3d(0.5, 0.5, 9));
  w.run({a});
  const auto once = w.result();
  const BlendStats stats = w.run({a, away, a});
  EXPECT_EQ(stats.photographs[1].samples, 0u);
  const auto twice = w.result();
  for (std::size_t i = 0; i < once.size(); ++i) {
    if (once[i].photos == 0) continue;
    ASSERT_EQ(twice[i].photos, 2);
    ASSERT_NEAR(twice[i].albedo[0], once[i].albedo[0], 1e-6f);
  }
  EXPECT_EQ(w.run({}).points_seen, 0u);
}

TEST(Blend, SigmaThatIsZeroOrNotANumberDoesNoHarm) {
  const Workplace w(plane_scene());
  for (const float sigma : {0.0f, std::nanf("")}) {
    ShotOptions shot;
    shot.sigma = sigma;
    w.run({w.photograph("a", Vec3d(0.5, 0.5, 0.6), Vec3d(0.5, 0.5, 0), shot)});
    for (const Seen& s : w.result())
      if (s.photos > 0) {
        ASSERT_TRUE(s.albedo.allFinite());
        ASSERT_NEAR(s.sigma, sigma == 0 ? 0.0f : 1.0f, 1e-5f);
      }
  }
}

TEST(Blend, ADiskWithoutRoomForItsStateIsRefusedBeforeAnythingIsWritten) {
  const Workplace w(plane_scene());
  const std::vector<BlendPhotograph> photos{w.photograph("a", Vec3d(0.4, 0.5, 0.7), Vec3d(0.5, 0.5, 0)), w.photograph("b", Vec3d(0.6, 0.5, 0.7), Vec3d(0.5, 0.5, 0))};
  const std::uint64_t needed = w.run(photos).scratch_bytes;   // and the layer besides
  std::filesystem::remove_all(w.folder.path() / "scratch");
  BlendOptions options;
  options.layer = "other";
  options.free_bytes = [&](const std::filesystem::path& folder) {
    EXPECT_EQ(folder, w.folder.path() / "scratch");
    return needed;
  };
  MemoryBudget budget(kPlenty);
  try {
    blend(*w.store, photos, options, w.folder.path() / "scratch", budget, silent_reporter());
    FAIL() << "no error";
  } catch (const Error& e) {
    for (const char* words : {"scratch: no space: blending needs ", "the disk has "}) EXPECT_NE(std::string(e.what()).find(words), std::string::npos) << e.what();
  }
  EXPECT_TRUE(std::filesystem::is_empty(w.folder.path() / "scratch"));
  EXPECT_FALSE(std::filesystem::exists(w.folder.path() / "store.chiaro/layers/other"));
  options.free_bytes = [&](const std::filesystem::path&) { return 2 * needed; };
  EXPECT_GT(w.run(photos, options).points_seen, 0u);
}

TEST(Blend, TheDiskHasToHoldVotesSumsLayerAndWhatIsWrittenAnew) {
  const Workplace w(plane_scene());
  const auto see_all = [&](const std::string& name, double x) { return w.photograph(name, Vec3d(x, 0.5, 1.8), Vec3d(x, 0.5, 0)); };
  const std::vector<BlendPhotograph> photos{see_all("a", 0.48), see_all("b", 0.52)};
  LeafShape votes{{}, 2, 0, sizeof(Ballot), 0}, sums{{}, 2, 4, sizeof(Accumulator), 0};
  std::uint64_t votes_bytes = 0, sums_bytes = 0, layer_bytes = 0;
  for (const stream::ChunkEntry& c : w.store->chunks()) layer_bytes += c.count * 18ull;   // four floats and a count of photographs
  for (const std::uint32_t leaf : w.store->leaves()) {
    votes.surfels_of_leaf.push_back(w.store->chunks()[leaf].count);
    sums.surfels_of_leaf.push_back(w.store->chunks()[leaf].count);
  }
  for (std::size_t i = 0; i < w.store->leaves().size(); ++i) {
    votes_bytes += LeafFile::disk_bytes(votes, i);
    sums_bytes += LeafFile::disk_bytes(sums, i);
  }
  ASSERT_GT(votes_bytes, sums_bytes);
  std::uint64_t there = 2 * votes_bytes + sums_bytes + layer_bytes - 1;   // a leaf that is written anew is held twice, of so little as much as all of them
  BlendOptions options;
  options.free_bytes = [&](const std::filesystem::path&) { return there; };
  EXPECT_THROW(w.run(photos, options), Error);
  ++there;
  EXPECT_EQ(w.run(photos, options).scratch_bytes, there - layer_bytes);
}

TEST(Blend, RastersOfAnotherSizeOrWithoutAPlaneAreNamed) {
  const Workplace w(plane_scene());
  auto a = w.photograph("a", Vec3d(0.5, 0.5, 0.6), Vec3d(0.5, 0.5, 0));
  auto wrong_size = a;
  wrong_size.camera.lens.width_px = 80;
  auto wrong_plane = a;
  wrong_plane.albedo = a.radiance;
  for (const auto& bad : {wrong_size, wrong_plane}) {
    try {
      w.run({bad});
      FAIL() << "no error";
    } catch (const Error& e) {
      EXPECT_NE(std::string(e.what()).find("a_"), std::string::npos) << e.what();
    }
  }
  MemoryBudget tiny(10000);
  EXPECT_THROW(blend(*w.store, std::vector{a}, {}, w.folder.path() / "scratch", tiny, silent_reporter()), Error);
}

}  // namespace
}  // namespace chiaro::blend
