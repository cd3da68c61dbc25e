#include "tools/task_log.h"

#include <algorithm>
#include <chrono>
#include <nlohmann/json.hpp>

#include "stream/base/error.h"
#include "stream/base/file.h"
#include "stream/base/hash.h"

namespace chiaro::tools {
using Json = nlohmann::ordered_json;

TaskLog::TaskLog(std::filesystem::path folder) : folder_(std::move(folder)) { make_folder(folder_); }

std::filesystem::path TaskLog::marker(const std::string& name) const {
  std::string file = name;
  std::replace(file.begin(), file.end(), '/', '.');
  return folder_ / (file + ".json");
}

namespace {
/// Of the marker without its member "check": later tasks compute with the numbers in "info", so a flipped digit must not pass.
std::string check_of(const Json& marker) { return Hasher().add(marker.dump(-1, ' ', false, Json::error_handler_t::replace)).hex(); }

/// The marker's content, or null where there is none or it is damaged (then the task simply runs again).
Json read_marker(const std::filesystem::path& path) {
  std::error_code code;
  if (!std::filesystem::exists(path, code)) return nullptr;
  Json marker = Json::parse(read_text(path), nullptr, false);
  if (!marker.is_object() || !marker.contains("check")) return nullptr;
  const Json check = marker["check"];
  marker.erase("check");
  return check == check_of(marker) ? marker : Json(nullptr);
}
/// Sizes of the outputs: null for a folder or what is not there. A result that was cut short or replaced since is no result.
Json sizes_of(const std::vector<std::filesystem::path>& outputs) {
  Json sizes = Json::array();
  for (const std::filesystem::path& p : outputs) {
    std::error_code code;
    const bool is_file = std::filesystem::is_regular_file(p, code);
    const auto bytes = is_file ? std::filesystem::file_size(p, code) : 0;
    sizes.push_back(is_file && !code ? Json(bytes) : Json(nullptr));
  }
  return sizes;
}
bool matches(const Json& marker, const std::string& key, const std::vector<std::filesystem::path>& outputs) {
  if (!marker.is_object() || !marker.contains("key") || marker["key"] != key || !marker.contains("output_bytes")) return false;
  return std::all_of(outputs.begin(), outputs.end(), [](const std::filesystem::path& p) { return std::filesystem::exists(p); }) && marker["output_bytes"] == sizes_of(outputs);
}
}  // namespace

std::string TaskLog::info(const std::string& name) const {
  const Json found = read_marker(marker(name));
  return found.is_object() && found.contains("info") ? found["info"].dump() : "{}";
}

void TaskLog::forget(const std::string& name) const {
  std::error_code code;
  std::filesystem::remove(marker(name), code);
}

bool TaskLog::is_done(const std::string& name, const std::string& key, const std::vector<std::filesystem::path>& outputs) const {
  return matches(read_marker(marker(name)), key, outputs);
}

TaskOutcome TaskLog::run(const std::string& name, const std::string& key, const std::vector<std::filesystem::path>& outputs,
                         const std::function<std::string()>& body) const {
  TaskOutcome outcome;
  const Json found = read_marker(marker(name));
  if (matches(found, key, outputs)) {
    outcome.reused = true;
    outcome.seconds = found.value("seconds", 0.0);
    if (found.contains("info")) outcome.info_json = found["info"].dump();
    return outcome;
  }
  std::error_code code;
  std::filesystem::remove(marker(name), code);   // before the outputs change: a marker never speaks of what is half replaced
  for (const auto& output : outputs)
    if (output.has_parent_path()) make_folder(output.parent_path());
  const auto start = std::chrono::steady_clock::now();
  outcome.info_json = body();
  outcome.seconds = std::chrono::duration<double>(std::chrono::steady_clock::now() - start).count();
  Json out{{"task", name}, {"key", key}, {"seconds", outcome.seconds}, {"output_bytes", sizes_of(outputs)}, {"info", Json::parse(outcome.info_json)}};
  out["check"] = check_of(out);
  write_text(marker(name), out.dump(1) + "\n");
  return outcome;
}

}  // namespace chiaro::tools
