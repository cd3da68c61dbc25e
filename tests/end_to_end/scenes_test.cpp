/// The rendered scenes of ../shared and a cloud of millions of points, through the executable. Label slow.
#include <cmath>
#include <iostream>

#include "tests/support/run_fixture.h"

namespace chiaro::test {
namespace {

namespace fs = std::filesystem;

#define CHIARO_NEED_SCENE(variable, name)                               \
  const fs::path variable = shared_folder() / "scenes" / (name);        \
  if (shared_folder().empty()) GTEST_SKIP() << "../shared/scenes is absent"

double half_to_double(unsigned bits) {
  const int exponent = static_cast<int>(bits >> 10 & 31);
  const double fraction = bits & 1023, sign = bits >> 15 ? -1 : 1;
  if (exponent == 31) return fraction > 0 ? std::nan("") : sign * INFINITY;
  return exponent == 0 ? sign * std::ldexp(fraction, -24) : sign * std::ldexp(1024 + fraction, exponent - 25);
}

/// truth/albedo.npy: (N, 3) of half floats.
std::vector<std::array<double, 3>> read_truth(const fs::path& path) {
  const std::string bytes = file_bytes(path);
  const std::size_t header = 10 + static_cast<unsigned char>(bytes[8]) + 256u * static_cast<unsigned char>(bytes[9]);
  EXPECT_NE(bytes.substr(0, header).find("<f2"), std::string::npos) << path;
  std::vector<std::array<double, 3>> truth((bytes.size() - header) / 6);
  for (std::size_t i = 0; i < 3 * truth.size(); ++i) {
    const std::size_t at = header + 2 * i;
    truth[i / 3][i % 3] = half_to_double(static_cast<unsigned char>(bytes[at]) | static_cast<unsigned>(static_cast<unsigned char>(bytes[at + 1])) << 8);
  }
  return truth;
}

class Scenes : public RunTest {
 protected:
  Scenes() : RunTest(fs::path()) {}   // too much for a disk in memory

  AlbedoError run_scene(const fs::path& folder, const std::string& project, std::vector<std::string> more = {}) const {
    std::vector<std::string> words{"run", (folder / project).string(), "--out", at("out").string()};
    words.insert(words.end(), more.begin(), more.end());
    ran_ = chiaro(words);
    EXPECT_EQ(ran_.code, 0) << ran_.err;
    if (ran_.code != 0) return {};
    const AlbedoError e = albedo_error(read_ply(at("out/albedo.ply")), read_truth(folder / "truth/albedo.npy"));
    std::cout << project << ": absolute " << e.absolute << ", scaled " << e.scaled << ", seen " << e.seen << " of " << e.points << ", " << ran_.seconds << " s, "
              << (ran_.peak_bytes >> 20) << " MiB\n";
    return e;
  }
  mutable ProcessResult ran_;
};

class OnePhotograph : public Scenes, public testing::WithParamInterface<const char*> {};
TEST_P(OnePhotograph, OfTwoPlanesGivesTheirAlbedoUpToScale) {
  CHIARO_NEED_SCENE(folder, "vplanes");
  const AlbedoError e = run_scene(folder, GetParam());
  EXPECT_GT(e.seen, e.points / 2);
  EXPECT_LE(e.scaled, 0.02);
}
INSTANTIATE_TEST_SUITE_P(Lights, OnePhotograph, testing::Values("project.toml", "project_ambient.toml", "project_direct.toml", "project_interreflected.toml"),
                         [](const auto& i) { return std::string(i.param).substr(0, std::string(i.param).find('.')); });

/// Mottling hides what a missing interreflection does to the residuals: the evidence is in their sum.
class WithoutInterreflections : public Scenes, public testing::WithParamInterface<const char*> {};
TEST_P(WithoutInterreflections, ATexturedPhotographIsRecognised) {
  CHIARO_NEED_SCENE(folder, "vplanes_textured");
  const AlbedoError e = run_scene(folder, GetParam());
  EXPECT_LE(e.absolute, 0.1);
  EXPECT_LE(e.scaled, 0.03);
}
INSTANTIATE_TEST_SUITE_P(Lights, WithoutInterreflections, testing::Values("project_ambient.toml", "project_direct.toml"),
                         [](const auto& i) { return std::string(i.param).substr(0, std::string(i.param).find('.')); });

TEST_F(Scenes, TheTowerComesOutAbsolutely) {
  CHIARO_NEED_SCENE(folder, "tower");
  const AlbedoError e = run_scene(folder, "project.toml", {"--memory", "512MiB"});
  EXPECT_GT(e.seen, e.points / 3);   // the corner from outside: half of its points are in the far walls and the soil
  EXPECT_LE(e.absolute, 0.05);
  EXPECT_LE(ran_.peak_bytes, 512u << 20);
}

TEST_F(Scenes, TwoMillionPointsStayWithinTheirMemory) {
  TinySceneOptions options;
  options.points = 2'000'000;
  options.with_normals = false;
  options.width_px = 480;
  options.height_px = 360;
  options.focal_px = 550;
  const TinyScene s = scene(options);
  const ProcessResult ran = run("out", {"--memory", "256MiB"});
  ASSERT_EQ(ran.code, 0) << ran.err;
  const AlbedoError e = albedo_error(read_ply(at("out/albedo.ply")), s.albedo);
  std::cout << "2 M points: absolute " << e.absolute << ", " << ran.seconds << " s, " << (ran.peak_bytes >> 20) << " MiB\n";
  EXPECT_LE(ran.peak_bytes, 256u << 20);
  EXPECT_LE(json("out/run.json")["memory"]["peak_bytes"].get<std::uint64_t>(), 256u << 20);
  EXPECT_LE(e.absolute, 0.01);
}

}  // namespace
}  // namespace chiaro::test
