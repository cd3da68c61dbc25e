/// chiaro export STORE --out FILE: a layer back as a point file.
#include <algorithm>
#include <nlohmann/json.hpp>
#include <ostream>

#include "stream/base/error.h"
#include "stream/base/file.h"
#include "stream/base/parallel.h"
#include "stream/store/layer.h"
#include "tools/args.h"
#include "tools/colour_source.h"
#include "tools/commands.h"
#include "tools/export_points.h"
#include "tools/resources.h"
#include "tools/suggest.h"
#include "tools/table.h"

namespace chiaro::tools {
namespace fs = std::filesystem;
namespace {

bool has_albedo(const stream::Layer& layer) {
  return std::any_of(layer.fields().begin(), layer.fields().end(), [](const stream::LayerField& f) { return f.name == "albedo"; });
}

/// "albedo" where there is one, else the only layer with albedos; empty where there is none. throws UsageError where there are several.
std::string only_albedo(const stream::Store& store) {
  if (stream::has_layer(store, "albedo")) return "albedo";
  std::vector<std::string> found;
  for (const std::string& name : stream::layer_names(store))
    if (has_albedo(stream::Layer(store, name))) found.push_back(name);
  if (found.size() < 2) return found.empty() ? "" : found.front();
  std::string names;
  for (const std::string& name : found) names += (names.empty() ? "" : ", ") + name;
  throw UsageError(concat(store.path().string(), ": holds several results, name one with --layer: ", names));
}

/// The layer's name as export_points() takes it: empty for geometry and input colour alone.
std::string layer_of(const stream::Store& store, const std::string& wanted) {
  if (wanted.empty()) return only_albedo(store);
  if (wanted == "input") return "";
  if (stream::has_layer(store, wanted)) return wanted;
  throw Error(concat(store.path().string(), ": no layer \"", wanted, "\"", suggestion(wanted, stream::layer_names(store))));
}

void print(const fs::path& file, const ExportStats& stats, Console& console) {
  if (console.json) {
    const nlohmann::ordered_json out{{"file", file.string()}, {"points", stats.points}, {"points_unseen", stats.points_unseen}, {"points_filled", stats.points_filled}, {"points_inserted", stats.points_inserted},
                                     {"points_moved", stats.points_moved}, {"positions_from_store", stats.positions_from_store}};
    return console.result(out.dump(-1, ' ', false, nlohmann::ordered_json::error_handler_t::replace));
  }
  console.clear_line();
  console.out() << file.string() << ": " << format_count(stats.points) << " points, " << format_count(stats.points_unseen) << " of them unseen";
  if (stats.points_filled) console.out() << " (" << format_count(stats.points_filled) << " filled from their neighbours)";
  if (stats.points_inserted) console.out() << ", " << format_count(stats.points_inserted) << " inserted after the cloud's own";
  console.out() << '\n';
}

}  // namespace

int run_export(std::span<const std::string> args, Console& console) {
  std::string dir, layer, out;
  bool fill = false;
  std::uint64_t memory_bytes = std::uint64_t{2} << 30;
  int threads = 0;
  Args parser("export", "Writes a layer of a store as a point file: the input's points, in the input's order, with all that the input carried.");
  parser.positional("DIR", dir, "NAME.chiaro, or the folder of a run");
  parser.option("-o,--out", out, ".ply, .las or .pcd", "FILE");
  parser.require("--out");
  parser.option("--layer", layer, "which result; default: albedo where there is one, else the only one. input: geometry and input colour alone", "NAME");
  parser.flag("--fill", fill, "unseen points take albedo and colour from their neighbours; they stay marked by photos = 0");
  parser.resources(memory_bytes, threads);
  parser.common(console);
  if (!parser.parse(args, console)) return 0;
  const ThreadLimit limit(threads);
  const stream::Store store(store_folder(dir));
  ExportOptions options;
  options.file = out;
  options.layer = layer_of(store, layer);
  options.fill = fill;
  MemoryBudget budget(budget_bytes(memory_bytes));
  const fs::path parent = fs::path(out).parent_path();
  make_folder(parent.empty() ? "." : parent);
  const ScratchFolder scratch(parent.empty() ? "." : parent);
  print(options.file, export_points(store, options, scratch.path(), budget, console.report()), console);
  return 0;
}

}  // namespace chiaro::tools
