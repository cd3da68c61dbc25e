#include "tools/run_layer.h"

#include <algorithm>
#include <optional>
#include <nlohmann/json.hpp>

#include "blend/blend.h"
#include "optimize/pictures.h"
#include "stream/base/error.h"
#include "stream/base/file.h"
#include "stream/base/hash.h"
#include "stream/store/layer.h"
#include "tools/blend_record.h"
#include "tools/camera_record.h"
#include "tools/export_points.h"
#include "tools/run_context_json.h"
#include "tools/run_refine_json.h"

namespace chiaro::tools {
namespace {
using Json = nlohmann::ordered_json;

blend::Gain blend_gain(BlendGain g) {
  switch (g) {
    case BlendGain::kNone: return blend::Gain::kNone;
    case BlendGain::kChannels: return blend::Gain::kChannels;
    case BlendGain::kGrey: break;
  }
  return blend::Gain::kGrey;
}

struct AlbedoLevel {
  double median = 0, high = 0;   ///< of the points' largest channel: in the middle, and what a twentieth is above
};

/// Of the root of the tree, whose surfels are means over all of the cloud. nullopt: nothing there is seen.
std::optional<AlbedoLevel> albedo_level(const stream::Store& store, const std::string& layer) {
  std::vector<float> values;
  for (const Vec3f& albedo : stream::read_albedo(stream::Layer(store, layer), store, 0).albedo)
    if (albedo.allFinite()) values.push_back(albedo.maxCoeff());
  if (values.empty()) return std::nullopt;
  const auto at = [&](double share) {
    const auto place = values.begin() + static_cast<std::ptrdiff_t>(share * static_cast<double>(values.size() - 1));
    std::nth_element(values.begin(), place, values.end());
    return static_cast<double>(*place);
  };
  return AlbedoLevel{at(0.5), at(0.95)};
}

class LayerStages {
 public:
  LayerStages(RunContext& run, const std::vector<Shoot>& shoots) : run_(run), shoots_(shoots) {}

  void blend(const stream::Store& store) {
    std::vector<blend::BlendPhotograph> photographs;
    std::vector<int> cells_px;
    blend::BlendOptions options;
    Hasher h = keyed("blend 11");
    h.add(store.manifest().key);
    for (const Shoot& shoot : shoots_)
      for (const Photo& p : shoot.photos) {
        if (p.albedo_key.empty()) continue;   // without flash
        photographs.push_back({p.input->key, p.camera, run_.folder.gbuffer(p.input->key), run_.folder.albedo(p.input->key), run_.folder.radiance(p.input->key)});
        cells_px.push_back(p.binning);
        h.add(p.albedo_key).add(p.input->key);
      }
    h.add(std::uint64_t{run_.project.blend.reject}).add(static_cast<std::uint64_t>(run_.project.blend.gain)).add(std::uint64_t{run_.project.blend.align}).add(std::uint64_t{denoises()});
    if (run_.project.blend.bands != 2) h.add("bands").add(static_cast<std::uint64_t>(run_.project.blend.bands));
    run_.record.count("photographs_used", photographs.size());
    layer_key_ = h.hex();
    const std::string layer = run_.project.blend.layer;
    prepare_kept(layer);
    if (another_lies_there(store)) run_.tasks.forget(RunFolder::blend_task(layer));
    options.layer = layer;
    options.bands = run_.project.blend.bands;
    options.reject = run_.project.blend.reject;
    options.align = run_.project.blend.align;
    options.denoise = denoises();
    options.gain = blend_gain(run_.project.blend.gain);
    const Json info = run_.task(RunFolder::blend_task(layer), task_key(), {run_.folder.store() / "layers" / layer}, [&] {
      if (run_.project.blend.keep) options.keep = run_.folder.kept(layer);
      options.provenance_json = Json{{"method", name_of(run_.project.method)}, {"key", layer_key_}, {"photographs", photographs.size()}, {"acquisitions", acquisitions()}}.dump();
      make_folder(run_.folder.scratch());
      const blend::BlendStats s = blend::blend(store, photographs, options, run_.folder.scratch(), run_.budget, run_.report);
      return Json::parse(blend_record_json(s, photographs, cells_px));
    });
    if (info["points_seen"] == 0)
      throw Error(concat("no point of the cloud is seen by any photograph from its front, near enough and inside masks: ", kNothingSeenHint));
    run_.record.count("points_seen", info["points_seen"]);
    run_.record.count("points_unseen", info["points"].get<std::uint64_t>() - info["points_seen"].get<std::uint64_t>());
    run_.record.count("points_disputed", info["points_disputed"]);
    run_.record.count("samples", info["samples"]);
    for (const auto& n : info["notes"]) run_.note_both(n.get<std::string>());
    run_.record.set("blending", info.dump());
    record_cameras(info["photographs"]);
    record_layers(store);
    note_implausible_level(store);
    options.keep.clear();
    inserted_key_ = refine_run_layer(run_, store, photographs, std::move(options), {layer_key_, info});
  }

  void residuals(const stream::Store& store) {
    for (const Shoot& shoot : shoots_)
      for (const Photo& p : shoot.photos) {
        if (p.albedo_key.empty()) continue;
        Hasher h = keyed("residual");
        h.add(layer_key_).add(p.albedo_key);
        const std::filesystem::path picture = run_.folder.pictures(p.input->key) / "residual.exr";
        run_.task("residual/" + p.input->key, h.hex(), {picture}, [&] {
          const stream::Layer layer(store, run_.project.blend.layer);
          const double rms = optimize::write_residual(store, layer, run_.observe_input(shoot, p), run_.folder.albedo(p.input->key), picture, run_.report);
          return Json{{"relative_rms", rms}};
        });
      }
  }

