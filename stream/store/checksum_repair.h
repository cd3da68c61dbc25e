/// What a checksum can tell beyond "damaged": which single byte, changed back, makes it fit again.
///
/// A CRC is linear: the difference between the checksum found and the one expected depends on the place and the change alone, so that all places are tried in
/// one pass. Among n bytes a wrong place fits by chance with probability n * 255 / 2^32: whoever uses an answer checks what else must hold.
#pragma once
#include <cstddef>
#include <cstdint>
#include <optional>
#include <span>
#include <string>
#include <vector>

namespace chiaro::stream {

struct ByteFix {
  std::size_t at = 0;
  std::byte flip{};   ///< to be combined by exclusive or
};

/// Every single byte whose change gives `bytes` the CRC-32C `wanted`, from the last to the first; at most `most`.
std::vector<ByteFix> one_byte_fixes(std::span<const std::byte> bytes, std::uint32_t wanted, std::size_t most = 64);

/// A sealed JSON text (write_sealed) as it was before one byte was damaged; itself if it is whole. Nothing if no change, or more than one, makes it a
/// text as this program writes it.
std::optional<std::string> repair_sealed(const std::string& text);

}  // namespace chiaro::stream
