/// What would be lost with a store.
#pragma once
#include <filesystem>
#include <string>

namespace chiaro::tools {

/// A store that is made anew takes its layers with it. throws Error where it holds others than `mine` and the input's colour, whether it can be read or is damaged.
void require_no_results(const std::filesystem::path& store_path, const std::string& mine = "");

}  // namespace chiaro::tools
