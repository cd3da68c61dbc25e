/// One process at a time in a folder.
#pragma once
#include <filesystem>

namespace chiaro {

/// Holds an existing folder until the object, or the process, is gone; leaves nothing on the disk.
///
/// throws   Error if, for a fifth of a second, another process (or another such object) holds it, or moved or removed it before it let go. Where the file system knows no locks the folder is taken as free.
class FolderLock {
 public:
  explicit FolderLock(const std::filesystem::path& folder);
  FolderLock(FolderLock&& other) noexcept;
  FolderLock& operator=(FolderLock&&) = delete;
  ~FolderLock();
  /// Whether somebody has it now; false where that cannot be found out.
  static bool is_held(const std::filesystem::path& folder);

 private:
  void close() noexcept;
  int fd_ = -1;
};

}  // namespace chiaro
