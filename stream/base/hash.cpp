#include "stream/base/hash.h"

#include <fcntl.h>

#include <bit>
#include <cstdio>
#include <cstring>
#include <memory>
#include <vector>

#if defined(__x86_64__)
#include <nmmintrin.h>
#endif

#include "stream/base/error.h"

namespace chiaro {
namespace {

constexpr std::array<std::uint32_t, 256> make_table() {
  std::array<std::uint32_t, 256> t{};
  for (std::uint32_t i = 0; i < 256; ++i) {
    std::uint32_t c = i;
    for (int k = 0; k < 8; ++k) c = (c >> 1) ^ (c & 1 ? 0x82f63b78u : 0);
    t[i] = c;
  }
  return t;
}
constexpr auto kTable = make_table();

std::uint32_t crc_plain(const std::uint8_t* p, std::size_t n, std::uint32_t c) {
  while (n--) c = kTable[(c ^ *p++) & 0xff] ^ (c >> 8);
  return c;
}

#if defined(__x86_64__)
__attribute__((target("sse4.2"))) std::uint32_t crc_sse(const std::uint8_t* p, std::size_t n, std::uint32_t c) {
  std::uint64_t c64 = c;
  for (; n >= 8; n -= 8, p += 8) {
    std::uint64_t v;
    std::memcpy(&v, p, 8);
    c64 = _mm_crc32_u64(c64, v);
  }
  c = static_cast<std::uint32_t>(c64);
  while (n--) c = _mm_crc32_u8(c, *p++);
  return c;
}
#endif

constexpr std::uint64_t kC1 = 0x87c37b91114253d5ull, kC2 = 0x4cf5ad432745937full;
std::uint64_t fmix(std::uint64_t k) {
  k ^= k >> 33;
  k *= 0xff51afd7ed558ccdull;
  k ^= k >> 33;
  k *= 0xc4ceb9fe1a85ec53ull;
  return k ^ (k >> 33);
}

}  // namespace

std::uint32_t crc32c(std::span<const std::byte> bytes, std::uint32_t previous) {
  const auto* p = reinterpret_cast<const std::uint8_t*>(bytes.data());
#if defined(__x86_64__)
  if (__builtin_cpu_supports("sse4.2")) return ~crc_sse(p, bytes.size(), ~previous);
#endif
  return ~crc_plain(p, bytes.size(), ~previous);
}

void Hasher::block(const std::uint8_t* p) {
  std::uint64_t k1, k2;
  std::memcpy(&k1, p, 8);
  std::memcpy(&k2, p + 8, 8);
  k1 *= kC1;
  k1 = std::rotl(k1, 31);
  h1_ ^= k1 * kC2;
  h1_ = (std::rotl(h1_, 27) + h2_) * 5 + 0x52dce729;
  k2 *= kC2;
  k2 = std::rotl(k2, 33);
  h2_ ^= k2 * kC1;
  h2_ = (std::rotl(h2_, 31) + h1_) * 5 + 0x38495ab5;
}

Hasher& Hasher::add_bytes(const void* data, std::size_t size) {
  const auto* p = static_cast<const std::uint8_t*>(data);
  length_ += size;
  while (size > 0) {
    if (tail_size_ == 0 && size >= 16) {
      block(p);
      p += 16;
      size -= 16;
      continue;
    }
    tail_[tail_size_++] = *p++;
    --size;
    if (tail_size_ == 16) {
      block(tail_.data());
      tail_size_ = 0;
    }
  }
  return *this;
}

Hasher& Hasher::add(std::uint64_t value) { return add_bytes(&value, sizeof value); }
Hasher& Hasher::add(double value) { return add(std::bit_cast<std::uint64_t>(value)); }
Hasher& Hasher::add(std::string_view text) {
  add(std::uint64_t{text.size()});
  return add_bytes(text.data(), text.size());
}

std::string Hasher::hex() const {
  Hasher end = *this;
  if (end.tail_size_ > 0) {
    std::memset(end.tail_.data() + end.tail_size_, 0, 16 - end.tail_size_);
    end.block(end.tail_.data());
  }
  std::uint64_t h1 = end.h1_ ^ length_, h2 = end.h2_ ^ length_;
  h1 += h2;
  h2 += h1;
  h1 = fmix(h1);
  h2 = fmix(h2);
  h1 += h2;
  h2 += h1;
  char text[33];
  std::snprintf(text, sizeof text, "%016llx%016llx", static_cast<unsigned long long>(h1), static_cast<unsigned long long>(h2));
  return text;
}

std::string file_fingerprint(const std::filesystem::path& path) {
  constexpr std::uint64_t kBlock = 1 << 20, kWhole = 64 * kBlock;
  const std::unique_ptr<std::FILE, int (*)(std::FILE*)> file(std::fopen(path.c_str(), "rb"), &std::fclose);
  if (!file) throw Error(concat(path.string(), ": cannot be opened: ", std::strerror(errno)));
  std::error_code code;
  const std::uint64_t size = std::filesystem::file_size(path, code);
  if (code) throw Error(concat(path.string(), ": ", code.message()));
  Hasher hash;
  hash.add(size);
  std::vector<std::byte> buffer(kBlock);
  const auto add_at = [&](std::uint64_t offset, std::uint64_t count) {
    if (std::fseek(file.get(), static_cast<long>(offset), SEEK_SET) != 0 || std::fread(buffer.data(), 1, count, file.get()) != count)
      throw Error(concat(path.string(), ": cannot read ", count, " bytes at ", offset));
    hash.add_bytes(buffer.data(), count);
  };
  if (size <= kWhole) {
    for (std::uint64_t at = 0; at < size; at += kBlock) add_at(at, std::min(kBlock, size - at));
  } else {
    hash.add(static_cast<std::uint64_t>(std::filesystem::last_write_time(path).time_since_epoch().count()));
    const auto block_at = [&](std::uint64_t i) { return (size - kBlock) / 63 * i; };
    for (std::uint64_t i = 0; i < 64; ++i) (void)::posix_fadvise(::fileno(file.get()), static_cast<off_t>(block_at(i)), kBlock, POSIX_FADV_WILLNEED);   // one disk seek after the other takes longer
    for (std::uint64_t i = 0; i < 64; ++i) add_at(block_at(i), kBlock);
  }
  return hash.hex();
}

}  // namespace chiaro
