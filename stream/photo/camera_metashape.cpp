// Metashape cameras.xml. source: the frame and fisheye camera models in the manual's appendix; Agisoft forum topic 6437 on the chunk transform.
#include <algorithm>
#include <map>
#include <pugixml.hpp>

#include "stream/base/error.h"
#include "stream/base/file.h"
#include "stream/photo/camera_files.h"
#include "stream/photo/camera_files_detail.h"

namespace chiaro::stream {
namespace {

constexpr std::size_t kMaxGroupDepth = 32;

/// x_world = rotation * scale * x_inside + translation
struct Similarity {
  Mat3d rotation = Mat3d::Identity();
  double scale = 1;
  Vec3d translation = Vec3d::Zero();
};

struct Sensor {
  std::string label, problem;  ///< problem: why its cameras cannot be used; empty = none
  bool rolling = false;
  Lens lens;
};

class Reader {
 public:
  Reader(const std::filesystem::path& path, std::vector<std::string>& notes) : path_(path.string()), notes_(notes), text_(read_text(path, 512u << 20)) {
    for (std::size_t i = 0; i < text_.size(); ++i)
      if (text_[i] == '\n') line_ends_.push_back(static_cast<std::ptrdiff_t>(i));
    const pugi::xml_parse_result result = document_.load_buffer(text_.data(), text_.size());
    if (!result)
      throw Error(concat(path_, ": line ", line_of(result.offset), ": not valid XML: ", result.description()));
  }

  std::vector<Camera> read() {
    const pugi::xml_node root = document_.child("document");
    if (!root) throw Error(concat(path_, ": no <document> found, expected a Metashape cameras file"));
    const pugi::xml_node chunk = find_chunk(root);
    read_sensors(chunk);
    if (const auto transform = read_similarity(chunk.child("transform"))) chunk_ = *transform;
    active_component_ = chunk.child("components").attribute("active_id").value();
    for (const pugi::xml_node component : chunk.child("components").children("component"))
      if (const auto transform = read_similarity(component.child("transform"))) components_[component.attribute("id").value()] = *transform;
    note_reference(chunk);
    read_group(chunk.child("cameras"));
    note_names("have no position in the file (not aligned) and are left out", unaligned_);
    note_names("belong to another component of the chunk than the active one, without a transform that would place them in its frame; they are left out", unplaced_);
    note_names("belong to a rig and have their position from another camera (master_id), which is not supported; they are left out", of_rigs_);
    note_names("have a rolling shutter in the file, which is not followed: each is taken as exposed at once", rolling_);
    note_names("are disabled in the file and are left out", disabled_);
    if (cameras_.empty()) notes_.push_back(concat(path_, ": holds no camera with a position"));
    return std::move(cameras_);
  }

 private:
  std::size_t line_of(std::ptrdiff_t offset) const {
    return 1 + static_cast<std::size_t>(std::lower_bound(line_ends_.begin(), line_ends_.end(), offset) - line_ends_.begin());
  }
  std::string where(const pugi::xml_node& node) const { return concat(path_, ": line ", line_of(node.offset_debug())); }

  pugi::xml_node find_chunk(const pugi::xml_node& root) {
    std::vector<pugi::xml_node> chunks;
    for (const pugi::xml_node chunk : root.children("chunk"))
      if (chunk.child("cameras") && is_enabled(chunk)) chunks.push_back(chunk);
    if (chunks.empty()) throw Error(concat(path_, ": no enabled <chunk> with <cameras> found, expected a Metashape cameras file"));
    if (chunks.size() > 1) throw Error(concat(path_, ": ", chunks.size(), " enabled chunks with cameras, expected one: export the cameras of one chunk"));
    return chunks.front();
  }

  static bool is_enabled(const pugi::xml_node& node) {
    const std::string_view value = node.attribute("enabled").value();
    return value != "false" && value != "0";
  }

