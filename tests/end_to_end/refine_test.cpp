/// New points where the photographs show more than the cloud (blend.refine), from the project file to the exports.
#include <cmath>

#include "tests/support/run_fixture.h"

namespace chiaro::test {
namespace {

namespace fs = std::filesystem;
using testing::HasSubstr;

const std::vector<std::string> kOn{"--set", "blend.refine=image"};

class RefinedRun : public RunTest {
 protected:
  /// A cloud of few points before photographs of three times its resolution.
  TinyScene sparse() const { return scene({.points = 1500, .width_px = 192, .height_px = 144, .focal_px = 220}); }
  ProcessResult run_on(const std::string& out, std::vector<std::string> more = {}) const {
    more.insert(more.end(), kOn.begin(), kOn.end());
    return run(out, more);
  }
  std::map<std::string, std::string> layer(const std::string& out) const { return files_below(at(out + "/store.chiaro/layers")); }
  nlohmann::json result_of(const ProcessResult& ran) const { return nlohmann::json::parse(ran.out.substr(ran.out.rfind("{\"event\":\"result\"")), nullptr, false); }
};

TEST_F(RefinedRun, InsertedPointsFollowTheCloudsOwnAndAreMeasured) {
  const TinyScene s = sparse();
  ASSERT_EQ(run("plain").code, 0);
  const ProcessResult ran = run_on("out");
  ASSERT_EQ(ran.code, 0) << ran.err;
  EXPECT_THAT(differences(layer("plain"), layer("out")), testing::IsEmpty());

  const PlyVertices before = read_ply(at("plain/albedo.ply")), after = read_ply(at("out/albedo.ply"));
  const std::size_t n = before.size();
  ASSERT_GT(after.size(), 3 * n / 2);
  EXPECT_THROW(before.column("inserted"), std::out_of_range);
  for (std::size_t p = 0; p < before.names.size(); ++p)
    for (std::size_t i = 0; i < n; ++i) {
      const double a = before.columns[p][i], b = after.column(before.names[p])[i];
      ASSERT_TRUE(a == b || (std::isnan(a) && std::isnan(b))) << before.names[p] << i;
    }
  double error = 0;
  for (std::size_t i = 0; i < after.size(); ++i) {
    ASSERT_EQ(after.column("inserted")[i], i < n ? 0 : 1);
    if (i < n) continue;
    ASSERT_GT(after.column("photos")[i], 0);
    ASSERT_GT(after.column("sigma")[i], 0);
    const Vec3d place(after.column("x")[i], after.column("y")[i], after.column("z")[i]);
    const auto truth = tiny_albedo(s.options, place);
    const char* names[] = {"albedo_r", "albedo_g", "albedo_b"};
    for (std::size_t c = 0; c < 3; ++c) error += std::abs(after.column(names[c])[i] - truth[c]) / truth[c] / 3;
  }
  constexpr double kMostError = 0.02;   // as that of the cloud's own points on this scene
  EXPECT_LT(error / static_cast<double>(after.size() - n), kMostError);

  const auto record = json("out/run.json");
  EXPECT_EQ(record["counts"]["points_inserted"], after.size() - n);
  EXPECT_EQ(record["refinement"]["inserted_seen"], after.size() - n);
  EXPECT_EQ(record["refinement"]["refined"].get<std::size_t>() + record["refinement"]["fine_enough"].get<std::size_t>() + record["refinement"]["unseen"].get<std::size_t>() +
                record["refinement"]["without_surface"].get<std::size_t>(), n);
  EXPECT_THAT(record["notes"].dump(), HasSubstr("blend.refine: "));
  EXPECT_THAT(file_bytes(at("out/report/index.html")), HasSubstr("points inserted"));
}

TEST_F(RefinedRun, OtherCommandsKnowThem) {
  sparse();
  ASSERT_EQ(run("plain").code, 0);
  ASSERT_EQ(run_on("out").code, 0);
  const auto info = result_of(chiaro({"info", at("out").string(), "--json"}));
  const std::size_t inserted = json("out/run.json")["counts"]["points_inserted"];
  EXPECT_EQ(info["layers"][0]["inserted"]["points"], inserted);
  EXPECT_THAT(chiaro({"info", at("out").string()}).out, HasSubstr("points inserted"));
  EXPECT_EQ(chiaro({"verify", at("out").string()}).code, 0);

  // The cloud's own points are compared.
  const auto compared = result_of(chiaro({"compare", at("out/albedo.ply").string(), at("plain/albedo.ply").string(), "--json"}));
  EXPECT_EQ(compared["points"], json("plain/run.json")["counts"]["points_out"]);
  EXPECT_EQ(compared["difference"]["max"], 0);

  for (const std::string ending : {"las", "pcd"}) {
    const ProcessResult ran = chiaro({"export", at("out").string(), "--out", at("again." + ending).string(), "--json"});
    ASSERT_EQ(ran.code, 0) << ran.err;
    EXPECT_EQ(result_of(ran)["points_inserted"], inserted);
    ASSERT_EQ(chiaro({"ingest", at("again." + ending).string(), "--out", at(ending + ".chiaro").string()}).code, 0);
    EXPECT_EQ(result_of(chiaro({"info", at(ending + ".chiaro").string(), "--json"}))["points_read"], json("out/run.json")["counts"]["points_out"]);
    EXPECT_THAT(file_bytes(at("again." + ending)), HasSubstr("inserted"));
  }
  for (const char* run : {"out", "plain"})
    ASSERT_EQ(chiaro({"render", at(run).string(), "--views", at("scene/novel/views.toml").string(), "--points", "--albedo", "--out", at(std::string("view_") + run).string()}).code, 0);
  EXPECT_NE(file_bytes(at("view_out/novel_00.exr")), file_bytes(at("view_plain/novel_00.exr")));

  // Damage in them is damage.
  const fs::path values = at("out/store.chiaro/inserted/albedo.chiaro/layers/albedo/values.bin");
  std::string bytes = file_bytes(values);
  bytes[bytes.size() / 2] ^= 1;
  put_bytes(values, bytes);
  const ProcessResult verified = chiaro({"verify", at("out").string()});
  EXPECT_EQ(verified.code, 1);
  EXPECT_THAT(verified.err + verified.out, HasSubstr("inserted/albedo.chiaro"));
}

TEST_F(RefinedRun, TheSameBytesForAnyThreadsMemoryAndKeptSums) {
  sparse();
  const auto points = [&](const std::string& out) { return files_below(at(out + "/store.chiaro/inserted")); };
  // Light transport takes a coarser cut where memory is short: without lights it must not matter.
  ASSERT_EQ(run_on("one", {"--threads", "1", "--set", "solve.method=none"}).code, 0);
  ASSERT_EQ(run_on("five", {"--threads", "5", "--memory", "300MiB", "--set", "blend.keep=true", "--set", "solve.method=none"}).code, 0);
  ASSERT_GE(points("one").size(), 5u);
  EXPECT_THAT(differences(points("one"), points("five")), testing::IsEmpty());
  EXPECT_EQ(file_bytes(at("one/albedo.ply")), file_bytes(at("five/albedo.ply")));
}

TEST_F(RefinedRun, WithoutTheOptionTheyGoAndAnotherLayerHasItsOwn) {
  sparse();
  ASSERT_EQ(run("plain").code, 0);
  const std::string plain = file_bytes(at("plain/albedo.ply"));
  ASSERT_EQ(run_on("out").code, 0);
  EXPECT_NE(file_bytes(at("out/albedo.ply")), plain);
  const auto first = files_below(at("out/store.chiaro/inserted"));
  ASSERT_EQ(run_on("out", {"--set", "blend.layer=plain", "--set", "solve.method=direct"}).code, 0);
  EXPECT_TRUE(fs::exists(at("out/store.chiaro/inserted/plain.chiaro/manifest.json")));
  // Nothing is done twice.
  ASSERT_EQ(run_on("out").code, 0);
  const auto record = json("out/run.json");
  int asked = 0;
  for (const auto& stage : record["stages"])
    if (stage["name"] == "refine") {
      EXPECT_TRUE(stage["reused"].get<bool>());
      ++asked;
    }
  EXPECT_EQ(asked, 1);
  ASSERT_EQ(run("out").code, 0);
  EXPECT_FALSE(fs::exists(at("out/store.chiaro/inserted/albedo.chiaro")));
  EXPECT_TRUE(fs::exists(at("out/store.chiaro/inserted/plain.chiaro/manifest.json")));
  EXPECT_EQ(file_bytes(at("out/albedo.ply")), plain);
  ASSERT_EQ(run_on("out").code, 0);
  const auto again = files_below(at("out/store.chiaro/inserted"));
  for (const auto& [name, bytes] : first) EXPECT_EQ(again.at(name), bytes) << name;
}

TEST_F(RefinedRun, WhatWasStoppedBetweenPointsAndTheirAlbedoIsNotTakenForWhole) {
  sparse();
  ASSERT_EQ(run_on("out").code, 0);
  const auto whole = files_below(at("out/store.chiaro/inserted"));
  const std::string exported = file_bytes(at("out/albedo.ply"));
  fs::remove_all(at("out/store.chiaro/inserted/albedo.chiaro/layers"));
  fs::remove(at("out/work/tasks/refine.json"));
  EXPECT_EQ(result_of(chiaro({"info", at("out").string(), "--json"}))["layers"][0].count("inserted"), 0u);
  const ProcessResult plain = chiaro({"export", at("out").string(), "--out", at("plain.ply").string(), "--json"});
  EXPECT_EQ(result_of(plain)["points_inserted"], 0);
  ASSERT_EQ(run_on("out").code, 0);
  EXPECT_THAT(differences(whole, files_below(at("out/store.chiaro/inserted"))), testing::IsEmpty());
  EXPECT_EQ(file_bytes(at("out/albedo.ply")), exported);
}

TEST_F(RefinedRun, TheBudgetIsKeptAndSaid) {
  sparse();
  ASSERT_EQ(run_on("out", {"--set", "blend.refine_points=700"}).code, 0);
  const auto refinement = json("out/run.json")["refinement"];
  EXPECT_LE(refinement["inserted"], 700);
  EXPECT_GT(refinement["inserted"], 200);
  EXPECT_GT(refinement["coarser"], 1);
  EXPECT_THAT(json("out/run.json")["notes"].dump(), HasSubstr("refine_points = 700"));
}

TEST_F(RefinedRun, PhotographsNoFinerThanTheCloudInsertNothing) {
  scene({.points = 20000, .width_px = 48, .height_px = 36, .focal_px = 55});
  ASSERT_EQ(run_on("out").code, 0);
  EXPECT_EQ(json("out/run.json")["refinement"]["inserted"], 0);
  EXPECT_THROW(read_ply(at("out/albedo.ply")).column("inserted"), std::out_of_range);
  EXPECT_EQ(chiaro({"verify", at("out").string()}).code, 0);
  EXPECT_EQ(chiaro({"info", at("out").string()}).code, 0);
}

TEST_F(RefinedRun, NonsenseIsRefused) {
  scene();
  const auto refused = [&](const std::string& set, const std::string& says) {
    const ProcessResult ran = run("out", {"--set", set});
    EXPECT_EQ(ran.code, 2) << set;
    EXPECT_THAT(ran.err, HasSubstr(says)) << set;
  };
  refused("blend.refine=images", "did you mean \"image\"");
  refused("blend.refine=true", "blend.refine");
  for (const char* value : {"0", "-5", "1.5", "many", "2000000000000"}) refused(std::string("blend.refine_points=") + value, "blend.refine_points");
  EXPECT_FALSE(fs::exists(at("out/store.chiaro")));
}

}  // namespace
}  // namespace chiaro::test
