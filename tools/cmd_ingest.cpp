/// chiaro ingest FILES… --out NAME.chiaro: point files to a store.
#include <algorithm>
#include <chrono>
#include <nlohmann/json.hpp>
#include <ostream>
#include <system_error>

#include "stream/base/error.h"
#include "stream/base/parallel.h"
#include "stream/store/octree_build.h"
#include "tools/args.h"
#include "tools/commands.h"
#include "tools/glob.h"
#include "tools/resources.h"
#include "tools/cloud_units.h"
#include "tools/rounded_positions.h"
#include "tools/store_results.h"
#include "tools/table.h"

namespace chiaro::tools {
namespace fs = std::filesystem;
namespace {

std::vector<fs::path> find_files(const std::vector<std::string>& patterns) {
  std::vector<fs::path> files;
  for (const std::string& pattern : patterns) {
    const std::vector<fs::path> found = expand_pattern("", pattern);
    if (found.empty()) throw Error(concat(pattern, ": no such file"));
    for (const fs::path& file : found) {
      std::error_code code;
      if (!fs::is_regular_file(file, code)) throw Error(concat(file.string(), ": not a file"));
      if (std::any_of(files.begin(), files.end(), [&](const fs::path& other) { return fs::equivalent(file, other, code); })) throw UsageError(concat(file.string(), ": is named twice, and its points would count twice"));
      files.push_back(file);
    }
  }
  return files;
}

stream::NormalSource normal_source(const std::string& word) {
  if (word == "file") return stream::NormalSource::kFile;
  if (word == "estimate") return stream::NormalSource::kEstimate;
  return word == "none" ? stream::NormalSource::kNone : stream::NormalSource::kAuto;
}

/// The finished store that these inputs and options would give again, if it is there.
bool is_up_to_date(const fs::path& out, const std::vector<fs::path>& files, const stream::BuildOptions& options) {
  std::error_code code;
  if (!fs::exists(out, code)) return false;
  // Whatever else has that name is the user's and stays.
  if (!fs::exists(out / "manifest.json", code)) throw Error(concat(out.string(), ": exists and is not a store; it is left alone"));
  try {
    return stream::Store(out).manifest().key == stream::build_key(files, options);
  } catch (const Error&) {
    return false;  // damaged, or of another version: made anew
  }
}

void print(const fs::path& out, const stream::Manifest& manifest, bool reused, double seconds, Console& console) {
  if (console.json) {
    nlohmann::ordered_json json{{"store", out.string()}, {"reused", reused}, {"seconds", seconds}, {"points_read", manifest.points_read}, {"points_stored", manifest.points_stored},
                                {"points_rejected", manifest.points_rejected}, {"surfels_inner", manifest.surfels_inner}, {"normals_from_file", manifest.normals_from_file}};
    return console.result(json.dump(-1, ' ', false, nlohmann::ordered_json::error_handler_t::replace));
  }
  Table table({"", "", ""}, {Table::Align::kLeft, Table::Align::kRight, Table::Align::kLeft});
  table.row({"points read", format_count(manifest.points_read)});
  table.row({"stored", format_count(manifest.points_stored)});
  for (const auto& [reason, count] : manifest.points_rejected) table.row({"rejected", format_count(count), reason});
  table.row({"normals", manifest.normals_from_file ? "from file" : "estimated"});
  console.clear_line();
  console.out() << out.string() << (reused ? ": up to date\n" : concat(": made in ", format_seconds(seconds), ", ", format_rate(static_cast<double>(manifest.points_read) / std::max(seconds, 1e-9)), " points/s\n"))
                << table.text();
}

}  // namespace

int run_ingest(std::span<const std::string> args, Console& console) {
  std::vector<std::string> patterns;
  std::string out, normals = "auto", unit = "m";
  std::uint64_t memory_bytes = std::uint64_t{2} << 30;
  int threads = 0;
  Args parser("ingest", "Puts point files (PLY, LAS, LAZ, E57, PCD, XYZ, PTS, PTX) into one chunked store, in bounded memory. A killed run goes on where it stopped.");
  parser.positionals("FILES", patterns, "one or many, merged in this order; * ? [ ] are understood");
  parser.option("-o,--out", out, "folder of the store", "NAME.chiaro");
  parser.require("--out");
  parser.choice("--normals", normals, {"auto", "file", "estimate", "none"}, "auto: the file's where it has them, else estimated; none: no search for neighbours, rough normals and radii for a quick look");
  parser.choice("--unit", unit, {"m", "cm", "mm"}, "unit of the coordinates");
  parser.resources(memory_bytes, threads);
  parser.common(console);
  if (!parser.parse(args, console)) return 0;
  const ThreadLimit limit(threads);

  const auto start = std::chrono::steady_clock::now();
  const std::vector<fs::path> files = find_files(patterns);
  stream::BuildOptions options;
  options.unit = unit;
  options.normals = normal_source(normals);
  const bool reused = is_up_to_date(out, files, options);
  if (reused) remove_leftovers(out + ".part", out);
  else require_no_results(out);
  MemoryBudget budget(budget_bytes(memory_bytes));
  const stream::Manifest manifest = reused ? stream::Store(out).manifest() : stream::build_store(files, out, options, budget, console.report());
  for (const std::string& note : notes_on_rounded_positions(stream::Store(out), files, budget.free_bytes() / 2)) console.report().note(note);
  for (const std::string& note : notes_on_units(files, budget.free_bytes() / 2)) console.report().note(note);
  print(out, manifest, reused, std::chrono::duration<double>(std::chrono::steady_clock::now() - start).count(), console);
  return manifest.points_rejected.empty() ? 0 : 3;
}

}  // namespace chiaro::tools
