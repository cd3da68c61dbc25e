#include <algorithm>
#include <vector>

#include "stream/base/error.h"
#include "tools/project_toml.h"

namespace chiaro::tools {
namespace {

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

/// Parts between dots; a part in quotation marks may hold dots itself: acquisition."day 1.5".encoding.
std::vector<std::string> split_key(const std::string& key, const std::string& source) {
  std::vector<std::string> parts;
  std::size_t from = 0;
  do {
    std::size_t end = std::min(key.find('.', from), key.size());
    std::string part = key.substr(from, end - from);
    if (part.starts_with('"')) {
      const std::size_t close = key.find('"', from + 1);
      end = close + 1;
      if (close == std::string::npos || (end < key.size() && key[end] != '.')) throw UsageError(source + ": a quotation mark in the key is not closed");
      part = key.substr(from + 1, close - from - 1);
    }
    parts.push_back(part);
    if (parts.back().empty()) throw UsageError(source + ": expected key=value with a dotted key such as solve.method=adam");
    from = end + 1;
  } while (from <= key.size());
  if (parts.size() > 8) throw UsageError(source + ": the key has more than 8 parts");
  return parts;
}

/// Where the value begins: the first = outside of quotation marks.
std::size_t find_equals(const std::string& text) {
  bool quoted = false;
  for (std::size_t i = 0; i < text.size(); ++i) {
    if (text[i] == '"') quoted = !quoted;
    if (text[i] == '=' && !quoted) return i;
  }
  return std::string::npos;
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

}  // namespace

void apply_overrides(toml::table& root, std::span<const std::string> overrides) {
  for (const std::string& text : overrides) {
    Override set;
    set.source = "--set " + text;
    const std::size_t equals = find_equals(text);
    if (equals == std::string::npos) throw UsageError(set.source + ": expected key=value");
    const std::string key = trimmed(text.substr(0, equals));
    set.value = trimmed(text.substr(equals + 1));
    set.key = split_key(key, set.source);
    apply(root, set, 0);
  }
}

}  // namespace chiaro::tools
