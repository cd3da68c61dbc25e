#include "tools/status.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <sstream>

#include "run_fixture.h"
#include "stream/base/error.h"
#include "stream/base/folder_lock.h"
#include "tools/command.h"
#include "tools/commands.h"
#include "tools/progress_log.h"

namespace chiaro::tools {
namespace {
using testing::HasSubstr;

const TaskStatus& task(const RunStatus& status, const std::string& name) {
  for (const TaskStatus& t : status.tasks)
    if (t.name == name) return t;
  throw Error("no task " + name);
}

TEST(Status, OfAFinishedRunIsComplete) {
  RunFixture run;
  run.write();
  const RunStatus s = read_status(run.folder);
  EXPECT_TRUE(s.complete);
  EXPECT_EQ(s.exit_code, 3);
  // ingest, gather, light, blend, export; four tasks for each of two photographs and of the one that was left out.
  EXPECT_EQ(s.tasks.size(), 5u + 4u * 3u);
  EXPECT_EQ(task(s, "develop/photo_99").state, TaskState::kLeftOut);
  EXPECT_EQ(task(s, "ingest").seconds, 2);
  ASSERT_EQ(s.stages.size(), 9u);
  EXPECT_EQ(s.stages[0].name, "ingest");
  EXPECT_EQ(s.stages[1].name, "develop");
  EXPECT_EQ(s.stages[1].done, 2u);
  EXPECT_EQ(s.stages[1].left_out, 1u);
  EXPECT_EQ(s.stages[1].seconds, 1);
}

TEST(Status, ListsWhatHasNoMarkerAsToDo) {
  RunFixture run;
  run.write();
  std::filesystem::remove(run.folder.tasks() / "blend.json");
  write_text(run.folder.tasks() / "albedo.photo_01.json", "{\"task\":\"albedo/photo_01\",");
  std::filesystem::remove(run.folder.record());
  const RunStatus s = read_status(run.folder);
  EXPECT_FALSE(s.complete);
  EXPECT_FALSE(s.exit_code.has_value());
  EXPECT_EQ(task(s, "blend").state, TaskState::kToDo);
  EXPECT_EQ(task(s, "albedo/photo_01").state, TaskState::kToDo);
  EXPECT_EQ(task(s, "albedo/photo_00").state, TaskState::kDone);
  EXPECT_EQ(task(s, "develop/photo_99").state, TaskState::kToDo);
}

// Markers of an earlier run say nothing of one that has not come to them: its options may be others.
TEST(Status, ResultsOfAnEarlierRunAreToDoUntilTheRunComesToThem) {
  RunFixture run;
  run.write();
  {
    ProgressLog log(run.folder.progress());
    for (const char* name : {"ingest", "develop/photo_00"}) {
      log.begun(name);
      log.done(name);
    }
    log.begun("develop/photo_01");
  }
  RunStatus s = read_status(run.folder);
  EXPECT_FALSE(s.complete);
  EXPECT_FALSE(s.running);
  EXPECT_EQ(task(s, "ingest").state, TaskState::kDone);
  EXPECT_EQ(task(s, "develop/photo_00").state, TaskState::kDone);
  EXPECT_EQ(task(s, "develop/photo_01").state, TaskState::kToDo);   // it was stopped there
  EXPECT_EQ(task(s, "blend").state, TaskState::kToDo);
  EXPECT_EQ(s.from_before, 5u + 8u - 2u);
  const FolderLock at_work(run.folder.work());
  s = read_status(run.folder);
  EXPECT_TRUE(s.running);
  EXPECT_EQ(task(s, "develop/photo_01").state, TaskState::kRunning);
  EXPECT_EQ(s.stages[1].running, 1u);
  ProgressLog anew(run.folder.progress());
  EXPECT_EQ(read_status(run.folder).from_before, 5u + 8u);
}

TEST(Status, LightsThatAreSharedOrOfNothingAreNotToDo) {
  RunFixture run;
  run.write();
  auto project = nlohmann::json::parse(read_text(run.folder.project()));
  const auto photograph = [](const char* key) { return nlohmann::json::array({{{"key", key}, {"file", "/somewhere/else.exr"}}}); };
  project["acquisition"].push_back({{"name", "slower"}, {"role", "flash"}, {"lights_of", "day1"}, {"photographs", photograph("slow_00")}});
  project["acquisition"].push_back({{"name", "spoiled"}, {"role", "flash"}, {"photographs", photograph("photo_99")}});   // left out, by run.json
  write_text(run.folder.project(), project.dump());
  for (const char* stage : {"develop/", "raycast/", "albedo/", "residual/"}) run.mark(stage + std::string("slow_00"), 1);
  const RunStatus s = read_status(run.folder);
  EXPECT_TRUE(s.complete);
  EXPECT_THROW(task(s, "gather/slower"), Error);
  EXPECT_EQ(task(s, "light/day1").state, TaskState::kDone);
  EXPECT_EQ(task(s, "light/spoiled").state, TaskState::kLeftOut);
}

TEST(Status, KnowsTheTasksOfPhotographsWithoutFlash) {
  RunFixture run;
  run.write();
  auto project = nlohmann::json::parse(read_text(run.folder.project()));
  project["acquisition"].push_back({{"name", "dark"}, {"role", "no_flash"}, {"lights_of", "day1"}, {"photographs", {{{"key", "dark_00"}, {"file", "/somewhere/else.exr"}}}}});
  write_text(run.folder.project(), project.dump());
  run.mark("develop/dark_00", 1);
  RunStatus s = read_status(run.folder);
  EXPECT_FALSE(s.complete);
  EXPECT_EQ(task(s, "develop/dark_00").state, TaskState::kDone);
  EXPECT_EQ(task(s, "raycast/dark_00").state, TaskState::kToDo);
  run.mark("raycast/dark_00", 1);
  s = read_status(run.folder);
  EXPECT_TRUE(s.complete);
  for (const char* none : {"albedo/dark_00", "residual/dark_00", "light/dark"}) EXPECT_THROW(task(s, none), Error) << none;
}

TEST(Status, KnowsTheTasksOfBlendingAlone) {
  RunFixture run;
  run.method = "none";
  run.write();
  run.mark("colour/photo_00", 1);
  const RunStatus s = read_status(run.folder);
  EXPECT_EQ(task(s, "colour/photo_00").state, TaskState::kDone);
  EXPECT_EQ(task(s, "colour/photo_01").state, TaskState::kToDo);
  for (const TaskStatus& t : s.tasks) EXPECT_TRUE(t.stage != "light" && t.stage != "gather" && t.stage != "albedo") << t.name;
}

TEST(Status, AddsUpTheDisk) {
  RunFixture run;
  run.write();
  const RunStatus s = read_status(run.folder);
  std::uint64_t sum = 0, of_ply = 0;
  for (const PartSize& p : s.parts) {
    sum += p.bytes;
    if (p.name == "albedo.ply") of_ply = p.bytes;
  }
  EXPECT_EQ(sum, s.bytes);
  EXPECT_EQ(of_ply, 1000u);
  std::uint64_t walked = 0;
  for (const auto& entry : std::filesystem::recursive_directory_iterator(run.folder.root))
    if (entry.is_regular_file()) walked += entry.file_size();
  EXPECT_EQ(s.bytes, walked);
}

TEST(Status, SaysWhatIsNoRunFolder) {
  const ScratchFolder empty;
  EXPECT_THROW(read_status(RunFolder{empty.path() / "absent"}), Error);
  EXPECT_THROW(read_status(RunFolder{empty.path()}), Error);
  RunFixture run;
  run.write();
  write_text(run.folder.project(), "{}");
  EXPECT_THROW(read_status(run.folder), Error);
}

TEST(Status, PrintsATableAndJson) {
  RunFixture run;
  run.write();
  std::ostringstream out, err;
  Console console(out, err);
  EXPECT_EQ(run_status(std::vector<std::string>{run.folder.root.string()}, console), 0);
  EXPECT_THAT(out.str(), HasSubstr("raycast"));
  EXPECT_THAT(out.str(), HasSubstr("complete"));
  out.str("");
  EXPECT_EQ(run_status(std::vector<std::string>{"--json", run.folder.root.string()}, console), 0);
  const auto json = nlohmann::json::parse(out.str());
  EXPECT_EQ(json["event"], "result");
  EXPECT_EQ(json["complete"], true);
  EXPECT_EQ(json["stages"][0]["name"], "ingest");
}

}  // namespace
}  // namespace chiaro::tools
