/// Photographs of synthetic scenes against what is known of them without tracing any path.
#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <cmath>
#include <nlohmann/json.hpp>
#include <numbers>
#include <sstream>

#include "stream/base/error.h"
#include "stream/base/file.h"
#include "stream/base/parallel.h"
#include "stream/base/rng.h"
#include "stream/photo/camera_files.h"
#include "stream/photo/image_io.h"
#include "tests/support/files.h"
#include "tools/commands.h"
#include "tools/project.h"
#include "tools/synth_project.h"
#include "tools/synth_surfaces.h"

namespace chiaro::tools {
namespace {
namespace fs = std::filesystem;
using testing::HasSubstr;

constexpr double kPi = std::numbers::pi;
const SynthKind kPhotographed[] = {SynthKind::kSphere, SynthKind::kStatue, SynthKind::kWall, SynthKind::kRoom};
const char* const kNames[] = {"sphere", "statue", "wall", "room"};

/// Bodies are made once: the statue's table takes a second.
const SynthBody& body_of(SynthKind kind) {
  static std::map<SynthKind, std::unique_ptr<SynthBody>> bodies;
  auto& body = bodies[kind];
  if (!body) body = make_body(kind);
  return *body;
}

SynthProjectOptions small() {
  SynthProjectOptions options;
  options.photographs = 4;
  options.width_px = 48;
  options.height_px = 36;
  options.samples = 2;
  return options;
}

struct Picture {
  std::vector<float> rgb;
  std::vector<std::uint8_t> covered;
};

Picture render_all(SynthKind kind, const SynthLights& lights, const SynthView& view, const SynthPixels& pixels) {
  const auto n = static_cast<std::size_t>(view.lens.width_px) * static_cast<std::size_t>(view.lens.height_px);
  Picture p{std::vector<float>(3 * n), std::vector<std::uint8_t>(n)};
  render_synth_rows(body_of(kind), lights, view, pixels, 0, view.lens.height_px, p.rgb, p.covered);
  return p;
}

TEST(SynthBody, RaysMeetTheSurfaceWhereItIs) {
  for (std::size_t s = 0; s < 4; ++s) {
    SynthProjectOptions options = small();
    options.photographs = 12;
    const SynthScene scene(parse_synth_spec(kNames[s]), 100);
    const SynthBody& body = body_of(kPhotographed[s]);
    int hits = 0;
    for (const SynthView& view : synth_views(kPhotographed[s], options))
      for (int i = 0; i < 400; ++i) {
        const Vec3d in_camera((i % 20 + 0.5) / 20 - 0.5, (i / 20 + 0.5) / 20 - 0.5, 1), eye = view.pose.centre_in_world();
        const Vec3d direction = (view.pose.rotation_camera_from_world.transpose() * in_camera).normalized();
        const auto hit = body.hit(eye, direction);
        if (!hit) continue;
        ++hits;
        ASSERT_LT(scene.distance_to_surface(hit->position), 1e-9) << kNames[s];
        // The ray itself ends there, but for the table of radii and the height that a slope makes of a step.
        ASSERT_LT((eye + hit->distance * direction - hit->position).norm(), SynthBody::kLift / 2) << kNames[s];
        ASSERT_NEAR(hit->normal.norm(), 1, 1e-12);
        ASSERT_LT(hit->normal.dot(direction), 0.02) << kNames[s];   // faces the eye
      }
    EXPECT_GT(hits, 500) << kNames[s];
  }
}

TEST(SynthBody, NothingLiesBeforeWhatARayMeets) {
  // A walk in steps of half a millimetre along the ray never finds itself inside of the solid.
  for (const SynthKind kind : {SynthKind::kStatue, SynthKind::kWall}) {
    const SynthBody& body = body_of(kind);
    for (const SynthView& view : synth_views(kind, small()))
      for (int i = 0; i < 49; ++i) {
        const Vec3d in_camera((i % 7) / 7.0 - 0.45, (i / 7) / 7.0 - 0.45, 1), eye = view.pose.centre_in_world();
        const Vec3d direction = (view.pose.rotation_camera_from_world.transpose() * in_camera).normalized();
        const auto hit = body.hit(eye, direction);
        const double end = hit ? hit->distance - 1e-3 : 4.5;
        for (double t = std::max(0.0, end - 1.2); t < end; t += 5e-4) {
          const Vec3d p = eye + t * direction;
          if (kind == SynthKind::kWall && (std::abs(p.x()) > kWallWidth / 2 || std::abs(p.y()) > kWallHeight / 2 || p.z() < 0 || p.z() > 0.016)) continue;
          const double height = kind == SynthKind::kWall ? p.z() - wall_relief(p.x(), p.y()).height : p.norm() - statue_radius(p.normalized()).radius;
          ASSERT_GT(height, -1e-4) << "ray " << i << " at " << t << " of " << end;
        }
      }
  }
}

TEST(SynthBody, RaysThatLeaveASurfaceMeetItAgainOnlyWhereItIsInTheWay) {
  // Against a walk in steps of a millimetre; rays that pass within a tenth of one are left out, as either answer is right.
  for (const char* name : {"statue", "wall"}) {
    const bool wall = name == std::string("wall");
    const SynthScene scene(parse_synth_spec(name), 800);
    const SynthBody& body = body_of(wall ? SynthKind::kWall : SynthKind::kStatue);
    int blocked = 0, free = 0;
    for (std::uint64_t i = 0; i < 800; ++i) {
      const SynthPoint from = scene.point(i);
      const auto r = uniform01x4(1, Purpose::kTest, i, 0);
      const Vec3d normal = from.normal.cast<double>(), start = from.position + SynthBody::kLift * normal;
      Vec3d direction(2 * static_cast<double>(r[0]) - 1, 2 * static_cast<double>(r[1]) - 1, 2 * static_cast<double>(r[2]) - 1);
      direction.normalize();
      if (direction.dot(normal) < 0.05) continue;
      double lowest = 1;
      for (double t = 2e-3; t < 1; t += 1e-3) {
        const Vec3d p = start + t * direction;
        if (wall && (std::abs(p.x()) > kWallWidth / 2 || std::abs(p.y()) > kWallHeight / 2)) break;
        lowest = std::min(lowest, wall ? p.z() - wall_relief(p.x(), p.y()).height : p.norm() - statue_radius(p.normalized()).radius);
      }
      if (std::abs(lowest) < 1e-4) continue;
      ASSERT_EQ(body.occluded(start, direction), lowest < 0) << name << " " << i << " lowest " << lowest;
      ++(lowest < 0 ? blocked : free);
    }
    EXPECT_GT(blocked, 10) << name;
    EXPECT_GT(free, 50) << name;
  }
}

TEST(SynthRender, FlashAloneIsAlbedoOverPiTimesIrradiance) {
  SynthProjectOptions options = small();
  options.width_px = 65;    // odd: the middle pixel's centre is on the axis
  options.height_px = 49;
  SynthView view = synth_views(SynthKind::kSphere, options)[0];
  view.lens.fx = view.lens.fy = 4000;   // a pixel so small that the albedo hardly changes over it
  const SynthLights lights{30, 0, 0};
  SynthPixels pixels;
  const Picture picture = render_all(SynthKind::kSphere, lights, view, pixels);
  const Vec3d eye = view.pose.centre_in_world(), axis = view.pose.rotation_camera_from_world.row(2).transpose();
  const double t = -eye.dot(axis) - std::sqrt(eye.dot(axis) * eye.dot(axis) - eye.squaredNorm() + 1);
  const Vec3d p = eye + t * axis, to_flash = view.flash_in_scene() - p;
  const double irradiance = 30 * p.dot(to_flash) / to_flash.norm() / to_flash.squaredNorm();
  EXPECT_GT(irradiance, 1);
  const std::size_t middle = 24 * 65 + 32;
  for (int c = 0; c < 3; ++c) {
    const double expected = static_cast<double>(synth_albedo(p)[c]) / kPi * irradiance;
    EXPECT_NEAR(static_cast<double>(picture.rgb[3 * middle + static_cast<std::size_t>(c)]), expected, 1e-4 * expected);
  }
  EXPECT_EQ(picture.covered[middle], 255);
}

TEST(SynthRender, AConvexBodySeesExactlyHalfOfTheSky) {
  SynthProjectOptions options = small();
  const SynthView view = synth_views(SynthKind::kSphere, options)[1];
  SynthPixels pixels;
  pixels.samples = 1;
  const Picture picture = render_all(SynthKind::kSphere, {0, 0.4, 5}, view, pixels);
  int seen = 0;
  for (std::size_t i = 0; i < picture.covered.size(); ++i) {
    if (!picture.covered[i]) {
      EXPECT_EQ(picture.rgb[3 * i], 0);
      continue;
    }
    ++seen;
    const Vec3d in_camera((static_cast<double>(i % 48) + 0.5 - view.lens.cx) / view.lens.fx, (static_cast<double>(i / 48) + 0.5 - view.lens.cy) / view.lens.fy, 1);
    const auto hit = body_of(SynthKind::kSphere).hit(view.pose.centre_in_world(), (view.pose.rotation_camera_from_world.transpose() * in_camera).normalized());
    ASSERT_TRUE(hit);
    EXPECT_NEAR(static_cast<double>(picture.rgb[3 * i + 1]), 0.4 * static_cast<double>(synth_albedo(hit->position)[1]), 1e-5);
  }
  EXPECT_GT(seen, 300);
}

TEST(SynthRender, TheStatueCastsShadows) {
  const SynthBody& body = body_of(SynthKind::kStatue);
  // From right behind: the front gets nothing, whatever its normal.
  const auto front = body.hit({3, 0.1, 0.2}, Vec3d(-1, 0, 0));
  ASSERT_TRUE(front);
  EXPECT_EQ(flash_irradiance(body, {30, 0, 0}, {-3, 0, 0}, *front), 0);
  EXPECT_GT(flash_irradiance(body, {30, 0, 0}, {3, 0, 0}, *front), 1);
}

TEST(SynthRender, OneBounceInTheRoomIsTheSumOverItsSurface) {
  // Points that lie evenly on the surface stand for equal areas: E = sum of radiosity / pi * cos cos / r^2 * area / points, with shadow rays.
  const SynthBody& body = body_of(SynthKind::kRoom);
  const Vec3d flash(3.4, 0.5, -0.3);
  const SynthLights lights{40, 0, 1};
  const auto spot = body.hit({1.1, 0.3, 0}, Vec3d(0.1, 0.05, -1).normalized());
  ASSERT_TRUE(spot);
  constexpr std::uint64_t kPoints = 60000;
  const SynthScene scene(parse_synth_spec("room"), kPoints);
  Vec3d sum = Vec3d::Zero();
  for (std::uint64_t i = 0; i < kPoints; ++i) {
    const SynthPoint q = scene.point(i);
    const BodyHit there{0, q.position, q.normal.cast<double>()};
    const Vec3d way = q.position - spot->position;
    const double r2 = way.squaredNorm(), here_cos = way.dot(spot->normal) / std::sqrt(r2), there_cos = -way.dot(there.normal) / std::sqrt(r2);
    if (!(r2 > 1e-6 && here_cos > 1e-9 && there_cos > 1e-9)) continue;
    const Vec3d start = spot->position + SynthBody::kLift * spot->normal, end = q.position + SynthBody::kLift * there.normal;
    if (body.occluded(start, (end - start).normalized(), (end - start).norm())) continue;
    sum += flash_irradiance(body, lights, flash, there) / kPi * there_cos * here_cos / r2 * q.albedo.cast<double>();
  }
  const Vec3d expected = sum * scene.area_m2() / static_cast<double>(kPoints) / kPi;   // irradiance / pi
  constexpr std::uint32_t kPaths = 40000;
  Vec3d mean = Vec3d::Zero(), squares = Vec3d::Zero();
  for (std::uint32_t i = 0; i < kPaths; ++i) {
    const auto r = uniform01x4(3, Purpose::kTest, i, 0);
    const Vec3d light = incoming_by_one_path(body, lights, flash, *spot, static_cast<double>(r[0]), static_cast<double>(r[1]), 3, i, 0);
    mean += light / kPaths;
    squares += light.cwiseProduct(light) / kPaths;
  }
  for (int c = 0; c < 3; ++c) {
    const double sigma = std::sqrt((squares[c] - mean[c] * mean[c]) / kPaths);
    EXPECT_GT(mean[c], 0.01);
    EXPECT_NEAR(mean[c], expected[c], 4 * sigma + 0.02 * expected[c]);   // 2 %: the sum's own scatter
  }
}

TEST(SynthRender, PathsThatStandForOthersKeepTheMean) {
  // Two bounces are one, and one from where that one came: put together here without ending any path by chance.
  const SynthBody& body = body_of(SynthKind::kRoom);
  const Vec3d flash(3.4, 0.5, -0.3);
  const auto spot = body.hit({1.1, 0.3, 0}, Vec3d(0, 0, -1));
  ASSERT_TRUE(spot);
  constexpr std::uint32_t kPaths = 40000;
  double mean[3] = {}, squares[3] = {};
  const auto add = [&](int which, const Vec3d& light) {
    mean[which] += light.mean() / kPaths;
    squares[which] += light.mean() * light.mean() / kPaths;
  };
  for (std::uint32_t i = 0; i < kPaths; ++i) {
    const auto r = uniform01x4(3, Purpose::kTest, i, 0), s = uniform01x4(3, Purpose::kTest, i, 1);
    const auto path = [&](int bounces, const BodyHit& from, const std::array<float, 4>& square) {
      return incoming_by_one_path(body, {40, 0, bounces}, flash, from, static_cast<double>(square[0]), static_cast<double>(square[1]), 3, i, 0);
    };
    add(0, path(1, *spot, r));
    add(1, path(2, *spot, r));
    const double radius = std::sqrt(static_cast<double>(s[0])), phi = 2 * kPi * static_cast<double>(s[1]);
    const Vec3d direction(radius * std::cos(phi), radius * std::sin(phi), std::sqrt(1 - static_cast<double>(s[0])));   // about the floor's normal
    const auto next = body.hit(spot->position + SynthBody::kLift * spot->normal, direction.normalized());
    ASSERT_TRUE(next);
    const Vec3d light = Vec3d::Constant(flash_irradiance(body, {40, 0, 0}, flash, *next) / kPi) + path(1, *next, {s[2], s[3], 0, 0});
    add(2, synth_albedo(next->position).cast<double>().cwiseProduct(light));
  }
  const auto variance = [&](int which) { return (squares[which] - mean[which] * mean[which]) / kPaths; };
  const double sigma = std::sqrt(variance(1) + variance(2));
  EXPECT_NEAR(mean[1], mean[2], 4 * sigma);
  EXPECT_GT(mean[1] - mean[0], 8 * sigma);   // the second bounce is there to be seen
}

TEST(SynthRender, NoiseHasTheVarianceThatIsDeclared) {
  SynthProjectOptions options = small();
  options.width_px = 160;
  options.height_px = 120;
  const SynthView view = synth_views(SynthKind::kRoom, options)[0];
  const SynthLights lights{45, 0, 0};
  SynthPixels clean{1, 0, 0, 9}, noisy{1, 1e-3, 2e-3, 9};
  const Picture a = render_all(SynthKind::kRoom, lights, view, clean), b = render_all(SynthKind::kRoom, lights, view, noisy);
  double squares = 0;
  for (std::size_t i = 0; i < a.rgb.size(); ++i) {
    const double value = static_cast<double>(a.rgb[i]), off = static_cast<double>(b.rgb[i]) - value;
    squares += off * off / (1e-3 * value + 4e-6) / static_cast<double>(a.rgb.size());
  }
  EXPECT_NEAR(squares, 1, 4 * std::sqrt(2.0 / static_cast<double>(a.rgb.size())));
}

TEST(SynthRender, DoesNotDependOnTheBandsOfRows) {
  const SynthView view = synth_views(SynthKind::kWall, small())[2];
  const SynthLights lights{30, 0.1, 3};
  const SynthPixels pixels{2, 1e-4, 4e-4, 5};
  const Picture whole = render_all(SynthKind::kWall, lights, view, pixels);
  std::vector<float> rgb(3 * 48);
  std::vector<std::uint8_t> covered(48);
  for (const int y : {0, 17, 35}) {
    render_synth_rows(body_of(SynthKind::kWall), lights, view, pixels, y, y + 1, rgb, covered);
    for (std::size_t i = 0; i < rgb.size(); ++i) ASSERT_EQ(rgb[i], whole.rgb[3 * 48 * static_cast<std::size_t>(y) + i]);
  }
}

class SynthProject : public testing::Test {
 protected:
  SynthProjectResult write(const std::string& spec, const std::string& name, const SynthProjectOptions& options = small()) const {
    return write_synth_project(SynthScene(parse_synth_spec(spec), 2000), scratch_.path() / name, options, silent_reporter());
  }
  fs::path at(const std::string& name) const { return scratch_.path() / name; }
  ScratchFolder scratch_;
};

TEST_F(SynthProject, IsTheSameForTheSameSeedAndAnyThreads) {
  const auto files = [&](const char* spec, int threads, const char* name) {
    const ThreadLimit limit(threads);
    write(spec, name);
    return test::files_below(at(name));
  };
  const auto one = files("wall:seed=3", 1, "one");
  EXPECT_THAT(test::differences(one, files("wall:seed=3", 2, "two")), testing::IsEmpty());
  const auto other = test::differences(one, files("wall:seed=4", 2, "other"));
  EXPECT_THAT(other, testing::Contains("photos/photo_03.exr"));
  EXPECT_THAT(other, testing::Contains("cloud.ply"));
}

TEST_F(SynthProject, HoldsWhatARunNeeds) {
  for (const char* name : kNames) {
    const SynthProjectResult result = write(name, name);
    const Project project = load_project(at(name) / "project.toml");
    ASSERT_EQ(project.acquisitions.size(), 1u);
    EXPECT_EQ(project.acquisitions[0].photographs.size(), 4u);
    const auto truth = nlohmann::json::parse(read_text(at(name) / "truth/lights.json"));
    EXPECT_EQ(truth["flash_intensity_w_per_sr"], result.flash_intensity);
    EXPECT_EQ(truth["ambient_radiance"], name == std::string("room") ? 0.0 : 0.15);
    EXPECT_EQ(fs::exists(at(name) / "masks/photo_00.png"), name != std::string("room"));
    const stream::Image photo = stream::read_image(at(name) / "photos/photo_02.exr");
    EXPECT_EQ(photo.width, 48);
    EXPECT_EQ(photo.height, 36);
    EXPECT_FALSE(fs::exists(at(std::string(name) + ".part")));
  }
}

TEST_F(SynthProject, CamerasOfAMovedAndScaledSceneSeeTheSamePicture) {
  // Points of the scene fall on the same pixels, whatever the frame.
  const SynthScene moved(parse_synth_spec("wall:scale=2.5,offset=1000"), 50), still(parse_synth_spec("wall"), 50);
  const SynthProjectResult a = write("wall", "still"), b = write("wall:scale=2.5,offset=1000", "moved");
  EXPECT_NEAR(b.flash_intensity, 6.25 * a.flash_intensity, 1e-9);
  std::vector<std::string> notes;
  const auto cameras_a = stream::read_cameras(at("still/sparse"), notes), cameras_b = stream::read_cameras(at("moved/sparse"), notes);
  EXPECT_THAT(notes, testing::IsEmpty());
  ASSERT_EQ(cameras_b.size(), 4u);
  for (std::size_t k = 0; k < 4; ++k)
    for (std::uint64_t i = 0; i < 50; ++i) {
      const auto p = stream::project(cameras_a[k].lens, cameras_a[k].pose.camera_from_world(still.point(i).position));
      const auto q = stream::project(cameras_b[k].lens, cameras_b[k].pose.camera_from_world(moved.point(i).position));
      ASSERT_TRUE(p && q);
      EXPECT_LT((*p - *q).norm(), 1e-6);
    }
  // Rays are cast in the scene's own frame: the pictures are the same bytes.
  EXPECT_EQ(read_text(at("still/photos/photo_01.exr")), read_text(at("moved/photos/photo_01.exr")));
}

TEST_F(SynthProject, ALongerLensSeesLessOfTheSameScene) {
  SynthProjectOptions near = small();
  near.focal = 4;
  const std::vector<SynthView> wide = synth_views(SynthKind::kStatue, small()), narrow = synth_views(SynthKind::kStatue, near);
  for (std::size_t k = 0; k < wide.size(); ++k) {
    EXPECT_EQ(narrow[k].lens.fx, 4 * 36);   // the shorter side
    EXPECT_EQ(narrow[k].pose.translation_camera_from_world, wide[k].pose.translation_camera_from_world);
  }
  write("statue", "narrow", near);
  EXPECT_THAT(read_text(at("narrow/sparse/cameras.txt")), testing::HasSubstr("48 36 144 144"));
}

TEST_F(SynthProject, LeavesWhatIsThereAlone) {
  make_folder(at("mine"));
  write_text(at("mine/letter.txt"), "dear");
  EXPECT_THROW(write("sphere", "mine"), Error);
  EXPECT_EQ(read_text(at("mine/letter.txt")), "dear");
  make_folder(at("empty"));
  write("sphere", "empty");
  EXPECT_TRUE(fs::exists(at("empty/project.toml")));
}

TEST(SynthCommand, TakesPhotographsOfScenesThatHaveASurface) {
  const ScratchFolder scratch;
  std::ostringstream out, err;
  Console console(out, err);
  const std::string folder = (scratch.path() / "p").string();
  const auto run = [&](std::vector<std::string> words) {
    words.insert(words.end(), {"--points", "300"});
    return run_synth(words, console);
  };
  EXPECT_THROW(run({"sphere"}), UsageError);
  EXPECT_THROW(run({"sphere", "--out", folder + ".ply", "--photographs", "3"}), UsageError);
  EXPECT_THROW(run({"sphere", "--out", folder + ".ply", "--size", "64x48"}), UsageError);
  for (const char* scene : {"volume", "line", "outlier", "duplicates"}) EXPECT_THROW(run({scene, "--project", folder}), UsageError) << scene;
  for (const char* size : {"", "64", "64x", "x48", "64x48x", "64 x 48", "-64x48", "0x48", "64x20000", "99999999999x4"})
    EXPECT_THROW(run({"sphere", "--project", folder, "--size", size}), UsageError) << size;
  EXPECT_THROW(run({"sphere", "--project", folder, "--photographs", "0"}), UsageError);
  EXPECT_THROW(run({"sphere", "--project", folder, "--samples", "17"}), UsageError);
  EXPECT_THROW(run({"sphere", "--project", folder, "--focal", "101"}), UsageError);
  EXPECT_THROW(run({"sphere", "--project", folder, "--bounces", "61"}), UsageError);
  EXPECT_THROW(run({"sphere", "--project", folder, "--ambient", "-1"}), UsageError);
  EXPECT_THROW(run({"sphere", "--project", folder, "--out", "../cloud.ply"}), UsageError);
  EXPECT_THROW(run({"sphere", "--project", folder, "--out", "cloud.xyz"}), Error);
  EXPECT_TRUE(fs::is_empty(scratch.path()));
  EXPECT_EQ(run({"sphere", "--project", folder, "--photographs", "2", "--size", "32x24", "--out", "cloud.las", "--albedo"}), 0);
  EXPECT_THAT(out.str(), HasSubstr("2 photographs of 32 x 24 pixels"));
  EXPECT_THAT(read_text(folder + "/project.toml"), HasSubstr("cloud.las"));
  EXPECT_EQ(run({"--help"}), 0);
  EXPECT_THAT(out.str(), HasSubstr("--photographs"));
}

}  // namespace
}  // namespace chiaro::tools
