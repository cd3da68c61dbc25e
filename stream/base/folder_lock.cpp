#include "stream/base/folder_lock.h"

#include <fcntl.h>
#include <sys/file.h>
#include <unistd.h>

#include <cerrno>

#include "stream/base/error.h"

namespace chiaro {

FolderLock::FolderLock(const std::filesystem::path& folder) {
  fd_ = ::open(folder.c_str(), O_RDONLY | O_DIRECTORY | O_CLOEXEC);
  if (fd_ < 0) return;   // whoever writes into it next says what is wrong
  int code = 0;
  do code = ::flock(fd_, LOCK_EX | LOCK_NB) == 0 ? 0 : errno;
  while (code == EINTR);
  if (code != EWOULDBLOCK) return;   // held, or there are no locks here
  ::close(fd_);
  fd_ = -1;
  throw Error(concat(folder.string(), ": another chiaro is at work here; wait until it ends, or choose another --out"));
}

FolderLock::FolderLock(FolderLock&& other) noexcept : fd_(other.fd_) { other.fd_ = -1; }

FolderLock::~FolderLock() {
  if (fd_ >= 0) ::close(fd_);
}

}  // namespace chiaro
