#include "tools/run_photographs.h"

#include <algorithm>
#include <array>
#include <map>
#include <nlohmann/json.hpp>

#include "stream/base/budget.h"
#include "stream/base/disk_space.h"
#include "stream/base/error.h"
#include "stream/base/file.h"
#include "stream/photo/camera_files.h"
#include "stream/photo/develop.h"
#include "stream/photo/raw.h"
#include "surfels/gbuffer.h"
#include "tools/camera_frame.h"
#include "tools/run_context_json.h"

namespace chiaro::tools {
namespace {
using Json = nlohmann::ordered_json;

Hasher& add_camera(Hasher& h, const stream::Camera& c) {
  const stream::Lens& l = c.lens;
  h.add(static_cast<std::uint64_t>(l.kind)).add(static_cast<std::uint64_t>(l.width_px)).add(static_cast<std::uint64_t>(l.height_px));
  for (const double v : {l.fx, l.fy, l.cx, l.cy, l.skew}) h.add(v);
  for (const double v : l.k) h.add(v);
  for (const double v : l.p) h.add(v);
  for (int i = 0; i < 9; ++i) h.add(c.pose.rotation_camera_from_world.data()[i]);
  for (int i = 0; i < 3; ++i) h.add(c.pose.translation_camera_from_world[i]);
  if (c.focus.aperture > 0) h.add("focus").add(c.focus.aperture).add(c.focus.distance);
  return h;
}

stream::Encoding develop_encoding(Encoding e) {
  switch (e) {
    case Encoding::kSrgb: return stream::Encoding::kSrgb;
    case Encoding::kRaw: return stream::Encoding::kRaw;
    default: return stream::Encoding::kLinear;
  }
}

/// A flash that is fixed to the camera turns with it; the axes of its offset are those of the stored pixels, which many programs turn upright.
void note_turned(const Shoot& shoot, RunContext& run) {
  const Acquisition& a = *shoot.acquisition;
  if (run.project.method == SolveMethod::kNone || !shoot.has_flash() || a.flash->offset_in_camera.head<2>().norm() == 0) return;
  std::array<std::size_t, 2> count{};
  std::array<std::string, 2> first;
  for (const Photo& photo : shoot.photos) {
    const stream::Lens& lens = photo.camera.lens;
    if (lens.width_px == lens.height_px) continue;
    const std::size_t upright = lens.height_px > lens.width_px;
    if (count[upright]++ == 0) first[upright] = photo.input->key;
  }
  if (count[0] == 0 || count[1] == 0) return;
  const Vec3d& o = a.flash->offset_in_camera;
  run.note_both(concat("acquisition \"", a.name, "\": ", count[1], " of its photographs stand upright (", first[1], count[1] > 1 ? ", \u2026" : "", "), ", count[0], " lie (", first[0], count[0] > 1 ? ", \u2026" : "",
                       "), and offset_in_camera is taken in the pixels' axes of both. Where the flash turned with the camera, it is another one in pictures that were turned: give them an acquisition of their own with lights_of = \"",
                       a.name, "\" and offset_in_camera = [", -o.y(), ", ", o.x(), ", ", o.z(), "] (turned clockwise) or [", o.y(), ", ", -o.x(), ", ", o.z(), "] (counter-clockwise)"));
}

void require_photographs(const std::vector<Shoot>& shoots) {
  if (std::all_of(shoots.begin(), shoots.end(), [](const Shoot& s) { return s.photos.empty(); }))
    throw Error("no photograph is left to work with: see the notes above for what each one lacks");
}

/// Which photograph took which camera first. Acquisitions with flashes of their own may share cameras where nothing moved between them, as on a
/// tripod; but a photograph that was never registered, of a name that another folder has too, takes the other's camera in the same way.
class CamerasTaken {
 public:
  void take(const Acquisition& a, std::size_t lead, const stream::Camera& camera, const PhotographInput& photograph) {
    const auto [first, is_new] = first_.try_emplace({a.cameras, camera.photograph}, Taker{lead, &photograph});
    if (is_new || first->second.lead == lead) return;
    if (++shared_ == 1) example_ = concat(first->second.photograph->file.string(), " and ", photograph.file.string(), " have one camera, \"", camera.photograph, "\" of ", a.cameras.string());
  }
  void tell(RunContext& run) const {
    if (shared_ == 0) return;
    run.note_both(concat(example_, shared_ > 1 ? concat(", and ", shared_ - 1, " more of the same names likewise") : std::string(),
                         ": right if the camera stood still between the acquisitions. If not, one of them was not registered: leave it out, or give it another name"));
  }

