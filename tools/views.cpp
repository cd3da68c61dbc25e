#include "tools/views.h"

#include <algorithm>
#include <cmath>
#include <set>
#include <toml++/toml.h>

#include "stream/base/error.h"
#include "stream/photo/camera_files.h"
#include "tools/project_toml.h"
#include "tools/suggest.h"

namespace chiaro::tools {
namespace {

class ViewReader {
 public:
  explicit ViewReader(std::string file) : file_(std::move(file)) {}

  ViewInput read(const toml::table& t) const {
    known(t, {"name", "size", "camera", "rotation_camera_from_world", "translation_camera_from_world", "flash_offset_in_camera", "flash_intensity", "ambient_scale"});
    ViewInput v;
    v.name = text(t, "name");
    if (v.name.empty() || v.name.find('/') != std::string::npos || v.name[0] == '.') fail(t, concat("name \"", v.name, "\" is no file name"));
    const std::vector<double> size = numbers(need(t, "size"), 2, "size");
    if (!(size[0] >= 1 && size[0] <= 65536 && size[1] >= 1 && size[1] <= 65536)) fail(t, "size: expected two numbers from 1 to 65536");
    const toml::table* camera = need(t, "camera").as_table();
    if (!camera) fail(t, "camera: expected { model = …, params = […] }");
    known(*camera, {"model", "params"});
    const std::vector<double> params = numbers(need(*camera, "params"), 0, "params");
    const std::string where = concat(file_, ": view \"", v.name, "\"");
    stream::Camera c;
    try {
      c.lens = stream::lens_from_colmap(text(*camera, "model"), static_cast<int>(size[0]), static_cast<int>(size[1]), params, where);
      const toml::array* rows = need(t, "rotation_camera_from_world").as_array();
      if (!rows || rows->size() != 3) fail(t, "rotation_camera_from_world: expected three rows of three numbers");
      for (int r = 0; r < 3; ++r) {
        const std::vector<double> row = numbers(*rows->get(static_cast<std::size_t>(r)), 3, "rotation_camera_from_world");
        for (int k = 0; k < 3; ++k) c.pose.rotation_camera_from_world(r, k) = row[static_cast<std::size_t>(k)];
      }
      c.pose.translation_camera_from_world = vector(need(t, "translation_camera_from_world"), "translation_camera_from_world");
      c.photograph = v.name;
      stream::check_camera(c, where);
    } catch (const UsageError&) {
      throw;
    } catch (const Error& e) {
      throw UsageError(e.what());
    }
    v.lens = c.lens;
    v.pose = c.pose;
    if (const toml::node* n = t.get("flash_offset_in_camera")) v.flash_offset_in_camera = vector(*n, "flash_offset_in_camera");
    if (const toml::node* n = t.get("flash_intensity")) v.flash_intensity = positive(*n, "flash_intensity");
    if (const toml::node* n = t.get("ambient_scale")) v.ambient_scale = positive(*n, "ambient_scale");
    return v;
  }

  [[noreturn]] void fail(const toml::node& node, const std::string& what) const {
    throw UsageError(concat(file_, ":", node.source().begin.line, ":", node.source().begin.column, ": ", what));
  }
  void known(const toml::table& t, const std::vector<std::string>& keys) const {
    for (const auto& [key, node] : t)
      if (std::find(keys.begin(), keys.end(), std::string(key.str())) == keys.end()) fail(node, concat("unknown key \"", key.str(), "\"", suggestion(key.str(), keys)));
  }

 private:
  const toml::node& need(const toml::table& t, const char* key) const {
    const toml::node* n = t.get(key);
    if (!n) fail(t, concat("key \"", key, "\" is missing"));
    return *n;
  }
  std::string text(const toml::table& t, const char* key) const {
    const auto value = need(t, key).value<std::string>();
    if (!value || !need(t, key).is_string()) fail(need(t, key), concat(key, ": expected a text"));
    return *value;
  }
  double number(const toml::node& n, const char* key) const {
    const auto value = n.value<double>();
    if (!value || !std::isfinite(*value)) fail(n, concat(key, ": expected a finite number"));
    return *value;
  }
  double positive(const toml::node& n, const char* key) const {
    const double v = number(n, key);
    if (v < 0) fail(n, concat(key, ": ", v, " is negative"));
    return v;
  }
  /// count 0: any number of them, up to 16.
  std::vector<double> numbers(const toml::node& n, std::size_t count, const char* key) const {
    const toml::array* a = n.as_array();
    if (!a || (count > 0 && a->size() != count) || a->size() > 16) fail(n, concat(key, ": expected ", count > 0 ? std::to_string(count) : std::string("up to 16"), " numbers"));
    std::vector<double> out;
    for (const toml::node& e : *a) out.push_back(number(e, key));
    return out;
  }
  Vec3d vector(const toml::node& n, const char* key) const {
    const std::vector<double> v = numbers(n, 3, key);
    return {v[0], v[1], v[2]};
  }

  std::string file_;
};

}  // namespace

std::vector<ViewInput> load_views(const std::filesystem::path& path) {
  const toml::table root = parse_toml_file(path, "a file of views");
  const ViewReader reader(path.filename().string());
  reader.known(root, {"view"});
  const toml::array* list = root["view"].as_array();
  if (!list || list->empty()) throw UsageError(concat(path.filename().string(), ": no [[view]]"));
  std::vector<ViewInput> views;
  std::set<std::string> names;
  for (const toml::node& n : *list) {
    const toml::table* t = n.as_table();
    if (!t) reader.fail(n, "view: expected [[view]] tables");
    views.push_back(reader.read(*t));
    if (!names.insert(views.back().name).second) reader.fail(n, concat("two views are named \"", views.back().name, "\""));
  }
  return views;
}

}  // namespace chiaro::tools
