#include "stream/store/layer.h"

#include <algorithm>
#include <atomic>
#include <cstring>

#include "stream/base/error.h"
#include "stream/base/hash.h"
#include "stream/base/parallel.h"
#include "stream/store/layer_format.h"
#include "stream/store/store_format.h"

namespace chiaro::stream {
namespace fs = std::filesystem;

bool is_layer_name(const std::string& name) {
  const auto plain = [](char c) { return (c >= 'a' && c <= 'z') || (c >= 'A' && c <= 'Z') || (c >= '0' && c <= '9') || c == '_' || c == '-' || c == '.'; };
  return !name.empty() && name.size() <= 128 && name[0] != '.' && std::all_of(name.begin(), name.end(), plain) && !name.ends_with(".part") && !name.ends_with(".old");
}

namespace {

void check_name(const std::string& name) {
  if (!is_layer_name(name)) throw Error(concat("layer name \"", name, "\": expected letters, digits, '_', '-' and '.'"));
}

}  // namespace

std::vector<LayerField> albedo_fields() { return {{"albedo", FieldType::kF32, 3}, {"sigma", FieldType::kF32, 1}, {"photos", FieldType::kU16, 1}}; }
std::vector<LayerField> input_fields() { return {{"colour", FieldType::kU16, 3}}; }

struct LayerWriter::Impl {
  const Store* store;
  std::string name;
  std::vector<LayerField> fields;
  std::string provenance;
  fs::path final_path, part_path;
  std::size_t record_bytes = 0;
  std::vector<std::uint64_t> offsets;
  std::vector<std::uint32_t> crc;
  std::vector<std::uint8_t> written;   ///< one slot a chunk, each owned by the one who writes that chunk
  File values;
  bool committed = false;

  std::vector<std::byte> read(std::uint32_t chunk) const {
    std::vector<std::byte> bytes(offsets[chunk + 1] - offsets[chunk]);
    values.read_at(offsets[chunk], bytes.data(), bytes.size());
    return bytes;
  }

  void write(std::uint32_t chunk, std::span<const std::byte> planar) {
    values.write_at(offsets[chunk], planar.data(), planar.size());
    crc[chunk] = crc32c(planar);
    written[chunk] = 1;
  }

