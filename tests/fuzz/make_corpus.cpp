/// Writes the small files of tests/fuzz/corpus: fuzz_make_corpus FOLDER. Run by hand where a format is added; the files are kept with the code.
#include <cstddef>
#include <cstdio>
#include <cstdlib>

#include <jpeglib.h>
#include <tiffio.h>

#include <cmath>
#include <filesystem>

#include "stream/base/file.h"
#include "stream/cloud/point_stream.h"
#include "stream/photo/image_io.h"
#include "stream/photo/raster.h"
#include "stream/store/octree_build.h"
#include "tests/fuzz/targets.h"

namespace {

namespace fs = std::filesystem;
using namespace chiaro;
using namespace chiaro::stream;

template <class... T>
std::string bytes_of(const T&... values) {
  std::string bytes;
  (bytes.append(reinterpret_cast<const char*>(&values), sizeof values), ...);
  return bytes;
}

void put(const fs::path& path, const std::string& bytes) {
  make_folder(path.parent_path());
  write_text(path, bytes);
}

void make_texts(const fs::path& to) {
  const std::string header = "ply\nformat ascii 1.0\ncomment by hand\nelement camera 1\nproperty list uchar int ids\nelement vertex 3\nproperty float x\nproperty float y\n"
                             "property double z\nproperty float nx\nproperty float ny\nproperty float nz\nproperty uchar red\nproperty uchar green\nproperty uchar blue\nend_header\n";
  put(to / "ply/ascii.ply", header + "2 5 6\n1 2 3 0 0 1 4 5 6\n1 nan 3 0 1 0 4 5 6\n-1e3 2 3 0 0 0 255 0 9\n");
  const std::string row = bytes_of(1.f, 2.f, 3.0, 0.f, 0.f, 1.f) + "abc";
  for (const char* kind : {"little", "big"}) {
    std::string binary = header;
    binary.replace(binary.find("ascii"), 5, std::string("binary_") + kind + "_endian");
    put(to / "ply" / (std::string(kind) + ".ply"), binary + '\1' + std::string(4, '\2') + row + row + row);
  }
  put(to / "xyz/plain.xyz", "1 2 3 0.6 0 0.8\n4 5 6 0 1 0\n7 8 9 1 0 0");
  put(to / "xyz/mixed.xyz", "# x y z\r\n1 2 3\n\n  4\t5e-3 -6.25\r\n7 8 inf\r\n");
  put(to / "csv/names.csv", "# comment\nx,y,z,R,G,B,quality\r\n1,2,3,255,0,7,0.5\r\n4,5,6,1,2,3,1e-3\r\n-7.5,.5,nan,0,0,0,0\r\n");
  put(to / "csv/semicolon.csv", "x;y;z;intensity\n1.5;2;3;4\n2;3;4;5\n");
  put(to / "pts/two_scans.pts", "2\n1 2 3 -40 1 2 3\n4 5 6 7 8 9 10\n1\n1 2 3 4 5 6 7\n");
  const std::string pose = "0 0 0\n1 0 0\n0 1 0\n0 0 1\n1 0 0 0\n0 1 0 0\n0 0 1 0\n5 6 7 1\n";
  put(to / "ptx/two_scans.ptx", "1\n2\n" + pose + "1 2 3 0.5 4 5 6\n0 0 0 0.5 0 0 0\n1\n1\n" + pose + "1 2 -3 0.5 4 5 6\n");
  const std::string pcd = "# .PCD v0.7\nVERSION 0.7\nFIELDS x y z rgb\nSIZE 4 4 4 4\nTYPE F F F U\nCOUNT 1 1 1 1\nWIDTH 2\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS 2\nDATA ";
  put(to / "pcd/ascii.pcd", pcd + "ascii\n1 2 3 4278190335\n4 nan 6 255\n");
  put(to / "pcd/binary.pcd", pcd + "binary\n" + bytes_of(1.f, 2.f, 3.f, 0xffu) + bytes_of(4.f, 5.f, 6.f, 0xff00u));
  put(to / "colmap_text/two.pack", fuzz::pack({"# comment\n1 PINHOLE 640 480 600 610 322.5 238.25\n\n7 SIMPLE_RADIAL 100 200 90 50 100 -0.1\r\n",
                                               "# comment\n\n1 0.5 0.5 -0.5 0.5 1 2 3 1 dir/photo one.exr\n1.5 2.5 -1 3 4 17\n2 1 0 0 0 -1 0 +2.5 7 photo_02.exr\n\n"}));
  const std::string camera = bytes_of(std::uint64_t{1}, std::int32_t{1}, std::int32_t{1}, std::uint64_t{640}, std::uint64_t{480}, 600.0, 610.0, 322.5, 238.25);
  const std::string image = bytes_of(std::uint64_t{1}, std::int32_t{1}, 1.0, 0.0, 0.0, 0.0, 1.0, 2.0, 3.0, std::int32_t{1}) + std::string("a.exr\0", 6) +
                            bytes_of(std::uint64_t{1}, 1.5, 2.5, std::int64_t{-1});
  put(to / "colmap_binary/one.pack", fuzz::pack({camera, image}));
  put(to / "metashape/one.xml",
      "<?xml version=\"1.0\"?>\n<document version=\"2.0.0\">\n<chunk enabled=\"true\">\n<sensors>\n<sensor id=\"0\" label=\"lens\" type=\"frame\"><resolution width=\"640\" height=\"480\"/>\n"
      "<calibration type=\"frame\" class=\"adjusted\"><resolution width=\"640\" height=\"480\"/><f>500</f><cx>3</cx><cy>-4</cy><k1>0.1</k1><p1>0.001</p1><b1>2</b1></calibration></sensor>\n"
      "</sensors>\n<components><component id=\"5\"><transform><translation>0 0 100</translation></transform></component></components>\n<cameras>\n"
      "<camera id=\"0\" sensor_id=\"0\" component_id=\"5\" label=\"a\"><transform>1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1</transform></camera>\n"
      "<group id=\"0\"><camera id=\"1\" sensor_id=\"0\" label=\"b\"/></group></cameras>\n</chunk>\n</document>\n");
  put(to / "project/whole.toml",
      "[project]\nname = \"tower\"\nunit = \"cm\"\n\n[cloud]\nfiles = [\"project.toml\"]\nnormals = \"auto\"\noutliers = \"statistical\"\n\n[[acquisition]]\nname = \"day1\"\nphotographs = [\"*.toml\"]\n"
      "encoding = \"linear\"\nmasks = \"masks/{stem}.png\"\ncameras = \"project.toml\"\nnoise = { gain = 0.0001, read_sigma = 0.0004 }\n\n[acquisition.flash]\noffset_in_camera = [0.13, -0.16, 0.03]\n"
      "intensity_range = [23.82, 30.94]\n\n[acquisition.ambient]\nmodel = \"sh1\"\n\n[[acquisition.reference]]\nphotograph = \"project\"\npolygon = [[1, 2], [3, 4], [5, 0]]\nalbedo = [0.5, 0.5, 0.5]\n\n"
      "[solve]\nmethod = \"joint\"\n\n[run]\nmemory = \"512 MiB\"\nthreads = 2\nseed = 3\n\n[[export]]\nfile = \"albedo.ply\"\nfill = true\n");
}

void make_las(const fs::path& to) {
  make_folder(to / "las");
  PointWriterOptions options;
  options.num_points = 2;
  options.properties = {{"x", ScalarType::kF64}, {"y", ScalarType::kF64}, {"z", ScalarType::kF64}, {"red", ScalarType::kU16}, {"green", ScalarType::kU16}, {"blue", ScalarType::kU16}, {"sigma", ScalarType::kF32}};
  options.bounds.min = Vec3d::Zero();
  options.bounds.max = Vec3d::Ones();
  const auto writer = create_points(to / "las/extra.las", options);
  const std::string row = bytes_of(0.25, 0.5, 1.0, std::uint16_t{1}, std::uint16_t{2}, std::uint16_t{3}, 0.5f);
  writer->write(reinterpret_cast<const std::byte*>((row + row).data()), 2);
  writer->commit();
  std::string old(227, '\0');  // LAS 1.2, point format 0
  const auto set = [&](std::size_t at, const std::string& bytes) { old.replace(at, bytes.size(), bytes); };
  set(0, "LASF");
  set(24, std::string("\1\2", 2));
  set(94, bytes_of(std::uint16_t{227}, std::uint32_t{227}, std::uint32_t{0}, std::uint8_t{0}, std::uint16_t{20}, std::uint32_t{3}));
  set(131, bytes_of(0.01, 0.01, 0.01, 0.0, 0.0, 0.0));
  put(to / "las/old.las", old + std::string(60, '\1'));
}

void make_pictures(const fs::path& to) {
  for (const char* folder : {"exr", "png", "tiff", "jpeg", "mask", "raw", "raster"}) make_folder(to / folder);
  const int width = fuzz::kPictureWidth, height = fuzz::kPictureHeight;
  std::vector<float> values(width * height * 3);
  std::vector<std::uint8_t> bytes(values.size());
  std::vector<std::uint16_t> words(values.size());
  for (std::size_t i = 0; i < values.size(); ++i) {
    values[i] = static_cast<float>(i % 17) / 16;
    bytes[i] = static_cast<std::uint8_t>(i * 7);
    words[i] = static_cast<std::uint16_t>(i * 1001);
  }
  write_exr(to / "exr/half.exr", width, height, {"R", "G", "B"}, values, true);
  write_exr(to / "exr/grey.exr", width, height, {"Y"}, std::span(values).first(width * height), false);
  write_png_srgb8(to / "png/rgb8.png", width, height, bytes);
  write_png_srgb16(to / "png/grey16.png", width, height, std::span(words).first(width * height), 1);
  for (const int compression : {COMPRESSION_NONE, COMPRESSION_LZW, COMPRESSION_ADOBE_DEFLATE}) {
    const std::string name = to / "tiff" / ("rgb16_" + std::to_string(compression) + ".tif");
    TIFF* tiff = TIFFOpen(name.c_str(), "w");
    TIFFSetField(tiff, TIFFTAG_IMAGEWIDTH, width);
    TIFFSetField(tiff, TIFFTAG_IMAGELENGTH, height);
    TIFFSetField(tiff, TIFFTAG_BITSPERSAMPLE, 16);
    TIFFSetField(tiff, TIFFTAG_SAMPLESPERPIXEL, 3);
    TIFFSetField(tiff, TIFFTAG_PHOTOMETRIC, PHOTOMETRIC_RGB);
    TIFFSetField(tiff, TIFFTAG_PLANARCONFIG, PLANARCONFIG_CONTIG);
    TIFFSetField(tiff, TIFFTAG_COMPRESSION, compression);
    TIFFSetField(tiff, TIFFTAG_ROWSPERSTRIP, 8);
    for (int y = 0; y < height; ++y) TIFFWriteScanline(tiff, &words[static_cast<std::size_t>(y * width * 3)], static_cast<std::uint32_t>(y), 0);
    TIFFClose(tiff);
  }
  {
    jpeg_compress_struct jpeg{};
    jpeg_error_mgr errors{};
    jpeg.err = jpeg_std_error(&errors);
    jpeg_create_compress(&jpeg);
    unsigned char* out = nullptr;
    unsigned long size = 0;
    jpeg_mem_dest(&jpeg, &out, &size);
    jpeg.image_width = width;
    jpeg.image_height = height;
    jpeg.input_components = 3;
    jpeg.in_color_space = JCS_RGB;
    jpeg_set_defaults(&jpeg);
    jpeg_simple_progression(&jpeg);
    jpeg_start_compress(&jpeg, TRUE);
    while (jpeg.next_scanline < jpeg.image_height) {
      JSAMPROW row = &bytes[jpeg.next_scanline * static_cast<std::size_t>(width) * 3];
      jpeg_write_scanlines(&jpeg, &row, 1);
    }
    jpeg_finish_compress(&jpeg);
    put(to / "jpeg/progressive.jpg", std::string(reinterpret_cast<const char*>(out), size));
    jpeg_destroy_compress(&jpeg);
    std::free(out);
  }
  {
    RasterWriter writer(to / "raster/two.raster", width, height, {{"depth", PlaneType::kF32}, {"flags", PlaneType::kU8}});
    writer.write_rows<float>("depth", 0, std::span<const float>(values).first(width * height));
    writer.write_rows<std::uint8_t>("flags", 0, std::span<const std::uint8_t>(bytes).first(width * height));
    writer.commit();
  }
}

// Masks are pictures of the size of their photograph.
void make_masks(const fs::path& to) {
  put(to / "mask/grey.png", read_text(to / "png/grey16.png"));
  put(to / "mask/deflate.tif", read_text(to / "tiff/rgb16_8.tif"));
}

void make_npy(const fs::path& to) {
  make_folder(to / "npy");
  std::string header = "{'descr': '<f4', 'fortran_order': False, 'shape': (5, 3), }";
  header.resize(117, ' ');
  std::string file = std::string("\x93NUMPY\1\0", 8) + bytes_of(std::uint16_t{118}) + header + "\n";
  for (int i = 0; i < 15; ++i) file += bytes_of(static_cast<float>(i) / 16);
  put(to / "npy/five.npy", file);
}

// A mosaic in a DNG, without compression.
void make_dng(const fs::path& to) {
  constexpr std::uint32_t kSize = 64;
  struct Tag {
    std::uint16_t tag, type;
    std::uint32_t count;
    std::string value;
  };
  const auto u16 = [](std::uint16_t v) { return bytes_of(v, std::uint16_t{0}); };
  const auto u32 = [](std::uint32_t v) { return bytes_of(v); };
  const std::string model("Fuzz\0", 5);
  const std::vector<Tag> tags{{254, 4, 1, u32(0)}, {256, 4, 1, u32(kSize)}, {257, 4, 1, u32(kSize)}, {258, 3, 1, u16(16)}, {259, 3, 1, u16(1)}, {262, 3, 1, u16(32803)},
                              {271, 2, 5, model}, {272, 2, 5, model}, {273, 4, 1, u32(1024)}, {274, 3, 1, u16(1)}, {277, 3, 1, u16(1)}, {278, 4, 1, u32(kSize)}, {279, 4, 1, u32(2 * kSize * kSize)},
                              {33421, 3, 2, bytes_of(std::uint16_t{2}, std::uint16_t{2})}, {33422, 1, 4, std::string("\0\1\1\2", 4)}, {50706, 1, 4, std::string("\1\4\0\0", 4)},
                              {50708, 2, 5, model}, {50714, 3, 1, u16(64)}, {50717, 3, 1, u16(4095)}};
  std::string file = std::string("II*\0", 4) + u32(8) + bytes_of(static_cast<std::uint16_t>(tags.size()));
  std::string outside;
  const std::size_t outside_at = 8 + 2 + 12 * tags.size() + 4;
  for (const Tag& t : tags) {
    file += bytes_of(t.tag, t.type, t.count);
    if (t.value.size() <= 4) {
      file += t.value + std::string(4 - t.value.size(), '\0');
    } else {
      file += u32(static_cast<std::uint32_t>(outside_at + outside.size()));
      outside += t.value + std::string(t.value.size() % 2, '\0');
    }
  }
  file += u32(0) + outside;
  file.resize(1024);
  for (std::uint32_t i = 0; i < kSize * kSize; ++i) file += bytes_of(static_cast<std::uint16_t>(64 + i * 31 % 4000));
  put(to / "raw/mosaic.dng", file);
}

class Points : public PointReader {
 public:
  Points() {
    schema_.declared_points = kPoints;
    schema_.has_colour = true;
  }
  const PointSchema& schema() const override { return schema_; }
  bool read(PointBlock& block, std::size_t) override {
    block.clear();
    if (done_) return false;
    for (int i = 0; i < kPoints; ++i) {
      block.position.push_back({std::cos(i * 0.7), std::sin(i * 0.7), i * 0.01});
      block.colour.push_back({static_cast<std::uint16_t>(i * 100), 2, 3});
    }
    return done_ = true;
  }

