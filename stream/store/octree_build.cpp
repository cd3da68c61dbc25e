#include "stream/store/octree_build.h"

#include <algorithm>
#include <cmath>

#include "stream/base/disk_space.h"
#include "stream/base/error.h"
#include "stream/base/folder_lock.h"
#include "stream/base/hash.h"
#include "stream/base/parallel.h"
#include "stream/cloud/spool.h"
#include "stream/store/build_journal.h"
#include "stream/store/inner_levels.h"
#include "stream/store/layer.h"
#include "stream/store/leaf_build.h"
#include "stream/store/leaf_fit.h"
#include "stream/store/store_format.h"

namespace chiaro::stream {
namespace fs = std::filesystem;
namespace {

constexpr int kAlgorithmVersion = 10;     // part of the key: raise when the same input gives another store
constexpr std::size_t kBlockPoints = 65536;
constexpr std::uint64_t kMostPartitionPoints = 400'000;
constexpr double kMaxCoordinate = 1e9;    // project units
constexpr std::uint64_t kMaxPoints = std::uint64_t{1} << 40;
constexpr const char* kOutOfRange = "out of range";

/// Reads all clouds block by block, the next block while the current one is worked on.
template <class Body>
void for_each_block(const CloudInput& input, PointSpool& spool, PointSpool::Reading reading, MemoryBudget& budget, const Body& body) {
  const BudgetLease lease(budget, 2 * kBlockPoints * 64, "blocks of points");
  std::uint64_t first = 0;
  for (std::size_t cloud = 0; cloud < input.files.size(); ++cloud) {
    const auto reader = spool.open(cloud, reading, [&] { return input.open(cloud); });
    reader->wants(reading == PointSpool::Reading::kFirst ? PointParts::kPositions : PointParts::kNoExtras);
    PointBlock block, next;
    bool more = reader->read(block, kBlockPoints);
    while (more) {
      bool more_after = false;
      parallel_blocks(2, 1, [&](std::size_t task, std::size_t) {
        if (task == 0) more_after = reader->read(next, kBlockPoints);
        else body(cloud, reader->schema(), first, block);
      });
      first += block.size();
      std::swap(block, next);
      more = more_after;
    }
  }
}

class Builder {
 public:
  Builder(const CloudInput& input, const fs::path& out, const BuildOptions& options, MemoryBudget& budget, Reporter& report)
      : input_(input), out_(out), part_(out.string() + ".part"), spool_(part_), options_(options), budget_(budget), report_(report) {}

  Manifest run() {
    const std::string key = build_key(input_, options_);
    make_folder(part_);
    const FolderLock lock(part_);
    if (auto journal = read_journal(part_, key)) {
      b_ = std::move(*journal);
      if (b_.phase > BuildPhase::kStarted) report_.note(concat("going on with the build of ", out_.string(), " where it stopped"));
    } else {
      empty_folder(part_);   // not removed: it is what is locked
      b_.manifest.key = key;
    }
    if (b_.phase < BuildPhase::kSpilled) spill();
    if (b_.phase < BuildPhase::kLeaves) leaves();
    if (b_.phase < BuildPhase::kSurfels) surfels();
    if (b_.phase < BuildPhase::kInner) inner();
    if (b_.phase < BuildPhase::kLayers) layers();
    remove_leftovers();
    publish_folder(part_, out_);
    return b_.manifest;
  }

 private:
  void finish(BuildPhase phase) {
    b_.phase = phase;
    write_journal(part_, b_);
    report_.check();
  }

  // A store holds its own files only, wherever the build was killed before. The journal goes last.
  void remove_leftovers() const {
    const auto remove_others = [](const fs::path& folder, const auto& keep) {
      std::vector<fs::path> others;
      if (!fs::exists(folder)) return;
      for (const auto& entry : fs::directory_iterator(folder))
        if (!keep(entry.path())) others.push_back(entry.path());
      for (const fs::path& path : others) fs::remove_all(path);
    };
    remove_others(layers_path(part_), [](const fs::path& p) { return p.filename() == "input"; });
    const std::vector<fs::path> files{manifest_path(part_), index_path(part_), geometry_path(part_), source_path(part_), layers_path(part_)};
    remove_others(part_, [&](const fs::path& p) { return p.filename() == "journal.json" || std::find(files.begin(), files.end(), p) != files.end(); });
    remove_journal(part_);
  }

