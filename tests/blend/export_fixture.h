/// A cloud, a store and a layer to export, and what reads the files that come out.
#pragma once
#include <gtest/gtest.h>

#include <cmath>
#include <cstring>
#include <fstream>

#include "stream/base/file.h"
#include "stream/base/rng.h"
#include "stream/store/layer.h"
#include "stream/store/octree_build.h"
#include "tests/blend/noting_reporter.h"
#include "tests/support/planes.h"
#include "tools/export_points.h"

namespace chiaro::tools {

using blend::NotingReporter;

inline constexpr std::uint64_t kPlenty = std::uint64_t{1} << 30;
inline constexpr std::size_t kPoints = 6000;

struct InputPoint {
  double x = 0, y = 0, z = 0;
  std::uint8_t red = 0, green = 0, blue = 0;
  float quality = 0;
  std::int32_t scan = 0;
};

/// A bumpy sheet in random order; every 997th point has no position.
inline std::vector<InputPoint> input_points(std::uint64_t seed) {
  std::vector<InputPoint> points(kPoints);
  for (std::size_t i = 0; i < points.size(); ++i) {
    const auto u = uniform01x4(seed, Purpose::kTest, i, 0);
    InputPoint& p = points[i];
    p.x = 500000 + static_cast<double>(u[0]);   // as far from the origin as surveys are: needs double
    p.y = static_cast<double>(u[1]);
    p.z = 0.02 * std::sin(9 * static_cast<double>(u[0]));
    p.red = static_cast<std::uint8_t>(i % 251);
    p.green = static_cast<std::uint8_t>(i % 241);
    p.blue = static_cast<std::uint8_t>(i % 239);
    p.quality = u[2];
    p.scan = static_cast<std::int32_t>(i) - 3000;
    if (i % 997 == 5) p.x = std::nan("");
  }
  return points;
}

template <class T>
inline void append(std::string& text, const T& value) {
  text.append(reinterpret_cast<const char*>(&value), sizeof value);
}

inline void write_ply(const std::filesystem::path& path, const std::vector<InputPoint>& points, bool with_scan = true) {
  std::string text = "ply\nformat binary_little_endian 1.0\nelement vertex " + std::to_string(points.size()) +
                     "\nproperty double x\nproperty double y\nproperty double z\nproperty float quality\nproperty uchar red\nproperty uchar green\nproperty uchar blue\n";
  if (with_scan) text += "property int scan\n";
  text += "end_header\n";
  for (const InputPoint& p : points) {
    append(text, p.x);
    append(text, p.y);
    append(text, p.z);
    append(text, p.quality);
    append(text, p.red);
    append(text, p.green);
    append(text, p.blue);
    if (with_scan) append(text, p.scan);
  }
  write_text(path, text);
}

/// A binary PLY as written, by rows of named values.
struct PlyFile {
  std::vector<std::string> properties;   // "type name"
  std::vector<std::vector<double>> rows;
  const std::vector<double>& row(std::size_t i) const { return rows[i]; }
  double at(std::size_t i, const std::string& name) const {
    for (std::size_t c = 0; c < properties.size(); ++c)
      if (properties[c].substr(properties[c].find(' ') + 1) == name) return rows[i][c];
    throw std::out_of_range(name);
  }
};

template <class T>
inline double take(const char*& at) {
  T v;
  std::memcpy(&v, at, sizeof v);
  at += sizeof v;
  return static_cast<double>(v);
}

inline PlyFile read_ply(const std::filesystem::path& path) {
  const std::string text = read_text(path);
  const std::size_t end = text.find("end_header\n") + 11;
  std::istringstream header(text.substr(0, end));
  PlyFile ply;
  std::size_t count = 0;
  for (std::string line; std::getline(header, line);) {
    if (line.rfind("element vertex ", 0) == 0) count = std::stoul(line.substr(15));
    if (line.rfind("property ", 0) == 0) ply.properties.push_back(line.substr(9));
  }
  const char* at = text.data() + end;
  for (std::size_t i = 0; i < count; ++i) {
    std::vector<double> row;
    for (const std::string& p : ply.properties) {
      const std::string type = p.substr(0, p.find(' '));
      row.push_back(type == "double" ? take<double>(at) : type == "float" ? take<float>(at) : type == "uchar" ? take<std::uint8_t>(at) : type == "ushort" ? take<std::uint16_t>(at) : type == "short" ? take<std::int16_t>(at)
                                                                                                                                       : take<std::int32_t>(at));
    }
    ply.rows.push_back(std::move(row));
  }
  EXPECT_EQ(at, text.data() + text.size());
  return ply;
}

inline Vec3f albedo_of(std::uint64_t source) {
  const auto u = uniform01x4(77, Purpose::kTest, source, 0);
  return {u[0], u[1], u[2]};
}
inline bool seen(const Vec3d& position) { return position.y() < 0.6; }

class ExportPoints : public ::testing::Test {
 protected:
  ScratchFolder folder;
  std::vector<InputPoint> points = input_points(1);
  std::filesystem::path cloud = folder.path() / "cloud.ply";
  NotingReporter report;

  stream::Store build(const std::vector<std::filesystem::path>& files) {
    MemoryBudget budget(kPlenty);
    stream::BuildOptions options;
    options.chunk_surfels = 700;
    stream::build_store(files, folder.path() / "store.chiaro", options, budget, silent_reporter());
    return stream::Store(folder.path() / "store.chiaro");
  }
  stream::Store build() {
    write_ply(cloud, points);
    return build({cloud});
  }
  static void write_layer(const stream::Store& store, const std::string& provenance = "{}") {
    stream::LayerWriter writer(store, "albedo", stream::albedo_fields(), provenance);
    for (const std::uint32_t leaf : store.leaves()) {
      const stream::Chunk chunk = store.read_chunk(leaf);
      const auto sources = store.read_sources(leaf);
      const std::size_t n = chunk.count;
      std::vector<float> albedo(3 * n, std::nanf("")), sigma(n, std::nanf(""));
      std::vector<std::uint16_t> photos(n, 0);
      for (std::uint32_t i = 0; i < n; ++i) {
        if (!seen(chunk.surfel(i).position_in_world)) continue;
        const Vec3f a = albedo_of(sources[i]);
        for (std::size_t c = 0; c < 3; ++c) albedo[c * n + i] = a[static_cast<Eigen::Index>(c)];
        sigma[i] = 0.01f * static_cast<float>(1 + sources[i] % 7);
        photos[i] = static_cast<std::uint16_t>(1 + sources[i] % 5);
      }
      writer.write_chunk(leaf, tests::planes_of(albedo, sigma, photos));
    }
    writer.finish_inner(silent_reporter());
    writer.commit();
  }
  ExportStats run(const stream::Store& store, ExportOptions options, std::uint64_t bytes = kPlenty) {
    MemoryBudget budget(bytes);
    const ExportStats stats = export_points(store, options, folder.path() / "scratch", budget, report);
    EXPECT_EQ(budget.used_bytes(), 0u);
    EXPECT_TRUE(std::filesystem::is_empty(folder.path() / "scratch"));
    return stats;
  }
  ExportOptions to(const std::string& name) {
    ExportOptions options;
    options.file = folder.path() / name;
    return options;
  }
};

inline int srgb(double v) { return static_cast<int>(std::lround(255 * (v <= 0.0031308 ? 12.92 * v : 1.055 * std::pow(v, 1 / 2.4) - 0.055))); }

}  // namespace chiaro::tools
