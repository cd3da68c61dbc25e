#include "stream/photo/raster.h"

#include <numeric>

#include "tests/stream/photo/photo_support.h"

namespace chiaro::stream {
namespace {

void write_small(const std::filesystem::path& path, int height = 130) {
  RasterWriter writer(path, 5, height, {{"depth", PlaneType::kF32}, {"mask", PlaneType::kU8}});
  std::vector<float> depth(static_cast<std::size_t>(5 * height));
  std::iota(depth.begin(), depth.end(), 0.5f);
  const std::vector<std::uint8_t> mask(static_cast<std::size_t>(5 * height), 3);
  writer.write_rows("mask", 0, std::span<const std::uint8_t>(mask));
  writer.write_rows("depth", 4, std::span<const float>(depth).subspan(20));  // any order
  writer.write_rows("depth", 0, std::span<const float>(depth).first(20));
  writer.commit();
}

TEST(Raster, RowsComeBackAsWritten) {
  ScratchFolder scratch;
  write_small(scratch.path() / "a");
  const RasterReader reader(scratch.path() / "a");
  EXPECT_EQ(reader.width(), 5);
  EXPECT_EQ(reader.height(), 130);
  EXPECT_TRUE(reader.has("mask"));
  EXPECT_FALSE(reader.has("normal"));
  EXPECT_EQ(reader.rows<float>("depth", 99, 2)[4], 499.5f);
  EXPECT_EQ(reader.all<std::uint8_t>("mask").back(), 3);
  reader.verify();
  std::vector<std::byte> bytes(20);
  EXPECT_THROW(reader.read_rows("depth", 130, 1, bytes), std::invalid_argument);
  EXPECT_NE(error_of([&] { reader.all<float>("normal"); }).find("has no plane \"normal\""), std::string::npos);
}

TEST(Raster, NothingIsLeftWithoutCommit) {
  ScratchFolder scratch;
  { RasterWriter writer(scratch.path() / "a", 5, 5, {{"depth", PlaneType::kF32}}); }
  EXPECT_TRUE(std::filesystem::is_empty(scratch.path()));
}

TEST(Raster, VerifyFindsEveryFlippedPixelByte) {
  ScratchFolder scratch;
  write_small(scratch.path() / "a", 70);
  const std::string bytes = file_bytes(scratch.path() / "a");
  int missed = 0;
  for (std::size_t i = 128; i < bytes.size(); ++i) {
    std::string damaged = bytes;
    damaged[i] = static_cast<char>(damaged[i] ^ 0x10);
    put_bytes(scratch.path() / "b", damaged);
    missed += error_of([&] { RasterReader(scratch.path() / "b").verify(); }).empty();
  }
  EXPECT_LE(missed, 63 * 2);  // only padding between planes may change unseen
}

// The header has no checksum.
TEST(Raster, PlanesMustBeWhatIsAskedFor) {
  ScratchFolder scratch;
  write_small(scratch.path() / "a", 10);
  EXPECT_NE(error_of([&] { RasterReader(scratch.path() / "a").rows<float>("mask", 0, 1); }).find("plane \"mask\" has 5 bytes a row, expected 20"), std::string::npos);
  std::string bytes = file_bytes(scratch.path() / "a");
  bytes.replace(bytes.find("mask"), 5, std::string("depth"));
  put_bytes(scratch.path() / "b", bytes);
  EXPECT_NE(error_of([&] { RasterReader reader(scratch.path() / "b"); }).find("both called \"depth\""), std::string::npos);
}

TEST(Raster, SurvivesDamage) {
  ScratchFolder scratch;
  write_small(scratch.path() / "a", 10);
  const std::string bytes = file_bytes(scratch.path() / "a");
  for (std::size_t n = 0; n < bytes.size(); n += 7) {
    put_bytes(scratch.path() / "b", bytes.substr(0, n));
    EXPECT_NE(error_of([&] { RasterReader reader(scratch.path() / "b"); }), "") << n;
  }
  survive_damage(scratch.path() / "b", bytes, 300, [&] {
    const RasterReader reader(scratch.path() / "b");
    for (const PlaneInfo& plane : reader.planes()) {
      std::vector<std::byte> row(static_cast<std::size_t>(reader.width()) * plane_type_bytes(plane.type));
      reader.read_rows(plane.name, 0, 1, row);
    }
    reader.verify();
  });
}

}  // namespace
}  // namespace chiaro::stream
