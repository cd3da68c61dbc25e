/// chiaro synth SPEC --points N --out FILE: synthetic clouds of any size.
#include <nlohmann/json.hpp>
#include <ostream>

#include "stream/base/budget.h"
#include "stream/base/error.h"
#include "stream/base/parallel.h"
#include "tools/args.h"
#include "tools/commands.h"
#include "tools/synth_write.h"
#include "tools/table.h"

namespace chiaro::tools {

int run_synth(std::span<const std::string> words, Console& console) {
  Args args("synth", "Writes a synthetic cloud, streamed from a seed: memory does not depend on its size. Points lie evenly on the surface.\n\n" + synth_spec_help() +
                         "With --albedo: red = 0.45 + 0.30 sin(12 x + 7 y), green = 0.45 + 0.30 sin(9 y + 8 z + 2), blue = 0.45 + 0.30 sin(11 z - 6 x + 4),\n"
                         "linear, x y z in metres of the scene before scale, offset and noise.");
  std::string spec, file;
  std::uint64_t points = 0;
  bool albedo = false;
  int threads = 0;
  args.positional("SPEC", spec, "SCENE or SCENE:NAME=VALUE,...");
  args.option("-n,--points", points, "how many, 1 to 2^40", "N");
  args.option("-o,--out", file, ".ply, .las or .pcd", "FILE");
  args.flag("--albedo", albedo, "write albedo_r albedo_g albedo_b");
  args.option("--threads", threads, "threads; 0 = all cores", "N", 0, 4096);
  args.require("--points");
  args.require("--out");
  args.common(console);
  if (!args.parse(words, console)) return 0;
  if (points < 1 || points > std::uint64_t{1} << 40) throw UsageError(concat("--points ", points, ": expected 1 to ", std::uint64_t{1} << 40));
  const ThreadLimit limit(threads);
  const SynthScene scene(parse_synth_spec(spec), points);
  const SynthResult r = write_synth(scene, file, albedo, console.report());
  console.clear_line();
  if (console.json) {
    const nlohmann::ordered_json out{{"file", file}, {"points", r.points}, {"bytes", r.bytes}, {"area_m2", r.area_m2}, {"spacing_m", r.spacing_m}};
    console.result(out.dump(-1, ' ', false, nlohmann::ordered_json::error_handler_t::replace));
  } else {
    console.out() << file << ": " << format_count(r.points) << " points, " << format_bytes(r.bytes);
    if (r.area_m2 > 0) console.out() << ", " << format_number(r.area_m2) << " m^2, spacing " << format_number(1000 * r.spacing_m) << " mm";
    console.out() << '\n';
  }
  return 0;
}

}  // namespace chiaro::tools
