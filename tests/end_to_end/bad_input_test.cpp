/// What photographs cannot tell, and photographs that are not what the project says: a result all the same, with a sigma and a note that say so.
#include <algorithm>
#include <cmath>
#include <functional>
#include <iterator>
#include <sstream>

#include "stream/base/rng.h"
#include "stream/photo/image_io.h"
#include "tests/support/run_fixture.h"

namespace chiaro::test {
namespace {

namespace fs = std::filesystem;
using testing::HasSubstr;

class BadInput : public RunTest {
 protected:
  AlbedoError error_of(const TinyScene& s) const { return albedo_error(read_ply(at("out/albedo.ply")), s.albedo); }

  /// Over the points that have one.
  double median_sigma() const {
    const PlyVertices ply = read_ply(at("out/albedo.ply"));
    std::vector<double> v;
    for (std::size_t i = 0; i < ply.size(); ++i) {
      if (ply.column("photos")[i] == 0) continue;
      EXPECT_TRUE(std::isfinite(ply.column("sigma")[i]) && std::isfinite(ply.column("albedo_g")[i])) << "point " << i;
      v.push_back(ply.column("sigma")[i]);
    }
    std::sort(v.begin(), v.end());
    return v.empty() ? NAN : v[v.size() / 2];
  }

  nlohmann::json lights() const { return json("out/lights.json").at("acquisitions").at(0); }

