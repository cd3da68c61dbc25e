/// `chiaro run` as a user runs it, on a scene with a known answer.
#include <cmath>

#include "stream/base/folder_lock.h"
#include "stream/photo/image_io.h"
#include "tests/support/run_fixture.h"

namespace chiaro::test {
namespace {

namespace fs = std::filesystem;
using testing::HasSubstr;

class Run : public RunTest {
 protected:
  void expect_all_reused() const {
    const auto record = json("out/run.json");
    ASSERT_GE(record["stages"].size(), 10u);
    for (const auto& stage : record["stages"]) EXPECT_TRUE(stage["reused"].get<bool>()) << stage["name"];
  }
};

TEST_F(Run, LeavesEverythingThatTheContractLists) {
  scene();
  const ProcessResult ran = run("out");
  ASSERT_EQ(ran.code, 0) << ran.err;
  for (const char* name : {"store.chiaro", "albedo.ply", "lights.json", "run.json"}) EXPECT_TRUE(fs::exists(at("out") / name)) << name;
  for (const char* photo : {"photo_00", "photo_01", "photo_02"})
    for (const char* picture : {"albedo.exr", "sigma.exr", "residual.exr", "light.exr"}) {
      const fs::path path = at("out") / "photographs" / photo / picture;
      ASSERT_TRUE(fs::exists(path)) << path;
      stream::ImageOptions first;
      first.exr_channels = {stream::exr_channel_names(path).at(0)};
      const stream::ImageSource image(path, first);
      EXPECT_EQ(image.width(), 96);
      EXPECT_EQ(image.height(), 72);
    }
  EXPECT_THAT(stream::exr_channel_names(at("out/photographs/photo_00/light.exr")), testing::UnorderedElementsAre("direct", "indirect", "ambient"));
  EXPECT_THAT(stream::exr_channel_names(at("out/photographs/photo_00/albedo.exr")), testing::UnorderedElementsAre("R", "G", "B"));
  EXPECT_THAT(parts("out"), testing::IsEmpty());
  for (const auto& file : fs::recursive_directory_iterator(at("out/work/acquisitions"))) EXPECT_THAT(file.path().filename().string(), testing::Not(testing::StartsWith("observation"))) << "state of the search for the lights";
}

TEST_F(Run, WritesVertexPropertiesInTheOrderOfTheContract) {
  const TinyScene s = scene();
  ASSERT_EQ(run("out").code, 0);
  const PlyVertices ply = read_ply(at("out/albedo.ply"));
  EXPECT_THAT(ply.names, testing::ElementsAre("x", "y", "z", "nx", "ny", "nz", "red", "green", "blue", "albedo_r", "albedo_g", "albedo_b", "sigma", "photos"));
  EXPECT_THAT(ply.types, testing::ElementsAre("float", "float", "float", "float", "float", "float", "uchar", "uchar", "uchar", "float", "float", "float", "float", "ushort"));
  ASSERT_EQ(ply.size(), s.positions.size());
  std::size_t unseen = 0;
  for (std::size_t i = 0; i < ply.size(); ++i) {
    ASSERT_EQ(Vec3d(ply.columns[0][i], ply.columns[1][i], ply.columns[2][i]), s.positions[i]) << "order or position of point " << i;
    const bool seen = ply.column("photos")[i] > 0;
    unseen += !seen;
    for (const char* name : {"albedo_r", "albedo_g", "albedo_b", "sigma"}) ASSERT_EQ(std::isnan(ply.column(name)[i]), !seen) << name << " of point " << i;
  }
  EXPECT_GT(unseen, ply.size() / 4);          // the far side of the sphere
  EXPECT_LT(unseen, 2 * ply.size() / 3);
}

// Measured 0.0045 both: 0.05 of a sphere's radius between points, 0.03 between pixels. A calibrated range of +-0.6 % holds the absolute scale.
constexpr double kMaxAbsolute = 0.01, kMaxScaled = 0.008;

TEST_F(Run, FindsAlbedoAndLightsOfAPaintedSphere) {
  const TinyScene s = scene();
  ASSERT_EQ(run("out").code, 0);
  const AlbedoError e = albedo_error(read_ply(at("out/albedo.ply")), s.albedo);
  RecordProperty("absolute", std::to_string(e.absolute));
  RecordProperty("scaled", std::to_string(e.scaled));
  EXPECT_GT(e.seen, s.positions.size() / 3);
  EXPECT_LE(e.absolute, kMaxAbsolute);
  EXPECT_LE(e.scaled, kMaxScaled);
  const auto lights = json("out/lights.json").at("acquisitions").at(0);
  EXPECT_NEAR(lights["flash_intensity"].get<double>(), s.options.flash_intensity, 0.02 * s.options.flash_intensity);
  EXPECT_NEAR(lights["ambient"].get<double>(), s.options.ambient_radiance, 0.05 * s.options.ambient_radiance);
}

TEST_F(Run, ReadsPhotographsByCellsOfPixels) {
  // Points ten pixels apart and more. The scale is that of the reference target, whose outline is in pixels of the file.
  TinySceneOptions options;
  options.width_px = 578;
  options.height_px = 434;
  options.focal_px = 660;
  options.write_range = false;
  options.reference = true;
  const TinyScene s = scene(options);
  const auto width = [&](const std::string& out) { return json(out + "/work/cameras.json").at("cameras").at(0).at("lens").at("size").at(0).get<int>(); };
  const ProcessResult ran = run("out", {"--set", "acquisition.binning=4"});
  ASSERT_EQ(ran.code, 0) << ran.err;
  EXPECT_THAT(ran.err, testing::Not(HasSubstr("beyond the picture")));
  EXPECT_EQ(width("out"), 144);
  const AlbedoError cells = albedo_error(read_ply(at("out/albedo.ply")), s.albedo);
  EXPECT_LE(cells.absolute, kMaxAbsolute);
  // Each pixel by itself, which is what `auto` does with pictures as small as these.
  ASSERT_EQ(run("all").code, 0);
  EXPECT_EQ(width("all"), 578);
  const AlbedoError pixels = albedo_error(read_ply(at("all/albedo.ply")), s.albedo);
  EXPECT_LE(pixels.absolute, kMaxAbsolute);
  EXPECT_NEAR(cells.absolute, pixels.absolute, 0.003);
  EXPECT_NEAR(static_cast<double>(cells.seen), static_cast<double>(pixels.seen), 0.02 * static_cast<double>(pixels.seen));
  // In the same folder what depends on the pixels is made anew, with the same bytes as in a new one.
  ASSERT_EQ(run("all", {"--set", "acquisition.binning=4"}).code, 0);
  EXPECT_EQ(results("all"), results("out"));
}

/// Intensities are W/sr and radiances per square metre in any project: lengths alone change with the unit. Measured: albedo 3e-5, lights 1e-5, view 2e-4 apart, by rounding.
class RunInUnit : public RunTest, public testing::WithParamInterface<const char*> {};

TEST_P(RunInUnit, ComesToWhatItComesToInMetres) {
  TinySceneOptions options;
  const TinyScene s = scene(options, "metres");
  options.unit = GetParam();
  scene(options);
  ASSERT_EQ(run("m", {}, {}, "metres").code, 0);
  const ProcessResult ran = run("out");
  ASSERT_EQ(ran.code, 0) << ran.err;
  const PlyVertices here = read_ply(at("out/albedo.ply")), there = read_ply(at("m/albedo.ply"));
  std::vector<std::array<double, 3>> expected_albedo = s.albedo;
  for (std::size_t i = 0; i < there.size(); ++i)
    if (there.column("photos")[i] > 0) expected_albedo[i] = {there.column("albedo_r")[i], there.column("albedo_g")[i], there.column("albedo_b")[i]};
  EXPECT_LE(albedo_error(here, expected_albedo).absolute, 1e-3);
  const auto found = json("out/lights.json").at("acquisitions").at(0), expected = json("m/lights.json").at("acquisitions").at(0);
  for (const char* name : {"flash_intensity", "flash_intensity_sd", "ambient", "ambient_sd"}) EXPECT_NEAR(found[name].get<double>() / expected[name].get<double>(), 1, 0.01) << name;
  for (const std::string name : {"m", "out"})
    ASSERT_EQ(chiaro({"render", at(name).string(), "--views", at((name == "m" ? "metres" : "scene") + std::string("/novel/views.toml")).string(), "--out", at("novel_" + name).string()}).code, 0);
  const stream::Image view = stream::read_image(at("novel_out/novel_00.exr")), view_in_metres = stream::read_image(at("novel_m/novel_00.exr"));
  double error = 0, size = 0;
  for (std::size_t i = 0; i < view.values.size(); ++i) {
    error += std::abs(static_cast<double>(view.values[i]) - static_cast<double>(view_in_metres.values[i]));
    size += static_cast<double>(view_in_metres.values[i]);
  }
  EXPECT_LE(error / size, 2e-3);
}
INSTANTIATE_TEST_SUITE_P(Units, RunInUnit, testing::Values("cm", "mm"), [](const auto& i) { return std::string(i.param); });

TEST_F(Run, KeepsRatiosWhereTheRangeIsWide) {
  TinySceneOptions options;
  options.intensity_range = {6, 11};
  const TinyScene s = scene(options);
  ASSERT_EQ(run("out").code, 0);
  const AlbedoError e = albedo_error(read_ply(at("out/albedo.ply")), s.albedo);
  EXPECT_LE(e.scaled, kMaxScaled) << "factor " << e.factor;
}

TEST_F(Run, TakesTheScaleFromAReference) {
  TinySceneOptions options;
  options.write_range = false;
  options.reference = true;
  const TinyScene s = scene(options);
  const ProcessResult ran = run("out");
  ASSERT_EQ(ran.code, 0) << ran.err;
  EXPECT_LE(albedo_error(read_ply(at("out/albedo.ply")), s.albedo).absolute, kMaxAbsolute);
}

// The same where the photograph of the target comes last.
TEST_F(Run, TakesTheScaleFromAReferenceInTheLastPhotograph) {
  TinySceneOptions options;
  options.write_range = false;
  options.reference = true;
  const TinyScene s = scene(options);
  fs::rename(at("scene/photos/photo_00.exr"), at("scene/photos/photo_09.exr"));
  fs::rename(at("scene/masks/photo_00.png"), at("scene/masks/photo_09.png"));
  edit("scene/sparse/images.txt", "photo_00.exr", "photo_09.exr");
  edit("scene/project.toml", "photo_00", "photo_09");
  const ProcessResult ran = run("out");
  ASSERT_EQ(ran.code, 0) << ran.err;
  EXPECT_LE(albedo_error(read_ply(at("out/albedo.ply")), s.albedo).absolute, kMaxAbsolute);
}

// Each by itself finds its own ambient light, and its albedo is found under that. Measured: 0.001.
TEST_F(Run, SolvesEachPhotographUnderItsOwnLight) {
  TinySceneOptions options;
  options.uniform_paint = true;
  options.ambient_factors = {1, 3, 1};
  const TinyScene s = scene(options);
  const ProcessResult ran = run("out", {"--set", "solve.method=single"});
  ASSERT_EQ(ran.code, 0) << ran.err;
  const auto lights = json("out/lights.json").at("acquisitions").at(0).at("photographs");
  for (std::size_t k = 0; k < 3; ++k) EXPECT_NEAR(lights.at(k).at("ambient").get<double>() / (options.ambient_radiance * options.ambient_factors[k]), 1, 0.1) << k;
  const AlbedoError e = albedo_error(read_ply(at("out/albedo.ply")), s.albedo);
  RecordProperty("absolute", std::to_string(e.absolute));
  EXPECT_LE(e.absolute, 0.005);
  const stream::Image picture = stream::read_image(at("out/photographs/photo_01/albedo.exr"));
  std::vector<float> green;
  for (std::size_t i = 1; i < picture.values.size(); i += 3)
    if (picture.values[i] > 0) green.push_back(picture.values[i]);
  std::nth_element(green.begin(), green.begin() + static_cast<std::ptrdiff_t>(green.size() / 2), green.end());
  EXPECT_NEAR(static_cast<double>(green[green.size() / 2]) / s.albedo[0][1], 1, 0.02) << "of the one photograph whose light is another";
}

TEST_F(Run, EstimatesNormalsAndUndoesTheLens) {
  TinySceneOptions options;
  options.with_normals = false;
  options.with_colours = false;
  options.radial_k1 = -0.15;
  const TinyScene s = scene(options);
  const ProcessResult ran = run("out");
  ASSERT_EQ(ran.code, 0) << ran.err;
  EXPECT_LE(albedo_error(read_ply(at("out/albedo.ply")), s.albedo).absolute, 1.5 * kMaxAbsolute);
}

struct MethodCase {
  const char* name;
  bool uniform_paint;   // single photographs are told apart by paint alone: surfels of like chroma are taken for one material
  double max_scaled;    // direct and none leave light in the albedo by design, adam what its start left
};
class RunMethod : public RunTest, public testing::WithParamInterface<MethodCase> {};

TEST_P(RunMethod, FinishesWithItsOwnAccuracy) {
  TinySceneOptions options;
  options.uniform_paint = GetParam().uniform_paint;
  const TinyScene s = scene(options);
  const ProcessResult ran = run("out", {"--set", std::string("solve.method=") + GetParam().name});
  ASSERT_EQ(ran.code, 0) << ran.err;
  const AlbedoError e = albedo_error(read_ply(at("out/albedo.ply")), s.albedo);
  RecordProperty("scaled", std::to_string(e.scaled));
  EXPECT_GT(e.seen, s.positions.size() / 3);
  EXPECT_LE(e.scaled, GetParam().max_scaled) << "absolute " << e.absolute;
  const auto lights = json("out/lights.json").at("acquisitions").at(0);
  EXPECT_EQ(lights.at("method"), GetParam().name);
  // What finds no uncertainty by itself has that of the calibrated range, four deviations wide.
  const auto expect_that_of_the_range = [&](const nlohmann::json& light) {
    EXPECT_NEAR(light.at("flash_intensity_sd").get<double>() / light.at("flash_intensity").get<double>(), std::log(9.05 / 8.95) / 4, 1e-9);
  };
  if (std::string(GetParam().name) == "direct") expect_that_of_the_range(lights);
  if (std::string(GetParam().name) == "adam")
    for (const auto& light : lights.at("photographs")) expect_that_of_the_range(light);
}
// Measured, scaled: joint 0.0045, adam 0.077, direct 0.31, none 0.31.
INSTANTIATE_TEST_SUITE_P(Methods, RunMethod,
                         testing::Values(MethodCase{"joint", false, 0.008}, MethodCase{"single", true, 0.01}, MethodCase{"adam", false, 0.15}, MethodCase{"direct", false, 0.4}, MethodCase{"none", false, 0.4}),
                         [](const auto& i) { return std::string(i.param.name); });

TEST_F(Run, GivesTheSameBytesForAnyThreadsAndEachTime) {
  scene();
  ASSERT_EQ(run("one", {"--threads", "1"}).code, 0);
  ASSERT_EQ(run("two", {"--threads", "2"}).code, 0);
  ASSERT_EQ(run("again", {"--threads", "2"}).code, 0);
  EXPECT_THAT(differences(results("one"), results("two")), testing::IsEmpty());
  EXPECT_THAT(differences(results("two"), results("again")), testing::IsEmpty());
  EXPECT_GE(results("one").size(), 2u + 3 * 4);
}

TEST_F(Run, ReusesWhatIsDone) {
  scene();
  ASSERT_EQ(run("out").code, 0);
  const auto before = results("out");
  ASSERT_EQ(run("out").code, 0);
  EXPECT_THAT(differences(before, results("out")), testing::IsEmpty());
  expect_all_reused();
}

TEST_F(Run, NotesOnLightsNamePhotographsAsTheyAreCalledNow) {
  scene({.photographs = 1});
  ASSERT_EQ(run("out").code, 0);
  fs::rename(at("scene/photos/photo_00.exr"), at("scene/photos/photo_09.exr"));
  fs::rename(at("scene/masks/photo_00.png"), at("scene/masks/photo_09.png"));
  edit("scene/sparse/images.txt", "photo_00.exr", "photo_09.exr");
  const ProcessResult ran = run("out");
  ASSERT_EQ(ran.code, 0) << ran.err;
  EXPECT_THAT(ran.err, HasSubstr("photo_09: one photograph does not tell light from albedo"));
  EXPECT_THAT(ran.err, testing::Not(HasSubstr("photo_00")));
}

TEST_F(Run, RemovesWhatKilledRunsNeededMeanwhile) {
  scene({.photographs = 1});
  fs::create_directories(at("out/work/scratch/chiaro-Ab12Cd"));
  put_bytes(at("out/work/scratch/chiaro-Ab12Cd/means"), "x");
  put_bytes(at("out/work/scratch/blend.journal"), "x");
  put_bytes(at("scene/sparse/cameras.txt"), "1 NOTHING\n");
  EXPECT_EQ(run("out").code, 1);
  EXPECT_FALSE(fs::exists(at("out/work/scratch/chiaro-Ab12Cd")));
  EXPECT_TRUE(fs::exists(at("out/work/scratch/blend.journal")));   // a later run may go on from it
}

// What a process holds at its start is never the same twice; here it is made to differ by the words of its environment.
TEST_F(Run, ReusesWhatIsDoneWhateverTheProcessHoldsAtItsStart) {
  scene();
  ASSERT_EQ(run("out", {"--memory", "512MiB"}).code, 0);
  ProcessOptions larger;
  for (int i = 0; i < 10; ++i) larger.environment.push_back("CHIARO_TEST_" + std::to_string(i) + "=" + std::string(100000, 'x'));
  ASSERT_EQ(run("out", {"--memory", "512MiB"}, larger).code, 0);
  expect_all_reused();
}

TEST_F(Run, MakesAgainWhatWasCutOrRemoved) {
  scene({.photographs = 1});
  ASSERT_EQ(run("out").code, 0);
  const auto before = results("out");
  fs::remove(at("out/photographs/photo_00/sigma.exr"));
  fs::resize_file(at("out/photographs/photo_00/residual.exr"), 500);
  fs::resize_file(at("out/albedo.ply"), 1000);
  fs::resize_file(at("out/work/photographs/photo_00/gbuffer.raster"), 1000);
  const ProcessResult ran = run("out");
  EXPECT_EQ(ran.code, 0) << ran.err;
  EXPECT_THAT(differences(before, results("out")), testing::IsEmpty());
}

TEST_F(Run, ComesToTheSameResultAfterAChangeAndBack) {
  scene();
  ASSERT_EQ(run("out").code, 0);
  const auto before = results("out");
  ASSERT_EQ(run("out", {"--set", "acquisition.ambient.model=none"}).code, 0);
  EXPECT_THAT(differences(before, results("out")), testing::Contains("albedo.ply"));
  ASSERT_EQ(run("out").code, 0);
  EXPECT_THAT(differences(before, results("out")), testing::IsEmpty());
}

/// Whatever the lights depend on: with the rest as before they are not those of the run before.
TEST_F(Run, SolvesTheLightsAgainAfterAnyChangeOfWhatTheyDependOn) {
  scene({.photographs = 1, .reference = true});
  std::vector<std::string> words{"--set", "solve.method=direct"};
  const auto reused = [&] {
    const ProcessResult ran = run("out", words);
    EXPECT_EQ(ran.code, 0) << ran.err;
    const auto record = json("out/run.json");
    std::map<std::string, bool> of;
    for (const auto& stage : record["stages"]) of[stage["name"]] = stage["reused"].get<bool>();
    EXPECT_EQ(of.at("light/day1"), of.at("albedo/photo_00")) << "under other lights the albedo is another";
    return of.at("light/day1");
  };
  EXPECT_FALSE(reused());
  EXPECT_TRUE(reused());
  for (const auto& [from, to] : {std::pair{"intensity_range = [8.9", "intensity_range = [8.8"}, std::pair{"albedo = [", "albedo = [0.4, 0.4, 0.4]\n# ["}, std::pair{"sigma = 0.01", "sigma = 0.02"}, std::pair{"polygon = [[", "polygon = [[1, 1], ["}}) {
    edit("scene/project.toml", from, to);
    EXPECT_FALSE(reused()) << to;
  }
  for (const char* set : {"acquisition.ambient.model=uniform", "acquisition.falloff=none", "acquisition.ambient.floor=[0, 0, 1, -1.5]", "acquisition.ambient.floor=[0, 0, 1, -1.6]", "acquisition.ambient.floor=auto", "acquisition.ambient.floor=none", "run.seed=7", "project.unit=cm"}) {
    words.insert(words.end(), {"--set", set});
    EXPECT_FALSE(reused()) << set;
  }
  EXPECT_TRUE(reused());
}

TEST_F(Run, SolvesTheLightsAgainForAnotherShutterTime) {
  scene({.photographs = 1});
  fs::create_directory(at("scene/dark"));
  fs::copy_file(at("scene/photos/photo_00.exr"), at("scene/dark/photo_00.exr"));
  edit("scene/project.toml", "cameras = \"sparse\"\n", "cameras = \"sparse\"\nexposure_s = 0.1\n");
  put_bytes(at("scene/project.toml"), file_bytes(at("scene/project.toml")) + "\n[[acquisition]]\nname = \"dark\"\nrole = \"no_flash\"\nphotographs = [\"dark/photo_*.exr\"]\nencoding = \"linear\"\ncameras = \"sparse\"\n"
                                           "lights_of = \"day1\"\nexposure_s = 0.2\nnoise = { gain = 1e-5, read_sigma = 1e-4 }\n");
  const auto reused = [&](std::vector<std::string> more) {
    more.insert(more.end(), {"--set", "solve.method=direct"});
    const ProcessResult ran = run("out", more);
    EXPECT_EQ(ran.code, 0) << ran.err;
    const auto record = json("out/run.json");
    for (const auto& stage : record["stages"])
      if (stage["name"] == "light/day1") return stage["reused"].get<bool>();
    ADD_FAILURE() << "no such stage";
    return true;
  };
  EXPECT_FALSE(reused({}));
  EXPECT_TRUE(reused({}));
  EXPECT_FALSE(reused({"--set", "acquisition.dark.exposure_s=0.4"}));
}

TEST_F(Run, AFloorIsTheSamePlaneHoweverLongItsNormalIsWritten) {
  scene();
  const auto evidence = [&](const char* floor) {
    const ProcessResult ran = run("out", {"--set", std::string("acquisition.ambient.floor=") + floor});
    EXPECT_EQ(ran.code, 0) << ran.err;
    return json("out/lights.json").at("acquisitions").at(0).at("sky_evidence");
  };
  const auto one = evidence("[0, 0, 1, -1.5]"), other = evidence("[0, 0, 2, -3]"), lower = evidence("[0, 0, 1, -3]");
  ASSERT_GT(one.size(), 1u);
  EXPECT_EQ(one, other);
  EXPECT_NE(one, lower);
}

TEST_F(Run, LeavesAFolderAloneInWhichAnotherRunIsAtWork) {
  scene({.photographs = 1});
  ASSERT_EQ(run("out").code, 0);
  const auto before = files_below(at("out"), {});
  const FolderLock other(at("out/work"));
  const ProcessResult ran = run("out", {"--set", "solve.method=direct"});
  EXPECT_EQ(ran.code, 1);
  EXPECT_THAT(ran.err, HasSubstr("another chiaro is at work"));
  EXPECT_THAT(differences(before, files_below(at("out"), {})), testing::IsEmpty());
}

/// A scan whose normals point inwards: no photograph sees the front of anything.
TEST_F(Run, SaysThatTheNormalsPointInwards) {
  TinySceneOptions options;
  options.normals_inwards = true;
  scene(options);
  for (const char* method : {"joint", "none"}) {
    const ProcessResult ran = run("out", {"--set", std::string("solve.method=") + method});
    EXPECT_EQ(ran.code, 1) << method;
    EXPECT_THAT(ran.err, HasSubstr(" % of what the photographs show of the cloud, they see from behind")) << method;
    EXPECT_THAT(ran.err, HasSubstr("error: ")) << method;
    EXPECT_THAT(ran.err, HasSubstr("cloud.normals = \"estimate\"")) << method;
    EXPECT_EQ(json("out/run.json")["exit"], 1) << method;
  }
  EXPECT_EQ(run("out", {"--set", "cloud.normals=estimate"}).code, 0);
}

/// From either side of a sphere two photographs have a few grazing places in common, which tell nothing about their lights.
TEST_F(Run, SolvesPhotographsByThemselvesThatShareNothing) {
  TinySceneOptions options;
  options.azimuth_step = 2.6;
  options.from_level = true;
  options.photographs = 2;
  options.uniform_paint = true;
  const TinyScene s = scene(options);
  const ProcessResult ran = run("out");
  ASSERT_EQ(ran.code, 0) << ran.err;
  EXPECT_THAT(ran.err, HasSubstr("places of the cloud in common"));
  const auto lights = json("out/lights.json").at("acquisitions").at(0);
  ASSERT_EQ(lights.at("photographs").size(), 2u);
  EXPECT_THAT(lights.at("how").get<std::string>(), HasSubstr("each photograph by itself"));
  EXPECT_LE(albedo_error(read_ply(at("out/albedo.ply")), s.albedo).absolute, 0.03);
}

TEST_F(Run, StaysWithinItsMemory) {
  scene();
  const ProcessResult ran = run("out", {"--memory", "256MiB"});
  ASSERT_EQ(ran.code, 0) << ran.err;
  const auto memory = json("out/run.json")["memory"];
  EXPECT_EQ(memory["limit_bytes"], 256u << 20);
  EXPECT_GT(memory["peak_bytes"].get<std::uint64_t>(), 1u << 20);
  EXPECT_LE(memory["peak_bytes"].get<std::uint64_t>(), 256u << 20);
  EXPECT_LE(ran.peak_bytes, 256u << 20);
}

TEST_F(Run, CountsPointsOnceForSeveralExportsAndFindsAMovedCloud) {
  scene({.photographs = 1});
  ASSERT_EQ(run("out", {"--set", "solve.method=direct"}).code, 0);
  const std::string before = file_bytes(at("out/albedo.ply"));
  fs::rename(at("scene"), at("moved"));
  edit("moved/project.toml", "file = \"albedo.ply\"\n", "file = \"again.ply\"\n[[export]]\nfile = \"more.las\"\n");
  const ProcessResult ran = run("out", {"--set", "solve.method=direct"}, {}, "moved");
  ASSERT_EQ(ran.code, 0) << ran.err;
  EXPECT_THAT(ran.err, testing::Not(HasSubstr("positions come from the store")));
  EXPECT_EQ(file_bytes(at("out/again.ply")), before);
  EXPECT_EQ(json("out/run.json")["counts"]["points_out"], 6000);
}

TEST_F(Run, RecordsWhatItDid) {
  scene();
  ASSERT_EQ(run("out", {"--set", "run.seed=7"}).code, 0);
  const auto record = json("out/run.json");
  EXPECT_EQ(record["seed"], 7);
  EXPECT_EQ(record["exit"], 0);
  EXPECT_EQ(record["counts"]["points_in"], 6000);
  EXPECT_EQ(record["counts"]["points_out"], 6000);
  EXPECT_EQ(record["counts"]["photographs_used"], 3);
  EXPECT_EQ(record["counts"]["points_seen"].get<int>() + record["counts"]["points_unseen"].get<int>(), 6000);
  EXPECT_EQ(record["inputs"].size(), 4u);
  EXPECT_EQ(record["left_out"].size(), 0u);
}

TEST_F(Run, CanBeReportedVerifiedAndAskedForItsStatus) {
  scene();
  ASSERT_EQ(run("out").code, 0);
  const ProcessResult report = chiaro({"report", at("out").string()});
  EXPECT_EQ(report.code, 0) << report.err;
  EXPECT_THAT(file_bytes(at("out/report/index.html")), HasSubstr("photo_01"));
  const ProcessResult verified = chiaro({"verify", at("out/store.chiaro").string()});
  EXPECT_EQ(verified.code, 0) << verified.err;
  const ProcessResult status = chiaro({"status", at("out").string(), "--json"});
  ASSERT_EQ(status.code, 0) << status.err;
  EXPECT_TRUE(nlohmann::json::parse(status.out.substr(status.out.rfind("{\"event\":\"result\"")), nullptr, false).at("complete").get<bool>()) << status.out;
}

TEST_F(Run, PredictsAPhotographFromElsewhere) {
  const TinyScene s = scene();
  ASSERT_EQ(run("out").code, 0);
  const ProcessResult ran = chiaro({"render", at("out").string(), "--views", (s.folder / "novel/views.toml").string(), "--out", at("novel").string()});
  ASSERT_EQ(ran.code, 0) << ran.err;
  const stream::Image found = stream::read_image(at("novel/novel_00.exr")), truth = stream::read_image(s.folder / "novel/novel_00.exr");
  ASSERT_EQ(found.values.size(), truth.values.size());
  double error = 0, size = 0;
  for (std::size_t i = 0; i < truth.values.size(); ++i) {
    error += std::abs(static_cast<double>(found.values[i]) - static_cast<double>(truth.values[i]));
    size += static_cast<double>(truth.values[i]);
  }
  RecordProperty("relative", std::to_string(error / size));
  EXPECT_LE(error / size, 0.03);   // its outline included
}

TEST_F(Run, DoesNotRenderOverAPhotograph) {
  const TinyScene s = scene({.photographs = 1});
  ASSERT_EQ(run("out", {"--set", "solve.method=none"}).code, 0);
  edit("scene/novel/views.toml", "name = \"novel_00\"", "name = \"photo_00\"");
  const std::string photograph = file_bytes(s.folder / "photos/photo_00.exr");
  const ProcessResult ran = chiaro({"render", at("out").string(), "--albedo", "--views", (s.folder / "novel/views.toml").string(), "--out", (s.folder / "photos").string()});
  EXPECT_EQ(ran.code, 1);
  EXPECT_THAT(ran.err, HasSubstr("photos/photo_00.exr: is a photograph of the run, it is not written over; choose another --out"));
  EXPECT_TRUE(file_bytes(s.folder / "photos/photo_00.exr") == photograph);
}

TEST_F(Run, NotesWhatAViewDoesNotShow) {
  TinySceneOptions options;
  options.masks = false;
  const TinyScene s = scene(options);
  const auto render = [&] { return chiaro({"render", at("out").string(), "--views", (s.folder / "novel/views.toml").string(), "--out", at("novel").string()}); };
  ASSERT_EQ(run("out", {"--set", "solve.method=direct"}).code, 0);
  EXPECT_THAT(render().err, testing::Not(HasSubstr("note")));

  edit("scene/project.toml", "photo_*.exr", "photo_0[01].exr");
  put_bytes(s.project, file_bytes(s.project) + "\n[[acquisition]]\nname = \"day2\"\nphotographs = [\"photos/photo_02.exr\"]\ncameras = \"sparse\"\n[acquisition.flash]\noffset_in_camera = [0.25, -0.2, 0.02]\nintensity_range = [8.95, 9.05]\n");
  ASSERT_EQ(run("out", {"--set", "solve.method=direct"}).code, 0);
  EXPECT_THAT(render().err, HasSubstr("lights of 2 acquisitions; views are shown in those of \"day1\""));

  edit("scene/project.toml", "name = \"day2\"", "name = \"day2\"\nlights_of = \"day1\"");   // the same ones
  ASSERT_EQ(run("out", {"--set", "solve.method=direct"}).code, 0);
  EXPECT_THAT(render().err, testing::Not(HasSubstr("note")));

  put_bytes(at("out/work/progress"), "+ingest\n");   // as a run leaves it that was killed there
  const std::string views = file_bytes(s.folder / "novel/views.toml");
  const std::size_t shift = views.find("translation_camera_from_world");
  put_bytes(s.folder / "novel/views.toml", views.substr(0, shift) + "translation_camera_from_world = [0.0, 0.0, -50.0]" + views.substr(views.find('\n', shift)));
  const ProcessResult ran = render();
  EXPECT_EQ(ran.code, 0) << ran.err;
  EXPECT_THAT(ran.err, HasSubstr("novel_00: shows nothing of the cloud"));
  EXPECT_THAT(ran.err, HasSubstr("did not come to its end"));
}

TEST_F(Run, RendersTheColourOfARunThatSolvedNoLights) {
  const TinyScene s = scene({.photographs = 1});
  ASSERT_EQ(run("out", {"--set", "solve.method=none"}).code, 0);
  const std::vector<std::string> words{"render", at("out").string(), "--views", (s.folder / "novel/views.toml").string(), "--out", at("novel").string()};
  const ProcessResult lit = chiaro(words);
  EXPECT_EQ(lit.code, 1);
  EXPECT_THAT(lit.err, HasSubstr("--albedo"));
  std::vector<std::string> albedo = words;
  albedo.emplace_back("--albedo");
  const ProcessResult ran = chiaro(albedo);
  ASSERT_EQ(ran.code, 0) << ran.err;
  const stream::Image picture = stream::read_image(at("novel/novel_00.exr"));
  EXPECT_GT(*std::max_element(picture.values.begin(), picture.values.end()), 0.05f);
}

TEST_F(Run, PutsItsResultsBesideTheProjectByDefault) {
  const TinyScene s = scene({.photographs = 1});
  const ProcessResult ran = chiaro({"run", s.project.string()});
  ASSERT_EQ(ran.code, 0) << ran.err;
  EXPECT_TRUE(fs::exists(s.folder / "tiny.out" / "albedo.ply"));
}

TEST_F(Run, SpeaksJsonLineByLine) {
  scene({.photographs = 1});
  const ProcessResult ran = run("out", {"--json"});
  ASSERT_EQ(ran.code, 0) << ran.err;
  std::istringstream lines(ran.out);
  nlohmann::json last;
  int count = 0;
  for (std::string line; std::getline(lines, line); ++count) {
    last = nlohmann::json::parse(line, nullptr, false);
    ASSERT_TRUE(last.is_object()) << line;
    ASSERT_TRUE(last.contains("event")) << line;
  }
  EXPECT_GT(count, 1);
  EXPECT_EQ(last["event"], "result");
}

}  // namespace
}  // namespace chiaro::test
