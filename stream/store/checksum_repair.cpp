#include "stream/store/checksum_repair.h"

#include <array>
#include <nlohmann/json.hpp>

#include "stream/base/hash.h"
#include "stream/store/store_format.h"

namespace chiaro::stream {
namespace {

// What the last byte of a text adds to its checksum; each entry is known by its highest byte.
struct CrcTable {
  std::array<std::uint32_t, 256> of_byte{};
  std::array<std::uint8_t, 256> by_high_byte{};
  CrcTable() {
    for (std::uint32_t i = 0; i < 256; ++i) {
      const auto byte = static_cast<std::uint8_t>(i);
      of_byte[i] = ~crc32c(&byte, 1, 0xffffffffu);
      by_high_byte[of_byte[i] >> 24] = byte;
    }
  }
};

// As this program writes it: parsed and written again, the same text.
bool is_canonical(const std::string& text) {
  const auto j = nlohmann::ordered_json::parse(text, nullptr, false);
  return j.is_object() && j.dump(2, ' ', false, nlohmann::ordered_json::error_handler_t::replace) + "\n" == text;
}

constexpr std::size_t kHexAt = 15;  // of the digits in a seal

std::optional<std::uint32_t> digits_of(std::string_view seal) {
  std::uint32_t value = 0;
  for (const char c : seal.substr(kHexAt, 8)) {
    const bool digit = c >= '0' && c <= '9';
    if (!digit && !(c >= 'a' && c <= 'f')) return std::nullopt;
    value = value << 4 | static_cast<std::uint32_t>(digit ? c - '0' : c - 'a' + 10);
  }
  return value;
}

}  // namespace

std::vector<ByteFix> one_byte_fixes(std::span<const std::byte> bytes, std::uint32_t wanted, std::size_t most) {
  static const CrcTable table;
  std::vector<ByteFix> fixes;
  std::uint32_t difference = crc32c(bytes) ^ wanted;
  if (difference == 0) return fixes;
  for (std::size_t at = bytes.size(); at-- > 0 && fixes.size() < most;) {
    // Here `difference` is what a change of byte `at` must have made of the checksum right behind it. Going back over a byte undoes one step of the register.
    const std::uint8_t low = table.by_high_byte[difference >> 24];
    if (table.of_byte[low] == difference) fixes.push_back({at, static_cast<std::byte>(low)});
    difference = (difference ^ table.of_byte[low]) << 8 | low;
  }
  return fixes;
}

std::optional<std::string> repair_sealed(const std::string& text) {
  const std::size_t seal_bytes = seal_of("").size();
  if (text.size() <= seal_bytes) return std::nullopt;
  std::string body = text.substr(0, text.size() - seal_bytes);
  const std::string found = text.substr(body.size()), expected = seal_of(body);
  if (found == expected) return text;
  int differ = 0;
  for (std::size_t i = 0; i < seal_bytes; ++i) differ += found[i] != expected[i];
  if (differ == 1) return is_canonical(body + expected) ? std::optional(body + expected) : std::nullopt;
  const auto wanted = digits_of(found);
  if (!wanted) return std::nullopt;
  std::optional<std::string> answer;
  for (const ByteFix& fix : one_byte_fixes(std::as_bytes(std::span(body)), *wanted)) {
    char& c = body[fix.at];
    const char damaged = c;
    c = static_cast<char>(std::to_integer<unsigned char>(fix.flip) ^ static_cast<unsigned char>(c));
    const std::string candidate = body + found;
    c = damaged;
    if (seal_of(candidate.substr(0, body.size())) != found || !is_canonical(candidate)) continue;
    if (answer) return std::nullopt;
    answer = candidate;
  }
  return answer;
}

}  // namespace chiaro::stream
