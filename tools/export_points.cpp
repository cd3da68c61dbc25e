#include "tools/export_points.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <cstring>
#include <limits>
#include <optional>
#include <vector>

#include "stream/base/error.h"
#include "stream/base/file.h"
#include "stream/base/hash.h"
#include "stream/base/parallel.h"
#include "stream/cloud/point_stream.h"
#include "stream/store/layer.h"
#include "tools/fill_unseen.h"
#include "tools/inserted_points.h"

namespace chiaro::tools {
namespace {

using stream::PointProperty;
using stream::ScalarType;

constexpr std::uint16_t kMidGrey16 = 128 * 257;
constexpr std::size_t kReadPoints = 16384, kReadBytes = 256;   // points read at once, and what a reader holds for each

/// What the store knows about a point, on its way from the leaves' order to the input's.
struct PointRecord {
  std::uint64_t source = 0;
  std::array<double, 3> position{};
  std::array<float, 3> normal{}, albedo{};
  float sigma = 0, position_error = 0;   ///< largest difference to the source that quantisation explains
  std::array<std::uint16_t, 3> colour{};
  std::uint16_t photos = 0;
};
static_assert(sizeof(PointRecord) == 72);

std::uint8_t srgb_8bit(float linear) {
  if (!(linear > 0)) return 0;
  if (linear >= 1) return 255;
  const double v = linear <= 0.0031308 ? 12.92 * linear : 1.055 * std::pow(static_cast<double>(linear), 1 / 2.4) - 0.055;
  return static_cast<std::uint8_t>(std::lround(255 * v));
}

// ---- the leaves' side ----

struct LeafRecords {
  std::vector<PointRecord> points;
  std::uint64_t unseen = 0, filled = 0;
};

/// Colour of layer "input", 3 x u16 a surfel.
std::vector<std::array<std::uint16_t, 3>> input_colours(const stream::Store& store, const std::optional<stream::Layer>& input, std::uint32_t leaf, std::uint32_t count) {
  if (input) return stream::read_colour(*input, store, leaf);
  return std::vector<std::array<std::uint16_t, 3>>(count, {kMidGrey16, kMidGrey16, kMidGrey16});
}

class LeafSource {
 public:
  LeafSource(const stream::Store& store, const ExportOptions& options) : store_(store), fill_(options.fill) {
    if (!options.layer.empty()) layer_.emplace(store, options.layer);
    if (stream::has_layer(store, "input")) input_.emplace(store, "input");
  }

  LeafRecords read(std::uint32_t leaf) const {
    const stream::Chunk chunk = store_.read_chunk(leaf);
    const std::vector<std::uint64_t> sources = store_.read_sources(leaf);
    const auto colours = input_colours(store_, input_, leaf, chunk.count);
    stream::AlbedoValues values = albedo(chunk);
    LeafRecords records;
    for (const Vec3f& a : values.albedo) records.unseen += !a.allFinite();
    if (fill_ && layer_) records.filled = fill_unseen(store_, *layer_, chunk, values.albedo);
    records.points.resize(chunk.count);
    for (std::uint32_t i = 0; i < chunk.count; ++i) {
      const stream::Surfel s = chunk.surfel(i);
      PointRecord& r = records.points[i];
      r.source = sources[i];
      for (int c = 0; c < 3; ++c) {
        r.position[static_cast<std::size_t>(c)] = s.position_in_world[c];
        r.normal[static_cast<std::size_t>(c)] = s.normal[c];
        r.albedo[static_cast<std::size_t>(c)] = values.albedo[i][c];
      }
      r.sigma = values.sigma[i];
      r.photos = values.photos[i];
      r.colour = colours[i];
      r.position_error = static_cast<float>(2 * chunk.frame.step);
    }
    return records;
  }

 private:
  stream::AlbedoValues albedo(const stream::Chunk& chunk) const {
    if (layer_) return read_albedo(*layer_, store_, chunk.index);
    constexpr float kNaN = std::numeric_limits<float>::quiet_NaN();
    return {std::vector<Vec3f>(chunk.count, Vec3f::Constant(kNaN)), std::vector<float>(chunk.count, kNaN), std::vector<std::uint16_t>(chunk.count, 0)};
  }

