#include "tools/run_record.h"

#include <chrono>
#include <ctime>
#include <nlohmann/json.hpp>
#include <stdexcept>
#include <system_error>

#include "stream/base/budget.h"
#include "stream/base/file.h"
#include "tools/command.h"

namespace chiaro::tools {
namespace {
using Json = nlohmann::ordered_json;

double steady_seconds() { return std::chrono::duration<double>(std::chrono::steady_clock::now().time_since_epoch()).count(); }

/// "2025-03-14T15:09:26Z"
std::string utc_now() {
  const std::time_t now = std::chrono::system_clock::to_time_t(std::chrono::system_clock::now());
  std::tm parts = {};
  gmtime_r(&now, &parts);
  char text[32];
  std::strftime(text, sizeof text, "%Y-%m-%dT%H:%M:%SZ", &parts);
  return text;
}

std::string compiler() {
#if defined(__clang__)
  return std::string("clang ") + __clang_version__;
#elif defined(__GNUC__)
  return std::string("gcc ") + __VERSION__;
#else
  return "unknown";
#endif
}
}  // namespace

struct RunRecord::Impl {
  Json command, options = Json::object(), project, seed, threads, memory_limit, inputs = Json::array(), stages = Json::array(), counts = Json::object(),
                left_out = Json::array(), notes = Json::array(), more = Json::object();
  std::string started = utc_now();
  double start_s = steady_seconds();
};

RunRecord::RunRecord(std::string_view command, std::span<const std::string> args) : impl_(std::make_unique<Impl>()) {
  impl_->command = {{"name", command}, {"args", Json::array()}};
  for (const std::string& arg : args) impl_->command["args"].push_back(arg);
}
RunRecord::~RunRecord() = default;
RunRecord::RunRecord(RunRecord&&) noexcept = default;

void RunRecord::option(std::string_view name, std::string_view value) { impl_->options[std::string(name)] = value; }
void RunRecord::option(std::string_view name, double value) { impl_->options[std::string(name)] = value; }
void RunRecord::option(std::string_view name, std::uint64_t value) { impl_->options[std::string(name)] = value; }
void RunRecord::option(std::string_view name, bool value) { impl_->options[std::string(name)] = value; }

void RunRecord::project(const std::string& project_json) {
  impl_->project = Json::parse(project_json, nullptr, false);
  if (impl_->project.is_discarded()) throw std::invalid_argument("RunRecord::project: not JSON");
}
void RunRecord::seed(std::uint64_t value) { impl_->seed = value; }
void RunRecord::threads(int value) { impl_->threads = value; }
void RunRecord::memory_limit(std::uint64_t bytes) { impl_->memory_limit = bytes; }

void RunRecord::input(const std::filesystem::path& file, std::string_view fingerprint) {
  std::error_code code;
  const auto bytes = std::filesystem::file_size(file, code);
  impl_->inputs.push_back({{"file", file.string()}, {"bytes", code ? Json(nullptr) : Json(bytes)}, {"hash", fingerprint}});
}

void RunRecord::stage(std::string_view name, double seconds, bool reused) {
  impl_->stages.push_back({{"name", name}, {"seconds", seconds}, {"reused", reused}});
}

void RunRecord::count(std::string_view name, std::uint64_t amount) {
  Json& value = impl_->counts[std::string(name)];
  value = (value.is_null() ? 0 : value.get<std::uint64_t>()) + amount;
}

void RunRecord::left_out(std::string_view kind, std::string_view name, std::string_view reason, std::uint64_t amount) {
  impl_->left_out.push_back({{"kind", kind}, {"name", name}, {"reason", reason}, {"amount", amount}});
}
bool RunRecord::was_partial() const { return !impl_->left_out.empty(); }
void RunRecord::note(std::string_view text) { impl_->notes.push_back(text); }

void RunRecord::set(std::string_view name, const std::string& json_text) {
  Json value = Json::parse(json_text, nullptr, false);
  if (value.is_discarded()) throw std::invalid_argument("RunRecord::set: not JSON");
  impl_->more[std::string(name)] = std::move(value);
}

std::string RunRecord::json(int exit_code) const {
  Json out;
  out["command"] = impl_->command;
  out["version"] = version();
  out["compiler"] = compiler();
  out["started"] = impl_->started;
  out["finished"] = exit_code < 0 ? Json(nullptr) : Json(utc_now());
  out["seconds"] = steady_seconds() - impl_->start_s;
  out["exit"] = exit_code < 0 ? Json(nullptr) : Json(exit_code);
  out["options"] = impl_->options;
  out["project"] = impl_->project;
  out["seed"] = impl_->seed;
  out["threads"] = impl_->threads;
  out["memory"] = {{"limit_bytes", impl_->memory_limit}, {"peak_bytes", peak_resident_bytes()}};
  out["inputs"] = impl_->inputs;
  out["stages"] = impl_->stages;
  out["counts"] = impl_->counts;
  out["left_out"] = impl_->left_out;
  out["notes"] = impl_->notes;
  for (const auto& [name, value] : impl_->more.items()) out[name] = value;
  return out.dump(2, ' ', false, Json::error_handler_t::replace) + "\n";
}

void RunRecord::write(const std::filesystem::path& file, int exit_code) const { write_text(file, json(exit_code)); }

StageTimer::StageTimer(RunRecord& record, std::string name) : record_(record), name_(std::move(name)), start_s_(steady_seconds()) {}
double StageTimer::seconds() const { return steady_seconds() - start_s_; }
void StageTimer::done(bool reused) { record_.stage(name_, seconds(), reused); }

}  // namespace chiaro::tools
