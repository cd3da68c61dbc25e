#include "tools/status.h"

#include <algorithm>
#include <map>
#include <set>

#include "stream/base/folder_lock.h"
#include "tools/progress_log.h"
#include "tools/report_json.h"

namespace chiaro::tools {
namespace {
namespace fs = std::filesystem;

struct Marker {
  double seconds = 0;
};

std::map<std::string, Marker> read_markers(const fs::path& folder) {
  std::map<std::string, Marker> markers;
  std::error_code code;
  for (fs::directory_iterator it(folder, code), end; !code && it != end; it.increment(code)) {
    if (it->path().extension() != ".json") continue;
    try {
      const Json json = read_json_object(it->path());
      const std::string name = text_of(member(json, "task"));
      if (!name.empty() && member(json, "key").is_string()) markers[name] = {number_of(member(json, "seconds"), 0)};
    } catch (const Error&) {
      // A damaged marker is none: the task will run again.
    }
  }
  return markers;
}

class TaskList {
 public:
  TaskList(std::map<std::string, Marker> markers, std::set<std::string> left_out, std::optional<Progress> progress, bool running)
      : markers_(std::move(markers)), left_out_(std::move(left_out)), progress_(std::move(progress)), running_(running) {}

  void add(const std::string& stage, const std::string& item = "", bool left_out = false) {
    TaskStatus task{item.empty() ? stage : stage + "/" + item, stage, item};
    const auto marker = markers_.find(task.name);
    if (left_out) {
      task.state = TaskState::kLeftOut;
    } else if (running_ && progress_ && progress_->begun == task.name) {
      task.state = TaskState::kRunning;
    } else if (marker != markers_.end() && progress_ && !progress_->done.contains(task.name)) {
      ++from_before;
    } else if (marker != markers_.end()) {
      task.state = TaskState::kDone;
      task.seconds = marker->second.seconds;
    }
    tasks.push_back(std::move(task));
  }
  void add_of_photograph(const std::string& stage, const std::string& key) { add(stage, key, left_out_.contains(key)); }
  bool leaves_out(const std::string& key) const { return left_out_.contains(key); }

  std::vector<TaskStatus> tasks;
  std::size_t from_before = 0;

