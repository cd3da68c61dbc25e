/// The smallest camera RAW file: an uncompressed DNG with a mosaic R G / G B.
#pragma once
#include <bit>
#include <cstdint>
#include <filesystem>
#include <fstream>
#include <vector>

namespace chiaro::test {

struct DngOptions {
  std::uint32_t black = 512, white = 16383;
  std::uint32_t orientation = 1;   ///< as EXIF counts
};

/// mosaic: width * height raw numbers, rows from the top.
inline void write_dng(const std::filesystem::path& path, std::uint32_t width, std::uint32_t height, const std::vector<std::uint16_t>& mosaic, const DngOptions& options = {}) {
  static_assert(std::endian::native == std::endian::little);
  enum Type : std::uint16_t { kByte = 1, kText = 2, kShort = 3, kLong = 4 };
  struct Entry {
    std::uint16_t tag, type;
    std::uint32_t count, value;   // the value itself where it has four bytes or fewer
  };
  const auto bytes4 = [](unsigned a, unsigned b, unsigned c, unsigned d) { return a | b << 8 | c << 16 | d << 24; };
  std::vector<Entry> entries{{254, kLong, 1, 0},      {256, kLong, 1, width},  {257, kLong, 1, height}, {258, kShort, 1, 16}, {259, kShort, 1, 1},  {262, kShort, 1, 32803},
                             {271, kText, 4, bytes4('T', 's', 't', 0)},        {272, kText, 4, bytes4('C', 'a', 'm', 0)},     {273, kLong, 1, 0},   {274, kShort, 1, options.orientation},
                             {277, kShort, 1, 1},     {278, kLong, 1, height}, {279, kLong, 1, 2 * width * height},           {33421, kShort, 2, 2 | 2u << 16},
                             {33422, kByte, 4, bytes4(0, 1, 1, 2)},            {50706, kByte, 4, bytes4(1, 4, 0, 0)},         {50714, kLong, 1, options.black},            {50717, kLong, 1, options.white}};
  const auto head_bytes = static_cast<std::uint32_t>(8 + 2 + 12 * entries.size() + 4);
  for (Entry& e : entries)
    if (e.tag == 273) e.value = head_bytes;
  std::ofstream out(path, std::ios::binary | std::ios::trunc);
  const auto put = [&](const auto& value) { out.write(reinterpret_cast<const char*>(&value), sizeof value); };
  out.write("II*\0", 4);
  put(std::uint32_t{8});
  put(static_cast<std::uint16_t>(entries.size()));
  for (const Entry& e : entries) put(e.tag), put(e.type), put(e.count), put(e.value);
  put(std::uint32_t{0});
  out.write(reinterpret_cast<const char*>(mosaic.data()), static_cast<std::streamsize>(mosaic.size() * sizeof(std::uint16_t)));
}

}  // namespace chiaro::test