  // Reason to leave a point out, or null.
  const char* rejection(std::uint64_t number, const Vec3d& p) const {
    if (const char* why = why_unusable(p)) return why;
    if (p.cwiseAbs().maxCoeff() > kMaxCoordinate) return kOutOfRange;
    if (input_.rejected && input_.rejected(number)) return input_.rejected_reason.c_str();
    return nullptr;
  }

  void spill() {
    count();
    distribute();
    finish(BuildPhase::kSpilled);
  }

  void count() {
    Manifest& m = b_.manifest;
    m = Manifest{};
    m.key = build_key(input_, options_);
    m.unit = options_.unit;
    for (const auto& f : input_.files) m.source_files.push_back(f.string());
    m.source_fingerprints = input_.fingerprints;
    m.source_points.assign(input_.files.size(), 0);
    bool all_have_normals = true, one_lacks_normals = false, any_has_normals = false;
    CountGrid grid(budget_, budget_.limit_bytes() / 16);
    std::vector<Vec3d> accepted;
    report_.begin("count points", declared_points(), "points");
    std::map<std::string, std::uint64_t> rejected;
    for_each_block(input_, spool_, PointSpool::Reading::kFirst, budget_, [&](std::size_t cloud, const PointSchema& schema, std::uint64_t first, const PointBlock& block) {
      report_.check();
      if (first + block.size() > kMaxPoints) throw Error(concat("more than ", kMaxPoints, " points"));
      b_.has_colour = b_.has_colour || schema.has_colour;
      grids_.resize(input_.files.size());
      grids_[cloud] = schema.grid;
      colour_is_16_bit_ = colour_is_16_bit_ || schema.colour_is_16_bit;
      all_have_normals = all_have_normals && schema.has_normal;
      any_has_normals = any_has_normals || schema.has_normal;
      one_lacks_normals = one_lacks_normals || !schema.has_normal;
      accepted.clear();
      for (std::size_t i = 0; i < block.size(); ++i) {
        if (const char* reason = rejection(first + i, block.position[i])) ++rejected[reason];
        else accepted.push_back(block.position[i]);
      }
      grid.add(accepted);
      m.source_points[cloud] += block.size();
      m.points_read += block.size();
      report_.progress(m.points_read);
    });
    report_.end();
    m.points_rejected = rejected;
    m.points_stored = grid.points();
    if (m.points_stored == 0) throw Error(no_point_message());
    if ((options_.normals == NormalSource::kFile || options_.normals == NormalSource::kAxes) && one_lacks_normals) throw Error("normals = \"file\", but a cloud has no normals: use \"auto\" or \"estimate\"");
    m.normals_from_file = options_.normals != NormalSource::kEstimate && all_have_normals;
    has_normals_ = options_.normals != NormalSource::kEstimate && any_has_normals;
    bounds_extent_ = grid.bounds().max - grid.bounds().min;
    b_.root = grid.root();
    b_.typical_spacing = grid.typical_spacing();
    m.origin_in_world = b_.root.origin();
    m.edge = b_.root.edge();
    const auto cells = grid.cells(b_.root);
    const BudgetLease lease(budget_, cells.size() * sizeof(cells[0]), "counting grid");
    // Half a worker's room: the partitions of a build that is resumed with less memory should still fit. And no more than the processor's caches and the
    // allocator handle well.
    const std::uint64_t room = std::min(leaf_workers(budget_, options_.chunk_surfels).capacity / 2, kMostPartitionPoints);
    const std::uint64_t capacity = std::max<std::uint64_t>(room, options_.chunk_surfels);
    grid_level_ = grid.level(b_.root);
    b_.partitions = make_partitions(cells, grid_level_, options_.chunk_surfels, capacity);
  }

  std::uint64_t declared_points() const {
    std::uint64_t sum = 0;
    for (std::size_t i = 0; i < input_.files.size(); ++i) {
      const std::uint64_t n = input_.open(i)->schema().declared_points;
      if (n == 0 || n > kMaxPoints) return 0;  // a header is never trusted: this is for the progress bar only
      sum += n;
    }
    return sum;
  }

  std::string no_point_message() const {
    std::string text = concat("no usable point: ", b_.manifest.points_read, " read");
    for (const auto& [reason, n] : b_.manifest.points_rejected) text += concat(", ", n, " rejected (", reason, ")");
    for (const auto& f : input_.files) text += concat("; ", f.string());
    return text;
  }

