#include "stream/store/repair.h"

#include <algorithm>
#include <atomic>
#include <optional>

#include "stream/base/error.h"
#include "stream/base/hash.h"
#include "stream/base/parallel.h"
#include "stream/store/checksum_repair.h"
#include "stream/store/index_repair.h"
#include "stream/store/inner_levels.h"
#include "stream/store/layer.h"
#include "stream/store/layer_repair.h"
#include "stream/store/store_format.h"

namespace chiaro::stream {
namespace fs = std::filesystem;
namespace {

class StoreRepairer {
 public:
  StoreRepairer(const fs::path& path, MemoryBudget& budget, Reporter& report) : path_(path), budget_(budget), report_(report) {}

  RepairResult run() {
    if (!fs::is_directory(path_)) throw Error(concat(path_.string(), ": no such store (expected a folder with manifest.json)"));
    read_manifest();
    const bool has_index = repair_index();
    repair_manifest();
    if (has_index) {
      const BudgetLease lease(budget_, entries_.size() * (sizeof(ChunkEntry) + sizeof(State)), "index");
      state_.assign(entries_.size(), State::kWhole);
      look_at_chunks();
      repair_geometry();
      look_at_sources();
      repair_layers();
    }
    if (result_.points_lost > 0) advise_ingest(concat(result_.points_lost, " points are lost"));
    return std::move(result_);
  }

 private:
  enum class State : std::uint8_t { kWhole, kDamaged, kWrongBounds };

  void repaired(const fs::path& file, const std::string& what) { add_line(result_.repaired, concat(file.string(), ": ", what)); }

  void advise_ingest(const std::string& why) {
    std::string files;
    if (manifest_)
      for (const std::string& f : manifest_->source_files) files += (files.empty() ? "" : ", ") + f;
    add_line(result_.advice, concat(why, ": ingest again from ", files.empty() ? "the source files" : files, ", then make the layers again"));
  }

  // Manifest

  // Whole as it is, or after its checksum has told the damaged byte.
  void read_manifest() {
    const fs::path path = manifest_path(path_);
    try {
      manifest_on_disk_ = read_text(path);
      if (const auto whole = repair_sealed(manifest_on_disk_)) manifest_ = parse_manifest(path, *whole);
    } catch (const Error&) {
    }
  }

  void repair_manifest() {
    const fs::path path = manifest_path(path_);
    const bool sealed = manifest_.has_value();
    try {
      if (!sealed) manifest_ = parse_manifest(path, manifest_on_disk_);
    } catch (const Error&) {
    }
    if (manifest_ && !entries_.empty()) set_totals();
    const std::string made = manifest_ ? sealed_text(manifest_text(*manifest_)) : std::string();
    const std::size_t seal = seal_of("").size();
    // Members that were damaged beyond one byte: their true values must give the checksum that stands there.
    const bool proven = sealed || (manifest_ && manifest_on_disk_.size() > seal && made.ends_with(std::string_view(manifest_on_disk_).substr(manifest_on_disk_.size() - seal)));
    if (!proven) {
      manifest_.reset();
      add_line(result_.lost, concat(path.string(), ": damaged in more than one place: place and size of the root cell cannot be told"));
      advise_ingest("without its manifest the store cannot be read");
    } else if (made != manifest_on_disk_) {
      write_text(path, made);
      manifest_on_disk_ = made;
      repaired(path, "damaged text put right, as its checksum and the index say");
    }
  }

  // What follows from the index.
  void set_totals() {
    Manifest& m = *manifest_;
    m.points_stored = m.surfels_inner = 0;
    m.bounds = Box3d{};
    std::uint64_t rejected = 0, per_file = 0;
    for (const ChunkEntry& e : entries_) {
      (e.is_leaf() ? m.points_stored : m.surfels_inner) += e.count;
      if (!e.is_leaf()) continue;
      const Box3d box = tight_box(frame_of(m, e), e);
      m.bounds.extend(box.min);
      m.bounds.extend(box.max);
    }
    for (const auto& [reason, count] : m.points_rejected) rejected += count;
    for (const std::uint64_t n : m.source_points) per_file += n;
    if (per_file == m.points_stored + rejected) m.points_read = per_file;
  }

  // Index

  bool repair_index() {
    std::error_code missing;
    const std::uintmax_t size = fs::file_size(index_path(path_), missing);
    const BudgetLease lease(budget_, missing ? 0 : 3 * size, "index");   // too little memory is no loss
    RepairedIndex index;
    try {
      index = repaired_index(path_, manifest_, report_);
    } catch (const Error& e) {
      add_line(result_.lost, e.what());
      advise_ingest("without its index the store cannot be read");
      return false;
    }
    entries_ = std::move(index.entries);
    if (index.change.empty()) return true;
    write_index(index_path(path_), entries_);
    repaired(index_path(path_), index.change);
    return true;
  }

