#include <filesystem>
#include <ostream>

#include "stream/base/error.h"
#include "stream/base/file.h"
#include "stream/base/folder_lock.h"
#include "stream/base/parallel.h"
#include "tools/args.h"
#include "tools/commands.h"
#include "tools/console_report.h"
#include "tools/pipeline.h"
#include "tools/project.h"
#include "tools/report.h"
#include "tools/resources.h"
#include "tools/run_folder.h"
#include "tools/run_record.h"

namespace chiaro::tools {
namespace {

void print_summary(Console& console, const RunRecord& record, const RunFolder& folder, const Project& project, int code) {
  if (console.json) {
    console.result(record.json(code));
    return;
  }
  console.clear_line();
  for (const ExportInput& e : project.exports) console.out() << (folder.root / e.file).string() << "\n";
  console.out() << (folder.report() / "index.html").string() << "\n" << folder.record().string() << "\n";
}

/// What was done until a run stopped stays on record; a second failure (a full disk) must not hide the first.
void write_record(const RunRecord& record, const RunFolder& folder, int code) {
  try {
    record.write(folder.record(), code);
  } catch (const std::exception&) {
  }
}

}  // namespace

int run_run(std::span<const std::string> words, Console& console) {
  Args args("run", "Does everything: cloud and flash photographs in, albedo per point out. Resumes by itself where an earlier run stopped.");
  std::string project_file, out;
  std::vector<std::string> overrides;
  std::uint64_t memory = 0;
  int threads = 0;
  args.positional("PROJECT", project_file, "project file, see docs/project-file.md");
  args.option("-o,--out", out, "folder for everything the run leaves; default NAME.out beside the project file", "DIR");
  args.list("--set", overrides, "override a key of the project file, e.g. solve.method=adam", "KEY=VALUE");
  args.resources(memory, threads);
  args.common(console);
  if (!args.parse(words, console)) return 0;

  Project project = load_project(project_file, overrides);
  if (args.count("--memory") > 0) project.memory_bytes = memory;
  if (args.count("--threads") > 0) project.threads = threads;
  const RunFolder folder{out.empty() ? default_output(project) : std::filesystem::absolute(out)};
  const ThreadLimit limit(project.threads);
  MemoryBudget budget(budget_bytes(project.memory_bytes));
  RunRecord record("run", words);
  record.project(to_json(project));
  record.seed(project.seed);
  record.threads(ThreadLimit::current());
  record.memory_limit(project.memory_bytes);
  make_folder(folder.work());
  const FolderLock lock(folder.work());
  try {
    run_pipeline(project, folder.root, budget, record, console.report());
  } catch (...) {
    write_record(record, folder, exit_code_of_exception());
    throw;
  }
  const int code = record.was_partial() ? 3 : 0;
  record.write(folder.record(), code);
  write_report(folder, console.report());
  print_summary(console, record, folder, project, code);
  return code;
}

}  // namespace chiaro::tools