  void distribute() {
    const std::uint64_t n = b_.manifest.points_stored;
    const std::uint64_t spill_bytes = n * spill_bytes_per_point(axis_bits(), b_.manifest.points_read, b_.has_colour, colour_is_16_bit_, has_normals_) + (std::uint64_t{4} << 20) + n / 8;
    const std::uint64_t store_bytes = n * (b_.has_colour ? 26 : 17) * 7 / 5;
    std::uint64_t free = free_disk_bytes(part_);
    if (free < spill_bytes + store_bytes) {
      spool_.drop();
      free = free_disk_bytes(part_);
    }
    report_.note(concat(n, " points: ", format_bytes(spill_bytes), " of disk while building, about ", format_bytes(store_bytes), " for the store"));
    require_disk_space(out_, "the build", spill_bytes + store_bytes, free);
    File file(part_ / "spill.bin", File::Mode::kCreate);
    file.reserve(spill_bytes);
    SpillWriter writer(file, b_.root, b_.partitions, 0, budget_, budget_.free_bytes() / 4);
    std::vector<SpillPoint> points(kBlockPoints);
    std::vector<std::uint32_t> partition(kBlockPoints);
    constexpr std::uint32_t kRejected = 0xffffffffu;
    b_.estimated_normals = 0;
    report_.begin("distribute points", b_.manifest.points_read, "points");
    for_each_block(input_, spool_, PointSpool::Reading::kSecond, budget_, [&](std::size_t cloud, const PointSchema& schema, std::uint64_t first, const PointBlock& block) {
      report_.check();
      const PositionGrid* grid = grids_[cloud] ? &*grids_[cloud] : nullptr;
      const Vec3d inverse = grid ? Vec3d(grid->scale.cwiseInverse()) : Vec3d::Zero();
      parallel_blocks(block.size(), 4096, [&](std::size_t begin, std::size_t end) {
        for (std::size_t i = begin; i < end; ++i) {
          if (rejection(first + i, block.position[i])) {
            partition[i] = kRejected;
            continue;
          }
          points[i] = make_point(schema, grid, inverse, first + i, block, i);
          const auto q = b_.root.quantise(block.position[i]);
          partition[i] = static_cast<std::uint32_t>(writer.partition_of(cell_of_partitions(q)));
          if (!points[i].grid) points[i].place = {static_cast<std::int64_t>(q[0]), static_cast<std::int64_t>(q[1]), static_cast<std::int64_t>(q[2])};
        }
      });
      for (std::size_t i = 0; i < block.size(); ++i) {
        if (partition[i] == kRejected) continue;
        b_.estimated_normals += !points[i].has_normal;
        writer.append(partition[i], points[i]);
      }
      report_.progress(first + block.size());
    });
    b_.spill_bytes = writer.finish();
    file.truncate(b_.spill_bytes);
    file.sync();
    report_.end();
    if (options_.normals != NormalSource::kEstimate && b_.manifest.normals_from_file && b_.estimated_normals > 0)
      report_.note(concat(b_.estimated_normals, " points have a zero or damaged normal: estimated instead"));
  }

  // Bits of the three coordinates of a point in the spill file, at most.
  int axis_bits() const {
    int most = 0;
    for (std::size_t cloud = 0; cloud < grids_.size(); ++cloud) {
      const std::optional<PositionGrid>& grid = grids_[cloud];
      int sum = 0;
      if (b_.manifest.source_points[cloud] == 0) continue;
      for (int a = 0; a < 3; ++a) {
        const double steps = grid ? bounds_extent_[a] / std::abs(grid->scale[a]) + 2 : 1e18;
        sum += std::min(kAxisBits, static_cast<int>(std::ceil(std::log2(steps))));
      }
      most = std::max(most, sum);
    }
    return most;
  }

  // First level-21 cell of the cell of the counting grid: partitions are made of such.
  std::uint64_t cell_of_partitions(const std::array<std::uint64_t, 3>& q) const {
    const int shift = kAxisBits - grid_level_, up = 3 * (kMaxLevel - grid_level_);
    if (grid_level_ > ShortMorton::kBits) return morton_encode(q[0] >> shift, q[1] >> shift, q[2] >> shift) << up;
    return morton_.encode(q[0] >> shift, q[1] >> shift, q[2] >> shift) << up;
  }

