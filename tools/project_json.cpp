#include <nlohmann/json.hpp>

#include "tools/project.h"

namespace chiaro::tools {
namespace {
using Json = nlohmann::ordered_json;

Json json_of(const Acquisition& acquisition) {
  Json out{{"name", acquisition.name}, {"role", name_of(acquisition.role)}, {"encoding", name_of(acquisition.encoding)}};
  for (const PhotographInput& photograph : acquisition.photographs) {
    Json one{{"key", photograph.key}, {"file", photograph.file.string()}};
    if (!photograph.mask.empty()) one["mask"] = photograph.mask.string();
    out["photographs"].push_back(std::move(one));
  }
  out["cameras"] = acquisition.cameras.string();
  out["noise"] = acquisition.noise ? Json{{"gain", acquisition.noise->gain}, {"read_sigma", acquisition.noise->read_sigma}} : Json(nullptr);
  out["flash"] = nullptr;
  if (acquisition.flash) {
    const Vec3d& offset = acquisition.flash->offset_in_camera;
    out["flash"] = Json{{"offset_in_camera", {offset.x(), offset.y(), offset.z()}}, {"intensity_range", nullptr}};
    if (acquisition.flash->intensity_range) out["flash"]["intensity_range"] = *acquisition.flash->intensity_range;
  }
  if (acquisition.binning) out["binning"] = *acquisition.binning;
  if (acquisition.focus) out["focus"] = {{"distance", acquisition.focus->distance}, {"f_number", acquisition.focus->f_number}, {"focal_length", acquisition.focus->focal_length}};
  out["falloff"] = name_of(acquisition.falloff);
  out["ambient"] = Json{{"model", name_of(acquisition.ambient)}, {"floor", name_of(acquisition.floor)}};
  if (acquisition.floor_plane) out["ambient"]["floor"] = *acquisition.floor_plane;
  if (acquisition.exposure_s) out["exposure_s"] = *acquisition.exposure_s;
  out["reference"] = Json::array();
  for (const ReferenceInput& reference : acquisition.references) {
    Json corners = Json::array();
    for (const Vec2d& corner : reference.polygon) corners.push_back({corner.x(), corner.y()});
    out["reference"].push_back({{"photograph", acquisition.photographs[reference.photograph].stem}, {"polygon", corners}, {"albedo", reference.albedo}, {"sigma", reference.sigma}});
  }
  return out;
}
}  // namespace

std::string to_json(const Project& project) {
  Json out;
  out["file"] = project.file.string();
  out["project"] = {{"name", project.name}, {"unit", project.unit}, {"metres_per_unit", project.metres_per_unit}};
  out["cloud"] = {{"files", Json::array()}, {"normals", name_of(project.cloud.normals)}, {"outliers", name_of(project.cloud.outliers)}, {"align", name_of(project.cloud.align)}};
  for (const std::filesystem::path& file : project.cloud.files) out["cloud"]["files"].push_back(file.string());
  out["acquisition"] = Json::array();
  for (const Acquisition& acquisition : project.acquisitions) {
    out["acquisition"].push_back(json_of(acquisition));
    if (acquisition.lights_of) out["acquisition"].back()["lights_of"] = project.acquisitions[*acquisition.lights_of].name;
  }
  out["solve"] = {{"method", name_of(project.method)}};
  out["blend"] = {{"layer", project.blend.layer}, {"keep", project.blend.keep}, {"reject", project.blend.reject}, {"gain", name_of(project.blend.gain)}, {"align", project.blend.align}, {"denoise", project.blend.denoise}};
  if (project.blend.bands != 2) out["blend"]["bands"] = project.blend.bands;
  if (project.blend.refine != BlendRefine::kNone) {
    out["blend"]["refine"] = name_of(project.blend.refine);
    if (project.blend.refine_points) out["blend"]["refine_points"] = *project.blend.refine_points;
  }
  out["run"] = {{"memory", project.memory_bytes}, {"threads", project.threads}, {"seed", project.seed}};
  out["export"] = Json::array();
  for (const ExportInput& one : project.exports) out["export"].push_back({{"file", one.file}, {"fill", one.fill}});
  return out.dump(2, ' ', false, Json::error_handler_t::replace);
}

}  // namespace chiaro::tools