  /// f(value, index of the value) for every value of a photograph.
  static void change(const TinyScene& s, int photograph, const std::function<float(float, std::size_t)>& f) {
    const fs::path file = s.folder / "photos" / ("photo_0" + std::to_string(photograph) + ".exr");
    stream::Image image = stream::read_image(file);
    for (std::size_t i = 0; i < image.values.size(); ++i) image.values[i] = f(image.values[i], i);
    stream::write_exr(file, image.width, image.height, {"R", "G", "B"}, image.values, false);
  }
};

TEST_F(BadInput, OnePhotographOfAConvexBodySaysHowLittleItTells) {
  TinySceneOptions options;
  options.photographs = 1;
  options.intensity_range = {7, 11};   // sd 11 %
  const TinyScene s = scene(options);
  const ProcessResult ran = run("out");
  ASSERT_EQ(ran.code, 0) << ran.err;
  EXPECT_THAT(ran.err, HasSubstr("photo_00: one photograph does not tell light from albedo by itself: flash known to 11 %"));
  EXPECT_GT(median_sigma(), 0.1);
  EXPECT_LE(std::fabs(std::log(error_of(s).factor)), 2 * median_sigma());
}

TEST_F(BadInput, APhotographUnderAnotherAmbientLightIsNamedAndCorrected) {
  TinySceneOptions options;
  options.photographs = 4;
  const TinyScene s = scene(options);
  options.ambient_radiance *= 2;
  const TinyScene lamp = scene(options, "lamp");
  fs::copy_file(lamp.folder / "photos/photo_02.exr", s.folder / "photos/photo_02.exr", fs::copy_options::overwrite_existing);
  change(s, 2, [](float v, std::size_t) { return 0.8f * v; });
  const ProcessResult ran = run("out");
  ASSERT_EQ(ran.code, 0) << ran.err;
  EXPECT_THAT(ran.err, HasSubstr("photo_02: ambient light "));
  EXPECT_NEAR(lights().at("ambient_factors").at("photo_02").at("factor").get<double>(), 2, 0.1);
  EXPECT_NEAR(lights().at("exposures").at("photo_02").get<double>(), 0.8, 0.02);
  EXPECT_EQ(lights().at("ambient_factors").size(), 1u);
  EXPECT_EQ(lights().at("exposures").size(), 1u);
  EXPECT_LE(error_of(s).absolute, 0.02);
}

TEST_F(BadInput, AnOffsetOfTheFlashWithYUpIsNamedAndNothingIsChanged) {
  TinySceneOptions options;
  options.photographs = 4;
  const TinyScene s = scene(options);
  ASSERT_EQ(run("out").code, 0);
  EXPECT_THAT(file_bytes(at("out/run.json")), testing::Not(HasSubstr("looks as if it were written")));
  const auto [x, y, z] = options.flash_in_camera;
  std::ostringstream right, wrong;
  right << "offset_in_camera = [" << x << ", " << y << ", " << z << "]";
  wrong << "offset_in_camera = [" << x << ", " << -y << ", " << z << "]";
  edit("scene/project.toml", right.str(), wrong.str());
  const ProcessResult ran = run("out");
  ASSERT_EQ(ran.code, 0) << ran.err;
  EXPECT_THAT(ran.err, HasSubstr("flash." + wrong.str() + " looks as if it were written with y up"));
  EXPECT_THAT(ran.err, HasSubstr("write " + right.str()));
  EXPECT_THAT(file_bytes(at("out/run.json")), HasSubstr("looks as if it were written"));
}

TEST_F(BadInput, ValuesWithACurveThatAreTakenAsLinearAreNoticed) {
  TinySceneOptions options;
  options.photographs = 4;
  const TinyScene s = scene(options);
  for (int k = 0; k < 4; ++k) change(s, k, [](float v, std::size_t) { return v <= 0.0031308f ? 12.92f * v : 1.055f * std::pow(v, 1 / 2.4f) - 0.055f; });
  const ProcessResult ran = run("out");
  ASSERT_EQ(ran.code, 0) << ran.err;
  EXPECT_THAT(ran.err, HasSubstr("the photographs look as if they held the sRGB curve, and are taken as linear"));
  EXPECT_THAT(ran.err, HasSubstr("write encoding = \"srgb\""));
}

/// What they see of a smooth sphere changes slowly, and its outlines tell.
TEST_F(BadInput, CamerasOfAnotherScaleAreNoticedByTheMasks) {
  TinySceneOptions options;
  options.photographs = 4;
  const TinyScene s = scene(options);
  std::istringstream before(file_bytes(s.folder / "sparse/images.txt"));
  std::ostringstream after;
  for (std::string line; std::getline(before, line);) {
    std::istringstream words(line);
    std::vector<std::string> word{std::istream_iterator<std::string>(words), {}};
    for (std::size_t i = 5; word.size() == 10 && word[0] != "#" && i < 8; ++i) word[i] = std::to_string(1.3 * std::stod(word[i]));
    for (const std::string& w : word) after << w << ' ';
    after << '\n';
  }
  put_bytes(s.folder / "sparse/images.txt", after.str());
  const ProcessResult ran = run("out");
  ASSERT_EQ(ran.code, 0) << ran.err;
  EXPECT_THAT(ran.err, HasSubstr(" % of the pixels that the masks leave show nothing of the cloud"));
}

TEST_F(BadInput, APhotographThatWasOverexposedAndClippedIsReadWhereItIsNot) {
  TinySceneOptions options;
  options.photographs = 4;
  const TinyScene s = scene(options);
  const stream::Image before = stream::read_image(s.folder / "photos/photo_01.exr");
  const float white = *std::max_element(before.values.begin(), before.values.end());
  change(s, 1, [white](float v, std::size_t) { return std::min(2 * v, white); });
  const ProcessResult ran = run("out");
  ASSERT_EQ(ran.code, 0) << ran.err;
  EXPECT_THAT(json("out/run.json").at("notes").dump(), HasSubstr("photo_01.exr: "));
  EXPECT_THAT(json("out/run.json").at("notes").dump(), HasSubstr("pixels share the brightest value of the file"));
  EXPECT_THAT(ran.err, testing::Not(HasSubstr("pixels that the masks leave")));
  EXPECT_NEAR(lights().at("exposures").at("photo_01").get<double>(), 2, 0.04);
  EXPECT_LE(error_of(s).absolute, 0.02);
}

TEST_F(BadInput, WithoutAnyCalibrationOnlyRatiosAreClaimed) {
  TinySceneOptions options;
  options.photographs = 1;
  options.write_range = false;
  const TinyScene s = scene(options);
  const ProcessResult ran = run("out");
  ASSERT_EQ(ran.code, 0) << ran.err;
  EXPECT_THAT(ran.err, HasSubstr("albedo is known up to one factor"));
  EXPECT_THAT(lights()["absolute_scale"].get<std::string>(), HasSubstr("trust ratios"));
  EXPECT_GT(median_sigma(), 0.3);
  EXPECT_LE(error_of(s).scaled, 0.05);
  EXPECT_LE(std::fabs(std::log(error_of(s).factor)), 2 * median_sigma());
}

/// The flash reaches nothing: photographs of ambient light alone, and a calibrated flash that says nothing about them.
class Unlit : public BadInput, public testing::WithParamInterface<int> {
 protected:
  void expect_ratios(const TinyScene& s, const ProcessResult& ran) {
    ASSERT_EQ(ran.code, 0) << ran.err;
    EXPECT_THAT(ran.err, HasSubstr("the flash reaches nothing that is seen"));
    EXPECT_THAT(lights()["absolute_scale"].get<std::string>(), HasSubstr("trust ratios"));
    const AlbedoError e = error_of(s);
    EXPECT_GT(e.seen, s.positions.size() / 5);
    EXPECT_LE(e.scaled, 0.02);
    EXPECT_GT(median_sigma(), 0.25);   // of the scale: a guess that is 35 % wide, in the ambient light it began with
    EXPECT_LE(std::fabs(std::log(e.factor)), 2 * median_sigma());
  }
};
INSTANTIATE_TEST_SUITE_P(Photographs, Unlit, testing::Values(1, 3), [](const auto& i) { return std::to_string(i.param); });

TEST_P(Unlit, ByAFlashBehindTheObject) {
  TinySceneOptions options;
  options.photographs = GetParam();
  options.flash_in_camera = {0, 0, 9};
  const TinyScene s = scene(options);
  expect_ratios(s, run("out"));
}

/// ASCII PLY: a square plate half a metre in front of the flash of each photograph, turned towards the object, 0.4 m wide: its shadow covers the sphere.
std::string plates(const TinyScene& s) {
  std::string rows;
  std::size_t count = 0;
  std::istringstream lines(file_bytes(s.folder / "sparse/images.txt"));
  for (std::string line; std::getline(lines, line);) {
    std::istringstream words(line);
    double id = 0, w = 0, x = 0, y = 0, z = 0;
    Vec3d t;
    if (!(words >> id >> w >> x >> y >> z >> t[0] >> t[1] >> t[2])) continue;
    const Eigen::Map<const Vec3d> offset(s.options.flash_in_camera.data());
    const Vec3d flash = Eigen::Quaterniond(w, x, y, z).toRotationMatrix().transpose() * (offset - t), n = -flash.normalized();
    const Vec3d a = n.cross(Vec3d(0, 0, 1)).normalized(), b = n.cross(a);
    for (int i = 0; i < 1600; ++i, ++count) {
      const Vec3d p = flash + 0.5 * n + 0.01 * (i % 40 - 19.5) * a + 0.01 * (i / 40 - 19.5) * b;
      std::ostringstream row;
      row << p.x() << ' ' << p.y() << ' ' << p.z() << ' ' << n.x() << ' ' << n.y() << ' ' << n.z() << '\n';
      rows += row.str();
    }
  }
  std::string header = "ply\nformat ascii 1.0\nelement vertex " + std::to_string(count) + "\n";
  for (const char* name : {"x", "y", "z", "nx", "ny", "nz"}) header += std::string("property float ") + name + "\n";
  return header + "end_header\n" + rows;
}

TEST_P(Unlit, InCastShadow) {
  TinySceneOptions options;
  options.photographs = GetParam();
  options.flash_in_camera = {3, 0, 0};   // beside the view, and its plate too
  options.flash_intensity = 0;           // what the shadow leaves of it
  const TinyScene s = scene(options);
  put_bytes(s.folder / "plates.ply", plates(s));
  edit("scene/project.toml", "files = [\"cloud.ply\"]", "files = [\"cloud.ply\", \"plates.ply\"]");
  expect_ratios(s, run("out"));
}

TEST_F(BadInput, AFlashThatDidNotFireIsNoticed) {
  TinySceneOptions options;
  options.flash_intensity = 0;
  scene(options);
  const ProcessResult ran = run("out");
  ASSERT_EQ(ran.code, 0) << ran.err;
  EXPECT_THAT(ran.err, HasSubstr("did it fire?"));
  EXPECT_GT(median_sigma(), 0.5);
}

TEST_F(BadInput, AmbientLightDarkerThanTheNoiseDoesNoHarm) {
  TinySceneOptions options;
  options.ambient_radiance = 2e-4;   // surfaces of albedo 0.5 give back 1e-4
  options.noise_gain = 0;
  options.read_sigma = 1e-3;
  const TinyScene s = scene(options);
  for (int k = 0; k < 3; ++k)
    change(s, k, [&](float v, std::size_t i) { return v + static_cast<float>(options.read_sigma * normal01(5, Purpose::kTest, i, static_cast<std::uint32_t>(k))); });
  const ProcessResult ran = run("out");
  ASSERT_EQ(ran.code, 0) << ran.err;
  EXPECT_NEAR(error_of(s).factor, 1, 0.01);
  EXPECT_LE(error_of(s).absolute, 0.03);   // 0.021: the noise of the pixels
  EXPECT_NEAR(lights()["ambient"].get<double>(), options.ambient_radiance, 3 * lights()["ambient_sd"].get<double>() + 1e-4);
}

TEST_F(BadInput, ValuesBelowBlackAreNoMeasurement) {
  const TinyScene s = scene();
  change(s, 0, [](float v, std::size_t) { return -v; });
  const ProcessResult ran = run("out");
  ASSERT_EQ(ran.code, 0) << ran.err;
  EXPECT_LE(error_of(s).absolute, 0.01);
  EXPECT_LT(median_sigma(), 0.05);
}

TEST_F(BadInput, AFifthOfTheValuesBelowBlackLeavesTheOthers) {
  const TinyScene s = scene();
  for (int k = 0; k < 3; ++k) change(s, k, [](float v, std::size_t i) { return i % 5 == 0 ? -v : v; });
  const ProcessResult ran = run("out");
  ASSERT_EQ(ran.code, 0) << ran.err;
  EXPECT_LE(error_of(s).absolute, 0.03);
  EXPECT_LT(median_sigma(), 0.5);
}

TEST_F(BadInput, NothingAboveBlackIsAnError) {
  const TinyScene s = scene();
  for (int k = 0; k < 3; ++k) change(s, k, [](float v, std::size_t) { return -v; });
  const ProcessResult ran = run("out");
  EXPECT_EQ(ran.code, 1);
  EXPECT_THAT(ran.err, HasSubstr("no surfel of the cloud is seen well enough"));
}

TEST_F(BadInput, APhotographOfAnotherObjectIsLeftOutAndNamed) {
  TinySceneOptions options;
  options.photographs = 5;
  const TinyScene s = scene(options);
  TinySceneOptions other = options;
  other.uniform_paint = true;
  const TinyScene t = scene(other, "other");
  stream::Image upside_down = stream::read_image(t.folder / "photos/photo_03.exr");
  std::reverse(upside_down.values.begin(), upside_down.values.end());
  stream::write_exr(s.folder / "photos/photo_01.exr", upside_down.width, upside_down.height, {"R", "G", "B"}, upside_down.values, false);
  const ProcessResult ran = run("out");
  EXPECT_EQ(ran.code, 3) << ran.err;
  const auto record = json("out/run.json");
  ASSERT_EQ(record["left_out"].size(), 1u);
  EXPECT_EQ(record["left_out"][0]["name"], "photo_01");
  EXPECT_THAT(record["left_out"][0]["reason"].get<std::string>(), HasSubstr("something else"));
  EXPECT_EQ(record["counts"]["photographs_used"], 4);
  EXPECT_LE(error_of(s).absolute, 0.01);
  EXPECT_NEAR(lights()["ambient"].get<double>(), options.ambient_radiance, 0.02 * options.ambient_radiance);
}

TEST_F(BadInput, AnAlbedoThatNoSurfaceHasIsNoted) {
  const TinyScene s = scene();
  const std::vector<std::string> direct{"--set", "solve.method=direct"};
  EXPECT_THAT(run("out", direct).err, testing::Not(HasSubstr("hardly that of any surface")));
  edit("scene/project.toml", "[8.95, 9.05]", "[895, 905]");   // as of photographs in other numbers, or of lengths in another unit
  for (int k = 0; k < 2; ++k) EXPECT_THAT(run("out", direct).err, HasSubstr("hardly that of any surface: nearly all of it is below 0.01"));
  edit("scene/project.toml", "[895, 905]", "[3.55, 3.65]");
  EXPECT_THAT(run("out", direct).err, HasSubstr("hardly that of any surface: half of it is above 1."));
  edit("scene/project.toml", "[3.55, 3.65]", "[0.895, 0.905]");
  const ProcessResult nothing = run("out", direct);   // beyond what is given a value
  EXPECT_EQ(nothing.code, 1);
  EXPECT_THAT(nothing.err, HasSubstr("acquisition \"day1\": 100 % of the pixels that the light reaches would reflect more than twice of it"));
  EXPECT_EQ(run("out", {"--set", "solve.method=none"}).err.find("hardly"), std::string::npos);
}

TEST_F(BadInput, ARangeThatAReferenceContradictsIsNamed) {
  TinySceneOptions options;
  options.intensity_range = {10, 12};   // sd 4.6 % around 10.95; the truth is 9
  options.reference = true;             // known to 1 %
  const TinyScene s = scene(options);
  const ProcessResult ran = run("out");
  ASSERT_EQ(ran.code, 0) << ran.err;
  EXPECT_THAT(ran.err, HasSubstr("speak against the flash's calibrated range of 10 to 12 W/sr"));
  EXPECT_THAT(ran.err, HasSubstr("by themselves they say 9 W/sr"));
  EXPECT_LE(error_of(s).absolute, 0.03);
}

TEST_F(BadInput, ARangeThatWouldMakeSurfacesWhiterThanWhiteIsNamed) {
  TinySceneOptions options;
  options.intensity_range = {3, 3.2};   // a third of the truth: albedos up to 2.6
  const TinyScene s = scene(options);
  const ProcessResult ran = run("out");
  ASSERT_EQ(ran.code, 0) << ran.err;
  EXPECT_THAT(ran.err, HasSubstr("speak against the flash's calibrated range of 3 to 3.2 W/sr"));
}

TEST_F(BadInput, ATargetBesideThePictureIsNoted) {
  TinySceneOptions options;
  options.reference = true;
  scene(options);
  edit("scene/project.toml", "polygon = [[46, 34], [50, 34], [50, 38], [46, 38]]", "polygon = [[46, 34], [50, 34], [50, 80], [46, 80]]");
  const ProcessResult ran = run("out");
  ASSERT_EQ(ran.code, 0) << ran.err;
  EXPECT_THAT(ran.err, HasSubstr("photo_00: the reference target reaches beyond the picture (96 x 72 pixels)"));
}

TEST_F(BadInput, ATargetOfAPhotographThatIsLeftOutIsNotCounted) {
  TinySceneOptions options;
  options.reference = true;
  const TinyScene s = scene(options);
  change(s, 0, [](float, std::size_t) { return std::nanf(""); });
  const ProcessResult ran = run("out");
  ASSERT_EQ(ran.code, 3) << ran.err;
  EXPECT_THAT(ran.err, HasSubstr("photo_00 was left out, and the reference target in it with it"));
  EXPECT_EQ(lights().at("references"), 0);
}

TEST_F(BadInput, NamesThatAreNotUtf8DoNotEndARun) {
  // The layer of a picture, in Latin-1, is named in a note; the folder of a rendering in the result.
  const TinyScene s = scene({.photographs = 1});
  const stream::Image picture = stream::read_image(s.folder / "photos/photo_00.exr");
  stream::write_exr(s.folder / "photos/photo_00.exr", picture.width, picture.height, {"sch\xf6n.R", "sch\xf6n.G", "sch\xf6n.B"}, picture.values, false);
  ProcessResult ran = run("out", {"--set", "solve.method=none"});
  ASSERT_EQ(ran.code, 0) << ran.err;
  EXPECT_THAT(ran.err, HasSubstr("colour is taken from the layer"));
  ran = chiaro({"render", at("out").string(), "--albedo", "--views", (s.folder / "novel/views.toml").string(), "--out", at("sch\xf6n").string(), "--json"});
  EXPECT_EQ(ran.code, 0) << ran.err;
  EXPECT_TRUE(fs::exists(at("sch\xf6n/novel_00.exr")));
}

TEST_F(BadInput, ScaledCopiesOfWhatTheCameraIsOfAreNotedOnce) {
  const TinyScene s = scene();
  edit("scene/sparse/cameras.txt", "96 72 110 110 48 36", "192 144 220 220 96 72");
  const ProcessResult ran = run("out");
  ASSERT_EQ(ran.code, 0) << ran.err;
  EXPECT_THAT(ran.err, HasSubstr("96 x 72 pixels where the camera is of 192 x 144: taken as a scaled copy of all of it"));
  EXPECT_LE(error_of(s).absolute, 0.02);
}

TEST_F(BadInput, SinglePrecisionFarFromTheOriginIsNotedInTheRecordToo) {
  const TinyScene s = scene();
  std::string text = "ply\nformat ascii 1.0\nelement vertex " + std::to_string(s.positions.size()) + "\nproperty float x\nproperty float y\nproperty float z\nend_header\n";
  for (const Vec3d& p : s.positions) text += std::to_string(p.x() + 500000) + " " + std::to_string(p.y() + 4000000) + " " + std::to_string(p.z()) + "\n";
  put_bytes(s.folder / "cloud.ply", text);
  for (int k = 0; k < 2; ++k) {   // a run that goes on, or is repeated, has it as well
    (void)run("out", {"--set", "solve.method=direct"});
    EXPECT_THAT(file_bytes(at("out/run.json")), HasSubstr("cloud.ply: its coordinates have single precision"));
  }
}

TEST_F(BadInput, UprightAndLyingPhotographsOfOneAcquisitionAreNoted) {
  TinySceneOptions options;
  options.masks = false;
  const TinyScene s = scene(options);
  EXPECT_THAT(run("out", {"--set", "solve.method=direct"}).err, testing::Not(HasSubstr("upright")));
  // One is cropped to a part that stands: of that size, whatever it was turned from.
  const fs::path file = s.folder / "photos/photo_02.exr";
  const stream::Image image = stream::read_image(file);
  const int width = 48, left = (image.width - width) / 2;
  std::vector<float> part;
  for (int y = 0; y < image.height; ++y)
    for (int i = 3 * (y * image.width + left); i < 3 * (y * image.width + left + width); ++i) part.push_back(image.values[static_cast<std::size_t>(i)]);
  stream::write_exr(file, width, image.height, {"R", "G", "B"}, part, false);
  put_bytes(s.folder / "sparse/cameras.txt", file_bytes(s.folder / "sparse/cameras.txt") + "\n2 PINHOLE 48 72 110 110 24 36\n");
  edit("scene/sparse/images.txt", "1 photo_02.exr", "2 photo_02.exr");
  const ProcessResult ran = run("out", {"--set", "solve.method=direct"});
  EXPECT_EQ(ran.code, 0) << ran.err;
  EXPECT_THAT(ran.err, HasSubstr("1 of its photographs stand upright (photo_02), 2 lie (photo_00, "));
  EXPECT_THAT(ran.err, HasSubstr("offset_in_camera = [0.2, 0.25, 0.02] (turned clockwise) or [-0.2, -0.25, 0.02]"));
  // A flash around the lens has no side.
  edit("scene/project.toml", "[0.25, -0.2, 0.02]", "[0, 0, 0.02]");
  EXPECT_THAT(run("out", {"--set", "solve.method=direct"}).err, testing::Not(HasSubstr("upright")));
}

TEST_F(BadInput, MasksTheOtherWayRoundAreNoticed) {
  const TinyScene s = scene();
  const std::vector<std::string> direct{"--set", "solve.method=direct"};
  EXPECT_THAT(run("out", direct).err, testing::Not(HasSubstr("the other way round")));
  for (int k = 0; k < 3; ++k) {
    const fs::path file = s.folder / "masks" / ("photo_0" + std::to_string(k) + ".png");
    const stream::Image mask = stream::read_image(file);
    std::vector<std::uint8_t> turned;
    const std::size_t channels = mask.values.size() / (static_cast<std::size_t>(mask.width) * static_cast<std::size_t>(mask.height));
    for (std::size_t i = 0; i < mask.values.size(); i += channels) turned.push_back(mask.values[i] > 0.5f ? 0 : 255);
    stream::write_png_srgb8(file, mask.width, mask.height, turned, 1);
  }
  EXPECT_THAT(run("out", direct).err, HasSubstr("white is what is used. Are the masks the other way round"));
}

TEST_F(BadInput, OneCameraForPhotographsOfTwoAcquisitionsIsNoted) {
  TinySceneOptions options;
  options.masks = false;
  const TinyScene s = scene(options);
  fs::create_directories(s.folder / "left");
  fs::copy_file(s.folder / "photos/photo_02.exr", s.folder / "left/photo_00.exr");
  fs::remove(s.folder / "photos/photo_02.exr");
  put_bytes(s.project, file_bytes(s.project) + "\n[[acquisition]]\nname = \"left\"\nphotographs = [\"left/photo_*.exr\"]\ncameras = \"sparse\"\n[acquisition.flash]\noffset_in_camera = [0.25, -0.2, 0.02]\n");
  ProcessResult ran = run("out", {"--set", "solve.method=direct"});
  EXPECT_EQ(ran.code, 0) << ran.err;
  EXPECT_THAT(ran.err, HasSubstr("left/photo_00.exr have one camera, \"photo_00.exr\" of "));
  // A second shutter time, or none of the flash, is taken from where the first was.
  edit("scene/project.toml", "name = \"left\"", "name = \"left\"\nrole = \"no_flash\"");
  edit("scene/project.toml", "[acquisition.flash]\noffset_in_camera = [0.25, -0.2, 0.02]\n", "");
  ran = run("out", {"--set", "solve.method=direct"});
  EXPECT_THAT(ran.err, testing::Not(HasSubstr("have one camera")));
}

TEST_F(BadInput, ARangeThatHoldsTheTruthIsNotDoubted) {
  TinySceneOptions options;
  options.intensity_range = {7.5, 9.5};
  options.reference = true;
  scene(options);
  const ProcessResult ran = run("out");
  ASSERT_EQ(ran.code, 0) << ran.err;
  EXPECT_THAT(ran.err, testing::Not(HasSubstr("speak against")));
}

TEST_F(BadInput, AFlashBesideItsPlaceIsFound) {
  const TinyScene s = scene();
  edit("scene/project.toml", "offset_in_camera = [0.25, -0.2, 0.02]", "offset_in_camera = [0.29, -0.18, 0.02]");
  const ProcessResult ran = run("out");
  ASSERT_EQ(ran.code, 0) << ran.err;
  EXPECT_THAT(ran.err, HasSubstr("is offset_in_camera right?"));
  const auto shift = lights().at("flash_shift_in_camera");
  EXPECT_NEAR(shift[0].get<double>(), -0.04, 0.015);
  EXPECT_NEAR(shift[1].get<double>(), -0.02, 0.015);
  EXPECT_LE(error_of(s).absolute, 0.01);
}

TEST_F(BadInput, AFlashThatIsNotAlwaysTheSameIsFollowed) {
  TinySceneOptions options;
  options.photographs = 5;
  const TinyScene s = scene(options);
  const double ln[] = {0.04, -0.03, 0.02, -0.045, 0.015};
  for (int k = 0; k < 5; ++k) change(s, k, [&](float v, std::size_t) { return v * static_cast<float>(std::exp(ln[k])); });
  const ProcessResult ran = run("out");
  ASSERT_EQ(ran.code, 0) << ran.err;
  EXPECT_THAT(ran.err, testing::ContainsRegex("the brightness of its photographs varies by [2-5][.0-9]* % .*x to the right, y down, z forwards"));
  EXPECT_NEAR(lights().at("exposure_spread").get<double>(), 0.035, 0.015);
  EXPECT_NEAR(lights().at("exposures").at("photo_00").get<double>() / lights().at("exposures").at("photo_03").get<double>(), std::exp(0.085), 0.01);
  EXPECT_LE(error_of(s).absolute, 0.02);
}

TEST_F(BadInput, AmbientLightThatIsNotAlwaysTheSameIsFollowed) {
  TinySceneOptions options;
  options.photographs = 5;
  options.ambient_factors = {1.5, 0.75, 1.25, 0.65, 1.1};
  const TinyScene s = scene(options);
  const ProcessResult ran = run("out");
  ASSERT_EQ(ran.code, 0) << ran.err;
  EXPECT_THAT(ran.err, HasSubstr("the ambient light of its photographs varies by"));
  EXPECT_NEAR(lights().at("ambient_spread").get<double>(), 0.33, 0.12);
  const auto factor = [&](const char* photograph) { return lights().at("ambient_factors").at(photograph).at("factor").get<double>(); };
  EXPECT_NEAR(factor("photo_00") / factor("photo_03"), 1.5 / 0.65, 0.15);
  EXPECT_LE(error_of(s).absolute, 0.02);
}

TEST_F(BadInput, AVignetteIsTakenOff) {
  TinySceneOptions options;
  options.photographs = 4;
  options.lens_loss = 0.35;
  const TinyScene s = scene(options);
  const ProcessResult ran = run("out");
  ASSERT_EQ(ran.code, 0) << ran.err;
  EXPECT_THAT(ran.err, HasSubstr("the photographs are darker towards their corners"));
  EXPECT_EQ(lights().at("falloff").at("of"), "lens");
  EXPECT_NEAR(lights().at("falloff").at("kept_in_corners").get<double>(), 0.65, 0.04);
  EXPECT_LE(error_of(s).absolute, 0.02);
}

TEST_F(BadInput, AFlashThatIsWeakerOffItsAxisIsFollowedThereAndInNewViews) {
  TinySceneOptions options;
  options.photographs = 4;
  options.flash_loss = 0.45;
  options.ambient_radiance = 0.4;
  const TinyScene s = scene(options);
  const ProcessResult ran = run("out");
  ASSERT_EQ(ran.code, 0) << ran.err;
  EXPECT_EQ(lights().at("falloff").at("of"), "flash");
  EXPECT_NEAR(lights().at("falloff").at("kept_in_corners").get<double>(), 0.55, 0.05);
  EXPECT_LE(error_of(s).absolute, 0.02);
  ASSERT_EQ(chiaro({"render", at("out").string(), "--views", (s.folder / "novel/views.toml").string(), "--out", at("novel").string()}).code, 0);
  const stream::Image view = stream::read_image(at("novel/novel_00.exr")), truth = stream::read_image(s.folder / "novel/novel_00.exr");
  double error = 0;
  std::size_t count = 0;
  for (std::size_t i = 1; i < view.values.size(); i += 3)
    if (truth.values[i] > 0.02f && view.values[i] > 0) {
      error += std::fabs(std::log(static_cast<double>(view.values[i] / truth.values[i])));
      ++count;
    }
  EXPECT_GT(count, 500u);
  EXPECT_LE(error / static_cast<double>(count), 0.03);
}

TEST_F(BadInput, AFalloffThatTheProjectRulesOutStaysInTheAlbedo) {
  TinySceneOptions options;
  options.photographs = 4;
  options.lens_loss = 0.35;
  const TinyScene s = scene(options);
  edit("scene/project.toml", "encoding = \"linear\"", "encoding = \"linear\"\nfalloff = \"none\"");
  const ProcessResult ran = run("out");
  ASSERT_EQ(ran.code, 0) << ran.err;
  EXPECT_FALSE(lights().contains("falloff"));
  EXPECT_GT(error_of(s).absolute, 0.04);
}

// The same scene, a hundred times smaller: 1.3 mm is nothing unlikely, 13 cm would be.
TEST_F(BadInput, AFlashBesideItsPlaceIsFoundInCentimetres) {
  const TinyScene s = scene();
  edit("scene/project.toml", "unit = \"m\"", "unit = \"cm\"");
  edit("scene/project.toml", "intensity_range = [8.95, 9.05]", "intensity_range = [8.95e-4, 9.05e-4]");
  edit("scene/project.toml", "offset_in_camera = [0.25, -0.2, 0.02]", "offset_in_camera = [0.35, -0.12, 0.02]");
  const ProcessResult ran = run("out");
  ASSERT_EQ(ran.code, 0) << ran.err;
  EXPECT_THAT(ran.err, HasSubstr("the flash stands 1 mm from where"));
  const auto shift = lights().at("flash_shift_in_camera");
  EXPECT_NEAR(shift[0].get<double>(), -0.1, 0.03);
  EXPECT_NEAR(shift[1].get<double>(), -0.08, 0.03);
  EXPECT_LE(error_of(s).absolute, 0.02);
}

}  // namespace
}  // namespace chiaro::test
