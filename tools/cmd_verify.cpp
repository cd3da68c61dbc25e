/// chiaro verify STORE: reads everything and checks it.
#include <nlohmann/json.hpp>
#include <ostream>

#include "stream/base/error.h"
#include "stream/base/parallel.h"
#include "stream/store/octree_build.h"
#include "tools/args.h"
#include "tools/colour_source.h"
#include "tools/commands.h"
#include "tools/resources.h"
#include "tools/table.h"

namespace chiaro::tools {

int run_verify(std::span<const std::string> args, Console& console) {
  std::string dir;
  std::uint64_t memory_bytes = std::uint64_t{2} << 30;
  int threads = 0;
  Args parser("verify", "Reads a whole store and checks it: checksums, counts, links, bounds, that every point is there exactly once, and all layers.\nExit code 1 if anything is wrong.");
  parser.positional("DIR", dir, "NAME.chiaro, or the folder of a run");
  parser.resources(memory_bytes, threads);
  parser.common(console);
  if (!parser.parse(args, console)) return 0;
  const ThreadLimit limit(threads);
  MemoryBudget budget(budget_bytes(memory_bytes));
  const auto folder = store_folder(dir);
  const stream::VerifyResult result = stream::verify_store(folder, budget, console.report());
  console.clear_line();
  if (console.json) {
    const nlohmann::ordered_json out{{"store", folder.string()}, {"chunks", result.chunks}, {"surfels", result.surfels}, {"problems", result.problems}};
    console.result(out.dump(-1, ' ', false, nlohmann::ordered_json::error_handler_t::replace));
  } else {
    for (const std::string& problem : result.problems) console.out() << problem << '\n';
  }
  if (!result.problems.empty())
    throw Error(concat(folder.string(), ": ", result.problems.size(), result.problems.size() == 1 ? " problem: " : " problems, the first: ", result.problems.front()));
  if (!console.json) console.out() << folder.string() << ": whole; " << format_count(result.chunks) << " chunks, " << format_count(result.surfels) << " surfels\n";
  return 0;
}

}  // namespace chiaro::tools
