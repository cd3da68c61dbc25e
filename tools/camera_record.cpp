#include "tools/camera_record.h"

#include <span>

#include "tools/report_json.h"

namespace chiaro::tools {
namespace {

Json numbers_json(std::span<const double> values) {
  Json list = Json::array();
  for (const double v : values) list.push_back(v);
  return list;
}

Json lens_json(const stream::Lens& l) {
  return {{"kind", l.kind == stream::LensKind::kFisheye ? "fisheye" : "perspective"}, {"size", {l.width_px, l.height_px}}, {"focal", {l.fx, l.fy}},
          {"centre", {l.cx, l.cy}}, {"skew", l.skew}, {"k", numbers_json(l.k)}, {"p", numbers_json(l.p)}};
}

Json pose_json(const stream::Pose& p) {
  Json rows = Json::array();
  for (int r = 0; r < 3; ++r) rows.push_back({p.rotation_camera_from_world(r, 0), p.rotation_camera_from_world(r, 1), p.rotation_camera_from_world(r, 2)});
  const Vec3d& t = p.translation_camera_from_world;
  return {{"rotation_camera_from_world", rows}, {"translation_camera_from_world", {t.x(), t.y(), t.z()}}};
}

stream::Camera camera_from(const Json& j, const std::filesystem::path& file) {
  stream::Camera c;
  c.photograph = j.at("photograph").get<std::string>();
  require_plain_name(c.photograph, file, "a photograph");
  const Json& lens = j.at("lens");
  const std::string kind = lens.at("kind").get<std::string>();
  if (kind != "fisheye" && kind != "perspective") throw Error(concat(file.string(), ": damaged: lens \"", kind, "\""));
  stream::Lens& l = c.lens;
  l.kind = kind == "fisheye" ? stream::LensKind::kFisheye : stream::LensKind::kPerspective;
  l.width_px = lens.at("size").at(0);
  l.height_px = lens.at("size").at(1);
  l.fx = lens.at("focal").at(0);
  l.fy = lens.at("focal").at(1);
  l.cx = lens.at("centre").at(0);
  l.cy = lens.at("centre").at(1);
  l.skew = lens.at("skew");
  l.k = lens.at("k").get<std::array<double, 7>>();
  l.p = lens.at("p").get<std::array<double, 4>>();
  const Json& pose = j.at("pose");
  for (int r = 0; r < 3; ++r)
    for (int k = 0; k < 3; ++k) c.pose.rotation_camera_from_world(r, k) = pose.at("rotation_camera_from_world").at(static_cast<std::size_t>(r)).at(static_cast<std::size_t>(k));
  for (int k = 0; k < 3; ++k) c.pose.translation_camera_from_world[k] = pose.at("translation_camera_from_world").at(static_cast<std::size_t>(k));
  if (j.contains("focus")) c.focus = {j.at("focus").at("aperture").get<double>(), j.at("focus").at("distance").get<double>()};
  stream::check_camera(c, concat(file.string(), ": ", c.photograph));
  return c;
}

}  // namespace

void write_camera_record(const std::filesystem::path& file, const std::vector<PhotographCamera>& cameras) {
  Json list = Json::array();
  for (const PhotographCamera& c : cameras) {
    list.push_back({{"photograph", c.camera.photograph}, {"acquisition", c.acquisition}, {"lens", lens_json(c.camera.lens)}, {"pose", pose_json(c.camera.pose)},
                    {"gain", numbers_json(c.gain)}, {"shift_px", numbers_json(c.shift_px)}, {"trust", c.trust}});
    if (const stream::Focus& f = c.camera.focus; f.aperture > 0) list.back()["focus"] = {{"aperture", f.aperture}, {"distance", f.distance}};
    if (c.flash_in_camera) list.back()["flash_in_camera"] = numbers_json(std::span(c.flash_in_camera->data(), 3));
  }
  write_text(file, Json{{"cameras", list}}.dump(1) + "\n");
}

std::vector<PhotographCamera> read_camera_record(const std::filesystem::path& file) {
  const Json root = read_json_object(file);
  std::vector<PhotographCamera> cameras;
  try {
    for (const Json& j : root.at("cameras")) {
      cameras.push_back({j.at("acquisition").get<std::string>(), camera_from(j, file), {}, j.at("gain").get<std::array<double, 3>>(), j.at("shift_px").get<std::array<double, 2>>(), j.at("trust").get<double>()});
      if (!j.contains("flash_in_camera")) continue;
      const auto offset = j.at("flash_in_camera").get<std::array<double, 3>>();
      cameras.back().flash_in_camera = Vec3d(offset[0], offset[1], offset[2]);
    }
  } catch (const nlohmann::json::exception& e) {
    throw Error(concat(file.string(), ": damaged: camera ", cameras.size(), ": ", e.what()));
  }
  return cameras;
}

}  // namespace chiaro::tools
