#include "stream/store/layer.h"

#include <Eigen/Core>
#include <algorithm>
#include <atomic>
#include <cmath>
#include <cstring>
#include <limits>
#include <nlohmann/json.hpp>

#include "stream/base/error.h"
#include "stream/base/hash.h"
#include "stream/base/parallel.h"
#include "stream/store/inner_levels.h"
#include "stream/store/store_format.h"

namespace chiaro::stream {
namespace fs = std::filesystem;
namespace {

constexpr char kMagic[9] = "chiaroLY";
constexpr std::size_t kMaxFields = 64;
constexpr int kMaxComponents = 64;

struct LayerHeader {
  char magic[8];
  std::uint32_t version, record_bytes;
  std::uint64_t chunks, values_bytes;
  std::uint32_t records_crc, header_crc;
};
static_assert(sizeof(LayerHeader) == 40);

const char* const kTypeNames[] = {"f32", "f16", "u16", "u8"};

std::size_t type_bytes(FieldType t) { return t == FieldType::kF32 ? 4 : t == FieldType::kU8 ? 1 : 2; }

std::size_t record_bytes_of(const std::vector<LayerField>& fields) {
  std::size_t sum = 0;
  for (const LayerField& f : fields) sum += type_bytes(f.type) * static_cast<std::size_t>(f.components);
  return sum;
}

void check_name(const std::string& name) {
  const auto plain = [](char c) { return (c >= 'a' && c <= 'z') || (c >= 'A' && c <= 'Z') || (c >= '0' && c <= '9') || c == '_' || c == '-' || c == '.'; };
  const bool ok = !name.empty() && name.size() <= 128 && name[0] != '.' && std::all_of(name.begin(), name.end(), plain) && !name.ends_with(".part") && !name.ends_with(".old");
  if (!ok) throw Error(concat("layer name \"", name, "\": expected letters, digits, '_', '-' and '.'"));
}

/// Where each chunk's values begin: chunks in index order, nothing between.
std::vector<std::uint64_t> value_offsets(const Store& store, std::size_t record_bytes) {
  std::vector<std::uint64_t> offsets{0};
  offsets.reserve(store.chunks().size() + 1);
  for (const ChunkEntry& e : store.chunks()) offsets.push_back(offsets.back() + e.count * std::uint64_t{record_bytes});
  return offsets;
}

double read_value(FieldType type, const std::byte* p) {
  switch (type) {
    case FieldType::kF32: { float v; std::memcpy(&v, p, 4); return v; }
    case FieldType::kF16: { Eigen::half v; std::memcpy(&v.x, p, 2); return static_cast<float>(v); }
    case FieldType::kU16: { std::uint16_t v; std::memcpy(&v, p, 2); return v; }
    case FieldType::kU8: break;
  }
  return static_cast<double>(std::to_integer<std::uint8_t>(*p));
}

void write_value(FieldType type, double value, std::byte* p) {
  switch (type) {
    case FieldType::kF32: { const auto v = static_cast<float>(value); std::memcpy(p, &v, 4); return; }
    case FieldType::kF16: { const Eigen::half v(static_cast<float>(value)); std::memcpy(p, &v.x, 2); return; }
    case FieldType::kU16: { const auto v = static_cast<std::uint16_t>(value); std::memcpy(p, &v, 2); return; }
    case FieldType::kU8: break;
  }
  *p = static_cast<std::byte>(static_cast<std::uint8_t>(value));
}

bool is_real(FieldType t) { return t == FieldType::kF32 || t == FieldType::kF16; }

/// Mean of what counts: finite values of real fields, records with a non-zero component of integer fields.
class RecordMean {
 public:
  explicit RecordMean(const std::vector<LayerField>& fields) : fields_(fields) {
    std::size_t n = 0;
    for (const LayerField& f : fields) n += static_cast<std::size_t>(f.components);
    sum_.resize(n);
    count_.resize(n);
  }
  /// Adds record `slot` of `count` planar records.
  void add(const std::byte* planar, std::size_t count, std::size_t slot) {
    std::size_t at = 0;
    const std::byte* field = planar;
    for (const LayerField& f : fields_) {
      const std::size_t bytes = type_bytes(f.type), n = static_cast<std::size_t>(f.components);
      bool any = is_real(f.type);
      for (std::size_t c = 0; c < n && !any; ++c) any = read_value(f.type, field + (c * count + slot) * bytes) != 0;
      for (std::size_t c = 0; c < n; ++c, ++at) {
        const double v = read_value(f.type, field + (c * count + slot) * bytes);
        if (!any || !std::isfinite(v)) continue;
        sum_[at] += v;
        ++count_[at];
      }
      field += n * count * bytes;
    }
  }
  /// Writes the mean as record `slot` of `count` planar records and starts anew.
  void finish(std::byte* planar, std::size_t count, std::size_t slot) {
    std::size_t at = 0;
    std::byte* field = planar;
    for (const LayerField& f : fields_) {
      const std::size_t bytes = type_bytes(f.type), n = static_cast<std::size_t>(f.components);
      for (std::size_t c = 0; c < n; ++c, ++at) {
        const double mean = count_[at] > 0 ? sum_[at] / static_cast<double>(count_[at]) : is_real(f.type) ? std::numeric_limits<double>::quiet_NaN() : 0.0;
        write_value(f.type, is_real(f.type) ? mean : std::floor(mean + 0.5), field + (c * count + slot) * bytes);
        sum_[at] = 0;
        count_[at] = 0;
      }
      field += n * count * bytes;
    }
  }