  const stream::Store& store_;
  bool fill_;
  std::optional<stream::Layer> layer_, input_;
};

// ---- buckets ----

/// Records sorted into buckets of consecutive source indices, in a scratch file; each bucket has its own region, filled through a small buffer.
class Buckets {
 public:
  Buckets(const std::filesystem::path& path, std::uint64_t num_sources, std::uint64_t per_bucket, std::size_t buffer_records)
      : file_(path, File::Mode::kCreate), per_bucket_(per_bucket), buffer_records_(buffer_records),
        buffers_(static_cast<std::size_t>((num_sources + per_bucket - 1) / per_bucket)), written_(buffers_.size()) {}

  std::size_t count() const { return buffers_.size(); }
  std::uint64_t first_source(std::size_t bucket) const { return bucket * per_bucket_; }

  void add(const PointRecord& record) {
    const auto bucket = static_cast<std::size_t>(record.source / per_bucket_);
    if (bucket >= buffers_.size()) throw Error(concat(file_.path().string(), ": source index ", record.source, " lies beyond the points that were read"));
    if (buffers_[bucket].empty()) buffers_[bucket].reserve(buffer_records_);
    buffers_[bucket].push_back(record);
    if (buffers_[bucket].size() >= buffer_records_) flush(bucket);
  }
  void flush_all() {
    for (std::size_t b = 0; b < buffers_.size(); ++b) {
      flush(b);
      buffers_[b].shrink_to_fit();
    }
  }
  std::vector<PointRecord> read(std::size_t bucket) const {
    std::vector<PointRecord> records(written_[bucket]);
    file_.read_at(first_source(bucket) * sizeof(PointRecord), records.data(), records.size() * sizeof(PointRecord));
    return records;
  }

 private:
  void flush(std::size_t bucket) {
    auto& buffer = buffers_[bucket];
    if (written_[bucket] + buffer.size() > per_bucket_) throw Error(concat(file_.path().string(), ": more points than sources in bucket ", bucket));
    file_.write_at((first_source(bucket) + written_[bucket]) * sizeof(PointRecord), buffer.data(), buffer.size() * sizeof(PointRecord));
    written_[bucket] += buffer.size();
    buffer.clear();
  }

  File file_;
  std::uint64_t per_bucket_;
  std::size_t buffer_records_;
  std::vector<std::vector<PointRecord>> buffers_;
  std::vector<std::uint64_t> written_;
};

// ---- the source files' side ----

/// Bytes of one carried property inside a file's packed extras.
struct CarriedField {
  std::size_t offset = 0, bytes = 0;
};

std::optional<CarriedField> find_field(const stream::PointSchema& schema, const PointProperty& wanted) {
  std::size_t offset = 0;
  for (const PointProperty& p : schema.extras) {
    if (p.name == wanted.name && p.type == wanted.type) return CarriedField{offset, stream::scalar_bytes(p.type)};
    offset += stream::scalar_bytes(p.type);
  }
  return std::nullopt;
}

/// The source files one after the other, as one run of points. Only made while all of them are what they were at ingest.
class SourceFiles {
 public:
  SourceFiles(const stream::Manifest& manifest, std::vector<std::filesystem::path> files, bool with_albedo, bool with_inserted, Reporter& report) : manifest_(manifest), files_(std::move(files)) {
    for (const std::filesystem::path& file : files_) {
      const auto reader = stream::open_points(file);
      schemas_.push_back(reader->schema());
      position_is_double_ |= reader->schema().position_is_double;
    }
    choose_carried(with_albedo, with_inserted, report);
  }

  static bool unchanged(const stream::Manifest& manifest, const std::vector<std::filesystem::path>& files, std::string& why) {
    if (files.empty() || files.size() != manifest.source_fingerprints.size() || files.size() != manifest.source_points.size()) {
      why = "the store does not name its source files";
      return false;
    }
    for (std::size_t i = 0; i < files.size(); ++i) {
      std::error_code code;
      if (!std::filesystem::is_regular_file(files[i], code)) {
        why = concat(files[i].string(), " is not there any more");
        return false;
      }
      if (file_fingerprint(files[i]) != manifest.source_fingerprints[i]) {
        why = concat(files[i].string(), " has changed since it was ingested");
        return false;
      }
    }
    return true;
  }

  bool position_is_double() const { return position_is_double_; }
  const std::vector<PointProperty>& carried() const { return carried_; }

