#include "surfels/gbuffer.h"

#include <gtest/gtest.h>

#include <cmath>

#include "stream/base/error.h"
#include "stream/base/file.h"
#include "stream/base/parallel.h"
#include "stream/base/rng.h"
#include "stream/photo/raster.h"
#include "tests/support/sampled_surface.h"

namespace chiaro::surfels {
namespace {

stream::Camera camera_above(double height, int width_px, int height_px, double focal_px) {
  stream::Camera c;
  c.photograph = "test";
  c.lens.width_px = width_px;
  c.lens.height_px = height_px;
  c.lens.fx = c.lens.fy = focal_px;
  c.lens.cx = width_px / 2.0;
  c.lens.cy = height_px / 2.0;
  c.pose.rotation_camera_from_world << 1, 0, 0, 0, -1, 0, 0, 0, -1;   // looks down
  c.pose.translation_camera_from_world = -c.pose.rotation_camera_from_world * Vec3d(0, 0, height);
  return c;
}

class GBuffer : public ::testing::Test {
 protected:
  ScratchFolder folder;
  MemoryBudget budget{256u << 20};
};

TEST_F(GBuffer, AgreesWithThePlaneInClosedForm) {
  const stream::Store store = tests::build_test_store(tests::square_points(250, 4.0, {0, 0, 0}, {0, 0, 1}, 1), folder.path());
  const stream::Camera camera = camera_above(2, 64, 48, 60);
  GBufferOptions options;
  options.flash_in_camera = Vec3d(0.3, -0.1, 0.05);
  const GBufferStats stats = write_gbuffer(store, camera, options, folder.path() / "g.raster", budget, silent_reporter());
  EXPECT_EQ(stats.pixels_hit, 64u * 48u);
  const stream::RasterReader g(folder.path() / "g.raster");
  const auto depth = g.all<float>("depth"), flash = g.all<float>("flash"), nz = g.all<float>("nz"), coverage = g.all<float>("coverage"), lit = g.all<float>("lit"), footprint = g.all<float>("footprint");
  EXPECT_EQ(stats.pixels_from_behind, 0u);
  EXPECT_EQ(stats.rays, 4u * 64u * 48u);   // even everywhere
  const Vec3d light = camera.pose.world_from_camera(*options.flash_in_camera);
  for (int y = 0; y < 48; ++y)
    for (int x = 0; x < 64; ++x) {
      const std::size_t i = static_cast<std::size_t>(y) * 64 + static_cast<std::size_t>(x);
      const Vec3d d = *stream::unproject(camera.lens, {x + 0.5, y + 0.5});
      EXPECT_NEAR(depth[i], 2 / d.z(), 2e-3);            // mean over the pixel, not its middle
      EXPECT_GT(nz[i], 0.9999f);
      EXPECT_EQ(coverage[i], 1.0f);
      EXPECT_NEAR(footprint[i], depth[i] / 60, 1e-6);
      EXPECT_EQ(lit[i], 1.0f);
      const Vec3d p = camera.pose.world_from_camera(d * (2 / d.z()));
      const double r = (light - p).norm(), expected = (light.z() / r) / (r * r);
      EXPECT_NEAR(flash[i] / expected, 1, 2e-3);
    }
}

/// Two faces that meet along x = 0, z = 0, each turned by `slope` from the level.
std::vector<tests::SampledPoint> roof_points(double slope) {
  std::vector<tests::SampledPoint> points;
  constexpr int kAlong = 260, kAcross = 130;
  for (int side : {-1, 1})
    for (int i = 0; i < kAcross; ++i)
      for (int k = 0; k < kAlong; ++k) {
        const auto u = uniform01x4(3, Purpose::kTest, points.size(), 0);
        const double out = 2.0 * (i + 0.3 + 0.4 * u[0]) / kAcross, y = 4.0 * (k + 0.3 + 0.4 * u[1]) / kAlong - 2;
        points.push_back({{side * out * std::cos(slope), y, -out * std::sin(slope)}, Vec3d(side * std::sin(slope), 0, std::cos(slope)).cast<float>()});
      }
  return points;
}

// The middle column of pixels shows both faces, half and half.
TEST_F(GBuffer, AveragesOverAPixelThatARidgeDivides) {
  const double slope = 40 * 3.14159265358979 / 180;
  const stream::Store store = tests::build_test_store(roof_points(slope), folder.path());
  const stream::Camera camera = camera_above(2, 65, 48, 60);
  GBufferOptions options;
  options.flash_in_camera = Vec3d(0.6, 0, 0);
  write_gbuffer(store, camera, options, folder.path() / "g.raster", budget, silent_reporter());
  const stream::RasterReader g(folder.path() / "g.raster");
  const auto flash = g.all<float>("flash"), spread = g.all<float>("spread");
  double ratio = 0, away = 0;
  constexpr int kFirst = 14, kLast = 34;
  for (int y = kFirst; y < kLast; ++y) {
    const Vec3d to_flash(0.6, (y + 0.5 - 24) * 2 / 60, 2);
    const double r3 = std::pow(to_flash.norm(), 3), right = (0.6 * std::sin(slope) + 2 * std::cos(slope)) / r3, left = (-0.6 * std::sin(slope) + 2 * std::cos(slope)) / r3;
    const std::size_t i = static_cast<std::size_t>(y) * 65 + 32;
    ratio += static_cast<double>(flash[i]) / (0.5 * (right + left)) / (kLast - kFirst);
    away += (static_cast<double>(spread[i]) - (right - left) / (right + left)) / (kLast - kFirst);
  }
  EXPECT_NEAR(ratio, 1, 0.02);
  EXPECT_NEAR(away, 0, 0.03);   // of 0.25
}

TEST_F(GBuffer, CastsAllRaysWhereFacesAreTurnedApart) {
  const stream::Store store = tests::build_test_store(roof_points(25 * 3.14159265358979 / 180), folder.path());   // nowhere half a pixel off either plane
  const GBufferStats stats = write_gbuffer(store, camera_above(2, 65, 48, 60), {}, folder.path() / "g.raster", budget, silent_reporter());
  EXPECT_GE(stats.rays, 4u * 65 * 48 + 12 * 46);        // all sixteen on the ridge,
  EXPECT_LE(stats.rays, 4u * 65 * 48 + 12 * 48 * 3);    // and where discs beside it are mixed
}

TEST_F(GBuffer, CastsAllRaysWhereLevelSurfacesLieOneAboveTheOther) {
  auto points = tests::square_points(250, 4.0, {0, 0, -0.06}, {0, 0, 1}, 1);
  for (const auto& p : tests::square_points(250, 4.0, {0, 0, 0}, {0, 0, 1}, 2))
    if (p.position.x() > 0) points.push_back(p);
  const stream::Store store = tests::build_test_store(points, folder.path());
  const GBufferStats stats = write_gbuffer(store, camera_above(2, 65, 48, 60), {}, folder.path() / "g.raster", budget, silent_reporter());
  EXPECT_NEAR(static_cast<double>(stats.rays), 4 * 65 * 48 + 12 * 48, 12 * 10);
}

TEST_F(GBuffer, CoversTheAreaOfAPlate) {
  const stream::Store store = tests::build_test_store(tests::square_points(260, 1.05, {0, 0, 0}, {0, 0, 1}, 1), folder.path());
  write_gbuffer(store, camera_above(2, 64, 64, 60), {}, folder.path() / "g.raster", budget, silent_reporter());
  double pixels = 0;
  int partly = 0;
  for (const float c : stream::RasterReader(folder.path() / "g.raster").all<float>("coverage")) {
    pixels += static_cast<double>(c);
    partly += c > 0 && c < 1;
  }
  EXPECT_NEAR(pixels * (2.0 / 60) * (2.0 / 60), 1.05 * 1.05, 0.03);
  EXPECT_GT(partly, 60);
}

TEST_F(GBuffer, CountsWhatIsSeenFromBehind) {
  auto points = tests::square_points(250, 4.0, {0, 0, 0}, {0, 0, 1}, 1);
  for (auto& p : points)
    if (p.position.x() < 0) p.normal = -p.normal;
  const stream::Store store = tests::build_test_store(points, folder.path());
  const GBufferStats stats = write_gbuffer(store, camera_above(2, 64, 48, 60), {}, folder.path() / "g.raster", budget, silent_reporter());
  EXPECT_EQ(stats.pixels_hit, 64u * 48u);
  EXPECT_NEAR(static_cast<double>(stats.pixels_from_behind), 32 * 48, 2 * 48);
}

TEST_F(GBuffer, IsTheSameForAnyThreadsAndTiles) {
  const stream::Store store = tests::build_test_store(tests::square_points(500, 4.0, {0, 0, -1}, {0, 0, 1}, 1), folder.path(), 4096);
  const stream::Camera camera = camera_above(2, 64, 192, 300);
  GBufferOptions options;
  options.flash_in_camera = Vec3d(0.1, 0.1, 0);
  {
    const ThreadLimit limit(1);
    write_gbuffer(store, camera, options, folder.path() / "one.raster", budget, silent_reporter());
  }
  const GBufferStats whole = write_gbuffer(store, camera, options, folder.path() / "two.raster", budget, silent_reporter());
  EXPECT_EQ(whole.tiles, 1);
  const WorkingSet cut = select_visible(store, {camera.lens, camera.pose, {0, 0, 64, 192}, {camera.pose.world_from_camera(*options.flash_in_camera)}}, options.cut, budget, silent_reporter());
  MemoryBudget small(cut.bytes);   // a fifth of it is kept free: the whole picture does not fit
  const GBufferStats parts = write_gbuffer(store, camera, options, folder.path() / "tiles.raster", small, silent_reporter());
  EXPECT_GT(parts.tiles, 1);
  options.tile_bytes = cut.bytes / 3;
  const GBufferStats by_size = write_gbuffer(store, camera, options, folder.path() / "by_size.raster", budget, silent_reporter());
  EXPECT_EQ(by_size.tiles, 3);
  options.tile_bytes = 0;   // no less than a band of rows at a time
  EXPECT_EQ(write_gbuffer(store, camera, options, folder.path() / "bands.raster", budget, silent_reporter()).tiles, 3);
  EXPECT_EQ(read_text(folder.path() / "one.raster"), read_text(folder.path() / "by_size.raster"));
  EXPECT_EQ(read_text(folder.path() / "one.raster"), read_text(folder.path() / "bands.raster"));
  EXPECT_EQ(read_text(folder.path() / "one.raster"), read_text(folder.path() / "two.raster"));
  EXPECT_EQ(read_text(folder.path() / "one.raster"), read_text(folder.path() / "tiles.raster"));
}

TEST_F(GBuffer, MarksDepthEdgesAndNotCreases) {
  // A square floating above a larger one: an edge around it; nothing inside.
  auto points = tests::square_points(250, 4.0, {0, 0, 0}, {0, 0, 1}, 1);
  const auto tile = tests::square_points(80, 1.0, {0, 0, 0.5}, {0, 0, 1}, 2);
  points.insert(points.end(), tile.begin(), tile.end());
  const stream::Store store = tests::build_test_store(points, folder.path());
  const stream::Camera camera = camera_above(3, 64, 64, 80);
  write_gbuffer(store, camera, {}, folder.path() / "g.raster", budget, silent_reporter());
  const auto edge = stream::RasterReader(folder.path() / "g.raster").all<float>("edge");
  const int half = static_cast<int>(0.5 * 80 / 2.5);   // the tile's half width in pixels
  EXPECT_LE(edge[32 * 64 + static_cast<std::size_t>(32 + half)], 1.5f);
  EXPECT_NEAR(edge[32 * 64 + 32], half, 2);
  EXPECT_GT(edge[32 * 64 + 32], 10);
}

// A plate far outside the picture, and a flash farther out still: its shadow lies where the closed form has it.
TEST_F(GBuffer, SeesTheShadowsThatAFlashFarToTheSideThrows) {
  auto points = tests::square_points(250, 4.0, {0, 0, 0}, {0, 0, 1}, 1);
  const Vec3d flash(5, 0, 1);
  const double x = 3, z0 = 0.2, z1 = 0.6, half = 0.2;   // seen from the flash: on the ground from x = 2.5 to 0, and there half a metre to each side
  const auto plate = tests::square_points(60, z1 - z0, {x, 0, 0.5 * (z0 + z1)}, {1, 0, 0}, 2);
  points.insert(points.end(), plate.begin(), plate.end());
  const stream::Store store = tests::build_test_store(points, folder.path(), 512);
  const stream::Camera camera = camera_above(2, 128, 96, 120);
  GBufferOptions options;
  options.flash_in_camera = camera.pose.rotation_camera_from_world * flash + camera.pose.translation_camera_from_world;
  const GBufferStats stats = write_gbuffer(store, camera, options, folder.path() / "g.raster", budget, silent_reporter());
  EXPECT_EQ(stats.pixels_hit, 128u * 96u);
  const stream::RasterReader g(folder.path() / "g.raster");
  const auto d = g.all<float>("flash"), lit = g.all<float>("lit");
  int in_shadow = 0, in_light = 0;
  for (int row = 0; row < 96; ++row)
    for (int column = 0; column < 128; ++column) {
      const Vec3d p((column + 0.5 - 64) / 60, -(row + 0.5 - 48) / 60, 0);
      const Vec3d at_plate = flash + (flash.x() - x) / (flash.x() - p.x()) * (p - flash);
      const double inside = std::min({at_plate.z() - z0, z1 - at_plate.z(), half - std::fabs(at_plate.y())});   // how far within the plate's border
      const std::size_t i = static_cast<std::size_t>(row) * 128 + static_cast<std::size_t>(column);
      if (inside > 0.02) {
        EXPECT_EQ(d[i], 0.0f) << column << ' ' << row;
        EXPECT_EQ(lit[i], 0.0f);
        ++in_shadow;
      } else if (inside < -0.02) {
        const double r = (flash - p).norm();
        EXPECT_NEAR(static_cast<double>(d[i]) * r * r * r / flash.z(), 1, 0.01) << column << ' ' << row;
        ++in_light;
      }
    }
  EXPECT_GT(in_shadow, 1500);
  EXPECT_GT(in_light, 4000);
  // In parts, of which each has its own view of the flash: the same bytes.
  options.tile_bytes = 0;
  EXPECT_GT(write_gbuffer(store, camera, options, folder.path() / "bands.raster", budget, silent_reporter()).tiles, 1);
  EXPECT_EQ(read_text(folder.path() / "g.raster"), read_text(folder.path() / "bands.raster"));
}

// A small plate near the flash throws a large shadow: its edge is as uncertain as the plate's own, magnified.
TEST_F(GBuffer, DoubtsTheEdgesOfShadows) {
  auto points = tests::square_points(300, 6.0, {0, 0, 0}, {0, 0, 1}, 1);
  const auto plate = tests::square_points(20, 0.4, {2.0, 0, 1.5}, {0, 0, 1}, 2);
  points.insert(points.end(), plate.begin(), plate.end());
  const stream::Store store = tests::build_test_store(points, folder.path());
  const stream::Camera camera = camera_above(4, 128, 128, 100);
  GBufferOptions options;
  options.flash_in_camera = Vec3d(3.0, 0, 2.0);   // at (3, 0, 2): the plate's shadow runs over x from -4.2 .. -0.6, y +-0.8 on the ground
  write_gbuffer(store, camera, options, folder.path() / "g.raster", budget, silent_reporter());
  const stream::RasterReader g(folder.path() / "g.raster");
  const auto lit = g.all<float>("lit"), doubt = g.all<float>("shadow"), penumbra = g.all<float>("penumbra");
  // On the line x = -1.2: the shadow is cast from (1.95, +-0.2, 1.5), a quarter of the way: its edges lie at y = +-0.8, 20 pixels from the middle row.
  const int column = 64 - 30;
  int edge = 0;
  for (int y = 64; y < 127; ++y)
    if (lit[static_cast<std::size_t>(y) * 128 + static_cast<std::size_t>(column)] < 0.5f) edge = y + 1;
  EXPECT_NEAR(edge, 64 + 20, 3);
  float widest = 0;
  for (int y = edge - 2; y <= edge + 1; ++y) widest = std::max(widest, penumbra[static_cast<std::size_t>(y) * 128 + static_cast<std::size_t>(column)]);
  EXPECT_GT(widest, 0.7f * 0.5f * 0.02f * 4 / 0.04f);   // half a spacing of 2 cm, four times magnified, on pixels of 4 cm
  EXPECT_LT(widest, 4);   // found 2.6: discs there are somewhat larger than half a spacing, and the light grazes
  const auto at = [&](int y) { return doubt[static_cast<std::size_t>(y) * 128 + static_cast<std::size_t>(column)]; };
  EXPECT_GT(std::max(at(edge), at(edge - 1)), 0.6f);
  EXPECT_GT(at(edge - 1), at(edge - 1 - static_cast<int>(widest)));
  EXPECT_EQ(at(126), 0.0f);
  EXPECT_EQ(doubt[64 * 128 + 120], 0.0f);
}

TEST_F(GBuffer, SaysWhenTheBudgetCannotHoldOneBand) {
  const stream::Store store = tests::build_test_store(tests::sphere_points(300000, 1.0, {0, 0, -1}, false), folder.path());
  MemoryBudget small(300000);
  EXPECT_THROW(write_gbuffer(store, camera_above(2, 96, 160, 90), {}, folder.path() / "g.raster", small, silent_reporter()), Error);
  EXPECT_FALSE(std::filesystem::exists(folder.path() / "g.raster"));
}

TEST_F(GBuffer, CutsCoarserFromFartherAway) {
  const stream::Store store = tests::build_test_store(tests::sphere_points(300000, 1.0, {0, 0, -1}, false), folder.path());
  const auto surfels_seen = [&](double height) {
    const stream::Camera c = camera_above(height, 96, 96, 90);
    return select_visible(store, {c.lens, c.pose, {0, 0, 96, 96}, {}}, {}, budget, silent_reporter()).surfels;
  };
  EXPECT_GT(surfels_seen(1.0), 4 * surfels_seen(60));
}

TEST_F(GBuffer, LeavesOutWhatIsHiddenAndChangesNoPixel) {
  // Five walls behind each other, each larger than the picture: the first hides the others.
  std::vector<tests::SampledPoint> points;
  for (int wall = 0; wall < 5; ++wall) {
    const auto more = tests::square_points(200, 3.0, {0, 0, -1.0 * wall}, {0, 0, 1}, static_cast<std::uint64_t>(wall) + 1);
    points.insert(points.end(), more.begin(), more.end());
  }
  const stream::Store store = tests::build_test_store(points, folder.path(), 2048);
  const stream::Camera camera = camera_above(1, 64, 64, 80);
  GBufferOptions options;
  options.flash_in_camera = Vec3d(0.1, 0.05, 0);
  options.cut.pixel_error = 0.3;
  const GBufferStats culled = write_gbuffer(store, camera, options, folder.path() / "culled.raster", budget, silent_reporter());
  options.cut.cull_hidden = false;
  const GBufferStats all = write_gbuffer(store, camera, options, folder.path() / "all.raster", budget, silent_reporter());
  EXPECT_GT(culled.chunks_hidden, 0u);
  EXPECT_LT(2 * culled.chunks, all.chunks);
  EXPECT_EQ(read_text(folder.path() / "culled.raster"), read_text(folder.path() / "all.raster"));
}

TEST_F(GBuffer, LooksAtNothingBehindTheCamera) {
  const stream::Store store = tests::build_test_store(tests::square_points(100, 1.0, {0, 0, 9}, {0, 0, -1}, 1), folder.path());
  const GBufferStats stats = write_gbuffer(store, camera_above(2, 32, 32, 30), {}, folder.path() / "g.raster", budget, silent_reporter());
  EXPECT_EQ(stats.pixels_hit, 0u);
}

}  // namespace
}  // namespace chiaro::surfels
