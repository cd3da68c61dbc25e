#include "blend/identity.h"

#include <algorithm>

#include "blend/photo_window.h"
#include "stream/base/file.h"
#include "stream/base/hash.h"

namespace chiaro::blend {
namespace {

/// Content of a raster by its size and its ends: the checksums of all planes stand at the end of the file.
void add_raster(Hasher& hash, const std::filesystem::path& path) {
  constexpr std::uint64_t kHead = 8192, kTail = 65536;
  const File file(path, File::Mode::kRead);
  const std::uint64_t size = file.size();
  std::vector<std::byte> bytes(std::min(size, kHead));
  file.read_at(0, bytes.data(), bytes.size());
  hash.add(size).add_bytes(bytes.data(), bytes.size());
  bytes.resize(std::min(size, kTail));
  file.read_at(size - bytes.size(), bytes.data(), bytes.size());
  hash.add_bytes(bytes.data(), bytes.size());
}

}  // namespace

std::vector<const BlendPhotograph*> in_order_of_names(std::span<const BlendPhotograph> photographs) {
  std::vector<const BlendPhotograph*> sorted;
  for (const BlendPhotograph& p : photographs) sorted.push_back(&p);
  std::sort(sorted.begin(), sorted.end(), [](const BlendPhotograph* a, const BlendPhotograph* b) {
    return a->name != b->name ? a->name < b->name : a->albedo < b->albedo;
  });
  return sorted;
}

Scale scale_of(const std::vector<const BlendPhotograph*>& photographs, Reporter& report) {
  OctaveHistogram footprint, brightness;
  for (const BlendPhotograph* p : photographs) {
    report.check();
    const PhotographRasters rasters(p->camera.lens, p->gbuffer, p->albedo, p->radiance);
    footprint.merge(footprints(rasters));
    brightness.merge(brightnesses(rasters));
  }
  return {footprint.median(), brightness.median()};
}

WindowOptions window_options(const BlendOptions& options, const Scale& scale) {
  return {.low_radius = static_cast<float>(options.low_band_px) * scale.footprint, .reference_footprint = scale.footprint, .border_px = static_cast<float>(options.border_px), .wider = options.bands - 2};
}

std::string photograph_key(const BlendPhotograph& p) {
  Hasher hash;
  const stream::Lens& lens = p.camera.lens;
  hash.add(p.name).add(static_cast<std::uint64_t>(lens.kind));
  for (const double v : {lens.fx, lens.fy, lens.cx, lens.cy, lens.skew}) hash.add(v);
  for (const double v : lens.k) hash.add(v);
  for (const double v : lens.p) hash.add(v);
  for (int i = 0; i < 9; ++i) hash.add(p.camera.pose.rotation_camera_from_world(i / 3, i % 3));
  for (int i = 0; i < 3; ++i) hash.add(p.camera.pose.translation_camera_from_world[i]);
  if (p.camera.focus.aperture > 0) hash.add("focus").add(p.camera.focus.aperture).add(p.camera.focus.distance);
  add_raster(hash, p.gbuffer);
  add_raster(hash, p.albedo);
  add_raster(hash, p.radiance);
  return hash.hex();
}

std::string options_key(const stream::Store& store, const BlendOptions& options) {
  Hasher hash;
  hash.add("blend accumulators 9").add(store.manifest().key).add(std::uint64_t{store.chunks().size()});
  hash.add(options.low_band_px).add(options.border_px).add(options.high_band_power);
  hash.add(std::uint64_t{options.reject}).add(static_cast<std::uint64_t>(options.gain)).add(std::uint64_t{options.align});
  if (options.bands != 2) hash.add("bands").add(static_cast<std::uint64_t>(options.bands));
  return hash.hex();
}

}  // namespace chiaro::blend
