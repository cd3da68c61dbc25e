#include "tests/fuzz/targets.h"

#include <algorithm>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <fstream>
#include <stdexcept>

#include "stream/base/error.h"
#include "stream/base/file.h"
#include "stream/base/hash.h"
#include "stream/cloud/point_stream.h"
#include "stream/photo/camera_files.h"
#include "stream/photo/develop.h"
#include "stream/photo/image_io.h"
#include "stream/photo/raster.h"
#include "stream/photo/raw.h"
#include "stream/store/layer.h"
#include "stream/store/octree_build.h"
#include "stream/store/repair.h"
#include "stream/store/store_format.h"
#include "tools/npy_reader.h"
#include "tools/project.h"

namespace chiaro::fuzz {
namespace {

namespace fs = std::filesystem;
using Bytes = std::span<const std::uint8_t>;

constexpr std::uint64_t kMemory = 16 << 20;      // that readers may use
constexpr std::size_t kMostPoints = 1 << 20;     // text of a few bytes cannot say more; a compressed scan can

// In memory where the system offers that, and one a process.
const fs::path& folder() {
  static const ScratchFolder scratch(fs::exists("/dev/shm") ? fs::path("/dev/shm") : fs::path());
  return scratch.path();
}

void put(const fs::path& path, std::string_view bytes) {
  std::ofstream out(path, std::ios::binary | std::ios::trunc);
  out.write(bytes.data(), static_cast<std::streamsize>(bytes.size()));
}

fs::path put(const char* name, Bytes bytes) {
  const fs::path path = folder() / name;
  put(path, {reinterpret_cast<const char*>(bytes.data()), bytes.size()});
  return path;
}

template <class Read>
bool is_read(const Read& read) {
  try {
    read();
    return true;
  } catch (const Error& e) {
    if (std::getenv("CHIARO_FUZZ_VERBOSE")) std::fprintf(stderr, "%s\n", e.what());
    return false;
  }
}

bool points(const char* name, Bytes bytes) {
  const fs::path path = put(name, bytes);
  return is_read([&] {
    const auto reader = stream::open_points(path, kMemory);
    stream::PointBlock block;
    for (std::size_t n = 0; n < kMostPoints && reader->read(block, 4096); n += block.size()) {
      const std::size_t count = block.size();
      if (reader->schema().has_normal && block.normal.size() != count) throw std::logic_error("normals are missing");
      if (reader->schema().has_colour && block.colour.size() != count) throw std::logic_error("colours are missing");
      if (block.extras.size() != count * reader->schema().extra_bytes()) throw std::logic_error("extras are missing");
    }
  });
}

bool picture(const char* name, Bytes bytes) {
  const fs::path path = put(name, bytes);
  return is_read([&] {
    stream::ImageOptions options;
    options.limits = {1 << 20, kMemory};
    stream::ImageSource source(path, options);
    std::vector<float> rows(static_cast<std::size_t>(source.width()) * static_cast<std::size_t>(source.channels()) * 16);
    for (int y = 0; y < source.height(); y += 16) source.read_rows(y, std::min(16, source.height() - y), rows.data());
  });
}

// A mask belongs to a photograph, and must be of its size: that of the corpus' pictures.
bool mask(Bytes bytes) {
  const fs::path photograph = folder() / "photo.exr", path = put("mask.png", bytes);
  if (!fs::exists(photograph)) stream::write_exr(photograph, kPictureWidth, kPictureHeight, {"Y"}, std::vector<float>(std::size_t{kPictureWidth} * kPictureHeight, 0.25f), true);
  return is_read([&] {
    stream::DevelopOptions options;
    options.mask = path;
    options.noise = stream::NoiseModel{1e-4, 1e-3};
    options.find_clipping = true;
    stream::develop(photograph, options, folder() / "photo.raster", silent_reporter());
  });
}

bool npy(Bytes bytes) {
  const fs::path path = put("colours.npy", bytes);
  return is_read([&] {
    tools::NpyReader reader(path);
    for (std::size_t n = 0; n < kMostPoints;) {
      const std::size_t rows = reader.read(4096).size();
      if (rows == 0) break;
      n += rows;
    }
  });
}

bool raw(Bytes bytes) {
  const fs::path path = put("photo.dng", bytes);
  return is_read([&] {
    const stream::RawSource source(path);
    const auto heaps = source.heaps();
    const auto width = static_cast<std::size_t>(source.info().width_px);
    std::vector<float> rgb(width * 3);
    std::vector<std::uint8_t> saturated(width);
    for (int y = 0; y < source.info().height_px; ++y) source.read_rows(y, 1, 0.98, heaps, rgb.data(), saturated.data());
  });
}

bool raster(Bytes bytes) {
  const fs::path path = put("work.raster", bytes);
  return is_read([&] {
    const stream::RasterReader reader(path);
    for (const stream::PlaneInfo& plane : reader.planes()) {
      std::vector<std::byte> row(static_cast<std::size_t>(reader.width()) * stream::plane_type_bytes(plane.type));
      for (int y = 0; y < reader.height(); ++y) reader.read_rows(plane.name, y, 1, row);
    }
  });
}

bool cameras(const fs::path& path) {
  return is_read([&] {
    std::vector<std::string> notes;
    stream::read_cameras(path, notes);
  });
}

bool colmap(const char* kind, Bytes bytes) {
  const fs::path path = folder() / concat("colmap_", kind);
  fs::create_directories(path);
  const auto files = unpack(bytes, 2);
  put(path / concat("cameras.", kind), files[0]);
  put(path / concat("images.", kind), files[1]);
  return cameras(path);
}

bool project(Bytes bytes) {
  const fs::path path = put("project.toml", bytes);
  fs::create_directories(folder() / "masks");
  put(folder() / "masks/project.png", "");
  return is_read([&] { tools::to_json(tools::load_project(path)); });
}

// With the right checksums, hostile contents get further.
std::string resealed_index(std::string bytes) {
  if (bytes.size() < sizeof(stream::IndexHeader)) return bytes;
  stream::IndexHeader header;
  std::memcpy(&header, bytes.data(), sizeof header);
  header.records_crc = crc32c(bytes.data() + sizeof header, bytes.size() - sizeof header);
  header.header_crc = stream::header_crc_of(header);
  std::memcpy(bytes.data(), &header, sizeof header);
  return bytes;
}

std::string resealed_text(const std::string& text) {
  const std::string body = text.substr(0, text.rfind(",\n  \"crc32c\""));
  return body + stream::seal_of(body);
}

// Flags, manifest, index, geometry, source, layer.json, layer index, values.
bool store(Bytes bytes) {
  const fs::path path = folder() / "a.chiaro", layer = path / "layers/input";
  fs::create_directories(layer);
  const auto files = unpack(bytes, 8);
  const bool reseal = !files[0].empty() && (files[0][0] & 1);
  put(path / "manifest.json", reseal ? resealed_text(files[1]) : files[1]);
  put(path / "index.bin", reseal ? resealed_index(files[2]) : files[2]);
  put(path / "geometry.bin", files[3]);
  put(path / "source.bin", files[4]);
  put(layer / "layer.json", reseal ? resealed_text(files[5]) : files[5]);
  put(layer / "index.bin", files[6]);
  put(layer / "values.bin", files[7]);
  MemoryBudget budget(kMemory);
  const bool whole = stream::verify_store(path, budget, silent_reporter()).problems.empty();
  is_read([&] { stream::repair_store(path, budget, silent_reporter()); });
  is_read([&] {
    const stream::Store opened(path);
    for (std::uint32_t i = 0; i < opened.chunks().size(); ++i) is_read([&] { opened.read_chunk(i); });
    for (const std::uint32_t leaf : opened.leaves()) is_read([&] { opened.read_sources(leaf); });
    for (const std::string& name : stream::layer_names(opened)) {
      const stream::Layer values(opened, name);
      for (std::uint32_t i = 0; i < opened.chunks().size(); ++i) is_read([&] { values.read_chunk(i); });
    }
  });
  return whole;
}

}  // namespace

const std::vector<Target>& targets() {
  static const std::vector<Target> all{
      {"ply", [](Bytes b) { return points("a.ply", b); }},
      {"las", [](Bytes b) { return points("a.las", b); }},
      {"laz", [](Bytes b) { return points("a.laz", b); }},
      {"e57", [](Bytes b) { return points("a.e57", b); }},
      {"pcd", [](Bytes b) { return points("a.pcd", b); }},
      {"xyz", [](Bytes b) { return points("a.xyz", b); }},
      {"csv", [](Bytes b) { return points("a.csv", b); }},
      {"pts", [](Bytes b) { return points("a.pts", b); }},
      {"ptx", [](Bytes b) { return points("a.ptx", b); }},
      {"exr", [](Bytes b) { return picture("a.exr", b); }},
      {"tiff", [](Bytes b) { return picture("a.tif", b); }},
      {"png", [](Bytes b) { return picture("a.png", b); }},
      {"jpeg", [](Bytes b) { return picture("a.jpg", b); }},
      {"mask", mask},
      {"npy", npy},
      {"raw", raw},
      {"raster", raster},
      {"colmap_text", [](Bytes b) { return colmap("txt", b); }},
      {"colmap_binary", [](Bytes b) { return colmap("bin", b); }},
      {"metashape", [](Bytes b) { return cameras(put("cameras.xml", b)); }},
      {"project", project},
      {"store", store},
  };
  return all;
}

const Target& target(const std::string& name) {
  for (const Target& t : targets())
    if (t.name == name) return t;
  throw std::invalid_argument("no fuzz target \"" + name + "\"");
}

std::vector<std::string> unpack(Bytes bytes, std::size_t files) {
  std::vector<std::string> result(files);
  std::size_t at = 0;
  for (std::string& file : result) {
    std::uint32_t size = 0;
    if (bytes.size() - at < sizeof size) break;
    std::memcpy(&size, &bytes[at], sizeof size);
    at += sizeof size;
    const std::size_t n = std::min<std::size_t>(size, bytes.size() - at);
    file.assign(reinterpret_cast<const char*>(bytes.data()) + at, n);
    at += n;
  }
  return result;
}

std::string pack(const std::vector<std::string>& files) {
  std::string bytes;
  for (const std::string& file : files) {
    const auto size = static_cast<std::uint32_t>(file.size());
    bytes.append(reinterpret_cast<const char*>(&size), sizeof size);
    bytes += file;
  }
  return bytes;
}

}  // namespace chiaro::fuzz
