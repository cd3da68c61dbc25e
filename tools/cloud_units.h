/// Clouds that are merged, and are not in one unit.
#pragma once
#include <cstdint>
#include <filesystem>
#include <string>
#include <vector>

namespace chiaro::tools {

/// A sentence for each file whose coordinates fit those of the first one a hundredth, a thousandth as large, or as many times as large, and not as they are. Looks at the first points.
///
/// memory_bytes  what opening a file may take, see open_points().
std::vector<std::string> notes_on_units(const std::vector<std::filesystem::path>& files, std::uint64_t memory_bytes);

}  // namespace chiaro::tools
