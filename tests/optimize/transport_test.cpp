#include <gtest/gtest.h>

#include <array>
#include <cmath>
#include <numbers>
#include <set>

#include "optimize/acquisition.h"
#include "optimize/adam.h"
#include "optimize/gather.h"
#include "optimize/radiosity.h"
#include "stream/base/error.h"
#include "stream/base/file.h"
#include "stream/base/parallel.h"
#include "stream/base/rng.h"
#include "tests/optimize/lit.h"

namespace chiaro::optimize {
namespace {

using tests::Lit;
using tests::SampledPoint;

TEST(Gather, AConvexBodySeesTheWholeSky) {
  const Lit s(tests::sphere_points(20000, 1.0, {0, 0, 0}, false), 32);
  for (std::size_t i = 0; i < s.proxy.size(); ++i) EXPECT_NEAR(s.transport.sky[i * kSkyTerms], std::numbers::pi, 1e-5);
  // The first-order terms of a hemisphere around n: integral of w cos = 2 pi / 3 n.
  const Vec3f n = s.proxy.normal[123];
  EXPECT_NEAR(s.transport.sky[123 * kSkyTerms + 3], 2.0943951 * static_cast<double>(n.x()), 0.15);
  EXPECT_NEAR(s.transport.sky[123 * kSkyTerms + 2], 2.0943951 * static_cast<double>(n.z()), 0.15);
}

TEST(Gather, AFurnaceHasNoSkyAndIsFilledWithItsOwnLight) {
  const Lit s(tests::sphere_points(20000, 1.0, {0, 0, 0}, true), 32);
  std::vector<float> ones(3 * s.proxy.size(), 1.0f), g;
  gather_radiosity(s.transport, ones, g);
  double sky = 0;
  for (std::size_t i = 0; i < s.proxy.size(); ++i) sky += static_cast<double>(s.transport.sky[i * kSkyTerms]);
  EXPECT_LT(sky / static_cast<double>(s.proxy.size()), 1e-3);
  for (const float v : g) EXPECT_NEAR(v, 1, 0.05);
  // B = rho (E + F B) has B = rho E / (1 - rho) inside a closed surface.
  const std::vector<float> albedo(3 * s.proxy.size(), 0.6f), direct(3 * s.proxy.size(), 2.0f);
  const std::vector<float> b = forward_radiosity(s.transport, albedo, direct, 1, 40);
  double mean = 0;
  for (const float v : b) mean += static_cast<double>(v);
  EXPECT_NEAR(mean / static_cast<double>(b.size()) / (0.6 * 2 / 0.4), 1, 2e-3);
}

TEST(Gather, ParallelPlatesSeeTheirFormFactor) {
  // Two unit squares at distance one: F = 0.19982 (Siegel & Howell, configuration 1 with X = Y = 1).
  auto points = tests::square_points(80, 1.0, {0, 0, 0}, {0, 0, 1}, 1);
  const auto upper = tests::square_points(80, 1.0, {0, 0, 1}, {0, 0, -1}, 2);
  points.insert(points.end(), upper.begin(), upper.end());
  const Lit s(points, 64);
  double hits = 0;
  for (const std::uint32_t h : s.transport.hits) hits += h != Transport::kSky;
  // Discs overhang the rims by about half a spacing of 1/80: a receiver that is 3 % larger.
  EXPECT_NEAR(hits / static_cast<double>(s.transport.hits.size()), 0.19982 * 1.015, 0.19982 * 0.02);
}

TEST(Gather, OtherFacesAreMetRightBesideACrease) {
  // A floor that ends at a wall: half of what its points see beside the crease is wall, however near they are.
  auto points = tests::square_points(60, 1.0, {0.5, 0, 0}, {0, 0, 1}, 1);
  const auto wall = tests::square_points(60, 1.0, {0, 0, 0.5}, {1, 0, 0}, 2);
  points.insert(points.end(), wall.begin(), wall.end());
  const Lit s(points, 64);
  double hits = 0, expected = 0;
  int count = 0;
  for (std::size_t i = 0; i < s.proxy.size(); ++i) {
    const Vec3d p = s.proxy.position[i].cast<double>() + s.proxy.origin_in_world;
    if (s.proxy.normal[i].z() < 0.9f || p.x() > 1.0 / 60 || std::fabs(p.y()) > 0.25) continue;
    for (std::size_t m = 0; m < 64; ++m) hits += (s.transport.hits[64 * i + m] != Transport::kSky) / 64.0;
    // A strip of height 1, endless to both sides (its ends matter by less than 1 %): Hottel's crossed strings.
    expected += 0.5 * (1 - p.x() / std::sqrt(1 + p.x() * p.x()));
    ++count;
  }
  ASSERT_GT(count, 20);
  EXPECT_NEAR(hits / expected, 1, 0.05);
}

TEST(Gather, ErrorFallsFasterThanRandomRays) {
  // Mean square error of the sky fraction above a plate with a roof, against 1024 rays: quartering should beat 1/4 clearly.
  auto points = tests::square_points(40, 1.0, {0, 0, 0}, {0, 0, 1}, 1);
  const auto roof = tests::square_points(40, 1.0, {0.5, 0, 0.5}, {0, 0, -1}, 2);
  points.insert(points.end(), roof.begin(), roof.end());
  const Lit truth(points, 1024), few(points, 16), more(points, 64);
  const auto error = [&](const Lit& s) {
    double sum = 0;
    for (std::size_t i = 0; i < s.proxy.size(); ++i) sum += std::pow(static_cast<double>(s.transport.sky[i * kSkyTerms] - truth.transport.sky[i * kSkyTerms]), 2);
    return sum;
  };
  EXPECT_LT(error(more), 0.17 * error(few));
}

TEST(Gather, IsTheSameForAnyThreadsAndSurvivesTheDisk) {
  const auto points = tests::sphere_points(6000, 1.0, {0, 0, 0}, true);
  const Lit a(points, 16, 2);
  const ThreadLimit limit(1);
  const Lit b(points, 16, 2);
  EXPECT_EQ(a.transport.hits, b.transport.hits);
  EXPECT_EQ(a.transport.sky, b.transport.sky);
  const auto path = a.folder.path() / "transport.bin";
  write_transport(a.transport, path);
  const Transport back = read_transport(path, a.proxy.size());
  EXPECT_EQ(back.hits, a.transport.hits);
  EXPECT_EQ(back.sky, a.transport.sky);
  EXPECT_THROW(read_transport(path, a.proxy.size() + 1), Error);
  std::string bytes = read_text(path);
  for (const std::size_t at : {std::size_t{0}, std::size_t{9}, std::size_t{200}, bytes.size() - 1}) {
    std::string damaged = bytes;
    damaged[at] = static_cast<char>(damaged[at] ^ 0x41);
    write_text(a.folder.path() / "damaged.bin", damaged);
    EXPECT_THROW(read_transport(a.folder.path() / "damaged.bin", a.proxy.size()), Error) << "byte " << at;
  }
  write_text(a.folder.path() / "short.bin", bytes.substr(0, bytes.size() / 2));
  EXPECT_THROW(read_transport(a.folder.path() / "short.bin", a.proxy.size()), Error);
}

TEST(Radiosity, UnseenSurfelsFollowFromTheirAlbedo) {
  // Half of a closed sphere is measured; the other half must come out as the closed form of the whole.
  const Lit s(tests::sphere_points(8000, 1.0, {0, 0, 0}, true), 64);
  constexpr double kAlbedo = 0.5, kFlash = 3;
  Lights lights;
  lights.flash_intensity = kFlash;
  Observation o;
  const std::size_t n = s.proxy.size();
  o.flash.assign(n, 1.0f);
  o.seen.assign(n, 0);
  o.radiosity.assign(3 * n, 0.0f);
  const double expected = kAlbedo * kFlash / (1 - kAlbedo);
  for (std::size_t i = 0; i < n; ++i)
    if (s.proxy.position[i].x() > 0) {
      o.seen[i] = 1;
      for (std::size_t c = 0; c < 3; ++c) o.radiosity[3 * i + c] = static_cast<float>(expected);
    }
  const std::vector<float> albedo(3 * n, static_cast<float>(kAlbedo));
  const std::vector<float> g = tests::complete_alone(s.transport, s.smoother, 2, lights, albedo, o, 60, 1e-8);
  double mean = 0, unseen = 0;
  for (std::size_t i = 0; i < n; ++i) {
    mean += static_cast<double>(g[3 * i + 1]) / static_cast<double>(n);
    if (!o.seen[i]) unseen = std::max(unseen, std::fabs(static_cast<double>(o.radiosity[3 * i]) / expected - 1));
  }
  EXPECT_NEAR(mean / expected, 1, 2e-3);
  EXPECT_LT(unseen, 0.05);
}

// Of two acquisitions over the same surfels the second takes what the first gathered, as a mark in it shows; with rays of another seed it does not.
TEST(GatherScene, TakesWhatWasGatheredOverTheSameSurfels) {
  const Lit s(tests::sphere_points(500, 1.0, {0, 0, 0}, false), 4);
  AcquisitionInput input;
  input.try_floor = false;
  AcquisitionOptions options;
  options.rays = 4;
  MemoryBudget budget(512u << 20);
  const auto folder = [&](const char* name) {
    make_folder(s.folder.path() / name);
    return s.folder.path() / name;
  };
  const auto gathered = [&](const char* name, std::span<const std::filesystem::path> others) {
    gather_scene(s.store, input, options, folder(name), others, budget, silent_reporter());
    return read_text(folder(name) / "transport.bin");
  };
  const std::string plain = gathered("plain", {});
  const std::array others{folder("first")};
  gathered("first", {});
  EXPECT_EQ(gathered("second", others), plain);
  Transport marked = read_transport(folder("first") / "transport.bin", s.proxy.size());
  marked.sky[0] += 1;
  write_transport(marked, folder("first") / "transport.bin");
  EXPECT_EQ(gathered("third", others), read_text(folder("first") / "transport.bin"));
  options.seed = 7;
  EXPECT_EQ(gathered("fourth", others), gathered("fifth", {}));
}

// Photographs that see other parts, under other lights, and stop after different numbers of sweeps.
TEST(Radiosity, OfPhotographsCompletedTogetherHasTheBitsOfEachAlone) {
  const Lit s(tests::sphere_points(3000, 1.0, {0, 0, 0}, true), 16);
  const std::size_t n = s.proxy.size();
  std::vector<Lights> lights(Completion::kMost);
  std::vector<Observation> seen(Completion::kMost);
  std::vector<float> albedo;
  for (std::size_t i = 0; i < 3 * n; ++i) albedo.push_back(0.2f + 0.6f * uniform01(5, Purpose::kTest, i, 0));
  for (std::size_t k = 0; k < seen.size(); ++k) {
    lights[k].flash_intensity = 2 + static_cast<double>(k);
    lights[k].bounce = k == 3 ? 0.1 : 1.0;
    Observation& o = seen[k];
    for (std::size_t i = 0; i < n; ++i) {
      o.seen.push_back(s.proxy.position[i].x() > 0.3f * static_cast<float>(k) - 0.5f);
      o.flash.push_back(uniform01(5, Purpose::kTest, i, static_cast<std::uint32_t>(k + 1)));
      for (std::size_t c = 0; c < 3; ++c) o.radiosity.push_back(o.seen[i] ? 1 + 0.1f * static_cast<float>(c + k) : 0.0f);
    }
  }
  constexpr int kSweeps = 12;
  constexpr double kTolerance = 1e-3;
  for (const int threads : {1, 8}) {
    const ThreadLimit limit(threads);
    Completion together(s.transport, s.smoother, 2, seen.size());
    for (std::size_t k = 0; k < seen.size(); ++k) together.add(lights[k], albedo, seen[k]);
    together.solve(kSweeps, kTolerance);
    std::set<int> sweeps;
    for (std::size_t k = 0; k < seen.size(); ++k) {
      Observation alone = seen[k], o = seen[k];
      int done = 0;
      EXPECT_EQ(together.gathered(k), tests::complete_alone(s.transport, s.smoother, 2, lights[k], albedo, alone, kSweeps, kTolerance, &done)) << k;
      together.take_unseen(k, o);
      EXPECT_EQ(o.radiosity, alone.radiosity) << k;
      EXPECT_EQ(together.sweeps(k), done) << k;
      sweeps.insert(done);
    }
    EXPECT_GT(sweeps.size(), 1u);
  }
}

TEST(Adam, GradientsAgreeWithFiniteDifferences) {
  auto points = tests::square_points(12, 1.0, {0, 0, 0.5}, {1, 0, 0}, 1);
  const auto floor = tests::square_points(12, 1.0, {0.5, 0, 0}, {0, 0, 1}, 2);
  points.insert(points.end(), floor.begin(), floor.end());
  const Lit s(points, 64);
  const std::size_t n = s.proxy.size();
  Observation o;
  o.flash.resize(n);
  o.seen.resize(n);
  o.radiosity.resize(3 * n);
  AdamState x;
  x.flash_intensity = 4;
  x.ambient = 0.3;
  x.albedo.resize(3 * n);
  for (std::size_t i = 0; i < n; ++i) {
    const auto u = uniform01x4(1, Purpose::kTest, i, 0);
    o.flash[i] = 0.2f + 0.3f * u[0];
    o.seen[i] = u[1] < 0.8f;
    for (std::size_t c = 0; c < 3; ++c) {
      o.radiosity[3 * i + c] = 0.5f + u[2];
      x.albedo[3 * i + c] = 0.3f + 0.4f * u[3];
    }
  }
  AdamGradient g;
  adam_loss(s.transport, o, x, 6, &g);
  const auto check = [&](double& parameter, double gradient, const char* what) {
    for (const double step : {1e-2, 3e-3}) {
      const double at = parameter;
      parameter = at * (1 + step);
      const double up = adam_loss(s.transport, o, x, 6, nullptr);
      parameter = at * (1 - step);
      const double down = adam_loss(s.transport, o, x, 6, nullptr);
      parameter = at;
      EXPECT_NEAR((up - down) / (2 * step * at) / gradient, 1, 2e-3) << what;
    }
  };
  check(x.flash_intensity, g.flash_intensity, "flash");
  check(x.ambient, g.ambient, "ambient");
  for (const std::size_t c : {std::size_t{0}, std::size_t{100}, 3 * n / 2, 3 * n - 1}) {
    // One albedo at a time changes the loss little: a wide step keeps the difference above float rounding.
    const float at = x.albedo[c];
    constexpr float kStep = 0.05f;
    x.albedo[c] = at + kStep;
    const double up = adam_loss(s.transport, o, x, 6, nullptr);
    x.albedo[c] = at - kStep;
    const double down = adam_loss(s.transport, o, x, 6, nullptr);
    x.albedo[c] = at;
    EXPECT_NEAR((up - down) / (2 * static_cast<double>(kStep)), static_cast<double>(g.albedo[c]), 0.02 * std::fabs(static_cast<double>(g.albedo[c])) + 1e-7) << c;
  }
}

/// All surfels seen under a far flash above them; radiosity from what arrives of a flash of unit intensity.
template <class Radiosity>
Observation seen_from_above(const Lit& s, const Radiosity& radiosity) {
  const std::size_t n = s.proxy.size();
  Observation o;
  o.seen.assign(n, 1);
  for (std::size_t i = 0; i < n; ++i) {
    o.flash.push_back(0.3f * std::max(0.0f, s.proxy.normal[i].z()));
    o.radiosity.insert(o.radiosity.end(), 3, radiosity(o.flash[i]));
  }
  return o;
}

TEST(Adam, StartDecidesWhatOnePhotographCannot) {
  // The paper's loss is flat along flash against ambient: from low and high flash the fit is as good, the light is not the same (physics.md 0.1).
  const Lit s(tests::sphere_points(3000, 1.0, {0, 0, 0}, false), 16);
  const Observation o = seen_from_above(s, [](float flash) { return 0.5f * (5 * flash + 3.14159f * 0.12f); });
  AdamOptions options;
  options.search_steps = 1;
  options.search_iterations = 50;
  options.iterations = 300;
  const AdamResult low = solve_adam(s.transport, o, {3.5, 3.6}, options, silent_reporter()), high = solve_adam(s.transport, o, {6.9, 7.0}, options, silent_reporter());
  EXPECT_LT(low.loss, 1e-5);
  EXPECT_LT(high.loss, 1e-5);
  EXPECT_LT(low.state.flash_intensity, 3.7);
  EXPECT_GT(high.state.flash_intensity, 6.8);
}

// Half of what the lower of two plates meets is the back of the upper one; that meets nothing.
TEST(Gather, CountsRaysThatMeetASurfaceFromBehind) {
  auto points = tests::square_points(60, 1.0, {0, 0, 0}, {0, 0, 1}, 1);
  const auto upper = tests::square_points(60, 1.0, {0, 0, 1}, {0, 0, 1}, 2);
  points.insert(points.end(), upper.begin(), upper.end());
  EXPECT_NEAR(Lit(points, 64).transport.back_share, 0.5 * 0.19982, 0.005);
}

TEST(Gather, OtherRaysFollowFromAnotherSeedAndAreKnownByIt) {
  const Lit s(tests::sphere_points(3000, 1.0, {0, 0, 0}, true), 16);
  const Transport other = gather(s.proxy, *s.tracer, s.smoother, {16, 7, 0}, silent_reporter());
  EXPECT_EQ(s.transport.seed, 1u);
  EXPECT_EQ(other.seed, 7u);
  EXPECT_NE(other.hits, s.transport.hits);
  // A ray of the fan meets what lies in its direction: on a sphere, 2 (n . d) d away.
  const RayFan fan(s.proxy, 7, 100);
  for (std::size_t m = 0; m < 16; ++m) {
    const Vec3f d = fan.direction(m), expected = s.proxy.position[100] + 2 * s.proxy.normal[100].dot(d) * d;
    ASSERT_NE(other.hits[100 * 16 + m], Transport::kSky);
    EXPECT_LE((s.proxy.position[other.hits[100 * 16 + m]] - expected).norm(), 0.12f) << m;
  }
  Transport written = other;
  written.back_share = 0.25;
  write_transport(written, s.folder.path() / "other.bin");
  const Transport back = read_transport(s.folder.path() / "other.bin", s.proxy.size());
  EXPECT_EQ(back.seed, 7u);
  EXPECT_EQ(back.back_share, 0.25);
}

TEST(Gather, SmoothsTheSkyAsOftenAsAsked) {
  const auto points = tests::square_points(30, 1.0, {0, 0, 0}, {0, 0, 1}, 1);
  const Lit plain(points, 16), smooth(points, 16, 3);
  std::vector<float> expected = plain.transport.sky;
  plain.smoother.apply(expected, kSkyTerms, 3);
  EXPECT_EQ(smooth.transport.sky, expected);
}

TEST(SkyBasis, IsTheOneOfItsHeader) {
  const float x = 0.2f, y = -0.5f, z = 0.7f;
  float terms[kSkyTerms];
  sky_basis({x, y, z}, terms);
  const float expected[] = {1, y, z, x, x * y, y * z, 3 * z * z - 1, x * z, x * x - y * y};
  for (int k = 0; k < kSkyTerms; ++k) EXPECT_EQ(terms[k], expected[k]) << k;
}

// Brighter than any albedo explains: the search ends at the range's upper end, flash and albedo at their bounds.
TEST(Adam, StaysInTheCalibratedRangeAndBelowWhite) {
  const Lit s(tests::sphere_points(1000, 1.0, {0, 0, 0}, false), 8);
  const Observation o = seen_from_above(s, [](float flash) { return 40 * flash; });
  AdamOptions options;
  options.search_iterations = 40;
  const AdamResult r = solve_adam(s.transport, o, {5, 10}, options, silent_reporter());
  EXPECT_LT(r.search_loss_high, 0.9 * r.search_loss_low);
  EXPECT_GT(r.state.flash_intensity, 9.9);
  EXPECT_LE(r.state.flash_intensity, 10);
  for (const float a : r.state.albedo) {
    ASSERT_GE(a, 0);
    ASSERT_LE(a, 1);
  }
}

}  // namespace
}  // namespace chiaro::optimize
