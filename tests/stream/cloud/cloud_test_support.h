/// Files made by hand and whole clouds read back, for the tests of stream/cloud.
#pragma once
#include <gtest/gtest.h>

#include <cstring>
#include <filesystem>
#include <string>
#include <vector>

#include "stream/base/error.h"
#include "stream/base/file.h"
#include "stream/cloud/point_stream.h"

namespace chiaro::stream {

namespace fs = std::filesystem;

inline fs::path shared_folder() {
  if (const char* path = std::getenv("CHIARO_SHARED")) return path;
  return fs::path(CHIARO_SOURCE_DIR) / ".." / "shared";
}

/// Appends values as their bytes.
template <class... T>
std::string bytes_of(const T&... values) {
  std::string bytes;
  const auto add = [&bytes](const auto& value) { bytes.append(reinterpret_cast<const char*>(&value), sizeof value); };
  (add(values), ...);
  return bytes;
}

inline std::string reversed(std::string text) { return {text.rbegin(), text.rend()}; }

struct Cloud {
  PointSchema schema;
  PointBlock points;
};

/// Reads all, in small uneven blocks so that block borders are crossed.
inline Cloud read_all(PointReader& reader, std::size_t max_points = 1000) {
  Cloud cloud;
  PointBlock block;
  while (reader.read(block, max_points)) {
    cloud.points.position.insert(cloud.points.position.end(), block.position.begin(), block.position.end());
    cloud.points.normal.insert(cloud.points.normal.end(), block.normal.begin(), block.normal.end());
    cloud.points.colour.insert(cloud.points.colour.end(), block.colour.begin(), block.colour.end());
    cloud.points.extras.insert(cloud.points.extras.end(), block.extras.begin(), block.extras.end());
    EXPECT_LE(block.size(), max_points);
  }
  EXPECT_EQ(block.size(), 0u);
  cloud.schema = reader.schema();
  const std::size_t n = cloud.points.size();
  EXPECT_EQ(cloud.points.normal.size(), cloud.schema.has_normal ? n : 0);
  EXPECT_EQ(cloud.points.colour.size(), cloud.schema.has_colour ? n : 0);
  EXPECT_EQ(cloud.points.extras.size(), n * cloud.schema.extra_bytes());
  return cloud;
}

inline Cloud read_all(const fs::path& path, std::size_t max_points = 1000) { return read_all(*open_points(path), max_points); }

/// The message of the Error, or "" and a failure.
template <class Work>
std::string error_of(const Work& work) {
  try {
    work();
  } catch (const Error& error) {
    return error.what();
  }
  ADD_FAILURE() << "no Error";
  return "";
}

inline std::size_t extra_offset(const PointSchema& schema, const std::string& name) {
  std::size_t offset = 0;
  for (const PointProperty& extra : schema.extras) {
    if (extra.name == name) return offset;
    offset += scalar_bytes(extra.type);
  }
  ADD_FAILURE() << "no extra " << name;
  return 0;
}

template <class T>
T extra_of(const Cloud& cloud, std::size_t point, const std::string& name) {
  T value{};
  const std::size_t at = point * cloud.schema.extra_bytes() + extra_offset(cloud.schema, name);
  if (at + sizeof value <= cloud.points.extras.size()) std::memcpy(&value, cloud.points.extras.data() + at, sizeof value);
  return value;
}

/// A folder with files written from strings.
class CloudFiles : public ::testing::Test {
 protected:
  fs::path make(const std::string& name, const std::string& content) const {
    const fs::path path = folder_.path() / name;
    write_text(path, content);
    return path;
  }
  Cloud read(const std::string& name, const std::string& content) const { return read_all(make(name, content), 2); }
  std::string error(const std::string& name, const std::string& content) const {
    const fs::path path = make(name, content);
    const std::string message = error_of([&] { read_all(path); });
    EXPECT_NE(message.find(name), std::string::npos) << message;
    return message;
  }
  ScratchFolder folder_;
};

/// A LAS file of `minor` version and point format with these records, scale 0.01, no extra records before the points.
std::string make_las(int minor, int format, const std::vector<std::string>& records);

}  // namespace chiaro::stream
