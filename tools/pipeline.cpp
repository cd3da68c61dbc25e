#include "tools/pipeline.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <map>
#include <nlohmann/json.hpp>
#include <set>

#include "blend/blend.h"
#include "optimize/acquisition.h"
#include "optimize/albedo.h"
#include "optimize/pictures.h"
#include "stream/base/error.h"
#include "stream/base/file.h"
#include "stream/base/hash.h"
#include "stream/cloud/filtered.h"
#include "stream/photo/camera_files.h"
#include "stream/photo/develop.h"
#include "stream/photo/image_io.h"
#include "stream/photo/raster.h"
#include "stream/store/layer.h"
#include "stream/store/octree_build.h"
#include "surfels/gbuffer.h"
#include "tools/blend_record.h"
#include "tools/camera_record.h"
#include "tools/export_points.h"
#include "tools/ingest.h"
#include "tools/light_spread_json.h"
#include "tools/run_folder.h"
#include "tools/table.h"
#include "tools/task_log.h"

namespace chiaro::tools {
namespace {

using Json = nlohmann::ordered_json;
using optimize::Method;

/// Part of every key: raise it when a stage's result changes for the same inputs.
constexpr std::uint64_t kPipelineVersion = 5;

struct Photo {
  const PhotographInput* input = nullptr;
  std::size_t index_in_acquisition = 0;   ///< of the project, for references
  stream::Camera camera;
  optimize::PixelNoise noise;
  std::size_t index_in_lights = 0;        ///< among all photographs that share their lights
  std::string radiance_key, gbuffer_key, albedo_key;
};

struct Shoot {
  const Acquisition* acquisition = nullptr;
  std::vector<Photo> photos;
  std::size_t lead = 0;                   ///< number of the shoot whose lights these photographs share: most often its own
  double ambient_scale = 1;               ///< shutter time beside the lead's
  bool has_flash() const { return acquisition->flash.has_value(); }
  // Of a lead:
  std::string transport_key, light_key;
  optimize::AcquisitionResult lights;
};

Hasher keyed(std::string_view stage) {
  Hasher h;
  h.add(kPipelineVersion).add(stage);
  return h;
}

Hasher& add_camera(Hasher& h, const stream::Camera& c) {
  const stream::Lens& l = c.lens;
  h.add(static_cast<std::uint64_t>(l.kind)).add(static_cast<std::uint64_t>(l.width_px)).add(static_cast<std::uint64_t>(l.height_px));
  for (const double v : {l.fx, l.fy, l.cx, l.cy, l.skew}) h.add(v);
  for (const double v : l.k) h.add(v);
  for (const double v : l.p) h.add(v);
  for (int i = 0; i < 9; ++i) h.add(c.pose.rotation_camera_from_world.data()[i]);
  for (int i = 0; i < 3; ++i) h.add(c.pose.translation_camera_from_world[i]);
  return h;
}

stream::Encoding develop_encoding(Encoding e) {
  switch (e) {
    case Encoding::kSrgb: return stream::Encoding::kSrgb;
    case Encoding::kRaw: return stream::Encoding::kRaw;
    default: return stream::Encoding::kLinear;
  }
}

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

blend::Gain blend_gain(BlendGain g) {
  switch (g) {
    case BlendGain::kNone: return blend::Gain::kNone;
    case BlendGain::kChannels: return blend::Gain::kChannels;
    case BlendGain::kGrey: break;
  }
  return blend::Gain::kGrey;
}

class Pipeline {
 public:
  Pipeline(const Project& project, const std::filesystem::path& out, MemoryBudget& budget, RunRecord& record, Reporter& report)
      : project_(project), folder_{out}, tasks_(folder_.tasks()), budget_(budget), record_(record), report_(report) {}

  void run() {
    check_flash();
    write_text(folder_.project(), to_json(project_) + "\n");
    for (const std::string& note : project_.notes) note_both(note);
    ingest();
    read_all_cameras();
    const stream::Store store(folder_.store());
    count_points(store);
    for (Shoot& shoot : shoots_) {
      develop(shoot);
      raycast(store, shoot);
      if (project_.method == SolveMethod::kNone) take_colour(shoot);
    }
    if (project_.method != SolveMethod::kNone) {
      for (std::size_t i = 0; i < shoots_.size(); ++i)
        if (shoots_[i].lead == i) solve_lights(store, i);
      for (Shoot& shoot : shoots_)
        if (shoot.has_flash()) solve_albedo(store, shoot);
    }
    write_lights();
    blend(store);
    residuals(store);
    for (const ExportInput& e : project_.exports) export_layer(store, e);
    std::error_code code;
    std::filesystem::remove_all(folder_.scratch(), code);
  }

