/// State per surfel while photographs are added, on disk: one record a leaf chunk, read and rewritten whole by one task at a time.
///
/// Each leaf has two slots in the file. A write goes to the older one, with a checksum and a mark of how far it reaches (photograph, row), so that a
/// kill at any moment leaves the previous state whole; a resumed run continues each chunk from its own mark. What a newer state has replaced goes back to
/// the disk once that one is synced: the file takes one state of each leaf, and a little more while it is written. Photographs are added in the order of
/// their names, each surfel once a photograph: the state has the same bits however the work was cut.
#pragma once
#include <array>
#include <cstddef>
#include <cstdint>
#include <filesystem>
#include <memory>
#include <optional>
#include <span>
#include <string>
#include <type_traits>
#include <vector>

namespace chiaro::blend {

/// How far a leaf has come: everything of photographs before `photograph`, and of that one the surfels in rows before `row`.
struct Mark {
  std::uint32_t photograph = 0, row = 0;
  friend auto operator<=>(const Mark&, const Mark&) = default;
};

using FourFloats = std::array<float, 4>;

/// counters: 32-bit numbers a leaf, beside the records of its surfels. more: so many times four floats a surfel behind them.
struct LeafShape {
  std::vector<std::uint32_t> surfels_of_leaf;
  std::uint32_t num_photographs = 0, counters = 0, record_bytes = 0, more = 0;
};

template <class T>
struct LeafRecord {
  std::vector<std::uint32_t> counters;
  std::vector<T> surfels;
  std::vector<FourFloats> more;   ///< those of the first surfel, of the second, …
};

class LeafFile {
 public:
  /// Opens `path` if it was made with the same key and shape, else starts it anew. throws Error.
  LeafFile(const std::filesystem::path& path, const std::string& key, LeafShape shape);
  /// Opens `path` only if it was made with the same key and shape.
  static std::optional<LeafFile> existing(const std::filesystem::path& path, const std::string& key, LeafShape shape);
  /// What a leaf takes on the disk.
  static std::uint64_t disk_bytes(const LeafShape& shape, std::size_t leaf);
  /// What a file takes besides, at most, while leaves of so many bytes are written anew.
  static std::uint64_t spare_bytes(std::uint64_t leaves_bytes);
  LeafFile(LeafFile&&) noexcept;
  LeafFile& operator=(LeafFile&&) noexcept;
  ~LeafFile();
  std::size_t num_leaves() const;
  /// Photographs that are in completely.
  std::uint32_t photographs_done() const;
  /// Syncs, then notes that photographs [0, count) are in.
  void set_photographs_done(std::uint32_t count);
  Mark mark(std::size_t leaf) const;
  bool is_written(std::size_t leaf) const;
  /// The leaf's state; zeros if it was never written. Thread-safe for different leaves. throws Error on a checksum that does not fit.
  template <class T>
  LeafRecord<T> read(std::size_t leaf) const {
    static_assert(std::is_trivially_copyable_v<T>);
    LeafRecord<T> record{std::vector<std::uint32_t>(counters()), std::vector<T>(surfels(leaf)), std::vector<FourFloats>(std::size_t{surfels(leaf)} * more())};
    read_bytes(leaf, record.counters, std::as_writable_bytes(std::span<T>(record.surfels)), std::as_writable_bytes(std::span<FourFloats>(record.more)));
    return record;
  }
  template <class T>
  void write(std::size_t leaf, const Mark& mark, const LeafRecord<T>& record) {
    write_bytes(leaf, mark, record.counters, std::as_bytes(std::span<const T>(record.surfels)), std::as_bytes(std::span<const FourFloats>(record.more)));
  }

 private:
  LeafFile();
  std::uint32_t surfels(std::size_t leaf) const;
  std::uint32_t counters() const;
  std::uint32_t more() const;
  void read_bytes(std::size_t leaf, std::span<std::uint32_t> counters, std::span<std::byte> surfels, std::span<std::byte> more) const;
  void write_bytes(std::size_t leaf, const Mark& mark, std::span<const std::uint32_t> counters, std::span<const std::byte> surfels, std::span<const std::byte> more);
  struct Impl;
  std::unique_ptr<Impl> impl_;
};

}  // namespace chiaro::blend