  SpillPoint make_point(const PointSchema& schema, const PositionGrid* grid, const Vec3d& inverse, std::uint64_t number, const PointBlock& block, std::size_t i) const {
    SpillPoint p;
    if (grid) {
      const Vec3d k = ((block.position[i] - grid->add).array() * inverse.array()).matrix();
      if (k.cwiseAbs().maxCoeff() < 0x1p40) {
        for (std::size_t a = 0; a < 3; ++a) p.place[a] = static_cast<std::int64_t>(k[static_cast<int>(a)] + (k[static_cast<int>(a)] < 0 ? -0.5 : 0.5));
        if (grid->position(p.place) == block.position[i]) p.grid = grid;
      }
    }
    p.source = number;
    if (schema.has_normal && options_.normals != NormalSource::kEstimate) {
      const Vec3d normal = block.normal[i].cast<double>();
      const double length = normal.norm();
      if (std::isfinite(length) && length > 1e-20) {
        p.normal = encode_normal((normal / length).cast<float>());
        p.has_normal = true;
      }
    }
    if (schema.has_colour) p.colour = block.colour[i];
    return p;
  }

  void leaves() {
    {
      File spill(part_ / "spill.bin", File::Mode::kReadWrite);
      File geometry(geometry_path(part_), File::Mode::kCreate), source(source_path(part_), File::Mode::kCreate), colour;
      if (b_.has_colour) colour = File(part_ / "colour.bin", File::Mode::kCreate);
      const LeafRules rules{options_.chunk_surfels, b_.root.edge(), b_.typical_spacing / 16, options_.normals == NormalSource::kNone, options_.normals != NormalSource::kAxes};
      report_.begin("sort points", b_.manifest.points_stored, "points");
      const auto leaf_entries = build_leaves(spill, b_.spill_bytes, b_.root, b_.partitions, rules, {geometry, source, b_.has_colour ? &colour : nullptr}, budget_, report_);
      report_.end();
      b_.leaf_geometry_end = 0;
      b_.manifest.bounds = Box3d{};
      for (const ChunkEntry& e : leaf_entries) {
        b_.leaf_geometry_end = std::max(b_.leaf_geometry_end, e.offset + aligned(geometry_bytes(e.count)));
        const Box3d box = tight_box(frame_of(b_.manifest, e), e);
        b_.manifest.bounds.extend(box.min);
        b_.manifest.bounds.extend(box.max);
      }
      write_index(part_ / "leaves.bin", link_index(leaf_entries));
      geometry.sync();
      source.sync();
      if (b_.has_colour) colour.sync();
    }
    finish(BuildPhase::kLeaves);
    fs::remove(part_ / "spill.bin");
  }

  static std::uint64_t aligned(std::uint64_t bytes) { return (bytes + kChunkAlignment - 1) / kChunkAlignment * kChunkAlignment; }

  static std::vector<std::uint32_t> leaves_of(const std::vector<ChunkEntry>& entries) {
    std::vector<std::uint32_t> leaves;
    for (std::uint32_t i = 0; i < entries.size(); ++i)
      if (entries[i].is_leaf()) leaves.push_back(i);
    std::sort(leaves.begin(), leaves.end(), [&](std::uint32_t a, std::uint32_t b) { return entries[a].offset < entries[b].offset; });
    return leaves;
  }

  // One phase: radii take the place of what refined normals are made from, and a block may have been written in part.
  void surfels() {
    if (options_.normals != NormalSource::kNone) {
      std::vector<ChunkEntry> entries = read_index(part_ / "leaves.bin");
      const auto leaves = leaves_of(entries);
      const BudgetLease lease(budget_, entries.size() * (sizeof(ChunkEntry) + 4), "index");
      File geometry(geometry_path(part_), File::Mode::kReadWrite);
      const FitJob job{geometry, b_.manifest, entries, leaves, b_.typical_spacing, options_.estimate_radius_spacings};
      if (b_.estimated_normals > 0) {
        fit_normals(job, budget_, report_);
        refine_normals(job, budget_, report_);
      }
      fit_radii(job, budget_, report_);
      geometry.sync();
      write_index(part_ / "leaves.bin", entries);
    }
    finish(BuildPhase::kSurfels);
  }