  /// Versions differ in where they say it, and whether as a switch or by what was found.
  static bool is_rolling(const pugi::xml_node& node) {
    for (const pugi::xml_node child : node.children()) {
      const std::string_view name = child.name(), property = child.attribute("name").value(), text = child.text().get(), value = child.attribute("value").value();
      if (!name.starts_with("rolling_shutter") && !property.starts_with("rolling_shutter")) continue;
      const std::string_view says = value.empty() ? text : value;
      if (says != "false" && says != "0" && says != "disabled") return true;
    }
    return false;
  }

  double number(const pugi::xml_node& node, std::string_view word) const {
    const auto value = detail::parse_number<double>(word);
    if (!value) throw Error(concat(where(node), ": <", node.name(), "> holds \"", word.substr(0, 40), "\", expected a finite number"));
    return *value;
  }

  std::vector<double> numbers(const pugi::xml_node& node, std::size_t count) const {
    std::vector<double> out;
    std::string_view rest = node.text().get();
    for (std::string_view word = detail::take_word(rest); !word.empty(); word = detail::take_word(rest)) {
      if (out.size() == count) throw Error(concat(where(node), ": <", node.name(), "> holds more than ", count, " numbers"));
      out.push_back(number(node, word));
    }
    if (out.size() != count) throw Error(concat(where(node), ": <", node.name(), "> holds ", out.size(), " numbers, expected ", count));
    return out;
  }

  double child_number(const pugi::xml_node& parent, const char* name, double otherwise = 0) const {
    const pugi::xml_node node = parent.child(name);
    return node ? numbers(node, 1).front() : otherwise;
  }

  Mat3d checked_rotation(const Mat3d& rotation, const std::string& at) const {
    const double deviation = (rotation * rotation.transpose() - Mat3d::Identity()).cwiseAbs().maxCoeff();
    if (!(deviation <= 1e-4) || !(rotation.determinant() > 0))
      throw Error(concat(at, ": rotation is not orthonormal: R R^T differs from 1 by ", deviation, ", determinant ", rotation.determinant()));
    return rotation;
  }

  std::optional<Similarity> read_similarity(const pugi::xml_node& node) const {
    if (!node) return std::nullopt;
    Similarity out;
    if (const pugi::xml_node rotation = node.child("rotation")) {
      const std::vector<double> r = numbers(rotation, 9);
      out.rotation << r[0], r[1], r[2], r[3], r[4], r[5], r[6], r[7], r[8];
      out.rotation = checked_rotation(out.rotation, where(rotation));
    }
    if (const pugi::xml_node translation = node.child("translation")) {
      const std::vector<double> t = numbers(translation, 3);
      out.translation = {t[0], t[1], t[2]};
    }
    out.scale = child_number(node, "scale", 1);
    if (!(out.scale > 0)) throw Error(concat(where(node), ": scale is ", out.scale, ", expected a positive number"));
    return out;
  }

  int side(const pugi::xml_node& resolution, const char* name) const {
    const std::string_view text = resolution.attribute(name).value();
    const auto value = detail::parse_number<int>(text);
    if (!value || *value <= 0 || *value > (1 << 20))
      throw Error(concat(where(resolution), ": ", name, " is \"", text.substr(0, 40), "\", expected 1 to ", 1 << 20, " pixels"));
    return *value;
  }

  /// The adjusted calibration is the one the poses belong to; files may also hold the initial one.
  static pugi::xml_node best_calibration(const pugi::xml_node& sensor) {
    pugi::xml_node best;
    for (const pugi::xml_node calibration : sensor.children("calibration")) {
      if (std::string_view(calibration.attribute("class").value()) == "adjusted") return calibration;
      if (!best) best = calibration;
    }
    return best;
  }

  void read_sensors(const pugi::xml_node& chunk) {
    for (const pugi::xml_node node : chunk.child("sensors").children("sensor")) {
      Sensor sensor;
      sensor.label = node.attribute("label").value();
      sensor.rolling = is_rolling(node);
      const pugi::xml_node calibration = best_calibration(node);
      if (!calibration)
        sensor.problem = "has no <calibration>";
      else
        read_calibration(node, calibration, sensor);
      if (!sensors_.emplace(node.attribute("id").value(), std::move(sensor)).second)
        throw Error(concat(where(node), ": sensor \"", node.attribute("id").value(), "\" is given twice"));
    }
  }

