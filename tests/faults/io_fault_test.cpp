/// Every write, sync and rename goes wrong once: refused for want of space, refused by the disk, or torn by the end of the process. The error is clear, what
/// was finished before stays readable, and the next try ends with the same bytes.
#include <algorithm>

#include "stream/base/rng.h"
#include "tests/support/run_fixture.h"

namespace chiaro::test {
namespace {

namespace fs = std::filesystem;
using testing::HasSubstr;

class IoFault : public RunTest {
 protected:
  void SetUp() override {
    if (other_executable()) GTEST_SKIP() << "sanitizers want to be loaded first";
  }

  ProcessOptions shim(const std::string& folder, long call, const std::string& kind) const {
    ProcessOptions options;
    options.environment = {std::string("LD_PRELOAD=") + CHIARO_IO_SHIM, "CHIARO_SHIM_FOLDER=" + at(folder).string(), "CHIARO_SHIM_COUNT=" + at("count").string(),
                           "CHIARO_SHIM_AT=" + std::to_string(call), "CHIARO_SHIM_KIND=" + kind};
    return options;
  }
  long counted() const { return std::stol(file_bytes(at("count"))); }

  static void expect_clear(const ProcessResult& ran, const std::string& kind, const std::string& folder, const std::string& when) {
    if (kind == "tear") {
      EXPECT_TRUE(ran.signalled) << when;
      return;
    }
    EXPECT_FALSE(ran.signalled) << when;
    EXPECT_EQ(ran.code, 1) << when << ": " << ran.err;
    EXPECT_THAT(ran.err, HasSubstr(folder)) << when << ": the file is not named";
    EXPECT_THAT(ran.err, testing::AnyOf(HasSubstr("o space left"), HasSubstr("nput/output error"))) << when;
  }
};

/// Calls that are tried: all of them up to `most`, else so many that lie evenly.
std::vector<long> tried(long calls, long most) {
  std::vector<long> chosen;
  const long n = std::min(calls, most);
  for (long i = 0; i < n; ++i) chosen.push_back(n == 1 ? 1 : 1 + i * (calls - 1) / (n - 1));
  return chosen;
}

class StoreFault : public IoFault {
 protected:
  void whole_store(std::size_t points) {
    cloud("cloud.ply", 1, points);
    const ProcessResult ran = ingest("cloud.ply", "disk/whole.chiaro", shim("disk", 0, "EIO"));
    ASSERT_EQ(ran.code, 0) << ran.err;
    calls_ = counted();
    ASSERT_GE(calls_, 20);
    whole_ = files_below(at("disk/whole.chiaro"));
  }

  /// A bumpy ball with colours.
  void cloud(const std::string& name, std::uint64_t seed, std::size_t points) const {
    std::string text = "ply\nformat binary_little_endian 1.0\nelement vertex " + std::to_string(points) +
                       "\nproperty float x\nproperty float y\nproperty float z\nproperty uchar red\nproperty uchar green\nproperty uchar blue\nend_header\n";
    for (std::size_t i = 0; i < points; ++i) {
      const Vec3f u(uniform01(seed, Purpose::kTest, i, 0) - 0.5f, uniform01(seed, Purpose::kTest, i, 1) - 0.5f, uniform01(seed, Purpose::kTest, i, 2) - 0.5f);
      const Vec3f p = u.normalized() * (1 + 0.05f * std::sin(20 * u.x()));
      text.append(reinterpret_cast<const char*>(p.data()), 12);
      for (int c = 0; c < 3; ++c) text.push_back(static_cast<char>(i >> (2 * c)));
    }
    put_bytes(at(name), text);
  }

  ProcessResult ingest(const std::string& cloud, const std::string& out, const ProcessOptions& options = {}) const {
    return chiaro({"ingest", at(cloud).string(), "--out", at(out).string(), "--quiet"}, options);
  }

  std::vector<std::string> on_disk() const {
    std::vector<std::string> names;
    for (const auto& entry : fs::directory_iterator(at("disk"))) names.push_back(entry.path().filename().string());
    return names;
  }

