/// Reading JSON that this program wrote earlier, with errors that name the file. For .cpp files only.
#pragma once
#include <cmath>
#include <filesystem>
#include <nlohmann/json.hpp>

#include "stream/base/error.h"
#include "stream/base/file.h"

namespace chiaro::tools {

using Json = nlohmann::ordered_json;

/// throws Error if the file is missing, is not JSON, or is not an object.
inline Json read_json_object(const std::filesystem::path& path) {
  const std::string text = read_text(path);
  // The parser takes nested brackets down recursively: ours nest a few levels.
  int depth = 0;
  for (const char c : text) {
    depth += (c == '[' || c == '{') - (c == ']' || c == '}');
    if (depth > 500) throw Error(concat(path.string(), ": damaged: brackets nest deeper than 500"));
  }
  Json json;
  try {
    json = Json::parse(text);
  } catch (const nlohmann::json::exception& e) {
    throw Error(concat(path.string(), ": damaged: ", e.what()));
  }
  if (!json.is_object()) throw Error(concat(path.string(), ": damaged: expected a JSON object"));
  return json;
}

/// The member, or null where there is none or `json` is no object.
inline const Json& member(const Json& json, const char* name) {
  static const Json kNull;
  if (!json.is_object()) return kNull;
  const auto found = json.find(name);
  return found == json.end() ? kNull : *found;
}
inline std::string text_of(const Json& json, const std::string& otherwise = "") { return json.is_string() ? json.get<std::string>() : otherwise; }
inline double number_of(const Json& json, double otherwise = NAN) { return json.is_number() ? json.get<double>() : otherwise; }
inline std::uint64_t count_of(const Json& json) {
  if (json.is_number_unsigned()) return json.get<std::uint64_t>();
  return json.is_number_integer() && json.get<std::int64_t>() > 0 ? static_cast<std::uint64_t>(json.get<std::int64_t>()) : 0;
}

/// Paths built from names in a file must stay inside the folder. throws Error.
inline void require_plain_name(const std::string& name, const std::filesystem::path& file, const char* what) {
  if (name.empty() || name == "." || name == ".." || name.find('/') != std::string::npos || name.find('\0') != std::string::npos)
    throw Error(concat(file.string(), ": damaged: \"", name, "\" cannot be the name of ", what));
}

/// NaN and infinity have no JSON number: null.
inline Json json_or_null(double value) { return std::isfinite(value) ? Json(value) : Json(nullptr); }

}  // namespace chiaro::tools
