/// run.json: what ran, on what, with which options and seed, how long each stage took, and what was left out.
#pragma once
#include <cstdint>
#include <filesystem>
#include <memory>
#include <span>
#include <string>
#include <string_view>

namespace chiaro::tools {

/// Collects the record of one run. Members appear in run.json in a fixed order: command, version, compiler, started, finished, seconds, exit,
/// options, project, seed, threads, memory (limit and peak), inputs, stages, counts, left_out, notes, and what set() added. Not thread-safe.
class RunRecord {
 public:
  /// args: the command line after the program's name.
  RunRecord(std::string_view command, std::span<const std::string> args);
  ~RunRecord();
  RunRecord(RunRecord&&) noexcept;

  void option(std::string_view name, std::string_view value);
  void option(std::string_view name, const char* value) { option(name, std::string_view(value)); }
  void option(std::string_view name, double value);
  void option(std::string_view name, std::uint64_t value);
  void option(std::string_view name, int value) { option(name, static_cast<double>(value)); }
  void option(std::string_view name, bool value);
  /// project_json: to_json(Project).
  void project(const std::string& project_json);
  void seed(std::uint64_t value);
  void threads(int value);
  void memory_limit(std::uint64_t bytes);

  /// An input and its key, see file_fingerprint(); size taken from the disk.
  void input(const std::filesystem::path& file, std::string_view fingerprint);
  /// A finished stage. reused: its result was already there from an earlier run.
  void stage(std::string_view name, double seconds, bool reused = false);
  /// Adds to a count such as "points_in", "photographs_used".
  void count(std::string_view name, std::uint64_t amount = 1);
  /// Something left out: kind "photograph", name "photo_07", reason "no camera". Makes was_partial() true (exit code 3).
  void left_out(std::string_view kind, std::string_view name, std::string_view reason, std::uint64_t amount = 1);
  bool was_partial() const;
  void note(std::string_view text);
  /// Any further member from JSON text. throws std::invalid_argument if it is none.
  void set(std::string_view name, const std::string& json_text);

  /// The record as it stands; peak memory and seconds are of this moment. exit_code < 0: still running.
  std::string json(int exit_code = -1) const;
  /// Atomic; see write_text().
  void write(const std::filesystem::path& file, int exit_code = -1) const;

 private:
  struct Impl;
  std::unique_ptr<Impl> impl_;
};

/// Measures a stage: from its making to done(), which enters it in the record. Without done() nothing is entered (the stage failed).
class StageTimer {
 public:
  StageTimer(RunRecord& record, std::string name);
  void done(bool reused = false);
  double seconds() const;

 private:
  RunRecord& record_;
  std::string name_;
  double start_s_;
};

}  // namespace chiaro::tools
