/// Checksums and content keys.
#pragma once
#include <array>
#include <cstdint>
#include <filesystem>
#include <span>
#include <string>
#include <string_view>

namespace chiaro {

/// CRC-32C (Castagnoli), as iSCSI and ext4 use it. "123456789" gives 0xe3069283. Chain by passing the previous value.
std::uint32_t crc32c(std::span<const std::byte> bytes, std::uint32_t previous = 0);
inline std::uint32_t crc32c(const void* data, std::size_t size, std::uint32_t previous = 0) {
  return crc32c({static_cast<const std::byte*>(data), size}, previous);
}

/// 128-bit content key (MurmurHash3 x64 128, A. Appleby, public domain algorithm), for caching, not for security.
class Hasher {
 public:
  Hasher& add(std::string_view text);           ///< length and bytes
  Hasher& add_bytes(const void* data, std::size_t size);
  Hasher& add(std::uint64_t value);
  Hasher& add(double value);
  std::string hex() const;                      ///< 32 hexadecimal digits

 private:
  void block(const std::uint8_t* p);
  std::uint64_t h1_ = 0x6368696172300001ull, h2_ = 0x6368696172300002ull, length_ = 0;
  std::array<std::uint8_t, 16> tail_{};
  std::size_t tail_size_ = 0;
};

/// Key of a file's identity: size and whole content up to 64 MiB; beyond that size, modification time, and 64 MiB of samples
/// (head, tail and evenly spaced blocks). throws Error if it cannot be read.
std::string file_fingerprint(const std::filesystem::path& path);

}  // namespace chiaro
