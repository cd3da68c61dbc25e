/// Runs a program as a user would, and says how it ended, what it wrote and how much memory it took. Linux.
#pragma once
#include <chrono>
#include <csignal>
#include <cstdint>
#include <filesystem>
#include <functional>
#include <string>
#include <vector>

namespace chiaro::test {

struct ProcessOptions {
  std::filesystem::path folder;              ///< where it runs; empty = here
  double signal_after_s = -1;                ///< >= 0: send `signal` then
  int signal = SIGKILL;
  std::function<bool()> signal_when;         ///< asked about every millisecond; send `signal` as soon as it says so
  std::uint64_t max_file_bytes = 0;          ///< RLIMIT_FSIZE; 0 = none
  std::uint64_t max_address_bytes = 0;       ///< RLIMIT_AS; 0 = none
  double limit_s = 300;                      ///< killed beyond that, and `hung` set
  std::vector<std::string> environment;      ///< NAME=value, added to ours
};

struct ProcessResult {
  int code = -1;                             ///< exit code; 128 + signal where a signal ended it, as a shell says it
  bool signalled = false;
  bool hung = false;
  std::string out, err;
  std::uint64_t peak_bytes = 0;              ///< largest resident set, as the kernel counted it
  double seconds = 0;
};

/// words[0] is the program. Output is taken through files, so a killed child loses nothing.
ProcessResult run_process(const std::vector<std::string>& words, const ProcessOptions& options = {});

}  // namespace chiaro::test
