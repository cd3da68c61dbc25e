#include "tools/ingest.h"

#include "stream/base/error.h"
#include "stream/base/file.h"
#include "stream/base/hash.h"
#include "stream/cloud/filtered.h"
#include "stream/cloud/point_stream.h"
#include "stream/store/store.h"
#include "tools/cloud_units.h"
#include "tools/rounded_positions.h"

namespace chiaro::tools {

IngestPlan plan_ingest(const Project& project) {
  IngestPlan plan;
  plan.files = project.cloud.files;
  plan.options.unit = project.unit;
  switch (project.cloud.normals) {
    case Normals::kAuto: plan.options.normals = stream::NormalSource::kAuto; break;
    case Normals::kFile: plan.options.normals = stream::NormalSource::kFile; break;
    case Normals::kEstimate: plan.options.normals = stream::NormalSource::kEstimate; break;
    case Normals::kNone: plan.options.normals = stream::NormalSource::kNone; break;
  }
  plan.remove_outliers = project.cloud.outliers == Outliers::kStatistical;
  plan.align = project.cloud.align == Alignment::kIcp;
  Hasher h;
  h.add("ingest").add(stream::build_key(plan.files, plan.options)).add(std::uint64_t{plan.remove_outliers}).add(std::uint64_t{plan.align});
  plan.key = h.hex();
  return plan;
}

namespace {

/// Several clouds one after the other: outliers are judged over all scans together.
class ChainReader final : public stream::PointReader {
 public:
  ChainReader(std::size_t clouds, std::function<std::unique_ptr<stream::PointReader>(std::size_t)> open) : clouds_(clouds), open_(std::move(open)), now_(open_(0)), schema_(now_->schema()) {
    schema_.declared_points = 0;
  }
  const stream::PointSchema& schema() const override { return schema_; }
  bool read(stream::PointBlock& block, std::size_t max_points) override {
    while (!now_->read(block, max_points)) {
      if (++next_ >= clouds_) return false;
      now_ = open_(next_);
    }
    return true;
  }

 private:
  std::size_t clouds_, next_ = 0;
  std::function<std::unique_ptr<stream::PointReader>(std::size_t)> open_;
  std::unique_ptr<stream::PointReader> now_;
  stream::PointSchema schema_;
};

std::string describe(const std::filesystem::path& file, const std::filesystem::path& onto, const stream::IcpResult& r) {
  const Vec3d shift = r.target_from_source.translation();
  return concat(file.filename().string(), ": laid onto ", onto.filename().string(), " by ICP: rotation ", Eigen::AngleAxisd(r.target_from_source.rotation()).angle() * 57.29577951,
                " degrees, shift ", shift.x(), " ", shift.y(), " ", shift.z(), ", rms distance ", r.rms_distance, r.converged ? "" : ", NOT converged: check the scans");
}

bool is_made_of(const std::filesystem::path& store_path, const std::string& key) {
  try {
    return stream::Store(store_path).manifest().key == key;
  } catch (const Error&) {
    return false;   // none, a damaged one, or one of another version
  }
}

IngestOutcome make_store(const IngestPlan& plan, const std::filesystem::path& store_path, const std::filesystem::path& scratch, const std::function<void()>& before_building, MemoryBudget& budget,
                         Reporter& report) {
  IngestOutcome outcome;
  if (!plan.remove_outliers && !plan.align) {
    outcome.store_key = stream::build_key(plan.files, plan.options);
    if (is_made_of(store_path, outcome.store_key)) return outcome;
    before_building();
    stream::build_store(plan.files, store_path, plan.options, budget, report);
    return outcome;
  }
  const std::uint64_t memory = budget.free_bytes() / 2;
  std::vector<Eigen::Isometry3d> placed(plan.files.size(), Eigen::Isometry3d::Identity());
  stream::CloudInput input;
  input.files = plan.files;
  for (std::size_t i = 0; i < plan.files.size(); ++i) {
    std::string fingerprint = file_fingerprint(plan.files[i]);
    if (plan.align && i > 0) {
      stream::AlignOptions options;
      options.memory_bytes = memory;
      const stream::IcpResult r = stream::align_files(plan.files[0], plan.files[i], options, report);
      placed[i] = r.target_from_source;
      outcome.notes.push_back(describe(plan.files[i], plan.files[0], r));
      report.note(outcome.notes.back());
      Hasher h;
      h.add(fingerprint).add_bytes(placed[i].matrix().data(), 16 * sizeof(double));
      fingerprint = h.hex();
    }
    input.fingerprints.push_back(fingerprint);
  }
  input.open = [&](std::size_t i) {
    auto reader = stream::open_points(plan.files[i], memory);
    return i > 0 && plan.align ? stream::transformed(std::move(reader), placed[i]) : std::move(reader);
  };
  stream::OutlierMarks marks;
  stream::OutlierOptions options;
  if (plan.remove_outliers) input.filter_key = concat("statistical ", options.neighbours, " ", options.multiplier);
  outcome.store_key = stream::build_key(input, plan.options);
  if (is_made_of(store_path, outcome.store_key)) return outcome;
  before_building();
  if (plan.remove_outliers) {
    options.memory_bytes = std::max<std::uint64_t>(memory, 16u << 20);
    make_folder(scratch);
    options.scratch_folder = scratch;
    ChainReader all(plan.files.size(), input.open);
    marks = stream::mark_outliers(all, options, report);
    input.rejected = [&](std::uint64_t i) { return marks.rejected(i); };
    input.rejected_reason = stream::OutlierMarks::kReason;
    outcome.notes.push_back(concat(marks.num_rejected, " of ", marks.num_points, " points are statistical outliers (mean distance to ", options.neighbours, " neighbours above ",
                                   marks.threshold, ") and were left out"));
    report.note(outcome.notes.back());
  }
  stream::build_store_from(input, store_path, plan.options, budget, report);
  return outcome;
}

}  // namespace

IngestOutcome ingest_cloud(const IngestPlan& plan, const std::filesystem::path& store_path, const std::filesystem::path& scratch, const std::function<void()>& before_building, MemoryBudget& budget,
                           Reporter& report) {
  IngestOutcome outcome = make_store(plan, store_path, scratch, before_building, budget, report);
  const auto tell = [&](std::vector<std::string> notes) {
    for (std::string& note : notes) {
      report.note(note);
      outcome.notes.push_back(std::move(note));
    }
  };
  tell(notes_on_rounded_positions(stream::Store(store_path), plan.files, budget.free_bytes() / 2));
  if (!plan.align) tell(notes_on_units(plan.files, budget.free_bytes() / 2));
  return outcome;
}

}  // namespace chiaro::tools
