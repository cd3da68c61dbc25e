#include "tools/glob.h"

#include <algorithm>
#include <cctype>
#include <system_error>

namespace chiaro::tools {
namespace fs = std::filesystem;
namespace {

bool is_digit(char c) { return c >= '0' && c <= '9'; }

std::size_t digits_end(std::string_view text, std::size_t from) {
  while (from < text.size() && is_digit(text[from])) ++from;
  return from;
}

/// -1, 0, 1: digits as a number of any length, then the shorter run first.
int compare_numbers(std::string_view a, std::string_view b) {
  const std::string_view x = a.substr(std::min(a.find_first_not_of('0'), a.size())), y = b.substr(std::min(b.find_first_not_of('0'), b.size()));
  if (x.size() != y.size()) return x.size() < y.size() ? -1 : 1;
  if (const int order = x.compare(y)) return order < 0 ? -1 : 1;
  return a.size() == b.size() ? 0 : a.size() < b.size() ? -1 : 1;
}

/// Length of the set that starts at pattern[0] == '[', 0 if it is not closed; tells whether it holds `c`.
std::size_t match_set(std::string_view pattern, char c, bool& holds) {
  std::size_t i = 1;
  const bool negated = i < pattern.size() && (pattern[i] == '!' || pattern[i] == '^');
  if (negated) ++i;
  bool found = false;
  for (const std::size_t first = i; i < pattern.size(); ++i) {
    if (pattern[i] == ']' && i > first) {
      holds = found != negated;
      return i + 1;
    }
    const auto low = static_cast<unsigned char>(pattern[i]);
    auto high = low;
    if (i + 2 < pattern.size() && pattern[i + 1] == '-' && pattern[i + 2] != ']') {
      high = static_cast<unsigned char>(pattern[i + 2]);
      i += 2;
    }
    found = found || (static_cast<unsigned char>(c) >= low && static_cast<unsigned char>(c) <= high);
  }
  return 0;
}

void expand(const fs::path& folder, const std::vector<std::string>& parts, std::size_t index, std::vector<fs::path>& out) {
  std::error_code code;
  if (index == parts.size()) {
    out.push_back(folder);
    return;
  }
  const std::string& part = parts[index];
  const bool last = index + 1 == parts.size();
  if (!has_wildcard(part) || fs::exists(folder / part, code)) {
    if (fs::exists(folder / part, code)) expand(folder / part, parts, index + 1, out);
    return;
  }
  fs::directory_iterator entry(folder.empty() ? fs::path(".") : folder, code);
  if (code) return;
  for (; entry != fs::directory_iterator(); entry.increment(code)) {
    if (code) return;
    const std::string name = entry->path().filename().string();
    if (name.starts_with(".") && !part.starts_with(".")) continue;
    std::error_code type_error;
    if (!matches_wildcard(part, name) || (!last && !entry->is_directory(type_error))) continue;
    expand(folder / name, parts, index + 1, out);
  }
}

}  // namespace

bool natural_less(std::string_view a, std::string_view b) {
  std::size_t i = 0, j = 0;
  while (i < a.size() && j < b.size()) {
    if (is_digit(a[i]) && is_digit(b[j])) {
      const std::size_t i_end = digits_end(a, i), j_end = digits_end(b, j);
      if (const int order = compare_numbers(a.substr(i, i_end - i), b.substr(j, j_end - j))) return order < 0;
      i = i_end;
      j = j_end;
    } else {
      if (a[i] != b[j]) return static_cast<unsigned char>(a[i]) < static_cast<unsigned char>(b[j]);
      ++i;
      ++j;
    }
  }
  return a.size() - i < b.size() - j;
}

bool matches_wildcard(std::string_view pattern, std::string_view name) {
  // Greedy with one place to come back to: the last star. Going back further never helps.
  std::size_t p = 0, n = 0, star = std::string_view::npos, star_name = 0;
  while (n < name.size()) {
    std::size_t step = 0;
    bool holds = false;
    if (p < pattern.size() && pattern[p] == '*') {
      star = p++;
      star_name = n;
      continue;
    }
    if (p < pattern.size() && pattern[p] == '[') step = match_set(pattern.substr(p), name[n], holds);
    if (step == 0 && p < pattern.size()) {
      step = 1;
      holds = pattern[p] == '?' || pattern[p] == name[n];
    }
    if (holds) {
      p += step;
      ++n;
    } else if (star != std::string_view::npos) {
      p = star + 1;
      n = ++star_name;
    } else {
      return false;
    }
  }
  while (p < pattern.size() && pattern[p] == '*') ++p;
  return p == pattern.size();
}

bool has_wildcard(std::string_view text) { return text.find_first_of("*?[") != std::string_view::npos; }

std::vector<fs::path> expand_pattern(const fs::path& base, const std::string& pattern) {
  const fs::path whole = base / fs::path(pattern);
  std::error_code code;
  if (fs::exists(whole, code)) return {whole.lexically_normal()};
  // Only the pattern's own parts may hold wildcards; brackets in the base folder's name are just characters.
  const fs::path relative = fs::path(pattern).is_absolute() ? fs::path(pattern).relative_path() : fs::path(pattern);
  std::vector<std::string> parts;
  for (const fs::path& part : relative)
    if (!part.empty()) parts.push_back(part.string());
  std::vector<fs::path> found;
  expand(fs::path(pattern).is_absolute() ? fs::path(pattern).root_path() : base, parts, 0, found);
  for (fs::path& path : found) path = path.lexically_normal();
  std::sort(found.begin(), found.end(), [](const fs::path& a, const fs::path& b) { return natural_less(a.string(), b.string()); });
  return found;
}

}  // namespace chiaro::tools