  // Geometry

  void look_at_chunks() {
    const fs::path path = geometry_path(path_);
    if (fs::is_regular_file(path)) geometry_ = File(path, File::Mode::kRead);
    report_.begin("check geometry", entries_.size(), "chunks");
    std::vector<std::uint8_t> gaps(entries_.size());
    std::atomic<std::uint64_t> done{0};
    parallel_blocks(entries_.size(), 16, [&](std::size_t begin, std::size_t end) {
      report_.check();
      for (std::size_t i = begin; i < end; ++i) look_at_chunk(i, gaps[i]);
      report_.progress(done += end - begin);
    });
    report_.end();
    for (std::size_t i = 0; i < gaps.size(); ++i)
      if (gaps[i]) gaps_.push_back(static_cast<std::uint32_t>(i));
    bool any = false;
    for (std::size_t i = 0; i < entries_.size(); ++i) {
      any = any || state_[i] == State::kWrongBounds;
      if (state_[i] == State::kWrongBounds) state_[i] = State::kWhole;
      if (state_[i] == State::kDamaged && entries_[i].is_leaf()) lose_leaf(path, i, "");
    }
    if (!any) return;
    write_index(index_path(path_), entries_);
    repaired(index_path(path_), "bounds taken from the geometry");
    repair_manifest();
  }

  void look_at_chunk(std::size_t i, std::uint8_t& gap) {
    ChunkEntry& e = entries_[i];
    if (!geometry_.is_open() || e.offset > size_of_geometry() || geometry_bytes(e.count) > size_of_geometry() - e.offset) {
      state_[i] = State::kDamaged;
      return;
    }
    const std::vector<SurfelBlock> blocks = read_blocks(geometry_, e);
    if (crc32c(blocks.data(), geometry_bytes(e.count)) != e.geometry_crc) state_[i] = State::kDamaged;
    gap = byte_behind(geometry_, e).has_value();
    if (state_[i] == State::kDamaged) return;
    const ChunkEntry before = e;
    set_tight_bounds(e, blocks);
    if (before.tight_min != e.tight_min || before.tight_max != e.tight_max) state_[i] = State::kWrongBounds;
  }

  std::uint64_t size_of_geometry() const { return geometry_.is_open() ? geometry_.size() : 0; }

  void lose_leaf(const fs::path& file, std::size_t i, const char* what) {
    const ChunkEntry& e = entries_[i];
    result_.points_lost += e.count;
    add_line(result_.lost, concat(file.string(), ": chunk ", i, ", a leaf of level ", int{e.level}, ": ", what, e.count, " points are lost"));
  }

  void repair_geometry() {
    if (!geometry_.is_open()) {
      add_line(result_.lost, concat(geometry_path(path_).string(), ": is missing"));
      return;
    }
    const std::uint64_t size = geometry_file_bytes(entries_);
    std::vector<std::uint32_t> damaged;  // inner nodes, deepest first
    for (std::size_t i = entries_.size(); i-- > 0;)
      if (state_[i] == State::kDamaged && !entries_[i].is_leaf()) damaged.push_back(static_cast<std::uint32_t>(i));
    if (damaged.empty() && gaps_.empty() && size_of_geometry() == size) return;
    if (!manifest_) return;
    if (chunks_overlap()) {
      add_line(result_.lost, concat(index_path(path_).string(), ": chunks lie over each other in geometry.bin"));
      return advise_ingest("the index is wrong");
    }
    AtomicFile out(geometry_.path());
    copy_for_repair(geometry_, size, out, report_);
    for (const std::uint32_t i : gaps_) {
      const std::uint64_t begin = entries_[i].offset + geometry_bytes(entries_[i].count), end = std::min(size, aligned_end(entries_[i]));
      const std::vector<char> zeros(begin < end ? end - begin : 0);
      out.file().write_at(begin, zeros.data(), zeros.size());
    }
    std::size_t made = 0;
    report_.begin("rebuild inner levels", damaged.size(), "chunks");
    for (const std::uint32_t i : damaged) {
      report_.check();
      made += make_node(out.file(), i);
      report_.progress(made);
    }
    report_.end();
    if (made == 0 && gaps_.empty() && size_of_geometry() == size) return;
    out.commit();
    if (made > 0) repaired(geometry_.path(), concat(made, made == 1 ? " inner chunk" : " inner chunks", " made anew from the leaves"));
    if (!gaps_.empty()) repaired(geometry_.path(), concat("bytes behind ", gaps_.size(), gaps_.size() == 1 ? " chunk" : " chunks", " set to zero"));
    if (size_of_geometry() != size) repaired(geometry_.path(), concat(size_of_geometry(), " bytes long, now ", size));
    geometry_ = File(geometry_path(path_), File::Mode::kRead);
  }

