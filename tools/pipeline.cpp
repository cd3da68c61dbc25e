#include "tools/pipeline.h"

#include <algorithm>
#include <cmath>
#include <map>
#include <nlohmann/json.hpp>

#include "optimize/acquisition.h"
#include "optimize/albedo.h"
#include "optimize/pictures.h"
#include "stream/base/error.h"
#include "stream/base/file.h"
#include "stream/base/hash.h"
#include "stream/cloud/filtered.h"
#include "stream/store/layer.h"
#include "stream/store/octree_build.h"
#include "tools/ingest.h"
#include "tools/light_record_json.h"
#include "tools/resources.h"
#include "tools/run_context_json.h"
#include "tools/run_layer.h"
#include "tools/run_lights.h"
#include "tools/run_photographs.h"
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

class Pipeline {
 public:
  Pipeline(const Project& project, const std::filesystem::path& out, MemoryBudget& budget, RunRecord& record, Reporter& report)
      : run_{project, {out}, TaskLog(RunFolder{out}.tasks()), budget, record, report, ProgressLog(RunFolder{out}.progress())} {}

  void run() {
    check_flash();
    write_text(run_.folder.project(), to_json(run_.project) + "\n");
    for (const std::string& note : run_.project.notes) run_.note_both(note);
    ingest();
    shoots_ = read_shoots(run_);
    const stream::Store store(run_.folder.store());
    count_points(store);
    PhotographStages photographs(run_, shoots_);
    for (Shoot& shoot : shoots_) {
      photographs.develop(shoot);
      photographs.raycast(store, shoot);
      if (run_.project.method == SolveMethod::kNone) take_colour(shoot);
    }
    photographs.note_backs();
    if (run_.project.method != SolveMethod::kNone) {
      for (std::size_t i = 0; i < shoots_.size(); ++i)
        if (shoots_[i].lead == i) solve_lights(store, i);
      for (Shoot& shoot : shoots_)
        if (shoot.has_flash()) solve_albedo(store, shoot);
    }
    write_run_lights(run_, shoots_);
    write_run_layer(run_, store, shoots_);
    std::error_code code;
    std::filesystem::remove_all(run_.folder.scratch(), code);
  }

 private:
  void check_flash() const {
    if (run_.project.method == SolveMethod::kNone) return;
    for (const Acquisition& a : run_.project.acquisitions)
      if (a.role == AcquisitionRole::kFlash && !a.flash)
        throw UsageError(concat(run_.project.file.filename().string(), ": acquisition \"", a.name,
                                "\" has no [acquisition.flash]: without a known flash there is no albedo. Set solve.method = \"none\" to blend the photographs' own colour"));
  }

  void ingest() {
    const IngestPlan plan = plan_ingest(run_.project);
    if (!run_.tasks.is_done("ingest", plan.key, {run_.folder.store()})) require_no_other_layers();
    const Json info = run_.task("ingest", plan.key, {run_.folder.store()}, [&] {
      const IngestOutcome outcome = ingest_cloud(plan, run_.folder.store(), run_.budget, run_.report);
      return Json{{"store_key", outcome.store_key}, {"notes", outcome.notes}};
    });
    for (const auto& n : info.value("notes", Json::array())) run_.record.note(n.get<std::string>());
    for (const auto& file : run_.project.cloud.files) run_.record.input(file, file_fingerprint(file));
  }

  /// A store that is made anew takes its layers with it. Those that this run does not write would be gone for good.
  void require_no_other_layers() const {
    std::string others;
    try {
      for (const std::string& name : stream::layer_names(stream::Store(run_.folder.store())))
        if (name != "input" && name != run_.project.blend.layer) others += concat(others.empty() ? "" : ", ", name);
    } catch (const Error&) {
      return;   // no store yet, or none that could be read
    }
    if (!others.empty())
      throw Error(concat(run_.folder.store().string(), ": the cloud, or how it is read, is not what this store was made from, and its layers would be lost: ", others,
                         ". Choose another --out, or remove them from its folder layers"));
  }

  void count_points(const stream::Store& store) {
    const stream::Manifest& m = store.manifest();
    run_.record.count("points_in", m.points_read);
    run_.record.count("points_stored", m.points_stored);
    for (const auto& [reason, n] : m.points_rejected) {
      run_.record.count("points_rejected", n);
      // Outliers are left out because the project asks for it: counted, but nothing is missing.
      if (n > 0 && reason != stream::OutlierMarks::kReason) run_.record.left_out("points", "cloud", reason, n);
    }
  }

