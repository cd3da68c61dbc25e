/// What a run folder holds: tasks that are done and to do, with their times, and the space each part takes.
#pragma once
#include <cstdint>
#include <filesystem>
#include <optional>
#include <string>
#include <vector>

#include "tools/run_folder.h"

namespace chiaro::tools {

enum class TaskState {
  kDone,     ///< made by the last run, or found right by it
  kRunning,
  kToDo,     ///< also where a result of an earlier run is there, until the run comes to it: whether it still holds shows then
  kLeftOut,  ///< of a photograph that the last run left out
};
/// "done", "running", "to do", "left out".
const char* name_of(TaskState state);

struct TaskStatus {
  std::string name;           ///< as `chiaro run` calls it: "develop/photo_03"
  std::string stage, item;    ///< "develop", "photo_03"; item is empty where the stage has one task
  TaskState state = TaskState::kToDo;
  double seconds = 0;         ///< that it took when it ran; 0 unless done
};

struct StageStatus {
  std::string name;
  std::size_t done = 0, running = 0, to_do = 0, left_out = 0;
  double seconds = 0;         ///< sum over its tasks that are done
};

struct PartSize {
  std::string name;           ///< relative to the folder, "store.chiaro"
  std::uint64_t bytes = 0, files = 0;
};

struct RunStatus {
  std::string project, method;
  std::vector<TaskStatus> tasks;    ///< in the order in which a run takes them
  std::vector<StageStatus> stages;  ///< the same order
  std::vector<PartSize> parts;      ///< exports each by itself; "work/…" is what a resumed run goes on from
  std::uint64_t bytes = 0;          ///< of everything in the folder
  bool has_record = false;          ///< run.json is there
  std::optional<int> exit_code;     ///< of the last run that ended
  bool running = false;             ///< a run is at work in the folder
  std::size_t from_before = 0;      ///< of the tasks to do: a result of an earlier run is there
  bool complete = false;            ///< nothing to do
};

/// Tasks that the project implies (work/project.json), against the markers in work/tasks and work/progress. Damaged markers count as to do: the task would run again.
/// throws Error naming the file if the folder is none that `chiaro run` made, or project.json or run.json is damaged.
RunStatus read_status(const RunFolder& folder);

/// A sentence for whoever shows the results in a folder whose last run has not come to its end, so that they may be of two runs; empty: it has.
std::string note_on_unfinished(const RunStatus& status);

}  // namespace chiaro::tools
