/// Several results on one cloud: dates, methods, and what lies between them.
#include <cmath>

#include "tests/support/run_fixture.h"

namespace chiaro::test {
namespace {

namespace fs = std::filesystem;
using testing::HasSubstr;

class Layers : public RunTest {
 protected:
  /// The same points, painted anew, in a project of its own.
  TinyScene later() const {
    TinySceneOptions options;
    options.uniform_paint = true;
    const TinyScene s = scene(options, "later");
    EXPECT_EQ(file_bytes(at("later/cloud.ply")), file_bytes(at("scene/cloud.ply")));
    edit("later/project.toml", "\"cloud.ply\"", "\"../scene/cloud.ply\"");
    return s;
  }
  ProcessResult run_later(const std::string& layer, std::vector<std::string> more = {}) const {
    more.insert(more.end(), {"--set", "blend.layer=" + layer});
    return run("out", more, {}, "later");
  }
  std::map<std::string, std::string> layer_files(const std::string& name) const { return files_below(at("out/store.chiaro/layers"), {name}); }
  nlohmann::json result_of(const ProcessResult& ran) const { return nlohmann::json::parse(ran.out.substr(ran.out.rfind("{\"event\":\"result\"")), nullptr, false); }
};

// Each layer is within 1 % of its truth (measured 0.45 %), so a ratio of two is within 2 %.
constexpr double kMaxDifferenceError = 0.02;

TEST_F(Layers, TwoDatesLieBesideEachOtherAndAreCompared) {
  const TinyScene before = scene();
  const TinyScene after = later();
  ASSERT_EQ(run("out", {"--set", "blend.layer=day1"}).code, 0);
  const auto first = layer_files("day1");
  ASSERT_GE(first.size(), 3u);
  const std::string exported = file_bytes(at("out/albedo.ply"));
  const ProcessResult ran = run_later("day2");
  ASSERT_EQ(ran.code, 0) << ran.err;
  EXPECT_THAT(differences(first, layer_files("day1")), testing::IsEmpty());

  const auto info = result_of(chiaro({"info", at("out").string(), "--json"}));
  ASSERT_EQ(info["layers"].size(), 3u) << info["layers"];   // and the input's colour
  EXPECT_EQ(info["layers"][0]["name"], "day1");
  EXPECT_EQ(info["layers"][0]["provenance"]["photographs"], 3);
  EXPECT_EQ(info["layers"][1]["provenance"]["acquisitions"][0], "day1");
  EXPECT_THAT(chiaro({"info", at("out").string()}).out, HasSubstr("joint, 3 photographs of day1"));
  EXPECT_EQ(chiaro({"verify", at("out").string()}).code, 0);
  EXPECT_EQ(json("out/report/report.json")["layers"].size(), 2u);
  EXPECT_TRUE(json("out/report/report.json")["layers"][1]["this_run"].get<bool>());
  EXPECT_THAT(file_bytes(at("out/report/index.html")), HasSubstr("Layers of the store"));

  // The first one comes out as it did; without a name nobody knows which one is meant.
  ASSERT_EQ(chiaro({"export", at("out").string(), "--layer", "day1", "--out", at("day1.ply").string()}).code, 0);
  EXPECT_EQ(file_bytes(at("day1.ply")), exported);
  const ProcessResult which = chiaro({"export", at("out").string(), "--out", at("which.ply").string()});
  EXPECT_EQ(which.code, 2);
  EXPECT_THAT(which.err, HasSubstr("day1, day2"));

  const ProcessResult compared = chiaro({"compare", at("out").string() + ":day2", at("out").string() + ":day1", "--json", "--out", at("d.ply").string(), "--picture", at("d.png").string()});
  ASSERT_EQ(compared.code, 0) << compared.err;
  const auto numbers = result_of(compared);
  const PlyVertices points = read_ply(at("d.ply"));
  ASSERT_EQ(points.size(), before.positions.size());
  EXPECT_GT(fs::file_size(at("d.png")), 1000u);
  // Leaves come in another order than the input's: points are found by their place.
  double wrong = 0, expected = 0;
  std::size_t seen = 0;
  for (std::size_t i = 0; i < points.size(); ++i) {
    const Vec3d place(points.columns[0][i], points.columns[1][i], points.columns[2][i]);
    std::size_t nearest = 0;
    double least = 1e300;
    if (std::isnan(points.column("relative")[i])) continue;
    for (std::size_t k = 0; k < before.positions.size(); ++k)
      if (const double d = (before.positions[k] - place).squaredNorm(); d < least) least = d, nearest = k;
    double truth = 0;
    for (std::size_t c = 0; c < 3; ++c) truth += std::abs(after.albedo[nearest][c] - before.albedo[nearest][c]) / before.albedo[nearest][c] / 3;
    wrong += std::abs(points.column("relative")[i] - truth);
    expected += truth;
    ++seen;
  }
  EXPECT_EQ(seen, numbers["compared"].get<std::size_t>());
  EXPECT_GT(seen, points.size() / 3);
  const auto n = static_cast<double>(seen);
  EXPECT_GT(expected / n, 0.1);
  EXPECT_LE(wrong / n, kMaxDifferenceError);
  EXPECT_NEAR(numbers["relative"]["mean"].get<double>(), expected / n, kMaxDifferenceError);
}

TEST_F(Layers, TwoMethodsLieBesideEachOtherAndEachIsReused) {
  scene({.photographs = 2});
  ASSERT_EQ(run("out").code, 0);
  const auto first = layer_files("albedo");
  ASSERT_EQ(run("out", {"--set", "solve.method=direct", "--set", "blend.layer=plain"}).code, 0);
  EXPECT_THAT(differences(first, layer_files("albedo")), testing::IsEmpty());
  EXPECT_NE(layer_files("plain").at("plain/values.bin"), first.at("albedo/values.bin"));
  const auto status = result_of(chiaro({"status", at("out").string(), "--json"}));
  EXPECT_TRUE(status["complete"].get<bool>());
  ASSERT_EQ(run("out").code, 0);
  EXPECT_THAT(differences(first, layer_files("albedo")), testing::IsEmpty());
  const auto record = json("out/run.json");
  int asked = 0;
  for (const auto& stage : record["stages"])
    if (stage["name"] == "blend") {
      EXPECT_TRUE(stage["reused"].get<bool>());
      ++asked;
    }
  EXPECT_EQ(asked, 1);
}

// An export of the same name and length may come from another layer, and may have been put there by other commands.
TEST_F(Layers, AnExportIsThatOfItsLayer) {
  scene({.photographs = 1});
  const auto in_layer = [&](const std::string& name, const std::string& method) { return run("out", {"--set", "solve.method=" + method, "--set", "blend.layer=" + name}); };
  ASSERT_EQ(in_layer("day1", "none").code, 0);
  ASSERT_EQ(in_layer("day2", "none").code, 0);   // the same values
  EXPECT_THAT(file_bytes(at("out/albedo.ply")).substr(0, 100), HasSubstr("layer day2"));
  ASSERT_EQ(in_layer("dark", "direct").code, 0);
  const std::string exported = file_bytes(at("out/albedo.ply"));
  ASSERT_EQ(chiaro({"export", at("out").string(), "--layer", "day1", "--out", at("out/albedo.ply").string()}).code, 0);
  ASSERT_EQ(file_bytes(at("out/albedo.ply")).size(), exported.size());
  ASSERT_EQ(in_layer("dark", "direct").code, 0);
  EXPECT_EQ(file_bytes(at("out/albedo.ply")), exported);
}

TEST_F(Layers, AreMadeAgainWhereAnotherWasPutInTheirPlace) {
  scene({.photographs = 1});
  const auto in_layer = [&](const std::string& name, const std::string& method) { return run("out", {"--set", "solve.method=" + method, "--set", "blend.layer=" + name}); };
  ASSERT_EQ(in_layer("plain", "none").code, 0);
  ASSERT_EQ(in_layer("albedo", "direct").code, 0);
  const auto before = layer_files("albedo");
  fs::remove_all(at("out/store.chiaro/layers/albedo"));
  fs::copy(at("out/store.chiaro/layers/plain"), at("out/store.chiaro/layers/albedo"), fs::copy_options::recursive);
  ASSERT_EQ(in_layer("albedo", "direct").code, 0);
  EXPECT_THAT(differences(before, layer_files("albedo")), testing::IsEmpty());
}

TEST_F(Layers, NameTheAcquisitionsThatTheyAreMadeOf) {
  scene({.photographs = 1});
  ASSERT_EQ(run("out", {"--set", "solve.method=none"}).code, 0);
  ASSERT_EQ(run("out", {"--set", "solve.method=none", "--set", "acquisition.0.name=spring"}).code, 0);
  EXPECT_THAT(chiaro({"info", at("out").string()}).out, HasSubstr("1 photograph of spring"));
}

TEST_F(Layers, APhotographIsAddedToOneThatWasKept) {
  scene();
  const std::vector<std::string> none{"--set", "solve.method=none"};
  auto with = [&](std::vector<std::string> more) {
    more.insert(more.end(), none.begin(), none.end());
    return more;
  };
  ASSERT_EQ(run("out", with({"--set", "acquisition.photographs=[\"photos/photo_00.exr\", \"photos/photo_02.exr\"]"})).code, 0);
  EXPECT_FALSE(fs::exists(at("out/work/kept/albedo/state")));
  ASSERT_EQ(run("out", with({"--set", "blend.keep=true", "--set", "acquisition.photographs=[\"photos/photo_00.exr\", \"photos/photo_02.exr\"]"})).code, 0);
  EXPECT_TRUE(fs::exists(at("out/work/kept/albedo/state")));   // it was made again
  ASSERT_EQ(run("out", with({"--set", "blend.keep=true"})).code, 0);
  EXPECT_EQ(json("out/run.json")["blending"]["photographs"].size(), 3u);
  ASSERT_EQ(run("anew", with({})).code, 0);
  EXPECT_THAT(differences(results("anew"), results("out")), testing::IsEmpty());
  EXPECT_EQ(json("anew/run.json")["blending"]["leaves_kept"], 0);
  ASSERT_EQ(run("out", with({})).code, 0);
  EXPECT_FALSE(fs::exists(at("out/work/kept/albedo")));
  EXPECT_THAT(differences(results("anew"), results("out")), testing::IsEmpty());
}

TEST_F(Layers, AreNotLostWithTheirStore) {
  scene({.photographs = 1});
  ASSERT_EQ(run("out", {"--set", "blend.layer=day1"}).code, 0);
  const auto first = layer_files("day1");
  const ProcessResult refused = run("out", {"--set", "blend.layer=day2", "--set", "cloud.normals=estimate"});
  EXPECT_EQ(refused.code, 1);
  EXPECT_THAT(refused.err, HasSubstr("layers would be lost: day1"));
  EXPECT_THAT(differences(first, layer_files("day1")), testing::IsEmpty());
  const auto ingest = [&](const std::string& normals) { return chiaro({"ingest", at("scene/cloud.ply").string(), "--normals", normals, "--out", at("out/store.chiaro").string()}); };
  const ProcessResult replaced = ingest("estimate");
  EXPECT_EQ(replaced.code, 1);
  EXPECT_THAT(replaced.err, HasSubstr("layers would be lost: day1"));
  EXPECT_EQ(ingest("auto").code, 0);   // what it is made of
  EXPECT_THAT(differences(first, layer_files("day1")), testing::IsEmpty());
  EXPECT_EQ(run("out", {"--set", "blend.layer=day1", "--set", "cloud.normals=estimate"}).code, 0);   // its own is made again
  put_bytes(at("out/store.chiaro/index.bin"), "damaged");
  EXPECT_THAT(run("out", {"--set", "blend.layer=day2"}).err, HasSubstr("layers would be lost: day1"));
}

TEST_F(Layers, AStoreOfSomethingElseIsNotTakenForTheProjects) {
  scene({.photographs = 1});
  ASSERT_EQ(run("out", {"--set", "solve.method=none"}).code, 0);
  const auto before = results("out");
  fs::remove_all(at("out/store.chiaro/layers/albedo"));
  ASSERT_EQ(chiaro({"ingest", at("scene/cloud.ply").string(), "--normals", "estimate", "--out", at("out/store.chiaro").string()}).code, 0);
  ASSERT_EQ(run("out", {"--set", "solve.method=none"}).code, 0);
  EXPECT_THAT(differences(before, results("out")), testing::IsEmpty());
}

// Years may lie between two dates; work/ may be gone.
TEST_F(Layers, AnotherOneComesToAStoreWhoseRunHasLeftNothingElse) {
  scene({.photographs = 1});
  for (const std::string outliers : {"none", "statistical"}) {
    const auto add = [&](const std::string& layer) { return run(outliers, {"--set", "solve.method=none", "--set", "cloud.outliers=" + outliers, "--set", "blend.layer=" + layer}); };
    ASSERT_EQ(add("day1").code, 0);
    const auto first = files_below(at(outliers + "/store.chiaro"), {"geometry.bin", "layers/day1"});
    fs::remove_all(at(outliers + "/work"));
    const ProcessResult ran = add("day2");
    ASSERT_EQ(ran.code, 0) << ran.err;
    EXPECT_THAT(differences(first, files_below(at(outliers + "/store.chiaro"), {"geometry.bin", "layers/day1"})), testing::IsEmpty());
    EXPECT_TRUE(fs::exists(at(outliers + "/store.chiaro/layers/day2")));
  }
}

TEST_F(Layers, ALayerOfAnotherStoreIsRefused) {
  scene({.photographs = 1});
  TinySceneOptions fewer;
  fewer.points = 5000;
  fewer.photographs = 1;
  scene(fewer, "other");
  ASSERT_EQ(run("out").code, 0);
  ASSERT_EQ(run("out2", {}, {}, "other").code, 0);
  const ProcessResult both = chiaro({"compare", at("out").string() + ":albedo", at("out2").string() + ":albedo"});
  EXPECT_EQ(both.code, 1);
  EXPECT_THAT(both.err, HasSubstr("not the same points"));
  fs::copy(at("out2/store.chiaro/layers/albedo"), at("out/store.chiaro/layers/copied"), fs::copy_options::recursive);
  const ProcessResult verified = chiaro({"verify", at("out").string()}), compared = chiaro({"compare", at("out").string() + ":albedo", at("out").string() + ":copied"}),
                      exported = chiaro({"export", at("out").string(), "--layer", "copied", "--out", at("x.ply").string()});
  for (const ProcessResult* refused : {&verified, &compared, &exported}) {
    EXPECT_EQ(refused->code, 1);
    EXPECT_THAT(refused->err, HasSubstr("belongs to another store")) << refused->out;
  }
  EXPECT_FALSE(fs::exists(at("x.ply")));
}

}  // namespace
}  // namespace chiaro::test