 private:
  static constexpr int kPoints = 60;
  PointSchema schema_;
  bool done_ = false;
};

void make_store(const fs::path& to) {
  const ScratchFolder scratch;
  const fs::path path = scratch.path() / "a.chiaro";
  CloudInput input;
  input.files = {"memory"};
  input.fingerprints = {"cloud"};
  input.open = [](std::size_t) { return std::make_unique<Points>(); };
  BuildOptions options;
  options.chunk_surfels = 32;
  MemoryBudget budget(1 << 28);
  build_store_from(input, path, options, budget, silent_reporter());
  const fs::path layer = path / "layers/input";
  for (const std::string& flags : {std::string(1, '\0'), std::string(1, '\1')})
    put(to / "store" / (flags[0] ? "resealed.pack" : "sealed.pack"),
        fuzz::pack({flags, read_text(path / "manifest.json"), read_text(path / "index.bin"), read_text(path / "geometry.bin"), read_text(path / "source.bin"), read_text(layer / "layer.json"),
                    read_text(layer / "index.bin"), read_text(layer / "values.bin")}));
}

}  // namespace

int main(int argc, char** argv) {
  if (argc != 2) return 2;
  const fs::path to = argv[1];
  make_texts(to);
  make_las(to);
  make_pictures(to);
  make_masks(to);
  make_npy(to);
  make_dng(to);
  make_store(to);
}
