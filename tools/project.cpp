#include "tools/project.h"

#include <algorithm>
#include <cmath>
#include <functional>
#include <limits>
#include <map>
#include <nlohmann/json.hpp>
#include <set>
#include <system_error>
#include <toml++/toml.h>

#include "stream/base/budget.h"
#include "stream/base/error.h"
#include "stream/base/file.h"
#include "tools/glob.h"
#include "tools/suggest.h"

namespace chiaro::tools {
namespace fs = std::filesystem;
namespace {

constexpr std::uint64_t kMaxFileBytes = 4u << 20;
constexpr std::size_t kMaxPhotographs = 1'000'000;

// Positions ------------------------------------------------------------------------------------------------------------------------

/// "project.toml:12:5: ", or "--set solve.method=adm: " for what came from the command line.
std::string where(const toml::source_region& region) {
  if (!region.path) return "";
  if (region.path->starts_with("--set ") || !region.begin) return *region.path + ": ";
  return concat(*region.path, ':', region.begin.line, ':', region.begin.column, ": ");
}

[[noreturn]] void fail(const toml::source_region& region, const std::string& text) { throw UsageError(where(region) + text); }
[[noreturn]] void fail(const toml::node& node, const std::string& text) { fail(node.source(), text); }

const char* kind_of(const toml::node& node) {
  switch (node.type()) {
    case toml::node_type::table: return "a table";
    case toml::node_type::array: return "an array";
    case toml::node_type::string: return "a text";
    case toml::node_type::integer: return "a whole number";
    case toml::node_type::floating_point: return "a number";
    case toml::node_type::boolean: return "true or false";
    default: return "a date or time";
  }
}

[[noreturn]] void wrong_kind(const toml::node& node, const std::string& key, const std::string& expected) {
  fail(node, concat(key, ": expected ", expected, ", found ", kind_of(node)));
}

// Single values --------------------------------------------------------------------------------------------------------------------

/// Names of files and things: no empty text, no control characters (a path with a NUL byte would be another path).
std::string as_text(const toml::node& node, const std::string& key) {
  const auto* text = node.as_string();
  if (!text) wrong_kind(node, key, "a text");
  if (text->get().empty()) fail(node, key + ": expected a text, found an empty one");
  for (const char c : text->get())
    if (static_cast<unsigned char>(c) < 0x20 || c == 0x7f) fail(node, key + ": control characters are not allowed");
  return text->get();
}

double as_number(const toml::node& node, const std::string& key) {
  double value = 0;
  if (const auto* number = node.as_floating_point()) value = number->get();
  else if (const auto* whole = node.as_integer()) value = static_cast<double>(whole->get());
  else wrong_kind(node, key, "a number");
  if (!std::isfinite(value)) fail(node, key + ": expected a finite number");
  return value;
}

std::int64_t as_whole(const toml::node& node, const std::string& key, std::int64_t min, std::int64_t max) {
  const auto* whole = node.as_integer();
  if (!whole) wrong_kind(node, key, "a whole number");
  if (whole->get() < min || whole->get() > max) fail(node, concat(key, ": ", whole->get(), " is outside ", min, " .. ", max));
  return whole->get();
}

bool as_switch(const toml::node& node, const std::string& key) {
  const auto* value = node.as_boolean();
  if (!value) wrong_kind(node, key, "true or false");
  return value->get();
}

std::vector<double> as_numbers(const toml::node& node, const std::string& key, std::size_t count) {
  const auto* array = node.as_array();
  if (!array) wrong_kind(node, key, concat("an array of ", count, " numbers"));
  if (array->size() != count) fail(node, concat(key, ": expected ", count, " numbers, found ", array->size()));
  std::vector<double> values;
  for (const toml::node& element : *array) values.push_back(as_number(element, key));
  return values;
}

std::uint64_t as_bytes(const toml::node& node, const std::string& key) {
  if (node.is_integer()) return static_cast<std::uint64_t>(as_whole(node, key, 1, std::int64_t{1} << 60));
  const std::string text = as_text(node, key);
  try {
    return parse_bytes(text);
  } catch (const UsageError& e) {
    fail(node, concat(key, ": ", e.what()));
  }
}

// Choices: one table of words an enumeration ---------------------------------------------------------------------------------------

template <class E>
using Words = std::vector<std::pair<const char*, E>>;
const Words<Normals>& words_of(Normals) { static const Words<Normals> w{{"auto", Normals::kAuto}, {"file", Normals::kFile}, {"estimate", Normals::kEstimate}, {"none", Normals::kNone}}; return w; }
const Words<Outliers>& words_of(Outliers) { static const Words<Outliers> w{{"none", Outliers::kNone}, {"statistical", Outliers::kStatistical}}; return w; }
const Words<Alignment>& words_of(Alignment) { static const Words<Alignment> w{{"none", Alignment::kNone}, {"icp", Alignment::kIcp}}; return w; }
const Words<Encoding>& words_of(Encoding) {
  static const Words<Encoding> w{{"auto", Encoding::kAuto}, {"linear", Encoding::kLinear}, {"srgb", Encoding::kSrgb}, {"raw", Encoding::kRaw}};
  return w;
}
const Words<AmbientModel>& words_of(AmbientModel) {
  static const Words<AmbientModel> w{{"auto", AmbientModel::kAuto}, {"none", AmbientModel::kNone}, {"uniform", AmbientModel::kUniform},
                                     {"sh1", AmbientModel::kSh1}, {"sh2", AmbientModel::kSh2}};
  return w;
}
const Words<FloorModel>& words_of(FloorModel) {
  static const Words<FloorModel> w{{"auto", FloorModel::kAuto}, {"none", FloorModel::kNone}};
  return w;
}
const Words<SolveMethod>& words_of(SolveMethod) {
  static const Words<SolveMethod> w{{"joint", SolveMethod::kJoint}, {"single", SolveMethod::kSingle}, {"adam", SolveMethod::kAdam},
                                    {"direct", SolveMethod::kDirect}, {"none", SolveMethod::kNone}};
  return w;
}
const Words<BlendGain>& words_of(BlendGain) {
  static const Words<BlendGain> w{{"none", BlendGain::kNone}, {"grey", BlendGain::kGrey}, {"channels", BlendGain::kChannels}};
  return w;
}
const Words<AcquisitionRole>& words_of(AcquisitionRole) {
  static const Words<AcquisitionRole> w{{"flash", AcquisitionRole::kFlash}, {"no_flash", AcquisitionRole::kNoFlash}};
  return w;
}

template <class E>
const char* word_of(E value) {
  for (const auto& [word, known] : words_of(value))
    if (known == value) return word;
  return "?";
}

template <class E>
E as_choice(const toml::node& node, const std::string& key, E example) {
  const std::string text = as_text(node, key);
  std::vector<std::string> known;
  for (const auto& [word, value] : words_of(example)) {
    if (text == word) return value;
    known.push_back(word);
  }
  fail(node, concat(key, ": unknown value \"", text, "\"", suggestion(text, known)));
}

// Tables ---------------------------------------------------------------------------------------------------------------------------

/// A table whose keys are all known: unknown ones are refused first, as a mistyped key would otherwise show up as something missing.
class Section {
 public:
  Section(const toml::table& table, std::string name, const std::vector<std::string>& keys) : table_(table), name_(std::move(name)) {
    for (const auto& [key, node] : table_) {
      if (std::find(keys.begin(), keys.end(), key.str()) != keys.end()) continue;
      const toml::source_region& region = key.source().begin ? key.source() : node.source();
      fail(region, concat("unknown key \"", key.str(), "\"", name_.empty() ? "" : " in [" + name_ + "]", suggestion(key.str(), keys)));
    }
  }

