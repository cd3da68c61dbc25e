#include "tools/export_points.h"

#include <sys/stat.h>

#include <algorithm>
#include <cmath>
#include <limits>
#include <optional>
#include <vector>

#include "stream/base/disk_space.h"
#include "stream/base/error.h"
#include "stream/base/file.h"
#include "stream/base/parallel.h"
#include "stream/base/text.h"
#include "stream/cloud/point_stream.h"
#include "stream/store/layer.h"
#include "tools/export_records.h"
#include "tools/export_rows.h"
#include "tools/inserted_points.h"
#include "tools/source_files.h"

namespace chiaro::tools {
namespace {

constexpr std::uint64_t kMostInBucket = 0xfffffffeu;
constexpr std::size_t kReadPoints = 16384, kReadBytes = 256;   // points read at once, and what a reader holds for each

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

bool on_one_disk(const std::filesystem::path& a, const std::filesystem::path& b) {
  struct stat in_a {}, in_b {};
  return ::stat(a.c_str(), &in_a) == 0 && ::stat(b.c_str(), &in_b) == 0 && in_a.st_dev == in_b.st_dev;
}

/// The input of a run is not replaced by its result, which may lack what was rejected and names that the format has not.
void refuse_sources(const stream::Store& store, const ExportOptions& options) {
  std::vector<std::filesystem::path> sources(store.manifest().source_files.begin(), store.manifest().source_files.end());
  sources.insert(sources.end(), options.sources.begin(), options.sources.end());
  for (const std::filesystem::path& source : sources)
    if (std::error_code code; std::filesystem::equivalent(options.file, source, code))
      throw Error(concat(options.file.string(), ": is a source file of ", store.path().string(), ", it is not written over; choose another name"));
}

class Exporter {
 public:
  Exporter(const stream::Store& store, const ExportOptions& options, MemoryBudget& budget, Reporter& report)
      : store_(store), options_(options), budget_(budget), report_(report) {
    const stream::Manifest& manifest = store.manifest();
    if (with_albedo()) inserted_ = open_inserted(store, options.layer);
    if (inserted_) stats_.points_inserted = inserted_->seen();
    open_sources();
    const bool wide_colours = lower_extension(options.file) == ".las";  // its fields have 16 bits anyway
    rows_.emplace(positions_are_double(), wide_colours, with_albedo(), inserted_.has_value(), sources_ ? sources_->carried() : std::vector<stream::PointProperty>{});
    for (const std::uint64_t n : manifest.source_points) num_sources_ += n;
    num_sources_ = std::max(num_sources_, manifest.points_read);
  }

  ExportStats run(const std::filesystem::path& scratch) {
    require_space(scratch);
    const std::uint64_t share = budget_.free_bytes() / 4;
    const std::uint64_t per_bucket = std::clamp<std::uint64_t>(share / (sizeof(PointRecord) + rows_->row_bytes() + sizeof(std::uint32_t)), 1024, std::clamp<std::uint64_t>(num_sources_, 1024, kMostInBucket));
    const std::uint64_t num_buckets = (num_sources_ + per_bucket - 1) / per_bucket;
    const auto buffer_records = static_cast<std::size_t>(std::clamp<std::uint64_t>(share / std::max<std::uint64_t>(1, num_buckets) / sizeof(PointRecord), 8, 4096));
    const ScratchFolder folder(scratch);
    RecordBuckets buckets(folder.path() / "points.buckets", num_sources_, per_bucket, buffer_records);
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

  /// Most programs that read PCD take single precision alone.
  bool positions_are_double() const {
    const bool needed = extent_needs_double(store_.manifest());
    if (lower_extension(options_.file) != ".pcd") return sources_ ? sources_->position_is_double() : needed;
    if (!needed || (sources_ && !sources_->position_is_double())) return false;
    report_.note("export: the positions are too far from the origin for single precision and are written as double, which many programs do not read from PCD: PLY or LAS is safer");
    return true;
  }

  /// What cannot be read again does not stand in the way of the result.
  void open_sources() {
    const std::vector<std::string>& then = store_.manifest().source_files;
    const std::vector<std::filesystem::path> files = options_.sources.empty() ? std::vector<std::filesystem::path>(then.begin(), then.end()) : options_.sources;
    std::string why;
    if (SourceFiles::unchanged(store_.manifest(), files, why)) {
      std::vector<std::string> ours{"x", "y", "z", "nx", "ny", "nz", "red", "green", "blue"};
      if (with_albedo()) ours.insert(ours.end(), {"albedo_r", "albedo_g", "albedo_b", "sigma", "photos"});
      if (inserted_) ours.push_back("inserted");
      try {
        sources_.emplace(store_.manifest(), files, SourceFiles::Carry{ours, lower_extension(options_.file) != ".ply"}, budget_.free_bytes() / 2, report_);
        return;
      } catch (const Error& e) {
        why = e.what();
      }
    }
    stats_.positions_from_store = true;
    report_.note(concat("export: ", why, ": positions come from the store, further properties of the input are left out"));
  }

  /// A disk that is too small is met now and not hours later.
  void require_space(const std::filesystem::path& scratch) const {
    const std::uint64_t points = store_.manifest().points_stored, result = (points + stats_.points_inserted) * rows_->row_bytes(), records = points * sizeof(PointRecord);
    const std::filesystem::path folder = options_.file.has_parent_path() ? options_.file.parent_path() : ".";
    const auto require = [&](const std::filesystem::path& where, std::uint64_t bytes) { require_disk_space(where, "the export", bytes, options_.free_bytes(where)); };
    if (on_one_disk(scratch, folder)) return require(folder, records + result);
    require(scratch, records);
    require(folder, result);
  }

  void fill_buckets(RecordBuckets& buckets) {
    const LeafSource source(store_, options_.layer, options_.fill);
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
        for (std::size_t i = 0; i < records.points.size(); ++i) buckets.add(records.sources[i], records.points[i]);
        stats_.points_unseen += records.unseen;
        stats_.points_filled += records.filled;
        done += records.points.size();
      }
      report_.progress(done);
    }
    buckets.flush_all();
    report_.end();
  }