 private:
  struct Taker {
    std::size_t lead;
    const PhotographInput* photograph;
  };
  std::map<std::pair<std::filesystem::path, std::string>, Taker> first_;
  std::size_t shared_ = 0;
  std::string example_;
};

/// Disk for the pixels of a photograph: for its rasters as they are kept, where the object fills it (rendered scenes take 33 to 39 bytes a pixel; background next to
/// nothing); and for the largest of them, with a flash, while it is made. Pictures for the user are smaller.
std::uint64_t bytes_kept(std::uint64_t pixels, bool flash, bool solves) {
  constexpr std::uint64_t kRadiance = 9, kSeen = 15, kOfFlash = 5, kAlbedo = 14;
  return pixels * (kRadiance + kSeen + (solves && flash ? kOfFlash : 0) + (flash || !solves ? kAlbedo : 0));
}
constexpr std::uint64_t kBytesWhileMade = 62;
constexpr std::uint64_t kLeastShare = 4;   ///< background and even pictures may well leave only so small a part of what is estimated

}  // namespace

std::vector<Shoot> read_shoots(RunContext& run) {
  std::vector<Shoot> shoots;
  CamerasTaken taken;
  for (const Acquisition& a : run.project.acquisitions) {
    Shoot shoot;
    shoot.acquisition = &a;
    shoot.lead = a.lights_of.value_or(shoots.size());
    if (a.lights_of && a.exposure_s) shoot.ambient_scale = *a.exposure_s / *run.project.acquisitions[*a.lights_of].exposure_s;
    if (a.role == AcquisitionRole::kNoFlash && run.project.method == SolveMethod::kNone) {
      for (const PhotographInput& p : a.photographs) run.leave_out(p, "taken without flash, and no light is solved");
      shoots.push_back(std::move(shoot));
      continue;
    }
    std::vector<std::string> notes;
    const std::vector<stream::Camera> cameras = stream::read_cameras(a.cameras, notes);
    for (const std::string& n : notes) run.note_both(n);
    for (std::size_t i = 0; i < a.photographs.size(); ++i) {
      const PhotographInput& p = a.photographs[i];
      const stream::Camera* camera = stream::find_camera(cameras, p.file.string());
      if (!camera) {
        run.leave_out(p, concat("no camera in ", a.cameras.filename().string()));
        continue;
      }
      taken.take(a, shoot.lead, *camera, p);
      Photo photo;
      photo.input = &p;
      photo.index_in_acquisition = i;
      photo.camera = *camera;
      photo.camera.photograph = p.key;
      if (a.focus) photo.camera.focus = {a.focus->focal_length / a.focus->f_number, a.focus->distance};
      shoot.photos.push_back(std::move(photo));
    }
    shoots.push_back(std::move(shoot));
  }
  taken.tell(run);
  require_photographs(shoots);
  return shoots;
}

void PhotographStages::develop(Shoot& shoot) {
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
      run_.leave_out(*photo.input, e.what());
    }
  }
  shoot.photos = std::move(kept);
  tell_development_notes();
  note_turned(shoot, run_);
  require_photographs(shoots_);
}

