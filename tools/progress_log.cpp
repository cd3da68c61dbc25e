#include "tools/progress_log.h"

#include <algorithm>

namespace chiaro::tools {
namespace {
constexpr char kBegun = '+', kDone = '=';
}

ProgressLog::ProgressLog(const std::filesystem::path& file) : file_(file, std::ios::trunc) {}

void ProgressLog::begun(const std::string& task) { file_ << kBegun << task << std::endl; }
void ProgressLog::done(const std::string& task) { file_ << kDone << task << std::endl; }

std::optional<Progress> read_progress(const std::filesystem::path& file) {
  std::ifstream in(file);
  if (!in) return std::nullopt;
  Progress progress;
  for (std::string line; std::getline(in, line);) {
    const std::string task = line.substr(std::min<std::size_t>(1, line.size()));
    if (line.starts_with(kBegun)) progress.begun = task;
    if (!line.starts_with(kDone)) continue;
    progress.done.insert(task);
    if (progress.begun == task) progress.begun.clear();
  }
  return progress;
}

}  // namespace chiaro::tools
