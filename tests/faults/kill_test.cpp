/// A run that is killed at any moment, without a chance to tidy up, goes on to the same bytes.
#include <algorithm>

#include "stream/base/rng.h"
#include "tests/support/run_fixture.h"

namespace chiaro::test {
namespace {

namespace fs = std::filesystem;
constexpr std::uint64_t kSeed = 20;

class Kill : public RunTest {
 protected:
  void SetUp() override {
    scene({.photographs = 2});
    const ProcessResult ran = run("whole");
    ASSERT_EQ(ran.code, 0) << ran.err;
    seconds_ = ran.seconds;
    whole_ = results("whole");
    ASSERT_GE(whole_.size(), 2u + 2 * 4);
  }

  /// Lets the run in `out` end and compares.
  void finish(const std::string& out, const std::string& when) {
    // What looks like a result is one: the export appears whole or not at all.
    if (fs::exists(at(out) / "albedo.ply")) {
      EXPECT_EQ(file_bytes(at(out) / "albedo.ply"), whole_.at("albedo.ply")) << when;
    }
    const ProcessResult resumed = run(out);
    ASSERT_EQ(resumed.code, 0) << when << "\n" << resumed.err;
    EXPECT_THAT(differences(whole_, results(out)), testing::IsEmpty()) << when;
    EXPECT_THAT(parts(out), testing::IsEmpty()) << when;
  }

  double seconds_ = 0;
  std::map<std::string, std::string> whole_;
};

TEST_F(Kill, AtFivePseudoRandomMomentsLeavesARunThatGoesOnToTheSameBytes) {
  int killed = 0;
  for (std::uint64_t i = 0; i < 5; ++i) {
    double after_s = seconds_ * static_cast<double>(uniform01(kSeed, Purpose::kTest, i, 0));
    const std::string out = "out" + std::to_string(i);
    bool signalled = false;
    for (int tries = 0; tries < 8 && !signalled; ++tries, after_s /= 2) {   // sooner where the machine has become faster than in the first run
      fs::remove_all(at(out));
      fs::create_directories(at(out));
      ProcessOptions options;
      options.signal_after_s = after_s;
      signalled = run(out, {}, options).signalled;
    }
    killed += signalled;
    finish(out, "killed after " + std::to_string(2 * after_s) + " of " + std::to_string(seconds_) + " s");
  }
  EXPECT_EQ(killed, 5);
}

TEST_F(Kill, AgainAndAgainStillEnds) {
  int killed = 0;
  fs::create_directories(at("out"));
  for (std::uint64_t i = 0; i < 5; ++i) {
    ProcessOptions options;
    options.signal_after_s = seconds_ * (0.1 + 0.4 * static_cast<double>(uniform01(kSeed, Purpose::kTest, i, 1)));
    killed += run("out", {}, options).signalled;
  }
  EXPECT_GE(killed, 2);
  finish("out", "killed five times in a row");
}

TEST_F(Kill, BetweenTasksLosesNoFinishedTask) {
  std::vector<fs::path> markers;
  for (const auto& entry : fs::directory_iterator(at("whole/work/tasks"))) markers.push_back(entry.path());
  std::sort(markers.begin(), markers.end(), [](const fs::path& a, const fs::path& b) { return fs::last_write_time(a) < fs::last_write_time(b); });
  ASSERT_GE(markers.size(), 10u);
  for (std::size_t k = 0; k < markers.size(); k += 3) {
    const std::string out = "out" + std::to_string(k), name = markers[k].filename().string();
    ProcessOptions options;
    options.signal_when = [&] { return fs::exists(at(out) / "work/tasks" / name); };
    fs::create_directories(at(out));
    const ProcessResult first = run(out, {}, options);
    const bool finished_before_us = !first.signalled;
    finish(out, "killed after " + name);
    if (finished_before_us) continue;
    std::size_t reused = 0;
    const auto record = json(out + "/run.json");
    for (const auto& stage : record["stages"]) reused += stage["reused"].get<bool>();
    EXPECT_GE(reused, k + 1) << "killed after " << name;
  }
}

}  // namespace
}  // namespace chiaro::test