void PhotographStages::tell_development_notes() {
  constexpr std::size_t kNamed = 3;
  for (const auto& [text, files] : development_notes_) {
    std::string names;
    for (std::size_t i = 0; i < std::min(files.size(), kNamed); ++i) names += (i > 0 ? ", " : "") + files[i];
    if (files.size() > kNamed) names += concat(" and ", files.size() - kNamed, " more");
    run_.note_both(concat(names, ": ", text));
  }
  development_notes_.clear();
}

void PhotographStages::plan() {
  const bool solves = run_.project.method != SolveMethod::kNone;
  std::uint64_t kept = 0, there = 0, while_made = 0, photographs = 0;
  for (Shoot& shoot : shoots_)
    for (Photo& photo : shoot.photos) {
      try {
        photo.size = stream::working_size(photo.input->file, develop_encoding(shoot.acquisition->encoding));
      } catch (const Error&) {
        continue;   // what is wrong with it is said when it is developed
      }
      photo.binning = binning_of(*shoot.acquisition, photo);
      const std::uint64_t pixels = static_cast<std::uint64_t>(photo.size.width_px / photo.binning) * static_cast<std::uint64_t>(photo.size.height_px / photo.binning);
      kept += bytes_kept(pixels, shoot.has_flash(), solves);
      ++photographs;
      const PhotographDisk on_disk = disk_of(photo.input->key, shoot.has_flash() || !solves);
      there += on_disk.bytes;
      if (!on_disk.whole) while_made = std::max(while_made, pixels * kBytesWhileMade);
    }
  run_.report.note(concat(photographs, photographs == 1 ? " photograph: " : " photographs: ", "up to ", format_bytes(kept), " of disk for what is kept of ", photographs == 1 ? "its" : "their", " pixels; background takes little"));
  const std::uint64_t free = free_disk_bytes(run_.folder.root) + there;
  require_disk_space(run_.folder.work(), "what is kept of the photographs' pixels", while_made + kept / kLeastShare, free);
  if (while_made > 0 && free < while_made + kept)
    run_.note_both(concat("the disk of ", run_.folder.root.string(), " has ", format_bytes(free), " for them, which may be too little; a run that stops at a full disk goes on where it was once there is room"));
}

PhotographStages::PhotographDisk PhotographStages::disk_of(const std::string& key, bool with_albedo) const {
  PhotographDisk disk{0, true};
  std::vector<std::filesystem::path> rasters{run_.folder.radiance(key), run_.folder.gbuffer(key)};
  if (with_albedo) rasters.push_back(run_.folder.albedo(key));
  for (const auto& raster : rasters) {
    disk.bytes += allocated_bytes(raster);
    disk.whole = disk.whole && std::filesystem::exists(raster);
  }
  return disk;
}

int PhotographStages::binning_of(const Acquisition& a, const Photo& photo) {
  if (a.binning) return *a.binning;
  if (run_.project.blend.refine == BlendRefine::kImage) return 1;   // which asks for each pixel
  const int width = photo.size.width_px, height = photo.size.height_px;
  if (surfels::most_cell(width, height) < 2) return 1;
  if (!spacing_) spacing_.emplace(store_);
  return surfels::cell_for(spacing_->spacing_px(photo.camera) * width / photo.camera.lens.width_px, width, height);
}

