#include "stream/photo/camera.h"

#include <cmath>
#include <numbers>

#include "tests/stream/photo/photo_support.h"

namespace chiaro::stream {
namespace {

Lens plain_lens() {
  Lens lens;
  lens.width_px = 640;
  lens.height_px = 480;
  lens.fx = 600;
  lens.fy = 610;
  lens.cx = 322.5;
  lens.cy = 238.25;
  return lens;
}

/// Distortion as real lenses have it: up to a few per cent at the corner.
Lens random_lens(std::uint64_t seed) {
  Lens lens = plain_lens();
  std::uint32_t draw = 0;
  const auto u = [&](double lo, double hi) { return uniform(seed, draw++, lo, hi); };
  lens.kind = seed % 3 == 2 ? LensKind::kFisheye : LensKind::kPerspective;
  lens.fx = u(600, 3000);
  lens.fy = lens.fx * u(0.98, 1.02);
  lens.cx = u(280, 360);
  lens.cy = u(200, 280);
  lens.skew = u(-2, 2);
  for (int i = 0; i < 3; ++i) lens.k[i] = u(-0.15, 0.15);
  if (lens.kind == LensKind::kPerspective && seed % 3 == 1)
    for (int i = 3; i < 7; ++i) lens.k[i] = u(-0.05, 0.05);
  for (int i = 0; i < 2; ++i) lens.p[i] = u(-2e-3, 2e-3);
  for (int i = 2; i < 4; ++i) lens.p[i] = u(-0.1, 0.1);
  return lens;
}

TEST(Camera, ProjectsAPointByHand) {
  const auto pixel = project(plain_lens(), {0.5, -0.25, 2});
  ASSERT_TRUE(pixel);
  EXPECT_DOUBLE_EQ(pixel->x(), 322.5 + 600 * 0.25);
  EXPECT_DOUBLE_EQ(pixel->y(), 238.25 - 610 * 0.125);
  EXPECT_FALSE(project(plain_lens(), {0.5, -0.25, -2}));
  EXPECT_FALSE(project(plain_lens(), {0.5, -0.25, 0}));
}

TEST(Camera, ALensWithoutDistortionProjectsToTheSameBitsTheShortWay) {
  Lens lens = plain_lens();
  lens.skew = 0.7;
  ASSERT_TRUE(is_pinhole(lens));
  for (std::uint64_t i = 0; i < 1000; ++i) {
    std::uint32_t draw = 0;
    const Vec3d p(uniform(i, draw++, -3, 3), uniform(i, draw++, -3, 3), uniform(i, draw++, -1, 9));
    EXPECT_EQ(project_pinhole(lens, p), project(lens, p)) << i;
  }
  Lens other = lens;
  other.k[6] = 1e-3;
  EXPECT_FALSE(is_pinhole(other));
  other = lens;
  other.p[3] = 1e-3;
  EXPECT_FALSE(is_pinhole(other));
  other = lens;
  other.kind = LensKind::kFisheye;
  EXPECT_FALSE(is_pinhole(other));
}

TEST(Camera, ProjectsADistortedPointByHand) {
  Lens lens = plain_lens();
  lens.k = {0.1, 0.2, 0.3, 0.01, 0.02, 0.03, 0.4};
  lens.p = {0.001, 0.002, 0.5, 0.25};
  lens.skew = 3;
  const double x = 0.5, y = 0.25, s = 0.3125;
  const double rho = (1 + 0.1 * s + 0.2 * s * s + 0.3 * s * s * s + 0.4 * s * s * s * s) / (1 + 0.01 * s + 0.02 * s * s + 0.03 * s * s * s);
  const double t = 1 + 0.5 * s + 0.25 * s * s;
  const double xd = x * rho + (2 * 0.001 * x * y + 0.002 * (s + 2 * x * x)) * t, yd = y * rho + (0.001 * (s + 2 * y * y) + 2 * 0.002 * x * y) * t;
  const auto pixel = project(lens, {1, 0.5, 2});
  ASSERT_TRUE(pixel);
  EXPECT_NEAR(pixel->x(), 322.5 + 600 * xd + 3 * yd, 1e-9);
  EXPECT_NEAR(pixel->y(), 238.25 + 610 * yd, 1e-9);
}

TEST(Camera, FisheyeImageRadiusIsTheAngle) {
  Lens lens = plain_lens();
  lens.kind = LensKind::kFisheye;
  for (const double degrees : {0.0, 10.0, 60.0, 90.0, 100.0}) {
    const double angle = degrees * std::numbers::pi / 180;
    const auto pixel = project(lens, Vec3d(std::sin(angle), 0, std::cos(angle)) * 3);
    ASSERT_TRUE(pixel) << degrees;
    EXPECT_NEAR(pixel->x(), lens.cx + lens.fx * angle, 1e-9);
  }
  EXPECT_FALSE(project(lens, {0, 0, -1}));
}

TEST(Camera, RoundTripsThroughRandomLenses) {
  for (std::uint64_t seed = 0; seed < 300; ++seed) {
    const Lens lens = random_lens(seed);
    for (std::uint32_t i = 0; i < 20; ++i) {
      const Vec2d pixel(uniform(seed, 100 + 2 * i, 0, lens.width_px), uniform(seed, 101 + 2 * i, 0, lens.height_px));
      const auto ray = unproject(lens, pixel);
      ASSERT_TRUE(ray) << "seed " << seed;
      EXPECT_NEAR(ray->norm(), 1, 1e-14);
      const auto back = project(lens, *ray * 7.5);
      ASSERT_TRUE(back) << "seed " << seed;
      EXPECT_LT((*back - pixel).norm(), 1e-8) << "seed " << seed;
    }
  }
}

TEST(Camera, RoundTripsDirectionsInsideTheMonotonicRange) {
  for (std::uint64_t seed = 0; seed < 300; ++seed) {
    const Lens lens = random_lens(seed);
    for (std::uint32_t i = 0; i < 20; ++i) {
      const Vec3d ray = Vec3d(uniform(seed, 200 + 2 * i, -0.8, 0.8), uniform(seed, 201 + 2 * i, -0.8, 0.8), 1).normalized();
      const auto pixel = project(lens, ray);
      if (!pixel) continue;
      const auto back = unproject(lens, *pixel);
      ASSERT_TRUE(back) << "seed " << seed;
      const auto again = project(lens, *back);
      ASSERT_TRUE(again);
      EXPECT_LT((*again - *pixel).norm(), 1e-8) << "seed " << seed;
    }
  }
}

/// Without distortion there is nothing to search for; a lens with too little to change a number takes the long way.
TEST(Camera, APinholesDirectionsHaveTheBitsOfTheSearch) {
  for (std::uint64_t seed = 0; seed < 50; ++seed) {
    Lens lens = random_lens(seed), searched;
    lens.kind = LensKind::kPerspective;
    lens.k = {};
    lens.p = {};
    searched = lens;
    searched.k[0] = 1e-300;
    ASSERT_TRUE(is_pinhole(lens) && !is_pinhole(searched));
    for (std::uint32_t i = 0; i < 40; ++i) {
      const double far = i % 2 == 0 ? 1 : 1e4;
      const Vec2d pixel(uniform(seed, 300 + 2 * i, 0, lens.width_px) * far, uniform(seed, 301 + 2 * i, 0, lens.height_px) * far);
      const auto ray = unproject(lens, pixel), other = unproject(searched, pixel);
      ASSERT_EQ(ray.has_value(), other.has_value()) << "seed " << seed;
      if (ray) EXPECT_EQ(*ray, *other) << "seed " << seed;
    }
  }
  EXPECT_FALSE(unproject(plain_lens(), {std::nan(""), 0}));
}

TEST(Camera, RefusesPointsBeyondTheFoldOfTheLens) {
  Lens lens = plain_lens();
  lens.k[0] = -0.3;  // r (1 - 0.3 r^2) grows until r^2 = 1 / 0.9
  const double fold = std::sqrt(1 / 0.9);
  EXPECT_TRUE(project(lens, {fold * 0.999, 0, 1}));
  EXPECT_FALSE(project(lens, {fold * 1.001, 0, 1}));
  EXPECT_FALSE(project(lens, {0, 50, 1}));
  const double most = fold * (1 - 0.3 * fold * fold);
  EXPECT_TRUE(unproject(lens, {lens.cx + lens.fx * most * 0.999, lens.cy}));
  EXPECT_FALSE(unproject(lens, {lens.cx + lens.fx * most * 1.001, lens.cy}));
}

TEST(Camera, RefusesPointsBeyondTheFirstFoldEvenWhereTheModelGrowsAgain) {
  Lens lens = plain_lens();
  lens.k[0] = -0.5;
  lens.k[1] = 0.07;  // slope 1 - 1.5 s + 0.35 s^2 is negative between s = 0.82 and 3.46 only
  EXPECT_TRUE(project(lens, {std::sqrt(0.8), 0, 1}));
  EXPECT_FALSE(project(lens, {std::sqrt(2.0), 0, 1}));
  EXPECT_FALSE(project(lens, {std::sqrt(5.0), 0, 1}));
}

TEST(Camera, RefusesPointsBeyondThePoleOfARationalLens) {
  Lens lens = plain_lens();
  lens.k[3] = -0.5;  // denominator 1 - 0.5 s
  EXPECT_TRUE(project(lens, {std::sqrt(1.9), 0, 1}));
  EXPECT_FALSE(project(lens, {std::sqrt(2.1), 0, 1}));
}

TEST(Camera, FoldDoesNotDependOnWhichLensWasAskedBefore) {
  std::vector<Lens> lenses(40, plain_lens());
  for (std::size_t i = 0; i < lenses.size(); ++i) lenses[i].k[0] = -0.1 - 0.02 * static_cast<double>(i);
  for (int round = 0; round < 2; ++round)
    for (const Lens& lens : lenses) {
      const double fold = std::sqrt(-1 / (3 * lens.k[0]));
      EXPECT_TRUE(project(lens, {0, fold * 0.9999, 1}));
      EXPECT_FALSE(project(lens, {0, fold * 1.0001, 1}));
    }
}

TEST(Camera, PoseTakesTheCentreToTheOrigin) {
  Pose pose;
  pose.rotation_camera_from_world = Eigen::AngleAxisd(0.7, Vec3d(1, 2, 3).normalized()).toRotationMatrix();
  pose.translation_camera_from_world = {1, -2, 0.5};
  EXPECT_LT(pose.camera_from_world(pose.centre_in_world()).norm(), 1e-14);
  EXPECT_LT((pose.world_from_camera(pose.camera_from_world({3, 4, 5})) - Vec3d(3, 4, 5)).norm(), 1e-13);
}

TEST(Camera, CheckRepairsSmallAndRefusesLargeDeviations) {
  Camera camera{"a.jpg", plain_lens(), {}};
  camera.pose.rotation_camera_from_world(0, 1) = 5e-5;
  check_camera(camera, "file.txt");
  const Mat3d& r = camera.pose.rotation_camera_from_world;
  EXPECT_LT((r * r.transpose() - Mat3d::Identity()).cwiseAbs().maxCoeff(), 1e-15);

  const auto refusal = [](auto change) {
    Camera bad{"a.jpg", plain_lens(), {}};
    change(bad);
    return error_of([&] { check_camera(bad, "file.txt"); });
  };
  EXPECT_NE(refusal([](Camera& c) { c.pose.rotation_camera_from_world(0, 1) = 1e-2; }).find("orthonormal"), std::string::npos);
  EXPECT_NE(refusal([](Camera& c) { c.pose.rotation_camera_from_world.setZero(); }).find("orthonormal"), std::string::npos);
  EXPECT_NE(refusal([](Camera& c) { c.pose.rotation_camera_from_world = Vec3d(1, 1, -1).asDiagonal(); }).find("mirrors"), std::string::npos);
  EXPECT_NE(refusal([](Camera& c) { c.pose.translation_camera_from_world.x() = NAN; }).find("not finite"), std::string::npos);
  EXPECT_NE(refusal([](Camera& c) { c.lens.fx = 0; }).find("focal length 0"), std::string::npos);
  EXPECT_NE(refusal([](Camera& c) { c.lens.k[2] = INFINITY; }).find("radial"), std::string::npos);
  EXPECT_NE(refusal([](Camera& c) { c.lens.width_px = 0; }).find("size 0 x 480"), std::string::npos);
  EXPECT_NE(refusal([](Camera& c) { c.focus = {0.01, 0}; }).find("focus: aperture 0.01 at distance 0"), std::string::npos);
  EXPECT_NE(refusal([](Camera& c) { c.focus = {-0.01, 1}; }).find("focus"), std::string::npos);
  EXPECT_NE(refusal([](Camera& c) { c.lens.width_px = 0; }).find("file.txt: camera \"a.jpg\""), std::string::npos);
}

TEST(Camera, BlurIsThatOfAThinLens) {
  Camera camera;
  camera.lens = random_lens(1);
  camera.lens.fx = camera.lens.fy = 600;
  EXPECT_EQ(blur_px(camera, 2), 0) << "not known";
  camera.focus = {0.05 / 4, 2};   // 50 mm at f/4, focused at 2 m
  EXPECT_EQ(blur_px(camera, 2), 0);
  EXPECT_NEAR(blur_px(camera, 4), 600 * 0.0125 * 0.25, 1e-12);
  EXPECT_NEAR(blur_px(camera, 1), 600 * 0.0125 * 0.5, 1e-12);
  EXPECT_NEAR(blur_px(camera, 1e12), 600 * 0.0125 / 2, 1e-6);
  EXPECT_EQ(blur_px(camera, 0), 0);
  // The same by the lens equation on the sensor: images of both planes, and the cone of rays between them; the sensor is 600 pixels from the lens.
  const double focal = 0.05, sensor = 1 / (1 / focal - 1 / 2.0), image = 1 / (1 / focal - 1 / 3.0);
  EXPECT_NEAR(blur_px(camera, 3), 0.0125 * std::abs(sensor - image) / image * 600 / sensor, 1e-9);
  EXPECT_FLOAT_EQ(focus_share(0), 1);
  EXPECT_FLOAT_EQ(focus_share(2), 1 / (1 + 4.0f * 12 / 16));   // variances: of a disc d^2 / 16, of a pixel 1 / 12
}

TEST(Camera, ScaledLensSeesTheSameRays) {
  const Lens lens = random_lens(1);
  const Lens quarter = scaled_to(lens, 160, 120, "a.jpg");
  const auto full = project(lens, {0.1, -0.05, 1}), small = project(quarter, {0.1, -0.05, 1});
  ASSERT_TRUE(full && small);
  EXPECT_LT((*full * 0.25 - *small).norm(), 1e-10);
  EXPECT_NE(error_of([&] { scaled_to(lens, 120, 160, "a.jpg"); }).find("a.jpg: is 120 x 160 pixels"), std::string::npos);
  EXPECT_NE(error_of([&] { scaled_to(lens, 0, 160, "a.jpg"); }), "");
}

TEST(Camera, ALensOfCellsSeesThemWhereTheirPixelsAre) {
  const Lens lens = random_lens(1);
  const Lens cells = lens_of_cells(lens, 7);
  EXPECT_EQ(cells.width_px, lens.width_px / 7);
  EXPECT_EQ(cells.height_px, lens.height_px / 7);
  const auto pixel = project(lens, {0.1, -0.05, 1}), cell = project(cells, {0.1, -0.05, 1});
  ASSERT_TRUE(pixel && cell);
  EXPECT_LT((*pixel / 7 - *cell).norm(), 1e-10);
}

TEST(Camera, ALensIsNotScaledToWhatIsNoCopyOfItsPicture) {
  Lens lens = random_lens(1);
  lens.width_px = 6000;
  lens.height_px = 4000;
  const auto fits = [&](int width, int height) { return error_of([&] { scaled_to(lens, width, height, "a.tif"); }).empty(); };
  for (const auto& [width, height] : {std::pair{6000, 4000}, {3000, 2000}, {1500, 1000}, {2048, 1365}, {2047, 1365}, {12000, 8000}, {333, 222}}) EXPECT_TRUE(fits(width, height)) << width;
  EXPECT_FALSE(fits(6024, 4024));   // the sensor's area of a RAW file; its JPEG is cropped
  EXPECT_FALSE(fits(3012, 2012));   // at half size
  EXPECT_FALSE(fits(5970, 3980));   // in proportion: an undistorted picture
  EXPECT_FALSE(fits(6000, 3980));
  EXPECT_FALSE(fits(2900, 2000));
}

}  // namespace
}  // namespace chiaro::stream
