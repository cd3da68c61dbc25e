/// chiaro status DIR: what is done, what is to do, times and sizes.
#include <filesystem>
#include <ostream>

#include "stream/base/budget.h"
#include "tools/args.h"
#include "tools/commands.h"
#include "tools/report_json.h"
#include "tools/status.h"
#include "tools/table.h"

namespace chiaro::tools {
namespace {

Json json_of(const RunStatus& s) {
  Json out{{"project", s.project}, {"method", s.method}, {"complete", s.complete}, {"running", s.running}, {"from_before", s.from_before}, {"last_exit", s.exit_code ? Json(*s.exit_code) : Json(nullptr)}, {"bytes", s.bytes}};
  out["stages"] = Json::array();
  for (const StageStatus& g : s.stages)
    out["stages"].push_back({{"name", g.name}, {"done", g.done}, {"running", g.running}, {"to_do", g.to_do}, {"left_out", g.left_out}, {"seconds", g.seconds}});
  out["tasks"] = Json::array();
  for (const TaskStatus& t : s.tasks)
    out["tasks"].push_back({{"name", t.name}, {"state", name_of(t.state)}, {"seconds", t.state == TaskState::kDone ? Json(t.seconds) : Json(nullptr)}});
  out["parts"] = Json::array();
  for (const PartSize& p : s.parts) out["parts"].push_back({{"name", p.name}, {"bytes", p.bytes}, {"files", p.files}});
  return out;
}

void print(const RunStatus& s, bool all, std::ostream& out) {
  out << s.project << ", solve.method = " << s.method << ": " << (s.running ? "running" : s.complete ? "complete" : "not complete");
  if (s.exit_code) out << "; the last run ended with exit code " << *s.exit_code;
  out << "\n\n";
  const auto count = [](std::size_t n) { return n ? std::to_string(n) : std::string("-"); };
  Table stages({"stage", "done", "running", "to do", "left out", "time"});
  double seconds = 0;
  for (const StageStatus& g : s.stages) {
    stages.row({g.name, count(g.done), count(g.running), count(g.to_do), count(g.left_out), g.done ? format_seconds(g.seconds) : "-"});
    seconds += g.seconds;
  }
  stages.row({"all", "", "", "", "", format_seconds(seconds)});
  out << stages.text() << '\n';
  if (s.from_before > 0) out << s.from_before << " tasks to do have a result of an earlier run; a run passes over those that still hold\n\n";
  if (all) {
    Table tasks({"task", "state", "time"}, {Table::Align::kLeft, Table::Align::kLeft, Table::Align::kRight});
    for (const TaskStatus& t : s.tasks) tasks.row({t.name, name_of(t.state), t.state == TaskState::kDone ? format_seconds(t.seconds) : "-"});
    out << tasks.text() << '\n';
  }
  Table parts({"part", "size", "files"});
  for (const PartSize& p : s.parts) parts.row({p.name, format_bytes(p.bytes), format_count(p.files)});
  parts.row({"all", format_bytes(s.bytes)});
  out << parts.text();
}

}  // namespace

int run_status(std::span<const std::string> words, Console& console) {
  Args args("status",
            "What a run has done and has still to do, how long each stage took, and how much disk each part takes.\n"
            "Times are those of the tasks when they ran, in whichever run that was. A task that is done runs again only if its inputs or options change;\n"
            "what an earlier run has made is to do until the run at work finds that it still holds.");
  std::string dir;
  bool all = false;
  args.positional("DIR", dir, "folder of a run");
  args.flag("--tasks", all, "list every task");
  args.common(console);
  if (!args.parse(words, console)) return 0;
  const RunStatus status = read_status(RunFolder{std::filesystem::path(dir)});
  if (console.json)
    console.result(json_of(status).dump(-1, ' ', false, Json::error_handler_t::replace));
  else
    print(status, all, console.out());
  return 0;
}

}  // namespace chiaro::tools
