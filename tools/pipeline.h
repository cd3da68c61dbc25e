/// The whole way from a project to albedo per point: stages as pure functions between files, each one a task that is skipped when its result is there.
#pragma once
#include <filesystem>

#include "stream/base/budget.h"
#include "stream/base/report.h"
#include "tools/project.h"
#include "tools/run_record.h"

namespace chiaro::tools {

/// Runs everything that is not done yet in `out`. The record is filled as it goes and written to out/run.json at the end (also after a failure).
/// throws UsageError (no flash but albedo asked for), Error, Cancelled. What single photographs lack is entered in the record as left out.
void run_pipeline(const Project& project, const std::filesystem::path& out, MemoryBudget& budget, RunRecord& record, Reporter& report);

}  // namespace chiaro::tools
