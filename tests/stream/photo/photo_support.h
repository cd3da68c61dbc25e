/// Helpers of the photo tests: test data of other programs, bytes of files, and the damage that readers must survive.
#pragma once
#include <gtest/gtest.h>

#include <cstdlib>
#include <filesystem>
#include <fstream>
#include <functional>
#include <sstream>
#include <string>

#include "stream/base/error.h"
#include "stream/base/file.h"
#include "stream/base/rng.h"

namespace chiaro::stream {

/// Folder of real data beside the source tree (or where CHIARO_SHARED says); empty where it is absent.
inline std::filesystem::path shared_folder() {
  if (const char* set = std::getenv("CHIARO_SHARED")) return set;
  const std::filesystem::path beside = std::filesystem::path(CHIARO_SOURCE_DIR) / ".." / "shared";
  return std::filesystem::exists(beside / "real") ? beside : std::filesystem::path();
}

#define CHIARO_NEED_SHARED(variable)                    \
  const std::filesystem::path variable = shared_folder(); \
  if (variable.empty()) GTEST_SKIP() << "real test data (../shared) is absent"

inline std::string file_bytes(const std::filesystem::path& path) {
  std::ifstream in(path, std::ios::binary);
  std::ostringstream out;
  out << in.rdbuf();
  return out.str();
}

inline void put_bytes(const std::filesystem::path& path, const std::string& bytes) {
  std::filesystem::remove(path);  // a truncated file is written through to disk on close by some file systems; a new one is not
  std::ofstream out(path, std::ios::binary | std::ios::trunc);
  out.write(bytes.data(), static_cast<std::streamsize>(bytes.size()));
}

/// Message of the Error that `call` throws; empty if it throws none. Anything else than an Error escapes and fails the test.
inline std::string error_of(const std::function<void()>& call) {
  try {
    call();
  } catch (const Error& error) {
    return error.what();
  }
  return {};
}

/// Writes damaged copies of `bytes` to `path` and calls read(): each prefix and each byte replaced by a few values, at most `max_places` places evenly spaced.
/// read() may succeed or throw Error; any other end fails the test. Returns how many copies were refused.
inline int survive_damage(const std::filesystem::path& path, const std::string& bytes, std::size_t max_places, const std::function<void()>& read) {
  int refused = 0;
  const std::size_t step = std::max<std::size_t>(1, bytes.size() / max_places);
  for (std::size_t i = 0; i < bytes.size(); i += step) {
    put_bytes(path, bytes.substr(0, i));
    refused += !error_of(read).empty();
    for (const int value : {0x00, 0xff, bytes[i] ^ 0x80, bytes[i] ^ 0x01}) {
      std::string damaged = bytes;
      damaged[i] = static_cast<char>(value);
      if (damaged == bytes) continue;
      put_bytes(path, damaged);
      refused += !error_of(read).empty();
    }
  }
  return refused;
}

inline double uniform(std::uint64_t element, std::uint32_t draw, double lo, double hi) {
  return lo + (hi - lo) * static_cast<double>(uniform01(11, Purpose::kTest, element, draw));
}

}  // namespace chiaro::stream
