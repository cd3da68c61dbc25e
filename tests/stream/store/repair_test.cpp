#include "stream/store/repair.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <cstring>
#include <fstream>
#include <map>

#include "memory_cloud.h"
#include "stream/base/error.h"
#include "stream/base/file.h"
#include "stream/base/hash.h"
#include "stream/base/parallel.h"
#include "stream/store/checksum_repair.h"
#include "stream/store/layer.h"
#include "stream/store/layer_format.h"
#include "stream/store/store_format.h"

namespace chiaro::stream {
namespace {

namespace fs = std::filesystem;
using testing::Contains;
using testing::HasSubstr;
using testing::IsEmpty;

using Files = std::map<std::string, std::string>;  // bytes by name

Files read_folder(const fs::path& folder) {
  Files files;
  for (const auto& entry : fs::recursive_directory_iterator(folder))
    if (entry.is_regular_file()) files[fs::relative(entry.path(), folder).string()] = read_text(entry.path());
  return files;
}

void overwrite(const fs::path& path, const std::string& bytes) {
  std::ofstream out(path, std::ios::binary | std::ios::trunc);
  out.write(bytes.data(), static_cast<std::streamsize>(bytes.size()));
}

std::string flipped(std::string bytes, std::size_t at, unsigned char mask = 0x10) {
  bytes.at(at) = static_cast<char>(static_cast<unsigned char>(bytes[at]) ^ mask);
  return bytes;
}

std::string zeroed(std::string bytes, std::size_t at, std::size_t size) { return bytes.replace(at, size, size, '\0'); }

// A store of three levels or more with colours and a layer of every type, whose leaves have values.
class Repair : public testing::Test {
 protected:
  void SetUp() override {
    MemoryCloud cloud = sphere_cloud(600, 1.0);
    for (const Vec3d& p : sphere_cloud(300, 0.1, 0, Vec3d(0.7, 0.6, 0.5)).position) cloud.position.push_back(p);
    for (std::size_t i = 0; i < cloud.position.size(); ++i) cloud.colour.push_back({static_cast<std::uint16_t>(i * 40), 2, static_cast<std::uint16_t>(60000 - i)});
    build(cloud, path_, 64);
    const Store store(path_);
    LayerWriter writer(store, "albedo", albedo_fields(), R"({"method": "test"})");
    for (const std::uint32_t leaf : store.leaves()) {
      const std::uint32_t n = store.chunks()[leaf].count;
      std::vector<std::byte> bytes(18 * n);
      for (std::uint32_t i = 0; i < 4 * n; ++i) {
        const auto value = static_cast<float>(i % 7) / 8;
        std::memcpy(&bytes[4 * i], &value, 4);
      }
      writer.write_chunk(leaf, bytes);
    }
    writer.finish_inner(silent_reporter());
    writer.commit();
    entries_ = store.chunks();
    whole_ = read_folder(path_);
    ASSERT_GT(entries_.back().level, 2);
  }
  RepairResult repair() {
    MemoryBudget budget(1 << 26);
    return repair_store(path_, budget, silent_reporter());
  }
  VerifyResult verify() {
    MemoryBudget budget(1 << 26);
    return verify_store(path_, budget, silent_reporter());
  }
  void restore() {
    for (const auto& [name, bytes] : whole_) overwrite(path_ / name, bytes);
  }
  // Damages one file and expects the repaired store to be the old one, byte by byte.
  void expect_repaired(const std::string& name, const std::string& damaged, const std::string& what) {
    overwrite(path_ / name, damaged);
    expect_as_before(name + ", " + what);
  }
  void expect_as_before(const std::string& what) {
    const RepairResult r = repair();
    EXPECT_THAT(r.lost, IsEmpty()) << what;
    EXPECT_EQ(r.points_lost, 0u) << what;
    EXPECT_FALSE(r.repaired.empty()) << what;
    const bool same = read_folder(path_) == whole_;
    EXPECT_TRUE(same) << what << ": other bytes than before";
    if (!same) restore();
  }
  std::size_t first_leaf() const {
    return static_cast<std::size_t>(std::find_if(entries_.begin(), entries_.end(), [](const ChunkEntry& e) { return e.is_leaf(); }) - entries_.begin());
  }
  ScratchFolder scratch_;
  fs::path path_ = scratch_.path() / "a.chiaro";
  Files whole_;
  std::vector<ChunkEntry> entries_;
};

TEST(ChecksumRepair, FindsTheOneByteThatWasChanged) {
  std::vector<std::byte> bytes(1000);
  for (std::size_t i = 0; i < bytes.size(); ++i) bytes[i] = static_cast<std::byte>(i * 7 % 256);
  const std::uint32_t crc = crc32c(bytes);
  EXPECT_THAT(one_byte_fixes(bytes, crc), IsEmpty());
  for (std::size_t at = 0; at < bytes.size(); at += 37) {
    bytes[at] ^= std::byte{0x5a};
    const auto fixes = one_byte_fixes(bytes, crc);
    ASSERT_EQ(fixes.size(), 1u) << at;
    EXPECT_EQ(fixes[0].at, at);
    EXPECT_EQ(fixes[0].flip, std::byte{0x5a});
    bytes[at] ^= std::byte{0x5a};
  }
  bytes[3] ^= std::byte{1};
  bytes[500] ^= std::byte{1};
  EXPECT_THAT(one_byte_fixes(bytes, crc), IsEmpty());
}

TEST_F(Repair, AWholeStoreIsLeftAlone) {
  const auto before = fs::last_write_time(path_ / "geometry.bin");
  const RepairResult r = repair();
  EXPECT_THAT(r.repaired, IsEmpty());
  EXPECT_THAT(r.lost, IsEmpty());
  EXPECT_EQ(fs::last_write_time(path_ / "geometry.bin"), before);
  EXPECT_TRUE(read_folder(path_) == whole_);
}

TEST_F(Repair, AnyOneByteOfTheSmallFilesComesBack) {
  for (const char* name : {"manifest.json", "index.bin", "layers/albedo/layer.json", "layers/albedo/index.bin", "layers/input/layer.json", "layers/input/index.bin"}) {
    const std::string& bytes = whole_[name];
    const std::size_t step = bytes.size() > 2000 ? 113 : 13;
    for (std::size_t at = 0; at < bytes.size(); at += step) expect_repaired(name, flipped(bytes, at, static_cast<unsigned char>(1u << (at % 8))), "byte " + std::to_string(at));
  }
  EXPECT_THAT(verify().problems, IsEmpty());
}

TEST_F(Repair, AnyByteOfInnerGeometryComesBack) {
  const std::string& bytes = whole_["geometry.bin"];
  for (const ChunkEntry& e : entries_) {
    if (e.is_leaf()) continue;
    for (const std::uint64_t at : {std::uint64_t{0}, geometry_bytes(e.count) / 2, geometry_bytes(e.count) - 1})
      expect_repaired("geometry.bin", flipped(bytes, e.offset + at), "inner chunk at " + std::to_string(e.offset) + " + " + std::to_string(at));
  }
}

TEST_F(Repair, AllInnerLevelsComeBackFromTheLeaves) {
  const std::string& bytes = whole_["geometry.bin"];
  std::uint64_t leaves_end = 0;
  for (const ChunkEntry& e : entries_)
    if (e.is_leaf()) leaves_end = std::max(leaves_end, aligned_end(e));
  ASSERT_LT(leaves_end, bytes.size());
  expect_repaired("geometry.bin", zeroed(bytes, leaves_end, bytes.size() - leaves_end), "zeros");
  expect_repaired("geometry.bin", bytes.substr(0, leaves_end), "cut");
  expect_repaired("geometry.bin", bytes + "more", "longer");
  expect_repaired("geometry.bin", flipped(bytes, leaves_end - 1), "between chunks");
}

TEST_F(Repair, InnerValuesOfLayersComeBack) {
  for (const char* layer : {"input", "albedo"}) {
    const std::string name = std::string("layers/") + layer + "/values.bin";
    const std::uint64_t record = std::string(layer) == "input" ? 6 : 18;
    std::string none_left = whole_[name];
    std::uint64_t at = 0;
    for (const ChunkEntry& e : entries_) {
      const std::uint64_t size = e.count * record;
      if (!e.is_leaf()) {
        none_left = zeroed(none_left, at, size);
        expect_repaired(name, flipped(whole_[name], at + size / 3), "values at " + std::to_string(at));
      }
      at += size;
    }
    expect_repaired(name, none_left, "all inner values");
    expect_repaired(name, whole_[name] + "x", "longer");
  }
}

TEST_F(Repair, LostRecordsOfTheIndexAreMadeFromTheLeaves) {
  const std::string& bytes = whole_["index.bin"];
  const std::size_t inner_bytes = first_leaf() * kIndexRecordBytes;
  expect_repaired("index.bin", zeroed(bytes, 32, inner_bytes), "inner records");
  expect_repaired("index.bin", zeroed(bytes, 0, 32 + inner_bytes), "header and inner records");
  expect_repaired("index.bin", zeroed(bytes, 0, 32), "header");
  expect_repaired("index.bin", bytes + std::string(200, 'x'), "longer");
  expect_repaired("source.bin", whole_["source.bin"] + "x", "longer");
  expect_repaired("layers/input/index.bin", whole_["layers/input/index.bin"] + "x", "longer");
  for (std::size_t i = 0; i < entries_.size(); ++i) {
    const std::size_t at = 32 + i * kIndexRecordBytes;
    expect_repaired("index.bin", zeroed(bytes, at + 44, 12), "bounds of " + std::to_string(i));
    if (entries_[i].is_leaf()) expect_repaired("index.bin", flipped(flipped(zeroed(bytes, at + 8, 16), at + 28), at + 34), "offsets and checksums of " + std::to_string(i));
    else expect_repaired("index.bin", zeroed(bytes, at, 64), "record " + std::to_string(i));
  }
}

TEST_F(Repair, TotalsOfTheManifestFollowFromTheIndex) {
  Manifest wrong = read_manifest(manifest_path(path_));
  wrong.points_stored = 1;
  wrong.points_read = 7;
  wrong.surfels_inner = 3;
  wrong.bounds.max.x() = 17;
  write_sealed(manifest_path(path_), manifest_text(wrong));
  EXPECT_FALSE(verify().problems.empty());
  expect_as_before("wrong totals with a right checksum");
  // Damaged beyond one byte: proven by the checksum of the original.
  std::string text = whole_["manifest.json"];
  text.replace(text.find("\"points_stored\": 900") + 17, 3, "123");
  text.replace(text.find("\"points_read\": 900") + 15, 3, "456");
  expect_repaired("manifest.json", text, "two totals");
}

TEST_F(Repair, SeveralFilesAtOnceComeBack) {
  const std::uint64_t inner = entries_[0].offset;
  overwrite(path_ / "manifest.json", flipped(whole_["manifest.json"], 70));
  overwrite(path_ / "index.bin", flipped(whole_["index.bin"], 32 + 64 * 5 + 47));
  overwrite(path_ / "geometry.bin", flipped(whole_["geometry.bin"], inner + 9));
  overwrite(path_ / "layers/albedo/index.bin", flipped(whole_["layers/albedo/index.bin"], 60));
  overwrite(path_ / "layers/albedo/values.bin", flipped(whole_["layers/albedo/values.bin"], 1));
  expect_as_before("five files");
  // The same inner node in the index and in the geometry.
  overwrite(path_ / "geometry.bin", flipped(whole_["geometry.bin"], inner + 9));
  expect_repaired("index.bin", flipped(whole_["index.bin"], 32 + 29), "root in both, one byte");
  overwrite(path_ / "geometry.bin", flipped(whole_["geometry.bin"], entries_[1].offset));
  expect_repaired("index.bin", zeroed(whole_["index.bin"], 32 + 64, 60), "inner node in both, most bytes");
}

TEST_F(Repair, DamagedLeavesAreNamedAndNeverBlessed) {
  const std::size_t leaf = entries_.size() - 1;
  ASSERT_TRUE(entries_[leaf].is_leaf());
  const std::string geometry = flipped(whole_["geometry.bin"], entries_[leaf].offset + 5), source = flipped(whole_["source.bin"], entries_[leaf].source_offset);
  overwrite(path_ / "geometry.bin", geometry);
  RepairResult r = repair();
  EXPECT_THAT(r.repaired, IsEmpty());
  EXPECT_EQ(r.points_lost, entries_[leaf].count);
  EXPECT_THAT(r.lost, testing::ElementsAre(testing::AllOf(HasSubstr("geometry.bin: chunk " + std::to_string(leaf)), HasSubstr(std::to_string(entries_[leaf].count) + " points are lost"))));
  EXPECT_THAT(r.advice, Contains(HasSubstr("ingest again from memory")));
  EXPECT_EQ(read_text(path_ / "geometry.bin"), geometry);
  EXPECT_EQ(read_text(path_ / "index.bin"), whole_["index.bin"]);
  EXPECT_FALSE(verify().problems.empty());
  // The same leaf in both files: its points are counted once.
  overwrite(path_ / "source.bin", source);
  EXPECT_EQ(repair().points_lost, entries_[leaf].count);
  restore();
  const std::string values = flipped(whole_["layers/albedo/values.bin"], whole_["layers/albedo/values.bin"].size() - 1);
  overwrite(path_ / "layers/albedo/values.bin", values);
  r = repair();
  EXPECT_THAT(r.lost, testing::ElementsAre(HasSubstr("values.bin: chunk " + std::to_string(leaf))));
  EXPECT_THAT(r.advice, Contains(HasSubstr("make layer albedo again")));
  EXPECT_EQ(read_text(path_ / "layers/albedo/values.bin"), values);
}

TEST_F(Repair, WhatStandsAboveADamagedLeafIsRebuiltWhereItCan) {
  // Root and a leaf under another node: the root comes back, the leaf does not.
  const std::size_t leaf = entries_.size() - 1;
  std::string bytes = flipped(whole_["geometry.bin"], entries_[leaf].offset + 5);
  const std::string with_root = bytes;
  bytes = flipped(bytes, entries_[0].offset + 5);
  overwrite(path_ / "geometry.bin", bytes);
  const RepairResult r = repair();
  EXPECT_THAT(r.repaired, testing::ElementsAre(HasSubstr("1 inner chunk made anew")));
  EXPECT_EQ(r.points_lost, entries_[leaf].count);
  EXPECT_EQ(read_text(path_ / "geometry.bin"), with_root);
  // Its own parent does not.
  overwrite(path_ / "geometry.bin", flipped(with_root, entries_[entries_[leaf].parent].offset));
  EXPECT_THAT(repair().lost, Contains(HasSubstr(concat("inner chunk ", entries_[leaf].parent, ": its child ", leaf, " is damaged"))));
}

TEST_F(Repair, WhatCannotBeToldIsNamed) {
  const auto lost = [&](const std::string& name, const std::string& bytes) {
    overwrite(path_ / name, bytes);
    const Files before = read_folder(path_);
    const RepairResult r = repair();
    EXPECT_FALSE(r.lost.empty()) << name;
    EXPECT_FALSE(r.advice.empty()) << name;
    EXPECT_TRUE(read_folder(path_) == before) << name;
    restore();
  };
  lost("manifest.json", zeroed(whole_["manifest.json"], 0, 300));
  lost("manifest.json", "");
  std::string other_key = whole_["manifest.json"];   // still a manifest, but of no store that anybody made
  const std::size_t key = other_key.find("\"key\": \"") + 8;
  for (const std::size_t at : {key, key + 5}) other_key[at] = other_key[at] == '0' ? '1' : '0';
  lost("manifest.json", other_key);
  lost("index.bin", "");
  lost("index.bin", whole_["index.bin"].substr(0, whole_["index.bin"].size() - 64));
  lost("index.bin", zeroed(whole_["index.bin"], whole_["index.bin"].size() - 64, 64));
  lost("index.bin", zeroed(zeroed(whole_["index.bin"], 0, 32), 32 + (entries_.size() - 1) * kIndexRecordBytes + 8, 8));   // no checksum, and a leaf without its place
  lost("source.bin", "");
  lost("layers/albedo/layer.json", zeroed(whole_["layers/albedo/layer.json"], 10, 50));
  lost("layers/albedo/index.bin", zeroed(whole_["layers/albedo/index.bin"], 0, 300));
  for (const char* name : {"manifest.json", "index.bin", "geometry.bin", "source.bin", "layers/albedo/values.bin", "layers/input/layer.json"}) {
    fs::remove(path_ / name);
    EXPECT_FALSE(repair().lost.empty()) << name;
    EXPECT_FALSE(verify().problems.empty()) << name;
    restore();
  }
  EXPECT_THROW(MemoryBudget budget(1 << 26); repair_store(scratch_.path() / "none.chiaro", budget, silent_reporter()), Error);
}

TEST_F(Repair, WhatIsMadeAnewHasToBeWhatItsChecksumSays) {
  // An index that is whole and speaks of another root: what the children make is not taken for it.
  std::vector<ChunkEntry> other = entries_;
  other[0].geometry_crc ^= 1;
  write_index(index_path(path_), other);
  const RepairResult r = repair();
  EXPECT_THAT(r.lost, Contains(HasSubstr("another version made them")));
  EXPECT_THAT(r.repaired, IsEmpty());
  EXPECT_EQ(read_text(path_ / "geometry.bin"), whole_["geometry.bin"]);
  restore();
  // The same in a layer.
  const fs::path index = path_ / "layers/albedo/index.bin";
  const std::string bytes = read_text(index);
  std::vector<std::uint32_t> crc(entries_.size());
  LayerHeader header{};
  std::memcpy(&header, bytes.data(), sizeof header);
  std::memcpy(crc.data(), bytes.data() + sizeof header, 4 * crc.size());
  crc[0] ^= 1;
  header = layer_header(header.record_bytes, header.values_bytes, crc);
  overwrite(index, std::string(reinterpret_cast<const char*>(&header), sizeof header) + std::string(reinterpret_cast<const char*>(crc.data()), 4 * crc.size()));
  const RepairResult of_layer = repair();
  EXPECT_THAT(of_layer.lost, Contains(HasSubstr("another version made them")));
  EXPECT_THAT(of_layer.repaired, IsEmpty());
  EXPECT_EQ(read_text(path_ / "layers/albedo/values.bin"), whole_["layers/albedo/values.bin"]);
}

TEST_F(Repair, BoundsThatTheGeometryContradictsFollowIt) {
  std::vector<ChunkEntry> wide = entries_;
  for (ChunkEntry& e : wide) e.tight_max = {65535, 65535, 65535};
  write_index(index_path(path_), wide);
  expect_as_before("bounds of a whole index");
}

TEST_F(Repair, ALayerOfAnotherStoreAndWhatAPublicationLeftAreNotTouched) {
  LayerInfo info = parse_layer_json("layer.json", whole_["layers/albedo/layer.json"]);
  info.store_key = std::string(32, '7');
  overwrite(path_ / "layers/albedo/layer.json", sealed_text(layer_json_text(info)));
  EXPECT_THAT(repair().lost, Contains(HasSubstr("belongs to another store")));
  restore();
  for (const char* left : {"albedo.part", "albedo.old"}) fs::create_directories(path_ / "layers" / left);
  EXPECT_THAT(repair().lost, IsEmpty());
}

TEST_F(Repair, DamageOfTwoBytesIsNotTakenForThatOfAThird) {
  // Bounds of two leaves damaged so that the checksum would fit after the change of a byte elsewhere: rare by chance, looked for here.
  const std::string& bytes = whole_["index.bin"];
  const std::string records = bytes.substr(32);
  const std::uint32_t crc = crc32c(records.data(), records.size());
  const auto random = [](std::uint64_t round, std::uint32_t draw, std::size_t below) { return std::min(below - 1, static_cast<std::size_t>(uniform(round, draw, 5) * static_cast<double>(below))); };
  int found = 0;
  for (std::uint64_t round = 0; found < 8 && round < 1000000; ++round) {
    std::string damaged = records;
    for (const std::uint32_t k : {0u, 3u}) {
      const std::size_t leaf = first_leaf() + random(round, k, entries_.size() - first_leaf());
      if (!entries_[leaf].is_leaf()) continue;
      damaged = flipped(damaged, leaf * kIndexRecordBytes + 44 + random(round, k + 1, 12), static_cast<unsigned char>(1 + random(round, k + 2, 255)));
    }
    const auto fixes = one_byte_fixes(std::as_bytes(std::span(damaged)), crc);
    if (fixes.size() != 1 || flipped(damaged, fixes[0].at, std::to_integer<unsigned char>(fixes[0].flip)) == records) continue;
    ++found;
    overwrite(path_ / "index.bin", bytes.substr(0, 32) + damaged);
    const RepairResult r = repair();
    EXPECT_THAT(r.repaired, testing::ElementsAre(HasSubstr("made anew from the leaves"))) << round;
    const bool same = read_folder(path_) == whole_;
    EXPECT_TRUE(same) << round;
    if (!same) restore();
  }
  EXPECT_EQ(found, 8);
}

TEST_F(Repair, LeavesThatAreCutOffStayLostAndTheOthersReadable) {
  const std::uint64_t cut = entries_[entries_.size() / 2].offset;
  overwrite(path_ / "geometry.bin", whole_["geometry.bin"].substr(0, cut));
  EXPECT_THROW(Store{path_}, Error);
  const RepairResult r = repair();
  std::uint64_t behind = 0;
  for (const ChunkEntry& e : entries_) behind += e.is_leaf() && e.offset + geometry_bytes(e.count) > cut ? e.count : 0;
  ASSERT_GT(behind, 0u);
  EXPECT_EQ(r.points_lost, behind);
  EXPECT_EQ(verify().chunks, entries_.size());
  const Store store(path_);
  for (std::uint32_t i = 0; i < entries_.size(); ++i) {
    if (!entries_[i].is_leaf()) continue;
    if (entries_[i].offset + geometry_bytes(entries_[i].count) > cut) EXPECT_THROW(store.read_chunk(i), Error);
    else EXPECT_NO_THROW(store.read_chunk(i));
  }
}

TEST_F(Repair, AnIndexThatLaysChunksOverEachOtherIsNotFollowed) {
  std::vector<ChunkEntry> bad = entries_;
  for (ChunkEntry& e : bad)
    if (!e.is_leaf()) e.offset = entries_[first_leaf()].offset;
  write_index(index_path(path_), bad);
  EXPECT_THAT(repair().lost, Contains(HasSubstr("over each other")));
  EXPECT_EQ(read_text(path_ / "geometry.bin"), whole_["geometry.bin"]);
}

TEST_F(Repair, ALeafSpacingThatTwoBytesWereTakenFromIsNotGuessed) {
  const std::size_t at = 32 + (entries_.size() - 1) * kIndexRecordBytes + 60;
  overwrite(path_ / "index.bin", flipped(flipped(whole_["index.bin"], at), at + 1));
  const RepairResult r = repair();
  EXPECT_THAT(r.lost, Contains(HasSubstr("nothing else tells")));
  EXPECT_THAT(r.repaired, IsEmpty());
}

TEST_F(Repair, RandomDamageNeverCrashesAndNeverMakesItWorse) {
  for (std::uint64_t round = 0; round < 60; ++round) {
    std::uint32_t draw = 0;
    const auto random = [&](std::size_t below) { return std::min(below - 1, static_cast<std::size_t>(uniform(round, draw++, 99) * static_cast<double>(below))); };
    for (std::size_t k = 0; k <= random(3); ++k) {
      auto it = whole_.begin();
      std::advance(it, static_cast<std::ptrdiff_t>(random(whole_.size())));
      std::string bytes = read_text(path_ / it->first);
      if (bytes.empty()) continue;
      const std::size_t at = random(bytes.size()), size = std::min(bytes.size() - at, std::size_t{1} << random(8));
      if (random(8) == 0) bytes.resize(at);
      else
        for (std::size_t i = 0; i < size; ++i) bytes[at + i] = static_cast<char>(random(256));
      overwrite(path_ / it->first, bytes);
    }
    const RepairResult r = repair();
    const Files now = read_folder(path_);
    EXPECT_EQ(r.lost.empty(), now == whole_) << "round " << round;
    EXPECT_EQ(verify().problems.empty(), now == whole_) << "round " << round;
    // A second repair finds nothing more to do.
    EXPECT_THAT(repair().repaired, IsEmpty()) << "round " << round;
    restore();
  }
}

TEST_F(Repair, TooLittleMemoryIsNoLoss) {
  overwrite(path_ / "index.bin", flipped(whole_["index.bin"], 40));
  MemoryBudget budget(100);
  try {
    repair_store(path_, budget, silent_reporter());
    FAIL();
  } catch (const Error& e) {
    EXPECT_THAT(e.what(), HasSubstr("memory budget"));
  }
  EXPECT_EQ(budget.used_bytes(), 0u);
  expect_as_before("with enough");
}

TEST_F(Repair, GivesTheSameBytesForAnyNumberOfThreads) {
  const std::string bytes = zeroed(whole_["geometry.bin"], entries_[0].offset, 100);
  for (const int threads : {1, 8}) {
    const ThreadLimit limit(threads);
    expect_repaired("geometry.bin", bytes, std::to_string(threads) + " threads");
  }
}

TEST(RepairOfOneLeaf, AStoreWithoutInnerNodesIsRepairedToo) {
  const ScratchFolder scratch;
  const fs::path path = scratch.path() / "a.chiaro";
  build(sphere_cloud(50, 1.0), path);
  const Files whole = read_folder(path);
  MemoryBudget budget(1 << 26);
  for (std::size_t at = 0; at < whole.at("index.bin").size(); at += 3) {
    overwrite(path / "index.bin", flipped(whole.at("index.bin"), at));
    repair_store(path, budget, silent_reporter());
    ASSERT_TRUE(read_folder(path) == whole) << at;
  }
  overwrite(path / "geometry.bin", whole.at("geometry.bin").substr(0, geometry_bytes(50)));
  repair_store(path, budget, silent_reporter());
  EXPECT_TRUE(read_folder(path) == whole);
}

}  // namespace
}  // namespace chiaro::stream
