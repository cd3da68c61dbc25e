/// What a power cut would leave of files: which of their bytes are known to be on the disk. For tests, which link it instead of the C library's own calls.
#pragma once
#include <filesystem>
#include <functional>
#include <string>

namespace chiaro {

/// While one of these lives, the content of each file below `folder` is remembered whenever it is synced.
class SyncWatch {
 public:
  /// on_rename: called before a file or folder below `folder` takes its final name.
  using OnRename = std::function<void(const std::filesystem::path& from, const std::filesystem::path& to)>;
  explicit SyncWatch(std::filesystem::path folder, OnRename on_rename = {});
  SyncWatch(const SyncWatch&) = delete;
  SyncWatch& operator=(const SyncWatch&) = delete;
  ~SyncWatch();
  /// Is the file on the disk as it is now?
  bool is_synced(const std::filesystem::path& file) const;
  /// Damages a file as a power cut may: of what was not synced, every other sector is as it was at the last sync. The first of each page is new.
  void cut_power(const std::filesystem::path& file) const;
};

}  // namespace chiaro