  void export_layer(const stream::Store& store, const ExportInput& e) {
    const std::filesystem::path file = run_.folder.root / e.file;
    const std::string task = "export/" + e.file;
    Hasher h = keyed("export 2");
    h.add(run_.project.blend.layer).add(layer_key_).add(e.file).add(std::uint64_t{e.fill});
    if (!inserted_key_.empty()) h.add(inserted_key_);
    forget_if_replaced(task, file);
    const Json info = run_.task(task, h.hex(), {file}, [&] {
      ExportOptions options;
      options.file = file;
      options.layer = run_.project.blend.layer;
      options.fill = e.fill;
      options.sources = run_.project.cloud.files;   // the folder may have moved since the store was made
      make_folder(run_.folder.scratch());
      const ExportStats s = export_points(store, options, run_.folder.scratch(), run_.budget, run_.report);
      return Json{{"points", s.points}, {"points_unseen", s.points_unseen}, {"points_filled", s.points_filled}, {"points_inserted", s.points_inserted}, {"positions_from_store", s.positions_from_store}, {"hash", file_fingerprint(file)}};
    });
    if (&e == &run_.project.exports.front()) run_.record.count("points_out", info["points"]);   // of several exports each holds all of them
  }

 private:
  /// The other methods are there to be compared with, as they are; their sigma is no measure of what is noise.
  bool denoises() const { return run_.project.blend.denoise && (run_.project.method == SolveMethod::kJoint || run_.project.method == SolveMethod::kSingle); }

  /// The layer's record names the acquisitions, on which no value of it depends.
  std::string task_key() const {
    Hasher h;
    h.add(layer_key_);
    for (const std::string& name : acquisitions()) h.add(name);
    return h.hex();
  }

  /// An export lies where users write: another layer or another program's copy of it may have taken its place, at the same length.
  void forget_if_replaced(const std::string& task, const std::filesystem::path& file) const {
    std::error_code code;
    if (!std::filesystem::is_regular_file(file, code)) return;
    const Json then = Json::parse(run_.tasks.info(task), nullptr, false);
    if (then.value("hash", std::string()) != file_fingerprint(file)) run_.tasks.forget(task);
  }

  /// Layers are folders: one may have been moved or copied to the name of another.
  bool another_lies_there(const stream::Store& store) const {
    try {
      const Json provenance = Json::parse(stream::Layer(store, run_.project.blend.layer).provenance_json(), nullptr, false);
      return !provenance.is_object() || provenance.value("key", std::string()) != layer_key_;
    } catch (const Error&) {
      return false;   // none, or damaged: named when it is read
    }
  }

  /// A layer that was made without its sums is made again with them, where they are wanted; where they are not, they go.
  void prepare_kept(const std::string& layer) const {
    std::error_code code;
    const bool is_there = std::filesystem::exists(run_.folder.kept(layer), code);
    if (run_.project.blend.keep && !is_there) run_.tasks.forget(RunFolder::blend_task(layer));
    if (!run_.project.blend.keep && is_there) std::filesystem::remove_all(run_.folder.kept(layer), code);
  }

  /// Those with photographs in the result.
  std::vector<std::string> acquisitions() const {
    std::vector<std::string> names;
    for (const Shoot& shoot : shoots_)
      if (std::any_of(shoot.photos.begin(), shoot.photos.end(), [](const Photo& p) { return !p.albedo_key.empty(); })) names.push_back(shoot.acquisition->name);
    return names;
  }

  /// A wrong unit, or a calibration in other numbers than the photographs', makes the albedo wrong by powers of ten, and photographs of one surface alone agree with that.
  void note_implausible_level(const stream::Store& store) const {
    constexpr double kSoot = 0.05, kBeyondWhite = 1.2;
    if (run_.project.method == SolveMethod::kNone) return;
    const std::optional<AlbedoLevel> level = albedo_level(store, run_.project.blend.layer);
    if (!level || (level->high >= kSoot && level->median <= kBeyondWhite)) return;
    run_.note_both(concat("the albedo is hardly that of any surface: ", level->high < kSoot ? concat("nearly all of it is below ", level->high) : concat("half of it is above ", level->median),
                          ", where soot has 0.04 and snow 0.9. Are project.unit and the flash's intensity_range right, in the numbers of these photographs? A white surface that faces the flash from a distance of one metre has the pixel value intensity / pi"));
  }

  /// All results that the store holds now, this run's among them.
  void record_layers(const stream::Store& store) const {
    Json all = Json::array();
    for (const std::string& name : stream::layer_names(store)) {
      if (name == "input") continue;
      const Json provenance = Json::parse(stream::Layer(store, name).provenance_json(), nullptr, false);
      all.push_back({{"name", name}, {"this_run", name == run_.project.blend.layer}, {"provenance", provenance.is_discarded() ? Json(nullptr) : provenance}});
    }
    run_.record.set("layers", all.dump());
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
    write_camera_record(run_.folder.cameras(), cameras);
  }

  RunContext& run_;
  const std::vector<Shoot>& shoots_;
  std::string layer_key_, inserted_key_;
};

}  // namespace

void write_run_layer(RunContext& run, const stream::Store& store, const std::vector<Shoot>& shoots) {
  LayerStages stages(run, shoots);
  stages.blend(store);
  stages.residuals(store);
  for (const ExportInput& e : run.project.exports) stages.export_layer(store, e);
}

}  // namespace chiaro::tools
