/// Resume and re-run as one mechanism: a task is done when its marker names the key of its inputs and options and its outputs exist (design decision 3).
#pragma once
#include <filesystem>
#include <functional>
#include <string>
#include <vector>

namespace chiaro::tools {

struct TaskOutcome {
  bool reused = false;
  double seconds = 0;
  std::string info_json = "{}";   ///< what the task's body said about itself, kept in the marker
};

class TaskLog {
 public:
  /// folder: made if absent.
  explicit TaskLog(std::filesystem::path folder);
  /// Runs `body` unless the marker of `name` holds `key` and all outputs exist. body returns a JSON object about what it did.
  TaskOutcome run(const std::string& name, const std::string& key, const std::vector<std::filesystem::path>& outputs, const std::function<std::string()>& body) const;
  /// What the body of `name` said when it ran last, as JSON; an empty object where there is no marker.
  std::string info(const std::string& name) const;
  /// The task will run again.
  void forget(const std::string& name) const;
  /// True if it would not run.
  bool is_done(const std::string& name, const std::string& key, const std::vector<std::filesystem::path>& outputs) const;

 private:
  std::filesystem::path marker(const std::string& name) const;
  std::filesystem::path folder_;
};

}  // namespace chiaro::tools
