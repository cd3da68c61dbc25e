#include "tools/project_toml.h"

#include <cmath>
#include <filesystem>

#include "stream/base/budget.h"
#include "stream/base/file.h"

namespace chiaro::tools {
namespace {

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

}  // namespace

toml::table parse_toml_file(const std::filesystem::path& path, const char* what) {
  namespace fs = std::filesystem;
  constexpr std::uint64_t kMaxFileBytes = 4u << 20;
  std::error_code code;
  if (const fs::file_status status = fs::status(path, code); !fs::exists(status)) throw UsageError(concat(path.string(), ": no such file, expected ", what));
  else if (fs::is_directory(status)) throw UsageError(concat(path.string(), ": is a folder, expected ", what));
  const std::string text = read_text(path, kMaxFileBytes);
  const std::string shown = path.string();
  refuse_deep_keys(text, shown);
  try {
    return toml::parse(text, shown);
  } catch (const toml::parse_error& e) {
    throw UsageError(concat(shown, ':', e.source().begin.line, ':', e.source().begin.column, ": ", e.description()));
  }
}

std::string where(const toml::source_region& region) {
  if (!region.path) return "";
  if (region.path->starts_with("--set ") || !region.begin) return *region.path + ": ";
  return concat(*region.path, ':', region.begin.line, ':', region.begin.column, ": ");
}

void fail(const toml::source_region& region, const std::string& text) { throw UsageError(where(region) + text); }
void fail(const toml::node& node, const std::string& text) { fail(node.source(), text); }

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

void wrong_kind(const toml::node& node, const std::string& key, const std::string& expected) {
  fail(node, concat(key, ": expected ", expected, ", found ", kind_of(node)));
}

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

const toml::table& as_table(const toml::node& node, const std::string& key) {
  const auto* table = node.as_table();
  if (!table) wrong_kind(node, key, "a table");
  return *table;
}

std::vector<const toml::table*> as_tables(const toml::node& node, const std::string& key) {
  if (const auto* table = node.as_table()) return {table};
  const auto* array = node.as_array();
  if (!array) wrong_kind(node, key, "tables ([[" + key + "]])");
  std::vector<const toml::table*> tables;
  for (const toml::node& element : *array) tables.push_back(&as_table(element, key));
  return tables;
}

}  // namespace chiaro::tools
