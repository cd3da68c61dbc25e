#include "tools/synth_project.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <iomanip>
#include <nlohmann/json.hpp>
#include <numbers>
#include <sstream>

#include "stream/base/budget.h"
#include "stream/base/error.h"
#include "stream/base/file.h"
#include "stream/photo/image_io.h"
#include "tools/synth_surfaces.h"

namespace chiaro::tools {
namespace {

namespace fs = std::filesystem;
constexpr double kPi = std::numbers::pi;
constexpr int kBandRows = 32;
constexpr double kRangeLow = 0.98, kRangeHigh = 1.03;   ///< calibrated range over the flash's true intensity: holds it, and is not centred on it
const Vec3d kFlashInCamera(0.13, -0.16, 0.03);          ///< metres before scale: beside and above the lens

const char* scene_name(SynthKind kind) {
  switch (kind) {
    case SynthKind::kSphere: return "sphere";
    case SynthKind::kStatue: return "statue";
    case SynthKind::kWall: return "wall";
    case SynthKind::kRoom: return "room";
    case SynthKind::kDuplicates: return "duplicates";
    case SynthKind::kOutlier: return "outlier";
    case SynthKind::kVolume: return "volume";
    case SynthKind::kLine: return "line";
  }
  return "";
}

void need_surface(SynthKind kind) {
  if (!has_body(kind)) throw UsageError(concat("--photographs: the scene \"", scene_name(kind), "\" cannot be photographed, expected sphere, statue, wall or room"));
}

stream::Pose look(const Vec3d& eye, const Vec3d& target, const Vec3d& up) {
  const Vec3d z = (target - eye).normalized(), x = z.cross(up).normalized(), y = z.cross(x);   // y down
  stream::Pose pose;
  pose.rotation_camera_from_world.row(0) = x;
  pose.rotation_camera_from_world.row(1) = y;
  pose.rotation_camera_from_world.row(2) = z;
  pose.translation_camera_from_world = -(pose.rotation_camera_from_world * eye);
  return pose;
}

/// Around a body: from afar, and every third from near at another height.
stream::Pose ring_pose(int k, int count, double far_m, double near_m, double height_m) {
  constexpr std::array<double, 3> kElevation{0.15, 0.65, -0.35};
  const double azimuth = 2 * kPi * k / count, elevation = kElevation[static_cast<std::size_t>(k % 3)], distance = k % 3 == 1 ? near_m : far_m;
  const Vec3d target(0, 0, k % 3 == 1 ? height_m : k % 3 == 2 ? -height_m / 2 : 0.0);
  return look(target + distance * Vec3d(std::cos(azimuth) * std::cos(elevation), std::sin(azimuth) * std::cos(elevation), std::sin(elevation)), target, {0, 0, 1});
}

/// Along the wall, at two heights and two distances, never square to it.
stream::Pose wall_pose(int k, int count) {
  const double along = count > 1 ? static_cast<double>(k) / (count - 1) - 0.5 : 0.0, side = k % 2 ? 1 : -1;
  const Vec3d target(2.2 * along, 0.5 * side, 0);
  return look(target + Vec3d(0.9 * (k % 4 < 2 ? 1 : -1), -0.4 * side, k % 3 == 0 ? 2.9 : 2.2), target, {0, 1, 0});
}

/// Between the rows of columns, looking across the room to all sides, up and down.
stream::Pose room_pose(int k, int count) {
  constexpr std::array<double, 3> kPitch{-0.1, 0.45, -0.5};
  const double angle = 2 * kPi * k / count + 0.3, pitch = kPitch[static_cast<std::size_t>(k % 3)], yaw = angle + kPi;
  const Vec3d eye(3.6 * std::cos(angle), 0.8 * std::sin(angle), -0.2);
  return look(eye, eye + Vec3d(std::cos(yaw) * std::cos(pitch), std::sin(yaw) * std::cos(pitch), std::sin(pitch)), {0, 0, 1});
}

std::string photo_name(int k, int count) {
  std::ostringstream name;
  name << "photo_" << std::setw(static_cast<int>(std::max<std::size_t>(2, std::to_string(count - 1).size()))) << std::setfill('0') << k;
  return name.str();
}

/// As the scene is written: scaled and moved.
stream::Pose placed(const stream::Pose& pose, const SynthSpec& spec) {
  stream::Pose out = pose;
  const Vec3d offset(spec.offset_m, spec.offset_m, spec.offset_m / 10);
  out.translation_camera_from_world = spec.scale * pose.translation_camera_from_world - pose.rotation_camera_from_world * offset;
  return out;
}

std::string cameras_text(const stream::Lens& lens) {
  std::ostringstream text;
  text << std::setprecision(17) << "# CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]\n1 PINHOLE " << lens.width_px << ' ' << lens.height_px << ' ' << lens.fx << ' ' << lens.fy << ' ' << lens.cx << ' '
       << lens.cy << '\n';
  return text.str();
}

std::string images_text(const std::vector<SynthView>& views, const SynthSpec& spec) {
  std::ostringstream text;
  text << std::setprecision(17) << "# IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, then an empty line of points\n";
  const int count = static_cast<int>(views.size());
  for (int k = 0; k < count; ++k) {
    const stream::Pose pose = placed(views[static_cast<std::size_t>(k)].pose, spec);
    const Eigen::Quaterniond q(pose.rotation_camera_from_world);
    const Vec3d& t = pose.translation_camera_from_world;
    text << k + 1 << ' ' << q.w() << ' ' << q.x() << ' ' << q.y() << ' ' << q.z() << ' ' << t.x() << ' ' << t.y() << ' ' << t.z() << " 1 " << photo_name(k, count) << ".exr\n\n";
  }
  return text.str();
}

std::string project_text(const SynthSpec& spec, const SynthProjectOptions& options, const SynthProjectResult& result, bool closed) {
  const Vec3d flash = spec.scale * kFlashInCamera;
  std::ostringstream text;
  const std::string masks = closed ? "" : "masks = \"masks/{stem}.png\"\n";
  std::ostringstream noise;
  noise << "noise = { gain = " << options.gain << ", read_sigma = " << options.read_sigma << " }\n";
  text << std::setprecision(10) << "# Made by chiaro synth; the true lights are in truth/lights.json.\n[project]\nname = \"" << scene_name(spec.kind) << "\"\nunit = \"m\"\n\n[cloud]\nfiles = [\""
       << options.cloud << "\"]\nnormals = \"auto\"\n\n[[acquisition]]\nname = \"synth\"\nphotographs = [\"photos/photo_*.exr\"]\nencoding = \"linear\"\n"
       << masks << "cameras = \"sparse\"\n" << noise.str();
  if (options.without_flash) text << "exposure_s = " << kFlashExposureS << '\n';
  text << "\n[acquisition.flash]\noffset_in_camera = [" << flash.x() << ", " << flash.y() << ", " << flash.z() << "]\nintensity_range = [" << kRangeLow * result.flash_intensity << ", "
       << kRangeHigh * result.flash_intensity << "]\n\n[acquisition.ambient]\nmodel = \"" << (closed ? "none" : "auto") << "\"\n";
  if (options.without_flash)
    text << "\n[[acquisition]]\nname = \"dark\"\nrole = \"no_flash\"\nphotographs = [\"dark/photo_*.exr\"]\nencoding = \"linear\"\n" << masks << "cameras = \"sparse\"\n" << noise.str()
         << "exposure_s = " << kDarkExposureS << '\n';
  text << "\n[[export]]\nfile = \"albedo.ply\"\n";
  return text.str();
}

std::string truth_text(const SynthSpec& spec, const SynthProjectOptions& options, const SynthProjectResult& result, bool closed) {
  const nlohmann::ordered_json out{{"scene", scene_name(spec.kind)},
                                   {"seed", spec.seed},
                                   {"scale", spec.scale},
                                   {"offset_m", {spec.offset_m, spec.offset_m, spec.offset_m / 10}},
                                   {"flash_intensity_w_per_sr", result.flash_intensity},
                                   {"ambient_radiance", result.ambient_radiance},
                                   {"ambient", closed ? "none: the room is closed" : "uniform grey"},
                                   {"bounces", options.bounces},
                                   {"gloss_roughness", options.gloss_roughness},
                                   {"paths_per_pixel", options.samples * options.samples},
                                   {"albedo", "0.45 + 0.30 sin(12 x + 7 y), 0.45 + 0.30 sin(9 y + 8 z + 2), 0.45 + 0.30 sin(11 z - 6 x + 4); x y z = (position - offset) / scale"}};
  return out.dump(1) + "\n";
}

/// Made beside the folder and moved when whole; removed if it never is.
class PartFolder {
 public:
  explicit PartFolder(const fs::path& folder) : folder_(folder), part_(folder.string() + ".part") {
    std::error_code code;
    if (fs::exists(folder, code) && !(fs::is_directory(folder, code) && fs::is_empty(folder, code))) throw Error(concat(folder.string(), ": exists and is not an empty folder; it is left alone"));
    fs::remove_all(part_, code);
    for (const char* name : {"photos", "sparse", "truth"}) make_folder(part_ / name);
  }
  PartFolder(const PartFolder&) = delete;
  PartFolder& operator=(const PartFolder&) = delete;
  ~PartFolder() {
    std::error_code code;
    fs::remove_all(part_, code);
  }
  const fs::path& path() const { return part_; }
  void publish() { publish_folder(part_, folder_); }

