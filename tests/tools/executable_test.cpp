/// The executable itself, once per command: what only a process can show.
#include <gmock/gmock.h>
#include <gtest/gtest.h>
#include <sys/wait.h>

#include <cstdlib>
#include <fstream>
#include <map>
#include <nlohmann/json.hpp>

#include "stream/base/file.h"
#include "stream/photo/image_io.h"

namespace chiaro::tools {
namespace {

namespace fs = std::filesystem;
using testing::HasSubstr;

// Of the contract, in the order of `chiaro --help`.
const char* const kCommands[] = {"run", "ingest", "info", "verify", "export", "render", "compare", "report", "status", "synth"};

struct Ran {
  int code = -1;
  std::string out, err;
};

class ExecutableTest : public testing::Test {
 protected:
  /// Runs `chiaro WORDS` in the scratch folder.
  Ran run(const std::string& words) {
    const std::string folder = scratch_.path().string();
    const std::string line = "cd '" + folder + "' && '" CHIARO_EXECUTABLE "' " + words + " >out.txt 2>err.txt </dev/null";
    const int status = std::system(line.c_str());
    Ran ran;
    ran.code = WIFEXITED(status) ? WEXITSTATUS(status) : 1000 + status;
    ran.out = read_text(scratch_.path() / "out.txt");
    ran.err = read_text(scratch_.path() / "err.txt");
    return ran;
  }
  void write(const std::string& name, const std::string& text) { std::ofstream(scratch_.path() / name, std::ios::binary) << text; }
  std::string cloud(int points) {
    std::string text = "ply\nformat ascii 1.0\nelement vertex " + std::to_string(points) +
                       "\nproperty float x\nproperty float y\nproperty float z\nproperty uchar red\nproperty uchar green\nproperty uchar blue\nend_header\n";
    for (int i = 0; i < points; ++i) text += std::to_string(i % 50) + " " + std::to_string(i / 50) + " 0 " + std::to_string(i % 256) + " 10 20\n";
    return text;
  }
  ScratchFolder scratch_;
};

class EveryCommand : public ExecutableTest, public testing::WithParamInterface<const char*> {};

TEST_P(EveryCommand, ExplainsItself) {
  const std::string name = GetParam();
  const Ran ran = run(name + " --help");
  EXPECT_EQ(ran.code, 0);
  EXPECT_THAT(ran.out, HasSubstr("chiaro " + name));
  EXPECT_THAT(ran.out, HasSubstr("--json"));
  EXPECT_EQ(ran.err, "");
  EXPECT_EQ(run("help " + name).out, ran.out);
}

TEST_P(EveryCommand, RefusesUnknownOptions) {
  const Ran ran = run(std::string(GetParam()) + " --jsno");
  EXPECT_EQ(ran.code, 2);
  EXPECT_THAT(ran.err, HasSubstr("unknown option \"--jsno\"; did you mean \"--json\"?"));
  EXPECT_EQ(ran.out, "");
}

TEST_P(EveryCommand, SaysInJsonTooWhatIsWrongWithTheCommandLine) {
  for (const char* words : {" --json --jsno", " --jsno --json", " --json"}) {
    const Ran ran = run(GetParam() + std::string(words));
    EXPECT_EQ(ran.code, 2);
    const auto event = nlohmann::json::parse(ran.out, nullptr, false);
    ASSERT_TRUE(event.is_object()) << ran.out;
    EXPECT_EQ(event["event"], "error");
    EXPECT_EQ(event["exit"], 2);
  }
}

TEST_P(EveryCommand, NeedsItsWords) {
  const Ran ran = run(GetParam());
  EXPECT_EQ(ran.code, 2);
  EXPECT_THAT(ran.err, testing::StartsWith("error: chiaro "));
}

INSTANTIATE_TEST_SUITE_P(Commands, EveryCommand, testing::ValuesIn(kCommands), [](const auto& i) { return std::string(i.param); });

TEST_F(ExecutableTest, CompareSaysWherePointsAreNotTheSame) {
  write("a.ply", cloud(500));
  std::string text = cloud(500);
  const std::size_t rows = text.find("end_header\n") + 11;
  const std::size_t end_of_first = text.find('\n', rows) + 1;
  write("b.ply", text.substr(0, rows) + text.substr(end_of_first) + text.substr(rows, end_of_first - rows));   // the first point at the end
  Ran ran = run("compare a.ply b.ply");
  EXPECT_EQ(ran.code, 0);
  EXPECT_THAT(ran.err, HasSubstr("note: 500 of 500 points do not lie in the same place"));
  EXPECT_THAT(run("compare a.ply b.ply --json").out, HasSubstr("\"elsewhere\":500"));
  EXPECT_THAT(run("compare a.ply a.ply").err, testing::Not(HasSubstr("note")));
  ran = run("compare a.ply b.ply --picture d.jpg");
  EXPECT_EQ(ran.code, 2);
  EXPECT_THAT(ran.err, HasSubstr("--picture d.jpg: expected FILE.png"));
}

TEST_F(ExecutableTest, RenderRefusesWrongViewsWithTwo) {
  std::string deep = "a";
  for (int i = 0; i < 200000; ++i) deep += ".a";
  write("deep.toml", deep + " = 1\n");
  write("empty.toml", "");
  write("broken.toml", "[[view]\n");
  for (const auto& [file, says] : {std::pair{"nothing.toml", "nothing.toml: no such file, expected a file of views"}, std::pair{".", ".: is a folder, expected a file of views"},
                                   std::pair{"deep.toml", "deep.toml:1: a name with more than 500 dots"}, std::pair{"empty.toml", "empty.toml: no [[view]]"}, std::pair{"broken.toml", "broken.toml:1:"}}) {
    const Ran ran = run(std::string("render run --out v --views ") + file);
    EXPECT_EQ(ran.code, 2) << file;
    EXPECT_THAT(ran.err, HasSubstr(says));
  }
}

TEST_F(ExecutableTest, IngestRefusesAFileThatIsNamedTwice) {
  write("cloud.ply", cloud(100));
  const Ran ran = run("ingest cloud.ply './cl*.ply' --out s.chiaro");
  EXPECT_EQ(ran.code, 2);
  EXPECT_THAT(ran.err, HasSubstr("cloud.ply: is named twice"));
}

TEST_F(ExecutableTest, IngestSaysWhereSinglePrecisionHasLostTheShape) {
  // A square metre, a point each 2 cm, at UTM coordinates: floats step by 0.25 there.
  const auto far_cloud = [](const char* type) {
    std::string text = std::string("ply\nformat ascii 1.0\nelement vertex 2500\nproperty ") + type + " x\nproperty " + type + " y\nproperty " + type + " z\nend_header\n";
    for (int i = 0; i < 2500; ++i) text += std::to_string(500000 + 0.02 * (i % 50)) + " " + std::to_string(4000000 + 0.02 * (i / 50)) + " 10\n";
    return text;
  };
  write("float.ply", far_cloud("float"));
  write("double.ply", far_cloud("double"));
  Ran ran = run("ingest float.ply --out float.chiaro");
  EXPECT_EQ(ran.code, 0);
  EXPECT_THAT(ran.err, HasSubstr("float.ply: its coordinates have single precision, which far from the origin means steps of 0.25 m"));
  EXPECT_THAT(run("ingest float.ply --out float.chiaro").err, HasSubstr("steps of 0.25 m"));   // up to date, and no better
  ran = run("ingest double.ply --out double.chiaro");
  EXPECT_EQ(ran.code, 0);
  EXPECT_THAT(ran.err, testing::Not(HasSubstr("single precision")));
  std::string stray = cloud(2500);
  stray.replace(stray.find("end_header\n") + 11, 1, "1e9");   // of the first point, x
  write("stray.ply", stray);
  EXPECT_THAT(run("ingest stray.ply --out stray.chiaro").err, testing::Not(HasSubstr("single precision")));
  write("one.xyz", "1 2 3\n");
  EXPECT_THAT(run("ingest one.xyz --out one.chiaro").err, testing::Not(HasSubstr("single precision")));
  ran = run("ingest double.ply float.ply --out both.chiaro");
  EXPECT_THAT(ran.err, HasSubstr("note: float.ply: its coordinates"));
  EXPECT_THAT(ran.err, testing::Not(HasSubstr("double.ply: its coordinates")));
}

TEST_F(ExecutableTest, ListsItsCommandsAndSuggests) {
  EXPECT_EQ(run("").code, 2);
  const Ran help = run("--help");
  EXPECT_EQ(help.code, 0);
  for (const char* name : kCommands) EXPECT_THAT(help.out, HasSubstr(name));
  const Ran typo = run("comprae a b");
  EXPECT_EQ(typo.code, 2);
  EXPECT_EQ(typo.err, "error: unknown command \"comprae\"; did you mean \"compare\"?\n");
  EXPECT_THAT(run("--version").out, testing::MatchesRegex("chiaro [0-9.]+\n"));
}

TEST_F(ExecutableTest, NoticesThatItsOutputIsLost) {
  if (!fs::exists("/dev/full")) GTEST_SKIP() << "no /dev/full";
  const int status = std::system("'" CHIARO_EXECUTABLE "' --help >/dev/full 2>/dev/null");
  EXPECT_TRUE(WIFEXITED(status) && WEXITSTATUS(status) == 1);
}

TEST_F(ExecutableTest, ExitsWithOneForBadFiles) {
  write("bad.ply", "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nend_header\n");
  write("bad.png", "no picture");
  for (const char* words : {"ingest absent.ply --out s.chiaro", "ingest bad.ply --out s.chiaro", "info absent.chiaro", "verify absent.chiaro", "export absent.chiaro --out a.ply",
                            "compare bad.png bad.png", "compare absent.exr absent.exr", "compare bad.ply bad.ply", "compare absent.chiaro:a absent.chiaro:b"}) {
    const Ran ran = run(words);
    EXPECT_EQ(ran.code, 1) << words;
    EXPECT_THAT(ran.err, HasSubstr("error: ")) << words;
  }
  EXPECT_FALSE(fs::exists(scratch_.path() / "s.chiaro"));
  const Ran json = run("compare bad.png bad.png --json");
  EXPECT_EQ(nlohmann::json::parse(json.out)["event"], "error");
}

TEST_F(ExecutableTest, ComparesPictures) {
  stream::write_exr(scratch_.path() / "a.exr", 20, 16, {"R", "G", "B"}, std::vector<float>(960, 0.6f), false);
  stream::write_exr(scratch_.path() / "b.exr", 20, 16, {"R", "G", "B"}, std::vector<float>(960, 0.5f), false);
  stream::write_exr(scratch_.path() / "small.exr", 2, 2, {"R", "G", "B"}, std::vector<float>(12, 0.5f), false);
  const Ran table = run("compare a.exr b.exr");
  EXPECT_EQ(table.code, 0);
  EXPECT_THAT(table.out, HasSubstr("psnr"));
  EXPECT_THAT(table.out, HasSubstr("20"));
  const Ran json = run("compare a.exr b.exr --json");
  const auto result = nlohmann::json::parse(json.out);
  EXPECT_NEAR(result["psnr"].get<double>(), 20, 1e-4);
  for (const char* key : {"ssim", "flip", "mse", "relative_error"}) EXPECT_TRUE(result[key].is_number()) << key;
  EXPECT_EQ(run("compare a.exr small.exr").code, 1);
  EXPECT_EQ(run("compare a.exr b.ply").code, 2);
  EXPECT_EQ(run("compare a.exr b.exr --out d.ply").code, 2);
}

TEST_F(ExecutableTest, MakesDescribesVerifiesAndExportsAStore) {
  write("cloud.ply", cloud(2000));
  const Ran made = run("ingest 'cl*.ply' --out s.chiaro --threads 2 --memory 512MiB");
  ASSERT_EQ(made.code, 0) << made.err;
  EXPECT_THAT(made.out, HasSubstr("2 000"));
  EXPECT_THAT(run("ingest cloud.ply --out s.chiaro").out, HasSubstr("up to date"));
  const auto info = nlohmann::json::parse(run("info s.chiaro --json").out);
  EXPECT_EQ(info["points_stored"], 2000);
  EXPECT_EQ(info["layers"][0]["name"], "input");
  EXPECT_THAT(run("info s.chiaro").out, HasSubstr("2 000 of 2 000 read"));
  ASSERT_EQ(run("export s.chiaro --out back.ply").code, 0);
  const auto same = nlohmann::json::parse(run("compare back.ply cloud.ply --json").out);
  EXPECT_EQ(same["values"], "colour");
  EXPECT_EQ(same["points"], 2000);
  EXPECT_EQ(same["difference"]["max"], 0.0);
  EXPECT_THAT(run("export s.chiaro --layer inptu --out x.ply").err, HasSubstr("did you mean \"input\"?"));
  EXPECT_EQ(run("verify s.chiaro").code, 0);
  // One flipped byte anywhere in the geometry is found.
  std::string bytes = read_text(scratch_.path() / "s.chiaro/geometry.bin");
  bytes[100] = static_cast<char>(bytes[100] ^ 4);
  write("s.chiaro/geometry.bin", bytes);
  const Ran broken = run("verify s.chiaro");
  EXPECT_EQ(broken.code, 1);
  EXPECT_THAT(broken.err, HasSubstr("problem"));
}

TEST_F(ExecutableTest, RepairsAStoreAndNamesWhatIsLost) {
  write("cloud.ply", cloud(2000));
  ASSERT_EQ(run("ingest cloud.ply --out s.chiaro").code, 0);
  const Ran whole = run("verify s.chiaro --repair");
  EXPECT_EQ(whole.code, 0);
  EXPECT_THAT(whole.out, testing::Not(HasSubstr("repaired")));
  const std::string index = read_text(scratch_.path() / "s.chiaro/index.bin");
  std::string bytes = index;
  bytes[50] = static_cast<char>(bytes[50] ^ 4);
  write("s.chiaro/index.bin", bytes);
  EXPECT_EQ(run("verify s.chiaro").code, 1);
  const Ran repaired = run("verify s.chiaro --repair");
  EXPECT_EQ(repaired.code, 0) << repaired.err;
  EXPECT_THAT(repaired.out, testing::AllOf(HasSubstr("repaired: s.chiaro/index.bin"), HasSubstr("s.chiaro: whole")));
  EXPECT_EQ(read_text(scratch_.path() / "s.chiaro/index.bin"), index);
  // Geometry of a leaf is kept nowhere else.
  bytes = read_text(scratch_.path() / "s.chiaro/geometry.bin");
  bytes[100] = static_cast<char>(bytes[100] ^ 4);
  write("s.chiaro/geometry.bin", bytes);
  const Ran lost = run("verify s.chiaro --repair");
  EXPECT_EQ(lost.code, 1);
  EXPECT_THAT(lost.out, testing::AllOf(HasSubstr("lost: s.chiaro/geometry.bin: chunk"), HasSubstr("points are lost"), HasSubstr("to do: "), HasSubstr("cloud.ply"), HasSubstr("to do: remove s.chiaro before that")));
  EXPECT_EQ(read_text(scratch_.path() / "s.chiaro/geometry.bin"), bytes);
  const std::string out = run("verify s.chiaro --repair --json").out;
  const std::string result = out.substr(out.find("{\"event\":\"result\""));
  EXPECT_GT(nlohmann::json::parse(result.substr(0, result.find('\n')))["points_lost"], 0);
}

TEST_F(ExecutableTest, ARepairThatIsKilledLeavesEachFileDamagedOrRepaired) {
  write("cloud.ply", cloud(100000));
  ASSERT_EQ(run("ingest cloud.ply --out s.chiaro").code, 0);
  const std::string names[] = {"s.chiaro/manifest.json", "s.chiaro/index.bin", "s.chiaro/geometry.bin", "s.chiaro/layers/input/values.bin"};
  std::map<std::string, std::string> whole, damaged;
  for (const std::string& name : names) whole[name] = damaged[name] = read_text(scratch_.path() / name);
  for (const std::size_t at : {std::size_t{70}, std::size_t{90}}) damaged[names[at == 90]][at] ^= 4;
  damaged[names[2]].back() ^= 4;  // of an inner node: these stand behind the leaves
  damaged[names[3]].front() ^= 4;  // of the root
  int killed = 0;
  for (const char* seconds : {"0.005", "0.01", "0.02", "0.03", "0.05", "0.08"}) {
    for (const std::string& name : names) write(name, damaged[name]);
    const int status = std::system(("cd '" + scratch_.path().string() + "' && timeout -s KILL " + seconds + " '" CHIARO_EXECUTABLE "' verify s.chiaro --repair >/dev/null 2>&1").c_str());
    killed += status != 0;
    for (const std::string& name : names) {
      const std::string now = read_text(scratch_.path() / name);
      EXPECT_TRUE(now == damaged[name] || now == whole[name]) << name << " after " << seconds << " s";
    }
    const Ran ran = run("verify s.chiaro --repair");
    EXPECT_EQ(ran.code, 0) << ran.out;
    for (const std::string& name : names) EXPECT_TRUE(read_text(scratch_.path() / name) == whole[name]) << name << " after " << seconds << " s";
    for (const auto& entry : fs::recursive_directory_iterator(scratch_.path() / "s.chiaro")) EXPECT_NE(entry.path().extension(), ".part");
  }
  EXPECT_GT(killed, 0);
}

TEST_F(ExecutableTest, LeavesAFolderAloneThatIsNoStore) {
  write("cloud.ply", cloud(100));
  fs::create_directory(scratch_.path() / "photos");
  write("photos/precious.txt", "x");
  EXPECT_EQ(run("ingest cloud.ply --out photos").code, 1);
  EXPECT_TRUE(fs::exists(scratch_.path() / "photos/precious.txt"));
}

TEST_F(ExecutableTest, CountsRejectedPointsAndSaysThree) {
  std::string text = cloud(100);
  text.replace(text.find("\n7 0 0 "), 7, "\nnan 0 0 ");
  write("cloud.ply", text);
  const Ran ran = run("ingest cloud.ply --out s.chiaro --json");
  EXPECT_EQ(ran.code, 3) << ran.err;
  const std::string last = ran.out.substr(ran.out.rfind("{\"event\":\"result\""));
  EXPECT_EQ(nlohmann::json::parse(last)["points_stored"], 99);
}

}  // namespace
}  // namespace chiaro::tools
