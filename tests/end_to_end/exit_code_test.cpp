/// How `chiaro run` ends when something is wrong: the code, the message, and what is (not) left behind.
#include "tests/support/run_fixture.h"

namespace chiaro::test {
namespace {

namespace fs = std::filesystem;
using testing::HasSubstr;

class ExitCode : public RunTest {};

struct WrongProject {
  const char* name;
  const char* from;
  const char* to;
  const char* message;   // part of the error
};
class WrongProjectFile : public RunTest, public testing::WithParamInterface<WrongProject> {};

TEST_P(WrongProjectFile, IsRefusedWithTwoBeforeAnythingIsWritten) {
  scene({.photographs = 1});
  edit("scene/project.toml", GetParam().from, GetParam().to);
  const ProcessResult ran = run("out");
  EXPECT_EQ(ran.code, 2) << ran.err;
  EXPECT_THAT(ran.err, HasSubstr("error: "));
  EXPECT_THAT(ran.err, HasSubstr("project.toml"));
  EXPECT_THAT(ran.err, HasSubstr(GetParam().message));
  EXPECT_FALSE(fs::exists(at("out/albedo.ply")));
}

INSTANTIATE_TEST_SUITE_P(
    Projects, WrongProjectFile,
    testing::Values(WrongProject{"NoToml", "[project]", "[project", "project.toml:"}, WrongProject{"UnknownKey", "encoding =", "encodnig =", "did you mean \"encoding\"?"},
                    WrongProject{"UnknownTable", "[acquisition.ambient]", "[acquisition.ambeint]", "did you mean \"ambient\"?"},
                    WrongProject{"RangeMinAboveMax", "intensity_range = [8.95, 9.05]", "intensity_range = [9.05, 8.95]", "intensity_range"},
                    WrongProject{"UnknownModel", "model = \"auto\"", "model = \"autp\"", "did you mean \"auto\"?"}, WrongProject{"NegativeNoise", "gain = 1e-05", "gain = -1e-05", "gain"},
                    WrongProject{"NoSuchPhotographs", "photos/photo_*.exr", "photos/nothing_*.exr", "nothing_"}, WrongProject{"NoSuchCameras", "cameras = \"sparse\"", "cameras = \"sparce\"", "sparce"},
                    WrongProject{"NotANumber", "offset_in_camera = [0.25", "offset_in_camera = [nan", "offset_in_camera"},
                    WrongProject{"UnitNobodyKnows", "unit = \"m\"", "unit = \"parsec\"", "unit"}),
    [](const auto& i) { return std::string(i.param.name); });

TEST_F(ExitCode, IsTwoWithoutAFlash) {
  scene({.photographs = 1, .flash = false});
  const ProcessResult ran = run("out");
  EXPECT_EQ(ran.code, 2);
  EXPECT_THAT(ran.err, HasSubstr("solve.method = \"none\""));
  const ProcessResult colour = run("out", {"--set", "solve.method=none"});
  EXPECT_EQ(colour.code, 0) << colour.err;
  EXPECT_TRUE(fs::exists(at("out/albedo.ply")));
}

TEST_F(ExitCode, IsTwoForAWrongCommandLine) {
  scene({.photographs = 1});
  EXPECT_THAT(run("out", {"--memroy", "1GiB"}).err, HasSubstr("did you mean \"--memory\"?"));
  for (const std::vector<std::string>& words : std::vector<std::vector<std::string>>{{"--memroy", "1GiB"}, {"--memory", "much"}, {"--threads", "-1"}, {"--set", "solve.methd=joint"}, {"--set", "solve.method"}})
    EXPECT_EQ(run("out", words).code, 2) << words[0] << " " << words.back();
}

TEST_F(ExitCode, IsTwoWithoutAProjectFile) {
  for (const fs::path& file : {at("nothing.toml"), scratch_.path()}) {
    const ProcessResult ran = chiaro({"run", file.string()});
    EXPECT_EQ(ran.code, 2);
    EXPECT_THAT(ran.err, HasSubstr(file.string() + ": "));
    EXPECT_THAT(ran.err, HasSubstr("expected a project file"));
  }
}

TEST_F(ExitCode, NamesACloudThatIsMissing) {
  const TinyScene s = scene({.photographs = 1});
  fs::remove(s.folder / "cloud.ply");
  const ProcessResult ran = run("out");
  // The project file names a file that is not there: 2 by load_project's contract.
  EXPECT_THAT(ran.code, testing::AnyOf(1, 2));
  EXPECT_THAT(ran.err, HasSubstr("cloud.ply"));
}

TEST_F(ExitCode, IsOneForACloudThatEndsEarly) {
  const TinyScene s = scene({.photographs = 1});
  fs::resize_file(s.folder / "cloud.ply", 50000);
  const ProcessResult ran = run("out");
  EXPECT_EQ(ran.code, 1);
  EXPECT_THAT(ran.err, HasSubstr("cloud.ply"));
  EXPECT_FALSE(fs::exists(at("out/store.chiaro")));
}

TEST_F(ExitCode, IsOneWhereTheOnlyPhotographIsDamaged) {
  const TinyScene s = scene({.photographs = 1});
  fs::resize_file(s.folder / "photos/photo_00.exr", 3000);
  const ProcessResult ran = run("out");
  EXPECT_EQ(ran.code, 1);
  EXPECT_THAT(ran.err, HasSubstr("photo_00"));
  EXPECT_FALSE(fs::exists(at("out/albedo.ply")));
  EXPECT_EQ(json("out/run.json")["exit"], 1);
}

TEST_F(ExitCode, IsOneWhereNothingOfTheCloudIsSeen) {
  const TinyScene s = scene({.photographs = 1});
  // Turned by half a turn about the camera's own y axis: it looks away.
  put_bytes(s.folder / "sparse/images.txt", "1 1 0 0 0 0 0 -9 1 photo_00.exr\n\n");
  const ProcessResult ran = run("out");
  EXPECT_EQ(ran.code, 1) << ran.err;
  EXPECT_THAT(ran.err, HasSubstr("photo_00"));
}

/// Damages the scene in one way; the run must leave photo_01 out, say why, and go on with the others.
struct Damage {
  const char* name;
  void (*apply)(const TinyScene&);
  const char* reason;
};
class OnePhotographLess : public RunTest, public testing::WithParamInterface<Damage> {};

TEST_P(OnePhotographLess, FinishesWithThreeAndNamesIt) {
  const TinyScene s = scene();
  GetParam().apply(s);
  const ProcessResult ran = run("out");
  EXPECT_EQ(ran.code, 3) << ran.err;
  EXPECT_THAT(ran.err, HasSubstr("photo_01"));
  const auto record = json("out/run.json");
  ASSERT_EQ(record["left_out"].size(), 1u);
  EXPECT_EQ(record["left_out"][0]["kind"], "photograph");
  EXPECT_EQ(record["left_out"][0]["name"], "photo_01");
  EXPECT_THAT(record["left_out"][0]["reason"].get<std::string>(), HasSubstr(GetParam().reason));
  EXPECT_EQ(record["exit"], 3);
  EXPECT_EQ(record["counts"]["photographs_used"], 2);
  EXPECT_LE(albedo_error(read_ply(at("out/albedo.ply")), s.albedo).absolute, 0.03);
}

INSTANTIATE_TEST_SUITE_P(
    Damages, OnePhotographLess,
    testing::Values(Damage{"PhotographEndsEarly", [](const TinyScene& s) { fs::resize_file(s.folder / "photos/photo_01.exr", 5000); }, "photo_01.exr"},
                    Damage{"PhotographIsText", [](const TinyScene& s) { put_bytes(s.folder / "photos/photo_01.exr", "no picture"); }, "photo_01.exr"},
                    Damage{"MaskOfAnotherSize",
                           [](const TinyScene& s) {
                             TinySceneOptions other;
                             other.width_px = 48;
                             other.height_px = 36;
                             write_tiny_scene(s.folder / "small", other);
                             fs::copy_file(s.folder / "small/masks/photo_01.png", s.folder / "masks/photo_01.png", fs::copy_options::overwrite_existing);
                           },
                           "mask"},
                    Damage{"MaskIsDamaged", [](const TinyScene& s) { fs::resize_file(s.folder / "masks/photo_01.png", 60); }, "photo_01.png"},
                    Damage{"CameraIsMissing",
                           [](const TinyScene& s) {
                             std::string text = file_bytes(s.folder / "sparse/images.txt");
                             const std::size_t line = text.find("\n2 ") + 1;
                             text.erase(line, text.find('\n', line) + 2 - line);
                             put_bytes(s.folder / "sparse/images.txt", text);
                           },
                           "no camera"}),
    [](const auto& i) { return std::string(i.param.name); });

TEST_F(ExitCode, WhatAnEarlierRunMadeOfAPhotographThatIsLeftOutNowGoes) {
  const TinyScene s = scene();
  ASSERT_EQ(run("out").code, 0);
  ASSERT_TRUE(fs::exists(at("out/photographs/photo_01/albedo.exr")));
  put_bytes(s.folder / "photos/photo_01.exr", "no picture");
  ASSERT_EQ(run("out").code, 3);
  EXPECT_FALSE(fs::exists(at("out/photographs/photo_01")));
  EXPECT_TRUE(fs::exists(at("out/photographs/photo_00/albedo.exr")));
}

TEST_F(ExitCode, IsThreeForPointsThatAreNotFinite) {
  const TinyScene s = scene({.photographs = 1});
  std::string bytes = file_bytes(s.folder / "cloud.ply");
  const std::size_t body = bytes.find("end_header\n") + 11;
  for (int i = 0; i < 4; ++i) bytes[body + 27 * 100 + static_cast<std::size_t>(i)] = static_cast<char>(0xff);   // x of point 100
  put_bytes(s.folder / "cloud.ply", bytes);
  const ProcessResult ran = run("out");
  EXPECT_EQ(ran.code, 3) << ran.err;
  const auto record = json("out/run.json");
  EXPECT_EQ(record["counts"]["points_rejected"], 1);
  EXPECT_EQ(record["left_out"][0]["kind"], "points");
}

TEST_F(ExitCode, Is130AfterAnInterruptAndTheRunGoesOn) {
  scene();
  ASSERT_EQ(run("whole").code, 0);
  ProcessOptions interrupt;
  interrupt.signal_when = [this] { return fs::exists(at("out/work/tasks/ingest.json")); };
  for (const int signal : {SIGINT, SIGTERM, SIGHUP}) {
    interrupt.signal = signal;
    fs::remove_all(at("out"));
    const ProcessResult ran = run("out", {}, interrupt);
    EXPECT_EQ(ran.code, 130) << signal << ": " << ran.err;
    EXPECT_FALSE(ran.signalled) << signal;
    EXPECT_THAT(ran.err, HasSubstr("interrupted"));
    EXPECT_FALSE(fs::exists(at("out/albedo.ply")));
    EXPECT_EQ(json("out/run.json")["exit"], 130);
  }
  ASSERT_EQ(run("out").code, 0);
  EXPECT_THAT(differences(results("whole"), results("out")), testing::IsEmpty());
  EXPECT_TRUE(json("out/run.json")["stages"][0]["reused"].get<bool>());
}

}  // namespace
}  // namespace chiaro::test