 private:
  fs::path folder_, part_;
};

void check_space(const fs::path& folder, const SynthProjectOptions& options) {
  // Half floats of a noisy picture hardly shrink.
  const std::uint64_t wanted = (options.without_flash ? 2 : 1) * static_cast<std::uint64_t>(options.photographs) * static_cast<std::uint64_t>(options.width_px) * static_cast<std::uint64_t>(options.height_px) * 6;
  const std::uint64_t left = free_disk_bytes(folder);
  if (wanted > left) throw Error(concat(folder.string(), ": ", format_bytes(wanted), " are needed for photographs, the disk has ", format_bytes(left), " left"));
}

void write_photograph(const SynthBody& body, const SynthLights& lights, const SynthView& view, const SynthPixels& pixels, const fs::path& folder, const std::string& name, Reporter& report) {
  const char* pictures = lights.flash_intensity > 0 ? "photos" : "dark";
  const int width = view.lens.width_px, height = view.lens.height_px;
  std::vector<float> rgb;
  std::vector<std::uint8_t> mask(static_cast<std::size_t>(width) * static_cast<std::size_t>(height));
  stream::ExrWriter picture(folder / pictures / (name + ".exr"), width, height, {"R", "G", "B"}, true);
  for (int y = 0; y < height; y += kBandRows) {
    report.check();
    const int rows = std::min(kBandRows, height - y);
    const std::size_t first = static_cast<std::size_t>(y) * static_cast<std::size_t>(width), count = static_cast<std::size_t>(rows) * static_cast<std::size_t>(width);
    rgb.resize(3 * count);
    render_synth_rows(body, lights, view, pixels, y, y + rows, rgb, std::span(mask).subspan(first, count));
    picture.write_rows(rows, rgb);
  }
  picture.commit();
  if (!body.is_closed() && lights.flash_intensity > 0) stream::write_png_srgb8(folder / "masks" / (name + ".png"), width, height, mask, 1);
}

void range(const char* name, double value, double min, double max) {
  if (!(value >= min && value <= max)) throw UsageError(concat(name, " ", value, ": expected ", min, " to ", max));
}

}  // namespace

void SynthProjectOptions::validate() const {
  range("--photographs", photographs, 1, 10000);
  range("--size (width)", width_px, 16, 16384);
  range("--size (height)", height_px, 16, 16384);
  range("--focal", focal, 0, 100);
  range("--samples", samples, 1, 16);
  range("--bounces", bounces, 0, kMostBounces);
  range("--ambient", ambient_radiance, 0, 1e6);
  range("--gloss", gloss_roughness, 0, 1);
  if (cloud.empty() || fs::path(cloud).filename() != fs::path(cloud) || cloud.find_first_of("\"\\*?[") != std::string::npos)
    throw UsageError(concat("--out ", cloud, ": with --project, expected a file name without a folder, such as cloud.las"));
}

SynthLights synth_lights(SynthKind kind, const SynthProjectOptions& options) {
  need_surface(kind);
  // Radiance about 0.5 in the middle distance; the room is larger, and what it reflects adds up.
  return {kind == SynthKind::kRoom ? 45.0 : 30.0, kind == SynthKind::kRoom ? 0.0 : options.ambient_radiance, options.bounces, {options.gloss_roughness > 0, 0.04, options.gloss_roughness}};
}

std::vector<SynthView> synth_views(SynthKind kind, const SynthProjectOptions& options) {
  need_surface(kind);
  const double focal = options.focal > 0 ? options.focal : kind == SynthKind::kRoom ? 0.9 : kind == SynthKind::kWall ? 1.2 : 1.45;
  const double shorter = std::min(options.width_px, options.height_px);
  SynthView view;
  view.lens.width_px = options.width_px;
  view.lens.height_px = options.height_px;
  view.lens.fx = view.lens.fy = focal * shorter;
  view.lens.cx = options.width_px / 2.0;
  view.lens.cy = options.height_px / 2.0;
  view.flash_in_camera = kFlashInCamera;
  std::vector<SynthView> views;
  for (int k = 0; k < options.photographs; ++k) {
    switch (kind) {
      case SynthKind::kWall: view.pose = wall_pose(k, options.photographs); break;
      case SynthKind::kRoom: view.pose = room_pose(k, options.photographs); break;
      case SynthKind::kStatue: view.pose = ring_pose(k, options.photographs, 3.2, 2.2, 0.45); break;
      default: view.pose = ring_pose(k, options.photographs, 3.6, 2.9, 0.3); break;
    }
    views.push_back(view);
  }
  return views;
}

SynthProjectResult write_synth_project(const SynthScene& scene, const fs::path& given, const SynthProjectOptions& options, Reporter& report) {
  options.validate();
  const SynthSpec& spec = scene.spec();
  const SynthLights lights = synth_lights(spec.kind, options);
  if (options.without_flash && !(lights.ambient_radiance > 0)) throw UsageError("--no-flash: the scene has no ambient light to photograph");
  const std::vector<SynthView> views = synth_views(spec.kind, options);
  const fs::path absolute = fs::absolute(given).lexically_normal(), folder = absolute.has_filename() ? absolute : absolute.parent_path();
  PartFolder part(folder);
  const std::unique_ptr<SynthBody> body = make_body(spec.kind);
  if (!body->is_closed()) make_folder(part.path() / "masks");
  if (options.without_flash) make_folder(part.path() / "dark");

  SynthProjectResult result;
  check_space(folder, options);
  result.cloud = write_synth(scene, part.path() / options.cloud, options.with_albedo, report);
  check_space(folder, options);   // the cloud may have taken it
  result.photographs = options.photographs;
  // A scene twice as large takes four times the flash for the same picture.
  result.flash_intensity = lights.flash_intensity * spec.scale * spec.scale;
  result.ambient_radiance = lights.ambient_radiance;
  report.begin("photographs", static_cast<std::uint64_t>(options.photographs), "photographs");
  for (int k = 0; k < options.photographs; ++k) {
    SynthPixels pixels{options.samples, options.gain, options.read_sigma, spec.seed + (static_cast<std::uint64_t>(k) + 1) * 0x9e3779b97f4a7c15ull};
    write_photograph(*body, lights, views[static_cast<std::size_t>(k)], pixels, part.path(), photo_name(k, options.photographs), report);
    if (options.without_flash) {
      pixels.seed ^= 0x5851f42d4c957f2dull;
      write_photograph(*body, {0, lights.ambient_radiance * kDarkExposureS / kFlashExposureS, lights.bounces, lights.gloss}, views[static_cast<std::size_t>(k)], pixels, part.path(),
                       photo_name(k, options.photographs), report);
    }
    report.progress(static_cast<std::uint64_t>(k) + 1);
  }
  report.end();
  write_text(part.path() / "sparse" / "cameras.txt", cameras_text(views.front().lens));
  write_text(part.path() / "sparse" / "images.txt", images_text(views, spec));
  write_text(part.path() / "sparse" / "points3D.txt", "# none\n");
  write_text(part.path() / "truth" / "lights.json", truth_text(spec, options, result, body->is_closed()));
  write_text(part.path() / "project.toml", project_text(spec, options, result, body->is_closed()));
  part.publish();
  return result;
}

}  // namespace chiaro::tools
