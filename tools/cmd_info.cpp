/// chiaro info STORE: what a store holds.
#include <algorithm>
#include <map>
#include <nlohmann/json.hpp>
#include <ostream>
#include <system_error>

#include "stream/base/budget.h"
#include "stream/base/error.h"
#include "stream/store/layer.h"
#include "tools/args.h"
#include "tools/colour_source.h"
#include "tools/commands.h"
#include "tools/inserted_points.h"
#include "tools/table.h"

namespace chiaro::tools {
namespace fs = std::filesystem;
namespace {
using Json = nlohmann::ordered_json;

struct Level {
  std::uint64_t chunks = 0, leaves = 0, surfels = 0;
  double spacing_min = 1e300, spacing_max = 0;
};

std::map<int, Level> levels_of(const stream::Store& store) {
  std::map<int, Level> levels;
  for (const stream::ChunkEntry& chunk : store.chunks()) {
    Level& level = levels[chunk.level];
    ++level.chunks;
    level.leaves += chunk.is_leaf();
    level.surfels += chunk.count;
    level.spacing_min = std::min(level.spacing_min, static_cast<double>(chunk.spacing));
    level.spacing_max = std::max(level.spacing_max, static_cast<double>(chunk.spacing));
  }
  return levels;
}

std::uint64_t bytes_under(const fs::path& folder) {
  std::uint64_t bytes = 0;
  std::error_code code;
  for (fs::recursive_directory_iterator entry(folder, code), end; !code && entry != end; entry.increment(code)) {
    std::error_code size_error;
    const auto size = entry->is_regular_file(size_error) ? entry->file_size(size_error) : 0;
    if (!size_error) bytes += size;
  }
  return bytes;
}

const char* type_name(stream::FieldType type) {
  switch (type) {
    case stream::FieldType::kF32: return "f32";
    case stream::FieldType::kF16: return "f16";
    case stream::FieldType::kU16: return "u16";
    case stream::FieldType::kU8: return "u8";
  }
  return "?";
}

std::string field_text(const stream::LayerField& field) {
  return concat(field.name, ' ', field.components > 1 ? std::to_string(field.components) + " x " : "", type_name(field.type));
}

Json json_of(const stream::Layer& layer, const std::string& name) {
  Json fields = Json::array();
  for (const stream::LayerField& field : layer.fields()) fields.push_back({{"name", field.name}, {"type", type_name(field.type)}, {"components", field.components}});
  const Json provenance = Json::parse(layer.provenance_json(), nullptr, false);
  return {{"name", name}, {"record_bytes", layer.record_bytes()}, {"fields", fields}, {"provenance", provenance.is_discarded() ? Json(nullptr) : provenance}};
}

/// With what was inserted beside it.
Json layer_json(const stream::Store& store, const std::string& name) {
  Json out = json_of(stream::Layer(store, name), name);
  if (const auto inserted = open_inserted(store, name)) out["inserted"] = {{"store", inserted->store->path().string()}, {"points", inserted->seen()}};
  return out;
}

/// "joint, 12 photographs of day1": from what the layer says of itself.
std::string made_by(const stream::Layer& layer) {
  const Json provenance = Json::parse(layer.provenance_json(), nullptr, false);
  if (!provenance.is_object()) return "";
  std::string text;
  if (const Json method = provenance.value("method", Json()); method.is_string()) text = method.get<std::string>();
  if (const Json n = provenance.value("photographs", Json()); n.is_number_unsigned()) text += concat(", ", format_count(n.get<std::uint64_t>()), n == 1 ? " photograph" : " photographs");
  const char* join = " of ";
  for (const Json& name : provenance.value("acquisitions", Json::array())) {
    if (!name.is_string()) continue;
    text += join + name.get<std::string>();
    join = ", ";
  }
  return text;
}

Json json_of(const Vec3d& v) { return {v.x(), v.y(), v.z()}; }

std::string as_json(const stream::Store& store) {
  const stream::Manifest& m = store.manifest();
  Json out{{"store", store.path().string()}, {"format_version", m.format_version}, {"unit", m.unit}, {"bytes", bytes_under(store.path())}, {"points_read", m.points_read},
           {"points_stored", m.points_stored}, {"points_rejected", m.points_rejected}, {"surfels_inner", m.surfels_inner}, {"normals_from_file", m.normals_from_file},
           {"bounds", {{"min", json_of(m.bounds.min)}, {"max", json_of(m.bounds.max)}}}, {"origin", json_of(m.origin_in_world)}, {"edge", m.edge}, {"key", m.key}};
  out["sources"] = Json::array();
  for (std::size_t i = 0; i < m.source_files.size(); ++i)
    out["sources"].push_back({{"file", m.source_files[i]}, {"hash", i < m.source_fingerprints.size() ? m.source_fingerprints[i] : ""}, {"points", i < m.source_points.size() ? m.source_points[i] : 0}});
  out["levels"] = Json::array();
  for (const auto& [number, level] : levels_of(store))
    out["levels"].push_back({{"level", number}, {"chunks", level.chunks}, {"leaves", level.leaves}, {"surfels", level.surfels}, {"spacing_min", level.spacing_min}, {"spacing_max", level.spacing_max}});
  out["layers"] = Json::array();
  for (const std::string& name : stream::layer_names(store)) out["layers"].push_back(layer_json(store, name));
  return out.dump(-1, ' ', false, Json::error_handler_t::replace);
}

std::string box_text(const Vec3d& v) { return concat(format_number(v.x(), 9), "  ", format_number(v.y(), 9), "  ", format_number(v.z(), 9)); }

void print(const stream::Store& store, std::ostream& out) {
  const stream::Manifest& m = store.manifest();
  Table facts({"", ""}, {Table::Align::kLeft, Table::Align::kLeft});
  facts.row({"store", store.path().string()});
  facts.row({"format", concat("version ", m.format_version, ", unit ", m.unit)});
  facts.row({"on disk", format_bytes(bytes_under(store.path()))});
  facts.row({"points", concat(format_count(m.points_stored), " of ", format_count(m.points_read), " read")});
  for (const auto& [reason, count] : m.points_rejected) facts.row({"rejected", concat(format_count(count), " ", reason)});
  facts.row({"inner surfels", format_count(m.surfels_inner)});
  facts.row({"normals", m.normals_from_file ? "from the file" : "estimated"});
  facts.row({"lower corner", box_text(m.bounds.min)});
  facts.row({"upper corner", box_text(m.bounds.max)});
  facts.row({"extent", box_text(m.bounds.max - m.bounds.min)});
  for (const std::string& file : m.source_files) facts.row({"source", file});
  out << facts.text() << '\n';

  Table levels({"level", "chunks", "leaves", "surfels", concat("spacing from, ", m.unit), "to"});
  for (const auto& [number, level] : levels_of(store))
    levels.row({std::to_string(number), format_count(level.chunks), format_count(level.leaves), format_count(level.surfels), format_number(level.spacing_min, 3), format_number(level.spacing_max, 3)});
  out << levels.text();

  Table layers({"layer", "bytes a surfel", "fields", "made by"}, {Table::Align::kLeft, Table::Align::kRight, Table::Align::kLeft, Table::Align::kLeft});
  for (const std::string& name : stream::layer_names(store)) {
    const stream::Layer layer(store, name);
    std::string fields;
    for (const stream::LayerField& field : layer.fields()) fields += (fields.empty() ? "" : ", ") + field_text(field);
    std::string made = made_by(layer);
    if (const auto inserted = open_inserted(store, name)) made += concat("; ", format_count(inserted->seen()), " points inserted");
    layers.row({name, std::to_string(layer.record_bytes()), fields, made});
  }
  out << '\n' << layers.text();
}

}  // namespace

int run_info(std::span<const std::string> args, Console& console) {
  std::string dir;
  Args parser("info", "Describes a store: points, levels, layers, sources.");
  parser.positional("DIR", dir, "NAME.chiaro, or the folder of a run");
  parser.common(console);
  if (!parser.parse(args, console)) return 0;
  const stream::Store store(store_folder(dir));
  if (console.json) console.result(as_json(store));
  else print(store, console.out());
  return 0;
}

}  // namespace chiaro::tools
