#include "tests/blend/export_fixture.h"
#include "tools/fill_unseen.h"

namespace chiaro::tools {
namespace {

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

}  // namespace
}  // namespace chiaro::tools
