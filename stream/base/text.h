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

/// Whether text can stand in JSON and XML as it is; names on old disks may be of Latin-1 or another encoding.
inline bool is_utf8(std::string_view text) {
  for (std::size_t i = 0; i < text.size();) {
    const auto byte = [&](std::size_t k) { return k < text.size() ? static_cast<unsigned char>(text[k]) : 0u; };
    const unsigned lead = byte(i);
    const std::size_t length = lead < 0x80 ? 1 : lead >= 0xc2 && lead < 0xe0 ? 2 : lead >= 0xe0 && lead < 0xf0 ? 3 : lead >= 0xf0 && lead < 0xf5 ? 4 : 0;
    if (length == 0) return false;
    for (std::size_t k = 1; k < length; ++k)
      if ((byte(i + k) & 0xc0) != 0x80) return false;
    // The shortest form, no surrogates, nothing beyond U+10FFFF.
    if ((lead == 0xe0 && byte(i + 1) < 0xa0) || (lead == 0xed && byte(i + 1) >= 0xa0) || (lead == 0xf0 && byte(i + 1) < 0x90) || (lead == 0xf4 && byte(i + 1) >= 0x90)) return false;
    i += length;
  }
  return true;
}

/// With its dot, ".ply" of CLOUD.PLY.
inline std::string lower_extension(const std::filesystem::path& file) { return lower(file.extension().string()); }

}  // namespace chiaro
