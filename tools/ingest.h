/// From the project's cloud files to the store: which files, how their points are filtered and placed, and the key of it all.
#pragma once
#include <filesystem>
#include <functional>
#include <string>
#include <vector>

#include "stream/base/budget.h"
#include "stream/base/report.h"
#include "stream/store/octree_build.h"
#include "tools/project.h"

namespace chiaro::tools {

struct IngestPlan {
  std::vector<std::filesystem::path> files;
  stream::BuildOptions options;
  bool remove_outliers = false, align = false;
  std::string key;
};

IngestPlan plan_ingest(const Project& project);

struct IngestOutcome {
  std::string store_key;
  std::vector<std::string> notes;
};

/// Builds the store at `store_path`, unless the one that lies there is made of the same. scratch: folder for what is needed meanwhile; made if absent.
/// before_building: may throw; called before a store that is there is replaced. throws Error, Cancelled.
IngestOutcome ingest_cloud(const IngestPlan& plan, const std::filesystem::path& store_path, const std::filesystem::path& scratch, const std::function<void()>& before_building, MemoryBudget& budget,
                           Reporter& report);

}  // namespace chiaro::tools
