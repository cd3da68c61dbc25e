#include "stream/photo/raster.h"

#include <bit>
#include <cmath>
#include <cstring>
#include <limits>
#include <numeric>

#include <gmock/gmock.h>

#include "stream/base/error.h"
#include "stream/base/hash.h"
#include "stream/base/parallel.h"
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

// But for the reserved words of planes.
TEST(Raster, EveryFlippedByteIsFound) {
  ScratchFolder scratch;
  write_small(scratch.path() / "a", 70);
  const std::string bytes = file_bytes(scratch.path() / "a");
  std::vector<std::size_t> missed;
  for (std::size_t i = 40 + 2 * 40; i < bytes.size(); ++i) {
    std::string damaged = bytes;
    damaged[i] = static_cast<char>(damaged[i] ^ 0x10);
    put_bytes(scratch.path() / "b", damaged);
    if (error_of([&] { RasterReader(scratch.path() / "b").verify(); }).empty()) missed.push_back(i);
  }
  EXPECT_EQ(missed, std::vector<std::size_t>{});
}

std::vector<float> smooth_rows(int width, int height) {
  std::vector<float> values;
  for (int y = 0; y < height; ++y)
    for (int x = 0; x < width; ++x) values.push_back(1.5f + 1e-3f * static_cast<float>(x) + 2e-3f * static_cast<float>(y));
  return values;
}

