/// chiaro report DIR: the HTML report of a finished run.
#include <filesystem>
#include <ostream>

#include "stream/base/budget.h"
#include "stream/base/parallel.h"
#include "tools/args.h"
#include "tools/commands.h"
#include "tools/report.h"
#include "tools/report_json.h"

namespace chiaro::tools {

int run_report(std::span<const std::string> words, Console& console) {
  Args args("report",
            "Writes DIR/report/index.html, one file that opens offline: input, prediction, albedo, difference, light shares, uncertainty and coverage of every\n"
            "photograph, lights, numbers and times; and DIR/report/report.json with all the numbers. `chiaro run` does this at its end.");
  std::string dir;
  ReportOptions options;
  int threads = 0;
  args.positional("DIR", dir, "folder of a finished run");
  args.option("--width", options.max_picture_width, "widest picture; narrower where the file would grow beyond --size", "PIXELS", 16, 4096);
  args.bytes("--size", options.max_bytes, "largest index.html");
  args.option("--threads", threads, "threads; 0 = all cores", "N", 0, 4096);
  args.common(console);
  if (!args.parse(words, console)) return 0;
  const ThreadLimit limit(threads);
  options.min_picture_width = std::min(options.min_picture_width, options.max_picture_width);
  const ReportResult r = write_report(RunFolder{std::filesystem::path(dir)}, console.report(), options);
  console.clear_line();
  if (console.json)
    console.result(Json{{"html", r.html.string()}, {"json", r.json.string()}, {"bytes", r.html_bytes}, {"photographs", r.photographs}, {"picture_width", r.picture_width}}.dump(
        -1, ' ', false, Json::error_handler_t::replace));
  else
    console.out() << r.html.string() << "\n" << r.json.string() << "\n";
  return 0;
}

}  // namespace chiaro::tools
