/// Points of an export on their way from the order of the leaves to the order of the source files.
#pragma once
#include <array>
#include <cstdint>
#include <filesystem>
#include <optional>
#include <vector>

#include "stream/base/file.h"
#include "stream/store/layer.h"
#include "stream/store/store.h"

namespace chiaro::tools {

/// What the store knows about a point, as compactly as it is stored: all points lie on disk in this form once.
struct PointRecord {
  std::uint32_t source = 0;      ///< less that of the first point of its bucket
  std::uint32_t leaf = 0;        ///< the chunk whose frame the position is in
  Vec3f albedo = Vec3f::Zero();  ///< linear; NaN = unseen
  float sigma = 0;
  std::array<std::uint16_t, 3> position{}, colour{};
  std::array<std::int16_t, 2> normal{};
  std::uint16_t photos = 0;
};
static_assert(sizeof(PointRecord) == 44);

struct LeafRecords {
  std::vector<std::uint64_t> sources;   ///< of each point
  std::vector<PointRecord> points;      ///< `source` is not set
  std::uint64_t unseen = 0, filled = 0;
};

/// Reads leaves with the values of a layer (empty: none) and the colours of layer "input". Thread-safe. The store outlives it.
class LeafSource {
 public:
  LeafSource(const stream::Store& store, const std::string& layer, bool fill);
  LeafRecords read(std::uint32_t leaf) const;

 private:
  stream::AlbedoValues albedo(const stream::Chunk& chunk) const;

  const stream::Store& store_;
  bool fill_;
  std::optional<stream::Layer> layer_, input_;
};

/// Records sorted into buckets of consecutive source indices, in a scratch file; each bucket has its own region, filled through a small buffer.
class RecordBuckets {
 public:
  RecordBuckets(const std::filesystem::path& path, std::uint64_t num_sources, std::uint64_t per_bucket, std::size_t buffer_records);

  std::size_t count() const { return buffers_.size(); }
  std::uint64_t first_source(std::size_t bucket) const { return bucket * per_bucket_; }
  void add(std::uint64_t source, PointRecord record);
  void flush_all();
  std::vector<PointRecord> read(std::size_t bucket) const;

 private:
  void flush(std::size_t bucket);

  File file_;
  std::uint64_t per_bucket_;
  std::size_t buffer_records_;
  std::vector<std::vector<PointRecord>> buffers_;
  std::vector<std::uint64_t> written_;
};

}  // namespace chiaro::tools