  void every_fault_heals(long most) const {
    for (const std::string kind : {"ENOSPC", "EIO", "tear"})
      for (const long call : tried(calls_, most)) {
        const std::string when = kind + " at call " + std::to_string(call) + " of " + std::to_string(calls_);
        expect_clear(ingest("cloud.ply", "disk/out.chiaro", shim("disk", call, kind)), kind, at("disk").string(), when);
        const ProcessResult again = ingest("cloud.ply", "disk/out.chiaro");
        ASSERT_EQ(again.code, 0) << when << ": " << again.err;
        ASSERT_THAT(differences(whole_, files_below(at("disk/out.chiaro"))), testing::IsEmpty()) << when;
        EXPECT_THAT(on_disk(), testing::UnorderedElementsAre("whole.chiaro", "out.chiaro")) << when;
        fs::remove_all(at("disk/out.chiaro"));
      }
  }

  long calls_ = 0;
  std::map<std::string, std::string> whole_;
};

TEST_F(StoreFault, AtEveryCallTheNextTryEndsWithTheSameBytes) {
  ASSERT_NO_FATAL_FAILURE(whole_store(2'000));
  every_fault_heals(calls_);
}

TEST_F(StoreFault, WithSeveralLeavesTheNextTryEndsWithTheSameBytes) {
  ASSERT_NO_FATAL_FAILURE(whole_store(90'000));
  every_fault_heals(5);
}

TEST_F(StoreFault, AtEveryCallAnOlderStoreStaysReadable) {
  ASSERT_NO_FATAL_FAILURE(whole_store(2'000));
  cloud("older.ply", 2, 1'000);
  ASSERT_EQ(ingest("older.ply", "older.chiaro").code, 0);
  const auto older = files_below(at("older.chiaro"));
  for (const std::string kind : {"EIO", "tear"})
    for (long call = 1; call <= calls_ + 2; ++call) {
      const std::string when = kind + " at call " + std::to_string(call);
      fs::remove_all(at("disk/out.chiaro"));
      fs::copy(at("older.chiaro"), at("disk/out.chiaro"), fs::copy_options::recursive);
      const ProcessResult ran = ingest("cloud.ply", "disk/out.chiaro", shim("disk", call, kind));
      if (ran.code == 0) {
        EXPECT_GT(call, calls_) << when;
        continue;
      }
      const auto now = files_below(at("disk/out.chiaro"));
      EXPECT_TRUE(differences(older, now).empty() || differences(whole_, now).empty()) << when << ": neither the older nor the new store";
      EXPECT_EQ(chiaro({"verify", at("disk/out.chiaro").string(), "--quiet"}).code, 0) << when;
      ASSERT_EQ(ingest("cloud.ply", "disk/out.chiaro").code, 0) << when;
      ASSERT_THAT(differences(whole_, files_below(at("disk/out.chiaro"))), testing::IsEmpty()) << when;
      EXPECT_THAT(on_disk(), testing::UnorderedElementsAre("whole.chiaro", "out.chiaro")) << when;
    }
}

TEST_F(IoFault, AnywhereInARunTheNextTryEndsWithTheSameBytes) {
  scene({.photographs = 2});
  ASSERT_EQ(run("whole", {}, shim("whole", 0, "EIO")).code, 0);
  const long calls = counted();
  ASSERT_GE(calls, 100);
  for (const std::string kind : {"ENOSPC", "EIO", "tear"})
    for (const long call : tried(calls, 6)) {
      const std::string out = "out", when = kind + " at call " + std::to_string(call) + " of " + std::to_string(calls);
      expect_clear(run(out, {}, shim(out, call, kind)), kind, at(out).string(), when);
      const ProcessResult again = run(out);
      ASSERT_EQ(again.code, 0) << when << ": " << again.err;
      EXPECT_THAT(differences(results("whole"), results(out)), testing::IsEmpty()) << when;
      EXPECT_THAT(parts(out), testing::IsEmpty()) << when;
      fs::remove_all(at(out));
    }
}

}  // namespace
}  // namespace chiaro::test
