#include "tools/project.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <map>
#include <set>
#include <system_error>

#include "stream/base/error.h"
#include "stream/base/file.h"
#include "stream/base/text.h"
#include "stream/store/layer.h"
#include "tools/glob.h"
#include "tools/project_toml.h"

namespace chiaro::tools {
namespace fs = std::filesystem;
namespace {

constexpr std::size_t kMaxPhotographs = 1'000'000;

// Files ----------------------------------------------------------------------------------------------------------------------------

/// Files named by a text or an array of texts, globs expanded in natural order. sorted: order over all patterns, else pattern by pattern.
std::vector<fs::path> as_files(const toml::node& node, const std::string& key, const fs::path& folder, bool sorted) {
  std::vector<const toml::node*> patterns;
  if (const auto* array = node.as_array())
    for (const toml::node& element : *array) patterns.push_back(&element);
  else
    patterns.push_back(&node);
  if (patterns.empty()) fail(node, key + ": no files named");
  std::vector<fs::path> files;
  std::set<fs::path> seen;
  for (const toml::node* pattern : patterns) {
    const std::string text = as_text(*pattern, key);
    const std::vector<fs::path> matches = expand_pattern(folder, text);
    if (matches.empty()) fail(*pattern, concat(key, ": ", has_wildcard(text) ? "no file matches \"" : "no such file: \"", text, "\" (from ", folder.string(), ")", text.find('\\') != std::string::npos ? "; paths are written with /, on Windows too" : ""));
    for (const fs::path& file : matches) {
      std::error_code code;
      if (!fs::is_regular_file(file, code)) fail(*pattern, concat(key, ": ", file.string(), " is not a file"));
      const fs::path canonical = fs::weakly_canonical(file, code);
      if (!seen.insert(code ? file : canonical).second) fail(*pattern, concat(key, ": ", file.string(), " is named twice"));
      files.push_back(file);
      if (files.size() > kMaxPhotographs) fail(node, concat(key, ": more than ", kMaxPhotographs, " files"));
    }
  }
  if (sorted) std::sort(files.begin(), files.end(), [](const fs::path& a, const fs::path& b) { return natural_less(a.string(), b.string()); });
  return files;
}

Encoding encoding_by_extension(const fs::path& file) {
  const std::string extension = lower_extension(file);
  for (const char* e : {".exr", ".tif", ".tiff", ".hdr"})
    if (extension == e) return Encoding::kLinear;
  for (const char* e : {".jpg", ".jpeg", ".png"})
    if (extension == e) return Encoding::kSrgb;
  return Encoding::kRaw;
}

// The sections ---------------------------------------------------------------------------------------------------------------------

void read_project(const toml::node* node, Project& project) {
  project.name = project.file.stem().string();
  if (!node) return;
  const Section section(as_table(*node, "project"), "project", {"name", "unit"});
  const toml::node* name = section.find("name");
  if (name) {
    project.name = as_text(*name, "project.name");
    // It becomes the name of a folder.
    if (project.name.find('/') != std::string::npos || project.name.front() == '.' || project.name.size() > 200)
      fail(*name, "project.name: expected a plain name without slashes and leading dot, at most 200 bytes");
  }
  if (const toml::node* unit = section.find("unit")) {
    project.unit = as_text(*unit, "project.unit");
    const std::vector<std::string> units{"m", "cm", "mm"};
    if (std::find(units.begin(), units.end(), project.unit) == units.end())
      fail(*unit, concat("project.unit: unknown unit \"", project.unit, "\"; known: m, cm, mm"));
  }
  project.metres_per_unit = stream::metres_per_unit(project.unit);
}

void read_cloud(const toml::node& node, const fs::path& folder, CloudInput& cloud) {
  const Section section(as_table(node, "cloud"), "cloud", {"files", "normals", "outliers", "align"});
  cloud.files = as_files(section.need("files", "the scan's files, e.g. files = [\"cloud.ply\"]"), "cloud.files", folder, false);
  section.choice("normals", cloud.normals);
  section.choice("outliers", cloud.outliers);
  section.choice("align", cloud.align);
}

void read_noise(const toml::node& node, const std::string& key, std::optional<NoiseInput>& noise) {
  const Section section(as_table(node, key), key, {"gain", "read_sigma"});
  NoiseInput values;
  if (const toml::node* gain = section.find("gain")) values.gain = as_number(*gain, key + ".gain");
  if (const toml::node* sigma = section.find("read_sigma")) values.read_sigma = as_number(*sigma, key + ".read_sigma");
  if (values.gain < 0 || values.read_sigma < 0) fail(node, key + ": gain and read_sigma must not be negative");
  if (!(values.gain > 0) && !(values.read_sigma > 0)) fail(node, key + ": gain or read_sigma must be positive; leave noise out to have it estimated");
  noise = values;
}

void read_binning(const toml::node& node, const std::string& key, std::optional<int>& binning) {
  constexpr std::int64_t kMost = 64;
  if (node.is_string() && as_text(node, key) == "auto") return;
  if (!node.is_integer()) fail(node, concat(key, ": expected \"auto\" or a whole number from 1 to ", kMost));
  binning = static_cast<int>(as_whole(node, key, 1, kMost));
}

void read_focus(const toml::node& node, const std::string& key, std::optional<FocusInput>& focus) {
  const Section section(as_table(node, key), key, {"distance", "f_number", "focal_length"});
  FocusInput values;
  const auto read = [&](const char* name, const char* what, double& value) {
    const toml::node& number = section.need(name, what);
    value = as_number(number, concat(key, '.', name));
    if (!(value > 0)) fail(number, concat(key, '.', name, ": expected a number above 0, found ", value));
  };
  read("distance", "how far from the camera the plane in focus lies, in project units", values.distance);
  read("f_number", "what the aperture was set to, e.g. 8", values.f_number);
  read("focal_length", "of the lens, in project units, e.g. 0.05 for 50 mm in metres", values.focal_length);
  if (!(values.distance > values.focal_length))
    fail(node, concat(key, ": a lens of focal length ", values.focal_length, " cannot be focused at distance ", values.distance, "; both are in project units"));
  focus = values;
}

void read_flash(const toml::node& node, const std::string& key, std::optional<FlashInput>& flash) {
  const Section section(as_table(node, key), key, {"offset_in_camera", "intensity_range"});
  FlashInput values;
  const auto offset = as_numbers(section.need("offset_in_camera", "[right, down, forward] in project units; [0, 0, 0] for a flash around the lens"),
                                 key + ".offset_in_camera", 3);
  values.offset_in_camera = Vec3d(offset[0], offset[1], offset[2]);
  if (const toml::node* range = section.find("intensity_range")) {
    const auto ends = as_numbers(*range, key + ".intensity_range", 2);
    if (!(ends[0] > 0)) fail(*range, concat(key, ".intensity_range: expected positive intensities in W/sr, found ", ends[0]));
    if (ends[0] > ends[1]) fail(*range, concat(key, ".intensity_range: minimum ", ends[0], " is greater than maximum ", ends[1]));
    values.intensity_range = {ends[0], ends[1]};
  }
  flash = values;
}

double polygon_area(const std::vector<Vec2d>& polygon) {
  double twice = 0;
  for (std::size_t i = 0; i < polygon.size(); ++i) {
    const Vec2d &a = polygon[i], &b = polygon[(i + 1) % polygon.size()];
    twice += a.x() * b.y() - a.y() * b.x();
  }
  return std::abs(twice) / 2;
}

std::vector<Vec2d> as_polygon(const toml::node& node, const std::string& key) {
  const auto* array = node.as_array();
  if (!array) wrong_kind(node, key, "an array of [x, y]");
  if (array->size() < 3) fail(node, concat(key, ": expected at least 3 corners, found ", array->size()));
  std::vector<Vec2d> polygon;
  for (const toml::node& corner : *array) {
    const auto xy = as_numbers(corner, key, 2);
    if (std::abs(xy[0]) > 1e6 || std::abs(xy[1]) > 1e6) fail(corner, key + ": no photograph is that large");
    polygon.push_back(Vec2d(xy[0], xy[1]));
  }
  if (!(polygon_area(polygon) > 0)) fail(node, key + ": the corners enclose no area");
  return polygon;
}

std::size_t find_photograph(const toml::node& node, const std::string& key, const Acquisition& acquisition) {
  const std::string text = as_text(node, key);
  std::vector<std::string> stems;
  for (std::size_t i = 0; i < acquisition.photographs.size(); ++i) {
    const PhotographInput& photograph = acquisition.photographs[i];
    if (text == photograph.stem || text == photograph.file.filename().string()) return i;
    stems.push_back(photograph.stem);
  }
  const auto best = nearest(text, stems);
  fail(node, concat(key, ": \"", text, "\" is none of the photographs of \"", acquisition.name, "\"", best ? "; did you mean \"" + *best + "\"?" : ""));
}

ReferenceInput read_reference(const toml::table& table, const std::string& key, const Acquisition& acquisition) {
  const Section section(table, key, {"photograph", "polygon", "albedo", "sigma"});
  ReferenceInput reference;
  reference.photograph = find_photograph(section.need("photograph", "name or stem of the photograph that shows it"), key + ".photograph", acquisition);
  reference.polygon = as_polygon(section.need("polygon", "its corners in pixels, [[x, y], …]"), key + ".polygon");
  const toml::node& albedo = section.need("albedo", "linear red, green, blue in (0, 1]");
  const auto values = as_numbers(albedo, key + ".albedo", 3);
  for (std::size_t c = 0; c < 3; ++c) {
    if (!(values[c] > 0 && values[c] <= 1)) fail(albedo, concat(key, ".albedo: ", values[c], " is outside (0, 1]"));
    reference.albedo[c] = values[c];
  }
  if (const toml::node* sigma = section.find("sigma")) {
    reference.sigma = as_number(*sigma, key + ".sigma");
    if (!(reference.sigma > 0)) fail(*sigma, concat(key, ".sigma: expected a positive relative deviation, found ", reference.sigma));
  }
  return reference;
}

/// Masks by the pattern. None at all is a mistake; a few missing ones leave their photographs whole, and the user is told.
void find_masks(const toml::node& node, const std::string& key, const fs::path& folder, Acquisition& acquisition, std::vector<std::string>& notes) {
  acquisition.masks = as_text(node, key);
  std::vector<std::string> missing;
  for (PhotographInput& photograph : acquisition.photographs) {
    std::string text = acquisition.masks;
    constexpr std::string_view kStem = "{stem}";
    for (std::size_t at = text.find(kStem); at != std::string::npos; at = text.find(kStem, at + photograph.stem.size()))
      text.replace(at, kStem.size(), photograph.stem);
    const fs::path file = (folder / text).lexically_normal();
    std::error_code code;
    if (fs::is_regular_file(file, code)) photograph.mask = file;
    else missing.push_back(photograph.stem);
  }
  if (missing.size() == acquisition.photographs.size())
    fail(node, concat(key, ": no photograph has a mask \"", acquisition.masks, "\" (from ", folder.string(), ")"));
  if (missing.empty()) return;
  std::string list;
  for (std::size_t i = 0; i < std::min<std::size_t>(missing.size(), 10); ++i) list += (i ? ", " : "") + missing[i];
  notes.push_back(concat("acquisition ", acquisition.name, ": ", missing.size(), " of ", acquisition.photographs.size(), " photographs have no mask and are used whole: ",
                         list, missing.size() > 10 ? ", …" : ""));
}

void resolve_encoding(const toml::source_region& region, Acquisition& acquisition) {
  if (acquisition.encoding != Encoding::kAuto) return;
  acquisition.encoding = encoding_by_extension(acquisition.photographs.front().file);
  for (const PhotographInput& photograph : acquisition.photographs)
    if (encoding_by_extension(photograph.file) != acquisition.encoding)
      fail(region, concat("acquisition \"", acquisition.name, "\": ", acquisition.photographs.front().file.filename().string(), " and ",
                          photograph.file.filename().string(), " are of different kinds; say encoding = \"linear\", \"srgb\" or \"raw\""));
}

void read_floor_plane(const toml::node& node, Acquisition& acquisition) {
  const auto values = as_numbers(node, "acquisition.ambient.floor", 4);
  acquisition.floor_plane.emplace();
  std::copy_n(values.begin(), 4, acquisition.floor_plane->begin());
  if (!(std::hypot(values[0], values[1], values[2]) > 0)) fail(node, "acquisition.ambient.floor: expected [nx, ny, nz, h] with an upward direction that is not 0");
}

Acquisition read_acquisition(const toml::table& table, std::size_t number, const fs::path& folder, std::vector<std::string>& notes) {
  const Section section(table, "acquisition", {"name", "role", "photographs", "encoding", "masks", "cameras", "noise", "binning", "flash", "focus", "falloff", "ambient", "reference", "exposure_s", "lights_of"});
  Acquisition acquisition;
  acquisition.name = concat("acquisition", number + 1);
  section.text("name", acquisition.name);
  section.choice("role", acquisition.role);
  section.choice("encoding", acquisition.encoding);
  const toml::node& photographs = section.need("photographs", "their files, e.g. photographs = [\"photos/photo_*.exr\"]");
  std::map<std::string, fs::path> stems;
  for (const fs::path& file : as_files(photographs, "acquisition.photographs", folder, true)) {
    PhotographInput photograph;
    photograph.file = file;
    photograph.stem = photograph.key = file.stem().string();
    if (!is_utf8(photograph.stem))
      fail(photographs, concat("acquisition.photographs: ", file.lexically_relative(folder).string(), ": its name is not UTF-8, as it has to be to name its results: rename it, and in the cameras' file too"));
    const auto [earlier, is_new] = stems.emplace(photograph.stem, file);
    if (!is_new)
      fail(photographs, concat("acquisition.photographs: ", earlier->second.lexically_relative(folder).string(), " and ", file.lexically_relative(folder).string(), " share the name \"", photograph.stem,
                               "\", which names their results: rename one of them, or make each folder an acquisition of its own"));
    acquisition.photographs.push_back(std::move(photograph));
  }
  resolve_encoding(photographs.source(), acquisition);
  if (const toml::node* masks = section.find("masks")) find_masks(*masks, "acquisition.masks", folder, acquisition, notes);
  const toml::node& cameras = section.need("cameras", "a COLMAP folder, a Metashape XML file, …");
  acquisition.cameras = (folder / as_text(cameras, "acquisition.cameras")).lexically_normal();
  std::error_code code;
  if (!fs::exists(acquisition.cameras, code)) fail(cameras, concat("acquisition.cameras: no such file or folder: ", acquisition.cameras.string()));
  if (const toml::node* noise = section.find("noise")) read_noise(*noise, "acquisition.noise", acquisition.noise);
  if (const toml::node* binning = section.find("binning")) read_binning(*binning, "acquisition.binning", acquisition.binning);
  if (const toml::node* flash = section.find("flash")) read_flash(*flash, "acquisition.flash", acquisition.flash);
  if (const toml::node* focus = section.find("focus")) read_focus(*focus, "acquisition.focus", acquisition.focus);
  section.choice("falloff", acquisition.falloff);
  if (const toml::node* ambient = section.find("ambient")) {
    const Section light(as_table(*ambient, "acquisition.ambient"), "acquisition.ambient", {"model", "floor"});
    light.choice("model", acquisition.ambient);
    if (const toml::node* floor = light.find("floor"); floor && floor->is_array()) read_floor_plane(*floor, acquisition);
    else light.choice("floor", acquisition.floor);
  }
  if (const toml::node* exposure = section.find("exposure_s")) {
    acquisition.exposure_s = as_number(*exposure, "acquisition.exposure_s");
    if (!(*acquisition.exposure_s > 0)) fail(*exposure, concat("acquisition.exposure_s: expected a shutter time above 0 in seconds, found ", *acquisition.exposure_s));
  }
  if (acquisition.role == AcquisitionRole::kNoFlash && acquisition.flash)
    fail(table.source(), concat("acquisition \"", acquisition.name, "\": role = \"no_flash\" and a flash exclude each other"));
  if (const toml::node* references = section.find("reference"))
    for (const toml::table* reference : as_tables(*references, "acquisition.reference"))
      acquisition.references.push_back(read_reference(*reference, "acquisition.reference", acquisition));
  return acquisition;
}

/// lights_of = "NAME": an acquisition with a flash. Photographs without flash belong to the one before them, else to the first, unless they say otherwise.
void join_lights(const toml::node& node, Project& project) {
  std::vector<Acquisition>& all = project.acquisitions;
  const auto leads = [&](std::size_t i, const std::vector<const toml::table*>& tables) { return all[i].role == AcquisitionRole::kFlash && !tables[i]->contains("lights_of"); };
  const std::vector<const toml::table*> tables = as_tables(node, "acquisition");
  std::vector<std::string> names;
  for (const Acquisition& a : all) names.push_back(a.name);
  for (std::size_t i = 0; i < all.size(); ++i) {
    if (const toml::node* named = tables[i]->get("lights_of")) {
      const std::string text = as_text(*named, "acquisition.lights_of");
      const auto at = static_cast<std::size_t>(std::find(names.begin(), names.end(), text) - names.begin());
      if (at == names.size()) {
        const auto best = nearest(text, names);
        fail(*named, concat("acquisition.lights_of: \"", text, "\" is none of the acquisitions", best ? "; did you mean \"" + *best + "\"?" : ""));
      }
      if (!leads(at, tables)) fail(*named, concat("acquisition.lights_of: \"", text, "\" must be an acquisition with a flash that shares nobody else's lights"));
      all[i].lights_of = at;
    } else if (all[i].role == AcquisitionRole::kNoFlash) {
      for (std::size_t j = 0; j < all.size(); ++j)
        if (leads(j, tables) && (!all[i].lights_of || j < i)) all[i].lights_of = j;
      if (!all[i].lights_of) fail(tables[i]->source(), concat("acquisition \"", all[i].name, "\": without flash it measures the ambient light of another acquisition, and there is none with a flash"));
    }
    if (!all[i].lights_of) continue;
    const Acquisition& lead = all[*all[i].lights_of];
    if (all[i].exposure_s.has_value() != lead.exposure_s.has_value())
      fail(tables[i]->source(), concat("acquisitions \"", all[i].name, "\" and \"", lead.name, "\" share their lights: give exposure_s for both, or for neither where the shutter times are the same"));
  }
}

void read_acquisitions(const toml::node& node, const fs::path& folder, Project& project) {
  std::set<std::string> names;
  for (const toml::table* table : as_tables(node, "acquisition")) {
    project.acquisitions.push_back(read_acquisition(*table, project.acquisitions.size(), folder, project.notes));
    const std::string& name = project.acquisitions.back().name;
    if (name.find('/') != std::string::npos || name.front() == '.') fail(table->source(), concat("acquisition.name: \"", name, "\" must not hold slashes or begin with a dot"));
    if (!names.insert(name).second) fail(table->source(), concat("acquisition.name: two acquisitions are called \"", name, "\""));
  }
  if (project.acquisitions.empty()) fail(node, "acquisition: none given");
  join_lights(node, project);
}

/// One photograph has one flash setting. Without flash it may measure the ambient light of several acquisitions.
void refuse_shared_photographs(const toml::node& node, const Project& project) {
  std::map<fs::path, const Acquisition*> owners;
  for (const Acquisition& acquisition : project.acquisitions) {
    if (acquisition.role == AcquisitionRole::kNoFlash) continue;
    for (const PhotographInput& photograph : acquisition.photographs) {
      std::error_code code;
      const fs::path canonical = fs::weakly_canonical(photograph.file, code);
      const auto [owner, is_new] = owners.emplace(code ? photograph.file : canonical, &acquisition);
      if (!is_new) fail(node, concat("acquisition.photographs: ", photograph.file.string(), " belongs to \"", owner->second->name, "\" and to \"", acquisition.name, "\", and would count twice"));
    }
  }
}

/// Folder names of photographs: the stem where that is unique over the project.
void assign_keys(const toml::node& node, Project& project) {
  std::map<std::string, int> uses;
  for (const Acquisition& acquisition : project.acquisitions)
    for (const PhotographInput& photograph : acquisition.photographs) ++uses[photograph.stem];
  std::set<std::string> keys;
  for (Acquisition& acquisition : project.acquisitions)
    for (PhotographInput& photograph : acquisition.photographs) {
      if (uses[photograph.stem] > 1) photograph.key = acquisition.name + "." + photograph.stem;
      if (!keys.insert(photograph.key).second)
        fail(node, concat("acquisition: two photographs would both be called \"", photograph.key, "\"; rename an acquisition"));
    }
}

void read_run(const toml::node* node, Project& project) {
  if (!node) return;
  const Section section(as_table(*node, "run"), "run", {"memory", "threads", "seed"});
  if (const toml::node* memory = section.find("memory")) project.memory_bytes = as_bytes(*memory, "run.memory");
  if (const toml::node* threads = section.find("threads")) project.threads = static_cast<int>(as_whole(*threads, "run.threads", 0, 4096));
  if (const toml::node* seed = section.find("seed"))
    project.seed = static_cast<std::uint64_t>(as_whole(*seed, "run.seed", 0, std::numeric_limits<std::int64_t>::max()));
}

/// A folder in the store, and a file's name where no export is named.
void read_layer(const Section& blend, std::string& layer) {
  const toml::node* node = blend.find("layer");
  if (!node) return;
  layer = as_text(*node, "blend.layer");
  if (!stream::is_layer_name(layer)) fail(*node, "blend.layer: expected letters, digits, '_', '-' and '.', at most 128, no dot in front and neither .part nor .old at the end");
  if (layer == "input") fail(*node, "blend.layer: \"input\" is the layer of the cloud's own colour");
}

void read_blend(const toml::node* node, BlendInput& blend) {
  if (!node) return;
  const Section section(as_table(*node, "blend"), "blend", {"layer", "bands", "keep", "reject", "gain", "align", "denoise", "refine", "refine_points"});
  read_layer(section, blend.layer);
  if (const toml::node* bands = section.find("bands")) blend.bands = static_cast<int>(as_whole(*bands, "blend.bands", 2, 4));
  if (const toml::node* keep = section.find("keep")) blend.keep = as_switch(*keep, "blend.keep");
  if (const toml::node* reject = section.find("reject")) blend.reject = as_switch(*reject, "blend.reject");
  if (const toml::node* align = section.find("align")) blend.align = as_switch(*align, "blend.align");
  if (const toml::node* denoise = section.find("denoise")) blend.denoise = as_switch(*denoise, "blend.denoise");
  section.choice("gain", blend.gain);
  section.choice("refine", blend.refine);
  constexpr std::int64_t kMostPoints = 1'000'000'000'000;
  if (const toml::node* points = section.find("refine_points")) blend.refine_points = static_cast<std::uint64_t>(as_whole(*points, "blend.refine_points", 1, kMostPoints));
}

void read_exports(const toml::node* node, Project& project) {
  for (ExportInput& one : project.exports) one.file = project.blend.layer + ".ply";
  if (!node) return;
  project.exports.clear();
  std::set<std::string> files;
  for (const toml::table* table : as_tables(*node, "export")) {
    const Section section(*table, "export", {"file", "fill"});
    ExportInput one;
    one.file = project.blend.layer + ".ply";
    // `--set export.fill=true` on a project without [[export]] means the default file.
    if (const toml::node* file = section.find("file")) {
      one.file = as_text(*file, "export.file");
      const std::string extension = lower_extension(one.file);
      if (extension != ".ply" && extension != ".las" && extension != ".pcd")
        fail(*file, concat("export.file: \"", one.file, "\": expected .ply, .las or .pcd"));
    }
    if (const toml::node* fill = section.find("fill")) one.fill = as_switch(*fill, "export.fill");
    if (!files.insert(fs::path(one.file).lexically_normal().string()).second) fail(table->source(), concat("export.file: ", one.file, " is written twice"));
    project.exports.push_back(std::move(one));
  }
}

}  // namespace

Project load_project(const fs::path& path, std::span<const std::string> overrides) {
  toml::table root = parse_toml_file(path, "a project file");
  apply_overrides(root, overrides);
  Project project;
  std::error_code code;
  project.file = fs::absolute(path, code).lexically_normal();
  if (code) throw Error(concat(path.string(), ": ", code.message()));
  const fs::path folder = project.file.parent_path();

  const Section section(root, "", {"project", "cloud", "acquisition", "solve", "blend", "run", "export"});
  read_project(section.find("project"), project);
  read_cloud(section.need("cloud", "[cloud] with files = [\"cloud.ply\"]"), folder, project.cloud);
  const toml::node& acquisitions = section.need("acquisition", "[[acquisition]] with photographs and cameras");
  read_acquisitions(acquisitions, folder, project);
  refuse_shared_photographs(acquisitions, project);
  assign_keys(acquisitions, project);
  if (const toml::node* solve = section.find("solve")) {
    const Section method(as_table(*solve, "solve"), "solve", {"method"});
    method.choice("method", project.method);
  }
  read_blend(section.find("blend"), project.blend);
  read_run(section.find("run"), project);
  read_exports(section.find("export"), project);
  return project;
}

fs::path default_output(const Project& project) { return project.file.parent_path() / (project.name + ".out"); }

}  // namespace chiaro::tools
