/// Results back as a point file: the input's points in the input's order, with albedo, sigma and everything the input carried.
#pragma once
#include <cstdint>
#include <filesystem>
#include <functional>
#include <string>
#include <vector>

#include "stream/base/budget.h"
#include "stream/base/file.h"
#include "stream/base/report.h"
#include "stream/store/store.h"

namespace chiaro::tools {

struct ExportOptions {
  std::filesystem::path file;      ///< .ply, .las or .pcd
  std::string layer = "albedo";    ///< empty: geometry and input colour alone
  std::vector<std::filesystem::path> sources;   ///< where the source files are now, in the store's order; empty: where they were at ingest
  bool fill = false;               ///< unseen points take albedo and colour from their neighbours; they stay marked by photos = 0 and sigma NaN
  std::function<std::uint64_t(const std::filesystem::path&)> free_bytes = free_disk_bytes;   ///< of the disk that holds a folder
};

struct ExportStats {
  std::uint64_t points = 0, points_unseen = 0, points_filled = 0;
  std::uint64_t points_inserted = 0;   ///< of the points, after all others: see inserted_points.h
  std::uint64_t points_moved = 0;      ///< stored elsewhere than the source file says (aligned scans): the stored position is written
  bool positions_from_store = false;   ///< the source files changed or are gone
};

/// Properties in this order: x y z (double where the input was, else float), nx ny nz (float, from the store), red green blue (u8, in LAS u16; sRGB of the albedo),
/// albedo_r albedo_g albedo_b (float, linear), sigma (float), photos (u16), with inserted points inserted (u8, 0 or 1), then the input's own further properties as they were.
/// Unseen: albedo and sigma NaN, photos 0, colour of the input or mid-grey 128. Rejected points are left out.
/// Positions and further properties are re-read from the source files while these are unchanged; otherwise positions come from the store, further
/// properties are dropped, and a note says so; so too where a file cannot be read within the budget. Properties that not all source files share are dropped too.
/// Points that were inserted beside the layer follow after all others, where a photograph sees them; the input's own properties are NaN there, whole numbers 0.
/// scratch: a folder for 44 bytes a point; room for them and for the result is asked for before anything is written. Memory: two passes over buckets of consecutive points, as the budget allows.
/// throws Error (no such layer, no space, unknown extension, a file that is a source of the store), Cancelled.
ExportStats export_points(const stream::Store& store, const ExportOptions& options, const std::filesystem::path& scratch, MemoryBudget& budget, Reporter& report);

}  // namespace chiaro::tools
