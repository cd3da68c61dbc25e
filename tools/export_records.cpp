#include "tools/export_records.h"

#include <limits>
#include <string>

#include "stream/base/error.h"
#include "tools/fill_unseen.h"

namespace chiaro::tools {
namespace {

constexpr std::uint16_t kMidGrey16 = 128 * 257;

/// Colour of layer "input", 3 x u16 a surfel.
std::vector<std::array<std::uint16_t, 3>> input_colours(const stream::Store& store, const std::optional<stream::Layer>& input, std::uint32_t leaf, std::uint32_t count) {
  if (input) return stream::read_colour(*input, store, leaf);
  return std::vector<std::array<std::uint16_t, 3>>(count, {kMidGrey16, kMidGrey16, kMidGrey16});
}

}  // namespace

LeafSource::LeafSource(const stream::Store& store, const std::string& layer, bool fill) : store_(store), fill_(fill) {
  if (!layer.empty()) layer_.emplace(store, layer);
  if (stream::has_layer(store, "input")) input_.emplace(store, "input");
}

LeafRecords LeafSource::read(std::uint32_t leaf) const {
  const stream::Chunk chunk = store_.read_chunk(leaf);
  const auto colours = input_colours(store_, input_, leaf, chunk.count);
  stream::AlbedoValues values = albedo(chunk);
  LeafRecords records;
  records.sources = store_.read_sources(leaf);
  for (const Vec3f& a : values.albedo) records.unseen += !a.allFinite();
  if (fill_ && layer_) records.filled = fill_unseen(store_, *layer_, chunk, values.albedo);
  records.points.resize(chunk.count);
  for (std::uint32_t i = 0; i < chunk.count; ++i) {
    const stream::SurfelBlock& block = chunk.blocks[i / stream::kBlockSurfels];
    const std::size_t lane = i % stream::kBlockSurfels;
    records.points[i] = {0, leaf, values.albedo[i], values.sigma[i], {block.x[lane], block.y[lane], block.z[lane]}, colours[i], {block.normal_u[lane], block.normal_v[lane]}, values.photos[i]};
  }
  return records;
}

stream::AlbedoValues LeafSource::albedo(const stream::Chunk& chunk) const {
  if (layer_) return read_albedo(*layer_, store_, chunk.index);
  constexpr float kNaN = std::numeric_limits<float>::quiet_NaN();
  return {std::vector<Vec3f>(chunk.count, Vec3f::Constant(kNaN)), std::vector<float>(chunk.count, kNaN), std::vector<std::uint16_t>(chunk.count, 0)};
}

RecordBuckets::RecordBuckets(const std::filesystem::path& path, std::uint64_t num_sources, std::uint64_t per_bucket, std::size_t buffer_records)
    : file_(path, File::Mode::kCreate), per_bucket_(per_bucket), buffer_records_(buffer_records),
      buffers_(static_cast<std::size_t>((num_sources + per_bucket - 1) / per_bucket)), written_(buffers_.size()) {}

void RecordBuckets::add(std::uint64_t source, PointRecord record) {
  const auto bucket = static_cast<std::size_t>(source / per_bucket_);
  if (bucket >= buffers_.size()) throw Error(concat(file_.path().string(), ": source index ", source, " lies beyond the points that were read"));
  if (buffers_[bucket].empty()) buffers_[bucket].reserve(buffer_records_);
  record.source = static_cast<std::uint32_t>(source - first_source(bucket));
  buffers_[bucket].push_back(record);
  if (buffers_[bucket].size() >= buffer_records_) flush(bucket);
}

void RecordBuckets::flush_all() {
  for (std::size_t b = 0; b < buffers_.size(); ++b) {
    flush(b);
    buffers_[b].shrink_to_fit();
  }
}

std::vector<PointRecord> RecordBuckets::read(std::size_t bucket) const {
  std::vector<PointRecord> records(written_[bucket]);
  file_.read_at(first_source(bucket) * sizeof(PointRecord), records.data(), records.size() * sizeof(PointRecord));
  return records;
}

void RecordBuckets::flush(std::size_t bucket) {
  auto& buffer = buffers_[bucket];
  if (written_[bucket] + buffer.size() > per_bucket_) throw Error(concat(file_.path().string(), ": more points than sources in bucket ", bucket));
  file_.write_at((first_source(bucket) + written_[bucket]) * sizeof(PointRecord), buffer.data(), buffer.size() * sizeof(PointRecord));
  written_[bucket] += buffer.size();
  buffer.clear();
}

}  // namespace chiaro::tools
