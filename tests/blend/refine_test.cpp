/// New points where the photographs show more than the cloud, and what the blend makes of them.
#include "blend/refine.h"

#include <gtest/gtest.h>

#include <fstream>

#include "stream/base/error.h"
#include "stream/base/parallel.h"
#include "tests/blend/noting_reporter.h"
#include "tests/blend/stopping_reporter.h"
#include "tests/blend/workplace.h"

namespace chiaro::blend {
namespace {

using namespace testing;

/// Detail far below the spacing of the points (0.04): waves of 0.06.
AnalyticScene fine_paint() {
  AnalyticScene scene = plane_scene();
  scene.spacing = 0.04;
  scene.albedo = [](const Vec3d& p) -> Vec3f { return smooth_paint(p) + Vec3f::Constant(0.15f * static_cast<float>(std::sin(105 * p.x()) * std::sin(95 * p.y()))); };
  return scene;
}

Tolerance even_tolerance() {
  Tolerance tolerance;
  tolerance.by_class.fill(0.1f);
  return tolerance;
}

class Refine : public ::testing::Test {
 protected:
  std::vector<BlendPhotograph> photographs(double focal = 150) const {
    return {w.photograph("a", Vec3d(0.5, 0.5, 1), Vec3d(0.5, 0.5, 0), {}, focal), w.photograph("b", Vec3d(0.3, 0.5, 1.1), Vec3d(0.5, 0.5, 0), {}, focal),
            w.photograph("c", Vec3d(0.6, 0.7, 0.9), Vec3d(0.5, 0.5, 0), {}, focal)};
  }
  RefineStats find(const std::vector<BlendPhotograph>& photos, std::uint64_t most = 1u << 20, std::uint64_t memory = kPlenty, Reporter& report = silent_reporter(), const BlendOptions& options = {}) const {
    MemoryBudget budget(memory);
    const RefineStats stats = find_new_points(*w.store, photos, options, most, file(), w.folder.path() / "scratch", budget, report);
    EXPECT_EQ(budget.used_bytes(), 0u);
    EXPECT_LE(budget.peak_bytes(), memory);
    return stats;
  }
  std::filesystem::path file() const { return w.folder.path() / "new.points"; }
  std::string bytes() const {
    std::ifstream in(file(), std::ios::binary);
    return {std::istreambuf_iterator<char>(in), {}};
  }
  /// A store of the new points, blended.
  std::vector<Seen> blended(const std::vector<BlendPhotograph>& photos, BlendOptions options) {
    MemoryBudget budget(kPlenty);
    stream::CloudInput input{{"new"}, {"1"}, [&](std::size_t) { return read_new_points(file()); }, {}, "", ""};
    stream::BuildOptions build;
    build.normals = stream::NormalSource::kAxes;
    build.chunk_surfels = 1000;
    stream::build_store_from(input, w.folder.path() / "new.chiaro", build, budget, silent_reporter());
    const stream::Store cloud = std::move(*w.store);
    w.store.emplace(w.folder.path() / "new.chiaro");
    w.run(photos, std::move(options));
    return w.result();
  }
  Workplace w{fine_paint()};
};

TEST_F(Refine, NewPointsHaveTheAlbedoOfTheirOwnPlace) {
  const auto photos = photographs();
  const RefineStats stats = find(photos);
  EXPECT_GT(stats.inserted, 10000u);   // footprint 0.0067: 36 times the cloud
  EXPECT_LE(static_cast<double>(stats.inserted), 1.1 * static_cast<double>(stats.asked));
  EXPECT_GT(static_cast<double>(stats.inserted), 0.7 * static_cast<double>(stats.asked));
  EXPECT_EQ(stats.coarser, 1);
  EXPECT_EQ(stats.refined + stats.unseen + stats.fine_enough + stats.without_surface, stats.surfels);
  EXPECT_EQ(stats.fine_enough, 0u);
  EXPECT_GT(stats.refined, stats.surfels / 2);
  double error = 0;
  std::size_t seen = 0, oriented = 0;
  for (const Seen& s : blended(photos, {})) {
    ASSERT_NEAR(s.position.z(), 0, 1e-4);
    ASSERT_NEAR(std::abs(s.normal.z()), 1, 1e-3f);
    if (s.photos == 0) continue;
    ++seen;
    error += static_cast<double>(std::abs(s.albedo[0] - w.scene.albedo(s.position)[0]));
  }
  EXPECT_GT(seen, stats.inserted * 9 / 10);
  // The waves alone are 0.06 in the mean, and a colour interpolated between the cloud's points would miss all of them.
  EXPECT_LT(error / static_cast<double>(seen), 0.012);
  for (const std::uint32_t leaf : w.store->leaves()) {
    const stream::Chunk chunk = w.store->read_chunk(leaf);
    for (std::uint32_t i = 0; i < chunk.count; ++i) oriented += (chunk.surfel(i).flags & (stream::SurfelBlock::kOriented | stream::SurfelBlock::kEstimated)) != 0;
  }
  EXPECT_EQ(oriented, 0u);
}

TEST_F(Refine, WhereTheCloudIsAsFineAsThePhotographsNothingIsInserted) {
  const RefineStats stats = find(photographs(16));
  EXPECT_EQ(stats.inserted, 0u);
  EXPECT_EQ(bytes().size(), 0u);
  EXPECT_GT(stats.fine_enough, stats.surfels / 2);
}

TEST_F(Refine, TheBudgetIsKeptAndSpent) {
  const auto photos = photographs();
  for (const std::uint64_t most : {std::uint64_t{1}, std::uint64_t{1000}, std::uint64_t{4000}}) {
    const RefineStats stats = find(photos, most);
    EXPECT_LE(stats.inserted, most);
    if (most >= 1000) {
      EXPECT_GT(stats.inserted, most / 3);
    }
    EXPECT_GT(stats.coarser, 1.2);
    EXPECT_EQ(bytes().size(), 40 * stats.inserted);
  }
}

TEST_F(Refine, WhereNoStepKeepsToTheBudgetNothingIsInserted) {
  // A point through a microscope: pixels of 2 micrometres, so that the coarsest step, 3756 of them, still refines a spacing of 40 mm.
  Vec3d middle = Vec3d::Constant(1e3);
  for (const std::uint32_t leaf : w.store->leaves()) {
    const stream::Chunk chunk = w.store->read_chunk(leaf);
    for (std::uint32_t i = 0; i < chunk.count; ++i)
      if (const Vec3d p = chunk.surfel(i).position_in_world; (p - Vec3d(0.5, 0.5, 0)).norm() < (middle - Vec3d(0.5, 0.5, 0)).norm()) middle = p;
  }
  const std::vector<BlendPhotograph> photos{w.photograph("near", middle + Vec3d(0, 0, 1), middle, {}, 5e5)};
  NotingReporter report;
  const RefineStats stats = find(photos, 1, kPlenty, report);
  EXPECT_EQ(stats.inserted, 0u);
  EXPECT_EQ(stats.refined, 0u);
  EXPECT_GE(stats.over_budget, 1u);
  EXPECT_EQ(stats.over_budget + stats.unseen + stats.fine_enough + stats.without_surface, stats.surfels);
  EXPECT_NE(report.notes.find("refine: none inserted: points 3756 times"), std::string::npos) << report.notes;
  stream::PointBlock block;
  EXPECT_FALSE(read_new_points(file())->read(block, 10));   // there is a file, and it says so
  const RefineStats enough = find(photos);
  EXPECT_GT(enough.inserted, 8u);
  EXPECT_EQ(enough.over_budget, 0u);
}

TEST_F(Refine, ResultsDoNotDependOnThreadsMemoryOrOrder) {
  auto photos = photographs();
  find(photos, 5000);
  const std::string reference = bytes();
  ASSERT_GT(reference.size(), 40000u);
  std::reverse(photos.begin(), photos.end());
  for (const int threads : {1, 5}) {
    const ThreadLimit limit(threads);
    find(photos, 5000, 24u << 20);
    EXPECT_EQ(bytes(), reference) << threads;
  }
}

TEST_F(Refine, BordersOfChunksLeaveNoTrace) {
  const auto inserted = [](const Workplace& place) {
    MemoryBudget budget(kPlenty);
    const std::filesystem::path path = place.folder.path() / "new.points";
    const std::vector<BlendPhotograph> photos{place.photograph("a", Vec3d(0.5, 0.5, 1), Vec3d(0.5, 0.5, 0))};
    find_new_points(*place.store, photos, {}, 1u << 20, path, place.folder.path() / "scratch", budget, silent_reporter());
    stream::PointBlock block;
    read_new_points(path)->read(block, 1u << 20);
    return block.position;
  };
  const Workplace parts{fine_paint(), true, 64}, whole{fine_paint(), true, 60000};
  ASSERT_GT(parts.store->leaves().size(), 8u);
  ASSERT_EQ(whole.store->leaves().size(), 1u);
  const std::vector<Vec3d> a = inserted(parts), b = inserted(whole);
  ASSERT_GT(b.size(), 1000u);
  // Stored positions differ by their steps: a point or two may fall to another disc.
  EXPECT_NEAR(static_cast<double>(a.size()), static_cast<double>(b.size()), 0.005 * static_cast<double>(b.size()));
  std::size_t apart = 0;
  for (const Vec3d& p : b) apart += std::none_of(a.begin(), a.end(), [&](const Vec3d& q) { return (p - q).norm() < 1e-4; });
  EXPECT_LE(apart, b.size() / 200);
}

TEST_F(Refine, WhatIsStoppedGoesOn) {
  const auto photos = photographs();
  find(photos, 5000);
  const std::string reference = bytes();
  std::filesystem::remove(file());
  const int stops = stops_until_done(2, 1, [&](Reporter& report, int) { find(photos, 5000, kPlenty, report); }, [&] { EXPECT_FALSE(std::filesystem::exists(file())); });
  EXPECT_GT(stops, 2);
  EXPECT_EQ(bytes(), reference);
}

TEST_F(Refine, FactorsAndPlacesAreTakenFromTheCloudsBlend) {
  std::vector<BlendPhotograph> photos = photographs();
  photos.push_back(w.photograph("d", Vec3d(0.5, 0.4, 1), Vec3d(0.5, 0.5, 0), gained(1.5f)));
  find(photos);
  BlendOptions options;
  options.known = Findings{{{1, 1, 1}, {1, 1, 1}, {1, 1, 1}, {1 / 1.5, 1 / 1.5, 1 / 1.5}}, std::vector<Alignment>(4), 0.01, even_tolerance()};
  const auto right = blended(photos, options);
  double error = 0, seen = 0;
  for (const Seen& s : right)
    if (s.photos == 4) error += static_cast<double>(std::abs(s.albedo[0] - w.scene.albedo(s.position)[0])), ++seen;
  EXPECT_GT(seen, 5000);
  EXPECT_LT(error / seen, 0.012);
  // They belong to their photographs, in whatever order these come.
  options.known->alignment[3] = {Vec2f(0.5f, 0), 0.5f};
  w.run(photos, options);
  const auto in_order = w.bytes();
  BlendOptions backwards = options;
  std::reverse(backwards.known->gain.begin(), backwards.known->gain.end());
  std::reverse(backwards.known->alignment.begin(), backwards.known->alignment.end());
  w.run({photos.rbegin(), photos.rend()}, backwards);
  EXPECT_EQ(w.bytes(), in_order);
  options.known->alignment[3] = {};
  // And what is said there is believed, also where it is wrong.
  options.known->gain[0] = options.known->gain[1] = options.known->gain[2] = {2, 2, 2};
  options.known->gain[3] = {2 / 1.5, 2 / 1.5, 2 / 1.5};
  w.run(photos, options);
  double factor = 0;
  seen = 0;
  for (const Seen& s : w.result())
    if (s.photos == 4) factor += static_cast<double>(s.albedo[0] / w.scene.albedo(s.position)[0]), ++seen;
  EXPECT_NEAR(factor / seen, 2, 0.02);
}

TEST_F(Refine, APhotographIsReadWhereTheCloudsBlendHasFoundIt) {
  const std::vector<BlendPhotograph> photos{photographs()[0]};
  BlendOptions options;
  options.known = Findings{{{1, 1, 1}}, {{Vec2f(5, -3), 1}}, 0.01, even_tolerance()};
  const stream::Camera& camera = photos[0].camera;
  find(photos);
  double error = 0, seen = 0;
  for (const Seen& s : blended(photos, options)) {
    if (s.photos == 0 || (s.position - Vec3d(0.5, 0.5, 0)).cwiseAbs().maxCoeff() > 0.25) continue;
    const Vec2d pixel = *stream::project(camera.lens, camera.pose.camera_from_world(s.position)) + Vec2d(5, -3);
    const Vec3d eye = camera.pose.centre_in_world(), direction = camera.pose.rotation_camera_from_world.transpose() * *stream::unproject(camera.lens, pixel);
    error += static_cast<double>(std::abs(s.albedo[0] - w.scene.albedo(eye - eye.z() / direction.z() * direction)[0]));
    ++seen;
  }
  EXPECT_GT(seen, 2000);
  EXPECT_LT(error / seen, 0.012);
}

TEST_F(Refine, WhatIsKnownHasToFitThePhotographs) {
  BlendOptions options;
  options.known = Findings{{{1, 1, 1}}, std::vector<Alignment>(1), 0.01, even_tolerance()};
  EXPECT_THROW(w.run(photographs(), options), std::invalid_argument);
  options.keep = w.folder.path() / "kept";
  EXPECT_THROW(w.run({photographs()[0]}, options), std::invalid_argument);
}

TEST_F(Refine, AFileOfNewPointsThatEndsEarlyIsRefused) {
  find(photographs(), 1000);
  std::filesystem::resize_file(file(), std::filesystem::file_size(file()) - 7);
  EXPECT_THROW(read_new_points(file()), Error);
}

}  // namespace
}  // namespace chiaro::blend
