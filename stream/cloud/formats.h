/// One function per format; open_points and create_points choose. Internal to stream/cloud.
#pragma once
#include <cstdint>
#include <memory>

#include "stream/base/file.h"
#include "stream/cloud/point_stream.h"

namespace chiaro::stream {

std::unique_ptr<PointReader> open_ply(File file);
/// LAS, and LAZ within memory_bytes (see read_laz_rows).
std::unique_ptr<PointReader> open_las(File file, std::uint64_t memory_bytes);
std::unique_ptr<PointReader> open_e57(File file);
std::unique_ptr<PointReader> open_pcd(File file, std::uint64_t memory_bytes);
/// XYZ, TXT, ASC, CSV, PTS.
std::unique_ptr<PointReader> open_text(File file, bool is_pts);
/// Scans of rows and columns in text, each with its pose. Points that hit nothing are given as no_position().
std::unique_ptr<PointReader> open_ptx(File file);

std::unique_ptr<PointWriter> create_ply(const std::filesystem::path& path, const PointWriterOptions& options);
std::unique_ptr<PointWriter> create_las(const std::filesystem::path& path, const PointWriterOptions& options);
std::unique_ptr<PointWriter> create_pcd(const std::filesystem::path& path, const PointWriterOptions& options);

}  // namespace chiaro::stream