  void filter(std::uint32_t node) {
    write(node, mean_of_children(*store, node, fields, [this](std::uint32_t child) { return read(child); }));
  }
};

LayerWriter::LayerWriter(const Store& store, std::string name, std::vector<LayerField> fields, std::string provenance_json) : impl_(std::make_unique<Impl>()) {
  check_name(name);
  if (fields.empty() || fields.size() > kMaxFields) throw std::invalid_argument("a layer has 1 .. 64 fields");
  for (const LayerField& f : fields)
    if (f.components < 1 || f.components > kMaxComponents) throw std::invalid_argument("a field has 1 .. 64 components");
  Impl& w = *impl_;
  w.store = &store;
  w.fields = std::move(fields);
  w.provenance = std::move(provenance_json);
  w.final_path = layer_path(store, name);
  w.part_path = w.final_path.string() + ".part";
  w.name = std::move(name);
  w.record_bytes = record_bytes_of(w.fields);
  w.offsets = value_offsets(store, w.record_bytes);
  w.crc.resize(store.chunks().size());
  w.written.resize(store.chunks().size());
  std::error_code code;
  fs::remove_all(w.part_path, code);
  make_folder(w.part_path);
  w.values = File(w.part_path / "values.bin", File::Mode::kCreate);
  w.values.reserve(w.offsets.back());
}

LayerWriter::LayerWriter(LayerWriter&&) noexcept = default;

LayerWriter::~LayerWriter() {
  if (!impl_ || impl_->committed) return;
  std::error_code code;
  fs::remove_all(impl_->part_path, code);
}

void LayerWriter::write_chunk(std::uint32_t chunk, std::span<const std::byte> planar) {
  if (chunk >= impl_->crc.size()) throw std::invalid_argument(concat("chunk ", chunk, " of ", impl_->crc.size()));
  const std::uint64_t expected = impl_->offsets[chunk + 1] - impl_->offsets[chunk];
  if (planar.size() != expected) throw std::invalid_argument(concat("layer ", impl_->name, ", chunk ", chunk, ": ", planar.size(), " bytes, expected ", expected));
  impl_->write(chunk, planar);
}

void LayerWriter::finish_inner(Reporter& report) {
  Impl& w = *impl_;
  const std::vector<ChunkEntry>& chunks = w.store->chunks();
  std::atomic<std::uint64_t> done{0};
  report.begin(concat("layer ", w.name), chunks.size(), "chunks");
  for (std::size_t end = chunks.size(); end > 0;) {
    std::size_t begin = end;
    while (begin > 0 && chunks[begin - 1].level == chunks[end - 1].level) --begin;
    parallel_blocks(end - begin, 1, [&](std::size_t i, std::size_t) {
      report.check();
      const auto chunk = static_cast<std::uint32_t>(begin + i);
      if (!chunks[chunk].is_leaf()) w.filter(chunk);
      else if (!w.written[chunk]) w.write(chunk, unseen_values(w.fields, chunks[chunk].count));
      report.progress(++done);
    });
    end = begin;
  }
  report.end();
}

void LayerWriter::commit() {
  Impl& w = *impl_;
  for (std::size_t i = 0; i < w.written.size(); ++i)
    if (!w.written[i]) throw std::invalid_argument(concat("layer ", w.name, ": chunk ", i, " was not written; finish_inner() comes before commit()"));
  w.values.sync();
  w.values.close();
  const LayerHeader header = layer_header(w.record_bytes, w.offsets.back(), w.crc);
  AtomicFile index(w.part_path / "index.bin");
  index.append(&header, sizeof header);
  index.append(w.crc.data(), w.crc.size() * 4);
  index.commit();
  write_sealed(w.part_path / "layer.json", layer_json_text({w.store->manifest().key, w.fields, w.provenance}));
  publish_folder(w.part_path, w.final_path);
  w.committed = true;
}

struct Layer::Impl {
  fs::path path;
  std::vector<LayerField> fields;
  std::string provenance;
  std::size_t record_bytes = 0;
  std::vector<std::uint64_t> offsets;
  std::vector<std::uint32_t> crc;
  File values;
};

Layer::Layer(const Store& store, const std::string& name) : impl_(std::make_unique<Impl>()) {
  check_name(name);
  Impl& l = *impl_;
  l.path = layer_path(store, name);
  if (!fs::is_directory(l.path)) {
    std::string known;
    for (const std::string& n : layer_names(store)) known += known.empty() ? n : ", " + n;
    throw Error(concat(store.path().string(), ": no layer \"", name, "\"; it has ", known.empty() ? "none" : known));
  }
  const fs::path json_path = l.path / "layer.json", index_file = l.path / "index.bin";
  LayerInfo info = parse_layer_json(json_path, read_sealed(json_path));
  if (info.store_key != store.manifest().key)
    throw Error(concat(json_path.string(), ": belongs to another store: expected key ", store.manifest().key, ", found ", info.store_key));
  l.fields = std::move(info.fields);
  l.provenance = std::move(info.provenance);
  l.record_bytes = record_bytes_of(l.fields);
  l.offsets = value_offsets(store, l.record_bytes);
  const File index(index_file, File::Mode::kRead);
  LayerHeader header{};
  if (index.size() < sizeof header) throw Error(concat(index_file.string(), ": ", index.size(), " bytes, file ends early"));
  index.read_at(0, &header, sizeof header);
  if (!has_layer_magic(header) || header.header_crc != header_crc_of(header))
    throw Error(concat(index_file.string(), ": damaged header"));
  const std::uint64_t chunks = store.chunks().size();
  if (header.version != kFormatVersion || header.chunks != chunks || header.record_bytes != l.record_bytes || header.values_bytes != l.offsets.back() ||
      index.size() != sizeof header + 4 * chunks)
    throw Error(concat(index_file.string(), ": expected ", chunks, " chunks of ", l.record_bytes, "-byte records, found ", header.chunks, " of ", header.record_bytes));
  l.crc.resize(chunks);
  index.read_at(sizeof header, l.crc.data(), 4 * chunks);
  if (crc32c(l.crc.data(), 4 * chunks) != header.records_crc) throw Error(concat(index_file.string(), ": checksum of the records does not match"));
  l.values = File(l.path / "values.bin", File::Mode::kRead);
  if (l.values.size() != l.offsets.back())
    throw Error(concat(l.values.path().string(), ": ", l.values.size(), " bytes, expected ", l.offsets.back()));
}

Layer::Layer(Layer&&) noexcept = default;
Layer::~Layer() = default;
const std::vector<LayerField>& Layer::fields() const { return impl_->fields; }
const std::string& Layer::provenance_json() const { return impl_->provenance; }
std::size_t Layer::record_bytes() const { return impl_->record_bytes; }

std::vector<std::byte> Layer::read_chunk(std::uint32_t chunk) const {
  const Impl& l = *impl_;
  if (chunk >= l.crc.size()) throw std::invalid_argument(concat("chunk ", chunk, " of ", l.crc.size()));
  std::vector<std::byte> bytes(l.offsets[chunk + 1] - l.offsets[chunk]);
  l.values.read_at(l.offsets[chunk], bytes.data(), bytes.size());
  const std::uint32_t crc = crc32c(bytes);
  if (crc != l.crc[chunk])
    throw Error(concat(l.values.path().string(), ": chunk ", chunk, " at byte ", l.offsets[chunk], " is damaged: checksum expected ", l.crc[chunk], ", found ", crc));
  return bytes;
}

bool has_layer(const Store& store, const std::string& name) {
  std::error_code code;
  return fs::exists(layer_path(store, name) / "layer.json", code);
}

std::vector<std::string> layer_names(const Store& store) {
  std::vector<std::string> names;
  std::error_code code;
  for (fs::directory_iterator it(layers_path(store.path()), code), end; !code && it != end; it.increment(code)) {
    const std::string name = it->path().filename().string();
    if (!name.ends_with(".part") && !name.ends_with(".old") && has_layer(store, name)) names.push_back(name);
  }
  std::sort(names.begin(), names.end());
  return names;
}

namespace {
bool has_schema(const Layer& layer, const std::vector<LayerField>& expected) {
  const auto same = [](const LayerField& a, const LayerField& b) { return a.name == b.name && a.type == b.type && a.components == b.components; };
  return std::equal(layer.fields().begin(), layer.fields().end(), expected.begin(), expected.end(), same);
}
}  // namespace

std::vector<std::array<std::uint16_t, 3>> read_colour(const Layer& layer, const Store& store, std::uint32_t chunk) {
  if (!has_schema(layer, input_fields())) throw Error(concat(store.path().string(), ": the layer has no colour (expected the field colour, 3 x u16)"));
  const std::vector<std::byte> planar = layer.read_chunk(chunk);
  const std::size_t n = store.chunks()[chunk].count;
  std::vector<std::uint16_t> codes(3 * n);
  std::memcpy(codes.data(), planar.data(), 6 * n);
  std::vector<std::array<std::uint16_t, 3>> colours(n);
  for (std::size_t i = 0; i < n; ++i) colours[i] = {codes[i], codes[n + i], codes[2 * n + i]};
  return colours;
}

AlbedoValues read_albedo(const Layer& layer, const Store& store, std::uint32_t chunk) {
  if (!has_schema(layer, albedo_fields()))
    throw Error(concat(store.path().string(), ": the layer has no albedo (expected fields albedo, sigma, photos)"));
  const std::vector<std::byte> planar = layer.read_chunk(chunk);
  const std::size_t n = store.chunks()[chunk].count;
  std::vector<float> floats(4 * n);
  std::memcpy(floats.data(), planar.data(), 16 * n);
  AlbedoValues v;
  v.albedo.resize(n);
  for (std::size_t i = 0; i < n; ++i) v.albedo[i] = {floats[i], floats[n + i], floats[2 * n + i]};
  v.sigma.assign(floats.begin() + static_cast<std::ptrdiff_t>(3 * n), floats.end());
  v.photos.resize(n);
  std::memcpy(v.photos.data(), planar.data() + 16 * n, 2 * n);
  return v;
}

}  // namespace chiaro::stream
