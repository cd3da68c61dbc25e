#include <algorithm>
#include <memory>
#include <optional>
#include <ostream>

#include "optimize/proxy_file.h"
#include "optimize/render.h"
#include "stream/base/error.h"
#include "stream/base/file.h"
#include "stream/base/parallel.h"
#include "tools/args.h"
#include "tools/camera_record.h"
#include "tools/commands.h"
#include "tools/inserted_points.h"
#include "tools/light_record_json.h"
#include "tools/report_json.h"
#include "tools/resources.h"
#include "tools/run_folder.h"
#include "tools/status.h"
#include "tools/views.h"

namespace chiaro::tools {
namespace {

/// The lights of the first acquisition that has some, and where its transport lies.
struct RunLights {
  std::string acquisition;
  std::size_t solved = 0;   ///< acquisitions that have lights of their own
  optimize::Lights lights;
  Vec3d flash_in_camera = Vec3d::Zero();
  optimize::Falloff falloff;
};

/// Nullopt if the run solved none.
std::optional<RunLights> read_lights(const RunFolder& folder) {
  const Json lights = read_json_object(folder.lights()), project = read_json_object(folder.project());
  const auto lights_in = [](const Json& a) { return a.contains("flash_intensity") ? &a : a.contains("photographs") && !a["photographs"].empty() ? &a["photographs"][0] : nullptr; };
  try {
    for (const Json& a : lights.at("acquisitions")) {
      const Json* found = lights_in(a);
      if (!found) continue;
      RunLights r;
      r.solved = static_cast<std::size_t>(std::count_if(lights["acquisitions"].begin(), lights["acquisitions"].end(), [&](const Json& other) { return lights_in(other) && !other.contains("lights_of"); }));
      r.acquisition = a.at("acquisition");
      r.lights.flash_intensity = found->at("flash_intensity");
      r.lights.sky = found->at("sky").get<std::array<double, optimize::kSkyTerms>>();
      r.lights.sky_colour = found->at("sky_colour").get<std::array<double, 3>>();
      r.lights.floor = found->contains("floor_albedo");
      if (r.lights.floor) r.lights.floor_albedo = found->at("floor_albedo");
      r.lights.bounce = found->at("bounce");
      if (found->contains("gloss")) r.lights.gloss = {true, found->at("gloss").at("reflectance"), found->at("gloss").at("roughness")};
      if (a.contains("falloff")) r.falloff = falloff_from_json(a["falloff"]);
      for (const Json& p : project.at("acquisition"))
        if (p.at("name") == r.acquisition && !p.at("flash").is_null())
          for (int i = 0; i < 3; ++i)
            r.flash_in_camera[i] = p.at("flash").at("offset_in_camera").at(static_cast<std::size_t>(i)).get<double>() + (a.contains("flash_shift_in_camera") ? a["flash_shift_in_camera"].at(static_cast<std::size_t>(i)).get<double>() : 0.0);
      return r;
    }
  } catch (const nlohmann::json::exception& e) {
    throw Error(concat(folder.lights().string(), ": not the lights of a run: ", e.what()));
  }
  return std::nullopt;
}

std::filesystem::path picture_of(const std::filesystem::path& out, const ViewInput& view) { return out / (view.name + ".exr"); }

std::unique_ptr<optimize::RenderLights> load_lights(const RunFolder& folder, const stream::Store& store, const RunLights& lights) {
  const std::filesystem::path at = folder.acquisition(lights.acquisition);
  auto loaded = std::make_unique<optimize::RenderLights>(optimize::load_scene(store, at), std::vector<float>(), lights.lights);
  loaded->proxy_albedo = optimize::read_floats(optimize::proxy_albedo_path(at), 3 * loaded->scene.proxy.size());
  return loaded;
}

/// The photographs that sharpen what lies between the points.
std::vector<optimize::DetailPhotograph> load_photographs(const RunFolder& folder) {
  std::vector<optimize::DetailPhotograph> photographs;
  for (PhotographCamera& c : read_camera_record(folder.cameras())) {
    const std::string key = c.camera.photograph;
    std::optional<Vec3d> flash;
    if (c.flash_in_camera) flash = c.camera.pose.world_from_camera(*c.flash_in_camera);
    photographs.push_back({std::move(c.camera), folder.gbuffer(key), folder.albedo(key), flash, Eigen::Map<const Vec3d>(c.gain.data()).cast<float>(),
                           Eigen::Map<const Vec2d>(c.shift_px.data()).cast<float>(), static_cast<float>(c.trust)});
  }
  return photographs;
}

/// Views are often called after the photographs that they are compared with.
void refuse_photographs(const Json& project, const std::filesystem::path& out, const std::vector<ViewInput>& views) {
  for (const ViewInput& v : views) {
    const std::filesystem::path picture = picture_of(out, v);
    for (const Json& a : member(project, "acquisition"))
      for (const Json& p : member(a, "photographs"))
        if (std::error_code code; std::filesystem::equivalent(picture, text_of(member(p, "file"), ""), code))
          throw Error(concat(picture.string(), ": is a photograph of the run, it is not written over; choose another --out"));
  }
}

}  // namespace

int run_render(std::span<const std::string> words, Console& console) {
  Args args("render", "Predicts photographs from a finished run: for each view an EXR of linear radiance with all light terms.");
  std::string dir, views_file, out;
  bool only_albedo = false, only_direct = false, only_points = false;
  std::uint64_t memory = std::uint64_t{2} << 30;
  int threads = 0;
  args.positional("DIR", dir, "folder of a finished run");
  args.option("--views", views_file, "cameras to render from, see docs/project-file.md", "VIEWS.toml");
  args.option("-o,--out", out, "folder for the pictures, NAME.exr each", "DIR");
  args.flag("--albedo", only_albedo, "the albedo itself, without light");
  args.flag("--direct", only_direct, "flash only: no ambient light, no bounces");
  args.flag("--points", only_points, "the albedo of the points alone, inserted ones too: not sharpened by the photographs, which show what lies between them");
  args.require("--views");
  args.require("--out");
  args.resources(memory, threads);
  args.common(console);
  if (!args.parse(words, console)) return 0;
  if (only_albedo && only_direct) throw UsageError("--albedo and --direct exclude each other");

  const std::vector<ViewInput> views = load_views(views_file);
  const RunFolder folder{std::filesystem::absolute(dir)};
  const ThreadLimit limit(threads);
  MemoryBudget budget(budget_bytes(memory));
  const stream::Store store(folder.store());
  if (const std::string note = note_on_unfinished(read_status(folder)); !note.empty()) console.report().note(note);
  const Json project = read_json_object(folder.project());
  refuse_photographs(project, out, views);
  const std::string layer_name = text_of(member(member(project, "blend"), "layer"), "albedo");
  const stream::Layer layer(store, layer_name);
  // The photographs themselves show what lies between the points; where they are read, inserted points add nothing (measured on a tower: 37.7 dB without, 37.6 with).
  const std::optional<InsertedPoints> inserted = only_points ? open_inserted(store, layer_name) : std::nullopt;
  optimize::RenderOptions options;
  if (inserted) {
    options.inserted = inserted->store.get();
    options.inserted_layer = inserted->layer.get();
  }
  options.mode = only_albedo ? optimize::RenderMode::kAlbedo : only_direct ? optimize::RenderMode::kDirect : optimize::RenderMode::kFull;
  const std::optional<RunLights> found = read_lights(folder);
  if (!found && !only_albedo) throw Error(concat(dir, ": the run solved no lights (solve.method = \"none\"); only --albedo can be rendered"));
  std::unique_ptr<optimize::RenderLights> lights;
  if (found) lights = load_lights(folder, store, *found);
  const RunLights run_lights = found.value_or(RunLights{});
  if (run_lights.solved > 1 && !only_albedo)
    console.report().note(concat("the run has the lights of ", run_lights.solved, " acquisitions; views are shown in those of \"", run_lights.acquisition, "\""));
  std::vector<optimize::DetailPhotograph> photographs;
  if (!only_points) photographs = load_photographs(folder);
  options.sharpen_by = photographs;
  make_folder(out);
  Json results = Json::array();
  for (const ViewInput& v : views) {
    optimize::RenderView view{v.name, v.lens, v.pose, v.flash_offset_in_camera.value_or(run_lights.flash_in_camera), v.flash_intensity.value_or(run_lights.lights.flash_intensity), v.ambient_scale, run_lights.falloff};
    const std::filesystem::path picture = picture_of(out, v);
    const optimize::RenderStats s = optimize::render(store, layer, lights.get(), view, options, picture, budget, console.report());
    if (s.pixels_hit == 0) console.report().note(concat(v.name, ": shows nothing of the cloud: is it rotation and translation from world to camera, with z forwards, in the project's unit?"));
    results.push_back({{"view", v.name}, {"file", picture.string()}, {"pixels", s.pixels}, {"pixels_hit", s.pixels_hit}, {"pixels_without_albedo", s.pixels_without_albedo},
                       {"pixels_sharpened", s.pixels_sharpened}});
    if (!console.json) {
      console.clear_line();
      console.out() << picture.string() << "\n";
    }
  }
  if (console.json) console.result(Json{{"views", results}}.dump(-1, ' ', false, Json::error_handler_t::replace));
  return 0;
}

}  // namespace chiaro::tools
