#include "stream/store/store.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <cstring>
#include <fstream>

#include "memory_cloud.h"
#include "stream/base/error.h"
#include "stream/base/file.h"
#include "stream/base/hash.h"
#include "stream/store/layer.h"
#include "stream/store/store_format.h"

namespace chiaro::stream {
namespace {

namespace fs = std::filesystem;

void overwrite(const fs::path& path, const std::string& bytes) {
  std::ofstream out(path, std::ios::binary | std::ios::trunc);
  out.write(bytes.data(), static_cast<std::streamsize>(bytes.size()));
}

// A small store with colour and an albedo layer.
class StoreFiles : public testing::Test {
 protected:
  void SetUp() override {
    MemoryCloud cloud = sphere_cloud(600, 1.0);
    for (std::size_t i = 0; i < cloud.position.size(); ++i) cloud.colour.push_back({1, 2, 3});
    build(cloud, path_, 128);
    const Store store(path_);
    LayerWriter writer(store, "albedo", albedo_fields(), "{}");
    writer.finish_inner(silent_reporter());
    writer.commit();
  }
  VerifyResult verify() {
    MemoryBudget budget(1 << 26);
    return verify_store(path_, budget, silent_reporter());
  }
  ScratchFolder scratch_;
  fs::path path_ = scratch_.path() / "a.chiaro";
};

void open_everything(const fs::path& path) {
  const Store store(path);
  for (const char* name : {"input", "albedo"}) {
    const Layer layer(store, name);
    for (std::uint32_t i = 0; i < store.chunks().size(); ++i) layer.read_chunk(i);
  }
}

TEST_F(StoreFiles, AFreshStoreIsWhole) {
  const VerifyResult r = verify();
  EXPECT_THAT(r.problems, testing::IsEmpty());
  EXPECT_EQ(r.surfels, 600u);
  EXPECT_NO_THROW(open_everything(path_));
}

TEST_F(StoreFiles, EveryPrefixOfASmallFileIsAnError) {
  for (const char* name : {"index.bin", "manifest.json", "layers/albedo/layer.json", "layers/albedo/index.bin", "layers/albedo/values.bin"}) {
    const std::string whole = read_text(path_ / name);
    for (std::size_t size = 0; size < whole.size(); size += whole.size() > 3000 ? 41 : 3) {
      overwrite(path_ / name, whole.substr(0, size));
      EXPECT_THROW(open_everything(path_), Error) << name << " cut to " << size << " bytes";
    }
    overwrite(path_ / name, whole);
  }
  EXPECT_NO_THROW(open_everything(path_));
}

TEST_F(StoreFiles, EveryFlippedByteIsAnError) {
  for (const char* name : {"index.bin", "manifest.json", "layers/albedo/layer.json", "layers/albedo/index.bin", "layers/albedo/values.bin"}) {
    const std::string whole = read_text(path_ / name);
    for (std::size_t at = 0; at < whole.size(); at += whole.size() > 3000 ? 41 : 3) {
      std::string bad = whole;
      bad[at] = static_cast<char>(bad[at] ^ (1 << (at % 8)));
      overwrite(path_ / name, bad);
      EXPECT_THROW(open_everything(path_), Error) << name << " byte " << at;
    }
    overwrite(path_ / name, whole);
  }
}

TEST_F(StoreFiles, AHostileIndexWithARightChecksumIsAnError) {
  const std::vector<ChunkEntry> good = read_index(index_path(path_));
  ASSERT_GT(good.size(), 8u);
  const std::size_t leaf = good.size() - 1;
  const std::vector<std::pair<std::size_t, std::function<void(ChunkEntry&)>>> attacks = {
      {0, [](ChunkEntry& e) { e.level = 1; }},
      {0, [](ChunkEntry& e) { e.num_children = 65535; }},
      {0, [](ChunkEntry& e) { e.num_children = 0; }},
      {0, [](ChunkEntry& e) { e.first_child = 0; }},
      {0, [](ChunkEntry& e) { e.source_offset = 40; }},
      {leaf, [](ChunkEntry& e) { e.offset = ~std::uint64_t{0} - 4095; }},
      {leaf, [](ChunkEntry& e) { e.offset += 1; }},
      {leaf, [](ChunkEntry& e) { e.source_offset = ~std::uint64_t{0}; }},
      {leaf, [](ChunkEntry& e) { e.count = 0xffffffff; }},
      {leaf, [](ChunkEntry& e) { e.count = 0; }},
      {leaf, [](ChunkEntry& e) { e.level = 200; }},
      {leaf, [](ChunkEntry& e) { e.morton = ~std::uint64_t{0}; }},
      {leaf, [](ChunkEntry& e) { e.num_children = 1; }},
      {leaf, [](ChunkEntry& e) { e.part = 3; }},
      {leaf, [](ChunkEntry& e) { e.radius_max = NAN; }},
      {leaf, [](ChunkEntry& e) { e.radius_max = 0; }},
      {leaf, [](ChunkEntry& e) { e.spacing = INFINITY; }},
      {leaf, [](ChunkEntry& e) { e.tight_min[1] = 65535; e.tight_max[1] = 0; }},
  };
  for (std::size_t i = 0; i < attacks.size(); ++i) {
    auto bad = good;
    attacks[i].second(bad[attacks[i].first]);
    write_index(index_path(path_), bad);
    EXPECT_THROW(Store{path_}, Error) << "attack " << i;
  }
  write_index(index_path(path_), good);
  EXPECT_NO_THROW(Store{path_});
}

TEST_F(StoreFiles, AManifestThatCannotBeTrueIsAnError) {
  const Manifest good = read_manifest(manifest_path(path_));
  const std::vector<std::function<void(Manifest&)>> attacks = {
      [](Manifest& m) { m.points_stored += 1; },  [](Manifest& m) { m.points_read += 1; },          [](Manifest& m) { m.surfels_inner -= 1; },
      [](Manifest& m) { m.edge = -1; },           [](Manifest& m) { m.source_points[0] -= 1; },     [](Manifest& m) { m.format_version = 3; },
      [](Manifest& m) { m.origin_in_world.x() = NAN; }};
  for (std::size_t i = 0; i < attacks.size(); ++i) {
    Manifest bad = good;
    attacks[i](bad);
    write_sealed(manifest_path(path_), manifest_text(bad));
    EXPECT_THROW(Store{path_}, Error) << "attack " << i;
  }
  write_sealed(manifest_path(path_), R"({"format": "chiaro store", "format_version": "one"})");
  EXPECT_THROW(Store{path_}, Error);
}

TEST_F(StoreFiles, VerifyFindsADamagedByteInEveryFile) {
  const std::vector<ChunkEntry> entries = read_index(index_path(path_));
  const struct { const char* name; std::uint64_t at; } places[] = {
      {"geometry.bin", entries.back().offset + 40}, {"geometry.bin", entries.front().offset + 3}, {"source.bin", 77}, {"index.bin", 200},
      {"manifest.json", 60}, {"layers/albedo/values.bin", 500}, {"layers/albedo/layer.json", 20}, {"layers/input/index.bin", 50}};
  for (const auto& place : places) {
    const std::string whole = read_text(path_ / place.name);
    std::string bad = whole;
    bad[place.at] = static_cast<char>(bad[place.at] ^ 0x10);
    overwrite(path_ / place.name, bad);
    const VerifyResult r = verify();
    ASSERT_FALSE(r.problems.empty()) << place.name;
    EXPECT_THAT(r.problems[0], testing::HasSubstr(fs::path(place.name).filename().string()));
    overwrite(path_ / place.name, whole);
  }
  EXPECT_THAT(verify().problems, testing::IsEmpty());
}

TEST_F(StoreFiles, VerifyFindsWhatChecksumsCannot) {
  auto entries = read_index(index_path(path_));
  const auto good = entries;
  entries.back().tight_max[2] = 65535;
  write_index(index_path(path_), entries);
  EXPECT_THAT(verify().problems, testing::AllOf(testing::Not(testing::IsEmpty()), testing::Each(testing::HasSubstr("bounds"))));
  entries = good;  // two leaves with the same source indices
  std::vector<std::size_t> leaves;
  for (std::size_t i = 0; i < entries.size(); ++i)
    if (entries[i].is_leaf()) leaves.push_back(i);
  const std::size_t a = leaves[0];
  for (const std::size_t b : leaves) {
    if (b == a || entries[b].count > entries[a].count) continue;
    entries[b].source_offset = entries[a].source_offset;
    std::vector<std::byte> bytes(entries[b].count * kSourceBytes);
    File(source_path(path_), File::Mode::kRead).read_at(entries[b].source_offset, bytes.data(), bytes.size());
    entries[b].source_crc = crc32c(bytes);
    break;
  }
  write_index(index_path(path_), entries);
  EXPECT_FALSE(verify().problems.empty());
}

TEST_F(StoreFiles, VerifyFindsPointsOfOneSpotApart) {
  auto entries = read_index(index_path(path_));
  const auto leaf = std::find_if(entries.begin(), entries.end(), [](const ChunkEntry& e) { return e.is_leaf() && e.count >= 16; });
  ASSERT_NE(leaf, entries.end());
  File geometry(geometry_path(path_), File::Mode::kReadWrite);
  std::vector<SurfelBlock> blocks = read_blocks(geometry, *leaf);
  SurfelBlock& b = blocks[0];
  b.x[2] = b.x[0], b.y[2] = b.y[0], b.z[2] = b.z[0];
  geometry.write_at(leaf->offset, blocks.data(), geometry_bytes(leaf->count));
  leaf->geometry_crc = crc32c(blocks.data(), geometry_bytes(leaf->count));
  write_index(index_path(path_), entries);
  EXPECT_THAT(verify().problems, testing::Contains(testing::HasSubstr("slot 2: apart from others on the same spot")));
}

TEST_F(StoreFiles, ALayerOfAnotherStoreIsRefused) {
  build(sphere_cloud(600, 2.0), scratch_.path() / "b.chiaro", 128);
  fs::copy(path_ / "layers", scratch_.path() / "b.chiaro" / "layers", fs::copy_options::recursive | fs::copy_options::overwrite_existing);
  const Store b(scratch_.path() / "b.chiaro");
  EXPECT_TRUE(has_layer(b, "albedo"));
  // The same fingerprint makes the same key: give it another cloud.
  MemoryBudget budget(1 << 28);
  BuildOptions options;
  build_store_from(input_of(sphere_cloud(600, 1.0), "other"), scratch_.path() / "c.chiaro", options, budget, silent_reporter());
  fs::copy(path_ / "layers", scratch_.path() / "c.chiaro" / "layers", fs::copy_options::recursive);
  const Store c(scratch_.path() / "c.chiaro");
  EXPECT_THROW(Layer(c, "albedo"), Error);
}

TEST_F(StoreFiles, UnknownChunksAndLayersAreErrors) {
  const Store store(path_);
  EXPECT_THROW(store.read_chunk(static_cast<std::uint32_t>(store.chunks().size())), std::invalid_argument);
  EXPECT_THROW(store.read_sources(0), std::invalid_argument);
  EXPECT_THROW(Layer(store, "nothing"), Error);
  EXPECT_THROW(Layer(store, "../a.chiaro"), Error);
  EXPECT_THROW(LayerWriter(store, "a/b", albedo_fields(), "{}"), Error);
  EXPECT_THROW(Store(scratch_.path() / "none.chiaro"), Error);
  EXPECT_THAT(layer_names(store), testing::ElementsAre("albedo", "input"));
}

}  // namespace
}  // namespace chiaro::stream