  void note_unused(const pugi::xml_node& calibration, const std::string& label) const {
    constexpr const char* kUsed[] = {"resolution", "f", "cx", "cy", "b1", "b2", "k1", "k2", "k3", "k4", "p1", "p2", "p3", "p4"};
    constexpr const char* kAbout[] = {"date", "projection", "width", "height", "image", "covariance", "meta"};
    std::string unused;
    for (const pugi::xml_node child : calibration.children()) {
      const auto is = [&](const char* name) { return std::string_view(child.name()) == name; };
      const auto value = detail::parse_number<double>(detail::trimmed(child.text().get()));
      if (child.type() != pugi::node_element || std::any_of(std::begin(kUsed), std::end(kUsed), is) || std::any_of(std::begin(kAbout), std::end(kAbout), is) || (value && *value == 0)) continue;
      unused += concat(unused.empty() ? "" : ", ", child.name());
    }
    if (!unused.empty()) notes_.push_back(concat(path_, ": the calibration of sensor \"", label, "\" holds ", unused, ", which is not followed"));
  }

  void read_calibration(const pugi::xml_node& node, const pugi::xml_node& calibration, Sensor& sensor) const {
    std::string_view type = calibration.attribute("type").value();
    if (type.empty()) type = node.attribute("type").value();
    if (type == "equidistant_fisheye") type = "fisheye";  // as newer versions call it
    if (type != "frame" && type != "fisheye") {
      sensor.problem = concat("is of type \"", type, "\", expected frame or (equidistant) fisheye");
      return;
    }
    if (!calibration.child("f")) {
      sensor.problem = "has a calibration without <f> (written by a version before 1.2?)";
      return;
    }
    Lens& lens = sensor.lens;
    lens.kind = type == "frame" ? LensKind::kPerspective : LensKind::kFisheye;
    const pugi::xml_node resolution = calibration.child("resolution") ? calibration.child("resolution") : node.child("resolution");
    if (!resolution) throw Error(concat(where(calibration), ": calibration without <resolution>"));
    lens.width_px = side(resolution, "width");
    lens.height_px = side(resolution, "height");
    const double f = child_number(calibration, "f");
    lens.fx = f + child_number(calibration, "b1");
    lens.fy = f;
    lens.skew = child_number(calibration, "b2");
    lens.cx = 0.5 * lens.width_px + child_number(calibration, "cx");
    lens.cy = 0.5 * lens.height_px + child_number(calibration, "cy");
    note_unused(calibration, sensor.label);
    const bool frame = lens.kind == LensKind::kPerspective;
    lens.k[0] = child_number(calibration, "k1");
    lens.k[1] = child_number(calibration, "k2");
    lens.k[2] = child_number(calibration, "k3");
    lens.k[frame ? 6 : 3] = child_number(calibration, "k4");  // r^8 in both; in OpenCV's order k4 is the denominator
    lens.p = {child_number(calibration, "p2"), child_number(calibration, "p1"), child_number(calibration, "p3"), child_number(calibration, "p4")};
  }

  /// Groups nest; a stack instead of recursion, so that depth costs an error and not the process.
  void read_group(const pugi::xml_node& cameras) {
    std::vector<std::pair<pugi::xml_node, std::size_t>> open{{cameras.first_child(), 0}};
    while (!open.empty()) {
      const auto [node, depth] = open.back();
      if (!node) {
        open.pop_back();
        continue;
      }
      open.back().first = node.next_sibling();
      const std::string_view name = node.name();
      if (name == "camera") read_camera(node);
      if (name != "group") continue;
      if (depth >= kMaxGroupDepth) throw Error(concat(where(node), ": camera groups are nested more than ", kMaxGroupDepth, " deep"));
      open.emplace_back(node.first_child(), depth + 1);
    }
  }

