#include "surfels/tracer.h"

#include <gtest/gtest.h>

#include <cmath>

#include "stream/base/error.h"
#include "stream/base/file.h"
#include "stream/base/rng.h"
#include "surfels/disc_block.h"
#include "tests/support/sampled_surface.h"

namespace chiaro::surfels {
namespace {

using tests::build_test_store;
using tests::sphere_points;
using tests::square_points;

Tracer trace_all(const stream::Store& store, MemoryBudget& budget, const Vec3d& origin, bool reversed = false) {
  Tracer tracer(origin, budget);
  std::vector<std::uint32_t> leaves = store.leaves();
  if (reversed) std::reverse(leaves.begin(), leaves.end());
  for (const std::uint32_t leaf : leaves) tracer.add(store.read_chunk(leaf));
  tracer.commit();
  return tracer;
}

Vec3f random_direction(std::uint64_t i) {
  const auto u = uniform01x4(3, Purpose::kTest, i, 0);
  const float z = 2 * u[0] - 1, r = std::sqrt(1 - z * z), phi = 6.2831853f * u[1];
  return {r * std::cos(phi), r * std::sin(phi), z};
}

TEST(DiscBlock, ABoxHoldsAllDiscsAndIsNoLargerThanTheyAre) {
  for (std::uint64_t trial = 0; trial < 200; ++trial) {
    stream::SurfelBlock block{};
    const std::size_t count = 1 + trial % 16;
    const DiscScale scale{0.001f, 0.25f};
    Vec3f lower = Vec3f::Constant(1e30f), upper = Vec3f::Constant(-1e30f);
    float largest = 0;
    for (std::size_t i = 0; i < 16; ++i) {
      const auto u = uniform01x4(11, Purpose::kTest, 16 * trial + i, 0);
      const auto code = stream::encode_normal(random_direction(16 * trial + i));
      block.x[i] = static_cast<std::uint16_t>(65535 * u[0]);
      block.y[i] = static_cast<std::uint16_t>(65535 * u[1]);
      block.z[i] = static_cast<std::uint16_t>(65535 * u[2]);
      block.normal_u[i] = code[0];
      block.normal_v[i] = code[1];
      block.log_radius[i] = static_cast<std::uint8_t>(100 + 155 * u[3]);
      if (i >= count) block.flags[i] = stream::SurfelBlock::kPadding;
      if (i >= count) continue;
      const Vec3f centre = (Vec3f(block.x[i], block.y[i], block.z[i]) + Vec3f::Constant(0.5f)) * scale.step, n = stream::decode_normal(code[0], code[1]), across = n.unitOrthogonal();
      const float radius = stream::decode_radius(block.log_radius[i], 0.5f);
      largest = std::max(largest, radius);
      for (int k = 0; k < 720; ++k) {
        const float turn = 6.2831853f * static_cast<float>(k) / 720;
        const Vec3f rim = centre + radius * (std::cos(turn) * across + std::sin(turn) * n.cross(across));
        lower = lower.cwiseMin(rim);
        upper = upper.cwiseMax(rim);
      }
    }
    const BlockBox box = box_of_block(block, scale);
    for (std::size_t a = 0; a < 3; ++a) {
      const auto k = static_cast<int>(a);
      EXPECT_LE(box.lower[a], lower[k]);
      EXPECT_GE(box.upper[a], upper[k]);
      EXPECT_GE(box.lower[a], lower[k] - 2e-3f * largest - 1e-4f);   // the margin and the steps of the rim, and 65 m in floats
      EXPECT_LE(box.upper[a], upper[k] + 2e-3f * largest + 1e-4f);
    }
  }
}

TEST(Tracer, HitsAPlaneWhereItIs) {
  const ScratchFolder folder;
  const stream::Store store = build_test_store(square_points(120, 2.0, {5, 5, 3}, {0, 0, 1}, 1), folder.path());
  MemoryBudget budget(64u << 20);
  const Tracer tracer = trace_all(store, budget, {5, 5, 0});
  for (std::uint64_t i = 0; i < 500; ++i) {
    const auto u = uniform01x4(5, Purpose::kTest, i, 0);
    const Vec3f target(1.6f * u[0] - 0.8f, 1.6f * u[1] - 0.8f, 3), from(2 * u[2] - 1, 2 * u[3] - 1, 6);
    const Vec3f d = (target - from).normalized();
    Hit hit;
    ASSERT_TRUE(tracer.closest({from, d, 0, 1e30f}, hit));
    EXPECT_NEAR(hit.t, (target - from).norm(), 2e-4f);   // positions are stored to 1/65536 of the cell
    EXPECT_GT(hit.normal.z(), 0.9999f);
  }
}

// Of rays across the border of a square, the share that meets it `beyond` spacings outside (inside, if negative).
double share_met(const Tracer& tracer, double half, double spacing, double beyond) {
  int met = 0;
  constexpr int kRays = 2000;
  for (int i = 0; i < kRays; ++i) {
    const double along = (1.8 * (i + 0.5) / kRays - 0.9) * half, across = half + beyond * spacing;
    const Vec3d at[] = {{across, along, 0}, {-across, along, 0}, {along, across, 0}, {along, -across, 0}};
    Hit hit;
    met += tracer.closest({(at[i % 4] + Vec3d(0, 0, 1)).cast<float>(), {0, 0, -1}, 0, 1e30f}, hit);
  }
  return static_cast<double>(met) / kRays;
}

TEST(Tracer, DiscsEndWhereTheSurfaceEnds) {
  const ScratchFolder folder;
  std::vector<tests::SampledPoint> points;
  for (std::uint64_t i = 0; i < 10000; ++i) {
    const auto u = uniform01x4(12, Purpose::kTest, i, 0);
    points.push_back({{2 * u[0] - 1.0, 2 * u[1] - 1.0, 0}, {0, 0, 1}});
  }
  const stream::Store store = build_test_store(points, folder.path());
  MemoryBudget budget(64u << 20);
  const Tracer tracer = trace_all(store, budget, {0, 0, 0});
  EXPECT_GT(share_met(tracer, 1, 0.02, -0.5), 0.99);
  EXPECT_LT(share_met(tracer, 1, 0.02, 0.6), 0.6);    // whole discs: 0.8
  EXPECT_LT(share_met(tracer, 1, 0.02, 1), 0.15);     // 0.5
  EXPECT_LT(share_met(tracer, 1, 0.02, 1.3), 0.02);   // 0.3
}

TEST(Tracer, LetsNoRayOutOfASphere) {
  const ScratchFolder folder;
  const stream::Store store = build_test_store(sphere_points(60000, 1.0, {0, 0, 0}, true), folder.path());
  MemoryBudget budget(64u << 20);
  const Tracer tracer = trace_all(store, budget, {0, 0, 0});
  int misses = 0;
  double worst = 0;
  for (std::uint64_t i = 0; i < 20000; ++i) {
    Hit hit;
    if (!tracer.closest({{0.1f, -0.2f, 0.05f}, random_direction(i), 0, 1e30f}, hit)) {
      ++misses;
      continue;
    }
    const Vec3f p = Vec3f(0.1f, -0.2f, 0.05f) + random_direction(i) * hit.t;
    worst = std::max(worst, std::fabs(static_cast<double>(p.norm()) - 1));
  }
  EXPECT_EQ(misses, 0);
  EXPECT_LT(worst, 1e-3);   // sagitta of a disc of this radius is 1e-4
}

// The edge of a table: discs of its top reach over it no further than a fraction of the spacing, and the edge itself is closed.
TEST(Tracer, DiscsEndAtAnEdge) {
  const ScratchFolder folder;
  auto points = square_points(60, 2.0, {0, 0, 0}, {0, 0, 1}, 1);
  for (const Vec3d& side : {Vec3d(1, 0, 0), Vec3d(-1, 0, 0), Vec3d(0, 1, 0), Vec3d(0, -1, 0)}) {
    const auto more = square_points(60, 2.0, side - Vec3d(0, 0, 1), side, 2);
    points.insert(points.end(), more.begin(), more.end());
  }
  const stream::Store store = build_test_store(points, folder.path());
  MemoryBudget budget(64u << 20);
  const Tracer tracer = trace_all(store, budget, {0, 0, 0});
  const float spacing = 2.0f / 60;
  int over = 0, slipped = 0;
  const int n = 2000;
  for (int i = 0; i < n; ++i) {
    const float y = 1.8f * (static_cast<float>(i) + 0.5f) / n - 0.9f;
    Hit hit;
    over += tracer.closest({{1 + 0.3f * spacing, y, 2}, {0, 0, -1}, 0, 2.5f}, hit);
    over += tracer.occluded({{1 + 0.3f * spacing, y, 2}, {0, 0, -1}, 0, 2.5f});
    const Vec3f down = Vec3f(-1, 0, -1).normalized();
    slipped += !tracer.closest({Vec3f(1, y, 0) - 2 * down, down, 0, 2.2f}, hit);
  }
  EXPECT_LT(over, 2 * n / 20);
  EXPECT_EQ(slipped, 0);
}

TEST(Tracer, DoesNotDependOnTheOrderOfChunks) {
  const ScratchFolder folder;
  const stream::Store store = build_test_store(sphere_points(200000, 1.0, {0, 0, 0}, false), folder.path());
  ASSERT_GT(store.leaves().size(), 1u);
  MemoryBudget budget(256u << 20);
  const Tracer a = trace_all(store, budget, {0, 0, 0}), b = trace_all(store, budget, {0, 0, 0}, true);
  for (std::uint64_t i = 0; i < 5000; ++i) {
    const Vec3f d = random_direction(i);
    Hit ha, hb;
    const bool found = a.closest({-3 * d + random_direction(i + 77777) * 0.9f, d, 0, 1e30f}, ha);
    ASSERT_EQ(found, b.closest({-3 * d + random_direction(i + 77777) * 0.9f, d, 0, 1e30f}, hb));
    if (!found) continue;
    EXPECT_EQ(ha.t, hb.t);
    EXPECT_EQ(ha.normal, hb.normal);
    EXPECT_EQ(ha.surfel, hb.surfel);
  }
}

TEST(Tracer, TheProcessorChangesNoBit) {
  const ScratchFolder folder;
  std::vector<tests::SampledPoint> points = square_points(90, 1.5, {5, 5, 3}, {0.6, 0, 0.8}, 1);   // two faces that meet: some discs are clipped
  for (const auto& p : square_points(90, 1.5, {5, 5, 3}, {-0.8, 0, 0.6}, 2)) points.push_back(p);
  const stream::Store store = build_test_store(points, folder.path(), 4096);
  MemoryBudget budget(64u << 20);
  const Tracer tracer = trace_all(store, budget, {5, 5, 0});
  std::vector<std::array<float, 6>> answers[2];
  std::size_t hits = 0;
  for (const bool wide : {true, false}) {
    use_wide_discs(wide);
    for (std::uint64_t i = 0; i < 20000; ++i) {
      const auto u = uniform01x4(9, Purpose::kTest, i, 0);
      const float far = i % 4 == 0 ? 3000.0f : 2.0f;
      const Vec3f d = random_direction(i), from = Vec3f(1.4f * u[0] - 0.7f, 1.4f * u[1] - 0.7f, 2.3f + 1.4f * u[2]) - far * d;
      Hit hit;
      const bool met = tracer.closest({from, d, 0, 1e30f}, hit);
      hits += met;
      answers[wide].push_back({met ? hit.t : -1, met ? hit.normal.x() : 0, met ? hit.radius : 0, met ? hit.back : 0, met ? static_cast<float>(hit.surfel.packed() % 65536) : 0, tracer.occluded({from, d, 0, far}) ? 1.0f : 0.0f});
    }
  }
  use_wide_discs(true);
  EXPECT_GT(hits, 10000u);
  EXPECT_TRUE(answers[0] == answers[1]);
}

TEST(Tracer, BlendsWithWeightsThatSumToOne) {
  const ScratchFolder folder;
  const stream::Store store = build_test_store(square_points(60, 1.0, {0, 0, 0}, {0, 0, 1}, 2), folder.path());
  MemoryBudget budget(64u << 20);
  const Tracer tracer = trace_all(store, budget, {0, 0, 0});
  Hit hit;
  HitBlend blend;
  ASSERT_TRUE(tracer.closest({{0.013f, 0.021f, 1}, {0, 0, -1}, 0, 1e30f}, hit, blend));
  ASSERT_GE(blend.count, 1);
  float sum = 0;
  for (int i = 0; i < blend.count; ++i) sum += blend.weight[static_cast<std::size_t>(i)];
  EXPECT_NEAR(sum, 1, 1e-6f);
}

TEST(Tracer, ASurfaceDoesNotShadowItself) {
  const ScratchFolder folder;
  const stream::Store store = build_test_store(square_points(150, 2.0, {0, 0, 0}, {0, 0, 1}, 3), folder.path());
  MemoryBudget budget(64u << 20);
  const Tracer tracer = trace_all(store, budget, {0, 0, 0});
  int blocked = 0;
  for (std::uint64_t i = 0; i < 5000; ++i) {
    const auto u = uniform01x4(9, Purpose::kTest, i, 0);
    const Vec3f from(1.6f * u[0] - 0.8f, 1.6f * u[1] - 0.8f, 1);
    Hit hit;
    ASSERT_TRUE(tracer.closest({from, {0, 0, -1}, 0, 1e30f}, hit));
    const float elevation = 0.05f + 1.5f * u[2], phi = 6.2831853f * u[3];   // down to three degrees above the plane
    const Vec3f d(std::cos(elevation) * std::cos(phi), std::cos(elevation) * std::sin(phi), std::sin(elevation));
    blocked += tracer.occluded(escape_ray(from + Vec3f(0, 0, -hit.t), hit.normal, hit.radius, d, 1e30f));
  }
  EXPECT_EQ(blocked, 0);
}

TEST(Tracer, SeesWhatLiesBetween) {
  const ScratchFolder folder;
  auto points = square_points(80, 1.0, {0, 0, 0}, {0, 0, 1}, 4);
  const auto roof = square_points(80, 1.0, {0, 0, 1}, {0, 0, -1}, 5);
  points.insert(points.end(), roof.begin(), roof.end());
  const stream::Store store = build_test_store(points, folder.path());
  MemoryBudget budget(64u << 20);
  const Tracer tracer = trace_all(store, budget, {0, 0, 0});
  const Vec3f up(0, 0, 1);
  EXPECT_TRUE(tracer.occluded(escape_ray({0.1f, 0.1f, 0}, up, 0.02f, up, 5)));
  EXPECT_FALSE(tracer.occluded(escape_ray({0.1f, 0.1f, 0}, up, 0.02f, up, 0.9f))) << "the roof lies beyond the end of the ray";
}

using tests::blunt_wedge;
using tests::kBlunt;

/// Of rays from above that hit, how many are beyond an edge, and how many there are.
std::pair<int, int> beyond_edges(const Tracer& tracer, double x0, double x1) {
  std::pair<int, int> counts{0, 0};
  for (std::uint64_t i = 0; i < 2000; ++i) {
    const auto u = uniform01x4(14, Purpose::kTest, i, 0);
    const Ray ray{{static_cast<float>(x0 + (x1 - x0) * static_cast<double>(u[0])), 0.8f * u[1] - 0.4f, 1}, {0, 0, -1}, 0, 1e30f};
    Hit hit;
    if (!tracer.closest(ray, hit)) continue;
    counts.first += tracer.is_beyond_edge(ray, hit);
    ++counts.second;
  }
  return counts;
}

TEST(Tracer, TellsDiscsThatStandOutOverAnEdge) {
  const ScratchFolder folder;
  const stream::Store store = build_test_store(blunt_wedge(), folder.path());
  MemoryBudget budget(64u << 20);
  const Tracer tracer = trace_all(store, budget, {0, 0, 0});
  const auto [outside, hits] = beyond_edges(tracer, -kBlunt + 0.15 * tests::kWedgeSpacing, 0.2 * tests::kWedgeSpacing);
  EXPECT_GT(hits, 100) << "discs reach beyond the edge: else there is nothing to tell";
  EXPECT_GT(outside, 0.95 * hits);
  const auto [inside, of] = beyond_edges(tracer, -kBlunt - 6 * tests::kWedgeSpacing, -kBlunt - 0.4 * tests::kWedgeSpacing);
  EXPECT_EQ(of, 2000);
  EXPECT_LT(inside, 0.01 * of);
}

TEST(Tracer, AGapInOneFaceIsNoEdge) {
  const ScratchFolder folder;
  const stream::Store store = build_test_store(square_points(50, 1.0, {0, 0, 0}, {0, 0, 1}, 7), folder.path());
  MemoryBudget budget(64u << 20);
  const Tracer tracer = trace_all(store, budget, {0, 0, 0});
  const auto [beyond, hits] = beyond_edges(tracer, 0.5 - tests::kWedgeSpacing, 0.5 + tests::kWedgeSpacing);
  EXPECT_GT(hits, 1000);
  EXPECT_EQ(beyond, 0);
}

TEST(Tracer, RefusesWhatTheBudgetDoesNotHold) {
  const ScratchFolder folder;
  const stream::Store store = build_test_store(sphere_points(60000, 1.0, {0, 0, 0}, false), folder.path());
  MemoryBudget budget(500000);
  EXPECT_THROW(trace_all(store, budget, {0, 0, 0}), Error);
  EXPECT_LE(budget.peak_bytes(), 500000u);
}

TEST(Tracer, RaysFromFarKeepTheirPrecision) {
  // A site in projected coordinates: five million metres from the origin.
  const ScratchFolder folder;
  const Vec3d site(400000, 5000000, 100);
  const stream::Store store = build_test_store(square_points(80, 1.0, site, {0, 0, 1}, 6), folder.path());
  MemoryBudget budget(64u << 20);
  const Tracer tracer = trace_all(store, budget, site + Vec3d(0, 0, 1));
  Hit hit;
  ASSERT_TRUE(tracer.closest({tracer.scene_from_world(site + Vec3d(0.01, 0.02, 1)), {0, 0, -1}, 0, 1e30f}, hit));
  EXPECT_NEAR(hit.t, 1, 1e-4f);
}

}  // namespace
}  // namespace chiaro::surfels