  /// All photographs that share the lights of a lead, its own first.
  optimize::AcquisitionInput acquisition_input(std::size_t lead) {
    const Acquisition& a = *shoots_[lead].acquisition;
    optimize::AcquisitionInput input;
    input.intensity_range = a.flash->intensity_range;
    input.sky = sky_model(a.ambient);
    input.try_floor = a.floor != FloorModel::kNone;
    input.floor_plane = a.floor_plane;
    input.method = solve_method(run_.project.method);
    std::vector<Shoot*> shoots{&shoots_[lead]};
    for (std::size_t i = 0; i < shoots_.size(); ++i)
      if (i != lead && shoots_[i].lead == lead) shoots.push_back(&shoots_[i]);
    for (Shoot* shoot : shoots)
      for (Photo& photo : shoot->photos) {
        photo.index_in_lights = input.photographs.size();
        for (const ReferenceInput& r : shoot->acquisition->references)
          if (r.photograph == photo.index_in_acquisition) input.references.push_back({photo.index_in_lights, r.polygon, r.albedo, r.sigma});
        input.photographs.push_back(run_.observe_input(*shoot, photo));
        input.names.push_back(photo.input->key);
        run_.record.count(shoot->has_flash() ? "photographs_with_flash" : "photographs_without_flash", 1);
      }
    return input;
  }

  void solve_lights(const stream::Store& store, std::size_t lead) {
    Shoot& shoot = shoots_[lead];
    const Acquisition& a = *shoot.acquisition;
    const optimize::AcquisitionInput input = acquisition_input(lead);
    if (std::none_of(input.photographs.begin(), input.photographs.end(), [](const optimize::ObserveInput& p) { return p.flash_in_camera.has_value(); })) return;
    optimize::AcquisitionOptions options;
    options.seed = run_.project.seed;
    options.max_proxy_surfels = std::min(options.max_proxy_surfels, std::max<std::uint64_t>(2000, optimize::proxy_surfels_within(plannable_bytes(run_.project.memory_bytes) / 2, options.rays)));
    const std::filesystem::path folder = run_.folder.acquisition(a.name);
    make_folder(folder);
    Hasher h = keyed("gather");
    h.add(options.seed).add(options.proxy_surfels).add(options.max_proxy_surfels).add(static_cast<std::uint64_t>(options.rays));
    for (const std::string& key : keys_in_lights(lead)) h.add(key);
    h.add(std::uint64_t{input.try_floor});
    if (input.floor_plane)
      for (const double v : *input.floor_plane) h.add(v);
    shoot.transport_key = h.hex();
    run_.task("gather/" + a.name, shoot.transport_key, {folder / "proxy.bin", folder / "transport.bin", folder / "floor.bin"}, [&] {
      optimize::gather_scene(store, input, options, folder, run_.budget, run_.report);
      return Json::object();
    });
    h.add("light").add(static_cast<std::uint64_t>(input.method)).add(static_cast<std::uint64_t>(input.sky)).add(static_cast<std::uint64_t>(options.light_samples)).add(run_.project.metres_per_unit);
    for (const optimize::ObserveInput& p : input.photographs) h.add(p.noise.gain).add(p.noise.read_sigma).add(p.ambient_scale);
    if (input.intensity_range) h.add((*input.intensity_range)[0]).add((*input.intensity_range)[1]);
    for (const auto& r : input.references) {
      h.add(static_cast<std::uint64_t>(r.photograph)).add(r.sigma);
      for (const double v : r.albedo) h.add(v);
      for (const Vec2d& v : r.polygon) h.add(v.x()).add(v.y());
    }
    shoot.light_key = h.hex();
    std::vector<std::filesystem::path> outputs{optimize::proxy_albedo_path(folder)};
    const Json info = run_.task("light/" + a.name, shoot.light_key, outputs, [&] {
      const optimize::Scene scene = optimize::load_scene(store, folder);
      return light_json(optimize::solve_acquisition(store, scene, input, options, folder, run_.budget, run_.report));
    });
    shoot.lights = lights_from_json(info);
    for (const std::string& n : shoot.lights.notes) run_.note_both(n);
    for (std::size_t k = 0; k < shoot.lights.own_lights.size(); ++k) {
      const optimize::OwnLight& own = shoot.lights.own_lights[k];
      if (own.exposure != 1)
        run_.note_both(concat(input.names[k], ": ", format_number(own.exposure, 3), " times as bright as the other photographs of its acquisition say; this was taken out before the lights were solved"));
      if (own.ambient != 1) run_.note_both(concat(input.names[k], ": ambient light ", format_number(own.ambient, 3), " times that of the others, corrected"));
    }
    if (shoot.lights.proxy_seen == 0 && input.method != Method::kDirect && input.method != Method::kAdam)
      throw Error(concat("acquisition \"", a.name, "\": no surfel of the cloud is seen well enough by any photograph: ", kNothingSeenHint));
  }