  /// The next points, at most max_points, all of one file. throws Error when a file has fewer points than at ingest.
  const stream::PointBlock& read(std::size_t max_points) {
    while (!reader_ || left_in_file_ == 0) {
      file_ = reader_ ? file_ + 1 : 0;
      if (file_ >= schemas_.size()) throw Error("source files: fewer points than the store counts");
      reader_ = stream::open_points(files_[file_]);
      left_in_file_ = manifest_.source_points[file_];
      fields_.clear();
      for (const PointProperty& p : carried_) fields_.push_back(*find_field(schemas_[file_], p));
    }
    if (!reader_->read(block_, static_cast<std::size_t>(std::min<std::uint64_t>(max_points, left_in_file_))))
      throw Error(concat(files_[file_].string(), ": ends early, ", left_in_file_, " of ", manifest_.source_points[file_], " points are missing"));
    left_in_file_ -= block_.size();
    return block_;
  }
  /// Copies the carried properties of point i of the last block.
  std::byte* copy_carried(std::size_t i, std::byte* to) const {
    const std::byte* from = block_.extras.data() + i * schemas_[file_].extra_bytes();
    for (const CarriedField& f : fields_) {
      std::memcpy(to, from + f.offset, f.bytes);
      to += f.bytes;
    }
    return to;
  }

 private:
  void choose_carried(bool with_albedo, bool with_inserted, Reporter& report) {
    std::vector<std::string> ours{"x", "y", "z", "nx", "ny", "nz", "red", "green", "blue"};
    if (with_albedo) ours.insert(ours.end(), {"albedo_r", "albedo_g", "albedo_b", "sigma", "photos"});
    if (with_inserted) ours.push_back("inserted");
    for (const PointProperty& p : schemas_.front().extras) {
      if (std::find(ours.begin(), ours.end(), p.name) != ours.end()) {
        report.note(concat("export: the input's property \"", p.name, "\" is replaced by the result's"));
      } else if (std::all_of(schemas_.begin(), schemas_.end(), [&](const stream::PointSchema& s) { return find_field(s, p).has_value(); })) {
        carried_.push_back(p);
      } else {
        report.note(concat("export: the input's property \"", p.name, "\" is left out: not every source file has it"));
      }
    }
  }

  const stream::Manifest& manifest_;
  std::vector<std::filesystem::path> files_;
  std::vector<stream::PointSchema> schemas_;
  bool position_is_double_ = false;
  std::vector<PointProperty> carried_;
  std::unique_ptr<stream::PointReader> reader_;
  std::size_t file_ = 0;
  std::uint64_t left_in_file_ = 0;
  std::vector<CarriedField> fields_;
  stream::PointBlock block_;
};

// ---- rows ----

/// Packs rows in the order of the contract.
class RowPacker {
 public:
  RowPacker(bool double_positions, bool wide_colours, bool with_albedo, bool with_inserted, const std::vector<PointProperty>& carried)
      : double_positions_(double_positions), wide_colours_(wide_colours), with_albedo_(with_albedo), with_inserted_(with_inserted) {
    const ScalarType position = double_positions ? ScalarType::kF64 : ScalarType::kF32;
    for (const char* name : {"x", "y", "z"}) properties_.push_back({name, position});
    for (const char* name : {"nx", "ny", "nz"}) properties_.push_back({name, ScalarType::kF32});
    for (const char* name : {"red", "green", "blue"}) properties_.push_back({name, wide_colours ? ScalarType::kU16 : ScalarType::kU8});
    if (with_albedo) {
      for (const char* name : {"albedo_r", "albedo_g", "albedo_b", "sigma"}) properties_.push_back({name, ScalarType::kF32});
      properties_.push_back({"photos", ScalarType::kU16});
    }
    if (with_inserted) properties_.push_back({"inserted", ScalarType::kU8});
    first_carried_ = properties_.size();
    properties_.insert(properties_.end(), carried.begin(), carried.end());
    for (const PointProperty& p : properties_) row_bytes_ += stream::scalar_bytes(p.type);
  }
  const std::vector<PointProperty>& properties() const { return properties_; }
  std::size_t row_bytes() const { return row_bytes_; }

