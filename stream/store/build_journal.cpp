#include "stream/store/build_journal.h"

#include <nlohmann/json.hpp>

#include "stream/base/error.h"
#include "stream/store/store_format.h"

namespace chiaro::stream {
namespace fs = std::filesystem;
namespace {

fs::path journal_path(const fs::path& part) { return part / "journal.json"; }

}  // namespace

void write_journal(const fs::path& part, const BuildJournal& b) {
  nlohmann::ordered_json j;
  j["phase"] = static_cast<int>(b.phase);
  j["key"] = b.manifest.key;
  j["root_exponent"] = b.root.exponent;
  j["root_corner"] = b.root.corner;
  j["typical_spacing"] = b.typical_spacing;
  j["has_colour"] = b.has_colour;
  j["estimated_normals"] = b.estimated_normals;
  j["spill_bytes"] = b.spill_bytes;
  j["leaf_geometry_end"] = b.leaf_geometry_end;
  j["manifest"] = manifest_text(b.manifest);
  nlohmann::ordered_json partitions = nlohmann::ordered_json::array();
  for (const Partition& p : b.partitions) partitions.push_back({p.begin, p.count});
  j["partitions"] = std::move(partitions);
  write_sealed(journal_path(part), j.dump(1));
}

std::optional<BuildJournal> read_journal(const fs::path& part, const std::string& key) {
  if (!fs::exists(journal_path(part))) return std::nullopt;
  try {
    const auto j = nlohmann::json::parse(read_sealed(journal_path(part)));
    if (j.at("key").get<std::string>() != key) return std::nullopt;
    BuildJournal b;
    const int phase = j.at("phase").get<int>();
    if (phase < 0 || phase > static_cast<int>(BuildPhase::kLayers)) return std::nullopt;
    b.phase = static_cast<BuildPhase>(phase);
    b.root.exponent = j.at("root_exponent").get<int>();
    b.root.corner = j.at("root_corner").get<std::array<std::int64_t, 3>>();
    b.typical_spacing = j.at("typical_spacing").get<double>();
    b.has_colour = j.at("has_colour").get<bool>();
    b.estimated_normals = j.at("estimated_normals").get<std::uint64_t>();
    b.spill_bytes = j.at("spill_bytes").get<std::uint64_t>();
    b.leaf_geometry_end = j.at("leaf_geometry_end").get<std::uint64_t>();
    b.manifest = parse_manifest(journal_path(part), j.at("manifest").get<std::string>());
    for (const auto& p : j.at("partitions")) b.partitions.push_back({p.at(0).get<std::uint64_t>(), p.at(1).get<std::uint64_t>()});
    return b;
  } catch (const Error&) {
    return std::nullopt;
  } catch (const nlohmann::json::exception&) {
    return std::nullopt;
  }
}

void remove_journal(const fs::path& part) {
  std::error_code code;
  fs::remove(journal_path(part), code);
}

}  // namespace chiaro::stream
