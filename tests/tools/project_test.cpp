#include "tools/project.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <cstdlib>
#include <fstream>
#include <limits>
#include <nlohmann/json.hpp>

#include "stream/base/error.h"
#include "stream/base/file.h"

namespace chiaro::tools {
namespace {

namespace fs = std::filesystem;
using testing::HasSubstr;
using Words = std::vector<std::string>;

const char kValid[] = R"([project]
name = "tower"
unit = "mm"

[cloud]
files   = ["cloud.ply", "more/*.ply"]
normals = "file"
outliers = "statistical"
align = "icp"

[[acquisition]]
name        = "day1"
photographs = "photos/photo_*.exr"
encoding    = "linear"
masks       = "masks/{stem}.png"
cameras     = "sparse"
exposure_s  = 8e-3
noise       = { gain = 1e-4, read_sigma = 4e-4 }

[acquisition.flash]
offset_in_camera    = [0.13, -0.16, 3]
intensity_range     = [25.0, 34]

[acquisition.focus]
distance     = 1500
f_number     = 8
focal_length = 35

[[acquisition.reference]]
photograph = "photo_9"
polygon    = [[124, 260], [133, 260], [133, 269], [124, 269]]
albedo     = [0.80, 0.76, 1]
sigma      = 0.02

[acquisition.ambient]
model = "sh1"

[[acquisition]]
name        = "night"
role        = "no_flash"
photographs = ["photos/photo_1.exr"]
cameras     = "sparse"
exposure_s  = 0.5

[solve]
method = "single"

[blend]
reject = false
gain   = "channels"
align  = false

[run]
memory  = "512 MiB"
threads = 2
seed    = 7

[[export]]
file = "albedo.las"

[[export]]
file = "albedo.ply"
fill = true
)";

class ProjectTest : public testing::Test {
 protected:
  void SetUp() override {
    for (const char* file : {"cloud.ply", "more/b_10.ply", "more/b_9.ply", "photos/photo_10.exr", "photos/photo_9.exr", "photos/photo_1.exr", "masks/photo_10.png",
                             "masks/photo_9.png", "sparse/cameras.txt"}) {
      make_folder((scratch_.path() / file).parent_path());
      std::ofstream(scratch_.path() / file) << "x";
    }
  }
  Project load(const std::string& text, const Words& overrides = {}) {
    std::ofstream(file_, std::ios::binary) << text;
    return load_project(file_, overrides);
  }
  /// kValid with one text replaced.
  static std::string changed(const std::string& from, const std::string& to) {
    std::string text = kValid;
    const std::size_t at = text.find(from);
    EXPECT_NE(at, std::string::npos) << from;
    return text.replace(at, from.size(), to);
  }
  std::string complaint(const std::string& text, const Words& overrides = {}) {
    try {
      load(text, overrides);
    } catch (const UsageError& e) {
      std::string message = e.what();
      const std::string folder = scratch_.path().string() + "/";
      for (std::size_t at = message.find(folder); at != std::string::npos; at = message.find(folder)) message.erase(at, folder.size());
      return message;
    }
    return "none";
  }
  ScratchFolder scratch_;
  fs::path file_ = scratch_.path() / "project.toml";
};

TEST_F(ProjectTest, ReadsEveryKey) {
  const Project p = load(kValid);
  EXPECT_EQ(p.name, "tower");
  EXPECT_EQ(p.unit, "mm");
  EXPECT_EQ(p.metres_per_unit, 1e-3);
  ASSERT_EQ(p.cloud.files.size(), 3u);
  EXPECT_EQ(p.cloud.files[1], scratch_.path() / "more/b_9.ply") << "natural order";
  EXPECT_EQ(p.cloud.normals, Normals::kFile);
  EXPECT_EQ(p.cloud.outliers, Outliers::kStatistical);
  EXPECT_EQ(p.cloud.align, Alignment::kIcp);
  ASSERT_EQ(p.acquisitions.size(), 2u);
  const Acquisition& day = p.acquisitions[0];
  ASSERT_EQ(day.photographs.size(), 3u);
  EXPECT_EQ(day.photographs[0].key, "day1.photo_1") << "another acquisition has that stem too";
  EXPECT_EQ(day.photographs[1].key, "photo_9");
  EXPECT_EQ(day.photographs[2].mask, scratch_.path() / "masks/photo_10.png");
  EXPECT_TRUE(day.photographs[0].mask.empty());
  ASSERT_EQ(p.notes.size(), 1u);
  EXPECT_THAT(p.notes[0], HasSubstr("1 of 3 photographs have no mask and are used whole: photo_1"));
  EXPECT_EQ(day.encoding, Encoding::kLinear);
  EXPECT_EQ(day.role, AcquisitionRole::kFlash);
  EXPECT_EQ(day.cameras, scratch_.path() / "sparse");
  EXPECT_EQ(day.noise->gain, 1e-4);
  EXPECT_EQ(day.noise->read_sigma, 4e-4);
  EXPECT_EQ(day.flash->offset_in_camera, Vec3d(0.13, -0.16, 3));
  EXPECT_EQ((*day.flash->intensity_range)[1], 34);
  ASSERT_EQ(day.references.size(), 1u);
  EXPECT_EQ(day.references[0].photograph, 1u);
  EXPECT_EQ(day.references[0].polygon[2], Vec2d(133, 269));
  EXPECT_EQ(day.references[0].albedo[2], 1);
  EXPECT_EQ(day.references[0].sigma, 0.02);
  ASSERT_TRUE(day.focus);
  EXPECT_EQ(day.focus->distance, 1500);
  EXPECT_EQ(day.focus->f_number, 8);
  EXPECT_EQ(day.focus->focal_length, 35);
  EXPECT_EQ(day.ambient, AmbientModel::kSh1);
  EXPECT_EQ(day.floor, FloorModel::kAuto);
  EXPECT_EQ(day.falloff, FalloffModel::kAuto);
  EXPECT_EQ(load(changed("model = \"sh1\"", "floor = [0, 0, 2, -1]")).acquisitions[0].floor_plane, (std::array<double, 4>{0, 0, 2, -1}));
  const Acquisition& night = p.acquisitions[1];
  EXPECT_EQ(night.role, AcquisitionRole::kNoFlash);
  EXPECT_EQ(night.encoding, Encoding::kLinear) << "by the extension";
  EXPECT_FALSE(night.flash || night.noise || night.focus || night.binning);
  EXPECT_EQ(night.photographs[0].key, "night.photo_1");
  EXPECT_EQ(day.exposure_s, 8e-3);
  EXPECT_EQ(night.exposure_s, 0.5);
  EXPECT_EQ(night.lights_of, 0u) << "the acquisition before it";
  EXPECT_FALSE(day.lights_of);
  EXPECT_EQ(p.method, SolveMethod::kSingle);
  EXPECT_EQ(p.memory_bytes, 512u << 20);
  EXPECT_EQ(p.threads, 2);
  EXPECT_EQ(p.seed, 7u);
  ASSERT_EQ(p.exports.size(), 2u);
  EXPECT_FALSE(p.exports[0].fill);
  EXPECT_TRUE(p.exports[1].fill);
  EXPECT_EQ(default_output(p), scratch_.path() / "tower.out");
}

TEST_F(ProjectTest, NormalsMayBeLeftOut) {
  const Project p = load(changed("normals = \"file\"", "normals = \"none\""));
  EXPECT_EQ(p.cloud.normals, Normals::kNone);
  EXPECT_STREQ(name_of(p.cloud.normals), "none");
}

TEST_F(ProjectTest, HasDefaultsForAllButTheInputs) {
  const Project p = load("[cloud]\nfiles = \"cloud.ply\"\n[[acquisition]]\nphotographs = \"photos/*.exr\"\ncameras = \"sparse\"\n");
  EXPECT_EQ(p.name, "project");
  EXPECT_EQ(p.unit, "m");
  EXPECT_EQ(p.method, SolveMethod::kJoint);
  EXPECT_EQ(p.memory_bytes, std::uint64_t{2} << 30);
  EXPECT_EQ(p.acquisitions[0].ambient, AmbientModel::kAuto);
  EXPECT_EQ(p.acquisitions[0].name, "acquisition1");
  ASSERT_EQ(p.exports.size(), 1u);
  EXPECT_EQ(p.exports[0].file, "albedo.ply");
}

TEST_F(ProjectTest, NamesPositionAndNearestKey) {
  EXPECT_EQ(complaint(changed("intensity_range ", "intensity_rang ")),
            "project.toml:22:1: unknown key \"intensity_rang\" in [acquisition.flash]; did you mean \"intensity_range\"?");
  EXPECT_EQ(complaint(changed("[solve]", "[slove]")), "project.toml:45:2: unknown key \"slove\"; did you mean \"solve\"?");
  EXPECT_EQ(complaint(changed("\"single\"", "\"singel\"")), "project.toml:46:10: solve.method: unknown value \"singel\"; did you mean \"single\"?");
  EXPECT_EQ(complaint(changed("photographs = ", "photograps = ")),
            "project.toml:13:1: unknown key \"photograps\" in [acquisition]; did you mean \"photographs\"?");
  EXPECT_EQ(complaint(changed("\"photo_9\"", "\"photo_8\"")),
            "project.toml:30:14: acquisition.reference.photograph: \"photo_8\" is none of the photographs of \"day1\"; did you mean \"photo_1\"?");
  EXPECT_THAT(complaint("[cloud\n"), HasSubstr("project.toml:"));
  EXPECT_THAT(complaint(changed("[cloud]", "[cloud]\nfiles = 1\n")), HasSubstr("project.toml:8:"));
}

TEST_F(ProjectTest, RefusesWrongKindsAndValues) {
  const auto expect = [&](const char* from, const char* to, const char* message) { EXPECT_THAT(complaint(changed(from, to)), HasSubstr(message)) << to; };
  expect("unit = \"mm\"", "unit = \"km\"", "3:8: project.unit: unknown unit \"km\"; known: m, cm, mm");
  expect("name = \"tower\"", "name = \"../tower\"", "project.name");
  expect("name = \"tower\"", "name = \"a\\u0000b\"", "control characters");
  expect("name = \"tower\"", "name = 3", "project.name: expected a text, found a whole number");
  expect("\"cloud.ply\"", "\"cloud.plz\"", "6:12: cloud.files: no such file: \"cloud.plz\"");
  expect("\"more/*.ply\"", "\"more/*.las\"", "cloud.files: no file matches");
  expect("\"more/*.ply\"", "\"more/../cloud.ply\"", "is named twice");
  expect("\"more/*.ply\"", "\"more\"", "is not a file");
  expect("[\"cloud.ply\", \"more/*.ply\"]", "[]", "no files named");
  expect("\"sparse\"", "\"sprase\"", "no such file or folder");
  expect("masks/{stem}", "maks/{stem}", "no photograph has a mask");
  expect("gain = 1e-4", "gain = -1e-4", "must not be negative");
  expect("gain = 1e-4, read_sigma = 4e-4", "gain = 0, read_sigma = 0", "must be positive");
  expect("[25.0, 34]", "[34, 25.0]", "22:23: acquisition.flash.intensity_range: minimum 34 is greater than maximum 25");
  expect("[25.0, 34]", "[0, 25.0]", "expected positive");
  expect("[25.0, 34]", "[nan, 25.0]", "expected a finite number");
  expect("[25.0, 34]", "[25.0]", "expected 2 numbers, found 1");
  expect("[0.13, -0.16, 3]", "[0.13, -0.16, inf]", "finite");
  expect("offset_in_camera    = [0.13, -0.16, 3]\n", "", "acquisition.flash.offset_in_camera is missing");
  expect("[[124, 260], [133, 260], [133, 269], [124, 269]]", "[[124, 260], [133, 260]]", "at least 3 corners");
  expect("[133, 269], [124, 269]]", "[142, 260]]", "enclose no area");
  expect("[124, 260]", "[124, \"a\"]", "expected a number, found a text");
  expect("[0.80, 0.76, 1]", "[0.80, 0.76, 1.01]", "outside (0, 1]");
  expect("[0.80, 0.76, 1]", "[0.80, 0, 1]", "outside (0, 1]");
  expect("sigma      = 0.02", "sigma = 0", "positive");
  expect("model = \"sh1\"", "floor = [0, 0, 0, 1]", "acquisition.ambient.floor: expected [nx, ny, nz, h] with an upward direction that is not 0");
  expect("model = \"sh1\"", "floor = [0, 0, 1]", "expected 4 numbers, found 3");
  expect("model = \"sh1\"", "floor = \"yes\"", "acquisition.ambient.floor: unknown value \"yes\"");
  expect("name        = \"night\"", "name = \"day1\"", "two acquisitions are called");
  expect("\"512 MiB\"", "\"-1 GiB\"", "run.memory");
  expect("\"512 MiB\"", "-5", "run.memory: -5 is outside");
  expect("threads = 2", "threads = -1", "outside 0 .. 4096");
  expect("threads = 2", "threads = 1.5", "expected a whole number");
  expect("seed    = 7", "seed = -7", "run.seed");
  expect("\"albedo.las\"", "\"albedo.obj\"", "expected .ply, .las or .pcd");
  expect("\"albedo.las\"", "\"./albedo.ply\"", "is written twice");
  expect("fill = true", "fill = 1", "expected true or false");
  expect("[run]", "run = 3\n[ran]", "unknown key \"ran\"");
  EXPECT_THAT(complaint(""), HasSubstr("cloud is missing"));
  EXPECT_THAT(complaint("[cloud]\nfiles='cloud.ply'"), HasSubstr("acquisition is missing"));
}

TEST_F(ProjectTest, RefusesLensesThatCannotBe) {
  const auto expect = [&](const char* from, const char* to, const char* message) { EXPECT_THAT(complaint(changed(from, to)), HasSubstr(message)) << to; };
  expect("f_number     = 8", "f_number = 0", "acquisition.focus.f_number: expected a number above 0, found 0");
  expect("f_number     = 8\n", "", "f_number");
  expect("distance     = 1500", "distance = 30", "a lens of focal length 35 cannot be focused at distance 30");
  expect("focal_length = 35", "focal = 35", "did you mean \"focal_length\"?");
}

TEST_F(ProjectTest, ReadsBinning) {
  const auto with = [&](const char* binning) { return changed("exposure_s  = 8e-3\n", concat("exposure_s  = 8e-3\nbinning = ", binning, "\n").c_str()); };
  EXPECT_EQ(load(kValid).acquisitions[0].binning, std::nullopt);
  EXPECT_EQ(load(with("\"auto\"")).acquisitions[0].binning, std::nullopt);
  EXPECT_EQ(load(with("4")).acquisitions[0].binning, 4);
  const auto expect = [&](const char* binning, const char* message) { EXPECT_THAT(complaint(with(binning)), HasSubstr(message)) << binning; };
  expect("\"none\"", "acquisition.binning: expected \"auto\" or a whole number from 1 to 64");
  expect("2.5", "acquisition.binning: expected \"auto\" or a whole number from 1 to 64");
  expect("0", "acquisition.binning: 0 is outside 1 .. 64");
  expect("65", "acquisition.binning: 65 is outside 1 .. 64");
}

TEST_F(ProjectTest, RefusesLightsThatCannotBeShared) {
  const auto expect = [&](const char* from, const char* to, const char* message) { EXPECT_THAT(complaint(changed(from, to)), HasSubstr(message)) << to; };
  expect("exposure_s  = 0.5", "exposure_s = 0", "acquisition.exposure_s: expected a shutter time above 0");
  expect("exposure_s  = 0.5\n", "", "give exposure_s for both, or for neither");
  expect("exposure_s  = 0.5", "exposure_s = 0.5\nlights_of = \"day2\"", "acquisition.lights_of: \"day2\" is none of the acquisitions; did you mean \"day1\"?");
  expect("exposure_s  = 0.5", "exposure_s = 0.5\nlights_of = \"night\"", "must be an acquisition with a flash that shares nobody else's lights");
  expect("exposure_s  = 0.5", "exposure_s = 0.5\nflash = { offset_in_camera = [0, 0, 0] }", "role = \"no_flash\" and a flash exclude each other");
  EXPECT_THAT(complaint("[cloud]\nfiles = \"cloud.ply\"\n[[acquisition]]\nrole = \"no_flash\"\nphotographs = \"photos/*.exr\"\ncameras = \"sparse\"\n"),
              HasSubstr("there is none with a flash"));
}

TEST_F(ProjectTest, RefusesAPhotographInTwoAcquisitionsWithAFlash) {
  const std::string second = changed("role        = \"no_flash\"", "");
  EXPECT_THAT(complaint(second), HasSubstr("photos/photo_1.exr belongs to \"day1\" and to \"night\", and would count twice"));
  EXPECT_EQ(complaint(kValid), "none");   // without flash it measures the light of another
}

TEST_F(ProjectTest, SaysHowPathsAreWritten) {
  EXPECT_THAT(complaint(changed("photos/photo_*.exr", "photos\\\\photo_*.exr")), HasSubstr("no file matches \"photos\\photo_*.exr\" (from "));
  EXPECT_THAT(complaint(changed("photos/photo_*.exr", "photos\\\\photo_*.exr")), HasSubstr("; paths are written with /, on Windows too"));
}

TEST_F(ProjectTest, RefusesPhotographsThatShareAName) {
  std::ofstream(scratch_.path() / "photos/photo_9.tif") << "x";
  EXPECT_THAT(complaint(changed("photo_*.exr", "photo_*")), HasSubstr("photos/photo_9.exr and photos/photo_9.tif share the name \"photo_9\""));
  std::ofstream(scratch_.path() / "photos/other.jpg") << "x";
  EXPECT_THAT(complaint("[cloud]\nfiles = \"cloud.ply\"\n[[acquisition]]\nphotographs = [\"photos/*.jpg\", \"photos/*.exr\"]\ncameras = \"sparse\"\n"),
              HasSubstr("are of different kinds"));
}

TEST_F(ProjectTest, RefusesAPhotographWhoseNameIsNotUtf8) {
  std::ofstream(scratch_.path() / "photos/photo_B\xc3\xbcste.exr") << "x";
  EXPECT_EQ(complaint(kValid), "none");
  std::ofstream(scratch_.path() / "photos/photo_B\xfcste.exr") << "x";
  EXPECT_THAT(complaint(kValid), HasSubstr("photos/photo_B\xfcste.exr: its name is not UTF-8"));
}

TEST_F(ProjectTest, AppliesOverridesByNameByNumberAndToAll) {
  const Project p = load(kValid, Words{"solve.method=adam", "run.memory=1 GiB", "acquisition.night.ambient.model=none", "acquisition.0.ambient.model = sh2", "export.fill=true",
                                       "acquisition.day1.flash.intensity_range=[1, 2]", "run.threads=4", "project.name=\"x y\"", "acquisition.noise={gain = 0.5}"});
  EXPECT_EQ(p.method, SolveMethod::kAdam);
  EXPECT_EQ(p.memory_bytes, 1u << 30);
  EXPECT_EQ(p.acquisitions[0].ambient, AmbientModel::kSh2);
  EXPECT_EQ(p.acquisitions[1].ambient, AmbientModel::kNone);
  EXPECT_TRUE(p.exports[0].fill && p.exports[1].fill);
  EXPECT_EQ((*p.acquisitions[0].flash->intensity_range)[0], 1);
  EXPECT_EQ(p.threads, 4);
  EXPECT_EQ(p.name, "x y");
  EXPECT_EQ(p.acquisitions[0].noise->gain, 0.5);
  EXPECT_EQ(p.acquisitions[1].noise->gain, 0.5);
  // A section that the file does not have, and the default export.
  const Project q = load("[cloud]\nfiles = \"cloud.ply\"\n[[acquisition]]\nphotographs = \"photos/*.exr\"\ncameras = \"sparse\"\n", Words{"solve.method=direct", "export.fill=true"});
  EXPECT_EQ(q.method, SolveMethod::kDirect);
  ASSERT_EQ(q.exports.size(), 1u);
  EXPECT_EQ(q.exports[0].file, "albedo.ply");
  EXPECT_TRUE(q.exports[0].fill);
}

TEST_F(ProjectTest, AnOverrideNamesWhatHasDotsInQuotationMarks) {
  const std::string text = changed("name        = \"day1\"", "name = \"day 1.5=b\"");
  EXPECT_EQ(load(text, {"acquisition.\"day 1.5=b\".encoding=srgb"}).acquisitions[0].encoding, Encoding::kSrgb);
  EXPECT_EQ(load(text, {"acquisition.\"day 1.5=b\".encoding=srgb"}).acquisitions[1].encoding, Encoding::kLinear);
  EXPECT_EQ(load(text, {"project.name=\"a = b\""}).name, "a = b");
  EXPECT_THAT(complaint(text, {"acquisition.\"day 1.5.encoding=srgb"}), HasSubstr("expected key=value"));
  EXPECT_THAT(complaint(text, {"acquisition.\"day 1.5=b\"x.encoding=srgb"}), HasSubstr("a quotation mark in the key is not closed"));
}

TEST_F(ProjectTest, SaysWhichOverrideIsWrong) {
  EXPECT_EQ(complaint(kValid, {"solve.method=adm"}), "--set solve.method=adm: solve.method: unknown value \"adm\"; did you mean \"adam\"?");
  EXPECT_THAT(complaint(kValid, {"solve.methd=adam"}), HasSubstr("unknown key \"methd\" in [solve]; did you mean \"method\"?"));
  EXPECT_THAT(complaint(kValid, {"slove.method=adam"}), HasSubstr("unknown key \"slove\"; did you mean \"solve\"?"));
  EXPECT_THAT(complaint(kValid, {"solve.method"}), HasSubstr("expected key=value"));
  EXPECT_THAT(complaint(kValid, {"solve..method=adam"}), HasSubstr("dotted key"));
  EXPECT_THAT(complaint(kValid, {"=adam"}), HasSubstr("dotted key"));
  EXPECT_THAT(complaint(kValid, {"acquisition.7.name=a"}), HasSubstr("there is no table number 7"));
  EXPECT_THAT(complaint(kValid, {"project.name.x=a"}), HasSubstr("is a text, not a table"));
  EXPECT_THAT(complaint(kValid, {"run.seed=\n1\n[solve]"}), HasSubstr("control characters"));
  EXPECT_THAT(complaint(kValid, {"run.threads=many"}), HasSubstr("expected a whole number, found a text"));
  EXPECT_THAT(complaint(kValid, {"run.memory=nan"}), HasSubstr("--set run.memory=nan: run.memory"));
  EXPECT_THAT(complaint(kValid, {"solve.method=\xff"}), HasSubstr("--set"));
}

TEST_F(ProjectTest, WritesItselfAsJson) {
  const auto json = nlohmann::json::parse(to_json(load(kValid)));
  EXPECT_EQ(json["project"]["unit"], "mm");
  EXPECT_EQ(json["cloud"]["files"].size(), 3u);
  EXPECT_EQ(json["acquisition"][0]["photographs"][1]["key"], "photo_9");
  EXPECT_EQ(json["acquisition"][0]["flash"]["intensity_range"][0], 25.0);
  EXPECT_EQ(json["acquisition"][0]["reference"][0]["photograph"], "photo_9");
  EXPECT_EQ(json["acquisition"][1]["flash"], nullptr);
  EXPECT_EQ(json["solve"]["method"], "single");
  EXPECT_EQ(json["blend"]["gain"], "channels");
  EXPECT_EQ(json["blend"]["reject"], false);
  EXPECT_EQ(json["export"][1]["fill"], true);
}

TEST_F(ProjectTest, ALayerHasAPlainNameAndNamesItsExport) {
  const char* const kMinimal = "[cloud]\nfiles = \"cloud.ply\"\n[[acquisition]]\nphotographs = \"photos/*.exr\"\ncameras = \"sparse\"\n";
  EXPECT_EQ(load(kValid).blend.layer, "albedo");
  EXPECT_EQ(load(kValid, Words{"blend.layer=day_2"}).blend.layer, "day_2");
  EXPECT_EQ(load(kMinimal, Words{"blend.layer=day_2"}).exports.at(0).file, "day_2.ply");
  EXPECT_EQ(load(kMinimal, Words{"blend.layer=day_2", "export.fill=true"}).exports.at(0).file, "day_2.ply");
  EXPECT_EQ(load(kMinimal).exports.at(0).file, "albedo.ply");
  EXPECT_EQ(nlohmann::json::parse(to_json(load(kValid, Words{"blend.layer=day_2"})))["blend"]["layer"], "day_2");
  for (const char* bad : {"a/b", ".hidden", "day 2", "x.part", "x.old"}) EXPECT_THAT(complaint(kValid, {std::string("blend.layer=\"") + bad + '"'}), HasSubstr("blend.layer: expected letters")) << bad;
  EXPECT_THAT(complaint(kValid, {"blend.layer=input"}), HasSubstr("the cloud's own colour"));
  EXPECT_THAT(complaint(kValid, {"blend.layr=x"}), HasSubstr("did you mean \"layer\""));
}

TEST_F(ProjectTest, BlendingHasItsOwnSection) {
  const Project p = load(kValid);
  EXPECT_FALSE(p.blend.reject || p.blend.align);
  EXPECT_EQ(p.blend.gain, BlendGain::kChannels);
  EXPECT_FALSE(p.blend.keep);
  EXPECT_EQ(p.blend.bands, 2);
  EXPECT_EQ(load(kValid, Words{"blend.bands=4"}).blend.bands, 4);
  EXPECT_THAT(complaint(kValid, {"blend.bands=5"}), HasSubstr("blend.bands"));
  EXPECT_THAT(complaint(kValid, {"blend.bands=1"}), HasSubstr("blend.bands"));
  const Project q = load(kValid, Words{"blend.gain=none", "blend.align=true", "blend.keep=true"});
  EXPECT_TRUE(q.blend.keep);
  EXPECT_THAT(complaint(kValid, {"blend.keep=all"}), HasSubstr("blend.keep: expected true or false"));
  EXPECT_EQ(q.blend.gain, BlendGain::kNone);
  EXPECT_TRUE(q.blend.align);
  EXPECT_THAT(complaint(kValid, {"blend.gain=gray"}), HasSubstr("blend.gain: unknown value \"gray\"; did you mean \"grey\"?"));
  EXPECT_THAT(complaint(kValid, {"blend.reject=1"}), HasSubstr("blend.reject: expected true or false"));
}

TEST_F(ProjectTest, FailsCleanlyOnEveryPrefix) {
  const std::string text = kValid;
  int loaded = 0;
  for (std::size_t length = 0; length <= text.size(); ++length) {
    try {
      load(text.substr(0, length));
      ++loaded;
    } catch (const Error&) {
    }
  }
  EXPECT_GT(loaded, 0);
}

TEST_F(ProjectTest, FailsCleanlyOnEveryCorruptedByte) {
  const std::string text = kValid;
  int loaded = 0, refused = 0;
  for (std::size_t i = 0; i < text.size(); ++i)
    for (const int change : {0x00, 0xff, text[i] ^ 1, static_cast<int>('"'), static_cast<int>('9')}) {
      std::string bad = text;
      bad[i] = static_cast<char>(change);
      try {
        load(bad);
        ++loaded;
      } catch (const Error&) {
        ++refused;
      }
    }
  EXPECT_GT(loaded, 100) << "blanks and names may change";
  EXPECT_GT(refused, 500);
}

TEST_F(ProjectTest, SurvivesHostileText) {
  std::string deep_key = "a", deep_array = "x = ", wide = "x = [";
  for (int i = 0; i < 200000; ++i) deep_key += ".a";
  for (int i = 0; i < 200000; ++i) deep_array += "[";
  for (int i = 0; i < 200000; ++i) wide += "1,";
  std::string deep_table = "x = ";
  for (int i = 0; i < 100000; ++i) deep_table += "{a=";
  std::string quoted = "\"a\"";
  for (int i = 0; i < 100000; ++i) quoted += ".\"a\"";
  for (const std::string& text : {deep_key + " = 1\n", "[" + deep_key + "]\n", "[[" + deep_key + "]]\n", deep_array, wide + "]", deep_table, quoted + "=1", "x = {" + quoted + "=1}", std::string(1 << 20, 'x'),
                                  std::string(1 << 20, '\n'), std::string(100000, '"'), std::string("\xef\xbb\xbf"), std::string("x = 1e999999"),
                                  std::string("x = 99999999999999999999999")})
    EXPECT_THROW(load(text), Error) << text.substr(0, 20);
  EXPECT_THROW(load(std::string(5 << 20, ' ')), Error);
  EXPECT_THROW(load_project(scratch_.path() / "absent.toml"), Error);
  EXPECT_THROW(load_project(scratch_.path()), Error);
}

fs::path shared_folder() {
  const char* named = std::getenv("CHIARO_SHARED");
  return named ? fs::path(named) : fs::path(CHIARO_SOURCE_DIR) / ".." / "shared";
}

TEST(SceneProjects, AllLoad) {
  const fs::path scenes = shared_folder() / "scenes";
  if (!fs::exists(scenes)) GTEST_SKIP() << "no ../shared/scenes beside the sources";
  int count = 0;
  for (const auto& entry : fs::recursive_directory_iterator(scenes)) {
    const std::string name = entry.path().filename().string();
    if (!name.starts_with("project") || entry.path().extension() != ".toml") continue;
    ++count;
    Project project;
    ASSERT_NO_THROW(project = load_project(entry.path())) << entry.path();
    EXPECT_TRUE(project.notes.empty()) << entry.path() << ": " << project.notes[0];
    for (const Acquisition& acquisition : project.acquisitions)
      for (const PhotographInput& photograph : acquisition.photographs) EXPECT_EQ(photograph.key, photograph.stem);
  }
  EXPECT_GT(count, 10);
}

}  // namespace
}  // namespace chiaro::tools
