/// TOML files; values and tables of a project file, with complaints that say where in the file they lie. For the .cpp files that read projects and views only.
#pragma once
#include <algorithm>
#include <cstdint>
#include <filesystem>
#include <span>
#include <string>
#include <toml++/toml.h>
#include <vector>

#include "stream/base/error.h"
#include "tools/project_words.h"
#include "tools/suggest.h"

namespace chiaro::tools {

// The file -------------------------------------------------------------------------------------------------------------------------

/// `what` names what is expected, "a project file". throws UsageError where there is no such file or it is no TOML, with file, line and column; Error where it
/// cannot be read or is larger than 4 MiB.
toml::table parse_toml_file(const std::filesystem::path& path, const char* what);

// Positions ------------------------------------------------------------------------------------------------------------------------

/// "project.toml:12:5: ", or "--set solve.method=adm: " for what came from the command line.
std::string where(const toml::source_region& region);
[[noreturn]] void fail(const toml::source_region& region, const std::string& text);
[[noreturn]] void fail(const toml::node& node, const std::string& text);
const char* kind_of(const toml::node& node);
[[noreturn]] void wrong_kind(const toml::node& node, const std::string& key, const std::string& expected);

// Single values --------------------------------------------------------------------------------------------------------------------

/// Names of files and things: no empty text, no control characters (a path with a NUL byte would be another path).
std::string as_text(const toml::node& node, const std::string& key);
double as_number(const toml::node& node, const std::string& key);
std::int64_t as_whole(const toml::node& node, const std::string& key, std::int64_t min, std::int64_t max);
bool as_switch(const toml::node& node, const std::string& key);
std::vector<double> as_numbers(const toml::node& node, const std::string& key, std::size_t count);
std::uint64_t as_bytes(const toml::node& node, const std::string& key);

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

const toml::table& as_table(const toml::node& node, const std::string& key);
/// A table, or an array of tables: [acquisition] is one as good as [[acquisition]].
std::vector<const toml::table*> as_tables(const toml::node& node, const std::string& key);

/// overrides: see load_project(). Their values carry the option as their position. throws UsageError.
void apply_overrides(toml::table& root, std::span<const std::string> overrides);

}  // namespace chiaro::tools
