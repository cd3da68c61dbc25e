#include "stream/store/layer_format.h"

#include <Eigen/Core>
#include <algorithm>
#include <cmath>
#include <cstring>
#include <limits>
#include <nlohmann/json.hpp>

#include "stream/base/error.h"
#include "stream/base/hash.h"
#include "stream/store/inner_levels.h"
#include "stream/store/store_format.h"

namespace chiaro::stream {
namespace fs = std::filesystem;
namespace {

constexpr char kMagic[9] = "chiaroLY";

const char* const kTypeNames[] = {"f32", "f16", "u16", "u8"};

std::size_t type_bytes(FieldType t) { return t == FieldType::kF32 ? 4 : t == FieldType::kU8 ? 1 : 2; }

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

LayerHeader layer_header(std::size_t record_bytes, std::uint64_t values_bytes, const std::vector<std::uint32_t>& crc) {
  LayerHeader header{};
  std::memcpy(header.magic, kMagic, 8);
  header.version = kFormatVersion;
  header.record_bytes = static_cast<std::uint32_t>(record_bytes);
  header.chunks = crc.size();
  header.values_bytes = values_bytes;
  header.records_crc = crc32c(crc.data(), crc.size() * 4);
  header.header_crc = header_crc_of(header);
  return header;
}

std::uint32_t header_crc_of(const LayerHeader& header) { return crc32c(&header, offsetof(LayerHeader, header_crc)); }
bool has_layer_magic(const LayerHeader& header) { return std::memcmp(header.magic, kMagic, 8) == 0; }

std::string layer_json_text(const LayerInfo& info) {
  nlohmann::ordered_json j;
  j["format"] = "chiaro layer";
  j["format_version"] = kFormatVersion;
  j["store_key"] = info.store_key;
  nlohmann::ordered_json fields = nlohmann::ordered_json::array();
  for (const LayerField& f : info.fields) fields.push_back({{"name", f.name}, {"type", kTypeNames[static_cast<std::size_t>(f.type)]}, {"components", f.components}});
  j["fields"] = std::move(fields);
  j["provenance"] = info.provenance;
  return j.dump(2, ' ', false, nlohmann::ordered_json::error_handler_t::replace);
}

LayerInfo parse_layer_json(const fs::path& path, const std::string& text) {
  LayerInfo info;
  try {
    const auto j = nlohmann::json::parse(text);
    if (j.at("format").get<std::string>() != "chiaro layer") throw Error(concat(path.string(), ": format is not \"chiaro layer\""));
    if (const int version = j.at("format_version").get<int>(); version != kFormatVersion)
      throw Error(concat(path.string(), ": format version ", version, ", this program reads version ", kFormatVersion));
    info.store_key = j.at("store_key").get<std::string>();
    info.fields = parse_fields(path, j.at("fields"));
    info.provenance = j.at("provenance").get<std::string>();
  } catch (const nlohmann::json::exception& e) {
    throw Error(concat(path.string(), ": ", e.what()));
  }
  if (info.fields.empty()) throw Error(concat(path.string(), ": no fields"));
  return info;
}

fs::path layer_path(const Store& store, const std::string& name) { return layers_path(store.path()) / name; }

std::size_t record_bytes_of(const std::vector<LayerField>& fields) {
  std::size_t sum = 0;
  for (const LayerField& f : fields) sum += type_bytes(f.type) * static_cast<std::size_t>(f.components);
  return sum;
}

std::vector<std::uint64_t> value_offsets(const Store& store, std::size_t record_bytes) {
  std::vector<std::uint64_t> offsets{0};
  offsets.reserve(store.chunks().size() + 1);
  for (const ChunkEntry& e : store.chunks()) offsets.push_back(offsets.back() + e.count * std::uint64_t{record_bytes});
  return offsets;
}

std::vector<std::byte> unseen_values(const std::vector<LayerField>& fields, std::uint32_t count) {
  std::vector<std::byte> planar(count * record_bytes_of(fields));
  RecordMean nothing(fields);
  for (std::uint32_t slot = 0; slot < count; ++slot) nothing.finish(planar.data(), count, slot);
  return planar;
}

std::vector<std::byte> mean_of_children(const Store& store, std::uint32_t node, const std::vector<LayerField>& fields, const ReadValues& read) {
  const ChunkEntry& e = store.chunks()[node];
  std::vector<std::byte> out(e.count * record_bytes_of(fields));
  VoxelCursor cursor(static_cast<int>(e.source_offset));
  RecordMean mean(fields);
  std::vector<std::uint32_t> group;
  std::uint32_t current = 0;
  const auto finish = [&](std::uint32_t slot) {
    if (slot >= e.count) throw Error(concat(store.path().string(), ": chunk ", node, " holds ", e.count, " surfels, its children make more"));
    mean.finish(out.data(), e.count, slot);
  };
  for (std::uint32_t c = 0; c < e.num_children; ++c) {
    const std::uint32_t child = e.first_child + c;
    const Chunk geometry = store.read_chunk(child);
    const std::vector<std::byte> values = read(child);
    cursor.next_child(store.chunks()[child], geometry.blocks, group);
    for (const std::uint16_t slot : cursor.order()) {
      if (group[slot] != current) finish(current);
      current = group[slot];
      mean.add(values.data(), geometry.count, slot);
    }
  }
  finish(current);
  if (current + 1 != e.count) throw Error(concat(store.path().string(), ": chunk ", node, " holds ", e.count, " surfels, its children make ", current + 1));
  return out;
}

}  // namespace chiaro::stream