 private:
  const std::vector<LayerField>& fields_;
  std::vector<double> sum_;
  std::vector<std::uint64_t> count_;
};

fs::path layer_path(const Store& store, const std::string& name) { return layers_path(store.path()) / name; }

std::vector<LayerField> parse_fields(const fs::path& path, const nlohmann::json& j) {
  std::vector<LayerField> fields;
  for (const auto& f : j) {
    LayerField field;
    field.name = f.at("name").get<std::string>();
    const auto type = f.at("type").get<std::string>();
    const auto* known = std::find(std::begin(kTypeNames), std::end(kTypeNames), type);
    if (known == std::end(kTypeNames)) throw Error(concat(path.string(), ": field \"", field.name, "\": type \"", type, "\", expected f32, f16, u16 or u8"));
    field.type = static_cast<FieldType>(known - std::begin(kTypeNames));
    field.components = f.at("components").get<int>();
    if (field.components < 1 || field.components > kMaxComponents) throw Error(concat(path.string(), ": field \"", field.name, "\": ", field.components, " components, expected 1 .. ", kMaxComponents));
    fields.push_back(field);
    if (fields.size() > kMaxFields) throw Error(concat(path.string(), ": more than ", kMaxFields, " fields"));
  }
  return fields;
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

  // Values of a surfel that nobody saw.
  std::vector<std::byte> unseen(std::uint32_t count) const {
    std::vector<std::byte> planar(count * record_bytes);
    RecordMean nothing(fields);
    for (std::uint32_t slot = 0; slot < count; ++slot) nothing.finish(planar.data(), count, slot);
    return planar;
  }

  void filter(std::uint32_t node) {
    const ChunkEntry& e = store->chunks()[node];
    std::vector<std::byte> out(e.count * record_bytes);
    VoxelCursor cursor(static_cast<int>(e.source_offset));
    RecordMean mean(fields);
    std::vector<std::uint32_t> group;
    std::uint32_t current = 0;
    const auto finish = [&](std::uint32_t slot) {
      if (slot >= e.count) throw Error(concat(store->path().string(), ": chunk ", node, " holds ", e.count, " surfels, its children make more"));
      mean.finish(out.data(), e.count, slot);
    };
    for (std::uint32_t c = 0; c < e.num_children; ++c) {
      const std::uint32_t child = e.first_child + c;
      const Chunk geometry = store->read_chunk(child);
      const std::vector<std::byte> values_of_child = read(child);
      cursor.next_child(store->chunks()[child], geometry.blocks, group);
      for (std::uint32_t slot = 0; slot < geometry.count; ++slot) {
        if (group[slot] != current) finish(current);
        current = group[slot];
        mean.add(values_of_child.data(), geometry.count, slot);
      }
    }
    finish(current);
    if (current + 1 != e.count) throw Error(concat(store->path().string(), ": chunk ", node, " holds ", e.count, " surfels, its children make ", current + 1));
    write(node, out);
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
      else if (!w.written[chunk]) w.write(chunk, w.unseen(chunks[chunk].count));
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
  LayerHeader header{};
  std::memcpy(header.magic, kMagic, 8);
  header.version = kFormatVersion;
  header.record_bytes = static_cast<std::uint32_t>(w.record_bytes);
  header.chunks = w.crc.size();
  header.values_bytes = w.offsets.back();
  header.records_crc = crc32c(w.crc.data(), w.crc.size() * 4);
  header.header_crc = crc32c(&header, offsetof(LayerHeader, header_crc));
  AtomicFile index(w.part_path / "index.bin");
  index.append(&header, sizeof header);
  index.append(w.crc.data(), w.crc.size() * 4);
  index.commit();
  nlohmann::ordered_json j;
  j["format"] = "chiaro layer";
  j["format_version"] = kFormatVersion;
  j["store_key"] = w.store->manifest().key;
  nlohmann::ordered_json fields = nlohmann::ordered_json::array();
  for (const LayerField& f : w.fields) fields.push_back({{"name", f.name}, {"type", kTypeNames[static_cast<std::size_t>(f.type)]}, {"components", f.components}});
  j["fields"] = std::move(fields);
  j["provenance"] = w.provenance;
  write_sealed(w.part_path / "layer.json", j.dump(2, ' ', false, nlohmann::ordered_json::error_handler_t::replace));
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
  try {
    const auto j = nlohmann::json::parse(read_sealed(json_path));
    if (j.at("format").get<std::string>() != "chiaro layer") throw Error(concat(json_path.string(), ": format is not \"chiaro layer\""));
    if (const int version = j.at("format_version").get<int>(); version != kFormatVersion)
      throw Error(concat(json_path.string(), ": format version ", version, ", this program reads version ", kFormatVersion));
    if (const auto key = j.at("store_key").get<std::string>(); key != store.manifest().key)
      throw Error(concat(json_path.string(), ": belongs to another store: expected key ", store.manifest().key, ", found ", key));
    l.fields = parse_fields(json_path, j.at("fields"));
    l.provenance = j.at("provenance").get<std::string>();
  } catch (const nlohmann::json::exception& e) {
    throw Error(concat(json_path.string(), ": ", e.what()));
  }
  if (l.fields.empty()) throw Error(concat(json_path.string(), ": no fields"));
  l.record_bytes = record_bytes_of(l.fields);
  l.offsets = value_offsets(store, l.record_bytes);
  const File index(index_file, File::Mode::kRead);
  LayerHeader header{};
  if (index.size() < sizeof header) throw Error(concat(index_file.string(), ": ", index.size(), " bytes, file ends early"));
  index.read_at(0, &header, sizeof header);
  if (std::memcmp(header.magic, kMagic, 8) != 0 || header.header_crc != crc32c(&header, offsetof(LayerHeader, header_crc)))
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
