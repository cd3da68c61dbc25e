#include "stream/base/folder_lock.h"

#include <fcntl.h>
#include <sys/file.h>
#include <sys/stat.h>
#include <unistd.h>

#include <cerrno>
#include <chrono>
#include <thread>

#include "stream/base/error.h"

namespace chiaro {

namespace {

int open_folder(const std::filesystem::path& folder) { return ::open(folder.c_str(), O_RDONLY | O_DIRECTORY | O_CLOEXEC); }

/// False only where another has it.
bool try_lock(int fd, int kind) {
  for (;;) {
    if (::flock(fd, kind | LOCK_NB) == 0) return true;
    if (errno != EINTR) return errno != EWOULDBLOCK;
  }
}

/// False where the folder was renamed or removed since it was opened: whoever had it then has published it under another name, and what stands in its place is not ours.
bool is_still(int fd, const std::filesystem::path& folder) {
  struct stat opened {}, now {};
  return ::fstat(fd, &opened) == 0 && ::stat(folder.c_str(), &now) == 0 && opened.st_dev == now.st_dev && opened.st_ino == now.st_ino;
}

}  // namespace

FolderLock::FolderLock(const std::filesystem::path& folder) : fd_(open_folder(folder)) {
  if (fd_ < 0) return;   // whoever writes into it next says what is wrong
  constexpr int kTries = 5;
  constexpr std::chrono::milliseconds kPause(50);   // is_held() of another process holds it for a moment
  for (int i = 0; i < kTries; ++i) {
    if (i > 0) std::this_thread::sleep_for(kPause);
    if (!try_lock(fd_, LOCK_EX)) continue;
    if (is_still(fd_, folder)) return;
    close();
    throw Error(concat(folder.string(), ": another chiaro has just ended its work here; start again"));
  }
  close();
  throw Error(concat(folder.string(), ": another chiaro is at work here; wait until it ends, or choose another --out"));
}

FolderLock::FolderLock(FolderLock&& other) noexcept : fd_(other.fd_) { other.fd_ = -1; }

bool FolderLock::is_held(const std::filesystem::path& folder) {
  const int fd = open_folder(folder);
  if (fd < 0) return false;
  const bool held = !try_lock(fd, LOCK_SH);
  ::close(fd);
  return held;
}

FolderLock::~FolderLock() { close(); }

void FolderLock::close() noexcept {
  if (fd_ >= 0) ::close(fd_);
  fd_ = -1;
}

}  // namespace chiaro