  std::vector<std::string> keys_in_lights(std::size_t lead) const {
    std::map<std::size_t, std::string> keys;
    for (const Shoot& shoot : shoots_)
      if (shoot.lead == lead)
        for (const Photo& p : shoot.photos) keys[p.index_in_lights] = p.gbuffer_key;
    std::vector<std::string> ordered;
    for (const auto& [index, key] : keys) ordered.push_back(key);
    return ordered;
  }

  void solve_albedo(const stream::Store& store, Shoot& shoot) {
    if (shoot.photos.empty()) return;
    const Acquisition& a = *shoot.acquisition;
    const Shoot& lead = shoots_[shoot.lead];
    const std::filesystem::path folder = run_.folder.acquisition(lead.acquisition->name);
    std::unique_ptr<optimize::Scene> scene;   // loaded once, and only if some photograph needs it
    optimize::AlbedoOptions options;
    options.direct_only = run_.project.method == SolveMethod::kDirect;
    for (Photo& photo : shoot.photos) {
      const std::size_t k = photo.index_in_lights;
      if (lead.lights.strangers[k]) {
        run_.leave_out(*photo.input, "it shows something else than the other photographs where they show the same surfaces: another object, or the wrong camera");
        continue;
      }
      Hasher h = keyed("albedo");
      h.add(lead.light_key).add(photo.gbuffer_key).add(photo.radiance_key);
      photo.albedo_key = h.hex();
      const std::filesystem::path pictures = run_.folder.pictures(photo.input->key), raster = run_.folder.albedo(photo.input->key);
      const Json info = run_.task("albedo/" + photo.input->key, photo.albedo_key, {raster, pictures / "albedo.exr", pictures / "sigma.exr", pictures / "light.exr"}, [&] {
        if (!scene) scene = std::make_unique<optimize::Scene>(optimize::load_scene(store, folder));
        options.errors = lead.lights.errors[lead.lights.light_of_photograph[k]];
        const Vec3d flash = photo.camera.pose.world_from_camera(a.flash->offset_in_camera);
        const optimize::AlbedoStats s = optimize::solve_albedo(*scene, run_.observe_input(shoot, photo), lead.lights.lights[lead.lights.light_of_photograph[k]], flash,
                                                               {optimize::gathered_path(folder, k), optimize::floor_flash_path(folder, k), photo.camera.pose.rotation_camera_from_world.transpose() * lead.lights.flash_shift, lead.lights.own_lights[k]}, options, raster, run_.report);
        optimize::write_albedo_pictures(raster, pictures);
        return Json{{"pixels", s.pixels}, {"pixels_solved", s.pixels_solved}, {"pixels_dark", s.pixels_dark}, {"pixels_above_one", s.pixels_above_one}, {"pixels_impossible", s.pixels_impossible}, {"median_sigma", s.median_sigma}};
      });
      run_.record.count("pixels_solved", info["pixels_solved"]);
    }
  }

  void take_colour(Shoot& shoot) {
    for (Photo& photo : shoot.photos) {
      Hasher h = keyed("colour");
      h.add(photo.radiance_key).add(photo.gbuffer_key);
      photo.albedo_key = h.hex();
      const std::filesystem::path pictures = run_.folder.pictures(photo.input->key), raster = run_.folder.albedo(photo.input->key);
      run_.task("colour/" + photo.input->key, photo.albedo_key, {raster, pictures / "albedo.exr"}, [&] {
        optimize::colour_as_albedo(run_.observe_input(shoot, photo), raster, run_.report);
        optimize::write_albedo_pictures(raster, pictures);
        return Json::object();
      });
    }
  }

  RunContext run_;
  std::vector<Shoot> shoots_;
};

}  // namespace

void run_pipeline(const Project& project, const std::filesystem::path& out, MemoryBudget& budget, RunRecord& record, Reporter& report) {
  make_folder(out);
  Pipeline(project, out, budget, record, report).run();
}

}  // namespace chiaro::tools
