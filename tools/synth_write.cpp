#include "tools/synth_write.h"

#include <algorithm>
#include <cmath>
#include <cstring>
#include <vector>

#include "stream/base/budget.h"
#include "stream/base/error.h"
#include "stream/base/file.h"
#include "stream/base/parallel.h"
#include "stream/cloud/point_stream.h"

namespace chiaro::tools {
namespace {

constexpr std::uint64_t kBlock = 1 << 18;   // points; 12 MiB with everything

struct Row {
  bool as_double = false, normals = false, albedo = false;
  std::size_t bytes() const { return 3u * (as_double ? 8 : 4) + (normals ? 12u : 0u) + (albedo ? 12u : 0u); }
};

std::vector<stream::PointProperty> properties(const Row& row) {
  std::vector<stream::PointProperty> out;
  for (const char* name : {"x", "y", "z"}) out.push_back({name, row.as_double ? stream::ScalarType::kF64 : stream::ScalarType::kF32});
  if (row.normals)
    for (const char* name : {"nx", "ny", "nz"}) out.push_back({name, stream::ScalarType::kF32});
  if (row.albedo)
    for (const char* name : {"albedo_r", "albedo_g", "albedo_b"}) out.push_back({name, stream::ScalarType::kF32});
  return out;
}

/// A float has 24 bits: enough while a step is some thousandths of the spacing.
bool needs_double(const SynthScene& scene, const Box3d& box) {
  const double step = std::max(box.max.cwiseAbs().maxCoeff(), box.min.cwiseAbs().maxCoeff()) * 0x1p-24;
  const double spacing = scene.area_m2() > 0 ? std::sqrt(scene.area_m2() / static_cast<double>(scene.num_points())) : (box.max - box.min).maxCoeff() / static_cast<double>(scene.num_points());
  const double finest = scene.spec().noise_m > 0 ? std::min(spacing, scene.spec().noise_m) : spacing;
  return step > 2e-3 * finest;
}

void put(std::byte*& at, const void* value, std::size_t bytes) {
  std::memcpy(at, value, bytes);
  at += bytes;
}

void fill(const SynthScene& scene, const Row& row, std::uint64_t first, std::size_t count, std::vector<std::byte>& rows) {
  rows.resize(count * row.bytes());
  parallel_blocks(count, 4096, [&](std::size_t begin, std::size_t end) {
    std::byte* at = rows.data() + begin * row.bytes();
    for (std::size_t i = begin; i < end; ++i) {
      const SynthPoint p = scene.point(first + i);
      const Vec3f single = p.position.cast<float>();
      if (row.as_double) put(at, p.position.data(), 24);
      else put(at, single.data(), 12);
      if (row.normals) put(at, p.normal.data(), 12);
      if (row.albedo) put(at, p.albedo.data(), 12);
    }
  });
}

}  // namespace

SynthResult write_synth(const SynthScene& scene, const std::filesystem::path& file, bool with_albedo, Reporter& report) {
  const Box3d box = scene.bounds();
  Row row;
  row.as_double = needs_double(scene, box);
  row.normals = scene.spec().normals;
  row.albedo = with_albedo;
  const std::uint64_t wanted = scene.num_points() * row.bytes(), left = free_disk_bytes(file);
  if (wanted > left) throw Error(concat(file.string(), ": ", format_bytes(wanted), " are needed, the disk has ", format_bytes(left), " left"));

  stream::PointWriterOptions options;
  options.num_points = scene.num_points();
  options.properties = properties(row);
  options.bounds = box;
  if (with_albedo) options.comments.push_back("synthetic scene; albedo by formula, see chiaro synth --help");
  const auto writer = stream::create_points(file, options);
  std::vector<std::byte> rows;
  report.begin("synth", scene.num_points(), "points");
  for (std::uint64_t first = 0; first < scene.num_points(); first += kBlock) {
    report.check();
    const auto count = static_cast<std::size_t>(std::min(kBlock, scene.num_points() - first));
    fill(scene, row, first, count, rows);
    writer->write(rows.data(), count);
    report.progress(first + count);
  }
  writer->commit();
  report.end();
  SynthResult result;
  result.points = scene.num_points();
  std::error_code code;
  result.bytes = std::filesystem::file_size(file, code);
  result.area_m2 = scene.area_m2();
  result.spacing_m = result.area_m2 > 0 ? std::sqrt(result.area_m2 / static_cast<double>(result.points)) : 0;
  return result;
}

}  // namespace chiaro::tools
