/// How far the run in a folder has come: for `chiaro status`, which cannot know which results of earlier runs still hold.
#pragma once
#include <filesystem>
#include <fstream>
#include <optional>
#include <set>
#include <string>

namespace chiaro::tools {

/// A line for each task as it begins and ends, in a file that each run begins anew. Neither synced nor checked: nothing is computed from it.
class ProgressLog {
 public:
  explicit ProgressLog(const std::filesystem::path& file);
  void begun(const std::string& task);
  void done(const std::string& task);   ///< made now, or found done before and still right

 private:
  std::ofstream file_;
};

struct Progress {
  std::set<std::string> done;
  std::string begun;            ///< the task that the run is at, or was at when it stopped; empty: none
};

/// nullopt: there is no such file (a folder of an older version).
std::optional<Progress> read_progress(const std::filesystem::path& file);

}  // namespace chiaro::tools
