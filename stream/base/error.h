/// Errors of the outside world, and the one way text is put together.
#pragma once
#include <sstream>
#include <stdexcept>
#include <string>

namespace chiaro {

/// Something outside the program is wrong (a file, the disk, a value in a project file). The message names the thing, the
/// position and the numbers: "scan_07.las: 1204 of 9000000 points read, file ends early".
class Error : public std::runtime_error {
 public:
  using std::runtime_error::runtime_error;
};

/// The command line or the project file is wrong: exit code 2 instead of 1.
class UsageError : public Error {
 public:
  using Error::Error;
};

/// The user asked to stop; work done so far is kept. Exit code 130.
class Cancelled : public std::runtime_error {
 public:
  Cancelled() : std::runtime_error("interrupted") {}
};

/// Joins anything that can be streamed into one string.
template <class... Parts>
std::string concat(const Parts&... parts) {
  std::ostringstream out;
  (out << ... << parts);
  return out.str();
}

}  // namespace chiaro
