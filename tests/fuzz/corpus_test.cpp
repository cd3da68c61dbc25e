/// The corpus, and a little damage to each of its files, through the entry points that fuzzers use.
#include <gtest/gtest.h>

#include <algorithm>
#include <chrono>
#include <filesystem>

#include "stream/base/file.h"
#include "tests/fuzz/mutate.h"
#include "tests/fuzz/targets.h"
#include "tests/stream/cloud/allocation_watch.h"

namespace chiaro::fuzz {
namespace {

namespace fs = std::filesystem;

constexpr std::uint64_t kSeed = 5;
constexpr std::uint64_t kRounds = 60;                // of damage a file
constexpr std::size_t kLargestAllocation = 64 << 20; // inputs are of a few thousand bytes, readers may use 16 MiB
constexpr double kLongest_s = 30;                    // on a machine that does other things too

// Own files, and those of other programs that the readers' tests have.
std::vector<fs::path> corpus(const std::string& target) {
  std::vector<fs::path> files;
  const fs::path tests = fs::path(CHIARO_SOURCE_DIR) / "tests";
  std::error_code code;
  for (const auto& entry : fs::directory_iterator(tests / "fuzz/corpus" / target, code)) files.push_back(entry.path());
  for (const auto& entry : fs::directory_iterator(tests / "stream/cloud/data"))
    if (entry.path().extension() == "." + target) files.push_back(entry.path());
  std::sort(files.begin(), files.end());
  return files;
}

bool run(const Target& target, const std::string& bytes, const std::string& what) {
  stream::take_largest_allocation();
  const auto start = std::chrono::steady_clock::now();
  bool read = false;
  try {
    read = target.run({reinterpret_cast<const std::uint8_t*>(bytes.data()), bytes.size()});
  } catch (const std::exception& e) {
    ADD_FAILURE() << what << ": " << e.what();
  }
  EXPECT_LT(stream::take_largest_allocation(), kLargestAllocation) << what;
  EXPECT_LT(std::chrono::duration<double>(std::chrono::steady_clock::now() - start).count(), kLongest_s) << what;
  return read;
}

class FuzzCorpus : public testing::TestWithParam<std::string> {};

TEST_P(FuzzCorpus, IsReadOrRefusedWholeAndDamaged) {
  const Target& t = target(GetParam());
  if (!CHIARO_HAS_RUST_FORMATS && (t.name == "laz" || t.name == "e57")) GTEST_SKIP() << "built without the readers of LAZ and E57";
  const std::vector<fs::path> files = corpus(t.name);
  ASSERT_FALSE(files.empty()) << "no corpus";
  run(t, "", "nothing");
  for (const fs::path& file : files) {
    const std::string bytes = read_text(file);
    EXPECT_EQ(run(t, bytes, file.filename().string()), !file.filename().string().starts_with("refused_")) << file;
    for (std::uint64_t round = 0; round < kRounds; ++round) run(t, mutated(bytes, kSeed, round), file.filename().string() + ", round " + std::to_string(round));
  }
}

std::vector<std::string> names() {
  std::vector<std::string> all;
  for (const Target& t : targets()) all.push_back(t.name);
  return all;
}

INSTANTIATE_TEST_SUITE_P(Targets, FuzzCorpus, testing::ValuesIn(names()), [](const auto& i) { return i.param; });

TEST(FuzzPack, ComesBackAndMayBeCutAnywhere) {
  const std::vector<std::string> files{"abc", "", std::string(300, 'x')};
  const std::string bytes = pack(files);
  const auto view = [&](std::size_t n) { return std::span(reinterpret_cast<const std::uint8_t*>(bytes.data()), n); };
  EXPECT_EQ(unpack(view(bytes.size()), 3), files);
  for (std::size_t n = 0; n < bytes.size(); ++n) EXPECT_EQ(unpack(view(n), 4).size(), 4u);
}

}  // namespace
}  // namespace chiaro::fuzz
