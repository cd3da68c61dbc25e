/// chiaro synth SPEC --points N --out FILE: synthetic clouds of any size; with --photographs, whole projects.
#include <charconv>
#include <nlohmann/json.hpp>
#include <ostream>

#include "stream/base/budget.h"
#include "stream/base/error.h"
#include "stream/base/parallel.h"
#include "tools/args.h"
#include "tools/commands.h"
#include "tools/synth_project.h"
#include "tools/synth_write.h"
#include "tools/table.h"

namespace chiaro::tools {
namespace {

struct Words {
  std::string spec, file, project, size = "640x480";
  std::uint64_t points = 0;
  bool albedo = false;
  int threads = 0;
  SynthProjectOptions options;
};

void declare(Args& args, Words& words) {
  args.positional("SPEC", words.spec, "SCENE or SCENE:NAME=VALUE,...");
  args.option("-n,--points", words.points, "how many, 1 to 2^40", "N");
  args.option("-o,--out", words.file, ".ply, .las or .pcd; with --project a name in its folder (cloud.ply)", "FILE");
  args.flag("--albedo", words.albedo, "write albedo_r albedo_g albedo_b");
  args.option("--project", words.project, "write a folder for chiaro run: cloud, photographs, cameras, project.toml, truth/lights.json", "DIR");
  args.option("--photographs", words.options.photographs, "with --project: how many", "K", 1, 10000);
  args.option("--size", words.size, "of a photograph, pixels", "WxH");
  args.option("--focal", words.options.focal, "focal length over the shorter side of a photograph; 0 = nearly all of the scene is in each", "F", 0.0, 100.0);
  args.option("--samples", words.options.samples, "S^2 rays a pixel, each with a path for ambient and bounced light", "S", 1, 16);
  args.option("--bounces", words.options.bounces, "of the light between surfaces", "B", 0, kMostBounces);
  args.option("--ambient", words.options.ambient_radiance, "radiance of the sky, W/(sr m^2)", "L", 0.0, 1e6);
  args.option("--gloss", words.options.gloss_roughness, "roughness of a clear coat over all surfaces; 0 = matt", "A", 0.0, 1.0);
  args.flag("--no-flash", words.options.without_flash, "photograph each view once more without flash, to measure the ambient light");
  args.option("--threads", words.threads, "threads; 0 = all cores", "N", 0, 4096);
  args.require("--points");
}

/// "640x480".
void read_size(const std::string& text, SynthProjectOptions& options) {
  const char* end = text.data() + text.size();
  const auto [x, bad_width] = std::from_chars(text.data(), end, options.width_px);
  if (bad_width == std::errc() && x < end && *x == 'x') {
    const auto [rest, bad_height] = std::from_chars(x + 1, end, options.height_px);
    if (bad_height == std::errc() && rest == end) return;
  }
  throw UsageError(concat("--size ", text, ": expected width x height such as 640x480"));
}

void check(const Args& args, const Words& words) {
  if (words.points < 1 || words.points > std::uint64_t{1} << 40) throw UsageError(concat("--points ", words.points, ": expected 1 to ", std::uint64_t{1} << 40));
  if (words.project.empty() && words.file.empty()) throw UsageError("--out FILE is needed, or --project DIR");
  if (!words.project.empty()) return;
  for (const char* flag : {"--photographs", "--size", "--focal", "--samples", "--bounces", "--ambient", "--gloss", "--no-flash"})
    if (args.count(flag) > 0) throw UsageError(concat(flag, " needs --project DIR, where the photographs go"));
}

nlohmann::ordered_json json_of(const std::string& file, const SynthResult& r) {
  return {{"file", file}, {"points", r.points}, {"bytes", r.bytes}, {"area_m2", r.area_m2}, {"spacing_m", r.spacing_m}};
}

void print(const std::string& file, const SynthResult& r, Console& console) {
  console.out() << file << ": " << format_count(r.points) << " points, " << format_bytes(r.bytes);
  if (r.area_m2 > 0) console.out() << ", " << format_number(r.area_m2) << " m^2, spacing " << format_number(1000 * r.spacing_m) << " mm";
  console.out() << '\n';
}

void make_cloud(const Words& words, const SynthScene& scene, Console& console) {
  const SynthResult r = write_synth(scene, words.file, words.albedo, console.report());
  console.clear_line();
  if (!console.json) return print(words.file, r, console);
  console.result(json_of(words.file, r).dump(-1, ' ', false, nlohmann::ordered_json::error_handler_t::replace));
}

void make_project(Words& words, const SynthScene& scene, Console& console) {
  SynthProjectOptions& options = words.options;
  read_size(words.size, options);
  if (!words.file.empty()) options.cloud = words.file;
  options.with_albedo = words.albedo;
  const SynthProjectResult r = write_synth_project(scene, words.project, options, console.report());
  const std::string project = (std::filesystem::path(words.project) / "project.toml").string(), cloud = (std::filesystem::path(words.project) / options.cloud).string();
  console.clear_line();
  if (console.json) {
    nlohmann::ordered_json out = json_of(cloud, r.cloud);
    out.update(nlohmann::ordered_json{{"project", project}, {"photographs", r.photographs}, {"width", options.width_px}, {"height", options.height_px},
                                      {"flash_intensity", r.flash_intensity}, {"ambient", r.ambient_radiance}});
    return console.result(out.dump(-1, ' ', false, nlohmann::ordered_json::error_handler_t::replace));
  }
  print(cloud, r.cloud, console);
  console.out() << project << ": " << r.photographs << " photographs of " << options.width_px << " x " << options.height_px << " pixels, flash " << format_number(r.flash_intensity)
                << " W/sr, ambient radiance " << format_number(r.ambient_radiance) << '\n';
}

}  // namespace

int run_synth(std::span<const std::string> words, Console& console) {
  Args args("synth", "Writes a synthetic cloud, streamed from a seed: memory does not depend on its size. Points lie evenly on the surface.\n\n" + synth_spec_help() +
                         "With --albedo: red = 0.45 + 0.30 sin(12 x + 7 y), green = 0.45 + 0.30 sin(9 y + 8 z + 2), blue = 0.45 + 0.30 sin(11 z - 6 x + 4),\n"
                         "linear, x y z in metres of the scene before scale, offset and noise.\n\n"
                         "With --project: sphere, statue, wall or room painted so, with flash photographs taken all around it (along the wall, inside the room), rendered from the\n"
                         "formula of the surface, whatever the number of points: flash with falloff and cast shadows, grey ambient light, bounces, photon and read noise.\n"
                         "The room is closed: it has no ambient light.");
  Words given;
  declare(args, given);
  args.common(console);
  if (!args.parse(words, console)) return 0;
  check(args, given);
  const ThreadLimit limit(given.threads);
  const SynthScene scene(parse_synth_spec(given.spec), given.points);
  if (given.project.empty()) make_cloud(given, scene, console);
  else make_project(given, scene, console);
  return 0;
}

}  // namespace chiaro::tools
