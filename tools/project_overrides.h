/// Keys of a project file that the command line replaces (--set).
#pragma once
#include <span>
#include <string>
#include <toml++/toml.h>

namespace chiaro::tools {

/// overrides: see load_project(). Values carry the option as their position. throws UsageError.
void apply_overrides(toml::table& root, std::span<const std::string> overrides);

}  // namespace chiaro::tools
