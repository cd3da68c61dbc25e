#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <cmath>
#include <map>
#include <numbers>
#include <set>
#include <sstream>

#include "stream/base/error.h"
#include "stream/base/file.h"
#include "stream/base/parallel.h"
#include "stream/cloud/point_stream.h"
#include "tools/command.h"
#include "tools/commands.h"
#include "tools/synth_surfaces.h"
#include "tools/synth_write.h"

namespace chiaro::tools {
namespace {
using testing::HasSubstr;

const char* const kAll[] = {"sphere", "statue", "wall", "room", "duplicates", "outlier", "volume", "line"};

TEST(SynthSpec, ReadsParametersAndNamesMistakes) {
  const SynthSpec s = parse_synth_spec("statue:noise=0.0005,seed=7,normals=false,order=scan,scale=2,offset=500000");
  EXPECT_EQ(s.kind, SynthKind::kStatue);
  EXPECT_EQ(s.noise_m, 0.0005);
  EXPECT_EQ(s.seed, 7u);
  EXPECT_FALSE(s.normals);
  EXPECT_TRUE(s.scan_order);
  EXPECT_EQ(s.scale, 2);
  EXPECT_EQ(s.offset_m, 500000);
  for (const char* bad : {"", "statute", "statue:", "statue:noise", "statue:noise=", "statue:noise=-1", "statue:noise=nan", "statue:nose=1", "wall:order=scam", "wall:seed=1.5", "wall:scale=0", "wall:,"})
    EXPECT_THROW(parse_synth_spec(bad), UsageError) << bad;
  try {
    parse_synth_spec("wal");
    FAIL();
  } catch (const UsageError& e) {
    EXPECT_THAT(e.what(), HasSubstr("did you mean \"wall\""));
  }
}

TEST(IndexShuffle, TakesEveryIndexOnce) {
  for (const std::uint64_t count : {1u, 2u, 3u, 17u, 4096u, 10007u}) {
    const IndexShuffle shuffle(count, 5);
    std::set<std::uint64_t> seen;
    for (std::uint64_t i = 0; i < count; ++i) seen.insert(shuffle(i));
    EXPECT_EQ(seen.size(), count);
    EXPECT_LT(*seen.rbegin(), count);
  }
}

TEST(IndexShuffle, LeavesNoOrder) {
  constexpr std::uint64_t kCount = 20000;
  const IndexShuffle shuffle(kCount, 1);
  double products = 0;
  for (std::uint64_t i = 0; i + 1 < kCount; ++i) products += (static_cast<double>(shuffle(i)) / kCount - 0.5) * (static_cast<double>(shuffle(i + 1)) / kCount - 0.5);
  // Independent uniforms: mean 0, standard deviation 1/12 / sqrt(n).
  EXPECT_LT(std::abs(products / kCount), 4.0 / 12 / std::sqrt(static_cast<double>(kCount)));
}

TEST(SynthSurfaces, GradientsAgreeWithDifferences) {
  constexpr double h = 1e-6;
  for (int i = 0; i < 200; ++i) {
    const Vec3d d = Vec3d(std::sin(1.3 * i), std::cos(2.1 * i), std::sin(0.7 * i + 1)).normalized();
    const StarRadius s = statue_radius(d);
    for (int c = 0; c < 3; ++c) {
      const Vec3d e = h * Vec3d::Unit(c);
      EXPECT_NEAR(s.gradient[c], (statue_radius(d + e).radius - statue_radius(d - e).radius) / (2 * h), 1e-6);
    }
    EXPECT_GT(s.radius, 0.1);
    const double x = 1.9 * std::sin(3.3 * i), y = 1.4 * std::cos(1.7 * i);
    const ReliefHeight w = wall_relief(x, y);
    EXPECT_NEAR(w.dx, (wall_relief(x + h, y).height - wall_relief(x - h, y).height) / (2 * h), 2e-3);
    EXPECT_NEAR(w.dy, (wall_relief(x, y + h).height - wall_relief(x, y - h).height) / (2 * h), 2e-3);
  }
}

TEST(SynthScene, PointsLieOnTheSurface) {
  for (const char* name : {"sphere", "statue", "wall", "room", "duplicates", "line", "volume"}) {
    const SynthScene scene(parse_synth_spec(name), 5000);
    for (std::uint64_t i = 0; i < 5000; ++i) ASSERT_LT(scene.distance_to_surface(scene.point(i).position), 1e-9) << name << " " << i;
  }
}

TEST(SynthScene, NoiseHasItsSizeAndItsDirection) {
  const SynthScene scene(parse_synth_spec("wall:noise=0.002,scale=3,offset=1000"), 20000);
  const SynthScene clean(parse_synth_spec("wall:scale=3,offset=1000"), 20000);
  double squares = 0;
  for (std::uint64_t i = 0; i < 20000; ++i) {
    const Vec3d moved = scene.point(i).position - clean.point(i).position;
    const double along = moved.dot(clean.point(i).normal.cast<double>());
    EXPECT_LT((moved - along * clean.point(i).normal.cast<double>()).norm(), 1e-8);
    squares += along * along;
  }
  // The standard deviation of a standard deviation is sigma / sqrt(2 n).
  EXPECT_NEAR(std::sqrt(squares / 20000), 0.002, 4 * 0.002 / std::sqrt(2.0 * 20000));
}

TEST(SynthScene, EveryPointIsWithinTheBoundsAndIsAFunctionOfItsIndex) {
  for (const char* name : kAll)
    for (const char* parameters : {":noise=0.01", ":scale=7,offset=-300,order=scan"}) {
      const SynthScene scene(parse_synth_spec(std::string(name) + parameters), 3000);
      const Box3d box = scene.bounds();
      for (std::uint64_t i = 0; i < 3000; ++i) {
        const SynthPoint p = scene.point(i);
        ASSERT_TRUE((p.position.array() >= box.min.array()).all() && (p.position.array() <= box.max.array()).all()) << name << parameters;
        ASSERT_NEAR(p.normal.norm(), 1, 1e-5);
        ASSERT_EQ(p.position, scene.point(i).position);
      }
    }
}

TEST(SynthScene, AlbedoFollowsItsFormula) {
  const SynthScene scene(parse_synth_spec("sphere:scale=2,offset=10"), 100);
  for (std::uint64_t i = 0; i < 100; ++i) {
    const SynthPoint p = scene.point(i);
    const Vec3d q = (p.position - Vec3d(10, 10, 1)) / 2;
    EXPECT_NEAR(p.albedo[0], 0.45 + 0.30 * std::sin(12 * q.x() + 7 * q.y()), 1e-6);
    EXPECT_NEAR(p.albedo[2], 0.45 + 0.30 * std::sin(11 * q.z() - 6 * q.x() + 4), 1e-6);
  }
}

/// Chi-squared of counts in cells against their expectation; for stratified points it lies below that of independent ones, never above.
double chi_squared(const std::vector<double>& found, const std::vector<double>& expected) {
  double sum = 0;
  for (std::size_t i = 0; i < found.size(); ++i) sum += (found[i] - expected[i]) * (found[i] - expected[i]) / expected[i];
  return sum;
}

TEST(SynthScene, DensityOnTheSphereIsEven) {
  constexpr std::uint64_t kPoints = 200000;
  const SynthScene scene(parse_synth_spec("sphere"), kPoints);
  EXPECT_NEAR(scene.area_m2(), 4 * std::numbers::pi, 1e-9);
  // Slabs of equal height have equal areas, along any axis: this one is skew to the patches.
  const Vec3d axis = Vec3d(1, 2, -1).normalized();
  constexpr int kSlabs = 100;
  std::vector<double> found(kSlabs);
  for (std::uint64_t i = 0; i < kPoints; ++i) ++found[static_cast<std::size_t>(std::min(kSlabs - 1.0, (scene.point(i).position.dot(axis) + 1) / 2 * kSlabs))];
  EXPECT_LT(chi_squared(found, std::vector<double>(kSlabs, kPoints / double{kSlabs})), kSlabs + 4 * std::sqrt(2.0 * kSlabs));
}

TEST(SynthScene, DensityOnTheWallFollowsItsArea) {
  // The share of points on steep flanks is the flanks' share of the area, not of the plan.
  constexpr std::uint64_t kPoints = 300000;
  const SynthScene scene(parse_synth_spec("wall"), kPoints);
  constexpr int kGrid = 3000;
  double area = 0, steep = 0;
  for (int i = 0; i < kGrid; ++i)
    for (int j = 0; j < 600; ++j) {
      const ReliefHeight h = wall_relief(((i + 0.5) / kGrid - 0.5) * kWallWidth, ((j + 0.5) / 600 - 0.5) * 0.9);   // a strip of twelve courses
      const double a = std::sqrt(1 + h.dx * h.dx + h.dy * h.dy);
      area += a;
      if (a > 1.3) steep += a;
    }
  double found = 0, counted = 0;
  for (std::uint64_t i = 0; i < kPoints; ++i) {
    const SynthPoint p = scene.point(i);
    if (std::abs(p.position.y()) > 0.45) continue;
    ++counted;
    found += p.normal.z() < 1 / 1.3f;
  }
  const double expected = steep / area;
  EXPECT_NEAR(found / counted, expected, 4 * std::sqrt(expected / counted));
  EXPECT_NEAR(counted / kPoints, 0.3, 0.01);
}

TEST(SynthScene, DensityOnTheStatueIsEven) {
  // In each of many directions, points over solid angle against area over solid angle.
  constexpr std::uint64_t kPoints = 200000;
  const SynthScene scene(parse_synth_spec("statue"), kPoints);
  constexpr int kRows = 12, kColumns = 12, kSub = 24;
  const auto sheets = statue_sheets();
  std::vector<double> found(kRows * kColumns), expected(kRows * kColumns);
  double sum = 0;
  for (int cell = 0; cell < kRows * kColumns; ++cell)
    for (int s = 0; s < kSub * kSub; ++s) {
      const double a = sheets[0]->at((cell % kColumns + (s % kSub + 0.5) / kSub) / kColumns, (cell / kColumns + (s / kSub + 0.5) / kSub) / kRows).stretch;
      expected[static_cast<std::size_t>(cell)] += a;
      sum += a;
    }
  for (double& e : expected) e *= kPoints / sum;
  EXPECT_NEAR(scene.area_m2(), sum / (kRows * kColumns * kSub * kSub), 2e-3 * scene.area_m2());
  for (std::uint64_t i = 0; i < kPoints; ++i) {
    const Vec3d d = scene.point(i).position.normalized();
    double u = std::atan2(d.y(), d.x()) / (2 * std::numbers::pi);
    if (u < 0) u += 1;
    const int column = std::min(kColumns - 1, static_cast<int>(u * kColumns)), row = std::min(kRows - 1, static_cast<int>((d.z() + 1) / 2 * kRows));
    ++found[static_cast<std::size_t>(row * kColumns + column)];
  }
  EXPECT_LT(chi_squared(found, expected), kRows * kColumns + 4 * std::sqrt(2.0 * kRows * kColumns));
}

TEST(SynthScene, RoomHasNoPointsWhereColumnsStand) {
  const SynthScene scene(parse_synth_spec("room"), 50000);
  const double columns = 6 * 2 * std::numbers::pi * kColumnRadius * kRoomHeight;
  const double whole = 2 * (kRoomLength * kRoomWidth + kRoomLength * kRoomHeight + kRoomWidth * kRoomHeight) - 12 * std::numbers::pi * kColumnRadius * kColumnRadius + columns;
  EXPECT_NEAR(scene.area_m2(), whole, 1e-3 * whole);
  double on_columns = 0;
  for (std::uint64_t i = 0; i < 50000; ++i) {
    const Vec3d p = scene.point(i).position;
    for (const Vec2d& c : room_columns()) {
      const double r = (p.head<2>() - c).norm();
      EXPECT_GT(r, kColumnRadius - 1e-6);
      on_columns += r < kColumnRadius + 1e-6 && std::abs(p.z()) < kRoomHeight / 2 - 1e-6;
    }
  }
  EXPECT_NEAR(on_columns / 50000, columns / whole, 0.005);
}

TEST(SynthScene, DuplicatesAndOutliersAreAsManyAsAskedFor) {
  const SynthScene copies(parse_synth_spec("duplicates:share=0.002"), 10000);
  std::map<std::array<double, 3>, int> positions;
  for (std::uint64_t i = 0; i < 10000; ++i) {
    const Vec3d p = copies.point(i).position;
    ++positions[{p.x(), p.y(), p.z()}];
  }
  EXPECT_EQ(positions.size(), 20u);
  for (const auto& [p, n] : positions) EXPECT_EQ(n, 500);

  const SynthScene far(parse_synth_spec("outlier:share=0.0005,distance=5e4"), 10000);
  int outliers = 0;
  for (std::uint64_t i = 0; i < 10000; ++i) outliers += far.point(i).position.norm() > 1e4;
  EXPECT_EQ(outliers, 5);
}

TEST(SynthScene, ScanOrderKeepsNeighboursTogether) {
  const auto mean_step = [](const char* spec) {
    const SynthScene scene(parse_synth_spec(spec), 100000);
    double sum = 0;
    for (std::uint64_t i = 0; i < 2000; ++i) sum += (scene.point(40000 + i + 1).position - scene.point(40000 + i).position).norm();
    return sum / 2000;
  };
  EXPECT_LT(mean_step("sphere:order=scan"), 0.2);
  EXPECT_GT(mean_step("sphere"), 1.0);
}

TEST(SynthScene, ABillionPointsCostNoMore) {
  const SynthScene scene(parse_synth_spec("statue"), 1'000'000'000);
  for (std::uint64_t i = 0; i < 1000; ++i) EXPECT_LT(scene.distance_to_surface(scene.point(i * 999'983).position), 1e-9);
}

TEST(SynthWrite, FilesHoldExactlyWhatTheSceneHas) {
  const ScratchFolder scratch;
  for (const char* name : {"a.ply", "a.las", "a.pcd"}) {
    const SynthScene scene(parse_synth_spec("statue:noise=0.001"), 3001);
    const SynthResult result = write_synth(scene, scratch.path() / name, true, silent_reporter());
    EXPECT_EQ(result.points, 3001u);
    const auto reader = stream::open_points(scratch.path() / name);
    stream::PointBlock block;
    std::uint64_t index = 0;
    while (reader->read(block, 1000))
      for (std::size_t i = 0; i < block.size(); ++i, ++index) ASSERT_LT((block.position[i] - scene.point(index).position).norm(), 1e-4) << name;
    EXPECT_EQ(index, 3001u) << name;
  }
}

TEST(SynthWrite, IsTheSameForTheSameSeedAndAnyThreads) {
  const ScratchFolder scratch;
  const auto bytes = [&](const char* spec, int threads) {
    const ThreadLimit limit(threads);
    write_synth(SynthScene(parse_synth_spec(spec), 20000), scratch.path() / "x.ply", true, silent_reporter());
    return read_text(scratch.path() / "x.ply");
  };
  const std::string one = bytes("room:seed=3,noise=0.01", 1);
  EXPECT_EQ(bytes("room:seed=3,noise=0.01", 8), one);
  EXPECT_NE(bytes("room:seed=4,noise=0.01", 1), one);
}

TEST(SynthWrite, TakesDoublesWhereFloatsAreTooCoarse) {
  const ScratchFolder scratch;
  const auto is_double = [&](const char* spec) {
    write_synth(SynthScene(parse_synth_spec(spec), 1000), scratch.path() / "x.ply", false, silent_reporter());
    return stream::open_points(scratch.path() / "x.ply")->schema().position_is_double;
  };
  EXPECT_FALSE(is_double("sphere"));
  EXPECT_TRUE(is_double("sphere:offset=5000000"));
}

TEST(SynthCommand, RefusesWhatItCannotWrite) {
  const ScratchFolder scratch;
  std::ostringstream out, err;
  Console console(out, err);
  const auto run = [&](std::vector<std::string> words) { return run_synth(words, console); };
  EXPECT_THROW(run({"sphere", "--points", "10", "--out", (scratch.path() / "a.xyz").string()}), Error);
  EXPECT_THROW(run({"sphere", "--points", "0", "--out", (scratch.path() / "a.ply").string()}), UsageError);
  EXPECT_THROW(run({"sphere", "--points", "10"}), UsageError);
  EXPECT_THROW(run({"sphere", "--points", "1000000000000", "--out", (scratch.path() / "a.ply").string()}), Error);
  EXPECT_TRUE(std::filesystem::is_empty(scratch.path()));
  EXPECT_EQ(run({"sphere", "--points", "10", "--out", (scratch.path() / "a.ply").string()}), 0);
  EXPECT_THAT(out.str(), HasSubstr("10 points"));
  EXPECT_EQ(run({"--help"}), 0);
  for (const char* name : kAll) EXPECT_THAT(out.str(), HasSubstr(name));
}

}  // namespace
}  // namespace chiaro::tools
