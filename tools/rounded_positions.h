/// Clouds that lost their shape before they came here: single precision far from the origin.
#pragma once
#include <cstdint>
#include <filesystem>
#include <string>
#include <vector>

#include "stream/store/store.h"

namespace chiaro::tools {

/// A sentence for each file whose coordinates are those of single precision (whatever type holds them) where its steps are no longer small beside
/// the distance of the points. Looks at the first points of a file, and at none where the cloud lies near enough to the origin.
///
/// memory_bytes  what opening a file may take, see open_points().
std::vector<std::string> notes_on_rounded_positions(const stream::Store& store, const std::vector<std::filesystem::path>& files, std::uint64_t memory_bytes);

}  // namespace chiaro::tools
