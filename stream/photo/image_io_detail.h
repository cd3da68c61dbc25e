/// Inside of image_io: one row reader a format, and what they share. Not for other folders.
#pragma once
#include <csetjmp>
#include <cstdio>
#include <limits>
#include <memory>

#include "stream/base/error.h"
#include "stream/photo/image_io.h"

namespace chiaro::stream::detail {

class RowReader {
 public:
  virtual ~RowReader() = default;
  /// Rows [y0, y0 + rows). Readers without random access are only asked for the row after the last one.
  virtual void read_rows(int y0, int rows, float* out) = 0;
  virtual bool random_access() const { return false; }
  ImageInfo info;
};

std::unique_ptr<RowReader> open_exr(const std::filesystem::path& path, const ImageOptions& options);
std::unique_ptr<RowReader> open_tiff(const std::filesystem::path& path, const ImageOptions& options);
std::unique_ptr<RowReader> open_png(const std::filesystem::path& path, const ImageOptions& options);
std::unique_ptr<RowReader> open_jpeg(const std::filesystem::path& path, const ImageOptions& options);

/// throws Error if the size is empty or beyond the limits.
void check_size(const std::filesystem::path& path, std::uint64_t width, std::uint64_t height, const ImageLimits& limits);
void check_buffer(const std::filesystem::path& path, std::uint64_t bytes, const ImageLimits& limits, const char* what);

/// Description of an ICC profile ("sRGB IEC61966-2.1"); "unnamed" if it has none that can be read.
std::string profile_name(std::span<const std::uint8_t> icc);
/// Whether the curve of its red, or grey, channel is the identity; absent where the profile has none (tables) or is damaged.
std::optional<bool> profile_is_linear(std::span<const std::uint8_t> icc);
/// Fills `profile` and `says_linear`.
void read_profile(std::span<const std::uint8_t> icc, ImageInfo& info);

/// 1 to 8 as EXIF counts; 1 where the block ("Exif", then a TIFF header and its first directory) says nothing or is damaged.
int exif_orientation(std::span<const std::uint8_t> block);
/// Adds a note where viewers would turn or mirror the picture: cameras are those of the pixels as they are stored.
void note_orientation(int orientation, ImageInfo& info);

struct CloseFile {
  void operator()(std::FILE* file) const { std::fclose(file); }
};
using FilePtr = std::unique_ptr<std::FILE, CloseFile>;
/// Opens for reading. throws Error (missing, a folder).
FilePtr open_c_file(const std::filesystem::path& path);

/// Runs calls into a C library that reports errors by longjmp; false if it did. `call` must not own anything while it runs: the jump skips destructors.
template <class Call>
[[gnu::noinline]] bool guarded(std::jmp_buf& jump, Call&& call) {
  if (setjmp(jump) != 0) return false;
  call();
  return true;
}

}  // namespace chiaro::stream::detail
