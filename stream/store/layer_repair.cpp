#include "stream/store/layer_repair.h"

#include <algorithm>
#include <cstring>

#include "stream/base/error.h"
#include "stream/base/hash.h"
#include "stream/base/parallel.h"
#include "stream/store/checksum_repair.h"
#include "stream/store/index_repair.h"
#include "stream/store/layer_format.h"
#include "stream/store/store_format.h"

namespace chiaro::stream {
namespace fs = std::filesystem;
namespace {

class LayerRepairer {
 public:
  LayerRepairer(const Store& store, const std::string& name, RepairResult& result, Reporter& report)
      : store_(store), path_(layer_path(store, name)), result_(result), report_(report) {}

  void run() {
    const LayerInfo info = repair_json();
    fields_ = info.fields;
    offsets_ = value_offsets(store_, record_bytes_of(fields_));
    values_ = File(path_ / "values.bin", File::Mode::kRead);
    find_checksums();
    repair_index();
    repair_values();
  }

 private:
  LayerInfo repair_json() {
    const fs::path path = path_ / "layer.json";
    const std::string text = read_text(path);
    std::optional<std::string> whole = repair_sealed(text);
    if (!whole) whole = with_key(path, text);
    if (!whole) throw Error(concat(path.string(), ": damaged in more than one place; what the layer holds cannot be told"));
    const LayerInfo info = parse_layer_json(path, *whole);
    if (info.store_key != store_.manifest().key) throw Error(concat(path.string(), ": belongs to another store: expected key ", store_.manifest().key, ", found ", info.store_key));
    if (*whole != text) {
      write_text(path, *whole);
      add_line(result_.repaired, concat(path.string(), ": damaged text put right, as its checksum says"));
    }
    return info;
  }

  // The key is kept in the manifest too.
  std::optional<std::string> with_key(const fs::path& path, const std::string& text) const {
    try {
      LayerInfo info = parse_layer_json(path, text);
      info.store_key = store_.manifest().key;
      std::string made = sealed_text(layer_json_text(info));
      const std::size_t seal = seal_of("").size();
      if (text.size() > seal && made.ends_with(std::string_view(text).substr(text.size() - seal))) return made;
    } catch (const Error&) {
    }
    return std::nullopt;
  }

  void find_checksums() {
    found_.resize(store_.chunks().size());
    report_.begin(concat("repair layer ", path_.filename().string()), found_.size(), "chunks");
    parallel_blocks(found_.size(), 64, [&](std::size_t begin, std::size_t end) {
      report_.check();
      for (std::size_t i = begin; i < end; ++i) found_[i] = checksum_at(values_, offsets_[i], offsets_[i + 1] - offsets_[i]);
    });
    report_.end();
  }

  void repair_index() {
    const fs::path path = path_ / "index.bin";
    const File index(path, File::Mode::kRead);
    const std::size_t chunks = found_.size(), record_bytes = record_bytes_of(fields_);
    LayerHeader header{};
    index.read_some_at(0, &header, sizeof header);
    wanted_.assign(chunks, 0);
    index.read_some_at(sizeof header, wanted_.data(), 4 * chunks);
    LayerHeader expected = layer_header(record_bytes, offsets_.back(), wanted_);
    const bool is_whole_header = header.header_crc == header_crc_of(header);
    if (is_whole_header && !same_layout(header, expected)) throw Error(concat(path.string(), ": belongs to another layer or store"));
    const bool records_are_whole = header.records_crc == expected.records_crc || header.header_crc == expected.header_crc;
    if (!records_are_whole) {
      LayerHeader trusted = expected;  // is the checksum of the records what is left of the header?
      trusted.records_crc = header.records_crc;
      if (!is_whole_header && header_crc_of(trusted) != header.header_crc) throw Error(concat(path.string(), ": header and records are damaged: no checksum tells which values are whole"));
      if (!one_byte(header.records_crc) && !all_found(header.records_crc)) throw Error(concat(path.string(), ": checksums of chunks are damaged and cannot be told from the values"));
      expected = layer_header(record_bytes, offsets_.back(), wanted_);
    }
    if (index.size() == sizeof header + 4 * chunks && std::memcmp(&header, &expected, sizeof header) == 0 && records_are_whole) return;
    AtomicFile file(path);
    file.append(&expected, sizeof expected);
    file.append(wanted_.data(), 4 * chunks);
    file.commit();
    add_line(result_.repaired, concat(path.string(), ": ", records_are_whole ? "header put right" : "damaged checksums put right"));
  }

  static bool same_layout(const LayerHeader& a, const LayerHeader& b) {
    return std::memcmp(a.magic, b.magic, 8) == 0 && a.version == b.version && a.record_bytes == b.record_bytes && a.chunks == b.chunks && a.values_bytes == b.values_bytes;
  }

