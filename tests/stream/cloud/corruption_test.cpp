// Every prefix and every single-byte change of a small valid file of each format is read or refused with an Error: no crash, no hang, no
// large memory. LAZ and E57 files are those of other programs (data/make_files.py).
#include <gtest/gtest.h>

#include "allocation_watch.h"
#include "cloud_test_support.h"
#include "e57_pages.h"

namespace chiaro::stream {
namespace {

constexpr std::size_t kMostPoints = 1000;            // the files hold three
constexpr std::size_t kLargestAllocation = 4 << 20;  // buffers are of 1 MiB, blocks of what the file holds

/// Reads the bytes as a file; the number of points, or -1 for an Error.
long read_or_refuse(const fs::path& path, const std::string& bytes) {
  {
    File file(path, File::Mode::kCreate);
    file.write_at(0, bytes.data(), bytes.size());
  }
  std::size_t count = 0;
  try {
    const auto reader = open_points(path, 1 << 20);
    PointBlock block;
    while (reader->read(block, 512)) {
      count += block.size();
      if (count > kMostPoints) break;
    }
  } catch (const Error& error) {
    EXPECT_NE(std::string(error.what()).find(path.filename().string()), std::string::npos) << error.what();
    return -1;
  }
  EXPECT_LE(count, kMostPoints);
  return static_cast<long>(count);
}

class Corruption : public ::testing::TestWithParam<const char*> {
 protected:
  static std::string valid_file(const std::string& format);

  /// Thousands of small files: in memory where the system offers that.
  static fs::path quick_disk() { return fs::exists("/dev/shm") ? fs::path("/dev/shm") : fs::path(); }

