/// Entry points for fuzzing: each takes any bytes, reads them as one format through the public reader, and to the end.
///
/// An input is refused with chiaro::Error or read; anything else (another exception, a crash, a hang, a huge allocation) is a bug.
#pragma once
#include <cstdint>
#include <span>
#include <string>
#include <vector>

namespace chiaro::fuzz {

/// Size of the corpus' pictures, pixels.
constexpr int kPictureWidth = 9, kPictureHeight = 20;

struct Target {
  std::string name;
  bool (*run)(std::span<const std::uint8_t> bytes);  ///< true if it was read to the end, false if refused; throws what is not an Error
};

/// ply las laz e57 pcd xyz csv pts ptx npy · exr tiff png jpeg mask raw raster · colmap_text colmap_binary metashape · project store
const std::vector<Target>& targets();
/// throws std::invalid_argument for an unknown name.
const Target& target(const std::string& name);

/// Several files as one input: for each a u32 size and its bytes; the last ones may be missing or short.
std::vector<std::string> unpack(std::span<const std::uint8_t> bytes, std::size_t files);
std::string pack(const std::vector<std::string>& files);

}  // namespace chiaro::fuzz
