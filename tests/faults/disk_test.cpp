/// A disk that is full, a folder that cannot be written: a clear error, and the run goes on once there is space.
#include <sys/mount.h>
#include <unistd.h>

#include <cerrno>
#include <cstring>

#include "tests/support/run_fixture.h"

namespace chiaro::test {
namespace {

namespace fs = std::filesystem;
using testing::HasSubstr;

/// A disk of a given size in memory; needs the right to mount.
class SmallDisk {
 public:
  explicit SmallDisk(fs::path folder) : folder_(std::move(folder)) { fs::create_directories(folder_); }
  SmallDisk(const SmallDisk&) = delete;
  SmallDisk& operator=(const SmallDisk&) = delete;
  ~SmallDisk() {
    if (mounted_) umount2(folder_.c_str(), MNT_DETACH);
  }
  bool resize(std::uint64_t bytes, bool read_only = false) {
    const std::string size = "size=" + std::to_string(bytes);
    const unsigned long flags = (mounted_ ? MS_REMOUNT : 0) | (read_only ? MS_RDONLY : 0);
    const bool done = mount("tmpfs", folder_.c_str(), "tmpfs", flags, size.c_str()) == 0;
    mounted_ = mounted_ || done;
    return done;
  }

 private:
  fs::path folder_;
  bool mounted_ = false;
};

std::uint64_t bytes_below(const fs::path& folder) {
  std::uint64_t sum = 0;
  for (const auto& entry : fs::recursive_directory_iterator(folder))
    if (entry.is_regular_file()) sum += entry.file_size();
  return sum;
}

class Disk : public RunTest {};

TEST_F(Disk, FullAtAnyMomentIsAClearErrorAndTheRunGoesOnLater) {
  SmallDisk disk(at("disk"));
  if (!disk.resize(1 << 20)) GTEST_SKIP() << "mounting a small disk is not permitted here: " << std::strerror(errno);
  scene({.photographs = 2});
  ASSERT_EQ(run("whole").code, 0);
  const std::uint64_t needed = bytes_below(at("whole"));
  int stopped = 0;
  for (const int percent : {2, 20, 45, 70, 95}) {
    const std::string out = "disk/out" + std::to_string(percent);
    ASSERT_TRUE(disk.resize(std::max<std::uint64_t>(16384, needed * static_cast<std::uint64_t>(percent) / 100)));
    const ProcessResult ran = run(out);
    ASSERT_FALSE(ran.signalled) << percent << " %: signal " << ran.code - 128;
    if (ran.code != 0) {
      ++stopped;
      EXPECT_EQ(ran.code, 1) << percent << " %: " << ran.err;
      EXPECT_THAT(ran.err, testing::AnyOf(HasSubstr("no space left"), HasSubstr("disk"))) << percent << " %";
      EXPECT_THAT(ran.err, HasSubstr(at("disk").string())) << percent << " %: the file is not named";
    }
    ASSERT_TRUE(disk.resize(8 * needed + (8u << 20)));
    const ProcessResult later = run(out);
    EXPECT_EQ(later.code, 0) << percent << " %: " << later.err;
    EXPECT_THAT(differences(results("whole"), results(out)), testing::IsEmpty()) << percent << " %";
    EXPECT_THAT(parts(out), testing::IsEmpty()) << percent << " %";
    fs::remove_all(at(out));
  }
  EXPECT_GE(stopped, 4);
}

TEST_F(Disk, TooSmallForThePhotographsIsSaidBeforeTheFirst) {
  SmallDisk disk(at("disk"));
  if (!disk.resize(1 << 20)) GTEST_SKIP() << "mounting a small disk is not permitted here: " << std::strerror(errno);
  scene({.points = 500, .photographs = 4, .width_px = 384, .height_px = 288, .focal_px = 440});
  // One of them has room: 62 bytes a pixel while the largest raster is made, and a quarter of 43 a pixel of each photograph.
  ASSERT_TRUE(disk.resize(9'000'000));
  const ProcessResult ran = run("disk/out");
  EXPECT_EQ(ran.code, 1);
  EXPECT_THAT(ran.err, HasSubstr("no space: what is kept of the photographs' pixels needs 11.07 MiB, the disk has "));
  EXPECT_FALSE(fs::exists(at("disk/out/work/photographs/photo_00/radiance.raster")));
  // Cells of four pixels have.
  EXPECT_EQ(run("disk/out", {"--set", "acquisition.binning=4"}).code, 0);
  // What is there already is not asked for again.
  ASSERT_TRUE(disk.resize(40'000'000));
  ASSERT_EQ(run("disk/out").code, 0);
  ASSERT_TRUE(disk.resize(bytes_below(at("disk")) + 4'000'000));
  const ProcessResult again = run("disk/out");
  EXPECT_EQ(again.code, 0) << again.err;
}

TEST_F(Disk, ThatRefusesLargeFilesIsAClearError) {
  // Works without the right to mount: the system refuses to let any file grow beyond the limit.
  scene({.photographs = 1});
  ASSERT_EQ(run("whole").code, 0);
  int stopped = 0;
  for (const std::uint64_t bytes : {2000u, 30000u, 120000u, 300000u}) {
    const std::string out = "out" + std::to_string(bytes);
    ProcessOptions options;
    options.max_file_bytes = bytes;
    const ProcessResult ran = run(out, {}, options);
    ASSERT_FALSE(ran.signalled) << bytes << ": signal " << ran.code - 128;
    if (ran.code != 0) {
      ++stopped;
      EXPECT_EQ(ran.code, 1) << bytes << ": " << ran.err;
      EXPECT_THAT(ran.err, HasSubstr(at(out).string())) << bytes << ": the file is not named";
    }
    EXPECT_EQ(run(out).code, 0) << bytes;
    EXPECT_THAT(differences(results("whole"), results(out)), testing::IsEmpty()) << bytes;
  }
  EXPECT_GE(stopped, 2);
}

TEST_F(Disk, ThatCannotBeWrittenIsNamed) {
  SmallDisk disk(at("disk"));
  scene({.photographs = 1});
  if (geteuid() != 0) {
    fs::create_directories(at("disk"));
    fs::permissions(at("disk"), fs::perms::owner_read | fs::perms::owner_exec);
  } else if (!disk.resize(1 << 20) || !disk.resize(1 << 20, true)) {
    GTEST_SKIP() << "mounting a read-only disk is not permitted here: " << std::strerror(errno);
  }
  const ProcessResult ran = run("disk/out");
  EXPECT_EQ(ran.code, 1);
  EXPECT_THAT(ran.err, HasSubstr(at("disk/out").string()));
  if (geteuid() != 0) fs::permissions(at("disk"), fs::perms::owner_all);
}

TEST_F(Disk, OutputFolderThatIsAFileIsNamed) {
  scene({.photographs = 1});
  put_bytes(at("out"), "a file of the user's");
  const ProcessResult ran = run("out");
  EXPECT_EQ(ran.code, 1);
  EXPECT_THAT(ran.err, HasSubstr(at("out").string()));
  EXPECT_EQ(file_bytes(at("out")), "a file of the user's");
}

}  // namespace
}  // namespace chiaro::test