  /// Carried properties of a point that no source file has: not a number, whole numbers 0.
  std::byte* pack_nothing_carried(std::byte* at) const {
    for (std::size_t i = first_carried_; i < properties_.size(); ++i) {
      const std::size_t bytes = stream::scalar_bytes(properties_[i].type);
      constexpr double kNaN64 = std::numeric_limits<double>::quiet_NaN();
      constexpr float kNaN32 = std::numeric_limits<float>::quiet_NaN();
      if (properties_[i].type == ScalarType::kF64) std::memcpy(at, &kNaN64, bytes);
      else if (properties_[i].type == ScalarType::kF32) std::memcpy(at, &kNaN32, bytes);
      else std::memset(at, 0, bytes);
      at += bytes;
    }
    return at;
  }

  /// Writes all but the carried properties; returns where those go.
  std::byte* pack(const PointRecord& r, const Vec3d& position, std::uint8_t inserted, std::byte* at) const {
    const auto put = [&at](const auto& value) {
      std::memcpy(at, &value, sizeof value);
      at += sizeof value;
    };
    for (int c = 0; c < 3; ++c) double_positions_ ? put(position[c]) : put(static_cast<float>(position[c]));
    put(r.normal);
    const bool has_albedo = std::isfinite(r.albedo[0]) && std::isfinite(r.albedo[1]) && std::isfinite(r.albedo[2]);
    for (std::size_t c = 0; c < 3; ++c) {
      const auto colour = has_albedo ? static_cast<std::uint16_t>(257 * srgb_8bit(r.albedo[c])) : r.colour[c];
      wide_colours_ ? put(colour) : put(static_cast<std::uint8_t>((colour + 128) / 257));
    }
    if (with_albedo_) {
      put(r.albedo);
      put(r.sigma);
      put(r.photos);
    }
    if (with_inserted_) put(inserted);
    return at;
  }

 private:
  bool double_positions_, wide_colours_, with_albedo_, with_inserted_;
  std::vector<PointProperty> properties_;
  std::size_t first_carried_ = 0;
  std::size_t row_bytes_ = 0;
};

/// True where single precision is coarser than the store.
bool extent_needs_double(const stream::Manifest& manifest) {
  const double largest = std::max(manifest.bounds.min.cwiseAbs().maxCoeff(), manifest.bounds.max.cwiseAbs().maxCoeff());
  const double extent = (manifest.bounds.max - manifest.bounds.min).maxCoeff();
  return largest * std::numeric_limits<float>::epsilon() > extent * 1e-6;
}

Box3d grown_bounds(const stream::Manifest& manifest) {
  const Vec3d step = Vec3d::Constant(manifest.edge / 65536);   // stored positions are quantised, written ones are not
  return {manifest.bounds.min - step, manifest.bounds.max + step};
}

class Exporter {
 public:
  Exporter(const stream::Store& store, const ExportOptions& options, MemoryBudget& budget, Reporter& report)
      : store_(store), options_(options), budget_(budget), report_(report) {
    const stream::Manifest& manifest = store.manifest();
    if (with_albedo()) inserted_ = open_inserted(store, options.layer);
    if (inserted_) stats_.points_inserted = inserted_->seen();
    std::string why;
    const std::vector<std::filesystem::path> files = options.sources.empty() ? std::vector<std::filesystem::path>(manifest.source_files.begin(), manifest.source_files.end()) : options.sources;
    if (SourceFiles::unchanged(manifest, files, why)) {
      sources_.emplace(manifest, files, with_albedo(), inserted_.has_value(), report);
    } else {
      stats_.positions_from_store = true;
      report.note(concat("export: ", why, ": positions come from the store, further properties of the input are left out"));
    }
    const bool wide = sources_ ? sources_->position_is_double() : extent_needs_double(manifest);
    const bool wide_colours = options.file.extension() == ".las" || options.file.extension() == ".LAS";  // its fields have 16 bits anyway
    rows_.emplace(wide, wide_colours, with_albedo(), inserted_.has_value(), sources_ ? sources_->carried() : std::vector<PointProperty>{});
    for (const std::uint64_t n : manifest.source_points) num_sources_ += n;
    num_sources_ = std::max(num_sources_, manifest.points_read);
  }

