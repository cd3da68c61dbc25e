/// What a command is, and what it talks through.
#pragma once
#include <iosfwd>
#include <memory>
#include <span>
#include <string>

#include "stream/base/report.h"

namespace chiaro::tools {

/// Of the contract, for the exception that is being handled: 2 for wrong usage, 130 for an interruption, 1 for all else.
int exit_code_of_exception();

/// The two streams of a command and how it reports. Results go to out(), talk to err().
///
/// Commands add `--json` and `--quiet` through Args::common(); the reporter is made at its first use and follows them.
class Console {
 public:
  /// Streams outlive the console. is_terminal: err is a terminal that is `columns` wide.
  Console(std::ostream& out, std::ostream& err, bool is_terminal = false, int columns = 80);
  ~Console();
  Console(const Console&) = delete;
  Console& operator=(const Console&) = delete;

  std::ostream& out() { return out_; }
  std::ostream& err() { return err_; }
  bool json = false;   ///< results and progress as JSON, one event per line
  bool quiet = false;  ///< no progress; notes, results and errors only

  Reporter& report();
  /// Ends the live line, so that results can be printed.
  void clear_line();
  /// With --json: {"event":"result", …members of the object…} as one line on out(). json_object: text of a JSON object. throws std::invalid_argument if it is none.
  void result(const std::string& json_object);

 private:
  std::ostream& out_;
  std::ostream& err_;
  bool is_terminal_;
  int columns_;
  std::unique_ptr<Reporter> report_;
};

/// run() gets the words after the command's name and returns the exit code (0, or 3: finished but something had to be left out). Failures
/// are exceptions: UsageError gives exit code 2, Cancelled 130, everything else 1.
struct Command {
  const char* name;
  const char* summary;  ///< one line for `chiaro --help`
  int (*run)(std::span<const std::string> args, Console&);
};

/// The executable without its process: finds the command, runs it, turns exceptions into `error: …` and an exit code.
/// args: without the program's name. `--help`, `help [COMMAND]` and `--version` are answered here.
int run_app(std::span<const std::string> args, std::span<const Command> commands, Console& console);

/// "0.1.0"
std::string version();

}  // namespace chiaro::tools