  static long read_points(const fs::path& path, const std::string& bytes) { return read_or_refuse(path, bytes); }
};

std::string with_las_extra_record(std::string las) {
  std::string vlr(54 + 192, '\0');
  vlr.replace(2, 9, "LASF_Spec");
  vlr.replace(18, 4, bytes_of(std::uint16_t{4}, std::uint16_t{192}));
  vlr.replace(54 + 2, 4, std::string("\x09\x18hi", 4));
  vlr.replace(54 + 112, 8, bytes_of(2.0));
  const std::size_t header_bytes = 375;
  las.insert(header_bytes, vlr);
  las.replace(96, 8, bytes_of(static_cast<std::uint32_t>(header_bytes + vlr.size()), std::uint32_t{1}));
  return las;
}

std::string Corruption::valid_file(const std::string& format) {
  const std::string xyz =
      "property float x\nproperty float y\nproperty double z\nproperty uchar red\nproperty uchar green\nproperty ushort blue\n";
  const std::string row = bytes_of(1.f, 2.f, 3.0) + "abc" + "d";
  if (format == "ascii.ply")
    return "ply\nformat ascii 1.0\nelement camera 1\nproperty list uchar int ids\nelement vertex 3\n" + xyz +
           "end_header\n2 5 6\n1 2 3 4 5 6\n1 nan 3 4 5 6\n-1e3 2 3 4 5 600\n";
  if (format == "little.ply" || format == "big.ply")
    return std::string("ply\nformat binary_") + format.substr(0, format.find('.')) +
           "_endian 1.0\nelement camera 1\nproperty list uchar uchar ids\nelement vertex 3\n" + xyz + "end_header\n\x02zz" + row + row +
           row + "faces?";
  if (format == "lists.ply") {
    const std::string point = bytes_of(std::uint8_t{2}, std::int32_t{5}, std::int32_t{6}, 1.f, 2.f, 3.0) + "abcd" + bytes_of(std::uint8_t{0});
    return "ply\nformat binary_little_endian 1.0\nelement vertex 3\nproperty list uchar int seen_by\n" + xyz + "property list uchar float weights\nend_header\n" + point + point + point;
  }
  if (format.ends_with(".laz") || format.ends_with(".e57")) return read_text(fs::path(CHIARO_SOURCE_DIR) / "tests/stream/cloud/data" / format);
  if (format == "scan.ptx") {
    const std::string head = "0 0 0\n1 0 0\n0 1 0\n0 0 1\n1 0 0 0\n0 1 0 0\n0 0 1 0\n5 6 7 1\n";
    return "1\n2\n" + head + "1 2 3 0.5 4 5 6\n0 0 0 0.5 0 0 0\n1\n1\n" + head + "1 2 nan 0.5 4 5 6\n";
  }
  if (format == "legacy.las") return make_las(2, 3, std::vector<std::string>(3, std::string(34, '\1')));
  if (format == "new.las") return with_las_extra_record(make_las(4, 7, std::vector<std::string>(3, std::string(36 + 4, '\1'))));
  if (format == "names.csv") return "# comment\nx,y,z,R,G,B,quality\r\n1,2,3,255,0,7,0.5\r\n4,5,6,1,2,3,1e-3\r\n-7.5,.5,nan,0,0,0,0\r\n";
  if (format == "plain.xyz") return "1 2 3 0.6 0 0.8\n4 5 6 0 1 0\n7 8 9 1 0 0";
  if (format == "scan.pts") return "2\n1 2 3 -40 1 2 3\n4 5 6 7 8 9 10\n1\n1 2 3 4 5 6 7\n";
  const std::string head =
      "VERSION 0.7\nFIELDS x y z rgb\nSIZE 4 4 4 4\nTYPE F F F U\nCOUNT 1 1 1 1\nWIDTH 3\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS "
      "3\nDATA ";
  if (format == "ascii.pcd") return head + "ascii\n1 2 3 77\nnan 5 6 99\n7 8 9 0\n";
  if (format == "binary.pcd") return head + "binary\n" + std::string(48, 'k');
  // LZF: literal runs of 32, then a copy of 8 + 9 - 1 bytes from one byte back.
  std::string packed = std::string("\x1f") + "0123456789abcdef0123456789abcdef" + std::string("\xe0\x07\x00", 3);
  return head + "binary_compressed\n" + bytes_of(static_cast<std::uint32_t>(packed.size()), std::uint32_t{48}) + packed;
}

/// LAZ and E57 files hold more than three points.
bool comes_from_another_program(const std::string& format) { return format.ends_with(".laz") || format.ends_with(".e57"); }

TEST_P(Corruption, TheFileItselfIsRead) {
  const ScratchFolder folder(quick_disk());
  const long points = read_points(folder.path() / GetParam(), valid_file(GetParam()));
  if (comes_from_another_program(GetParam())) {
    EXPECT_GT(points, 0);
  } else {
    EXPECT_EQ(points, 3);
  }
}

TEST_P(Corruption, EveryPrefixIsReadOrRefused) {
  const ScratchFolder folder(quick_disk());
  const std::string file = valid_file(GetParam());
  take_largest_allocation();
  for (std::size_t n = 0; n < file.size(); ++n) {
    SCOPED_TRACE(n);
    read_points(folder.path() / GetParam(), file.substr(0, n));
  }
  EXPECT_LE(take_largest_allocation(), kLargestAllocation);
}

TEST_P(Corruption, EveryChangedByteIsReadOrRefused) {
  const ScratchFolder folder(quick_disk());
  const std::string file = valid_file(GetParam());
  take_largest_allocation();
  for (std::size_t i = 0; i < file.size(); ++i)
    for (int k = 0; k < 3; ++k) {
      if (comes_from_another_program(GetParam()) && static_cast<int>(i % 3) != k) continue;  // a LAZ decoder takes a millisecond to set up
      SCOPED_TRACE(i);
      std::string changed = file;
      changed[i] = k == 0 ? '\0' : k == 1 ? '\xff' : static_cast<char>(file[i] ^ 0x40);
      read_points(folder.path() / GetParam(), changed);
    }
  EXPECT_LE(take_largest_allocation(), kLargestAllocation);
}

TEST_P(Corruption, LongerNumbersAreReadOrRefused) {
  const ScratchFolder folder(quick_disk());
  const std::string file = valid_file(GetParam());
  take_largest_allocation();
  if (comes_from_another_program(GetParam())) return;  // their numbers are not text
  for (std::size_t i = 0; i < file.size(); ++i)
    if (file[i] >= '0' && file[i] <= '9') {
      for (const char* digits : {"99999999", "9999999999999999999999", "-"}) {
        SCOPED_TRACE(i);
        read_points(folder.path() / GetParam(), std::string(file).insert(i, digits));
      }
    }
  EXPECT_LE(take_largest_allocation(), kLargestAllocation);
}

// Below the checksums of E57: header, XML and packets with changed bytes that no checksum gives away.
TEST(CorruptionBelowChecksums, EveryChangedByteIsReadOrRefused) {
  if (!CHIARO_HAS_RUST_FORMATS) GTEST_SKIP() << "built without cargo";
  const ScratchFolder folder(fs::exists("/dev/shm") ? fs::path("/dev/shm") : fs::path());
  const fs::path path = folder.path() / "changed.e57";
  const std::string content = logical_bytes(read_text(fs::path(CHIARO_SOURCE_DIR) / "tests/stream/cloud/data/two_scans.e57"));
  take_largest_allocation();
  for (std::size_t i = 0; i < content.size(); ++i) {
    SCOPED_TRACE(i);
    std::string changed = content;
    changed[i] = i % 3 == 0 ? '\0' : i % 3 == 1 ? '9' : static_cast<char>(content[i] ^ 0x40);
    read_or_refuse(path, physical_bytes(changed));
  }
  EXPECT_LE(take_largest_allocation(), kLargestAllocation);
}

INSTANTIATE_TEST_SUITE_P(Formats, Corruption,
                         ::testing::Values("ascii.ply", "little.ply", "big.ply", "lists.ply", "legacy.las", "new.las", "names.csv", "plain.xyz",
                                           "scan.pts", "ascii.pcd", "binary.pcd", "compressed.pcd", "scan.ptx"),
                         [](const auto& format) {
                           std::string name = format.param;
                           for (char& c : name) c = c == '.' ? '_' : c;
                           return name;
                         });

#if CHIARO_HAS_RUST_FORMATS
INSTANTIATE_TEST_SUITE_P(RustFormats, Corruption,
                         ::testing::Values("format_0.laz", "format_3.laz", "format_5.laz", "format_7.laz", "format_10.laz", "variable_chunks.laz", "one_point.e57",
                                           "two_scans.e57"),
                         [](const auto& format) {
                           std::string name = format.param;
                           for (char& c : name) c = c == '.' ? '_' : c;
                           return name;
                         });
#endif

}  // namespace
}  // namespace chiaro::stream
