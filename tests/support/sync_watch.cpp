#include "tests/support/sync_watch.h"

#include <dlfcn.h>
#include <sys/stat.h>
#include <unistd.h>

#include <cstdio>
#include <fstream>
#include <map>
#include <mutex>
#include <sstream>

namespace chiaro {
namespace {
namespace fs = std::filesystem;

struct Watched {
  std::mutex mutex;
  bool active = false;
  fs::path folder;
  SyncWatch::OnRename on_rename;
  std::map<ino_t, std::string> synced;   // by file, whatever its name: as it was when it was synced last
};

Watched& watched() {
  static Watched w;
  return w;
}

template <class F>
F* real(const char* name) {
  return reinterpret_cast<F*>(dlsym(RTLD_NEXT, name));
}

std::string content_of(const fs::path& path) {
  std::ifstream in(path, std::ios::binary);
  std::ostringstream bytes;
  bytes << in.rdbuf();
  return bytes.str();
}

bool is_below(const fs::path& path, const fs::path& folder) { return path.string().starts_with(folder.string()); }

void remember(int fd) {
  Watched& w = watched();
  const std::lock_guard lock(w.mutex);
  if (!w.active) return;
  std::error_code code;
  const fs::path path = fs::read_symlink("/proc/self/fd/" + std::to_string(fd), code);
  struct stat info {};
  if (code || !is_below(path, w.folder) || ::fstat(fd, &info) != 0 || !S_ISREG(info.st_mode)) return;
  w.synced[info.st_ino] = content_of(path);
}

void announce(const char* from, const char* to) {
  SyncWatch::OnRename tell;
  {
    const std::lock_guard lock(watched().mutex);
    if (watched().active && is_below(to, watched().folder)) tell = watched().on_rename;
  }
  if (tell) tell(from, to);
}

const std::string* synced_content(const fs::path& file) {
  struct stat info {};
  if (::stat(file.c_str(), &info) != 0) return nullptr;
  const auto found = watched().synced.find(info.st_ino);
  return found == watched().synced.end() ? nullptr : &found->second;
}

}  // namespace

SyncWatch::SyncWatch(fs::path folder, OnRename on_rename) {
  const std::lock_guard lock(watched().mutex);
  watched().active = true;
  watched().folder = std::move(folder);
  watched().on_rename = std::move(on_rename);
  watched().synced.clear();
}

SyncWatch::~SyncWatch() {
  const std::lock_guard lock(watched().mutex);
  watched().active = false;
  watched().on_rename = {};
  watched().synced.clear();
}

bool SyncWatch::is_synced(const fs::path& file) const {
  const std::lock_guard lock(watched().mutex);
  const std::string* synced = synced_content(file);
  return synced && *synced == content_of(file);
}

void SyncWatch::cut_power(const fs::path& file) const {
  constexpr std::size_t kSector = 512;
  const std::lock_guard lock(watched().mutex);
  const std::string* synced = synced_content(file);
  std::string bytes = content_of(file), before = synced ? *synced : std::string();
  before.resize(bytes.size(), '\0');
  for (std::size_t at = kSector; at < bytes.size(); at += 2 * kSector) bytes.replace(at, kSector, before, at, kSector);
  std::ofstream out(file, std::ios::binary | std::ios::in | std::ios::out);
  out.write(bytes.data(), static_cast<std::streamsize>(bytes.size()));
}

}  // namespace chiaro

extern "C" {

int fdatasync(int fd) {
  static auto* const f = chiaro::real<int(int)>("fdatasync");
  const int result = f(fd);
  if (result == 0) chiaro::remember(fd);
  return result;
}

int rename(const char* from, const char* to) noexcept {
  static auto* const f = chiaro::real<int(const char*, const char*)>("rename");
  chiaro::announce(from, to);
  return f(from, to);
}

int renameat2(int from_folder, const char* from, int to_folder, const char* to, unsigned flags) noexcept {
  static auto* const f = chiaro::real<int(int, const char*, int, const char*, unsigned)>("renameat2");
  chiaro::announce(from, to);
  return f(from_folder, from, to_folder, to, flags);
}

}  // extern "C"