  const toml::node* find(const std::string& key) const { return table_.get(key); }
  const toml::node& need(const std::string& key, const std::string& hint) const {
    if (const toml::node* node = find(key)) return *node;
    fail(table_.source(), concat(path(key), " is missing: ", hint));
  }
  std::string path(const std::string& key) const { return name_.empty() ? key : name_ + "." + key; }

  template <class E>
  void choice(const std::string& key, E& value) const {
    if (const toml::node* node = find(key)) value = as_choice(*node, path(key), value);
  }
  void text(const std::string& key, std::string& value) const {
    if (const toml::node* node = find(key)) value = as_text(*node, path(key));
  }

 private:
  const toml::table& table_;
  std::string name_;
};

const toml::table& as_table(const toml::node& node, const std::string& key) {
  const auto* table = node.as_table();
  if (!table) wrong_kind(node, key, "a table");
  return *table;
}

/// A table, or an array of tables: [acquisition] is one as good as [[acquisition]].
std::vector<const toml::table*> as_tables(const toml::node& node, const std::string& key) {
  if (const auto* table = node.as_table()) return {table};
  const auto* array = node.as_array();
  if (!array) wrong_kind(node, key, "tables ([[" + key + "]])");
  std::vector<const toml::table*> tables;
  for (const toml::node& element : *array) tables.push_back(&as_table(element, key));
  return tables;
}

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
    if (matches.empty()) fail(*pattern, concat(key, ": ", has_wildcard(text) ? "no file matches \"" : "no such file: \"", text, "\" (from ", folder.string(), ")"));
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

std::string lower_extension(const fs::path& file) {
  std::string extension = file.extension().string();
  for (char& c : extension) c = static_cast<char>(c >= 'A' && c <= 'Z' ? c + 32 : c);
  return extension;
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
  project.metres_per_unit = project.unit == "mm" ? 1e-3 : project.unit == "cm" ? 1e-2 : 1.0;
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
  const Section section(table, "acquisition", {"name", "role", "photographs", "encoding", "masks", "cameras", "noise", "flash", "ambient", "reference", "exposure_s", "lights_of"});
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
    const auto [earlier, is_new] = stems.emplace(photograph.stem, file);
    if (!is_new)
      fail(photographs, concat("acquisition.photographs: ", earlier->second.filename().string(), " and ", file.filename().string(), " share the name \"", photograph.stem, "\""));
    acquisition.photographs.push_back(std::move(photograph));
  }
  resolve_encoding(photographs.source(), acquisition);
  if (const toml::node* masks = section.find("masks")) find_masks(*masks, "acquisition.masks", folder, acquisition, notes);
  const toml::node& cameras = section.need("cameras", "a COLMAP folder, a Metashape XML file, …");
  acquisition.cameras = (folder / as_text(cameras, "acquisition.cameras")).lexically_normal();
  std::error_code code;
  if (!fs::exists(acquisition.cameras, code)) fail(cameras, concat("acquisition.cameras: no such file or folder: ", acquisition.cameras.string()));
  if (const toml::node* noise = section.find("noise")) read_noise(*noise, "acquisition.noise", acquisition.noise);
  if (const toml::node* flash = section.find("flash")) read_flash(*flash, "acquisition.flash", acquisition.flash);
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

void read_exports(const toml::node* node, Project& project) {
  if (!node) return;
  project.exports.clear();
  std::set<std::string> files;
  for (const toml::table* table : as_tables(*node, "export")) {
    const Section section(*table, "export", {"file", "fill"});
    ExportInput one;
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

// Overrides ------------------------------------------------------------------------------------------------------------------------

std::string toml_quoted(const std::string& text) {
  std::string out = "\"";
  for (const char c : text) {
    if (c == '"' || c == '\\') out += '\\';
    if (static_cast<unsigned char>(c) < 0x20 || c == 0x7f) throw UsageError("--set: control characters are not allowed");
    out += c;
  }
  return out + '"';
}

/// The value as a document with the one key "v"; its nodes carry the option as their path.
toml::table parse_value(const std::string& value, const std::string& source) {
  try {
    toml::table table = toml::parse("v = " + value, source);
    if (table.size() == 1 && table.contains("v")) return table;
  } catch (const toml::parse_error&) {
  }
  try {
    return toml::parse("v = " + toml_quoted(value), source);
  } catch (const toml::parse_error& e) {
    throw UsageError(concat(source, ": ", e.description()));
  }
}

std::vector<std::string> split_key(const std::string& key, const std::string& source) {
  std::vector<std::string> parts;
  std::size_t from = 0;
  do {
    const std::size_t dot = std::min(key.find('.', from), key.size());
    parts.push_back(key.substr(from, dot - from));
    if (parts.back().empty()) throw UsageError(source + ": expected key=value with a dotted key such as solve.method=adam");
    from = dot + 1;
  } while (from <= key.size());
  if (parts.size() > 8) throw UsageError(source + ": the key has more than 8 parts");
  return parts;
}

struct Override {
  std::string source, value;
  std::vector<std::string> key;
};

void apply(toml::table& table, const Override& set, std::size_t depth);

void apply_to_array(toml::array& array, const Override& set, std::size_t depth) {
  const std::string& part = set.key[depth];
  if (part.find_first_not_of("0123456789") == std::string::npos && part.size() < 8) {
    const std::size_t index = std::stoul(part);
    if (index >= array.size() || !array[index].is_table() || depth + 1 == set.key.size())
      throw UsageError(concat(set.source, ": there is no table number ", index, " (the first is 0, there are ", array.size(), ")"));
    return apply(*array[index].as_table(), set, depth + 1);
  }
  // An element of that name, else all of them.
  for (toml::node& element : array) {
    toml::table* table = element.as_table();
    if (table && table->get("name") && table->get("name")->value_or(std::string()) == part && depth + 1 < set.key.size()) return apply(*table, set, depth + 1);
  }
  for (toml::node& element : array)
    if (toml::table* table = element.as_table()) apply(*table, set, depth);
}

void apply(toml::table& table, const Override& set, std::size_t depth) {
  const std::string& part = set.key[depth];
  if (depth + 1 == set.key.size()) {
    toml::table parsed = parse_value(set.value, set.source);
    std::move(*parsed.get("v")).visit([&](auto&& value) { table.insert_or_assign(part, std::move(value)); });
    return;
  }
  toml::node* next = table.get(part);
  if (!next) {
    // A new table with the option as its position: parsed, as positions cannot be set by hand.
    toml::table parsed = parse_value("{}", set.source);
    table.insert_or_assign(part, std::move(*parsed.get_as<toml::table>("v")));
    next = table.get(part);
  }
  if (next->is_table()) apply(*next->as_table(), set, depth + 1);
  else if (next->is_array_of_tables()) apply_to_array(*next->as_array(), set, depth + 1);
  else throw UsageError(concat(set.source, ": \"", part, "\" is ", kind_of(*next), ", not a table"));
}

std::string trimmed(const std::string& text) {
  const std::size_t begin = text.find_first_not_of(' '), end = text.find_last_not_of(' ');
  return begin == std::string::npos ? "" : text.substr(begin, end - begin + 1);
}

void apply_overrides(toml::table& root, std::span<const std::string> overrides) {
  for (const std::string& text : overrides) {
    Override set;
    set.source = "--set " + text;
    const std::size_t equals = text.find('=');
    if (equals == std::string::npos) throw UsageError(set.source + ": expected key=value");
    const std::string key = trimmed(text.substr(0, equals));
    set.value = trimmed(text.substr(equals + 1));
    set.key = split_key(key, set.source);
    apply(root, set, 0);
  }
}

// The file -------------------------------------------------------------------------------------------------------------------------

/// The parser builds a.b.c… as nested tables and takes them down recursively: a key with a hundred thousand dots would exhaust the stack.
void refuse_deep_keys(const std::string& text, const std::string& shown) {
  constexpr int kMaxDots = 500;
  int dots = 0, line = 1;
  for (const char c : text) {
    if (c == '.') ++dots;
    else if (std::string_view("=,{}[]#\n").find(c) != std::string_view::npos) dots = 0;
    if (dots > kMaxDots) throw UsageError(concat(shown, ':', line, ": a name with more than ", kMaxDots, " dots"));
    if (c == '\n') ++line;
  }
}

toml::table parse_file(const fs::path& path) {
  const std::string text = read_text(path, kMaxFileBytes);
  const std::string shown = path.string();
  refuse_deep_keys(text, shown);
  try {
    return toml::parse(text, shown);
  } catch (const toml::parse_error& e) {
    throw UsageError(concat(shown, ':', e.source().begin.line, ':', e.source().begin.column, ": ", e.description()));
  }
}

}  // namespace

const char* name_of(Normals value) { return word_of(value); }
const char* name_of(Outliers value) { return word_of(value); }
const char* name_of(Alignment value) { return word_of(value); }
const char* name_of(Encoding value) { return word_of(value); }
const char* name_of(AmbientModel value) { return word_of(value); }
const char* name_of(FloorModel value) { return word_of(value); }
const char* name_of(SolveMethod value) { return word_of(value); }
const char* name_of(BlendGain value) { return word_of(value); }
const char* name_of(AcquisitionRole value) { return word_of(value); }

Project load_project(const fs::path& path, std::span<const std::string> overrides) {
  toml::table root = parse_file(path);
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
  assign_keys(acquisitions, project);
  if (const toml::node* solve = section.find("solve")) {
    const Section method(as_table(*solve, "solve"), "solve", {"method"});
    method.choice("method", project.method);
  }
  if (const toml::node* blend = section.find("blend")) {
    const Section options(as_table(*blend, "blend"), "blend", {"reject", "gain", "align"});
    if (const toml::node* reject = options.find("reject")) project.blend.reject = as_switch(*reject, "blend.reject");
    if (const toml::node* align = options.find("align")) project.blend.align = as_switch(*align, "blend.align");
    options.choice("gain", project.blend.gain);
  }
  read_run(section.find("run"), project);
  read_exports(section.find("export"), project);
  return project;
}

fs::path default_output(const Project& project) { return project.file.parent_path() / (project.name + ".out"); }

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
  for (const fs::path& file : project.cloud.files) out["cloud"]["files"].push_back(file.string());
  out["acquisition"] = Json::array();
  for (const Acquisition& acquisition : project.acquisitions) {
    out["acquisition"].push_back(json_of(acquisition));
    if (acquisition.lights_of) out["acquisition"].back()["lights_of"] = project.acquisitions[*acquisition.lights_of].name;
  }
  out["solve"] = {{"method", name_of(project.method)}};
  out["blend"] = {{"reject", project.blend.reject}, {"gain", name_of(project.blend.gain)}, {"align", project.blend.align}};
  out["run"] = {{"memory", project.memory_bytes}, {"threads", project.threads}, {"seed", project.seed}};
  out["export"] = Json::array();
  for (const ExportInput& one : project.exports) out["export"].push_back({{"file", one.file}, {"fill", one.fill}});
  return out.dump(2, ' ', false, Json::error_handler_t::replace);
}

}  // namespace chiaro::tools