  // Then nothing that is written for one chunk is safe for the other.
  bool chunks_overlap() const {
    std::vector<std::pair<std::uint64_t, std::uint64_t>> places;
    for (const ChunkEntry& e : entries_) places.emplace_back(e.offset, aligned_end(e));
    std::sort(places.begin(), places.end());
    for (std::size_t i = 1; i < places.size(); ++i)
      if (places[i].first < places[i - 1].second) return true;
    return false;
  }

  bool make_node(File& file, std::uint32_t i) {
    InnerNode node;
    try {
      node = make_inner_node(*manifest_, entries_, entries_[i], [&](std::uint32_t child) { return child_blocks(file, child); }, kMaxChunkSurfels,
                             static_cast<int>(entries_[i].source_offset));
      if (node.entry.count != entries_[i].count || node.entry.geometry_crc != entries_[i].geometry_crc)
        throw Error("its children give other surfels than its checksum says: another version made them");
    } catch (const Error& e) {
      add_line(result_.lost, concat(geometry_.path().string(), ": inner chunk ", i, ": ", e.what()));
      advise_ingest("inner levels are lost");
      return false;
    }
    file.write_at(entries_[i].offset, node.blocks.data(), geometry_bytes(node.entry.count));
    state_[i] = State::kWhole;
    return true;
  }

  std::vector<SurfelBlock> child_blocks(const File& file, std::uint32_t child) const {
    if (state_[child] == State::kDamaged) throw Error(concat("its child ", child, " is damaged"));
    return read_blocks(file, entries_[child]);
  }

  // Sources and layers

  void look_at_sources() {
    const fs::path path = source_path(path_);
    File file;
    if (fs::is_regular_file(path)) file = File(path, File::Mode::kRead);
    else add_line(result_.lost, concat(path.string(), ": is missing"));
    std::vector<std::uint8_t> bad(entries_.size());
    parallel_blocks(entries_.size(), 64, [&](std::size_t begin, std::size_t end) {
      report_.check();
      for (std::size_t i = begin; i < end; ++i)
        bad[i] = entries_[i].is_leaf() && checksum_at(file, entries_[i].source_offset, kSourceBytes * entries_[i].count) != entries_[i].source_crc;
    });
    std::uint64_t end_of_sources = 0;
    for (std::size_t i = 0; i < bad.size(); ++i) {
      if (entries_[i].is_leaf()) end_of_sources = std::max(end_of_sources, entries_[i].source_offset + kSourceBytes * entries_[i].count);
      if (!bad[i]) continue;
      if (state_[i] == State::kDamaged) result_.points_lost -= entries_[i].count;  // counted already
      lose_leaf(path, i, "the source indices of ");
    }
    if (!file.is_open() || file.size() <= end_of_sources) return;
    AtomicFile out(path);
    copy_for_repair(file, end_of_sources, out, report_);
    out.commit();
    repaired(path, "what stood behind the end removed");
  }

  void repair_layers() {
    if (!manifest_) return;
    std::vector<std::string> names;
    std::error_code code;
    for (fs::directory_iterator it(layers_path(path_), code), end; !code && it != end; it.increment(code)) {
      const std::string name = it->path().filename().string();
      if (fs::is_directory(it->path(), code) && !name.ends_with(".part") && !name.ends_with(".old")) names.push_back(name);
    }
    std::sort(names.begin(), names.end());
    try {
      const Store store(path_);
      for (const std::string& name : names) repair_layer(store, name, result_, report_);
    } catch (const NoRoom&) {
      throw;
    } catch (const Error& e) {
      if (!names.empty()) add_line(result_.lost, concat("layers are not looked at: ", e.what()));
    }
  }

  fs::path path_;
  MemoryBudget& budget_;
  Reporter& report_;
  RepairResult result_;
  std::string manifest_on_disk_;
  std::optional<Manifest> manifest_;
  std::vector<ChunkEntry> entries_;
  std::vector<State> state_;
  std::vector<std::uint32_t> gaps_;  // chunks with something behind them
  File geometry_;
};

}  // namespace

RepairResult repair_store(const fs::path& path, MemoryBudget& budget, Reporter& report) { return StoreRepairer(path, budget, report).run(); }

}  // namespace chiaro::stream
