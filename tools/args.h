/// The options of one command: declared once, with default and unit, parsed and explained by the same declaration.
#pragma once
#include <cstdint>
#include <memory>
#include <span>
#include <string>
#include <vector>

#include "tools/command.h"

namespace chiaro::tools {

/// Each call binds a variable; its present value is the default that --help shows. Variables must outlive parse().
///
///   Args args("info", "Describes a store.");
///   args.positional("STORE", path, "folder NAME.chiaro");
///   args.common(console);
///   if (!args.parse(words, console)) return 0;   // --help was printed
class Args {
 public:
  Args(const std::string& command, const std::string& description);
  ~Args();
  Args(const Args&) = delete;
  Args& operator=(const Args&) = delete;

  /// A word that must be there.
  void positional(const std::string& name, std::string& value, const std::string& help);
  /// One or more words.
  void positionals(const std::string& name, std::vector<std::string>& values, const std::string& help);

  /// flags: "--out" or "-o,--out". unit: what the value is, as --help shows it: "DIR", "SECONDS".
  void option(const std::string& flags, std::string& value, const std::string& help, const std::string& unit);
  void option(const std::string& flags, double& value, const std::string& help, const std::string& unit, double min, double max);
  void option(const std::string& flags, int& value, const std::string& help, const std::string& unit, int min, int max);
  void option(const std::string& flags, std::uint64_t& value, const std::string& help, const std::string& unit);
  /// May be given several times.
  void list(const std::string& flags, std::vector<std::string>& values, const std::string& help, const std::string& unit);
  void flag(const std::string& flags, bool& value, const std::string& help);
  /// One of `choices`; another word gets the nearest one suggested.
  void choice(const std::string& flags, std::string& value, const std::vector<std::string>& choices, const std::string& help);
  /// A memory size such as 512MiB or "2 GiB", to bytes.
  void bytes(const std::string& flags, std::uint64_t& value, const std::string& help);
  /// Makes an option necessary.
  void require(const std::string& flag);

  /// --json and --quiet.
  void common(Console& console);
  /// --memory and --threads with their usual meaning. 0 threads = all cores.
  void resources(std::uint64_t& memory_bytes, int& threads);

  /// False if --help was asked for and printed. throws UsageError, with the nearest known option where one was mistyped.
  bool parse(std::span<const std::string> words, Console& console);
  /// How often an option was given, after parse().
  std::size_t count(const std::string& flag) const;

 private:
  struct Impl;
  std::unique_ptr<Impl> impl_;
};

}  // namespace chiaro::tools
