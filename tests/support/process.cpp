#include "tests/support/process.h"

#include <fcntl.h>
#include <sys/resource.h>
#include <sys/wait.h>
#include <unistd.h>

#include <cstdlib>
#include <fstream>
#include <sstream>
#include <stdexcept>
#include <thread>

#include "stream/base/file.h"

namespace chiaro::test {
namespace {

namespace fs = std::filesystem;
using Clock = std::chrono::steady_clock;

std::string slurp(const fs::path& path) {
  std::ifstream in(path, std::ios::binary);
  std::ostringstream text;
  text << in.rdbuf();
  return text.str();
}

void limit(int what, std::uint64_t bytes) {
  if (bytes == 0) return;
  const rlimit value{bytes, bytes};
  setrlimit(static_cast<__rlimit_resource_t>(what), &value);
}

[[noreturn]] void become(const std::vector<std::string>& words, const ProcessOptions& o, const fs::path& out, const fs::path& err) {
  const int in_fd = open("/dev/null", O_RDONLY), out_fd = open(out.c_str(), O_WRONLY | O_CREAT | O_TRUNC, 0644), err_fd = open(err.c_str(), O_WRONLY | O_CREAT | O_TRUNC, 0644);
  dup2(in_fd, 0);
  dup2(out_fd, 1);
  dup2(err_fd, 2);
  if (!o.folder.empty() && chdir(o.folder.c_str()) != 0) _exit(126);
  for (const std::string& e : o.environment) putenv(const_cast<char*>(e.c_str()));
  std::signal(SIGHUP, SIG_DFL);   // whatever these tests run under
  limit(RLIMIT_FSIZE, o.max_file_bytes);
  limit(RLIMIT_AS, o.max_address_bytes);
  std::vector<char*> argv;
  for (const std::string& w : words) argv.push_back(const_cast<char*>(w.c_str()));
  argv.push_back(nullptr);
  execv(argv[0], argv.data());
  _exit(127);
}

}  // namespace

ProcessResult run_process(const std::vector<std::string>& words, const ProcessOptions& options) {
  const ScratchFolder scratch;
  const fs::path out = scratch.path() / "out.txt", err = scratch.path() / "err.txt";
  const auto start = Clock::now();
  const auto elapsed = [&] { return std::chrono::duration<double>(Clock::now() - start).count(); };
  const pid_t child = fork();
  if (child < 0) throw std::runtime_error("fork failed");
  if (child == 0) become(words, options, out, err);
  ProcessResult result;
  int status = 0;
  rusage usage{};
  bool sent = false;
  while (true) {
    const pid_t done = wait4(child, &status, WNOHANG, &usage);
    if (done == child) break;
    if (done < 0) throw std::runtime_error("wait4 failed");
    const bool due = (options.signal_after_s >= 0 && elapsed() >= options.signal_after_s) || (options.signal_when && options.signal_when());
    if (!sent && due) {
      kill(child, options.signal);
      sent = true;
    }
    if (elapsed() > options.limit_s && !result.hung) {
      kill(child, SIGKILL);
      result.hung = true;
    }
    std::this_thread::sleep_for(std::chrono::milliseconds(1));
  }
  result.seconds = elapsed();
  result.signalled = WIFSIGNALED(status);
  result.code = result.signalled ? 128 + WTERMSIG(status) : WEXITSTATUS(status);
  result.out = slurp(out);
  result.err = slurp(err);
  result.peak_bytes = static_cast<std::uint64_t>(usage.ru_maxrss) * 1024;
  return result;
}

}  // namespace chiaro::test
