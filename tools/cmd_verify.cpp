/// chiaro verify STORE: reads everything and checks it; with --repair rebuilds what follows from what is whole.
#include <nlohmann/json.hpp>
#include <ostream>

#include "stream/base/error.h"
#include "stream/base/parallel.h"
#include "stream/store/octree_build.h"
#include "stream/store/repair.h"
#include "tools/args.h"
#include "tools/colour_source.h"
#include "tools/commands.h"
#include "tools/inserted_points.h"
#include "tools/resources.h"
#include "tools/table.h"

namespace chiaro::tools {
namespace {

void add(stream::RepairResult& sum, const stream::RepairResult& more) {
  sum.repaired.insert(sum.repaired.end(), more.repaired.begin(), more.repaired.end());
  sum.lost.insert(sum.lost.end(), more.lost.begin(), more.lost.end());
  sum.advice.insert(sum.advice.end(), more.advice.begin(), more.advice.end());
  sum.points_lost += more.points_lost;
}

}  // namespace

int run_verify(std::span<const std::string> args, Console& console) {
  std::string dir;
  std::uint64_t memory_bytes = std::uint64_t{2} << 30;
  int threads = 0;
  bool repair = false;
  Args parser("verify",
              "Reads a whole store and checks it: checksums, counts, links, bounds, that every point is there exactly once, all layers, and points inserted beside them.\n"
              "With --repair what follows from whole parts is rebuilt first, as it was: inner levels from the leaves, the index, totals of the manifest, inner values\n"
              "of layers. Damaged geometry, source indices and layer values of leaves are kept nowhere else: they are named, and stay damaged.\n"
              "Exit code 0 if the store is whole (now), 1 if damage remains.");
  parser.positional("DIR", dir, "NAME.chiaro, or the folder of a run");
  parser.flag("--repair", repair, "rebuild what can be rebuilt; needs room for a copy of the largest damaged file");
  parser.resources(memory_bytes, threads);
  parser.common(console);
  if (!parser.parse(args, console)) return 0;
  const ThreadLimit limit(threads);
  MemoryBudget budget(budget_bytes(memory_bytes));
  const auto folder = store_folder(dir);
  stream::RepairResult fixed = repair ? stream::repair_store(folder, budget, console.report()) : stream::RepairResult{};
  stream::VerifyResult result = stream::verify_store(folder, budget, console.report());
  for (const auto& inserted : inserted_stores(folder)) {
    if (repair) add(fixed, stream::repair_store(inserted, budget, console.report()));
    const stream::VerifyResult more = stream::verify_store(inserted, budget, console.report());
    for (const std::string& problem : more.problems) result.problems.push_back(concat(inserted.lexically_relative(folder).string(), ": ", problem));
    result.chunks += more.chunks;
    result.surfels += more.surfels;
  }
  // Whether a store is up to date is seen by its key, which damage leaves as it was.
  if (fixed.points_lost > 0) fixed.advice.push_back(concat("remove ", folder.string(), " before that: ingest and run take what is there for up to date"));
  console.clear_line();
  if (console.json) {
    nlohmann::ordered_json out{{"store", folder.string()}, {"chunks", result.chunks}, {"surfels", result.surfels}, {"problems", result.problems}};
    if (repair) out.update({{"repaired", fixed.repaired}, {"lost", fixed.lost}, {"advice", fixed.advice}, {"points_lost", fixed.points_lost}});
    console.result(out.dump(-1, ' ', false, nlohmann::ordered_json::error_handler_t::replace));
  } else {
    for (const std::string& line : fixed.repaired) console.out() << "repaired: " << line << '\n';
    for (const std::string& line : fixed.lost) console.out() << "lost: " << line << '\n';
    for (const std::string& line : fixed.advice) console.out() << "to do: " << line << '\n';
    for (const std::string& problem : result.problems) console.out() << problem << '\n';
  }
  if (!result.problems.empty())
    throw Error(concat(folder.string(), ": ", result.problems.size(), result.problems.size() == 1 ? " problem: " : " problems, the first: ", result.problems.front()));
  if (!console.json) console.out() << folder.string() << ": whole; " << format_count(result.chunks) << " chunks, " << format_count(result.surfels) << " surfels\n";
  return 0;
}

}  // namespace chiaro::tools
