#include "tools/ingest.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <sstream>

#include "stream/base/file.h"
#include "tests/support/files.h"

namespace chiaro::tools {
namespace {

namespace fs = std::filesystem;

std::vector<std::string> names_in(const fs::path& folder) {
  std::vector<std::string> names;
  for (const auto& entry : fs::directory_iterator(folder)) names.push_back(entry.path().filename().string());
  return names;
}

/// Looks at two folders whenever a piece of work begins.
class LookingReporter : public Reporter {
 public:
  LookingReporter(fs::path results, fs::path scratch) : results_(std::move(results)), scratch_(std::move(scratch)) {}
  void begin(std::string_view stage, std::uint64_t, std::string_view) override {
    if (stage != "outliers") return;
    beside_results = names_in(results_);
    in_scratch = names_in(scratch_);
  }
  void progress(std::uint64_t) override {}
  void end() override {}
  void note(std::string_view) override {}
  bool cancelled() const override { return false; }
  std::vector<std::string> beside_results, in_scratch;

 private:
  fs::path results_, scratch_;
};

// A process that is killed leaves it: it has to lie where a later run looks.
TEST(Ingest, WhatIsNeededMeanwhileLiesInTheScratchFolder) {
  const ScratchFolder folder;
  std::ostringstream text;
  for (int i = 0; i < 400; ++i) text << i % 20 << ' ' << i / 20 << " 0\n";
  test::put_bytes(folder.path() / "cloud.xyz", text.str());
  Project project;
  project.cloud.files = {folder.path() / "cloud.xyz"};
  project.cloud.outliers = Outliers::kStatistical;
  const fs::path results = folder.path() / "out", scratch = results / "work" / "scratch";
  make_folder(results);
  LookingReporter report(results, scratch);
  MemoryBudget budget(std::uint64_t{1} << 28);
  ingest_cloud(plan_ingest(project), results / "store.chiaro", scratch, [] {}, budget, report);
  EXPECT_THAT(report.beside_results, testing::ElementsAre("work"));
  EXPECT_EQ(report.in_scratch.size(), 1u);
  EXPECT_THAT(names_in(scratch), testing::IsEmpty());
}

}  // namespace
}  // namespace chiaro::tools