// Wide rows make blocks of a few of them; reads begin and end in the middle of some.
TEST(Raster, AnyRowsAcrossBlocks) {
  ScratchFolder scratch;
  const int width = 40'000, height = 11;
  ASSERT_EQ(raster_block_rows(width, height), 3);
  const std::vector<float> values = smooth_rows(width, height);
  RasterWriter writer(scratch.path() / "a", width, height, {{"v", PlaneType::kF32}});
  writer.write_rows("v", 0, std::span<const float>(values));
  EXPECT_EQ(writer.read_back<float>("v", 4, 2)[0], values[4 * 40'000]);
  writer.commit();
  const RasterReader reader(scratch.path() / "a");
  for (int y0 = 0; y0 < height; ++y0)
    for (int rows = 0; y0 + rows <= height; ++rows) {
      const auto from = values.begin() + static_cast<std::ptrdiff_t>(y0) * width;
      ASSERT_EQ(reader.rows<float>("v", y0, rows), std::vector<float>(from, from + static_cast<std::ptrdiff_t>(rows) * width)) << y0 << " " << rows;
    }
  EXPECT_LT(std::filesystem::file_size(scratch.path() / "a"), values.size() * sizeof(float) * 2 / 3);
}

TEST(Raster, KeepsAsManyBitsAsItsPlanesSay) {
  ScratchFolder scratch;
  constexpr float kInfinite = std::numeric_limits<float>::infinity();
  std::vector<float> values{0, -0.0f, 1, -0.3333333f, 1.9999999f, 1e-30f, 123456.789f, kInfinite, -kInfinite, std::bit_cast<float>(0x7fffffffu), std::bit_cast<float>(0xff800001u)};
  const auto width = static_cast<int>(values.size());
  RasterWriter writer(scratch.path() / "a", width, 1, {{"all", PlaneType::kF32}, {"fine", PlaneType::kF32, Precision::kFine}, {"coarse", PlaneType::kF32, Precision::kCoarse}});
  for (const char* plane : {"all", "fine", "coarse"}) writer.write_rows(plane, 0, std::span<const float>(values));
  writer.commit();
  const RasterReader reader(scratch.path() / "a");
  const auto all = reader.all<float>("all"), fine = reader.all<float>("fine"), coarse = reader.all<float>("coarse");
  EXPECT_EQ(std::memcmp(all.data(), values.data(), values.size() * sizeof(float)), 0);
  for (std::size_t i = 0; i < values.size(); ++i) {
    EXPECT_EQ(std::bit_cast<std::uint32_t>(fine[i]) & 0xffu, i < 9 ? 0u : std::bit_cast<std::uint32_t>(values[i]) & 0xffu) << i;
    EXPECT_EQ(std::signbit(coarse[i]), std::signbit(values[i])) << i;
    if (std::isnan(values[i])) {
      EXPECT_TRUE(std::isnan(fine[i]) && std::isnan(coarse[i])) << i;
    } else if (std::isinf(values[i])) {
      EXPECT_EQ(fine[i], values[i]);
      EXPECT_EQ(coarse[i], values[i]);
    } else {
      EXPECT_LE(std::abs(fine[i] - values[i]), std::ldexp(std::abs(values[i]), -16)) << i;
      EXPECT_LE(std::abs(coarse[i] - values[i]), std::ldexp(std::abs(values[i]), -8)) << i;
    }
  }
  EXPECT_EQ(coarse[4], 2.0f);   // carried over into the exponent
}

TEST(Raster, SameBytesForAnyThreads) {
  ScratchFolder scratch;
  const auto write = [&](int threads) {
    const ThreadLimit limit(threads);
    const std::vector<float> values = smooth_rows(3000, 200);
    RasterWriter writer(scratch.path() / "a", 3000, 200, {{"v", PlaneType::kF32}, {"w", PlaneType::kF32}});
    for (const char* plane : {"w", "v"}) writer.write_rows(plane, 0, std::span<const float>(values));
    writer.commit();
    return file_bytes(scratch.path() / "a");
  };
  EXPECT_EQ(write(1), write(4));
}

// No disk left behind by a process that is killed before commit().
TEST(Raster, RowsHaveNoNameBeforeCommit) {
  ScratchFolder scratch;
  const RasterWriter writer(scratch.path() / "a", 5, 5, {{"depth", PlaneType::kF32}});
  std::vector<std::filesystem::path> names;
  for (const auto& entry : std::filesystem::directory_iterator(scratch.path())) names.push_back(entry.path().filename());
  EXPECT_EQ(names, std::vector<std::filesystem::path>{"a.part"});
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

// A few bytes that claim to be a large picture take no memory.
TEST(Raster, BlocksMustBeLargeEnoughForTheirRows) {
  ScratchFolder scratch;
  write_small(scratch.path() / "a", 10);
  std::string bytes = file_bytes(scratch.path() / "a");
  const std::int32_t width = 1 << 27;
  std::memcpy(bytes.data() + 12, &width, sizeof width);
  put_bytes(scratch.path() / "b", bytes);
  EXPECT_NE(error_of([&] { RasterReader reader(scratch.path() / "b"); }).find("cannot be its"), std::string::npos);
}

// Compressed bytes that are not what they were, with checksums made to fit.
TEST(Raster, UnpacksNoMoreThanItsRows) {
  ScratchFolder scratch;
  write_small(scratch.path() / "a", 60);
  const std::string bytes = file_bytes(scratch.path() / "a");
  std::uint64_t index = 0;
  std::memcpy(&index, &bytes[32], sizeof index);
  for (std::size_t at = 40 + 2 * 40; at < index; ++at)
    for (const int flipped : {1, 0x10, 0x80, 0xff}) {
      std::string damaged = bytes;
      damaged[at] = static_cast<char>(damaged[at] ^ flipped);
      for (std::size_t entry = index; entry < bytes.size(); entry += 16) {
        std::uint64_t place = 0;
        std::uint32_t size = 0;
        std::memcpy(&place, &bytes[entry], sizeof place);
        std::memcpy(&size, &bytes[entry + 8], sizeof size);
        const std::uint32_t crc = crc32c(&damaged[place], size);
        std::memcpy(&damaged[entry + 12], &crc, sizeof crc);
      }
      const std::uint32_t crc = crc32c(&damaged[index], bytes.size() - index);
      std::memcpy(&damaged[28], &crc, sizeof crc);
      put_bytes(scratch.path() / "b", damaged);
      try {
        const RasterReader reader(scratch.path() / "b");
        EXPECT_EQ(reader.all<float>("depth").size(), 300u);
        EXPECT_EQ(reader.all<std::uint8_t>("mask").size(), 300u);
      } catch (const Error& e) {
        EXPECT_THAT(std::string(e.what()), testing::HasSubstr("cannot be unpacked"));
      }
    }
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
