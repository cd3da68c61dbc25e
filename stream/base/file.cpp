#include "stream/base/file.h"

#include <fcntl.h>
#include <sys/stat.h>
#include <sys/statvfs.h>
#include <unistd.h>

#include <cerrno>
#include <cstring>
#include <vector>

#include "stream/base/error.h"

namespace chiaro {
namespace fs = std::filesystem;
namespace {

[[noreturn]] void fail(const fs::path& path, const std::string& what, int code) {
  throw Error(concat(path.string(), ": ", what, ": ", code == ENOSPC ? "no space left on the disk" : std::strerror(code)));
}

}  // namespace

File::File(const fs::path& path, Mode mode) : path_(path) {
  const int flags = mode == Mode::kRead ? O_RDONLY : mode == Mode::kReadWrite ? O_RDWR : O_RDWR | O_CREAT | O_TRUNC;
  fd_ = ::open(path.c_str(), flags | O_CLOEXEC, 0644);
  if (fd_ < 0) fail(path, mode == Mode::kCreate ? "cannot be created" : "cannot be opened", errno);
  struct stat info {};
  if (::fstat(fd_, &info) == 0 && S_ISDIR(info.st_mode)) {
    ::close(fd_);
    fd_ = -1;
    throw Error(concat(path.string(), ": is a folder, expected a file"));
  }
}

File::File(File&& other) noexcept : fd_(other.fd_), path_(std::move(other.path_)) { other.fd_ = -1; }

File& File::operator=(File&& other) noexcept {
  if (this != &other) {
    if (fd_ >= 0) ::close(fd_);
    fd_ = other.fd_;
    path_ = std::move(other.path_);
    other.fd_ = -1;
  }
  return *this;
}

File::~File() {
  if (fd_ >= 0) ::close(fd_);
}

std::uint64_t File::size() const {
  struct stat info {};
  if (::fstat(fd_, &info) != 0) fail(path_, "size unknown", errno);
  return static_cast<std::uint64_t>(info.st_size);
}

std::size_t File::read_some_at(std::uint64_t offset, void* data, std::size_t bytes) const {
  std::size_t done = 0;
  while (done < bytes) {
    const ssize_t n = ::pread(fd_, static_cast<char*>(data) + done, bytes - done, static_cast<off_t>(offset + done));
    if (n < 0 && errno == EINTR) continue;
    if (n < 0) fail(path_, concat("cannot read ", bytes, " bytes at ", offset), errno);
    if (n == 0) break;
    done += static_cast<std::size_t>(n);
  }
  return done;
}

void File::read_at(std::uint64_t offset, void* data, std::size_t bytes) const {
  const std::size_t n = read_some_at(offset, data, bytes);
  if (n != bytes) throw Error(concat(path_.string(), ": file ends early: ", n, " of ", bytes, " bytes at offset ", offset));
}

void File::write_at(std::uint64_t offset, const void* data, std::size_t bytes) {
  std::size_t done = 0;
  while (done < bytes) {
    const ssize_t n = ::pwrite(fd_, static_cast<const char*>(data) + done, bytes - done, static_cast<off_t>(offset + done));
    if (n < 0 && errno == EINTR) continue;
    if (n < 0) fail(path_, concat("cannot write ", bytes, " bytes at ", offset), errno);
    done += static_cast<std::size_t>(n);
  }
}

void File::will_need(std::uint64_t offset, std::uint64_t bytes) const noexcept {
  (void)::posix_fadvise(fd_, static_cast<off_t>(offset), static_cast<off_t>(bytes), POSIX_FADV_WILLNEED);   // a hint: where it is not taken nothing is lost
}

void File::reserve(std::uint64_t bytes) {
  if (bytes == 0) return;
  const int code = ::posix_fallocate(fd_, 0, static_cast<off_t>(bytes));
  if (code != 0 && code != EOPNOTSUPP && code != EINVAL) fail(path_, concat("cannot reserve ", bytes, " bytes"), code);
}

void File::truncate(std::uint64_t bytes) {
  if (::ftruncate(fd_, static_cast<off_t>(bytes)) != 0) fail(path_, concat("cannot set the size to ", bytes, " bytes"), errno);
}

void File::sync() {
  if (::fdatasync(fd_) != 0) fail(path_, "cannot be synced to disk", errno);
}

void File::close() {
  if (fd_ < 0) return;
  const int fd = fd_;
  fd_ = -1;
  if (::close(fd) != 0) fail(path_, "cannot be closed", errno);
}

AtomicFile::AtomicFile(const fs::path& path) : path_(path), part_(path.string() + ".part"), file_(part_, File::Mode::kCreate) {}

AtomicFile::~AtomicFile() {
  if (!committed_ && file_.is_open()) ::unlink(part_.c_str());
}

void AtomicFile::append(const void* data, std::size_t bytes) {
  constexpr std::size_t kBuffer = 1 << 20;
  const char* p = static_cast<const char*>(data);
  if (bytes >= kBuffer) {
    flush();
    file_.write_at(flushed_, p, bytes);
    flushed_ += bytes;
    return;
  }
  buffer_.insert(buffer_.end(), p, p + bytes);
  if (buffer_.size() >= kBuffer) flush();
}

void AtomicFile::flush() {
  if (buffer_.empty()) return;
  file_.write_at(flushed_, buffer_.data(), buffer_.size());
  flushed_ += buffer_.size();
  buffer_.clear();
}

void AtomicFile::commit() {
  flush();
  file_.sync();
  file_.close();
  if (::rename(part_.c_str(), path_.c_str()) != 0) fail(path_, "cannot be renamed into place", errno);
  committed_ = true;
  sync_folder(path_.parent_path());
}

AtomicPath::AtomicPath(const fs::path& path)
    : path_(path), part_(path.parent_path() / concat(".", path.stem().string(), ".part", path.extension().string())) {}

AtomicPath::~AtomicPath() {
  if (!committed_) ::unlink(part_.c_str());
}

void AtomicPath::commit() {
  File file(part_, File::Mode::kReadWrite);
  file.sync();
  file.close();
  if (::rename(part_.c_str(), path_.c_str()) != 0) fail(path_, "cannot be renamed into place", errno);
  committed_ = true;
  sync_folder(path_.parent_path());
}

std::string read_text(const fs::path& path, std::uint64_t max_bytes) {
  const File file(path, File::Mode::kRead);
  const std::uint64_t size = file.size();
  if (size > max_bytes) throw Error(concat(path.string(), ": ", size, " bytes, expected at most ", max_bytes));
  std::string text(size, '\0');
  file.read_at(0, text.data(), size);
  return text;
}

void write_text(const fs::path& path, std::string_view text) {
  AtomicFile file(path);
  file.append(text);
  file.commit();
}

void sync_folder(const fs::path& folder) {
  const int fd = ::open(folder.empty() ? "." : folder.c_str(), O_RDONLY | O_DIRECTORY | O_CLOEXEC);
  if (fd < 0) return;
  const int code = ::fsync(fd) == 0 ? 0 : errno;
  ::close(fd);
  if (code != 0 && code != EINVAL && code != EROFS && code != ENOTSUP) fail(folder, "cannot be synced to disk", code);  // these: not on this file system
}

void make_folder(const fs::path& folder) {
  std::error_code code;
  fs::create_directories(folder, code);
  if (code) throw Error(concat(folder.string(), ": folder cannot be made: ", code.message()));
}

void empty_folder(const fs::path& folder) {
  std::error_code code;
  for (const fs::directory_entry& entry : fs::directory_iterator(folder, code)) fs::remove_all(entry.path(), code);
}

std::uint64_t free_disk_bytes(const fs::path& path) {
  fs::path at = fs::absolute(path);
  std::error_code code;
  while (!fs::exists(at, code) && at.has_parent_path() && at != at.parent_path()) at = at.parent_path();
  struct statvfs info {};
  if (::statvfs(at.c_str(), &info) != 0) fail(at, "free space unknown", errno);
  return static_cast<std::uint64_t>(info.f_bavail) * info.f_frsize;
}

std::uint64_t allocated_bytes(const fs::path& path) {
  struct stat info {};
  return ::stat(path.c_str(), &info) == 0 ? static_cast<std::uint64_t>(info.st_blocks) * 512 : 0;
}

namespace {

fs::path old_path(const fs::path& path) { return path.string() + ".old"; }

void move_aside_and_rename(const fs::path& part, const fs::path& path) {
  if (::rename(path.c_str(), old_path(path).c_str()) != 0) fail(path, "cannot be moved aside", errno);
  if (::rename(part.c_str(), path.c_str()) == 0) return;
  const int reason = errno;
  ::rename(old_path(path).c_str(), path.c_str());
  fail(path, "cannot be renamed into place", reason);
}

}  // namespace

void publish_folder(const fs::path& part, const fs::path& path) {
  sync_folder(part);
  std::error_code code;
  fs::remove_all(old_path(path), code);
  if (!fs::exists(path)) {
    if (::rename(part.c_str(), path.c_str()) != 0) fail(path, "cannot be renamed into place", errno);
    return sync_folder(path.parent_path());
  }
  // Both change places in one step, where the file system can do that, so that there is one at any moment.
  if (::renameat2(AT_FDCWD, part.c_str(), AT_FDCWD, path.c_str(), RENAME_EXCHANGE) != 0) {
    if (errno != EINVAL && errno != ENOSYS && errno != ENOTSUP) fail(path, "cannot be renamed into place", errno);
    move_aside_and_rename(part, path);
  }
  sync_folder(path.parent_path());
  remove_leftovers(part, path);   // the older one is there now
}

void remove_leftovers(const fs::path& part, const fs::path& path) {
  std::error_code code;
  fs::remove_all(part, code);
  fs::remove_all(old_path(path), code);
}

constexpr const char* kScratchPrefix = "chiaro-";

ScratchFolder::ScratchFolder(const fs::path& parent) {
  const fs::path base = parent.empty() ? fs::temp_directory_path() : parent;
  std::string name = (base / concat(kScratchPrefix, "XXXXXX")).string();
  if (!::mkdtemp(name.data())) fail(name, "scratch folder cannot be made", errno);
  path_ = name;
}

ScratchFolder::~ScratchFolder() {
  std::error_code code;
  fs::remove_all(path_, code);
}

void ScratchFolder::remove_left_in(const fs::path& parent) {
  std::vector<fs::path> left;
  std::error_code code;
  for (fs::directory_iterator it(parent, code), end; !code && it != end; it.increment(code))
    if (it->path().filename().string().starts_with(kScratchPrefix)) left.push_back(it->path());
  for (const fs::path& folder : left) fs::remove_all(folder, code);
}

}  // namespace chiaro
