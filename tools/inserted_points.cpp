#include "tools/inserted_points.h"

#include <algorithm>
#include <nlohmann/json.hpp>
#include <system_error>

namespace chiaro::tools {
namespace fs = std::filesystem;
namespace {

/// A text of what a layer says of itself; "" where it says nothing.
std::string provenance(const stream::Layer& layer, const char* name) {
  const auto json = nlohmann::json::parse(layer.provenance_json(), nullptr, false);
  if (!json.is_object() || !json.contains(name) || !json[name].is_string()) return "";
  return json[name].get<std::string>();
}

constexpr const char *kFolder = "inserted", *kEnding = ".chiaro";

}  // namespace

fs::path inserted_path(const fs::path& store, const std::string& layer) { return store / kFolder / (layer + kEnding); }

std::uint64_t InsertedPoints::seen() const {
  std::uint64_t count = 0;
  for (const std::uint32_t leaf : store->leaves())
    for (const std::uint16_t photos : read_albedo(*layer, *store, leaf).photos) count += photos > 0;
  return count;
}

std::optional<InsertedPoints> open_inserted(const stream::Store& store, const std::string& layer) {
  std::error_code code;
  const fs::path path = inserted_path(store.path(), layer);
  if (!fs::exists(path / "manifest.json", code) || !stream::has_layer(store, layer)) return std::nullopt;
  InsertedPoints found;
  found.store = std::make_unique<stream::Store>(path);
  if (!stream::has_layer(*found.store, layer)) return std::nullopt;   // a run was stopped before it came so far
  found.layer = std::make_unique<stream::Layer>(*found.store, layer);
  const std::string key = provenance(stream::Layer(store, layer), "key");
  if (key.empty() || provenance(*found.layer, "of") != key) return std::nullopt;
  return found;
}

std::vector<fs::path> inserted_stores(const fs::path& store) {
  std::vector<fs::path> found;
  std::error_code code;
  for (fs::directory_iterator entry(store / kFolder, code), end; !code && entry != end; entry.increment(code)) {
    std::error_code ignored;
    if (entry->path().extension() == kEnding && fs::exists(entry->path() / "manifest.json", ignored)) found.push_back(entry->path());
  }
  std::sort(found.begin(), found.end());
  return found;
}

}  // namespace chiaro::tools