void PhotographStages::develop_one(const Acquisition& a, Photo& photo) {
  const PhotographInput& p = *photo.input;
  const std::string fingerprint = file_fingerprint(p.file);
  const stream::PictureSize& size = photo.size;
  Hasher h = keyed("develop");
  h.add(fingerprint).add(static_cast<std::uint64_t>(a.encoding));
  h.add(p.mask.empty() ? std::string("-") : file_fingerprint(p.mask));
  h.add(a.noise ? a.noise->gain : -1.0).add(a.noise ? a.noise->read_sigma : -1.0);
  h.add(std::uint64_t{run_.project.method != SolveMethod::kNone});
  if (a.encoding == Encoding::kRaw) h.add("raw 2");   // raised as the pipeline's version is
  if (photo.binning > 1) h.add("cells").add(static_cast<std::uint64_t>(photo.binning));
  photo.radiance_key = h.hex();
  const Json info = run_.task("develop/" + p.key, photo.radiance_key, {run_.folder.radiance(p.key)}, [&] {
    stream::DevelopOptions options;
    options.encoding = develop_encoding(a.encoding);
    if (!p.mask.empty()) options.mask = p.mask;
    options.find_clipping = run_.project.method != SolveMethod::kNone;   // there a picture is the colour itself, and may be of one
    options.cell_px = photo.binning;
    if (a.noise) options.noise = stream::NoiseModel{a.noise->gain, a.noise->read_sigma, false};
    const stream::DevelopResult r = stream::develop(p.file, options, run_.folder.radiance(p.key), run_.report);
    return Json{{"width", r.width_px}, {"height", r.height_px}, {"noise_gain", r.noise.gain}, {"noise_read_sigma", r.noise.read_sigma}, {"noise_estimated", r.noise.estimated},
                {"pixels_used", r.pixels_used}, {"pixels_masked", r.pixels_masked}, {"pixels_saturated", r.pixels_saturated}, {"pixels_not_finite", r.pixels_not_finite},
                {"notes", r.notes}};
  });
  run_.record.input(p.file, fingerprint);
  for (const auto& note : info["notes"]) {
    const std::string text = note.get<std::string>(), name = p.file.filename().string();
    if (text.starts_with(name)) run_.record.note(text);   // of this one alone
    else development_notes_[text].push_back(name);
  }
  if (info["pixels_used"] == 0) throw Error("no usable pixel: everything is masked, saturated or not finite");
  if (!p.mask.empty()) pixels_left_by_mask_[p.key] = info["pixels_used"];
  photo.noise = {info["noise_gain"], info["noise_read_sigma"]};
  const stream::Lens lens = photo.camera.lens;
  const int raw_cell_px = a.encoding == Encoding::kRaw ? stream::RawSource::kCellPx : 1;
  photo.camera.lens = stream::lens_of_cells(stream::scaled_to(lens, size.file_width_px, size.file_height_px, p.file.string()), raw_cell_px * photo.binning);
  if (size.file_width_px != lens.width_px || size.file_height_px != lens.height_px)
    development_notes_[concat(size.file_width_px, " x ", size.file_height_px, " pixels where the camera is of ", lens.width_px, " x ", lens.height_px, ": taken as a scaled copy of all of it")].push_back(p.file.filename().string());
  if (photo.binning > 1 && !a.binning)
    development_notes_[concat("the points of the cloud lie ", 4 * photo.binning, " pixels apart and more: cells of ", photo.binning, " x ", photo.binning, " pixels are taken as one. binning = 1 in the acquisition takes each by itself, at ",
                              photo.binning * photo.binning, " times the time and disk")].push_back(p.file.filename().string());
}

