#include "surfels/working_set.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>

#include "stream/base/file.h"
#include "stream/base/parallel.h"
#include "stream/base/rng.h"
#include "surfels/frustum.h"
#include "surfels/occlusion.h"
#include "surfels/tracer.h"
#include "tests/support/sampled_surface.h"

namespace chiaro::surfels {
namespace {

constexpr std::uint64_t kRoom = 256u << 20;

/// Looks from `eye` to `target`, a flash beside it.
View view_to(const Vec3d& eye, const Vec3d& target, int width, int height, double focal) {
  View v;
  v.lens.width_px = width;
  v.lens.height_px = height;
  v.lens.fx = v.lens.fy = focal;
  v.lens.cx = width / 2.0;
  v.lens.cy = height / 2.0;
  const Vec3d forward = (target - eye).normalized(), right = forward.unitOrthogonal(), down = forward.cross(right);
  v.pose.rotation_camera_from_world << right.transpose(), down.transpose(), forward.transpose();
  v.pose.translation_camera_from_world = -v.pose.rotation_camera_from_world * eye;
  v.rect = {0, 0, width, height};
  v.lights_in_world.push_back(v.pose.world_from_camera({0.15, -0.1, 0}));
  return v;
}

/// A wall at z = 0 with a slit and a window, three walls behind it and a ball between them.
stream::Store walls(const std::filesystem::path& folder, std::uint32_t chunk_surfels = 1024) {
  std::vector<tests::SampledPoint> points;
  for (const auto& p : tests::square_points(260, 4.0, {0, 0, 0}, {0, 0, 1}, 1)) {
    const bool slit = std::fabs(p.position.x() + 0.7) < 0.05, window = std::fabs(p.position.x() - 0.6) < 0.2 && std::fabs(p.position.y()) < 0.2;
    if (!slit && !window) points.push_back(p);
  }
  for (int wall = 1; wall <= 3; ++wall) {
    const auto more = tests::square_points(200, 6.0, {0, 0, -0.8 * wall}, {0, 0, 1}, static_cast<std::uint64_t>(wall) + 1);
    points.insert(points.end(), more.begin(), more.end());
  }
  const auto ball = tests::sphere_points(20000, 0.25, {0.6, 0, -0.4}, false);
  points.insert(points.end(), ball.begin(), ball.end());
  return tests::build_test_store(points, folder, chunk_surfels);
}

Tracer trace(const stream::Store& store, const std::vector<std::uint32_t>& chunks, MemoryBudget& budget, const Vec3d& origin) {
  Tracer tracer(origin, budget);
  for (const std::uint32_t c : chunks) tracer.add(store.read_chunk(c));
  tracer.commit();
  return tracer;
}

TEST(WorkingSet, LosesNothingThatAPixelOrTheFlashMeets) {
  const ScratchFolder folder;
  const stream::Store store = walls(folder.path());
  std::uint64_t hidden = 0;
  for (std::uint64_t seed = 0; seed < 6; ++seed) {
    const auto u = uniform01x4(7, Purpose::kTest, seed, 0);
    const View view = view_to({4.0 * u[0] - 2, 3.0 * u[1] - 1.5, 1.5 + u[2]}, {0.8 * u[3] - 0.4, 0, 0}, 400, 300, 500);
    MemoryBudget budget(kRoom);
    CutOptions options;
    const WorkingSet seen = select_visible(store, view, options, budget, silent_reporter());
    options.cull_hidden = false;
    const WorkingSet all = select_visible(store, view, options, budget, silent_reporter());
    ASSERT_TRUE(std::includes(all.chunks.begin(), all.chunks.end(), seen.chunks.begin(), seen.chunks.end()));
    EXPECT_EQ(seen.chunks.size() + seen.chunks_hidden, all.chunks.size());
    hidden += seen.chunks_hidden;
    const Vec3d eye = view.pose.centre_in_world();
    const Tracer of_seen = trace(store, seen.chunks, budget, eye), of_all = trace(store, all.chunks, budget, eye);
    const Vec3f flash = of_all.scene_from_world(view.lights_in_world[0]);
    for (int y = 0; y < 300; y += 2)
      for (int x = 0; x < 400; x += 2) {
        const Vec3f d = (view.pose.rotation_camera_from_world.transpose() * *stream::unproject(view.lens, {x + 0.5, y + 0.5})).normalized().cast<float>();
        Hit a, b;
        const bool met = of_all.closest({Vec3f::Zero(), d, 0, 1e30f}, a);
        ASSERT_EQ(met, of_seen.closest({Vec3f::Zero(), d, 0, 1e30f}, b)) << "seed " << seed << ", pixel " << x << ' ' << y;
        if (!met) continue;
        ASSERT_EQ(a.surfel, b.surfel) << "seed " << seed << ", pixel " << x << ' ' << y;
        ASSERT_EQ(a.t, b.t);
        const Vec3f p = d * a.t, to_flash = flash - p;
        const Ray back = escape_ray(p, a.normal, a.radius, to_flash.normalized(), to_flash.norm());
        ASSERT_EQ(of_all.occluded(back), of_seen.occluded(back)) << "seed " << seed << ", pixel " << x << ' ' << y;
      }
  }
  EXPECT_GT(hidden, 300u);   // of some 260 a view
}

// The flash's cone is no wider than what the nearest surface in view makes of its place.
TEST(WorkingSet, ABandOfRowsKeepsWhatCastsShadowsIntoIt) {
  const ScratchFolder folder;
  const stream::Store store = walls(folder.path(), 64);
  std::size_t of_band = 0, of_all = 0;
  int dark = 0, slipped = 0;   // between two discs
  for (const auto& [eye, target] : {std::pair(Vec3d(0.3, 0.2, 2), Vec3d(0.42, 0, 0)), std::pair(Vec3d(-0.9, -0.4, 2), Vec3d(-0.7, 0, 0)), std::pair(Vec3d(0.5, 0.1, 2.2), Vec3d(0.5, 0, 0))}) {
    View whole = view_to(eye, target, 400, 300, 500);
    whole.lights_in_world = {whole.pose.world_from_camera({0.5, -0.35, 0})};   // far enough for its shadows to be cast from outside the band
    View band = whole;
    band.rect = {0, 130, 400, 160};
    MemoryBudget budget(kRoom);
    CutOptions options;
    const WorkingSet some = select_visible(store, band, options, budget, silent_reporter());
    options.cull_hidden = false;
    options.margin_px = 200;
    const WorkingSet all = select_visible(store, whole, options, budget, silent_reporter());
    of_band += some.chunks.size();
    of_all += all.chunks.size();
    const Tracer of_some = trace(store, some.chunks, budget, eye), of_whole = trace(store, all.chunks, budget, eye);
    const Vec3f flash = of_whole.scene_from_world(whole.lights_in_world[0]);
    for (int y = 130; y < 160; ++y)
      for (int x = 0; x < 400; ++x) {
        const Vec3f d = (whole.pose.rotation_camera_from_world.transpose() * *stream::unproject(whole.lens, {x + 0.5, y + 0.5})).normalized().cast<float>();
        Hit a, b;
        const bool met = of_whole.closest({Vec3f::Zero(), d, 0, 1e30f}, a);
        if (met != of_some.closest({Vec3f::Zero(), d, 0, 1e30f}, b) || (met && a.surfel != b.surfel)) {
          ++slipped;
          continue;
        }
        if (!met) continue;
        const Vec3f to_flash = flash - d * a.t;
        const Ray back = escape_ray(d * a.t, a.normal, a.radius, to_flash.normalized(), to_flash.norm());
        const bool is_dark = of_whole.occluded(back);
        slipped += is_dark != of_some.occluded(back);
        dark += is_dark;
      }
  }
  std::printf("dark %d, slipped %d\n", dark, slipped);
  EXPECT_GT(dark, 1000);
  EXPECT_LT(slipped, 10);   // of 36 000
  EXPECT_LT(2 * of_band, of_all);
}

// A twig beside the camera, outside its picture and near the flash, whose shadow falls on the picture's edge.
TEST(WorkingSet, TakesWhatStandsBetweenTheFlashAndTheEdgeOfThePicture) {
  View view = view_to({0, 0, 4}, {0, 0, 0}, 400, 300, 500);
  const Vec3d flash(0.4, 0, 0), edge(-1.59, 0, 4);   // camera frame; the picture ends at slopes of 0.4
  view.lights_in_world = {view.pose.world_from_camera(flash)};
  const Vec3d twig = view.pose.world_from_camera(flash + 0.08 * (edge - flash));
  const ScratchFolder folder;
  auto points = tests::square_points(300, 8.0, {0, 0, 0}, {0, 0, 1}, 1);
  const auto more = tests::square_points(6, 0.008, twig, {0, 0, 1}, 2);
  points.insert(points.end(), more.begin(), more.end());
  const stream::Store store = tests::build_test_store(points, folder.path(), 256);
  MemoryBudget budget(kRoom);
  CutOptions options;
  options.cull_hidden = false;
  const auto takes_twig = [&](const View& v) {
    const WorkingSet set = select_visible(store, v, options, budget, silent_reporter());
    return std::any_of(set.chunks.begin(), set.chunks.end(), [&](std::uint32_t c) { return distance_to_box(twig, store.bounds(c)) < 0.005; });
  };
  EXPECT_TRUE(takes_twig(view));
  view.lights_in_world.clear();
  EXPECT_FALSE(takes_twig(view));   // it is not in the picture itself
}

/// Everything that the store holds, at the same levels.
WorkingSet everything(const stream::Store& store, const View& view, MemoryBudget& budget) {
  CutOptions options;
  options.cull_hidden = false;
  options.margin_px = 50 * view.lens.fx;   // wider than a half-space
  return select_visible(store, view, options, budget, silent_reporter());
}

struct Answers {
  int pixels = 0, dark = 0, differ = 0;
  int slipped = 0;   ///< camera rays that go between two discs of what hides the rest
};

/// What pixels of the view's rectangle show, and whether their light does: by `some` chunks and by `all`.
Answers compare_sets(const stream::Store& store, const View& view, const WorkingSet& some, const WorkingSet& all, int step, MemoryBudget& budget) {
  const Vec3d eye = view.pose.centre_in_world();
  const Tracer of_some = trace(store, some.chunks, budget, eye), of_all = trace(store, all.chunks, budget, eye);
  const Vec3f light = of_all.scene_from_world(view.lights_in_world[0]);
  Answers n;
  for (int y = view.rect.y0; y < view.rect.y1; y += step)
    for (int x = view.rect.x0; x < view.rect.x1; x += step) {
      const Vec3f d = (view.pose.rotation_camera_from_world.transpose() * *stream::unproject(view.lens, {x + 0.5, y + 0.5})).normalized().cast<float>();
      Hit a, b;
      const bool met = of_all.closest({Vec3f::Zero(), d, 0, 1e30f}, a);
      ++n.pixels;
      if (met != of_some.closest({Vec3f::Zero(), d, 0, 1e30f}, b) || (met && a.surfel != b.surfel)) {
        ++n.slipped;
        continue;
      }
      if (!met) continue;
      const Vec3f p = d * a.t, to_light = light - p;
      if (!(a.normal.dot(to_light) > 0)) continue;
      const Ray back = escape_ray(p, a.normal, a.radius, to_light.normalized(), to_light.norm());
      const bool dark = of_all.occluded(back);
      n.dark += dark;
      n.differ += dark != of_some.occluded(back);
    }
  return n;
}

// Lamps that stand anywhere: far to the side, near the walls, between them, behind the camera, beside the ball.
TEST(WorkingSet, LosesNothingThatALampAnywhereMeets) {
  const ScratchFolder folder;
  const stream::Store store = walls(folder.path());
  MemoryBudget budget(kRoom);
  Answers sum;
  std::size_t kept = 0, whole = 0;
  std::uint64_t hidden = 0;
  for (const Vec3d& lamp : {Vec3d(6, 0.3, 0.4), Vec3d(-1.5, -4, 0.3), Vec3d(0.1, 0.2, 0.15), Vec3d(-0.5, 0.4, -0.4), Vec3d(0.6, 0, -0.1), Vec3d(1, 5, 8), Vec3d(0.9, 0.3, -5), Vec3d(0.6, 0, -0.4)}) {
    View view = view_to({0.5, 0.1, 1.8}, {0.2, 0, 0}, 400, 300, 500);
    view.lights_in_world = {lamp};
    for (const int rows : {300, 40}) {
      view.rect = {0, 150 - rows / 2, 400, 150 + rows / 2};
      const WorkingSet some = select_visible(store, view, {}, budget, silent_reporter()), all = everything(store, view, budget);
      ASSERT_TRUE(std::includes(all.chunks.begin(), all.chunks.end(), some.chunks.begin(), some.chunks.end()));
      EXPECT_EQ(all.chunks_outside, 0u);
      const Answers n = compare_sets(store, view, some, all, rows > 40 ? 2 : 1, budget);
      EXPECT_EQ(n.differ, 0) << "lamp at " << lamp.transpose() << ", " << rows << " rows";
      sum.pixels += n.pixels;
      sum.dark += n.dark;
      sum.slipped += n.slipped;
      kept += some.chunks.size();
      whole += all.chunks.size();
      hidden += some.chunks_hidden;
    }
  }
  std::printf("%d of %d dark, %d slipped; %zu of %zu chunks, %llu hidden\n", sum.dark, sum.pixels, sum.slipped, kept, whole, static_cast<unsigned long long>(hidden));
  EXPECT_GT(sum.dark, 4000);
  EXPECT_LT(sum.slipped, sum.pixels / 5000);
  EXPECT_LT(2 * kept, whole);
  EXPECT_GT(hidden, 1000u);
}

// A plate far to the side of the picture, that a lamp farther still throws into it.
TEST(WorkingSet, TakesWhatALampFarToTheSideThrowsIntoThePicture) {
  const ScratchFolder folder;
  auto points = tests::square_points(300, 8.0, {0, 0, 0}, {0, 0, 1}, 1);
  const Vec3d plate(3, 0, 0.6);
  for (const Vec3d& side : {Vec3d(1, 0, 0), Vec3d(-1, 0, 0)}) {   // a plate that casts, and one on the other side that does not
    const auto more = tests::square_points(60, 0.2, plate.cwiseProduct(Vec3d(side.x(), 1, 1)), side, 2);
    points.insert(points.end(), more.begin(), more.end());
  }
  const stream::Store store = tests::build_test_store(points, folder.path(), 128);
  MemoryBudget budget(kRoom);
  View view = view_to({0, 0, 3}, {0, 0, 0}, 200, 150, 200);   // shows 3 m of the ground
  view.lights_in_world = {Vec3d(5, 0, 1)};
  const auto takes = [&](const View& v, const Vec3d& p) {
    const WorkingSet set = select_visible(store, v, {}, budget, silent_reporter());
    return std::any_of(set.chunks.begin(), set.chunks.end(), [&](std::uint32_t c) { return distance_to_box(p, store.bounds(c)) < 0.2; });
  };
  EXPECT_TRUE(takes(view, plate));
  EXPECT_FALSE(takes(view, plate.cwiseProduct(Vec3d(-1, 1, 1))));
  const WorkingSet some = select_visible(store, view, {}, budget, silent_reporter()), all = everything(store, view, budget);
  EXPECT_LT(3 * some.chunks.size(), all.chunks.size());
  const Answers n = compare_sets(store, view, some, all, 1, budget);
  EXPECT_EQ(n.differ, 0);
  EXPECT_GT(n.dark, n.pixels / 12);
  view.rect = {0, 0, 25, 150};   // the shadow is cast on the columns in the middle
  EXPECT_FALSE(takes(view, plate));
  view.rect = {85, 0, 115, 150};
  EXPECT_TRUE(takes(view, plate));
}

// Boxes of chunks reach behind a camera that is nearer to a surface than they are large. Its flash is beside it all the same.
TEST(WorkingSet, AFlashBesideANearCameraNeedsLittleMore) {
  const ScratchFolder folder;
  const stream::Store store = tests::build_test_store(tests::sphere_points(200000, 1, {0, 0, 0}, false), folder.path(), 1024);
  MemoryBudget budget(kRoom);
  std::size_t with_flash = 0, alone = 0;
  for (const Vec3d& eye : {Vec3d(1.04, 0.02, 0.1), Vec3d(0.6, 0.6, 0.62), Vec3d(0.1, -1.03, 0.2)}) {
    View view = view_to(eye, {0, 0, 0}, 400, 300, 500);
    view.lights_in_world = {view.pose.world_from_camera({0.001, -0.001, 0})};
    CutOptions options;
    options.cull_hidden = false;
    with_flash += select_visible(store, view, options, budget, silent_reporter()).chunks.size();
    view.lights_in_world.clear();
    alone += select_visible(store, view, options, budget, silent_reporter()).chunks.size();
  }
  EXPECT_GT(alone, 0u);
  EXPECT_LE(with_flash, alone + alone / 4);
}

// A lamp throws the edges of near things magnified: they are as fine as if the camera stood there.
TEST(WorkingSet, IsFineNearALampThatIsFarFromTheCamera) {
  const ScratchFolder folder;
  auto points = tests::square_points(300, 8.0, {0, 0, 0}, {0, 0, 1}, 1);
  const Vec3d plate(0, 0, 9);   // a shade below the lamp, behind the camera
  const auto more = tests::square_points(250, 0.5, plate, {0, 0, 1}, 2);
  points.insert(points.end(), more.begin(), more.end());
  const stream::Store store = tests::build_test_store(points, folder.path(), 512);
  MemoryBudget budget(kRoom);
  View view = view_to({0, 0, 4}, {0, 0, 0}, 200, 150, 200);
  const auto coarsest = [&](double lamp_height) {
    view.lights_in_world = {Vec3d(0, 0, lamp_height)};
    double spacing = 0;
    for (const std::uint32_t c : select_visible(store, view, {}, budget, silent_reporter()).chunks)
      if (distance_to_box(plate, store.bounds(c)) < 0.2) spacing = std::max(spacing, static_cast<double>(store.chunks()[c].spacing));
    return spacing;
  };
  const double far = coarsest(30), near = coarsest(10);
  EXPECT_GT(far, 0.015);   // 5 m from the camera a pixel is 2.5 cm
  EXPECT_GT(near, 0);
  EXPECT_LT(near, 1.3 * 2 * 1.0 / 200);   // one metre from the lamp
}

// The pyramids of a light hold all of each box, in whatever direction, and no more than they must.
TEST(Frustum, OfALightHoldsTheBoxesAndTheWayThere) {
  for (std::uint64_t seed = 0; seed < 200; ++seed) {
    std::vector<Box3d> boxes;
    const auto few = uniform01x4(11, Purpose::kTest, seed, 0);
    const Vec3d middle = 4 * Vec3d(few[1], few[2], few[3]) - Vec3d(2, 2, 2);
    const double reach = seed % 2 ? 0.4 : 3;
    for (std::uint64_t i = 0; i < 1 + seed % 7; ++i) {
      const auto u = uniform01x4(12, Purpose::kTest, seed, 2 * i), v = uniform01x4(12, Purpose::kTest, seed, 2 * i + 1);
      Box3d box;
      box.extend(middle + reach * (Vec3d(u[0], u[1], u[2]) - Vec3d(0.5, 0.5, 0.5)));
      box.extend(box.min + (0.05 + 0.5 * u[3]) * Vec3d(v[0], v[1], v[2]));
      boxes.push_back(box);
    }
    const Vec3d light = Vec3d::Zero();
    const std::vector<Frustum> frusta = frusta_of_light(light, boxes);
    const auto holds = [&](const Vec3d& p) {
      Box3d at;
      at.extend(p);
      return std::any_of(frusta.begin(), frusta.end(), [&](const Frustum& f) { return !f.misses(at); });
    };
    ASSERT_GE(frusta.size(), 1u);
    ASSERT_LE(frusta.size(), 6u);
    for (const Box3d& box : boxes)
      for (std::uint64_t i = 0; i < 40; ++i) {
        const auto u = uniform01x4(13, Purpose::kTest, seed, i);
        const Vec3d p = box.min + (box.max - box.min).cwiseProduct(Vec3d(u[0], u[1], u[2]));
        EXPECT_TRUE(holds(p)) << seed;
        EXPECT_TRUE(holds(light + u[3] * (p - light))) << seed;
      }
    for (const Frustum& f : frusta) {
      EXPECT_LT(f.x0, f.x1);
      EXPECT_LT(f.y0, f.y1);
    }
    if (seed % 2 && middle.norm() > 1) {   // a small heap on one side
      EXPECT_FALSE(holds(-middle)) << seed;
      EXPECT_FALSE(holds(2 * middle)) << seed;
    }
  }
  EXPECT_TRUE(frusta_of_light({0, 0, 0}, {}).empty());
}

TEST(WorkingSet, AProxyHoldsWhatItMayAndIsFinerWhereAPhotographLooks) {
  const ScratchFolder folder;
  const stream::Store store = tests::build_test_store(tests::square_points(500, 8.0, {0, 0, 0}, {0, 0, 1}, 1), folder.path(), 1024);
  const std::vector<View> views{view_to({0, 0, 2}, {2, 0, 0}, 400, 300, 500)};
  EXPECT_LE(select_proxy(store, views, 1'000'000, 20'000).surfels, 20'000u);
  const WorkingSet set = select_proxy(store, views, 30'000, 60'000);
  std::uint64_t all = 0;
  double ahead = 0, behind = 0;   // at the same distances from the camera
  for (const std::uint32_t c : set.chunks) {
    all += store.chunks()[c].count;
    const stream::Chunk chunk = store.read_chunk(c);
    for (std::uint32_t i = 0; i < chunk.count; ++i) {
      const Vec3d p = chunk.surfel(i).position_in_world;
      if (std::fabs(p.y()) < 1 && std::fabs(p.x()) > 1.5 && std::fabs(p.x()) < 2.5) (p.x() > 0 ? ahead : behind) += 1;
    }
  }
  EXPECT_EQ(all, set.surfels);
  EXPECT_GT(behind, 0);
  EXPECT_GT(ahead, 3 * behind);
}

// Distances are those of the surfels that are there: what is taken lies a pixel apart at most, and what it came from lay further apart.
TEST(WorkingSet, TakesTheCoarsestLevelWhoseSurfelsLieAPixelApart) {
  const ScratchFolder folder;
  constexpr std::size_t kPoints = 200000;
  const stream::Store store = tests::build_test_store(tests::sphere_points(kPoints, 1, {0, 0, 0}, false), folder.path(), 1024);
  const double area = 4 * 3.14159265358979 / kPoints;   // of one point
  std::vector<double> points_below(store.chunks().size());
  for (std::size_t c = store.chunks().size(); c-- > 0;) {
    const stream::ChunkEntry& e = store.chunks()[c];
    if (e.is_leaf()) points_below[c] = e.count;
    if (c > 0) points_below[e.parent] += points_below[c];
  }
  CutOptions options;
  options.cull_hidden = false;
  double inner = 0, of_limit = 0, coarser = 0;
  for (double distance = 2; distance < 40; distance *= 1.1) {
    const View view = view_to({distance, 0.1, 0.2}, {0, 0, 0}, 400, 300, 500);
    MemoryBudget budget(kRoom);
    const auto pixels_apart = [&](std::uint32_t c) {
      return std::sqrt(points_below[c] * area / store.chunks()[c].count) * 500 / distance_to_box(view.pose.centre_in_world(), store.ray_bounds(c));
    };
    for (const std::uint32_t c : select_visible(store, view, options, budget, silent_reporter()).chunks) {
      if (c == 0 || points_below[c] < 500) continue;   // corners of cells: too few to tell
      if (!store.chunks()[c].is_leaf()) {
        EXPECT_LT(pixels_apart(c), 1.15) << "chunk " << c << " from " << distance;
        inner += 1;
        of_limit = std::max(of_limit, pixels_apart(c));
      }
      EXPECT_GT(pixels_apart(store.chunks()[c].parent), 0.85) << "above chunk " << c << " from " << distance;
      coarser += 1;
    }
  }
  EXPECT_GT(inner, 100);
  EXPECT_GT(coarser, 100);
  EXPECT_GT(of_limit, 0.9);
}

TEST(WorkingSet, IsTheSameForAnyThreadsAndBatches) {
  const ScratchFolder folder;
  const stream::Store store = walls(folder.path());
  const View view = view_to({0.3, 0.2, 2}, {0, 0, 0}, 400, 300, 500);
  MemoryBudget budget(kRoom);
  const WorkingSet many = select_visible(store, view, {}, budget, silent_reporter());
  const ThreadLimit limit(1);
  EXPECT_EQ(many.chunks, select_visible(store, view, {}, budget, silent_reporter()).chunks);
  const std::vector<Frustum> frusta{make_frustum(view, 16, view.pose.centre_in_world())};
  const auto hidden = [&](std::uint64_t batch) {
    const auto maps = find_occlusion(store, store.leaves(), frusta, {2.0 / 500, batch}, budget, silent_reporter());
    std::vector<std::uint32_t> found;
    for (const std::uint32_t c : store.leaves())
      if (maps[0].hides(store.ray_bounds(c))) found.push_back(c);
    return found;
  };
  const auto whole = hidden(1u << 30);
  EXPECT_GT(whole.size(), 50u);
  EXPECT_EQ(hidden(2000), whole);
}

// Rays that slip through a wall one at a time do not make it a window.
TEST(WorkingSet, PinholesDoNotOpenAWall) {
  const View view = view_to({0, 0, 2}, {0, 0, 0}, 400, 300, 500);
  const auto hidden_behind = [&](bool holes) {
    const ScratchFolder folder;
    std::vector<tests::SampledPoint> points;
    for (const auto& p : tests::square_points(260, 4.0, {0, 0, 0}, {0, 0, 1}, 1)) {
      const double x = std::remainder(p.position.x(), 0.25), y = std::remainder(p.position.y(), 0.25);
      if (!holes || std::hypot(x, y) > 0.046) points.push_back(p);
    }
    const auto more = tests::square_points(200, 6.0, {0, 0, -1}, {0, 0, 1}, 2);
    points.insert(points.end(), more.begin(), more.end());
    const stream::Store store = tests::build_test_store(points, folder.path(), 1024);
    MemoryBudget budget(kRoom);
    const std::vector<Frustum> frusta{make_frustum(view, 16, view.pose.centre_in_world())};
    const auto maps = find_occlusion(store, store.leaves(), frusta, {8.0 / 500, 1u << 30}, budget, silent_reporter());   // a ray every 32 mm
    int hidden = 0;
    for (const std::uint32_t c : store.leaves()) hidden += !frusta[0].misses(store.ray_bounds(c)) && maps[0].hides(store.ray_bounds(c));
    return hidden;
  };
  const int whole = hidden_behind(false), pierced = hidden_behind(true);
  EXPECT_GT(whole, 8);
  EXPECT_EQ(pierced, whole) << "of " << whole;
}

TEST(WorkingSet, DepthMapsAreChargedAndHideLessWhereTheyDoNotFit) {
  const ScratchFolder folder;
  const stream::Store store = walls(folder.path());
  const Vec3d lamp(0.1, 0.2, 0.15);
  const std::vector<Frustum> frusta = frusta_of_light(lamp, std::vector<Box3d>{{lamp - Vec3d::Constant(1), lamp + Vec3d::Constant(1)}});
  ASSERT_EQ(frusta.size(), 6u);   // of slopes from -1.01 to 1.01: 51 times 51 cells of 4 times 4 rays
  constexpr std::uint64_t kWorking = 204 * 204 * sizeof(float), kMap = kWorking + 51 * 51 * sizeof(float);
  const auto hidden = [&](std::uint64_t room, std::uint64_t held) {
    MemoryBudget budget(room);
    std::vector<std::size_t> by_map;
    {
      const auto maps = find_occlusion(store, store.leaves(), frusta, {0.01, 8000}, budget, silent_reporter());
      EXPECT_EQ(budget.used_bytes(), held);
      for (std::size_t k = 0; k < maps.size(); ++k) {
        by_map.push_back(0);
        for (const std::uint32_t c : store.leaves()) by_map[k] += maps[k].hides(store.ray_bounds(c)) && !frusta[k].misses(store.ray_bounds(c));
      }
    }
    EXPECT_EQ(budget.used_bytes(), 0u);
    return by_map;
  };
  const std::vector<std::size_t> all = hidden(kRoom, 6 * kMap);
  const auto most = static_cast<std::size_t>(std::max_element(all.begin(), all.end()) - all.begin());
  EXPECT_GT(all[most], 10u);
  const std::vector<std::size_t> some = hidden(2 * (3 * kMap + kWorking), 3 * kMap);
  for (std::size_t k = 0; k < 6; ++k) EXPECT_LE(some[k], k < 3 ? all[k] : 0) << k;
  EXPECT_EQ(hidden(2 * (kMap + kWorking) - 1, 0), std::vector<std::size_t>(6, 0));
}

TEST(WorkingSet, KeepsLittleOfWhatHides) {
  const ScratchFolder folder;
  const stream::Store store = walls(folder.path());
  const View view = view_to({0.3, 0.2, 2}, {0, 0, 0}, 400, 300, 500);
  const std::vector<Frustum> frusta{make_frustum(view, 16, view.pose.centre_in_world())};
  MemoryBudget whole(kRoom), parts(kRoom), none(20000);
  find_occlusion(store, store.leaves(), frusta, {2.0 / 500, 1u << 30}, whole, silent_reporter());
  find_occlusion(store, store.leaves(), frusta, {2.0 / 500, 8000}, parts, silent_reporter());
  EXPECT_LT(4 * parts.peak_bytes(), whole.peak_bytes());
  EXPECT_EQ(parts.used_bytes(), 0u);
  // Not even one chunk fits: nothing is known to be hidden, and nothing is lost.
  const auto maps = find_occlusion(store, store.leaves(), frusta, {2.0 / 500, 8000}, none, silent_reporter());
  for (const std::uint32_t c : store.leaves()) EXPECT_EQ(maps[0].hides(store.ray_bounds(c)), frusta[0].misses(store.ray_bounds(c)));
}

}  // namespace
}  // namespace chiaro::surfels
