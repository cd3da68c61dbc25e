#include "tools/run_solve.h"

#include <algorithm>
#include <map>
#include <memory>
#include <nlohmann/json.hpp>

#include "optimize/acquisition.h"
#include "optimize/albedo.h"
#include "optimize/pictures.h"
#include "stream/base/error.h"
#include "stream/base/file.h"
#include "tools/light_record_json.h"
#include "tools/resources.h"
#include "tools/run_context_json.h"
#include "tools/table.h"

namespace chiaro::tools {
namespace {
using Json = nlohmann::ordered_json;
using optimize::Method;

Method solve_method(SolveMethod m) {
  switch (m) {
    case SolveMethod::kSingle: return Method::kSingle;
    case SolveMethod::kAdam: return Method::kAdam;
    case SolveMethod::kDirect: return Method::kDirect;
    default: return Method::kJoint;
  }
}

optimize::SkyModel sky_model(AmbientModel m) {
  switch (m) {
    case AmbientModel::kNone: return optimize::SkyModel::kNone;
    case AmbientModel::kUniform: return optimize::SkyModel::kUniform;
    case AmbientModel::kSh1: return optimize::SkyModel::kSh1;
    case AmbientModel::kSh2: return optimize::SkyModel::kSh2;
    case AmbientModel::kAuto: break;
  }
  return optimize::SkyModel::kAuto;
}

optimize::FalloffModel falloff_model(FalloffModel m) {
  switch (m) {
    case FalloffModel::kNone: return optimize::FalloffModel::kNone;
    case FalloffModel::kLens: return optimize::FalloffModel::kLens;
    case FalloffModel::kFlash: return optimize::FalloffModel::kFlash;
    case FalloffModel::kAuto: break;
  }
  return optimize::FalloffModel::kAuto;
}

/// In pixels of the working image.
std::vector<Vec2d> outline_of(const ReferenceInput& reference, const Photo& photo) {
  std::vector<Vec2d> outline = reference.polygon;
  for (Vec2d& p : outline) p /= photo.binning;
  return outline;
}

/// Targets that are not there, or in part.
void note_references(RunContext& run, const Shoot& shoot) {
  for (const ReferenceInput& r : shoot.acquisition->references) {
    const Photo* photo = photo_of(shoot, r);
    if (!photo) {
      run.note_both(concat(shoot.acquisition->photographs[r.photograph].key, " was left out, and the reference target in it with it"));
      continue;
    }
    const stream::Lens& lens = photo->camera.lens;
    const auto outside = [&](const Vec2d& p) { return !(p.x() >= 0 && p.y() >= 0 && p.x() <= lens.width_px && p.y() <= lens.height_px); };
    const std::vector<Vec2d> outline = outline_of(r, *photo);
    if (std::any_of(outline.begin(), outline.end(), outside))
      run.note_both(concat(photo->input->key, ": the reference target reaches beyond the picture (", lens.width_px * photo->binning, " x ", lens.height_px * photo->binning, " pixels), only its part inside is used; is its outline that of this picture?"));
  }
}

/// All photographs that share the lights of a lead, its own first.
optimize::AcquisitionInput acquisition_input(RunContext& run, std::vector<Shoot>& shoots, std::size_t lead) {
  const Acquisition& a = *shoots[lead].acquisition;
  optimize::AcquisitionInput input;
  input.intensity_range = a.flash->intensity_range;
  input.sky = sky_model(a.ambient);
  input.try_floor = a.floor != FloorModel::kNone;
  input.floor_plane = a.floor_plane;
  input.falloff = falloff_model(a.falloff);
  input.method = solve_method(run.project.method);
  std::vector<Shoot*> of_lead{&shoots[lead]};
  for (std::size_t i = 0; i < shoots.size(); ++i)
    if (i != lead && shoots[i].lead == lead) of_lead.push_back(&shoots[i]);
  for (Shoot* shoot : of_lead) note_references(run, *shoot);
  for (Shoot* shoot : of_lead)
    for (Photo& photo : shoot->photos) {
      photo.index_in_lights = input.photographs.size();
      for (const ReferenceInput& r : shoot->acquisition->references)
        if (r.photograph == photo.index_in_acquisition) input.references.push_back({photo.index_in_lights, outline_of(r, photo), r.albedo, r.sigma});
      input.photographs.push_back(run.observe_input(*shoot, photo));
      input.names.push_back(photo.input->key);
      run.record.count(shoot->has_flash() ? "photographs_with_flash" : "photographs_without_flash", 1);
    }
  return input;
}

std::vector<std::string> keys_in_lights(const std::vector<Shoot>& shoots, std::size_t lead) {
  std::map<std::size_t, std::string> keys;
  for (const Shoot& shoot : shoots)
    if (shoot.lead == lead)
      for (const Photo& p : shoot.photos) keys[p.index_in_lights] = p.gbuffer_key;
  std::vector<std::string> ordered;
  for (const auto& [index, key] : keys) ordered.push_back(key);
  return ordered;
}

/// What the lights depend on beside what was gathered.
void add_light_inputs(Hasher& h, const optimize::AcquisitionInput& input, const optimize::AcquisitionOptions& options, double metres_per_unit) {
  h.add("light").add(static_cast<std::uint64_t>(input.method)).add(static_cast<std::uint64_t>(input.sky)).add(static_cast<std::uint64_t>(input.falloff)).add(static_cast<std::uint64_t>(options.light_samples)).add(metres_per_unit);
  for (const optimize::ObserveInput& p : input.photographs) h.add(p.noise.gain).add(p.noise.read_sigma).add(p.ambient_scale);
  if (input.intensity_range) h.add((*input.intensity_range)[0]).add((*input.intensity_range)[1]);
  for (const auto& r : input.references) {
    h.add(static_cast<std::uint64_t>(r.photograph)).add(r.sigma);
    for (const double v : r.albedo) h.add(v);
    for (const Vec2d& v : r.polygon) h.add(v.x()).add(v.y());
  }
}

/// What is noted of the lights names photographs, on whose names nothing else depends.
std::string with_names(const std::string& key, const std::vector<std::string>& names) {
  Hasher h;
  h.add(key);
  for (const std::string& name : names) h.add(name);
  return h.hex();
}

void note_own_lights(RunContext& run, const std::string& acquisition, const std::vector<std::string>& names, const optimize::AcquisitionResult& lights) {
  const auto note_spread = [&](double spread, const char* what, const char* as_of) {
    if (spread > 0) run.note_both(concat("acquisition \"", acquisition, "\": ", what, " of its photographs varies by ", format_number(100 * spread, 2), " % (standard deviation), as ", as_of, "; corrected"));
  };
  note_spread(lights.spread[optimize::kExposure], "the brightness", "of a flash that is not always the same, or that stands elsewhere than offset_in_camera says (x to the right, y down, z forwards)");
  note_spread(lights.spread[optimize::kAmbient], "the ambient light", "daylight does under passing clouds");
  for (std::size_t k = 0; k < lights.own_lights.size(); ++k) {
    const optimize::OwnLight& own = lights.own_lights[k];
    if (own.unlike)
      run.note_both(concat(names[k], ": ", format_number(own.exposure, 3), " times as bright as the other photographs of its acquisition say; this was taken out before the lights were solved"));
    if (own.unlike_ambient) run.note_both(concat(names[k], ": ambient light ", format_number(own.ambient, 3), " times that of the others, corrected"));
  }
}

/// Highlights and edges of shadows are a few pixels. Where it is many, the light is too weak.
void note_impossible(RunContext& run, const Acquisition& a, std::uint64_t solved, std::uint64_t impossible) {
  constexpr std::uint64_t kNoted = 20;   // one in so many
  if (impossible * kNoted <= solved + impossible) return;
  run.note_both(concat("acquisition \"", a.name, "\": ", 100 * impossible / (solved + impossible), " % of the pixels that the light reaches would reflect more than twice of it, or are far below black, and have no value: ",
                       "is the flash's intensity_range too low for these photographs, project.unit another one, or does the object shine?"));
}

}  // namespace

void solve_lights(RunContext& run, const stream::Store& store, std::vector<Shoot>& shoots, std::size_t lead) {
  Shoot& shoot = shoots[lead];
  const Acquisition& a = *shoot.acquisition;
  const optimize::AcquisitionInput input = acquisition_input(run, shoots, lead);
  if (std::none_of(input.photographs.begin(), input.photographs.end(), [](const optimize::ObserveInput& p) { return p.flash_in_camera.has_value(); })) return;
  optimize::AcquisitionOptions options;
  options.seed = run.project.seed;
  options.max_proxy_surfels = std::min(options.max_proxy_surfels, std::max<std::uint64_t>(2000, optimize::proxy_surfels_within(plannable_bytes(run.project.memory_bytes) / 2, options.rays)));
  const std::filesystem::path folder = run.folder.acquisition(a.name);
  make_folder(folder);
  Hasher h = keyed("gather");
  h.add(options.seed).add(options.proxy_surfels).add(options.max_proxy_surfels).add(static_cast<std::uint64_t>(options.rays));
  for (const std::string& key : keys_in_lights(shoots, lead)) h.add(key);
  h.add(std::uint64_t{input.try_floor});
  if (input.floor_plane)
    for (const double v : *input.floor_plane) h.add(v);
  shoot.transport_key = h.hex();
  std::vector<std::filesystem::path> others;
  for (std::size_t i = 0; i < lead; ++i)
    if (!shoots[i].transport_key.empty()) others.push_back(run.folder.acquisition(shoots[i].acquisition->name));
  run.task("gather/" + a.name, shoot.transport_key, {folder / "proxy.bin", folder / "transport.bin", folder / "floor.bin"}, [&] {
    optimize::gather_scene(store, input, options, folder, others, run.budget, run.report);
    return Json::object();
  });
  add_light_inputs(h, input, options, run.project.metres_per_unit);
  shoot.light_key = h.hex();
  std::vector<std::filesystem::path> outputs{optimize::proxy_albedo_path(folder)};
  const Json info = run.task("light/" + a.name, with_names(shoot.light_key, input.names), outputs, [&] {
    const optimize::Scene scene = optimize::load_scene(store, folder);
    return light_json(optimize::solve_acquisition(store, scene, input, options, folder, run.budget, run.report));
  });
  shoot.lights = lights_from_json(info);
  for (const std::string& n : shoot.lights.notes) run.note_both(n);
  note_own_lights(run, a.name, input.names, shoot.lights);
  if (shoot.lights.proxy_seen == 0 && input.method != Method::kDirect && input.method != Method::kAdam)
    throw Error(concat("acquisition \"", a.name, "\": no surfel of the cloud is seen well enough by any photograph: ", kNothingSeenHint));
}

void solve_albedo(RunContext& run, const stream::Store& store, const std::vector<Shoot>& shoots, Shoot& shoot) {
  if (shoot.photos.empty()) return;
  const Acquisition& a = *shoot.acquisition;
  const Shoot& lead = shoots[shoot.lead];
  const std::filesystem::path folder = run.folder.acquisition(lead.acquisition->name);
  std::unique_ptr<optimize::Scene> scene;   // loaded once, and only if some photograph needs it
  optimize::AlbedoOptions options;
  options.direct_only = run.project.method == SolveMethod::kDirect;
  std::uint64_t solved = 0, impossible = 0;
  for (Photo& photo : shoot.photos) {
    const std::size_t k = photo.index_in_lights;
    if (lead.lights.strangers[k]) {
      run.leave_out(*photo.input, "it shows something else than the other photographs where they show the same surfaces: another object, or the wrong camera");
      continue;
    }
    Hasher h = keyed("albedo");
    h.add(lead.light_key).add(photo.gbuffer_key).add(photo.radiance_key);
    photo.albedo_key = h.hex();
    const std::filesystem::path pictures = run.folder.pictures(photo.input->key), raster = run.folder.albedo(photo.input->key);
    const Json info = run.task("albedo/" + photo.input->key, photo.albedo_key, {raster, pictures / "albedo.exr", pictures / "sigma.exr", pictures / "light.exr"}, [&] {
      if (!scene) scene = std::make_unique<optimize::Scene>(optimize::load_scene(store, folder));
      options.errors = lead.lights.errors[lead.lights.light_of_photograph[k]];
      const Vec3d flash = photo.camera.pose.world_from_camera(a.flash->offset_in_camera);
      const optimize::AlbedoStats s = optimize::solve_albedo(*scene, run.observe_input(shoot, photo), lead.lights.lights[lead.lights.light_of_photograph[k]], flash,
                                                             {optimize::gathered_path(folder, k), optimize::floor_flash_path(folder, k), lead.lights.pattern, lead.lights.own_lights[k]}, options, raster, run.report);
      optimize::write_albedo_pictures(raster, pictures);
      return Json{{"pixels", s.pixels}, {"pixels_solved", s.pixels_solved}, {"pixels_dark", s.pixels_dark}, {"pixels_above_one", s.pixels_above_one}, {"pixels_impossible", s.pixels_impossible}, {"median_sigma", s.median_sigma}};
    });
    run.record.count("pixels_solved", info["pixels_solved"]);
    solved += info["pixels_solved"].get<std::uint64_t>();
    impossible += info["pixels_impossible"].get<std::uint64_t>();
  }
  run.record.count("pixels_impossible", impossible);
  note_impossible(run, a, solved, impossible);
}

void take_colour(RunContext& run, Shoot& shoot) {
  for (Photo& photo : shoot.photos) {
    Hasher h = keyed("colour");
    h.add(photo.radiance_key).add(photo.gbuffer_key);
    photo.albedo_key = h.hex();
    const std::filesystem::path pictures = run.folder.pictures(photo.input->key), raster = run.folder.albedo(photo.input->key);
    run.task("colour/" + photo.input->key, photo.albedo_key, {raster, pictures / "albedo.exr"}, [&] {
      optimize::colour_as_albedo(run.observe_input(shoot, photo), raster, run.report);
      optimize::write_albedo_pictures(raster, pictures);
      return Json::object();
    });
  }
}

}  // namespace chiaro::tools