  void write_rows(const RecordBuckets& buckets, std::uint64_t per_bucket) {
    const stream::Manifest& manifest = store_.manifest();
    stream::PointWriterOptions writer_options;
    writer_options.num_points = manifest.points_stored + stats_.points_inserted;
    writer_options.properties = rows_->properties();
    writer_options.bounds = grown_bounds(manifest);
    if (sources_ && !inserted_) {
      writer_options.resolution = sources_->position_step();
      writer_options.grid = sources_->position_grid();
    }
    if (sources_) writer_options.coordinate_system = sources_->coordinate_system();
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
      for (std::size_t i = 0; i < records.size(); ++i) place[records[i].source] = static_cast<std::uint32_t>(i);
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
      at = rows_->pack(r, position(r, block ? &block->position[i] : nullptr), 0, at);
      if (block) at = sources_->copy_carried(i, at);
    }
    const auto written = static_cast<std::size_t>(at - row_buffer_.data()) / rows_->row_bytes();
    writer.write(row_buffer_.data(), written);
    stats_.points += written;
    return count;
  }

  /// After all others, by leaf. What no photograph sees is no point.
  void write_inserted(stream::PointWriter& writer) {
    const LeafSource source(*inserted_->store, options_.layer, false);
    for (const std::uint32_t leaf : inserted_->store->leaves()) {
      report_.check();
      const LeafRecords records = source.read(leaf);
      for (std::size_t first = 0; first < records.points.size(); first += read_points_) {
        const std::size_t end = std::min(records.points.size(), first + read_points_);
        row_buffer_.resize((end - first) * rows_->row_bytes());
        std::byte* at = row_buffer_.data();
        for (std::size_t i = first; i < end; ++i) {
          const PointRecord& r = records.points[i];
          if (r.photos > 0) at = rows_->pack_nothing_carried(rows_->pack(r, stored_position(*inserted_->store, r), 1, at));
        }
        const auto written = static_cast<std::size_t>(at - row_buffer_.data()) / rows_->row_bytes();
        writer.write(row_buffer_.data(), written);
        stats_.points += written;
      }
      report_.progress(stats_.points);
    }
  }

  static Vec3d stored_position(const stream::Store& store, const PointRecord& r) {
    const stream::ChunkFrame frame = store.frame(r.leaf);
    return frame.origin_in_world + frame.step * Vec3d(r.position[0] + 0.5, r.position[1] + 0.5, r.position[2] + 0.5);
  }

  /// exact: in the source file, null where that is not read. Stored positions are within two steps of it, unless the scan was moved.
  Vec3d position(const PointRecord& r, const Vec3d* exact) {
    const Vec3d stored = stored_position(store_, r);
    if (!exact) return stored;
    if ((*exact - stored).cwiseAbs().maxCoeff() <= 2 * store_.frame(r.leaf).step) return *exact;
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
  refuse_sources(store, options);
  make_folder(scratch);
  return Exporter(store, options, budget, report).run(scratch);
}

}  // namespace chiaro::tools
