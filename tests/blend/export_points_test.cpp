#include "tools/export_points.h"

#include <gtest/gtest.h>

#include <bit>
#include <cmath>
#include <cstring>
#include <fstream>
#include <set>

#include "stream/base/error.h"
#include "stream/base/file.h"
#include "stream/base/hash.h"
#include "stream/base/parallel.h"
#include "stream/base/rng.h"
#include "stream/cloud/point_stream.h"
#include "stream/store/layer.h"
#include "stream/store/octree_build.h"
#include "tests/blend/noting_reporter.h"
#include "tests/support/planes.h"
#include "tools/export_rows.h"
#include "tools/fill_unseen.h"
#include "tools/inserted_points.h"

namespace chiaro::tools {
namespace {

using blend::NotingReporter;

constexpr std::uint64_t kPlenty = std::uint64_t{1} << 30;
constexpr std::size_t kPoints = 6000;

struct InputPoint {
  double x = 0, y = 0, z = 0;
  std::uint8_t red = 0, green = 0, blue = 0;
  float quality = 0;
  std::int32_t scan = 0;
};

/// A bumpy sheet in random order; every 997th point has no position.
std::vector<InputPoint> input_points(std::uint64_t seed) {
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
void append(std::string& text, const T& value) {
  text.append(reinterpret_cast<const char*>(&value), sizeof value);
}

void write_ply(const std::filesystem::path& path, const std::vector<InputPoint>& points, bool with_scan = true) {
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
double take(const char*& at) {
  T v;
  std::memcpy(&v, at, sizeof v);
  at += sizeof v;
  return static_cast<double>(v);
}

PlyFile read_ply(const std::filesystem::path& path) {
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

Vec3f albedo_of(std::uint64_t source) {
  const auto u = uniform01x4(77, Purpose::kTest, source, 0);
  return {u[0], u[1], u[2]};
}
bool seen(const Vec3d& position) { return position.y() < 0.6; }

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

int srgb(double v) { return static_cast<int>(std::lround(255 * (v <= 0.0031308 ? 12.92 * v : 1.055 * std::pow(v, 1 / 2.4) - 0.055))); }

TEST_F(ExportPoints, WritesTheContractsPropertiesInInputOrder) {
  const stream::Store store = build();
  write_layer(store);
  const ExportStats stats = run(store, to("albedo.ply"));
  const PlyFile ply = read_ply(folder.path() / "albedo.ply");
  const std::vector<std::string> expected{"double x",    "double y",    "double z",       "float nx",       "float ny",       "float nz",    "uchar red",    "uchar green",
                                          "uchar blue", "float albedo_r", "float albedo_g", "float albedo_b", "float sigma", "ushort photos", "float quality", "int scan"};
  EXPECT_EQ(ply.properties, expected);
  EXPECT_EQ(stats.points, ply.rows.size());
  std::size_t row = 0, unseen = 0;
  for (std::size_t i = 0; i < points.size(); ++i) {
    const InputPoint& p = points[i];
    if (std::isnan(p.x)) continue;   // rejected: left out
    ASSERT_LT(row, ply.rows.size());
    ASSERT_EQ(ply.at(row, "x"), p.x);   // the input's exact position
    ASSERT_EQ(ply.at(row, "z"), p.z);
    ASSERT_EQ(ply.at(row, "scan"), p.scan);
    ASSERT_EQ(ply.at(row, "quality"), static_cast<double>(p.quality));
    ASSERT_GT(std::abs(ply.at(row, "nz")), 0.9);
    if (ply.at(row, "photos") > 0) {
      const Vec3f a = albedo_of(i);
      ASSERT_EQ(ply.at(row, "albedo_g"), static_cast<double>(a.y()));
      ASSERT_EQ(ply.at(row, "photos"), static_cast<double>(1 + i % 5));
      ASSERT_NEAR(ply.at(row, "sigma"), 0.01 * static_cast<double>(1 + i % 7), 1e-6);
      ASSERT_NEAR(ply.at(row, "blue"), srgb(static_cast<double>(a.z())), 1);
    } else {
      ++unseen;
      ASSERT_GT(p.y, 0.59);
      ASSERT_TRUE(std::isnan(ply.at(row, "albedo_r")) && std::isnan(ply.at(row, "sigma")));
      ASSERT_EQ(ply.at(row, "red"), p.red);   // the input's colour
      ASSERT_EQ(ply.at(row, "blue"), p.blue);
    }
    ++row;
  }
  EXPECT_EQ(row, ply.rows.size());
  EXPECT_EQ(stats.points_unseen, unseen);
  EXPECT_FALSE(stats.positions_from_store);
  EXPECT_EQ(stats.points_moved, 0u);
}

TEST_F(ExportPoints, BudgetAndThreadsDoNotChangeTheBytes) {
  const stream::Store store = build();
  write_layer(store);
  run(store, to("a.ply"));
  run(store, to("b.ply"), 4 << 20);
  {
    const ThreadLimit one(1);
    run(store, to("c.ply"), 3 << 20);
  }
  const std::string a = read_text(folder.path() / "a.ply");
  EXPECT_EQ(a, read_text(folder.path() / "b.ply"));
  EXPECT_EQ(a, read_text(folder.path() / "c.ply"));
  MemoryBudget tiny(1000);
  EXPECT_THROW(export_points(store, to("d.ply"), folder.path() / "scratch", tiny, report), Error);
  EXPECT_FALSE(std::filesystem::exists(folder.path() / "d.ply"));
}

TEST_F(ExportPoints, ADiskThatIsTooSmallIsMetBeforeAnythingIsWritten) {
  const stream::Store store = build();
  ExportOptions options = to("albedo.ply");
  options.layer.clear();
  // 3 doubles, 3 floats, 3 bytes and 8 bytes carried a point, and 44 in between
  const std::uint64_t needed = store.manifest().points_stored * (24 + 12 + 3 + 8 + 44);
  options.free_bytes = [&](const std::filesystem::path&) { return needed - 1; };
  MemoryBudget budget(kPlenty);
  try {
    export_points(store, options, folder.path() / "scratch", budget, report);
    FAIL();
  } catch (const Error& e) {
    EXPECT_NE(std::string(e.what()).find("no space: the export needs"), std::string::npos) << e.what();
  }
  EXPECT_FALSE(std::filesystem::exists(folder.path() / "albedo.ply"));
  EXPECT_TRUE(std::filesystem::is_empty(folder.path() / "scratch"));
  options.free_bytes = [&](const std::filesystem::path&) { return needed; };
  EXPECT_EQ(run(store, options).points, store.manifest().points_stored);
}

TEST_F(ExportPoints, NeverWritesOverASourceFile) {
  const stream::Store store = build();
  write_layer(store);
  const std::string before = read_text(cloud);
  ExportOptions options = to("cloud.ply");
  EXPECT_THROW(run(store, options), Error);
  std::filesystem::rename(cloud, folder.path() / "now_here.ply");
  options.file = folder.path() / "store.chiaro/../now_here.ply";
  options.sources = {folder.path() / "now_here.ply"};
  EXPECT_THROW(run(store, options), Error);
  EXPECT_EQ(read_text(folder.path() / "now_here.ply"), before);
}

TEST_F(ExportPoints, FillGivesUnseenPointsTheirNeighboursAlbedoAndKeepsThemMarked) {
  const stream::Store store = build();
  write_layer(store);
  ExportOptions options = to("filled.ply");
  options.fill = true;
  const ExportStats stats = run(store, options);
  EXPECT_EQ(stats.points_filled, stats.points_unseen);
  EXPECT_GT(stats.points_filled, 1000u);
  const PlyFile ply = read_ply(folder.path() / "filled.ply");
  std::uint64_t unseen = 0;
  for (std::size_t i = 0; i < ply.rows.size(); ++i) {
    ASSERT_GE(ply.at(i, "albedo_r"), 0);
    ASSERT_LE(ply.at(i, "albedo_r"), 1);
    if (ply.at(i, "photos") > 0) continue;
    ++unseen;
    ASSERT_TRUE(std::isnan(ply.at(i, "sigma")));
    ASSERT_NEAR(ply.at(i, "red"), srgb(ply.at(i, "albedo_r")), 1);
  }
  EXPECT_EQ(unseen, stats.points_unseen);
}

TEST_F(ExportPoints, WhatIsNearerFillsMore) {
  points.assign(3, {});
  points[1].x = 1;
  points[2].x = 0.25;
  const stream::Store store = build();
  stream::LayerWriter writer(store, "albedo", stream::albedo_fields(), "{}");
  const auto sources = store.read_sources(store.leaves()[0]);
  std::vector<float> values(12, std::nanf(""));   // planes r, g, b, sigma
  std::vector<std::uint16_t> photos(3, 0);
  for (std::size_t i = 0; i < 3; ++i) {
    if (sources[i] == 2) continue;
    for (std::size_t c = 0; c < 3; ++c) values[3 * c + i] = sources[i] == 0 ? 0.2f : 0.8f;
    photos[i] = 1;
  }
  writer.write_chunk(store.leaves()[0], tests::planes_of(values, photos));
  writer.finish_inner(silent_reporter());
  writer.commit();
  ExportOptions options = to("filled.ply");
  options.fill = true;
  EXPECT_EQ(run(store, options).points_filled, 1u);
  // by the inverse of the squared distance, a thousandth of the largest one added
  const double a = 1 / (0.0625 + 0.001 * 0.5625), b = 1 / (0.5625 + 0.001 * 0.5625);
  EXPECT_NEAR(read_ply(folder.path() / "filled.ply").at(2, "albedo_g"), (0.2 * a + 0.8 * b) / (a + b), 1e-3);
}

TEST_F(ExportPoints, FourSpacingsFromWhatIsSeenTheCoarserLevelsFill) {
  const stream::Store store = build();
  const std::uint32_t leaf = store.leaves()[0];
  const stream::Chunk chunk = store.read_chunk(leaf);
  const auto place = [&](std::uint32_t slot) { return chunk.surfel(slot).position_in_world; };
  std::uint32_t corner = 0;   // the only one of its leaf that is seen; of the other leaves all are
  for (std::uint32_t i = 1; i < chunk.count; ++i)
    if (place(i).x() + place(i).y() < place(corner).x() + place(corner).y()) corner = i;
  stream::LayerWriter writer(store, "albedo", stream::albedo_fields(), "{}");
  for (const std::uint32_t l : store.leaves()) {
    const std::size_t n = store.chunks()[l].count;
    std::vector<float> values(4 * n, l == leaf ? std::nanf("") : 0.8f);
    std::vector<std::uint16_t> photos(n, l == leaf ? 0 : 1);
    if (l == leaf) {
      for (std::size_t plane = 0; plane < 4; ++plane) values[plane * n + corner] = 0.2f;
      photos[corner] = 1;
    }
    writer.write_chunk(l, tests::planes_of(values, photos));
  }
  writer.finish_inner(silent_reporter());
  writer.commit();
  const stream::Layer layer(store, "albedo");
  std::vector<Vec3f> albedo = stream::read_albedo(layer, store, leaf).albedo;
  EXPECT_EQ(fill_unseen(store, layer, chunk, albedo), chunk.count - 1u);
  const stream::ChunkEntry& entry = store.chunks()[leaf];
  const double spacing = static_cast<double>(std::max(entry.spacing, 0.5f * entry.radius_max));
  int near = 0, far = 0;
  for (std::uint32_t i = 0; i < chunk.count; ++i) {
    const double spacings = (place(i) - place(corner)).norm() / spacing;
    if (spacings < 3.99) {
      ++near;
      EXPECT_NEAR(albedo[i][0], 0.2f, 1e-6f) << spacings;
    } else if (spacings > 4.01) {
      ++far;
      EXPECT_GT(albedo[i][0], 0.201f) << spacings;
    }
  }
  EXPECT_GT(near, 8);
  EXPECT_GT(far, 50);
}

TEST_F(ExportPoints, AFlatAlbedoIsFilledFlat) {
  const stream::Store store = build();
  stream::LayerWriter writer(store, "albedo", stream::albedo_fields(), "{}");
  for (const std::uint32_t leaf : store.leaves()) {
    const stream::Chunk chunk = store.read_chunk(leaf);
    const std::size_t n = chunk.count;
    std::vector<float> values(4 * n, 0.25f);
    std::vector<std::uint16_t> photos(n, 1);
    for (std::uint32_t i = 0; i < n; ++i)
      if (chunk.surfel(i).position_in_world.y() > 0.1) {
        for (std::size_t c = 0; c < 3; ++c) values[c * n + i] = std::nanf("");
        photos[i] = 0;
      }
    writer.write_chunk(leaf, tests::planes_of(values, photos));
  }
  writer.finish_inner(silent_reporter());
  writer.commit();
  ExportOptions options = to("flat.ply");
  options.fill = true;
  run(store, options);
  const PlyFile ply = read_ply(folder.path() / "flat.ply");
  for (std::size_t i = 0; i < ply.rows.size(); ++i) ASSERT_NEAR(ply.at(i, "albedo_b"), 0.25, 1e-5);
}

TEST_F(ExportPoints, AChangedSourceFileGivesPositionsOfTheStoreAndANote) {
  const stream::Store store = build();
  write_layer(store);
  points[10].quality += 1;
  write_ply(cloud, points);
  const ExportStats stats = run(store, to("albedo.ply"));
  EXPECT_TRUE(stats.positions_from_store);
  EXPECT_NE(report.notes.find("cloud.ply has changed"), std::string::npos) << report.notes;
  const PlyFile ply = read_ply(folder.path() / "albedo.ply");
  EXPECT_EQ(ply.properties.size(), 14u);
  EXPECT_EQ(ply.properties[0], "double x");   // half a million metres away from the origin
  std::size_t row = 0;
  for (const InputPoint& p : points) {
    if (std::isnan(p.x)) continue;
    ASSERT_NEAR(ply.at(row, "x"), p.x, 1e-4);
    ASSERT_NEAR(ply.at(row++, "y"), p.y, 1e-4);
  }
  std::filesystem::remove(cloud);
  report.notes.clear();
  EXPECT_TRUE(run(store, to("albedo.ply")).positions_from_store);
  EXPECT_NE(report.notes.find("not there any more"), std::string::npos) << report.notes;
}

/// PCD as PCL compresses it, but with literal runs alone.
std::string compressed_pcd(std::size_t count) {
  std::string planar;
  for (int axis = 0; axis < 3; ++axis)
    for (std::size_t i = 0; i < count; ++i) {
      const auto u = uniform01x4(3, Purpose::kTest, i, 0);
      append(planar, axis == 2 ? 0.0f : u[static_cast<std::size_t>(axis)]);
    }
  std::string packed;
  for (std::size_t at = 0; at < planar.size(); at += 32) {
    const std::string run = planar.substr(at, 32);
    packed += static_cast<char>(run.size() - 1);
    packed += run;
  }
  const std::string n = std::to_string(count);
  std::string text = "VERSION .7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH " + n + "\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS " + n + "\nDATA binary_compressed\n";
  append(text, static_cast<std::uint32_t>(packed.size()));
  append(text, static_cast<std::uint32_t>(planar.size()));
  return text + packed;
}

TEST_F(ExportPoints, AFileThatTheBudgetCannotHoldOnceMoreCostsItsPropertiesAndNotTheResult) {
  constexpr std::size_t kMany = 100000;
  write_text(folder.path() / "cloud.pcd", compressed_pcd(kMany));
  const stream::Store store = build({folder.path() / "cloud.pcd"});
  ExportOptions options = to("all.ply");
  options.layer.clear();
  EXPECT_FALSE(run(store, options).positions_from_store);
  EXPECT_TRUE(report.notes.empty());
  const ExportStats stats = run(store, options, 4 << 20);
  EXPECT_TRUE(stats.positions_from_store);
  EXPECT_EQ(stats.points, kMany);
  EXPECT_NE(report.notes.find("cloud.pcd: a compressed PCD is read whole"), std::string::npos) << report.notes;
  EXPECT_NE(report.notes.find("positions come from the store"), std::string::npos) << report.notes;
}

TEST_F(ExportPoints, ASourceFileThatHasMovedIsReadWhereItIsNow) {
  const stream::Store store = build();
  write_layer(store);
  run(store, to("before.ply"));
  const std::filesystem::path moved = folder.path() / "elsewhere.ply";
  std::filesystem::rename(cloud, moved);
  ExportOptions options = to("after.ply");
  options.sources = {moved};
  EXPECT_FALSE(run(store, options).positions_from_store);
  EXPECT_EQ(read_text(folder.path() / "before.ply"), read_text(folder.path() / "after.ply"));
  write_ply(moved, input_points(3));   // another file of that name is none of its sources
  EXPECT_TRUE(run(store, options).positions_from_store);
}

TEST_F(ExportPoints, SeveralFilesFollowOneAnotherAndKeepWhatAllOfThemHave) {
  const auto second = input_points(2);
  const auto other = folder.path() / "second.ply";
  write_ply(cloud, points);
  write_ply(other, second, false);
  const stream::Store store = build({cloud, other});
  write_layer(store);
  run(store, to("albedo.ply"));
  const PlyFile ply = read_ply(folder.path() / "albedo.ply");
  EXPECT_EQ(ply.properties.back(), "float quality");
  EXPECT_NE(report.notes.find("\"scan\" is left out"), std::string::npos) << report.notes;
  std::size_t row = 0;
  for (const std::vector<InputPoint>* file : {static_cast<const std::vector<InputPoint>*>(&points), &second})
    for (const InputPoint& p : *file) {
      if (std::isnan(p.x)) continue;
      ASSERT_EQ(ply.at(row, "x"), p.x);
      ASSERT_EQ(ply.at(row++, "quality"), static_cast<double>(p.quality));
    }
  EXPECT_EQ(row, ply.rows.size());
}

TEST_F(ExportPoints, WhatTheFirstFileLacksIsNamed) {
  const auto other = folder.path() / "second.ply";
  write_ply(cloud, points, false);
  write_ply(other, input_points(2));
  const stream::Store store = build({cloud, other});
  write_layer(store);
  run(store, to("albedo.ply"));
  EXPECT_EQ(read_ply(folder.path() / "albedo.ply").properties.back(), "float quality");
  EXPECT_NE(report.notes.find("\"scan\" is left out"), std::string::npos) << report.notes;
}

TEST_F(ExportPoints, WhatFilesHaveInSeveralTypesIsWrittenInOneThatHoldsAll) {
  const auto write = [&](const char* name, const char* properties, const std::vector<std::string>& values) {
    const auto file = folder.path() / name;
    std::string text = concat("ply\nformat ascii 1.0\nelement vertex ", values.size(), "\nproperty double x\nproperty double y\nproperty double z\n", properties, "end_header\n");
    for (std::size_t i = 0; i < values.size(); ++i) text += concat(i % 5, " ", i / 5, " 0 ", values[i], "\n");
    write_text(file, text);
    return file;
  };
  const auto first = write("first.ply", "property float quality\nproperty uchar class\nproperty ushort intensity\nproperty uint id\nproperty uchar kept\n", std::vector<std::string>(10, "0.5 200 65535 4000000000 7"));
  const auto second = write("second.ply", "property uchar kept\nproperty double quality\nproperty char class\nproperty float intensity\nproperty short id\n", std::vector<std::string>(10, "8 1234567890.125 -100 0.25 -3"));
  const stream::Store store = build({first, second});
  write_layer(store);
  run(store, to("albedo.ply"));
  const PlyFile ply = read_ply(folder.path() / "albedo.ply");
  const std::vector<std::string> carried(ply.properties.end() - 5, ply.properties.end());
  EXPECT_EQ(carried, (std::vector<std::string>{"double quality", "short class", "float intensity", "double id", "uchar kept"}));   // PLY has no whole numbers of 64 bits
  EXPECT_NE(report.notes.find("\"class\" has several types in the source files and is written as short"), std::string::npos) << report.notes;
  EXPECT_EQ(report.notes.find("left out"), std::string::npos) << report.notes;
  ASSERT_EQ(ply.rows.size(), 20u);
  const auto values = [&](std::size_t row) { return std::vector<double>(ply.rows[row].end() - 5, ply.rows[row].end()); };
  EXPECT_EQ(values(9), (std::vector<double>{0.5, 200, 65535, 4e9, 7}));
  EXPECT_EQ(values(10), (std::vector<double>{1234567890.125, -100, 0.25, -3, 8}));
}

TEST_F(ExportPoints, AnExportIngestedAgainDoesNotRepeatItsProperties) {
  const stream::Store first = build();
  write_layer(first);
  run(first, to("albedo.ply"));
  const PlyFile before = read_ply(folder.path() / "albedo.ply");
  const stream::Store again = build({folder.path() / "albedo.ply"});
  write_layer(again);
  run(again, to("twice.ply"));
  EXPECT_EQ(read_ply(folder.path() / "twice.ply").properties, before.properties);
  EXPECT_NE(report.notes.find("replaced"), std::string::npos);
}

TEST_F(ExportPoints, WithoutALayerItIsTheGeometryAndTheInputsColour) {
  const stream::Store store = build();
  ExportOptions options = to("plain.ply");
  options.layer.clear();
  run(store, options);
  const PlyFile ply = read_ply(folder.path() / "plain.ply");
  EXPECT_EQ(ply.properties.size(), 11u);
  EXPECT_EQ(ply.at(3, "green"), 3);
  options.layer = "albedo";
  EXPECT_THROW(run(store, options), Error);
}

TEST_F(ExportPoints, LasAndPcdHoldTheSamePointsAndCarryTheAlbedo) {
  const stream::Store store = build();
  write_layer(store);
  for (const char* name : {"albedo.las", "albedo.pcd"}) {
    run(store, to(name));
    const auto reader = stream::open_points(folder.path() / name);
    stream::PointBlock block, all;
    while (reader->read(block, 1000)) all.position.insert(all.position.end(), block.position.begin(), block.position.end());
    std::size_t row = 0;
    for (const InputPoint& p : points) {
      if (std::isnan(p.x)) continue;
      ASSERT_LT(row, all.size()) << name;
      ASSERT_NEAR(all.position[row].y(), p.y, 2e-4) << name;
      ASSERT_NEAR(all.position[row++].x(), p.x, 2e-4) << name;
    }
    EXPECT_EQ(row, all.size());
    bool has_albedo = false;
    for (const auto& e : reader->schema().extras) has_albedo |= e.name == "albedo_r";
    EXPECT_TRUE(has_albedo) << name;
  }
}

/// The points of a file as an alignment of scans has moved them.
class MovedReader final : public stream::PointReader {
 public:
  MovedReader(const std::filesystem::path& file, const Vec3d& by) : reader_(stream::open_points(file)), by_(by) {}
  const stream::PointSchema& schema() const override { return reader_->schema(); }
  bool read(stream::PointBlock& block, std::size_t max_points) override {
    if (!reader_->read(block, max_points)) return false;
    for (Vec3d& p : block.position) p += by_;
    return true;
  }

 private:
  std::unique_ptr<stream::PointReader> reader_;
  Vec3d by_;
};

TEST_F(ExportPoints, ScansThatWereAlignedAreWrittenWhereTheyAreStored) {
  write_ply(cloud, points);
  const Vec3d by(0.3, -0.2, 0.1);
  const stream::CloudInput input{{cloud}, {file_fingerprint(cloud)}, [&](std::size_t) { return std::make_unique<MovedReader>(cloud, by); }, {}, "", ""};
  MemoryBudget budget(kPlenty);
  stream::build_store_from(input, folder.path() / "moved.chiaro", {}, budget, silent_reporter());
  const stream::Store store(folder.path() / "moved.chiaro");
  write_layer(store);
  const ExportStats stats = run(store, to("moved.ply"));
  EXPECT_EQ(stats.points_moved, stats.points);
  EXPECT_FALSE(stats.positions_from_store);
  EXPECT_NE(report.notes.find("the stored positions are written"), std::string::npos);
  const PlyFile ply = read_ply(folder.path() / "moved.ply");
  std::size_t row = 0;
  for (const InputPoint& p : points) {
    if (std::isnan(p.x)) continue;
    ASSERT_NEAR(ply.at(row, "x"), p.x + by.x(), 1e-4) << row;
    ASSERT_NEAR(ply.at(row, "y"), p.y + by.y(), 1e-4) << row;
    ASSERT_EQ(ply.at(row, "scan"), p.scan) << row;
    ++row;
  }
  EXPECT_EQ(row, stats.points);
}

TEST_F(ExportPoints, InsertedPointsFollowWhereAPhotographSeesThem) {
  const stream::Store store = build();
  write_layer(store, R"({"key": "this run"})");
  std::vector<InputPoint> more = input_points(2);
  more.resize(300);
  for (InputPoint& p : more) p.z += 3e6;   // far beyond the bounds of the cloud: they count in those of the file
  write_ply(folder.path() / "more.ply", more);
  const std::filesystem::path place = inserted_path(store.path(), "albedo");
  std::filesystem::create_directories(place.parent_path());
  MemoryBudget budget(kPlenty);
  stream::build_store({folder.path() / "more.ply"}, place, {}, budget, silent_reporter());
  write_layer(stream::Store(place), R"({"of": "this run"})");
  std::multiset<double> wanted;
  for (const InputPoint& p : more)
    if (seen(Vec3d(p.x, p.y, p.z)) && !std::isnan(p.x)) wanted.insert(p.y);
  ASSERT_GT(wanted.size(), 100u);
  ASSERT_LT(wanted.size(), 250u);

  const ExportStats stats = run(store, to("with.ply"));
  EXPECT_EQ(stats.points_inserted, wanted.size());
  EXPECT_EQ(stats.points, store.manifest().points_stored + wanted.size());
  const PlyFile ply = read_ply(folder.path() / "with.ply");
  ASSERT_EQ(ply.rows.size(), stats.points);
  std::multiset<double> found;
  for (std::size_t i = 0; i < ply.rows.size(); ++i) {
    ASSERT_EQ(ply.at(i, "inserted"), i < store.manifest().points_stored ? 0 : 1);
    if (i < store.manifest().points_stored) continue;
    ASSERT_GT(ply.at(i, "photos"), 0);
    ASSERT_TRUE(std::isnan(ply.at(i, "quality")));
    ASSERT_EQ(ply.at(i, "scan"), 0);
    found.insert(ply.at(i, "y"));
  }
  ASSERT_EQ(found.size(), wanted.size());
  for (auto a = found.begin(), b = wanted.begin(); a != found.end(); ++a, ++b) ASSERT_NEAR(*a, *b, 1e-4);

  run(store, to("with.las"));
  const auto reader = stream::open_points(folder.path() / "with.las");
  stream::PointBlock block;
  std::size_t high = 0;
  while (reader->read(block, 1000))
    for (const Vec3d& p : block.position) {
      ASSERT_NEAR(p.x(), 500000.5, 0.6);
      high += std::abs(p.z() - 3e6) < 0.1;
    }
  EXPECT_EQ(high, wanted.size());
  // Of another run they are nobody's.
  write_layer(stream::Store(place), R"({"of": "another run"})");
  EXPECT_EQ(run(store, to("without.ply")).points_inserted, 0u);
}

TEST(RowPacker, WhatAnInsertedPointDoesNotCarryIsNoNumberOrZero) {
  using stream::ScalarType;
  const RowPacker rows(true, false, true, true, {{"time", ScalarType::kF64}, {"quality", ScalarType::kF32}, {"scan", ScalarType::kI32}});
  std::vector<std::byte> row(rows.row_bytes(), std::byte{0x7b});
  const PointRecord record{0, 0, Vec3f(0.5f, 0.25f, 1), 0.1f, {}, {1, 2, 3}, {0, 0}, 4};
  const std::byte* end = rows.pack_nothing_carried(rows.pack(record, Vec3d(1, 2, 3), 1, row.data()));
  EXPECT_EQ(end, row.data() + row.size());
  const char* at = reinterpret_cast<const char*>(row.data() + row.size()) - 16;
  EXPECT_TRUE(std::isnan(take<double>(at)));
  EXPECT_TRUE(std::isnan(take<float>(at)));
  EXPECT_EQ(take<std::int32_t>(at), 0);
  at = reinterpret_cast<const char*>(row.data()) + 36;   // three doubles, three floats
  for (const double linear : {0.5, 0.25, 1.0}) EXPECT_EQ(take<std::uint8_t>(at), srgb(linear));
}

struct WholeCloud {
  stream::PointSchema schema;
  stream::PointBlock points;
};

/// All usable points.
WholeCloud read_cloud(const std::filesystem::path& path) {
  const auto reader = stream::open_points(path);
  WholeCloud cloud{reader->schema(), {}};
  const std::size_t row = cloud.schema.extra_bytes();
  stream::PointBlock block;
  while (reader->read(block, 7))
    for (std::size_t i = 0; i < block.size(); ++i) {
      if (!block.position[i].allFinite()) continue;
      cloud.points.position.push_back(block.position[i]);
      if (cloud.schema.has_colour) cloud.points.colour.push_back(block.colour[i]);
      cloud.points.extras.insert(cloud.points.extras.end(), block.extras.data() + i * row, block.extras.data() + (i + 1) * row);
    }
  return cloud;
}

/// Each extra of `before` is in `after` too, with its type and the same bytes.
void expect_carried(const WholeCloud& before, const WholeCloud& after) {
  ASSERT_EQ(before.points.size(), after.points.size());
  const auto place = [](const stream::PointSchema& schema, const stream::PointProperty& wanted) {
    std::size_t offset = 0;
    for (const auto& e : schema.extras) {
      if (e.name == wanted.name && e.type == wanted.type) return offset;
      offset += stream::scalar_bytes(e.type);
    }
    ADD_FAILURE() << wanted.name << " is missing";
    return std::size_t{0};
  };
  for (const auto& extra : before.schema.extras) {
    const std::size_t from = place(before.schema, extra), to = place(after.schema, extra);
    for (std::size_t i = 0; i < before.points.size(); ++i) {
      const std::byte* a = before.points.extras.data() + i * before.schema.extra_bytes() + from;
      const std::byte* b = after.points.extras.data() + i * after.schema.extra_bytes() + to;
      ASSERT_EQ(std::memcmp(a, b, stream::scalar_bytes(extra.type)), 0) << extra.name << " of point " << i;
    }
  }
}

std::filesystem::path cloud_data(const char* name) { return std::filesystem::path(CHIARO_SOURCE_DIR) / "tests/stream/cloud/data" / name; }

TEST_F(ExportPoints, NamesAndWholeNumbersThatAFormatCannotHoldComeOutAsItCan) {
  std::string text = "ply\nformat ascii 1.0\nelement vertex 600\nproperty double x\nproperty double y\nproperty double z\nproperty int64 id\nproperty uint64 scalar_\xc3\x89" "cart\nproperty float scalar__cart\nend_header\n";
  for (int i = 0; i < 600; ++i) text += concat(0.01 * (i % 25), " ", 0.01 * (i / 25), " 0 ", -5 - i, " ", 7000000000 + i, " ", i, "\n");
  write_text(cloud, text);
  const stream::Store store = build({cloud});
  ExportOptions options = to("plain.ply");
  options.layer.clear();
  run(store, options);
  const PlyFile ply = read_ply(options.file);
  const std::vector<std::string> carried(ply.properties.begin() + 9, ply.properties.end());
  EXPECT_EQ(carried, (std::vector<std::string>{"double id", "double scalar__cart", "float scalar__cart_2"}));
  EXPECT_EQ(ply.at(599, "id"), -604);
  EXPECT_EQ(ply.at(599, "scalar__cart"), 7000000599);
  EXPECT_EQ(ply.at(599, "scalar__cart_2"), 599);
  for (const char* what : {"\"id\" is written as double, exact up to 2^53", "cart\" is written as \"scalar__cart\""}) EXPECT_NE(report.notes.find(what), std::string::npos) << what << '\n' << report.notes;
  for (const char* name : {"plain.las", "plain.pcd"}) {   // both have such numbers
    options.file = folder.path() / name;
    run(store, options);
    const auto reader = stream::open_points(options.file);
    const auto& extras = reader->schema().extras;
    const auto id = std::find_if(extras.begin(), extras.end(), [](const stream::PointProperty& p) { return p.name == "id"; });
    ASSERT_NE(id, extras.end()) << name;
    EXPECT_EQ(id->type, stream::ScalarType::kI64);
  }
}

TEST_F(ExportPoints, PcdHasPositionsInSinglePrecisionWhereThatIsEnough) {
  for (InputPoint& p : points) p.x -= 500000;   // doubles, near the origin
  const stream::Store near = build();
  ExportOptions options = to("near.pcd");
  options.layer.clear();
  run(near, options);
  EXPECT_NE(read_text(options.file).find("\nSIZE 4 4 4 "), std::string::npos);
  EXPECT_EQ(report.notes.find("single precision"), std::string::npos);
  points = input_points(1);
  const stream::Store far = build();
  run(far, options);
  EXPECT_NE(read_text(options.file).find("\nSIZE 8 8 8 "), std::string::npos);
  EXPECT_NE(report.notes.find("too far from the origin for single precision"), std::string::npos);
}

TEST_F(ExportPoints, LasKeepsTheStepOfALasFileAndTheDigitsOfOthers) {
  const auto scale_of = [](const std::filesystem::path& file) {
    double scale = 0;
    std::memcpy(&scale, read_text(file).data() + 131, sizeof scale);
    return scale;
  };
  ExportOptions options = to("first.las");
  options.layer.clear();
  run(build(), options);
  EXPECT_LE(scale_of(options.file), 1e-8);   // a metre across
  {
    stream::PointWriterOptions coarse;
    coarse.num_points = 300;
    coarse.properties = {{"x", stream::ScalarType::kF64}, {"y", stream::ScalarType::kF64}, {"z", stream::ScalarType::kF64}};
    coarse.bounds.extend(Vec3d(0, 0, 0));
    coarse.bounds.extend(Vec3d(1, 1, 1));
    coarse.resolution = 0.002;
    const auto writer = stream::create_points(folder.path() / "coarse.las", coarse);
    std::string rows;
    for (int i = 0; i < 300; ++i)
      for (const double v : {0.002 * (i % 20), 0.002 * (i / 20), 0.0}) append(rows, v);
    writer->write(reinterpret_cast<const std::byte*>(rows.data()), 300);
    writer->commit();
  }
  options.file = folder.path() / "second.las";
  run(build({folder.path() / "coarse.las"}), options);
  EXPECT_EQ(scale_of(options.file), 0.002);
}

// As CloudCompare and PDAL write it: the offset is the lowest coordinate, whatever that is. Feet in metres, and another step for heights.
TEST_F(ExportPoints, LasKeepsThePositionsOfALasFileWithAnyOffset) {
  const auto write = [&](const char* name, const stream::PositionGrid& grid, std::int64_t shift) {
    stream::PointWriterOptions las;
    las.num_points = 300;
    las.properties = {{"x", stream::ScalarType::kF64}, {"y", stream::ScalarType::kF64}, {"z", stream::ScalarType::kF64}};
    las.grid = grid;
    std::string rows;
    for (std::int64_t i = 0; i < 300; ++i) {
      const Vec3d p = grid.position({shift + 7 * (i % 20), 11 * (i / 20) - shift, i % 3});
      las.bounds.extend(p);
      for (const double v : p) append(rows, v);
    }
    const auto writer = stream::create_points(folder.path() / name, las);
    writer->write(reinterpret_cast<const std::byte*>(rows.data()), 300);
    writer->commit();
    return folder.path() / name;
  };
  const stream::PositionGrid grid{{0.0003048, 0.0003048, 0.001}, {431234.56789, 5212345.67891, 100.0005}};
  const auto one = write("one.las", grid, 0), two = write("two.las", grid, 5000);
  ExportOptions options = to("kept.las");
  options.layer.clear();
  run(build({one, two}), options);
  const WholeCloud kept = read_cloud(options.file);
  ASSERT_EQ(kept.points.size(), 600u);
  constexpr double kRounding = 4e-9;   // of doubles of five million metres
  std::size_t at = 0;
  for (const auto& file : {one, two})
    for (const Vec3d& p : read_cloud(file).points.position) ASSERT_LE((kept.points.position[at++] - p).cwiseAbs().maxCoeff(), kRounding) << at;
}

TEST_F(ExportPoints, LazComesOutAsLasWithAllThatItCarried) {
  if (!CHIARO_HAS_RUST_FORMATS) GTEST_SKIP() << "built without cargo";
  for (const char* name : {"variable_chunks.laz", "format_7.laz", "format_8.laz", "format_3.laz"}) {
    SCOPED_TRACE(name);
    const stream::Store store = build({cloud_data(name)});
    ExportOptions options = to("out.las");
    options.layer.clear();
    run(store, options);
    const WholeCloud before = read_cloud(cloud_data(name)), after = read_cloud(folder.path() / "out.las");
    expect_carried(before, after);
    ASSERT_EQ(after.points.colour, before.points.colour);   // 16 bits
    for (std::size_t i = 0; i < before.points.size(); ++i) ASSERT_LT((before.points.position[i] - after.points.position[i]).norm(), 1e-4) << i;
  }
}

TEST_F(ExportPoints, E57ComesOutAsPlyWithAllThatItCarried) {
  if (!CHIARO_HAS_RUST_FORMATS) GTEST_SKIP() << "built without cargo";
  const stream::Store store = build({cloud_data("two_scans.e57")});
  EXPECT_EQ(store.manifest().points_read, 52u);
  EXPECT_EQ(store.manifest().points_stored, 46u);
  EXPECT_EQ(store.manifest().points_rejected.at("invalid in the scan"), 6u);
  ExportOptions options = to("out.ply");
  options.layer.clear();
  run(store, options);
  const WholeCloud before = read_cloud(cloud_data("two_scans.e57")), after = read_cloud(folder.path() / "out.ply");
  expect_carried(before, after);
  EXPECT_EQ(after.points.colour, before.points.colour);   // 8 bits both
  EXPECT_EQ(after.points.position, before.points.position);
}

TEST_F(ExportPoints, PtxComesOutAsPlyWithAllThatItCarried) {
  const std::string head = "0 0 0\n1 0 0\n0 1 0\n0 0 1\n0 1 0 0\n-1 0 0 0\n0 0 1 0\n10 20 30 1\n";
  std::string text;
  for (int scan = 0; scan < 2; ++scan) {
    text += "4\n5\n" + head;
    for (int i = 0; i < 20; ++i)
      text += i % 7 == 6 ? "0 0 0 0.5 0 0 0\n" : concat(i % 5 + 5 * scan, " ", i / 5 + 0.5, " 0.25 ", 0.01 * i, " ", i, " 2 3\n");
  }
  const auto path = folder.path() / "scans.ptx";
  write_text(path, text);
  const stream::Store store = build({path});
  EXPECT_EQ(store.manifest().points_rejected.at("invalid in the scan"), 4u);
  ExportOptions options = to("out.ply");
  options.layer.clear();
  run(store, options);
  const WholeCloud before = read_cloud(path), after = read_cloud(folder.path() / "out.ply");
  expect_carried(before, after);
  EXPECT_EQ(after.points.colour, before.points.colour);
  EXPECT_EQ(after.points.position, before.points.position);
}

}  // namespace
}  // namespace chiaro::tools