  void read_camera(const pugi::xml_node& node) {
    const std::string label = node.attribute("label").value();
    if (!is_enabled(node)) return disabled_.push_back(label);
    const pugi::xml_node transform = node.child("transform");
    if (!transform) return (node.attribute("master_id") ? of_rigs_ : unaligned_).push_back(label);
    const std::string at = concat(where(node), ": camera \"", label, "\"");
    if (label.empty()) throw Error(concat(at, ": has no label"));
    const auto sensor = sensors_.find(node.attribute("sensor_id").value());
    if (sensor == sensors_.end()) throw Error(concat(at, ": sensor \"", node.attribute("sensor_id").value(), "\" is not in the file"));
    if (!sensor->second.problem.empty()) throw Error(concat(at, ": its sensor \"", sensor->second.label, "\" ", sensor->second.problem));

    const std::vector<double> m = numbers(transform, 16);
    if (!(std::abs(m[12]) + std::abs(m[13]) + std::abs(m[14]) + std::abs(m[15] - 1) <= 1e-6))
      throw Error(concat(at, ": last row of its transform is not 0 0 0 1"));
    Mat3d chunk_from_camera;
    chunk_from_camera << m[0], m[1], m[2], m[4], m[5], m[6], m[8], m[9], m[10];
    checked_rotation(chunk_from_camera, at);
    // A component that has a transform of its own is placed by it; the chunk's transform repeats the one of the active component, and says nothing of others.
    const std::string component_id = node.attribute("component_id").value();
    const auto component = components_.find(component_id);
    if (component == components_.end() && !active_component_.empty() && !component_id.empty() && component_id != active_component_) return unplaced_.push_back(label);
    const Similarity& world = component == components_.end() ? chunk_ : component->second;
    Camera camera;
    camera.photograph = label;
    camera.lens = sensor->second.lens;
    camera.pose.rotation_camera_from_world = chunk_from_camera.transpose() * world.rotation.transpose();
    const Vec3d centre = world.rotation * (world.scale * Vec3d(m[3], m[7], m[11])) + world.translation;
    camera.pose.translation_camera_from_world = -camera.pose.rotation_camera_from_world * centre;
    check_camera(camera, where(node));
    if (sensor->second.rolling || is_rolling(node)) rolling_.push_back(label);
    cameras_.push_back(std::move(camera));
  }

  void note_reference(const pugi::xml_node& chunk) {
    const std::string_view reference = chunk.child("reference").text().get();
    const bool geographic = reference.starts_with("GEOGCS") || reference.starts_with("PROJCS") || reference.starts_with("COMPD_CS");
    if (geographic)
      notes_.push_back(concat(path_, ": the chunk is georeferenced; its cameras are given in geocentric coordinates, which fit a cloud only if that was exported in them too"));
  }

  void note_names(const char* what, const std::vector<std::string>& names) {
    constexpr std::size_t kMaxNames = 12;
    if (names.empty()) return;
    std::string list;
    for (std::size_t i = 0; i < std::min(names.size(), kMaxNames); ++i) list += concat(i ? ", " : "", names[i]);
    notes_.push_back(concat(path_, ": ", names.size(), " cameras ", what, ": ", list, names.size() > kMaxNames ? ", ..." : ""));
  }

  std::string path_, active_component_;
  std::vector<std::string>& notes_;
  std::string text_;
  std::vector<std::ptrdiff_t> line_ends_;
  pugi::xml_document document_;
  Similarity chunk_;
  std::map<std::string, Similarity> components_;
  std::map<std::string, Sensor> sensors_;
  std::vector<Camera> cameras_;
  std::vector<std::string> unaligned_, disabled_, of_rigs_, unplaced_, rolling_;
};

}  // namespace

std::vector<Camera> detail::read_metashape(const std::filesystem::path& file, std::vector<std::string>& notes) { return Reader(file, notes).read(); }

}  // namespace chiaro::stream