  // One damaged byte: the record it is in must then be the checksum of the values.
  bool one_byte(std::uint32_t records_crc) {
    const auto bytes = std::as_writable_bytes(std::span(wanted_));
    for (const ByteFix& fix : one_byte_fixes(bytes, records_crc)) {
      bytes[fix.at] ^= fix.flip;
      if (found_[fix.at / 4] == wanted_[fix.at / 4]) return true;
      bytes[fix.at] ^= fix.flip;
    }
    return false;
  }

  // All records that do not fit are damaged, and all values whole.
  bool all_found(std::uint32_t records_crc) {
    std::vector<std::uint32_t> crc = wanted_;
    for (std::size_t i = 0; i < crc.size(); ++i)
      if (found_[i]) crc[i] = *found_[i];
    if (crc32c(crc.data(), 4 * crc.size()) != records_crc) return false;
    wanted_ = std::move(crc);
    return true;
  }

  void repair_values() {
    std::vector<std::uint32_t> inner;  // deepest first: a node is made from its children
    bool any_leaf = false;
    for (std::size_t i = found_.size(); i-- > 0;) {
      if (found_[i] == wanted_[i]) continue;
      const ChunkEntry& e = store_.chunks()[i];
      if (!e.is_leaf()) {
        inner.push_back(static_cast<std::uint32_t>(i));
        continue;
      }
      any_leaf = true;
      add_line(result_.lost, concat(values_.path().string(), ": chunk ", i, ", a leaf: the values of ", e.count, " points are lost"));
    }
    if (any_leaf) add_line(result_.advice, concat("make layer ", path_.filename().string(), " again: run the command that made it, \"chiaro ingest\" for layer input"));
    if (inner.empty() && values_.size() == offsets_.back()) return;
    AtomicFile out(values_.path());
    copy_for_repair(values_, offsets_.back(), out, report_);
    std::size_t made = 0;
    for (const std::uint32_t node : inner) made += make_node(out.file(), node);
    if (made == 0 && values_.size() == offsets_.back()) return;
    out.commit();
    add_line(result_.repaired, concat(values_.path().string(), ": ", made, made == 1 ? " inner chunk" : " inner chunks", " made anew from the leaves"));
  }

  bool make_node(File& file, std::uint32_t node) {
    std::vector<std::byte> planar;
    try {
      planar = mean_of_children(store_, node, fields_, [&](std::uint32_t child) {
        std::vector<std::byte> bytes(offsets_[child + 1] - offsets_[child]);
        file.read_at(offsets_[child], bytes.data(), bytes.size());
        if (crc32c(bytes) != wanted_[child]) throw Error(concat("the values of its child ", child, " are damaged"));
        return bytes;
      });
      if (crc32c(planar) != wanted_[node]) throw Error("its children give other values than its checksum says: another version made them");
    } catch (const Error& e) {
      add_line(result_.lost, concat(values_.path().string(), ": inner chunk ", node, ": ", e.what()));
      return false;
    }
    file.write_at(offsets_[node], planar.data(), planar.size());
    return true;
  }

  const Store& store_;
  fs::path path_;
  RepairResult& result_;
  Reporter& report_;
  std::vector<LayerField> fields_;
  std::vector<std::uint64_t> offsets_;
  File values_;
  std::vector<std::optional<std::uint32_t>> found_;  // checksums of the values on disk; nothing behind the end
  std::vector<std::uint32_t> wanted_;
};

}  // namespace

void repair_layer(const Store& store, const std::string& name, RepairResult& result, Reporter& report) {
  try {
    LayerRepairer(store, name, result, report).run();
  } catch (const NoRoom&) {
    throw;
  } catch (const Error& e) {
    add_line(result.lost, e.what());
    add_line(result.advice, concat("make layer ", name, " again: run the command that made it, \"chiaro ingest\" for layer input"));
  }
}

void add_line(std::vector<std::string>& lines, const std::string& line) {
  if (lines.size() < RepairResult::kMostLines && std::find(lines.begin(), lines.end(), line) == lines.end()) lines.push_back(line);
}

void copy_for_repair(const File& from, std::uint64_t size, AtomicFile& to, Reporter& report) {
  if (const std::uint64_t free = free_disk_bytes(from.path().parent_path()); free < size)
    throw NoRoom(concat(from.path().string(), ": no space: the repair needs ", format_bytes(size), " for a copy, the disk has ", format_bytes(free), " free"));
  std::vector<char> buffer(1 << 20);
  report.begin(concat("copy ", from.path().filename().string()), size, "bytes");
  for (std::uint64_t at = 0; at < size;) {
    report.check();
    const std::size_t n = from.read_some_at(at, buffer.data(), static_cast<std::size_t>(std::min<std::uint64_t>(buffer.size(), size - at)));
    if (n == 0) break;
    to.append(buffer.data(), n);
    report.progress(at += n);
  }
  to.flush();
  to.file().truncate(size);
  report.end();
}

}  // namespace chiaro::stream