 private:
  void note_both(const std::string& text) {
    report_.note(text);
    record_.note(text);
  }

  /// Runs a task and enters it in the record.
  Json task(const std::string& name, const std::string& key, const std::vector<std::filesystem::path>& outputs, const std::function<Json()>& body) {
    report_.check();
    const TaskOutcome outcome = tasks_.run(name, key, outputs, [&] { return body().dump(); });
    record_.stage(name, outcome.reused ? 0.0 : outcome.seconds, outcome.reused);
    return Json::parse(outcome.info_json);
  }

  void check_flash() const {
    if (project_.method == SolveMethod::kNone) return;
    for (const Acquisition& a : project_.acquisitions)
      if (a.role == AcquisitionRole::kFlash && !a.flash)
        throw UsageError(concat(project_.file.filename().string(), ": acquisition \"", a.name,
                                "\" has no [acquisition.flash]: without a known flash there is no albedo. Set solve.method = \"none\" to blend the photographs' own colour"));
  }

  void ingest() {
    const IngestPlan plan = plan_ingest(project_);
    const Json info = task("ingest", plan.key, {folder_.store()}, [&] {
      const IngestOutcome outcome = ingest_cloud(plan, folder_.store(), budget_, report_);
      return Json{{"store_key", outcome.store_key}, {"notes", outcome.notes}};
    });
    for (const auto& n : info.value("notes", Json::array())) record_.note(n.get<std::string>());
    for (const auto& file : project_.cloud.files) record_.input(file, file_fingerprint(file));
  }

  void count_points(const stream::Store& store) {
    const stream::Manifest& m = store.manifest();
    store_key_ = m.key;
    record_.count("points_in", m.points_read);
    record_.count("points_stored", m.points_stored);
    for (const auto& [reason, n] : m.points_rejected) {
      record_.count("points_rejected", n);
      // Outliers are left out because the project asks for it: counted, but nothing is missing.
      if (n > 0 && reason != stream::OutlierMarks::kReason) record_.left_out("points", "cloud", reason, n);
    }
  }

  void read_all_cameras() {
    for (const Acquisition& a : project_.acquisitions) {
      Shoot shoot;
      shoot.acquisition = &a;
      shoot.lead = a.lights_of.value_or(shoots_.size());
      if (a.lights_of && a.exposure_s) shoot.ambient_scale = *a.exposure_s / *project_.acquisitions[*a.lights_of].exposure_s;
      if (a.role == AcquisitionRole::kNoFlash && project_.method == SolveMethod::kNone) {
        for (const PhotographInput& p : a.photographs) leave_out(p, "taken without flash, and no light is solved");
        shoots_.push_back(std::move(shoot));
        continue;
      }
      std::vector<std::string> notes;
      const std::vector<stream::Camera> cameras = stream::read_cameras(a.cameras, notes);
      for (const std::string& n : notes) note_both(n);
      for (std::size_t i = 0; i < a.photographs.size(); ++i) {
        const PhotographInput& p = a.photographs[i];
        const stream::Camera* camera = stream::find_camera(cameras, p.file.string());
        if (!camera) {
          leave_out(p, concat("no camera in ", a.cameras.filename().string()));
          continue;
        }
        Photo photo;
        photo.input = &p;
        photo.index_in_acquisition = i;
        photo.camera = *camera;
        photo.camera.photograph = p.key;
        shoot.photos.push_back(std::move(photo));
      }
      shoots_.push_back(std::move(shoot));
    }
    require_photographs();
  }

  void leave_out(const PhotographInput& p, const std::string& reason) {
    report_.note(concat(p.file.filename().string(), ": left out: ", reason));
    record_.left_out("photograph", p.key, reason);
  }

  void require_photographs() const {
    if (std::all_of(shoots_.begin(), shoots_.end(), [](const Shoot& s) { return s.photos.empty(); }))
      throw Error("no photograph is left to work with: see the notes above for what each one lacks");
  }

  void develop(Shoot& shoot) {
    const Acquisition& a = *shoot.acquisition;
    std::vector<Photo> kept;
    for (Photo& photo : shoot.photos) {
      try {
        develop_one(a, photo);
        kept.push_back(std::move(photo));
      } catch (const UsageError&) {
        throw;
      } catch (const Error& e) {
        // A photograph that cannot be read is left out and named; a disk or memory that is full stops the run.
        if (std::string_view(e.what()).find("no space left") != std::string_view::npos || std::string_view(e.what()).find("memory budget") != std::string_view::npos) throw;
        leave_out(*photo.input, e.what());
      }
    }
    shoot.photos = std::move(kept);
    require_photographs();
  }