void PhotographStages::raycast(Shoot& shoot) {
  const Acquisition& a = *shoot.acquisition;
  std::vector<Vec3d> centres;
  for (const Photo& photo : shoot.photos) centres.push_back(photo.camera.pose.centre_in_world());
  if (const auto note = cameras_in_one_spot(centres, store_.manifest().bounds, store_.manifest().unit)) run_.note_both(concat("acquisition \"", a.name, "\": ", *note));
  std::vector<Photo> kept;
  for (Photo& photo : shoot.photos) {
    surfels::GBufferOptions options;
    if (run_.project.method != SolveMethod::kNone && shoot.has_flash()) options.flash_in_camera = a.flash->offset_in_camera;
    options.mask_raster = run_.folder.radiance(photo.input->key);
    Hasher h = keyed("raycast");
    h.add(store_.manifest().key).add(photo.radiance_key);
    add_camera(h, photo.camera);
    h.add(static_cast<std::uint64_t>(options.subpixels)).add(options.cut.pixel_error);
    h.add(options.flash_in_camera ? std::uint64_t{1} : std::uint64_t{0});
    if (options.flash_in_camera)
      for (int i = 0; i < 3; ++i) h.add((*options.flash_in_camera)[i]);
    photo.gbuffer_key = h.hex();
    const Json info = run_.task("raycast/" + photo.input->key, photo.gbuffer_key, {run_.folder.gbuffer(photo.input->key)}, [&] {
      const surfels::GBufferStats s = surfels::write_gbuffer(store_, photo.camera, options, run_.folder.gbuffer(photo.input->key), run_.budget, run_.report);
      return Json{{"pixels", s.pixels}, {"pixels_hit", s.pixels_hit}, {"pixels_hit_in_mask", s.pixels_hit_in_mask}, {"pixels_from_behind", s.pixels_from_behind}, {"rays", s.rays}, {"shadow_rays", s.shadow_rays}, {"surfels", s.surfels},
                  {"chunks", s.chunks}, {"chunks_hidden", s.chunks_hidden}, {"tiles", s.tiles}};
    });
    if (const auto left = pixels_left_by_mask_.find(photo.input->key); left != pixels_left_by_mask_.end() && info.contains("pixels_hit_in_mask")) {
      masked_.used += left->second;
      masked_.on_cloud += info["pixels_hit"].get<std::uint64_t>();
      masked_.used_on_cloud += info["pixels_hit_in_mask"].get<std::uint64_t>();
    }
    if (info["pixels_hit"] == 0) {
      run_.leave_out(*photo.input, concat("it sees nothing of the cloud", far_camera(photo.camera.pose.centre_in_world(), store_.manifest().bounds, store_.manifest().unit).value_or("")));
      continue;
    }
    pixels_on_cloud_ += info["pixels_hit"].get<std::uint64_t>();
    pixels_from_behind_ += info["pixels_from_behind"].get<std::uint64_t>();
    run_.record.count("rays_primary", info["rays"]);
    run_.record.count("rays_shadow", info["shadow_rays"]);
    kept.push_back(std::move(photo));
  }
  shoot.photos = std::move(kept);
  require_photographs(shoots_);
}

void PhotographStages::note_masks() {
  const std::uint64_t beside = masked_.used - std::min(masked_.used, masked_.used_on_cloud);   // on the cloud clipped pixels count, too
  // A mask may well leave a small part of a large cloud, or some of what surrounds it, but hardly both.
  if (2 * masked_.used_on_cloud < masked_.used && 2 * masked_.used_on_cloud < masked_.on_cloud)
    run_.note_both(concat("the masks leave ", 100 * masked_.used_on_cloud / masked_.on_cloud, " % of what the photographs show of the cloud, and mostly pixels that do not show it: white is what is used. Are the masks the other way round, "
                          "or cameras and cloud not in one frame?"));
  else if (4 * beside > masked_.used)
    run_.note_both(concat(100 * beside / masked_.used, " % of the pixels that the masks leave show nothing of the cloud. Where the masks outline what was scanned, the cameras are not quite those of the cloud: "
                          "their distances (scale, unit), the focal length, or the frame"));
}

void PhotographStages::note_backs() {
  constexpr std::uint64_t kNoted = 20;   // a thin wall may well be seen from behind here and there
  run_.record.count("pixels_on_cloud", pixels_on_cloud_);
  run_.record.count("pixels_from_behind", pixels_from_behind_);
  if (pixels_from_behind_ * kNoted < pixels_on_cloud_) return;
  run_.note_both(concat(100 * pixels_from_behind_ / pixels_on_cloud_, " % of what the photographs show of the cloud, they see from behind by the cloud's normals, and such points stay unseen: do the normals of some scans "
                        "point inwards? cloud.normals = \"estimate\" does without them"));
}

}  // namespace chiaro::tools
