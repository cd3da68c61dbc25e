/// The report of a finished run: one HTML file that opens offline, and all its numbers as JSON.
#pragma once
#include <cstdint>
#include <filesystem>

#include "stream/base/report.h"
#include "tools/run_folder.h"

namespace chiaro::tools {

struct ReportOptions {
  int max_picture_width = 640;             ///< pixels; fewer where max_bytes asks for it
  int min_picture_width = 160;
  std::size_t max_pictures_of = 40;        ///< photographs shown with pictures: half of them evenly chosen, half those that are predicted worst
  std::uint64_t max_bytes = 15'000'000;    ///< of index.html
};

struct ReportResult {
  std::filesystem::path html, json;
  std::uint64_t html_bytes = 0;
  std::size_t photographs = 0;
  int picture_width = 0;
};

/// Writes root/report/index.html and root/report/report.json (see docs) from what a run left in `folder`: work/project.json, run.json, lights.json, the
/// rasters of work/photographs and the pictures of photographs. Reads each photograph by bands of rows; the same folder gives the same bytes.
/// throws Error naming the file if the folder is not that of a finished run, or a file is missing or damaged; Cancelled.
ReportResult write_report(const RunFolder& folder, Reporter& report, const ReportOptions& options = {});

}  // namespace chiaro::tools