  ExportStats run(const std::filesystem::path& scratch) {
    const std::uint64_t share = budget_.free_bytes() / 4;
    const std::uint64_t per_bucket = std::clamp<std::uint64_t>(share / (sizeof(PointRecord) + rows_->row_bytes() + sizeof(std::uint32_t)), 1024, std::max<std::uint64_t>(1024, num_sources_));
    const std::uint64_t num_buckets = (num_sources_ + per_bucket - 1) / per_bucket;
    const auto buffer_records = static_cast<std::size_t>(std::clamp<std::uint64_t>(share / std::max<std::uint64_t>(1, num_buckets) / sizeof(PointRecord), 8, 4096));
    const ScratchFolder folder(scratch);
    Buckets buckets(folder.path() / "points.buckets", num_sources_, per_bucket, buffer_records);
    {
      const BudgetLease lease(budget_, num_buckets * buffer_records * sizeof(PointRecord), "buffers of the export");
      fill_buckets(buckets);
    }
    read_points_ = static_cast<std::size_t>(std::clamp<std::uint64_t>(share / (rows_->row_bytes() + kReadBytes), 256, kReadPoints));
    const BudgetLease lease(budget_, per_bucket * (sizeof(PointRecord) + sizeof(std::uint32_t)) + read_points_ * (rows_->row_bytes() + kReadBytes), "a bucket of the export");
    write_rows(buckets, per_bucket);
    if (stats_.points_moved > 0)
      report_.note(concat("export: ", stats_.points_moved, " points lie elsewhere in the store than in the source files (aligned scans): the stored positions are written"));
    return stats_;
  }

 private:
  bool with_albedo() const { return !options_.layer.empty(); }

  void fill_buckets(Buckets& buckets) {
    const LeafSource source(store_, options_);
    const auto& leaves = store_.leaves();
    std::uint32_t largest = 0;
    for (const std::uint32_t leaf : leaves) largest = std::max(largest, store_.chunks()[leaf].count);
    // a leaf: records, geometry, sources, values; with `fill` an inner node and its search tree beside it
    const std::uint64_t leaf_bytes = largest * (sizeof(PointRecord) + 12ull + 8 + 24) + (options_.fill ? stream::kMaxChunkSurfels * 80ull : 0);
    const std::size_t at_once = static_cast<std::size_t>(
        std::clamp<std::uint64_t>(budget_.free_bytes() / 2 / std::max<std::uint64_t>(1, leaf_bytes), 1, static_cast<std::uint64_t>(ThreadLimit::current())));
    const BudgetLease lease(budget_, at_once * leaf_bytes, "leaves of the export");
    report_.begin("export: collect", store_.manifest().points_stored, "points");
    std::uint64_t done = 0;
    for (std::size_t first = 0; first < leaves.size(); first += at_once) {
      report_.check();
      std::vector<LeafRecords> batch(std::min(at_once, leaves.size() - first));
      parallel_blocks(batch.size(), 1, [&](std::size_t b0, std::size_t b1) {
        for (std::size_t b = b0; b < b1; ++b) batch[b] = source.read(leaves[first + b]);
      });
      for (const LeafRecords& records : batch) {
        for (const PointRecord& r : records.points) buckets.add(r);
        stats_.points_unseen += records.unseen;
        stats_.points_filled += records.filled;
        done += records.points.size();
      }
      report_.progress(done);
    }
    buckets.flush_all();
    report_.end();
  }

  void write_rows(const Buckets& buckets, std::uint64_t per_bucket) {
    const stream::Manifest& manifest = store_.manifest();
    stream::PointWriterOptions writer_options;
    writer_options.num_points = manifest.points_stored + stats_.points_inserted;
    writer_options.properties = rows_->properties();
    writer_options.bounds = grown_bounds(manifest);
    if (inserted_) {
      const Box3d more = grown_bounds(inserted_->store->manifest());
      writer_options.bounds.extend(more.min);
      writer_options.bounds.extend(more.max);
    }
    if (with_albedo()) writer_options.comments.push_back(concat("layer ", options_.layer));
    const auto writer = stream::create_points(options_.file, writer_options);
    report_.begin("export: write", writer_options.num_points, "points");
    for (std::size_t b = 0; b < buckets.count(); ++b) {
      const std::vector<PointRecord> records = buckets.read(b);
      const std::uint64_t first = buckets.first_source(b), end = std::min(num_sources_, first + per_bucket);
      std::vector<std::uint32_t> place(static_cast<std::size_t>(end - first), kAbsent);
      for (std::size_t i = 0; i < records.size(); ++i) place[static_cast<std::size_t>(records[i].source - first)] = static_cast<std::uint32_t>(i);
      for (std::uint64_t at = first; at < end;) {
        report_.check();
        at += write_block(records, place, static_cast<std::size_t>(at - first), static_cast<std::size_t>(std::min<std::uint64_t>(read_points_, end - at)), *writer);
        report_.progress(stats_.points);
      }
    }
    if (inserted_) write_inserted(*writer);
    writer->commit();
    report_.end();
  }

