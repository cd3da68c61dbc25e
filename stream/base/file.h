/// Files that are whole or absent: everything is written to NAME.part, synced and renamed. Plus positioned reads and writes with checked errors.
#pragma once
#include <cstdint>
#include <filesystem>
#include <span>
#include <string>
#include <string_view>
#include <vector>

namespace chiaro {

/// An open file descriptor with positioned I/O. Every call throws Error naming the path, the offset and the system's reason.
class File {
 public:
  enum class Mode { kRead, kReadWrite, kCreate };  ///< kCreate truncates or makes the file, read-write
  File() = default;
  File(const std::filesystem::path& path, Mode mode);
  File(File&& other) noexcept;
  File& operator=(File&& other) noexcept;
  ~File();
  bool is_open() const { return fd_ >= 0; }
  const std::filesystem::path& path() const { return path_; }
  std::uint64_t size() const;
  /// Reads exactly `bytes` bytes. throws Error on a short file ("ends early").
  void read_at(std::uint64_t offset, void* data, std::size_t bytes) const;
  /// Reads up to `bytes` bytes; returns how many (fewer only at the end of the file).
  std::size_t read_some_at(std::uint64_t offset, void* data, std::size_t bytes) const;
  /// Says that these bytes are read soon: the system may fetch them meanwhile, many such places at a time.
  void will_need(std::uint64_t offset, std::uint64_t bytes) const noexcept;
  void write_at(std::uint64_t offset, const void* data, std::size_t bytes);
  /// Reserves disk space so that a full disk is met here and not later. throws Error ("no space").
  void reserve(std::uint64_t bytes);
  void truncate(std::uint64_t bytes);
  void sync();
  void close();  ///< throws if the system reports a late write error
  int descriptor() const { return fd_; }

 private:
  int fd_ = -1;
  std::filesystem::path path_;
};

/// Writes `path` through `path.part`; commit() syncs, renames and syncs the folder. Without commit() the part file is removed.
class AtomicFile {
 public:
  explicit AtomicFile(const std::filesystem::path& path);
  AtomicFile(AtomicFile&&) noexcept = default;
  ~AtomicFile();
  File& file() { return file_; }
  const std::filesystem::path& part_path() const { return part_; }
  /// Appends through a buffer.
  void append(const void* data, std::size_t bytes);
  void append(std::string_view text) { append(text.data(), text.size()); }
  std::uint64_t appended_bytes() const { return flushed_ + buffer_.size(); }
  void flush();
  void commit();

 private:
  std::filesystem::path path_, part_;
  File file_;
  std::vector<char> buffer_;
  std::uint64_t flushed_ = 0;
  bool committed_ = false;
};

/// Path to write to with a library that opens files by name; commit() syncs and renames it. Without commit() it is removed.
/// The part name keeps the extension (libraries choose formats by it): "albedo.exr" is written as ".albedo.part.exr".
class AtomicPath {
 public:
  explicit AtomicPath(const std::filesystem::path& path);
  AtomicPath(const AtomicPath&) = delete;
  AtomicPath& operator=(const AtomicPath&) = delete;
  ~AtomicPath();
  const std::filesystem::path& part() const { return part_; }
  void commit();

 private:
  std::filesystem::path path_, part_;
  bool committed_ = false;
};

/// Whole small file. throws Error if it is missing or larger than max_bytes.
std::string read_text(const std::filesystem::path& path, std::uint64_t max_bytes = 256u << 20);
/// Atomic, synced.
void write_text(const std::filesystem::path& path, std::string_view text);
void sync_folder(const std::filesystem::path& folder);
/// Makes the folder and its parents. throws Error with the system's reason.
void make_folder(const std::filesystem::path& folder);
/// Removes what is in a folder, but not the folder.
void empty_folder(const std::filesystem::path& folder);
/// Bytes free for this user on the disk of `path` (its nearest existing parent).
std::uint64_t free_disk_bytes(const std::filesystem::path& path);
/// Bytes that a file takes on the disk (holes take none); 0 if it is not there.
std::uint64_t allocated_bytes(const std::filesystem::path& path);
/// Publishes a finished folder: syncs `part`, renames it to `path`, syncs the parent. An existing `path` is replaced in one step (in two on file systems that
/// cannot exchange names, such as NFS). throws Error.
void publish_folder(const std::filesystem::path& part, const std::filesystem::path& path);
/// Removes what a publication that was killed has left beside a finished `path`.
void remove_leftovers(const std::filesystem::path& part, const std::filesystem::path& path);
/// A temporary folder, removed with its content when the object goes. For tests and scratch data.
class ScratchFolder {
 public:
  explicit ScratchFolder(const std::filesystem::path& parent = {});
  ScratchFolder(const ScratchFolder&) = delete;
  ScratchFolder& operator=(const ScratchFolder&) = delete;
  ~ScratchFolder();
  const std::filesystem::path& path() const { return path_; }
  /// Removes those that processes that were killed have left in `parent`. Nobody else may be at work there.
  static void remove_left_in(const std::filesystem::path& parent);

 private:
  std::filesystem::path path_;
};

}  // namespace chiaro