  void inner() {
    std::vector<ChunkEntry> entries = read_index(part_ / "leaves.bin");
    const BudgetLease lease(budget_, entries.size() * sizeof(ChunkEntry), "index");
    File geometry(geometry_path(part_), File::Mode::kReadWrite);
    geometry.truncate(b_.leaf_geometry_end);
    build_inner_levels(geometry, b_.leaf_geometry_end, b_.manifest, entries, options_.chunk_surfels, budget_, report_);
    geometry.sync();
    b_.manifest.surfels_inner = 0;
    for (const ChunkEntry& e : entries)
      if (!e.is_leaf()) b_.manifest.surfels_inner += e.count;
    write_index(index_path(part_), entries);
    write_sealed(manifest_path(part_), manifest_text(b_.manifest));
    finish(BuildPhase::kInner);
  }

  void layers() {
    if (b_.has_colour) {
      const Store store(part_);
      LayerWriter writer(store, "input", input_fields(), R"({"method": "colour of the input files"})");
      {
        const File colour(part_ / "colour.bin", File::Mode::kRead);
        const std::vector<std::uint32_t>& leaves = store.leaves();
        parallel_blocks(leaves.size(), 8, [&](std::size_t begin, std::size_t end) {
          for (std::size_t i = begin; i < end; ++i) {
            const ChunkEntry& e = store.chunks()[leaves[i]];
            std::vector<std::uint16_t> planar(3ull * e.count);  // as encode_leaf wrote it
            colour.read_at(e.source_offset / kSourceBytes * 6, planar.data(), 6ull * e.count);
            writer.write_chunk(leaves[i], std::as_bytes(std::span(planar)));
          }
        });
      }
      writer.finish_inner(report_);
      writer.commit();
    }
    finish(BuildPhase::kLayers);
    fs::remove(part_ / "colour.bin");
  }

  const CloudInput& input_;
  fs::path out_, part_;
  PointSpool spool_;   // for the second reading of formats that are slow to decode
  const BuildOptions& options_;
  MemoryBudget& budget_;
  Reporter& report_;
  BuildJournal b_;
  std::vector<std::optional<PositionGrid>> grids_;   // of the clouds, as the count saw them
  Vec3d bounds_extent_ = Vec3d::Zero();
  int grid_level_ = 0;                               // of the cells that partitions are made of
  ShortMorton morton_;
  bool colour_is_16_bit_ = false, has_normals_ = false;
};

CloudInput input_from(const std::vector<fs::path>& files, std::uint64_t memory_bytes) {
  CloudInput input;
  for (const fs::path& f : files) {
    input.files.push_back(fs::absolute(f));
    input.fingerprints.push_back(file_fingerprint(f));
  }
  input.open = [files, memory_bytes](std::size_t i) { return open_points(files[i], memory_bytes); };
  return input;
}

}  // namespace

void BuildOptions::validate() const {
  if (!(estimate_radius_spacings >= 1.5 && estimate_radius_spacings <= 10)) throw std::invalid_argument("estimate_radius_spacings must be in 1.5 .. 10");
  if (chunk_surfels < 16 || chunk_surfels > kMaxChunkSurfels) throw std::invalid_argument("chunk_surfels must be in 16 .. 65536");
  if (unit.empty()) throw std::invalid_argument("unit must not be empty");
}

std::string build_key(const CloudInput& input, const BuildOptions& options) {
  Hasher h;
  h.add("chiaro store").add(static_cast<std::uint64_t>(kFormatVersion)).add(static_cast<std::uint64_t>(kAlgorithmVersion));
  h.add(static_cast<std::uint64_t>(input.fingerprints.size()));
  for (const std::string& f : input.fingerprints) h.add(f);
  h.add(input.filter_key).add(options.unit).add(static_cast<std::uint64_t>(options.normals)).add(options.estimate_radius_spacings);
  h.add(static_cast<std::uint64_t>(options.chunk_surfels));
  return h.hex();
}

std::string build_key(const std::vector<fs::path>& files, const BuildOptions& options) { return build_key(input_from(files, 0), options); }

Manifest build_store_from(const CloudInput& input, const fs::path& out, const BuildOptions& options, MemoryBudget& budget, Reporter& report) {
  options.validate();
  if (input.files.empty() || input.files.size() != input.fingerprints.size()) throw std::invalid_argument("one fingerprint a cloud, and at least one cloud");
  return Builder(input, out, options, budget, report).run();
}

Manifest build_store(const std::vector<fs::path>& files, const fs::path& out, const BuildOptions& options, MemoryBudget& budget, Reporter& report) {
  if (files.empty()) throw Error("no point files given");
  return build_store_from(input_from(files, budget.free_bytes() / 4), out, options, budget, report);
}

}  // namespace chiaro::stream