  void develop_one(const Acquisition& a, Photo& photo) {
    const PhotographInput& p = *photo.input;
    const std::string fingerprint = file_fingerprint(p.file);
    Hasher h = keyed("develop");
    h.add(fingerprint).add(static_cast<std::uint64_t>(a.encoding));
    h.add(p.mask.empty() ? std::string("-") : file_fingerprint(p.mask));
    h.add(a.noise ? a.noise->gain : -1.0).add(a.noise ? a.noise->read_sigma : -1.0);
    photo.radiance_key = h.hex();
    const Json info = task("develop/" + p.key, photo.radiance_key, {folder_.radiance(p.key)}, [&] {
      stream::DevelopOptions options;
      options.encoding = develop_encoding(a.encoding);
      if (!p.mask.empty()) options.mask = p.mask;
      if (a.noise) options.noise = stream::NoiseModel{a.noise->gain, a.noise->read_sigma, false};
      const stream::DevelopResult r = stream::develop(p.file, options, folder_.radiance(p.key), report_);
      return Json{{"width", r.width_px}, {"height", r.height_px}, {"noise_gain", r.noise.gain}, {"noise_read_sigma", r.noise.read_sigma}, {"noise_estimated", r.noise.estimated},
                  {"pixels_used", r.pixels_used}, {"pixels_masked", r.pixels_masked}, {"pixels_saturated", r.pixels_saturated}, {"pixels_not_finite", r.pixels_not_finite},
                  {"notes", r.notes}};
    });
    record_.input(p.file, fingerprint);
    for (const auto& n : info["notes"]) record_.note(n.get<std::string>());
    if (info["pixels_used"] == 0) throw Error("no usable pixel: everything is masked, saturated or not finite");
    photo.noise = {info["noise_gain"], info["noise_read_sigma"]};
    photo.camera.lens = stream::scaled_to(photo.camera.lens, info["width"], info["height"], p.file.string());
  }

  void raycast(const stream::Store& store, Shoot& shoot) {
    const Acquisition& a = *shoot.acquisition;
    std::vector<Photo> kept;
    for (Photo& photo : shoot.photos) {
      surfels::GBufferOptions options;
      if (project_.method != SolveMethod::kNone && shoot.has_flash()) options.flash_in_camera = a.flash->offset_in_camera;
      options.mask_raster = folder_.radiance(photo.input->key);
      Hasher h = keyed("raycast");
      h.add(store_key_).add(photo.radiance_key);
      add_camera(h, photo.camera);
      h.add(static_cast<std::uint64_t>(options.subpixels)).add(options.cut.pixel_error);
      h.add(options.flash_in_camera ? std::uint64_t{1} : std::uint64_t{0});
      if (options.flash_in_camera)
        for (int i = 0; i < 3; ++i) h.add((*options.flash_in_camera)[i]);
      photo.gbuffer_key = h.hex();
      const Json info = task("raycast/" + photo.input->key, photo.gbuffer_key, {folder_.gbuffer(photo.input->key)}, [&] {
        const surfels::GBufferStats s = surfels::write_gbuffer(store, photo.camera, options, folder_.gbuffer(photo.input->key), budget_, report_);
        return Json{{"pixels", s.pixels}, {"pixels_hit", s.pixels_hit}, {"rays", s.rays}, {"shadow_rays", s.shadow_rays}, {"surfels", s.surfels},
                    {"chunks", s.chunks}, {"chunks_hidden", s.chunks_hidden}, {"tiles", s.tiles}};
      });
      if (info["pixels_hit"] == 0) {
        leave_out(*photo.input, "it sees nothing of the cloud");
        continue;
      }
      record_.count("rays_primary", info["rays"]);
      record_.count("rays_shadow", info["shadow_rays"]);
      kept.push_back(std::move(photo));
    }
    shoot.photos = std::move(kept);
    require_photographs();
  }

  optimize::ObserveInput observe_input(const Shoot& shoot, const Photo& p) const {
    optimize::ObserveInput input{p.camera, folder_.radiance(p.input->key), folder_.gbuffer(p.input->key), p.noise, {}, shoot.ambient_scale};
    if (shoot.has_flash()) input.flash_in_camera = shoot.acquisition->flash->offset_in_camera;
    return input;
  }

