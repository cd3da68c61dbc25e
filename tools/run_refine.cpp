#include <algorithm>

#include "blend/refine.h"
#include "stream/base/error.h"
#include "stream/base/file.h"
#include "stream/store/octree_build.h"
#include "tools/inserted_points.h"
#include "tools/run_context_json.h"
#include "tools/run_refine_json.h"
#include "tools/table.h"

namespace chiaro::tools {
namespace {
using Json = nlohmann::ordered_json;

constexpr std::uint64_t kPointsOfCloud = 4;   ///< default budget: so many times the cloud

blend::Findings findings_of(const Json& record) {
  blend::Findings known;
  known.scatter = record.at("scatter");
  known.tolerance.by_class = record.at("tolerance").get<decltype(known.tolerance.by_class)>();
  for (const Json& p : record.at("photographs")) {
    known.gain.push_back(p.at("gain").get<std::array<double, 3>>());
    blend::Alignment a;
    if (p.contains("shift_corrected_px")) {
      a.shift_px = {p["shift_corrected_px"].at(0).get<float>(), p["shift_corrected_px"].at(1).get<float>()};
      a.trust = p["trust"].get<float>();
    }
    known.alignment.push_back(a);
  }
  return known;
}

/// Their normals are those of the cloud: with a sign if it has one.
void build_inserted(const stream::Store& store, const std::filesystem::path& points, const std::filesystem::path& out, RunContext& run) {
  stream::CloudInput input;
  input.files = {concat("points inserted into ", store.path().filename().string())};
  input.fingerprints = {file_fingerprint(points)};
  input.open = [&](std::size_t) { return blend::read_new_points(points); };
  stream::BuildOptions options;
  options.unit = store.manifest().unit;
  options.normals = store.manifest().normals_from_file ? stream::NormalSource::kFile : stream::NormalSource::kAxes;
  make_folder(out.parent_path());
  stream::build_store_from(input, out, options, run.budget, run.report);
}

Json insert(RunContext& run, const stream::Store& store, std::span<const blend::BlendPhotograph> photographs, blend::BlendOptions options, const BlendedLayer& layer, std::uint64_t most,
            const std::filesystem::path& out) {
  const std::filesystem::path scratch = run.folder.scratch() / "inserted", points = scratch / "new.points";
  std::filesystem::remove_all(out);   // of another layer, or of a run that was stopped
  options.known = findings_of(layer.record);
  const blend::RefineStats s = blend::find_new_points(store, photographs, options, most, points, scratch, run.budget, run.report);
  Json found{{"inserted", s.inserted}, {"asked", s.asked}, {"most", most}, {"coarser", s.coarser}, {"points", s.surfels}, {"refined", s.refined}, {"fine_enough", s.fine_enough},
             {"unseen", s.unseen}, {"without_surface", s.without_surface}, {"over_budget", s.over_budget}, {"inserted_seen", 0}, {"samples", 0}, {"points_disputed", 0}};
  if (s.inserted == 0) {
    make_folder(out);   // looked for, and none found
    return found;
  }
  build_inserted(store, points, out, run);
  options.provenance_json = Json{{"method", name_of(run.project.method)}, {"of", layer.key}, {"photographs", photographs.size()}}.dump();
  const blend::BlendStats b = blend::blend(stream::Store(out), photographs, options, scratch, run.budget, run.report);
  found["inserted_seen"] = b.points_seen;
  found["samples"] = b.samples;
  found["points_disputed"] = b.points_disputed;
  std::filesystem::remove(points);
  return found;
}

std::string sentence(const Json& r) {
  const auto count = [&](const char* name) { return format_count(r.at(name).get<std::uint64_t>()); };
  std::string text = concat("blend.refine: ", count("inserted_seen"), " points inserted, around ", count("refined"), " of the cloud's ", count("points"), "; the others: ", count("fine_enough"),
                            " as fine as their photographs, ", count("unseen"), " unseen, ", count("without_surface"), " on borders or edges");
  if (r.value("over_budget", std::uint64_t{0}) > 0)
    text += concat(", ", count("over_budget"), " whose new points refine_points = ", count("most"), " does not hold at any distance that is tried");
  else if (r.at("coarser").get<double>() > 1)
    text += concat("; refine_points = ", count("most"), " holds them ", format_number(r.at("coarser").get<double>(), 2), " times as far apart as the photographs' pixels: about ", count("asked"), " would not");
  return text;
}

}  // namespace

std::string refine_run_layer(RunContext& run, const stream::Store& store, std::span<const blend::BlendPhotograph> photographs, blend::BlendOptions options, const BlendedLayer& layer) {
  const std::filesystem::path out = inserted_path(store.path(), options.layer);
  const std::string task = RunFolder::refine_task(options.layer);
  if (run.project.blend.refine == BlendRefine::kNone) {
    std::error_code code;
    if (std::filesystem::exists(out, code)) {
      run.tasks.forget(task);
      std::filesystem::remove_all(out, code);
    }
    return "";
  }
  const std::uint64_t most = run.project.blend.refine_points.value_or(kPointsOfCloud * store.manifest().points_stored);
  Hasher h = keyed("refine 1");
  h.add(layer.key).add(most);
  const std::string key = h.hex();
  const Json found = run.task(task, key, {out}, [&] { return insert(run, store, photographs, std::move(options), layer, most, out); });
  run.record.count("points_inserted", found["inserted_seen"]);
  run.record.set("refinement", found.dump());
  run.note_both(sentence(found));
  return key;
}

}  // namespace chiaro::tools
