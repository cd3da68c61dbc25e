/// Inside of camera_files: one reader a format. Not for other folders.
#pragma once
#include <charconv>
#include <cmath>
#include <filesystem>
#include <optional>
#include <string>
#include <string_view>
#include <vector>

#include "stream/photo/camera.h"

namespace chiaro::stream::detail {

/// folder holds cameras.bin and images.bin (binary) or cameras.txt and images.txt.
std::vector<Camera> read_colmap(const std::filesystem::path& folder, bool binary, std::vector<std::string>& notes);
std::vector<Camera> read_metashape(const std::filesystem::path& file, std::vector<std::string>& notes);

/// The next word of `text` between blanks; `text` moves behind it. Empty at the end.
inline std::string_view take_word(std::string_view& text) {
  constexpr std::string_view kBlanks = " \t\r\n";
  const std::size_t begin = text.find_first_not_of(kBlanks);
  if (begin == std::string_view::npos) {
    text = {};
    return {};
  }
  const std::size_t end = std::min(text.find_first_of(kBlanks, begin), text.size());
  const std::string_view word = text.substr(begin, end - begin);
  text.remove_prefix(end);
  return word;
}

inline std::string_view trimmed(std::string_view text) {
  constexpr std::string_view kBlanks = " \t\r\n";
  const std::size_t begin = text.find_first_not_of(kBlanks);
  return begin == std::string_view::npos ? std::string_view() : text.substr(begin, text.find_last_not_of(kBlanks) - begin + 1);
}

/// The whole word as a number, independent of the locale; nullopt if it is none or, for real numbers, not finite.
template <class T>
std::optional<T> parse_number(std::string_view word) {
  if (!word.empty() && word.front() == '+') word.remove_prefix(1);
  T value{};
  const auto [end, code] = std::from_chars(word.data(), word.data() + word.size(), value);
  if (code != std::errc() || end != word.data() + word.size()) return std::nullopt;
  if constexpr (std::is_floating_point_v<T>)
    if (!std::isfinite(value)) return std::nullopt;
  return value;
}

}  // namespace chiaro::stream::detail