  /// All photographs that share the lights of a lead, its own first.
  optimize::AcquisitionInput acquisition_input(std::size_t lead) {
    const Acquisition& a = *shoots_[lead].acquisition;
    optimize::AcquisitionInput input;
    input.intensity_range = a.flash->intensity_range;
    input.sky = sky_model(a.ambient);
    input.try_floor = a.floor != FloorModel::kNone;
    input.floor_plane = a.floor_plane;
    input.method = solve_method(project_.method);
    std::vector<Shoot*> shoots{&shoots_[lead]};
    for (std::size_t i = 0; i < shoots_.size(); ++i)
      if (i != lead && shoots_[i].lead == lead) shoots.push_back(&shoots_[i]);
    for (Shoot* shoot : shoots)
      for (Photo& photo : shoot->photos) {
        photo.index_in_lights = input.photographs.size();
        for (const ReferenceInput& r : shoot->acquisition->references)
          if (r.photograph == photo.index_in_acquisition) input.references.push_back({photo.index_in_lights, r.polygon, r.albedo, r.sigma});
        input.photographs.push_back(observe_input(*shoot, photo));
        input.names.push_back(photo.input->key);
        record_.count(shoot->has_flash() ? "photographs_with_flash" : "photographs_without_flash", 1);
      }
    return input;
  }

