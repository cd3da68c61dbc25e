/// Room on a disk is asked for before long work begins, and not met at its end.
#pragma once
#include <cstdint>
#include <filesystem>
#include <string_view>

namespace chiaro {

/// throws Error naming the folder, what is needed and what is there, if that is less. who: "the build", "blending".
void require_disk_space(const std::filesystem::path& where, std::string_view who, std::uint64_t needed_bytes, std::uint64_t free_bytes);

}  // namespace chiaro
