#include "tools/export_points.h"

#include <set>

#include "stream/base/error.h"
#include "stream/base/hash.h"
#include "stream/base/parallel.h"
#include "stream/cloud/point_stream.h"
#include "tests/blend/export_fixture.h"
#include "tools/export_rows.h"
#include "tools/inserted_points.h"

namespace chiaro::tools {
namespace {

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

}  // namespace
}  // namespace chiaro::tools
