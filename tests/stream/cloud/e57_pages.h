/// The checksums of E57 files, so that tests can change what lies below them.
#pragma once
#include <cstdint>
#include <string>

namespace chiaro::stream {

inline std::uint32_t crc32c_of(const std::string& text) {
  std::uint32_t crc = ~0u;
  for (const char c : text) {
    crc ^= static_cast<unsigned char>(c);
    for (int k = 0; k < 8; ++k) crc = crc & 1u ? crc >> 1 ^ 0x82f63b78u : crc >> 1;
  }
  return ~crc;
}

/// The content of the pages without their checksums.
inline std::string logical_bytes(const std::string& file) {
  std::string content;
  for (std::size_t at = 0; at < file.size(); at += 1024) content += file.substr(at, 1020);
  return content;
}

/// Pages of 1020 bytes with their checksums; the last one is filled with zeros.
inline std::string physical_bytes(std::string content) {
  content.resize((content.size() + 1019) / 1020 * 1020);
  std::string file;
  for (std::size_t at = 0; at < content.size(); at += 1020) {
    const std::string page = content.substr(at, 1020);
    const std::uint32_t crc = crc32c_of(page);
    file += page;
    for (int k = 3; k >= 0; --k) file += static_cast<char>(crc >> (8 * k));
  }
  return file;
}

}  // namespace chiaro::stream