  void solve_lights(const stream::Store& store, std::size_t lead) {
    Shoot& shoot = shoots_[lead];
    const Acquisition& a = *shoot.acquisition;
    const optimize::AcquisitionInput input = acquisition_input(lead);
    if (std::none_of(input.photographs.begin(), input.photographs.end(), [](const optimize::ObserveInput& p) { return p.flash_in_camera.has_value(); })) return;
    optimize::AcquisitionOptions options;
    options.seed = project_.seed;
    options.max_proxy_surfels = std::min(options.max_proxy_surfels, std::max<std::uint64_t>(2000, optimize::proxy_surfels_within(budget_.limit_bytes() / 2, options.rays)));
    const std::filesystem::path folder = folder_.acquisition(a.name);
    make_folder(folder);
    Hasher h = keyed("gather");
    h.add(options.seed).add(options.proxy_surfels).add(options.max_proxy_surfels).add(static_cast<std::uint64_t>(options.rays));
    for (const std::string& key : keys_in_lights(lead)) h.add(key);
    h.add(std::uint64_t{input.try_floor});
    if (input.floor_plane)
      for (const double v : *input.floor_plane) h.add(v);
    shoot.transport_key = h.hex();
    task("gather/" + a.name, shoot.transport_key, {folder / "proxy.bin", folder / "transport.bin", folder / "floor.bin"}, [&] {
      optimize::gather_scene(store, input, options, folder, budget_, report_);
      return Json::object();
    });
    h.add("light").add(static_cast<std::uint64_t>(input.method)).add(static_cast<std::uint64_t>(input.sky)).add(static_cast<std::uint64_t>(options.light_samples));
    for (const optimize::ObserveInput& p : input.photographs) h.add(p.noise.gain).add(p.noise.read_sigma).add(p.ambient_scale);
    if (input.intensity_range) h.add((*input.intensity_range)[0]).add((*input.intensity_range)[1]);
    for (const auto& r : input.references) {
      h.add(static_cast<std::uint64_t>(r.photograph)).add(r.sigma);
      for (const double v : r.albedo) h.add(v);
      for (const Vec2d& v : r.polygon) h.add(v.x()).add(v.y());
    }
    shoot.light_key = h.hex();
    std::vector<std::filesystem::path> outputs{optimize::proxy_albedo_path(folder)};
    const Json info = task("light/" + a.name, shoot.light_key, outputs, [&] {
      const optimize::Scene scene = optimize::load_scene(store, folder);
      return light_json(optimize::solve_acquisition(store, scene, input, options, folder, budget_, report_));
    });
    shoot.lights = lights_from_json(info);
    for (const std::string& n : shoot.lights.notes) note_both(n);
    for (std::size_t k = 0; k < shoot.lights.exposures.size(); ++k)
      if (const double e = shoot.lights.exposures[k]; e != 1)
        note_both(concat(input.names[k], ": ", format_number(e, 3), " times as bright as the other photographs of its acquisition say; this was taken out before the lights were solved"));
    if (shoot.lights.proxy_seen == 0 && input.method != Method::kDirect && input.method != Method::kAdam)
      throw Error(concat("acquisition \"", a.name, "\": no surfel of the cloud is seen well enough by any photograph; are cameras and cloud in the same frame?"));
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

  static Json evidence_json(const std::vector<optimize::SkyEvidence>& evidence) {
    Json all = Json::array();
    for (const optimize::SkyEvidence& e : evidence) all.push_back({{"model", e.model}, {"parameters", e.parameters}, {"criterion", e.criterion}});
    return all;
  }

  static Json error_json(const optimize::ErrorModel& e) {
    return {{"normal_rad", e.normal_rad}, {"registration_px", e.registration_px}, {"other_light", e.other_light}, {"spread", e.spread}, {"rest", e.rest}, {"estimated", e.estimated}};
  }

  static Json light_json(const optimize::AcquisitionResult& r) {
    Json lights = Json::array();
    for (const optimize::LightSolution& s : r.lights) {
      Json covariance = Json::array();
      for (Eigen::Index i = 0; i < s.covariance.rows(); ++i) {
        Json row = Json::array();
        for (Eigen::Index j = 0; j < s.covariance.cols(); ++j) row.push_back(s.covariance(i, j));
        covariance.push_back(row);
      }
      lights.push_back({{"flash_intensity", s.lights.flash_intensity}, {"sky", s.lights.sky}, {"sky_colour", s.lights.sky_colour}, {"bounce", s.lights.bounce},
                        {"sky_terms", s.sky_terms}, {"sky_coloured", s.sky_colour}, {"floor", s.lights.floor}, {"floor_albedo", s.lights.floor_albedo}, {"covariance", covariance}, {"scatter", s.scatter},
                        {"groups", s.groups}, {"samples", s.samples}, {"iterations", s.iterations}, {"converged", s.converged}, {"scale_known", s.scale_known}});
    }
    Json errors = Json::array();
    for (const optimize::ErrorModel& e : r.errors) errors.push_back(error_json(e));
    return {{"sky_evidence", evidence_json(r.sky_evidence)}, {"lights", lights}, {"errors", errors}, {"light_of_photograph", r.light_of_photograph}, {"exposures", r.exposures}, {"strangers", r.strangers}, {"flash_shift", {r.flash_shift[0], r.flash_shift[1], r.flash_shift[2]}}, {"proxy_surfels", r.proxy_surfels}, {"proxy_seen", r.proxy_seen}, {"back_share", r.back_share},
            {"outer_iterations", r.outer_iterations}, {"last_change", r.last_change}, {"sky_model", r.sky_model}, {"notes", r.notes}};
  }

  static optimize::AcquisitionResult lights_from_json(const Json& j) {
    optimize::AcquisitionResult r;
    for (const Json& l : j["lights"]) {
      optimize::LightSolution s;
      s.lights.flash_intensity = l["flash_intensity"];
      s.lights.sky = l["sky"];
      s.lights.sky_colour = l["sky_colour"];
      s.sky_terms = l["sky_terms"];
      s.sky_colour = l["sky_coloured"];
      s.lights.floor = l["floor"];
      s.lights.floor_albedo = l["floor_albedo"];
      s.lights.bounce = l["bounce"];
      const auto n = static_cast<Eigen::Index>(l["covariance"].size());
      s.covariance.resize(n, n);
      for (Eigen::Index i = 0; i < n; ++i)
        for (Eigen::Index k = 0; k < n; ++k) s.covariance(i, k) = l["covariance"][static_cast<std::size_t>(i)][static_cast<std::size_t>(k)];
      s.scatter = l["scatter"];
      s.groups = l["groups"];
      s.samples = l["samples"];
      s.iterations = l["iterations"];
      s.converged = l["converged"];
      s.scale_known = l["scale_known"];
      r.lights.push_back(s);
    }
    for (const Json& e : j["sky_evidence"]) r.sky_evidence.push_back({e["model"].get<std::string>(), e["parameters"].get<int>(), e["criterion"].get<double>()});
    for (const Json& e : j["errors"]) r.errors.push_back({e["normal_rad"], e["registration_px"], e["other_light"], e["spread"], e["rest"], e["estimated"]});
    r.light_of_photograph = j["light_of_photograph"].get<std::vector<std::size_t>>();
    r.exposures = j["exposures"].get<std::vector<double>>();
    r.strangers = j["strangers"].get<std::vector<bool>>();
    for (int i = 0; i < 3; ++i) r.flash_shift[i] = j["flash_shift"][static_cast<std::size_t>(i)];
    r.proxy_surfels = j["proxy_surfels"];
    r.proxy_seen = j["proxy_seen"];
    r.back_share = j["back_share"];
    r.outer_iterations = j["outer_iterations"];
    r.last_change = j["last_change"];
    r.sky_model = j["sky_model"];
    r.notes = j["notes"].get<std::vector<std::string>>();
    return r;
  }

  void solve_albedo(const stream::Store& store, Shoot& shoot) {
    if (shoot.photos.empty()) return;
    const Acquisition& a = *shoot.acquisition;
    const Shoot& lead = shoots_[shoot.lead];
    const std::filesystem::path folder = folder_.acquisition(lead.acquisition->name);
    std::unique_ptr<optimize::Scene> scene;   // loaded once, and only if some photograph needs it
    optimize::AlbedoOptions options;
    options.direct_only = project_.method == SolveMethod::kDirect;
    for (Photo& photo : shoot.photos) {
      const std::size_t k = photo.index_in_lights;
      if (lead.lights.strangers[k]) {
        leave_out(*photo.input, "it shows something else than the other photographs where they show the same surfaces: another object, or the wrong camera");
        continue;
      }
      Hasher h = keyed("albedo");
      h.add(lead.light_key).add(photo.gbuffer_key).add(photo.radiance_key);
      photo.albedo_key = h.hex();
      const std::filesystem::path pictures = folder_.pictures(photo.input->key), raster = folder_.albedo(photo.input->key);
      const Json info = task("albedo/" + photo.input->key, photo.albedo_key, {raster, pictures / "albedo.exr", pictures / "sigma.exr", pictures / "light.exr"}, [&] {
        if (!scene) scene = std::make_unique<optimize::Scene>(optimize::load_scene(store, folder));
        options.errors = lead.lights.errors[lead.lights.light_of_photograph[k]];
        const Vec3d flash = photo.camera.pose.world_from_camera(a.flash->offset_in_camera);
        const optimize::AlbedoStats s = optimize::solve_albedo(*scene, observe_input(shoot, photo), lead.lights.lights[lead.lights.light_of_photograph[k]], flash,
                                                               {optimize::gathered_path(folder, k), optimize::floor_flash_path(folder, k), photo.camera.pose.rotation_camera_from_world.transpose() * lead.lights.flash_shift, lead.lights.exposures[k]}, options, raster, report_);
        optimize::write_albedo_pictures(raster, pictures);
        return Json{{"pixels", s.pixels}, {"pixels_solved", s.pixels_solved}, {"pixels_dark", s.pixels_dark}, {"pixels_above_one", s.pixels_above_one}, {"pixels_impossible", s.pixels_impossible}, {"median_sigma", s.median_sigma}};
      });
      record_.count("pixels_solved", info["pixels_solved"]);
    }
  }

  void take_colour(Shoot& shoot) {
    for (Photo& photo : shoot.photos) {
      Hasher h = keyed("colour");
      h.add(photo.radiance_key).add(photo.gbuffer_key);
      photo.albedo_key = h.hex();
      const std::filesystem::path pictures = folder_.pictures(photo.input->key), raster = folder_.albedo(photo.input->key);
      task("colour/" + photo.input->key, photo.albedo_key, {raster, pictures / "albedo.exr"}, [&] {
        optimize::colour_as_albedo(observe_input(shoot, photo), raster, report_);
        optimize::write_albedo_pictures(raster, pictures);
        return Json::object();
      });
    }
  }

  void write_lights() {
    Json all = Json::array();
    for (const Shoot& shoot : shoots_) {
      Json a{{"acquisition", shoot.acquisition->name}, {"method", name_of(project_.method)}};
      if (project_.method == SolveMethod::kNone) {
        a["how"] = "photographs taken as the colour itself; no light was solved";
      } else if (!shoot.has_flash()) {
        a["lights_of"] = shoots_[shoot.lead].acquisition->name;
        a["how"] = concat("taken without flash: measures the ambient light of \"", shoots_[shoot.lead].acquisition->name, "\"");
      } else {
        if (&shoot != &shoots_[shoot.lead]) a["lights_of"] = shoots_[shoot.lead].acquisition->name;
        describe_lights(shoot, a);
      }
      all.push_back(a);
    }
    write_text(folder_.lights(), Json{{"acquisitions", all}}.dump(1) + "\n");
  }

  void describe_lights(const Shoot& shoot, Json& a) const {
    const optimize::AcquisitionResult& lights = shoots_[shoot.lead].lights;
    const auto one = [&](const optimize::LightSolution& s, const optimize::ErrorModel& errors) {
      const double ln_sd = s.covariance.rows() > 0 ? std::sqrt(std::max(0.0, s.covariance(0, 0))) : 0;
      const int sky = s.sky_terms;
      const double ambient_sd = sky > 0 ? std::sqrt(std::max(0.0, s.covariance(1, 1))) : 0;
      std::vector<std::string> names{"ln_flash_intensity"};
      for (int k = 0; k < sky; ++k) names.push_back("sky_" + std::to_string(k));
      if (s.sky_colour) names.insert(names.end(), {"ln_sky_red", "ln_sky_blue"});
      if (s.lights.floor) names.push_back("floor_albedo");
      names.push_back("bounce");
      Json covariance = Json::array();
      for (Eigen::Index i = 0; i < s.covariance.rows(); ++i) {
        Json row = Json::array();
        for (Eigen::Index j = 0; j < s.covariance.cols(); ++j) row.push_back(s.covariance(i, j));
        covariance.push_back(row);
      }
      Json found{{"flash_intensity", s.lights.flash_intensity}, {"flash_intensity_sd", ln_sd * s.lights.flash_intensity},
                  {"ambient", s.lights.sky[0]}, {"ambient_sd", ambient_sd}, {"sky", s.lights.sky},
                  {"sky_colour", s.lights.sky_colour}, {"sky_basis", "1, y, z, x, xy, yz, 3z^2-1, xz, x^2-y^2 of the world direction"}, {"bounce", s.lights.bounce},
                  {"covariance_of", names}, {"covariance", covariance},
                  {"allowed", {{"flash_intensity", {s.lights.flash_intensity * std::exp(-2 * ln_sd), s.lights.flash_intensity * std::exp(2 * ln_sd)}},
                               {"ambient", {std::max(0.0, s.lights.sky[0] - 2 * ambient_sd), s.lights.sky[0] + 2 * ambient_sd}}}},
                  {"absolute_scale", s.scale_known ? "calibrated" : "from interreflections and a guess of the brightest albedo: trust ratios, not the scale"},
                  {"scatter_of_ln_albedo", s.scatter}, {"samples", s.samples}, {"converged", s.converged}};
      found["errors"] = error_json(errors);
      found["open_direction"] = to_json(light_spread(s));
      if (s.lights.floor) found["floor_albedo"] = s.lights.floor_albedo;
      return found;
    };
    a["sky_model"] = lights.sky_model;
    if (!lights.sky_evidence.empty()) a["sky_evidence"] = evidence_json(lights.sky_evidence);
    a["proxy_surfels"] = lights.proxy_surfels;
    for (const Photo& p : shoot.photos)
      if (lights.exposures.size() > p.index_in_lights && lights.exposures[p.index_in_lights] != 1) a["exposures"][p.input->key] = lights.exposures[p.index_in_lights];
    if (const Vec3d& shift = lights.flash_shift; !shift.isZero()) a["flash_shift_m"] = {shift[0], shift[1], shift[2]};
    a["how"] = how_found(shoot);
    const Acquisition& input = *shoot.acquisition;
    if (input.flash->intensity_range) a["calibrated_range"] = *input.flash->intensity_range;
    a["references"] = input.references.size();
    if (lights.lights.size() == 1) {
      a.update(one(lights.lights[0], lights.errors[0]));
      return;
    }
    Json each = Json::array();
    for (std::size_t k = 0; k < shoot.photos.size() && !lights.lights.empty(); ++k) {
      Json j{{"photograph", shoot.photos[k].input->key}};
      const std::size_t which = lights.light_of_photograph[shoot.photos[k].index_in_lights];
      j.update(one(lights.lights[which], lights.errors[which]));
      each.push_back(j);
    }
    a["photographs"] = each;
  }

  std::string how_found(const Shoot& shoot) const {
    std::size_t n = 0, without_flash = 0;
    for (const Shoot& other : shoots_)
      if (other.lead == shoot.lead) (other.has_flash() ? n : without_flash) += other.photos.size();
    const std::string dark = without_flash > 0 ? concat(" and ", without_flash, " without flash") : std::string();
    switch (project_.method) {
      case SolveMethod::kJoint:
        return n + without_flash > 1 ? concat("jointly over ", n, " photographs", dark, ": log ratios of surfels seen at least twice") : std::string("one photograph: log ratios of pairs of surfels of like chroma");
      case SolveMethod::kSingle:
        if (without_flash > 0) return concat("each photograph by itself", dark, ": log ratios of surfels seen at least twice");
        return "each photograph by itself: log ratios of pairs of surfels of like chroma";
      case SolveMethod::kAdam: return "each photograph by itself: one-dimensional search of the flash, then Adam over albedo, flash and ambient; the result depends on its start";
      case SolveMethod::kDirect: return "not solved: the middle of the calibrated range, no ambient, no bounces";
      case SolveMethod::kNone: break;
    }
    return "";
  }

  double shared_sigma() const {
    // Lights enter the shared plane of every photograph already; nothing is added here.
    return 0;
  }

  void blend(const stream::Store& store) {
    std::vector<blend::BlendPhotograph> photographs;
    Hasher h = keyed("blend 4");
    h.add(store_key_);
    for (const Shoot& shoot : shoots_)
      for (const Photo& p : shoot.photos) {
        if (p.albedo_key.empty()) continue;   // without flash
        photographs.push_back({p.input->key, p.camera, folder_.gbuffer(p.input->key), folder_.albedo(p.input->key), folder_.radiance(p.input->key)});
        h.add(p.albedo_key).add(p.input->key);
      }
    h.add(std::uint64_t{project_.blend.reject}).add(static_cast<std::uint64_t>(project_.blend.gain)).add(std::uint64_t{project_.blend.align});
    record_.count("photographs_used", photographs.size());
    layer_key_ = h.hex();
    const Json info = task("blend", layer_key_, {folder_.store() / "layers" / "albedo"}, [&] {
      blend::BlendOptions options;
      options.shared_sigma = shared_sigma();
      options.reject = project_.blend.reject;
      options.align = project_.blend.align;
      options.gain = blend_gain(project_.blend.gain);
      options.provenance_json = Json{{"method", name_of(project_.method)}, {"key", layer_key_}, {"photographs", photographs.size()}}.dump();
      make_folder(folder_.scratch());
      const blend::BlendStats s = blend::blend(store, photographs, options, folder_.scratch(), budget_, report_);
      return Json::parse(blend_record_json(s, photographs));
    });
    record_.count("points_seen", info["points_seen"]);
    record_.count("points_unseen", info["points"].get<std::uint64_t>() - info["points_seen"].get<std::uint64_t>());
    record_.count("points_disputed", info["points_disputed"]);
    record_.count("samples", info["samples"]);
    for (const auto& n : info["notes"]) note_both(n.get<std::string>());
    record_.set("blending", info.dump());
    record_cameras(info["photographs"]);
  }

  /// Of the photographs that are in the result; `found`: what blending says of each, in the same order.
  void record_cameras(const Json& found) const {
    std::vector<PhotographCamera> cameras;
    for (const Shoot& shoot : shoots_)
      for (const Photo& p : shoot.photos) {
        if (p.albedo_key.empty()) continue;
        const Json& blended = found.at(cameras.size());
        PhotographCamera c{shoot.acquisition->name, p.camera, {}, blended.at("gain").get<std::array<double, 3>>()};
        if (shoot.has_flash()) c.flash_in_camera = shoot.acquisition->flash->offset_in_camera;
        if (blended.contains("shift_corrected_px")) {
          c.shift_px = blended["shift_corrected_px"].get<std::array<double, 2>>();
          c.trust = blended["trust"];
        }
        cameras.push_back(std::move(c));
      }
    write_camera_record(folder_.cameras(), cameras);
  }

  void residuals(const stream::Store& store) {
    for (const Shoot& shoot : shoots_)
      for (const Photo& p : shoot.photos) {
        if (p.albedo_key.empty()) continue;
        Hasher h = keyed("residual");
        h.add(layer_key_).add(p.albedo_key);
        const std::filesystem::path picture = folder_.pictures(p.input->key) / "residual.exr";
        task("residual/" + p.input->key, h.hex(), {picture}, [&] {
          const stream::Layer layer(store, "albedo");
          const double rms = optimize::write_residual(store, layer, observe_input(shoot, p), folder_.albedo(p.input->key), picture, report_);
          return Json{{"relative_rms", rms}};
        });
      }
  }

  void export_layer(const stream::Store& store, const ExportInput& e) {
    const std::filesystem::path file = folder_.root / e.file;
    Hasher h = keyed("export");
    h.add(layer_key_).add(e.file).add(std::uint64_t{e.fill});
    const Json info = task("export/" + e.file, h.hex(), {file}, [&] {
      ExportOptions options;
      options.file = file;
      options.fill = e.fill;
      make_folder(folder_.scratch());
      const ExportStats s = export_points(store, options, folder_.scratch(), budget_, report_);
      return Json{{"points", s.points}, {"points_unseen", s.points_unseen}, {"points_filled", s.points_filled}, {"positions_from_store", s.positions_from_store}};
    });
    record_.count("points_out", info["points"]);
  }

  const Project& project_;
  const RunFolder folder_;
  const TaskLog tasks_;
  MemoryBudget& budget_;
  RunRecord& record_;
  Reporter& report_;
  std::string store_key_, layer_key_;
  std::vector<Shoot> shoots_;
};

}  // namespace

void run_pipeline(const Project& project, const std::filesystem::path& out, MemoryBudget& budget, RunRecord& record, Reporter& report) {
  make_folder(out);
  Pipeline(project, out, budget, record, report).run();
}

}  // namespace chiaro::tools
