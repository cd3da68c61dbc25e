/// Loaded before the C library (LD_PRELOAD): counts writes, syncs and renames below a folder, and lets one of them go wrong. For tests; Linux, glibc.
///
///   CHIARO_SHIM_FOLDER   what lies below it counts
///   CHIARO_SHIM_COUNT    file that gets the number of such calls when the program ends
///   CHIARO_SHIM_AT       the call that goes wrong, from 1
///   CHIARO_SHIM_KIND     ENOSPC: it and all later ones that need space are refused
///                        EIO: it is refused, once
///                        tear: half of the bytes are written (other calls are not done), and the process is killed
#include <dlfcn.h>
#include <fcntl.h>
#include <unistd.h>

#include <atomic>
#include <cerrno>
#include <climits>
#include <csignal>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <string>

namespace {

enum class Call { kWrite, kReserve, kSync, kRename };
enum class Fate { kAsUsual, kRefused, kTorn };

template <class F>
F* real(const char* name) {
  return reinterpret_cast<F*>(dlsym(RTLD_NEXT, name));
}

std::string environment(const char* name) {
  const char* value = std::getenv(name);
  return value ? value : "";
}

struct Plan {
  std::string folder = environment("CHIARO_SHIM_FOLDER"), kind = environment("CHIARO_SHIM_KIND");
  long at = std::atol(environment("CHIARO_SHIM_AT").c_str());
  std::atomic<long> calls{0};
  std::atomic<bool> full{false};
  ~Plan() {
    const std::string count = environment("CHIARO_SHIM_COUNT");
    if (count.empty()) return;
    if (FILE* file = std::fopen(count.c_str(), "w")) {
      std::fprintf(file, "%ld\n", calls.load());
      std::fclose(file);
    }
  }
};

Plan& plan() {
  static Plan p;
  return p;
}

bool counts(const char* path) { return !plan().folder.empty() && std::strncmp(path, plan().folder.c_str(), plan().folder.size()) == 0; }

bool counts(int fd) {
  char link[64], path[PATH_MAX + 1];
  std::snprintf(link, sizeof link, "/proc/self/fd/%d", fd);
  const ssize_t n = readlink(link, path, PATH_MAX);
  if (n <= 0) return false;
  path[n] = 0;
  return counts(path);
}

Fate fate(Call call) {
  Plan& p = plan();
  const bool now = ++p.calls == p.at, needs_space = call == Call::kWrite || call == Call::kReserve;
  if (p.kind == "ENOSPC") {
    if (now) p.full = true;
    if (!now && !(p.full && needs_space)) return Fate::kAsUsual;
    errno = ENOSPC;
    return Fate::kRefused;
  }
  if (!now) return Fate::kAsUsual;
  if (p.kind == "tear") return Fate::kTorn;
  errno = EIO;
  return Fate::kRefused;
}

[[noreturn]] void die() {
  kill(getpid(), SIGKILL);
  for (;;) pause();
}

/// what: does the call; half: what a torn one leaves behind.
template <class What, class Half>
auto act(Call call, bool counted, const What& what, const Half& half) -> decltype(what()) {
  if (!counted) return what();
  switch (fate(call)) {
    case Fate::kAsUsual: return what();
    case Fate::kTorn: half(); die();
    case Fate::kRefused: break;
  }
  return static_cast<decltype(what())>(-1);
}

const auto kNothing = [] {};

}  // namespace

extern "C" {

ssize_t write(int fd, const void* data, size_t bytes) {
  static auto* const f = real<ssize_t(int, const void*, size_t)>("write");
  return act(Call::kWrite, counts(fd), [&] { return f(fd, data, bytes); }, [&] { f(fd, data, bytes / 2); });
}

ssize_t pwrite(int fd, const void* data, size_t bytes, off_t offset) {
  static auto* const f = real<ssize_t(int, const void*, size_t, off_t)>("pwrite");
  return act(Call::kWrite, counts(fd), [&] { return f(fd, data, bytes, offset); }, [&] { f(fd, data, bytes / 2, offset); });
}
ssize_t pwrite64(int fd, const void* data, size_t bytes, off64_t offset) { return pwrite(fd, data, bytes, offset); }

int fsync(int fd) {
  static auto* const f = real<int(int)>("fsync");
  return act(Call::kSync, counts(fd), [&] { return f(fd); }, kNothing);
}

int fdatasync(int fd) {
  static auto* const f = real<int(int)>("fdatasync");
  return act(Call::kSync, counts(fd), [&] { return f(fd); }, kNothing);
}

int rename(const char* from, const char* to) noexcept {
  static auto* const f = real<int(const char*, const char*)>("rename");
  return act(Call::kRename, counts(to), [&] { return f(from, to); }, kNothing);
}

int renameat2(int from_folder, const char* from, int to_folder, const char* to, unsigned flags) noexcept {
  static auto* const f = real<int(int, const char*, int, const char*, unsigned)>("renameat2");
  return act(Call::kRename, counts(to), [&] { return f(from_folder, from, to_folder, to, flags); }, kNothing);
}

int ftruncate(int fd, off_t bytes) noexcept {
  static auto* const f = real<int(int, off_t)>("ftruncate");
  return act(Call::kReserve, counts(fd), [&] { return f(fd, bytes); }, kNothing);
}
int ftruncate64(int fd, off64_t bytes) noexcept { return ftruncate(fd, bytes); }

int posix_fallocate(int fd, off_t offset, off_t bytes) {
  static auto* const f = real<int(int, off_t, off_t)>("posix_fallocate");
  const int done = act(Call::kReserve, counts(fd), [&] { return f(fd, offset, bytes); }, kNothing);
  return done < 0 ? errno : done;   // this one gives its error as its result
}
int posix_fallocate64(int fd, off64_t offset, off64_t bytes) { return posix_fallocate(fd, offset, bytes); }

}  // extern "C"
