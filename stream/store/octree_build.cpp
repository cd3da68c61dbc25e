#include "stream/store/octree_build.h"

#include <algorithm>
#include <cmath>

#include "stream/base/error.h"
#include "stream/base/folder_lock.h"
#include "stream/base/hash.h"
#include "stream/base/parallel.h"
#include "stream/store/build_journal.h"
#include "stream/store/inner_levels.h"
#include "stream/store/layer.h"
#include "stream/store/leaf_build.h"
#include "stream/store/leaf_fit.h"
#include "stream/store/spill_points.h"
#include "stream/store/store_format.h"

namespace chiaro::stream {
namespace fs = std::filesystem;
namespace {

constexpr int kAlgorithmVersion = 10;     // part of the key: raise when the same input gives another store

class Builder {
 public:
  Builder(const CloudInput& input, const fs::path& out, const BuildOptions& options, MemoryBudget& budget, Reporter& report)
      : input_(input), out_(out), part_(out.string() + ".part"), options_(options), budget_(budget), report_(report) {}

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
    if (b_.phase < BuildPhase::kSpilled) {
      spill_points(input_, part_, out_, options_, budget_, report_, b_);
      finish(BuildPhase::kSpilled);
    }
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
  const BuildOptions& options_;
  MemoryBudget& budget_;
  Reporter& report_;
  BuildJournal b_;
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
