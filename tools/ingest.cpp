#include "tools/ingest.h"

#include "stream/base/error.h"
#include "stream/base/hash.h"

namespace chiaro::tools {

IngestPlan plan_ingest(const Project& project) {
  IngestPlan plan;
  plan.files = project.cloud.files;
  plan.options.unit = project.unit;
  switch (project.cloud.normals) {
    case Normals::kAuto: plan.options.normals = stream::NormalSource::kAuto; break;
    case Normals::kFile: plan.options.normals = stream::NormalSource::kFile; break;
    case Normals::kEstimate: plan.options.normals = stream::NormalSource::kEstimate; break;
  }
  plan.remove_outliers = project.cloud.outliers == Outliers::kStatistical;
  plan.align = project.cloud.align == Alignment::kIcp;
  Hasher h;
  h.add("ingest").add(stream::build_key(plan.files, plan.options)).add(std::uint64_t{plan.remove_outliers}).add(std::uint64_t{plan.align});
  plan.key = h.hex();
  return plan;
}

IngestOutcome ingest_cloud(const IngestPlan& plan, const std::filesystem::path& store_path, MemoryBudget& budget, Reporter& report) {
  IngestOutcome outcome;
  outcome.store_key = stream::build_store(plan.files, store_path, plan.options, budget, report).key;
  return outcome;
}

}  // namespace chiaro::tools
