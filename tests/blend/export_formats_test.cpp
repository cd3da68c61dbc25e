#include "stream/base/error.h"
#include "stream/cloud/point_stream.h"
#include "tests/blend/export_fixture.h"

namespace chiaro::tools {
namespace {

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
