#include "stream/store/layer.h"

#include <gtest/gtest.h>

#include <cmath>
#include <cstring>

#include "memory_cloud.h"
#include "stream/base/file.h"

namespace chiaro::stream {
namespace {

std::vector<std::byte> planar_albedo(const std::vector<Vec3f>& albedo, const std::vector<float>& sigma, const std::vector<std::uint16_t>& photos) {
  const std::size_t n = albedo.size();
  std::vector<std::byte> bytes(n * 18);
  for (std::size_t i = 0; i < n; ++i)
    for (std::size_t c = 0; c < 3; ++c) std::memcpy(&bytes[(c * n + i) * 4], &albedo[i][static_cast<int>(c)], 4);
  std::memcpy(&bytes[12 * n], sigma.data(), 4 * n);
  std::memcpy(&bytes[16 * n], photos.data(), 2 * n);
  return bytes;
}

TEST(Layer, LeavesComeBackAndInnerSurfelsAreMeans) {
  const ScratchFolder scratch;
  const MemoryCloud cloud = plane_cloud(6000);
  build(cloud, scratch.path() / "a.chiaro", 512);
  const Store store(scratch.path() / "a.chiaro");
  // Albedo = (x, y, 0.5), unseen where x < 0.3; two photographs each.
  LayerWriter writer(store, "albedo", albedo_fields(), R"({"method": "test"})");
  for (const std::uint32_t leaf : store.leaves()) {
    const Chunk c = store.read_chunk(leaf);
    std::vector<Vec3f> albedo(c.count);
    std::vector<float> sigma(c.count, 0.125f);
    std::vector<std::uint16_t> photos(c.count, 2);
    for (std::uint32_t i = 0; i < c.count; ++i) {
      const Vec3d p = c.surfel(i).position_in_world;
      albedo[i] = Vec3f(static_cast<float>(p.x()), static_cast<float>(p.y()), 0.5f);
      if (p.x() >= 0.3) continue;
      albedo[i] = Vec3f::Constant(NAN);
      sigma[i] = NAN;
      photos[i] = 0;
    }
    writer.write_chunk(leaf, planar_albedo(albedo, sigma, photos));
  }
  EXPECT_FALSE(has_layer(store, "albedo"));
  writer.finish_inner(silent_reporter());
  writer.commit();
  ASSERT_TRUE(has_layer(store, "albedo"));
  const Layer layer(store, "albedo");
  EXPECT_EQ(layer.provenance_json(), R"({"method": "test"})");
  EXPECT_EQ(layer.record_bytes(), 18u);
  std::size_t unseen = 0;
  for (std::uint32_t i = 0; i < store.chunks().size(); ++i) {
    const Chunk c = store.read_chunk(i);
    const AlbedoValues v = read_albedo(layer, store, i);
    const bool leaf = store.chunks()[i].is_leaf();
    const double voxel = leaf ? 0 : static_cast<double>(store.chunks()[i].spacing);
    for (std::uint32_t s = 0; s < c.count; ++s) {
      const Vec3d p = c.surfel(s).position_in_world;
      if (p.x() < 0.3 - 2 * voxel) {
        ASSERT_TRUE(std::isnan(v.albedo[s].x()) && std::isnan(v.sigma[s]));
        ASSERT_EQ(v.photos[s], 0);
        ++unseen;
      } else if (p.x() >= 0.3 + 2 * voxel) {
        // The mean of means is the mean position only where voxels hold equally many: within a voxel anyway.
        ASSERT_NEAR(static_cast<double>(v.albedo[s].x()), p.x(), leaf ? 1e-6 : voxel);
        ASSERT_NEAR(static_cast<double>(v.albedo[s].y()), p.y(), leaf ? 1e-6 : voxel);
        ASSERT_EQ(v.albedo[s].z(), 0.5f);
        ASSERT_EQ(v.sigma[s], 0.125f);
        ASSERT_EQ(v.photos[s], 2);
      }
    }
  }
  EXPECT_GT(unseen, 1500u);
}

TEST(Layer, ANodeJustAboveLeavesHoldsTheMeanOfItsMembers) {
  const ScratchFolder scratch;
  build(plane_cloud(2000), scratch.path() / "a.chiaro", 256);
  const Store store(scratch.path() / "a.chiaro");
  LayerWriter writer(store, "x", {{"number", FieldType::kF32, 1}, {"count", FieldType::kU8, 1}, {"half", FieldType::kF16, 1}}, "{}");
  for (const std::uint32_t leaf : store.leaves()) {
    const std::uint32_t n = store.chunks()[leaf].count;
    const auto sources = store.read_sources(leaf);
    std::vector<std::byte> bytes(7 * n);
    for (std::uint32_t i = 0; i < n; ++i) {
      const auto value = static_cast<float>(sources[i]);
      std::memcpy(&bytes[4 * i], &value, 4);
      bytes[4 * n + i] = static_cast<std::byte>(sources[i] % 3);
      const std::uint16_t one_and_a_half = 0x3e00;
      std::memcpy(&bytes[5 * n + 2 * i], &one_and_a_half, 2);
    }
    writer.write_chunk(leaf, bytes);
  }
  writer.finish_inner(silent_reporter());
  writer.commit();
  const Layer layer(store, "x");
  // A parent of leaves only: the weighted sum of its means is the sum over the leaves (voxel by voxel through the number of members).
  for (std::uint32_t i = 0; i < store.chunks().size(); ++i) {
    const ChunkEntry& e = store.chunks()[i];
    if (e.is_leaf()) continue;
    const auto bytes = layer.read_chunk(i);
    for (std::uint32_t s = 0; s < e.count; ++s) {
      float number;
      std::uint16_t half;
      std::memcpy(&number, &bytes[4 * s], 4);
      std::memcpy(&half, &bytes[5 * e.count + 2 * s], 2);
      ASSERT_GE(number, 0);
      ASSERT_LT(number, 2000);
      const int count = std::to_integer<int>(bytes[4 * e.count + s]);
      ASSERT_LE(count, 2);
      ASSERT_EQ(half, 0x3e00);
    }
  }
}

TEST(Layer, LeavesThatWereNotWrittenAreUnseen) {
  const ScratchFolder scratch;
  build(plane_cloud(1000), scratch.path() / "a.chiaro", 256);
  const Store store(scratch.path() / "a.chiaro");
  LayerWriter writer(store, "albedo", albedo_fields(), "{}");
  writer.finish_inner(silent_reporter());
  writer.commit();
  const Layer layer(store, "albedo");
  for (std::uint32_t i = 0; i < store.chunks().size(); ++i) {
    const AlbedoValues v = read_albedo(layer, store, i);
    for (std::size_t s = 0; s < v.albedo.size(); ++s) {
      EXPECT_TRUE(std::isnan(v.albedo[s].y()));
      EXPECT_EQ(v.photos[s], 0);
    }
  }
}

TEST(Layer, AWriterThatIsNotCommittedLeavesNothing) {
  const ScratchFolder scratch;
  build(plane_cloud(1000), scratch.path() / "a.chiaro", 256);
  const Store store(scratch.path() / "a.chiaro");
  {
    LayerWriter writer(store, "albedo", albedo_fields(), "{}");
    EXPECT_THROW(writer.commit(), std::invalid_argument);
    EXPECT_THROW(writer.write_chunk(0, {}), std::invalid_argument);
  }
  EXPECT_FALSE(has_layer(store, "albedo"));
  EXPECT_TRUE(std::filesystem::is_empty(store.path() / "layers"));
}

}  // namespace
}  // namespace chiaro::stream
