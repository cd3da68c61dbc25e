#include "tools/pipeline.h"

#include <nlohmann/json.hpp>

#include "stream/base/error.h"
#include "stream/base/file.h"
#include "stream/base/hash.h"
#include "stream/cloud/filtered.h"
#include "stream/store/octree_build.h"
#include "tools/ingest.h"
#include "tools/run_context_json.h"
#include "tools/run_layer.h"
#include "tools/run_lights.h"
#include "tools/run_photographs.h"
#include "tools/run_solve.h"
#include "tools/store_results.h"

namespace chiaro::tools {
namespace {

using Json = nlohmann::ordered_json;

class Pipeline {
 public:
  Pipeline(const Project& project, const std::filesystem::path& out, MemoryBudget& budget, RunRecord& record, Reporter& report)
      : run_{project, {out}, TaskLog(RunFolder{out}.tasks()), budget, record, report, ProgressLog(RunFolder{out}.progress())} {}

  void run() {
    check_flash();
    ScratchFolder::remove_left_in(run_.folder.scratch());   // what else lies there may be gone on from
    write_text(run_.folder.project(), to_json(run_.project) + "\n");
    for (const std::string& note : run_.project.notes) run_.note_both(note);
    ingest();
    shoots_ = read_shoots(run_);
    const stream::Store store(run_.folder.store());
    count_points(store);
    PhotographStages photographs(run_, store, shoots_);
    photographs.plan();
    for (Shoot& shoot : shoots_) {
      photographs.develop(shoot);
      photographs.raycast(shoot);
      if (run_.project.method == SolveMethod::kNone) take_colour(run_, shoot);
    }
    photographs.note_masks();
    photographs.note_backs();
    if (run_.project.method != SolveMethod::kNone) {
      for (std::size_t i = 0; i < shoots_.size(); ++i)
        if (shoots_[i].lead == i) solve_lights(run_, store, shoots_, i);
      for (Shoot& shoot : shoots_)
        if (shoot.has_flash()) solve_albedo(run_, store, shoots_, shoot);
    }
    write_run_lights(run_, shoots_);
    write_run_layer(run_, store, shoots_);
    std::error_code code;
    std::filesystem::remove_all(run_.folder.scratch(), code);
  }

 private:
  void check_flash() const {
    if (run_.project.method == SolveMethod::kNone) return;
    for (const Acquisition& a : run_.project.acquisitions)
      if (a.role == AcquisitionRole::kFlash && !a.flash)
        throw UsageError(concat(run_.project.file.filename().string(), ": acquisition \"", a.name,
                                "\" has no [acquisition.flash]: without a known flash there is no albedo. Set solve.method = \"none\" to blend the photographs' own colour"));
  }

  void ingest() {
    const IngestPlan plan = plan_ingest(run_.project);
    if (another_store_is_there()) run_.tasks.forget("ingest");
    const Json info = run_.task("ingest", plan.key, {run_.folder.store()}, [&] {
      const IngestOutcome outcome = ingest_cloud(plan, run_.folder.store(), run_.folder.scratch(), [&] { require_no_results(run_.folder.store(), run_.project.blend.layer); }, run_.budget, run_.report);
      return Json{{"store_key", outcome.store_key}, {"notes", outcome.notes}};
    });
    for (const auto& n : info.value("notes", Json::array())) run_.record.note(n.get<std::string>());
    for (const auto& file : run_.project.cloud.files) run_.record.input(file, file_fingerprint(file));
  }

  /// `chiaro ingest` may have put one there, or a user a copy. One that cannot be read is named when it is opened.
  bool another_store_is_there() const {
    const Json then = Json::parse(run_.tasks.info("ingest"), nullptr, false);
    try {
      return stream::Store(run_.folder.store()).manifest().key != then.value("store_key", std::string());
    } catch (const Error&) {
      return false;
    }
  }

  void count_points(const stream::Store& store) {
    const stream::Manifest& m = store.manifest();
    run_.record.count("points_in", m.points_read);
    run_.record.count("points_stored", m.points_stored);
    for (const auto& [reason, n] : m.points_rejected) {
      run_.record.count("points_rejected", n);
      // Outliers are left out because the project asks for it: counted, but nothing is missing.
      if (n > 0 && reason != stream::OutlierMarks::kReason) run_.record.left_out("points", "cloud", reason, n);
    }
  }

  RunContext run_;
  std::vector<Shoot> shoots_;
};

}  // namespace

void run_pipeline(const Project& project, const std::filesystem::path& out, MemoryBudget& budget, RunRecord& record, Reporter& report) {
  make_folder(out);
  Pipeline(project, out, budget, record, report).run();
}

}  // namespace chiaro::tools