  /// Writes up to `count` points from `offset` in the bucket; returns how many sources were passed.
  std::size_t write_block(const std::vector<PointRecord>& records, const std::vector<std::uint32_t>& place, std::size_t offset, std::size_t count, stream::PointWriter& writer) {
    const stream::PointBlock* block = sources_ ? &sources_->read(count) : nullptr;
    if (block) count = block->size();
    row_buffer_.resize(count * rows_->row_bytes());
    std::byte* at = row_buffer_.data();
    for (std::size_t i = 0; i < count; ++i) {
      if (place[offset + i] == kAbsent) continue;   // rejected at ingest
      const PointRecord& r = records[place[offset + i]];
      at = rows_->pack(r, position(r, block, i), 0, at);
      if (block) at = sources_->copy_carried(i, at);
    }
    const auto written = static_cast<std::size_t>(at - row_buffer_.data()) / rows_->row_bytes();
    writer.write(row_buffer_.data(), written);
    stats_.points += written;
    return count;
  }

  /// After all others, by leaf. What no photograph sees is no point.
  void write_inserted(stream::PointWriter& writer) {
    ExportOptions plain = options_;
    plain.fill = false;
    const LeafSource source(*inserted_->store, plain);
    for (const std::uint32_t leaf : inserted_->store->leaves()) {
      report_.check();
      const LeafRecords records = source.read(leaf);
      for (std::size_t first = 0; first < records.points.size(); first += read_points_) {
        const std::size_t end = std::min(records.points.size(), first + read_points_);
        row_buffer_.resize((end - first) * rows_->row_bytes());
        std::byte* at = row_buffer_.data();
        for (std::size_t i = first; i < end; ++i) {
          const PointRecord& r = records.points[i];
          if (r.photos > 0) at = rows_->pack_nothing_carried(rows_->pack(r, Vec3d(r.position[0], r.position[1], r.position[2]), 1, at));
        }
        const auto written = static_cast<std::size_t>(at - row_buffer_.data()) / rows_->row_bytes();
        writer.write(row_buffer_.data(), written);
        stats_.points += written;
      }
      report_.progress(stats_.points);
    }
  }

  Vec3d position(const PointRecord& r, const stream::PointBlock* block, std::size_t i) {
    const Vec3d stored(r.position[0], r.position[1], r.position[2]);
    if (!block) return stored;
    const Vec3d& exact = block->position[i];
    if ((exact - stored).cwiseAbs().maxCoeff() <= r.position_error) return exact;
    ++stats_.points_moved;
    return stored;
  }

  static constexpr std::uint32_t kAbsent = 0xffffffffu;
  const stream::Store& store_;
  const ExportOptions& options_;
  MemoryBudget& budget_;
  Reporter& report_;
  std::optional<InsertedPoints> inserted_;
  std::optional<SourceFiles> sources_;
  std::optional<RowPacker> rows_;
  std::uint64_t num_sources_ = 0;
  std::size_t read_points_ = kReadPoints;
  std::vector<std::byte> row_buffer_;
  ExportStats stats_;
};

}  // namespace

ExportStats export_points(const stream::Store& store, const ExportOptions& options, const std::filesystem::path& scratch, MemoryBudget& budget, Reporter& report) {
  if (!options.layer.empty() && !stream::has_layer(store, options.layer)) {
    std::string known;
    for (const std::string& name : stream::layer_names(store)) known += (known.empty() ? "" : ", ") + name;
    throw Error(concat(store.path().string(), ": has no layer \"", options.layer, "\" (layers: ", known.empty() ? "none" : known, ")"));
  }
  make_folder(scratch);
  return Exporter(store, options, budget, report).run(scratch);
}

}  // namespace chiaro::tools