 private:
  std::map<std::string, Marker> markers_;
  std::set<std::string> left_out_;
  std::optional<Progress> progress_;
  bool running_;
};

struct Shoot {
  std::string name, lead;   ///< lead: of the acquisition that its lights are solved with, mostly itself
  bool has_flash = true;    ///< without, it measures ambient light and gives no albedo
  std::vector<std::string> photographs;
};

std::vector<Shoot> shoots_of(const Json& project, const fs::path& file) {
  std::vector<Shoot> shoots;
  for (const Json& a : member(project, "acquisition")) {
    Shoot shoot{text_of(member(a, "name")), text_of(member(a, "lights_of"), text_of(member(a, "name"))), text_of(member(a, "role"), "flash") == "flash", {}};
    require_plain_name(shoot.name, file, "an acquisition");
    for (const Json& p : member(a, "photographs")) {
      shoot.photographs.push_back(text_of(member(p, "key")));
      require_plain_name(shoot.photographs.back(), file, "a photograph");
    }
    shoots.push_back(std::move(shoot));
  }
  if (shoots.empty()) throw Error(concat(file.string(), ": damaged: it names no acquisition"));
  return shoots;
}

/// Lights are solved once for all acquisitions that share them, and for none of which every photograph was left out.
void add_lights(TaskList& list, const std::vector<Shoot>& shoots, const Shoot& lead) {
  if (lead.lead != lead.name || !lead.has_flash) return;
  const bool none_left = std::all_of(shoots.begin(), shoots.end(), [&](const Shoot& s) {
    return s.lead != lead.name || !s.has_flash || std::all_of(s.photographs.begin(), s.photographs.end(), [&](const std::string& key) { return list.leaves_out(key); });
  });
  list.add("gather", lead.name, none_left);
  list.add("light", lead.name, none_left);
}

void add_tasks(TaskList& list, const std::vector<Shoot>& shoots, const std::string& method, const Json& project) {
  list.add("ingest");
  for (const Shoot& shoot : shoots) {
    if (!shoot.has_flash && method == "none") continue;   // no light is looked for
    for (const auto& key : shoot.photographs) list.add_of_photograph("develop", key);
    for (const auto& key : shoot.photographs) list.add_of_photograph("raycast", key);
    if (!shoot.has_flash) continue;
    if (method != "none") add_lights(list, shoots, shoot);
    for (const auto& key : shoot.photographs) list.add_of_photograph(method == "none" ? "colour" : "albedo", key);
  }
  const std::string layer = text_of(member(member(project, "blend"), "layer"), "albedo");
  const std::string item = RunFolder::blend_task(layer) == "blend" ? "" : layer;
  list.add("blend", item);
  if (text_of(member(member(project, "blend"), "refine"), "none") != "none") list.add("refine", item);
  for (const Shoot& shoot : shoots)
    if (shoot.has_flash)
      for (const auto& key : shoot.photographs) list.add_of_photograph("residual", key);
  for (const Json& e : member(project, "export")) list.add("export", text_of(member(e, "file")));
}

std::vector<StageStatus> stages_of(const std::vector<TaskStatus>& tasks) {
  std::vector<StageStatus> stages;
  for (const TaskStatus& task : tasks) {
    auto it = std::find_if(stages.begin(), stages.end(), [&](const StageStatus& s) { return s.name == task.stage; });
    if (it == stages.end()) it = stages.insert(stages.end(), StageStatus{task.stage});
    it->done += task.state == TaskState::kDone;
    it->running += task.state == TaskState::kRunning;
    it->to_do += task.state == TaskState::kToDo;
    it->left_out += task.state == TaskState::kLeftOut;
    it->seconds += task.seconds;
  }
  return stages;
}

/// Files that vanish while we look (a run at work) are passed over.
PartSize size_of(const fs::path& root, const std::string& name) {
  PartSize part{name};
  const fs::path path = root / name;
  std::error_code code;
  const auto add = [&](const fs::path& file) {
    std::error_code failed;
    const auto bytes = fs::file_size(file, failed);
    if (failed) return;
    part.bytes += bytes;
    ++part.files;
  };
  if (fs::is_regular_file(path, code)) {
    add(path);
    return part;
  }
  for (fs::recursive_directory_iterator it(path, fs::directory_options::skip_permission_denied, code), end; !code && it != end; it.increment(code)) {
    std::error_code failed;
    if (it->is_regular_file(failed) && !it->is_symlink(failed)) add(it->path());
  }
  return part;
}

void add_parts(RunStatus& status, const RunFolder& folder) {
  std::vector<std::string> names;
  std::error_code code;
  for (fs::directory_iterator it(folder.root, code), end; !code && it != end; it.increment(code))
    if (it->path().filename() != "work") names.push_back(it->path().filename().string());
  for (fs::directory_iterator it(folder.work(), code), end; !code && it != end; it.increment(code)) names.push_back("work/" + it->path().filename().string());
  std::sort(names.begin(), names.end());
  for (const std::string& name : names) {
    status.parts.push_back(size_of(folder.root, name));
    status.bytes += status.parts.back().bytes;
  }
}

std::set<std::string> read_record(const RunFolder& folder, RunStatus& status) {
  std::set<std::string> left_out;
  std::error_code code;
  status.has_record = fs::exists(folder.record(), code);
  if (!status.has_record) return left_out;
  const Json record = read_json_object(folder.record());
  if (member(record, "exit").is_number_integer()) status.exit_code = member(record, "exit").get<int>();
  for (const Json& one : member(record, "left_out"))
    if (text_of(member(one, "kind")) == "photograph") left_out.insert(text_of(member(one, "name")));
  return left_out;
}

}  // namespace

const char* name_of(TaskState state) {
  switch (state) {
    case TaskState::kDone: return "done";
    case TaskState::kRunning: return "running";
    case TaskState::kLeftOut: return "left out";
    case TaskState::kToDo: break;
  }
  return "to do";
}

RunStatus read_status(const RunFolder& folder) {
  std::error_code code;
  if (!fs::is_directory(folder.root, code)) throw Error(concat(folder.root.string(), ": no such folder"));
  if (!fs::exists(folder.project(), code)) throw Error(concat(folder.root.string(), ": not the folder of a run: ", folder.project().string(), " is missing"));
  const Json project = read_json_object(folder.project());
  RunStatus status;
  status.project = text_of(member(member(project, "project"), "name"));
  status.method = text_of(member(member(project, "solve"), "method"));
  status.running = FolderLock::is_held(folder.work());
  TaskList list(read_markers(folder.tasks()), read_record(folder, status), read_progress(folder.progress()), status.running);
  add_tasks(list, shoots_of(project, folder.project()), status.method, project);
  status.from_before = list.from_before;
  status.tasks = std::move(list.tasks);
  status.stages = stages_of(status.tasks);
  status.complete = std::none_of(status.tasks.begin(), status.tasks.end(), [](const TaskStatus& t) { return t.state == TaskState::kToDo || t.state == TaskState::kRunning; });
  add_parts(status, folder);
  return status;
}

std::string note_on_unfinished(const RunStatus& status) {
  if (status.complete) return {};
  const auto to_do = std::count_if(status.tasks.begin(), status.tasks.end(), [](const TaskStatus& t) { return t.state == TaskState::kToDo || t.state == TaskState::kRunning; });
  return concat(status.running ? "a run is at work in this folder" : "the last run in this folder did not come to its end", " (", to_do, " of ", status.tasks.size(),
                " tasks are to do, see chiaro status): what is shown may be in part of an earlier run, with other options or inputs");
}

}  // namespace chiaro::tools
