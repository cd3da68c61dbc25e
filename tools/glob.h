/// File patterns of the project file and the command line, and the order in which their matches stand.
#pragma once
#include <filesystem>
#include <string>
#include <string_view>
#include <vector>

namespace chiaro::tools {

/// Natural order: runs of digits compare as numbers, all else as bytes, so photo_2 stands before photo_10. Equal numbers of different
/// length ("07", "7"): the shorter run first. A strict total order: only equal texts are equivalent.
bool natural_less(std::string_view a, std::string_view b);

/// `*` any run, `?` one byte, `[a-c]` and `[!a-c]` one of a set; none of them matches a slash. Quadratic time at worst.
bool matches_wildcard(std::string_view pattern, std::string_view name);
bool has_wildcard(std::string_view text);

/// The files that `pattern` names, in natural order of their paths; a relative pattern starts at `base`. A pattern that is the name of
/// something that exists stands for itself, whatever brackets it holds. Wildcards may stand in folders too ("day?/photo_*.exr"); they skip
/// names that begin with a dot unless the pattern does. Never throws for what the disk holds: empty where nothing matches.
std::vector<std::filesystem::path> expand_pattern(const std::filesystem::path& base, const std::string& pattern);

}  // namespace chiaro::tools
