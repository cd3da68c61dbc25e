/// `chiaro synth --project` and then `chiaro run`, as a user would: the whole pipeline on scenes of any size with a known answer. Label slow.
#include <iostream>

#include "tests/support/run_fixture.h"

namespace chiaro::test {
namespace {

class Synth : public RunTest {
 protected:
  Synth() : RunTest(std::filesystem::path()) {}   // too much for a disk in memory

  ProcessResult make(const std::vector<std::string>& more) const {
    std::vector<std::string> words{"synth"};
    words.insert(words.end(), more.begin(), more.end());
    words.insert(words.end(), {"--project", at("scene").string(), "--albedo"});
    return chiaro(words);
  }
  std::vector<std::array<double, 3>> truth() const {
    const PlyVertices cloud = read_ply(at("scene/cloud.ply"));
    std::vector<std::array<double, 3>> values(cloud.size());
    for (std::size_t i = 0; i < values.size(); ++i) values[i] = {cloud.column("albedo_r")[i], cloud.column("albedo_g")[i], cloud.column("albedo_b")[i]};
    return values;
  }
};

TEST_F(Synth, AStatueComesOutWithinItsMemory) {
  constexpr std::uint64_t kMemory = 256u << 20;
  const ProcessResult made = make({"statue:noise=0.0003,normals=false", "--points", "200000", "--photographs", "6", "--size", "480x360"});
  ASSERT_EQ(made.code, 0) << made.err;
  const ProcessResult ran = run("out", {"--memory", std::to_string(kMemory)});
  ASSERT_EQ(ran.code, 0) << ran.err;
  const AlbedoError e = albedo_error(read_ply(at("out/albedo.ply")), truth());
  const double flash = json("out/lights.json").at("acquisitions").at(0)["flash_intensity"].get<double>();
  std::cout << "statue: absolute " << e.absolute << ", scaled " << e.scaled << ", seen " << e.seen << " of " << e.points << ", flash " << flash << ", made in " << made.seconds << " s, "
            << (made.peak_bytes >> 20) << " MiB; run in " << ran.seconds << " s, " << (ran.peak_bytes >> 20) << " MiB\n";
  EXPECT_GT(e.seen, 9 * e.points / 10);
  EXPECT_LE(e.absolute, 0.02);   // measured 0.0125, of which the flash's calibration is 0.006
  EXPECT_NEAR(flash, 30, 0.03 * 30);
  EXPECT_LE(ran.peak_bytes, kMemory);
  EXPECT_LE(made.peak_bytes, 128u << 20);
}

// A glazed statue: the coat is found, and taken off the albedo.
TEST_F(Synth, AGlazedStatueComesOutWithoutItsHighlights) {
  const ProcessResult made = make({"statue:noise=0.0003,normals=false", "--points", "100000", "--photographs", "10", "--size", "320x240", "--gloss", "0.25"});
  ASSERT_EQ(made.code, 0) << made.err;
  const ProcessResult ran = run("out", {});
  ASSERT_EQ(ran.code, 0) << ran.err;
  const AlbedoError e = albedo_error(read_ply(at("out/albedo.ply")), truth());
  const nlohmann::json lights = json("out/lights.json").at("acquisitions").at(0);
  std::cout << "glazed statue: absolute " << e.absolute << ", scaled " << e.scaled << ", gloss " << lights["gloss"] << ", evidence " << lights["gloss_evidence"] << ", flash " << lights["flash_intensity"] << '\n';
  EXPECT_LT(lights["gloss_evidence"].get<double>(), 0);
  EXPECT_NEAR(lights["gloss"]["roughness"].get<double>(), 0.25, 0.03);
  EXPECT_NEAR(lights["flash_intensity"].get<double>(), 30, 2 * lights["flash_intensity_sd"].get<double>());
  EXPECT_LE(e.scaled, 0.03);
}

// One flash photograph cannot tell flash from ambient light; the same view without flash, at four times the shutter time, can.
TEST_F(Synth, APhotographWithoutFlashSettlesTheAmbientLightOfASingleOne) {
  const ProcessResult made = make({"statue:noise=0.0003", "--points", "60000", "--photographs", "2", "--size", "240x180", "--no-flash"});
  ASSERT_EQ(made.code, 0) << made.err;
  const ProcessResult ran = run("out", {"--set", "solve.method=single"});
  ASSERT_EQ(ran.code, 0) << ran.err;
  for (const auto& one : json("out/lights.json").at("acquisitions").at(0).at("photographs")) {
    EXPECT_NEAR(one["ambient"].get<double>() / one["flash_intensity"].get<double>(), 0.15 / 30, 0.02 * 0.15 / 30) << one["photograph"];
    EXPECT_EQ(one["sky_colour"][0].get<double>(), 1) << "grey is enough";
  }
  EXPECT_EQ(json("out/lights.json").at("acquisitions").at(1).at("lights_of"), "synth");
  EXPECT_FALSE(std::filesystem::exists(at("out/photographs/dark.photo_00/albedo.exr"))) << "what has no flash gives no albedo";
  EXPECT_LT(albedo_error(read_ply(at("out/albedo.ply")), truth()).absolute, 0.02);
}

// In a closed room each photograph sees a tenth of the walls, and half of the light comes from what it does not see: lights and unseen radiosity, found in turn, have
// to settle instead of chasing each other.
TEST_F(Synth, TheLightOfAClosedRoomSettles) {
  const ProcessResult made = make({"room", "--points", "30000", "--photographs", "12", "--size", "120x90"});
  ASSERT_EQ(made.code, 0) << made.err;
  const ProcessResult ran = run("out", {});
  ASSERT_EQ(ran.code, 0) << ran.err;
  const AlbedoError e = albedo_error(read_ply(at("out/albedo.ply")), truth());
  const nlohmann::json lights = json("out/lights.json").at("acquisitions").at(0);
  std::cout << "room: absolute " << e.absolute << ", scaled " << e.scaled << ", factor " << e.factor << ", bounce " << lights["bounce"] << ", flash " << lights["flash_intensity"] << '\n';
  EXPECT_TRUE(lights["converged"].get<bool>());
  EXPECT_NEAR(lights["bounce"].get<double>(), 1, 0.06);
  EXPECT_NEAR(lights["flash_intensity"].get<double>(), 45, 0.02 * 45);
  EXPECT_NEAR(e.factor, 1, 0.04);   // points lie 11 cm apart, and the paint's waves are half a metre: the pattern itself is blurred
}

}  // namespace
}  // namespace chiaro::test
