#include "tools/suggest.h"

#include <algorithm>
#include <vector>

#include "stream/base/text.h"

namespace chiaro::tools {

std::size_t edit_distance(std::string_view a, std::string_view b) {
  constexpr std::size_t kLongest = 200;
  if (a.size() > kLongest || b.size() > kLongest) return a == b ? 0 : std::max(a.size(), b.size());
  // Three rows of the table: the one in work, the one before, and the one before that for swaps.
  std::vector<std::size_t> before(b.size() + 1), last(b.size() + 1), row(b.size() + 1);
  for (std::size_t j = 0; j <= b.size(); ++j) last[j] = j;
  for (std::size_t i = 1; i <= a.size(); ++i) {
    row[0] = i;
    for (std::size_t j = 1; j <= b.size(); ++j) {
      row[j] = std::min({last[j] + 1, row[j - 1] + 1, last[j - 1] + (a[i - 1] == b[j - 1] ? 0 : 1)});
      if (i > 1 && j > 1 && a[i - 1] == b[j - 2] && a[i - 2] == b[j - 1]) row[j] = std::min(row[j], before[j - 2] + 1);
    }
    std::swap(before, last);
    std::swap(last, row);
  }
  return last[b.size()];
}

std::optional<std::string> nearest(std::string_view word, std::span<const std::string> candidates) {
  const std::string typed = lower(word);
  const std::size_t limit = std::max<std::size_t>(1, typed.size() / 3);
  std::optional<std::string> best;
  std::size_t best_distance = limit + 1;
  for (const std::string& candidate : candidates) {
    const std::size_t distance = edit_distance(typed, lower(candidate));
    if (distance < best_distance && distance < std::max(typed.size(), candidate.size())) {
      best = candidate;
      best_distance = distance;
    }
  }
  if (best || typed.size() < 3) return best;
  for (const std::string& candidate : candidates)
    if (lower(candidate).compare(0, typed.size(), typed) == 0) return candidate;
  return std::nullopt;
}

std::string suggestion(std::string_view word, std::span<const std::string> candidates) {
  if (const auto best = nearest(word, candidates)) return "; did you mean \"" + *best + "\"?";
  if (candidates.empty()) return "";
  std::string list = "; known: ";
  for (std::size_t i = 0; i < candidates.size(); ++i) list += (i ? ", " : "") + candidates[i];
  return list;
}

}  // namespace chiaro::tools
