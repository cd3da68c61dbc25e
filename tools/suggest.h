/// "did you mean": the nearest known word, for mistyped commands, options and keys of the project file.
#pragma once
#include <cstddef>
#include <optional>
#include <span>
#include <string>
#include <string_view>

namespace chiaro::tools {

/// Insertions, deletions, substitutions and swaps of neighbours that turn `a` into `b` (no part edited twice; case counts).
/// Words beyond 200 characters are taken as unlike each other: the answer is then the longer length.
/// source: Damerau 1964; the restricted form, "optimal string alignment".
std::size_t edit_distance(std::string_view a, std::string_view b);

/// The candidate that `word` was probably meant to be: the nearest one, if it is at most a third of the word's length away (at least 1)
/// or continues what was typed ("intensity" for "intensity_range"). The first of equals; case is ignored.
std::optional<std::string> nearest(std::string_view word, std::span<const std::string> candidates);

/// `; did you mean "word"?` or, with no candidate near, `; known: a, b, c` (nothing if there are none).
std::string suggestion(std::string_view word, std::span<const std::string> candidates);

}  // namespace chiaro::tools
