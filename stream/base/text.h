/// Names in files and of files, whatever the case that their writer chose.
#pragma once
#include <filesystem>
#include <string>
#include <string_view>

namespace chiaro {

/// A to Z as a to z; other bytes, such as those of UTF-8, as they are.
inline std::string lower(std::string_view text) {
  std::string out(text);
  for (char& c : out)
    if (c >= 'A' && c <= 'Z') c = static_cast<char>(c - 'A' + 'a');
  return out;
}

/// With its dot, ".ply" of CLOUD.PLY.
inline std::string lower_extension(const std::filesystem::path& file) { return lower(file.extension().string()); }

}  // namespace chiaro
