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

bool is_real(FieldType t) { return t == FieldType::kF32 || t == FieldType::kF16; }

template <class F>
void with_type(FieldType type, const F& body) {
  switch (type) {
    case FieldType::kF32: return body(float{});
    case FieldType::kF16: return body(Eigen::half{});
    case FieldType::kU16: return body(std::uint16_t{});
    case FieldType::kU8: return body(std::uint8_t{});
  }
}

/// Values of one component, one after the other wherever they lie.
template <class T>
class Column {
 public:
  Column(const std::byte* values) : values_(values) {}
  T operator[](std::size_t i) const {
    T v;
    std::memcpy(&v, values_ + i * sizeof v, sizeof v);
    return v;
  }

 private:
  const std::byte* values_;
};

/// Means over the voxels of a node, of what counts: finite values of real fields, records with a non-zero component of integer fields.
class VoxelMeans {
 public:
  VoxelMeans(const std::vector<LayerField>& fields, std::uint32_t voxels) : fields_(fields), voxels_(voxels), means_(voxels * record_bytes_of(fields)) {
    std::size_t n = 0;
    for (const LayerField& f : fields) n += static_cast<std::size_t>(f.components);
    open_.resize(n);
  }

  /// planar: `count` records, of which the voxels of the cursor's child hold some each.
  void add(const VoxelCursor& cursor, const std::byte* planar, std::size_t count) {
    for_each_field([&](const LayerField& f, std::size_t first, std::byte* means) {
      if (!is_real(f.type)) find_some(f, planar, count);
      with_type(f.type, [&]<class T>(T) {
        for (std::size_t c = 0; c < static_cast<std::size_t>(f.components); ++c) add_component(cursor, Column<T>(planar + c * count * sizeof(T)), open_[first + c], means + c * voxels_ * sizeof(T));
      });
      planar += static_cast<std::size_t>(f.components) * count * type_bytes(f.type);
    });
    open_voxel_ = cursor.num_voxels() - 1;
  }

  /// Planar records of the voxels, once all children have been added.
  std::vector<std::byte> take() {
    for_each_field([&](const LayerField& f, std::size_t first, std::byte* means) {
      with_type(f.type, [&]<class T>(T) {
        for (std::size_t c = 0; c < static_cast<std::size_t>(f.components); ++c) put<T>(open_[first + c], open_voxel_, means + c * voxels_ * sizeof(T));
      });
    });
    return std::move(means_);
  }

 private:
  struct Sum {
    double sum = 0;
    std::uint64_t count = 0;
  };

  // body(field, number of its first component, its means)
  template <class F>
  void for_each_field(const F& body) {
    std::size_t first = 0;
    std::byte* means = means_.data();
    for (const LayerField& f : fields_) {
      body(f, first, means);
      first += static_cast<std::size_t>(f.components);
      means += static_cast<std::size_t>(f.components) * voxels_ * type_bytes(f.type);
    }
  }

  // Which records have a component that is not zero.
  void find_some(const LayerField& f, const std::byte* planar, std::size_t count) {
    some_.assign(count, 0);
    with_type(f.type, [&]<class T>(T) {
      for (std::size_t c = 0; c < static_cast<std::size_t>(f.components); ++c) {
        const Column<T> values(planar + c * count * sizeof(T));
        for (std::size_t i = 0; i < count; ++i) some_[i] = static_cast<std::uint8_t>(some_[i] | (values[i] != T{}));
      }
    });
  }

  // The last voxel of a child may go on in the next one: its sum stays open.
  template <class T>
  void add_component(const VoxelCursor& cursor, const Column<T>& values, Sum& open, std::byte* means) const {
    Sum sum = open;
    std::uint32_t current = open_voxel_;
    cursor.for_each_voxel([&](std::uint32_t voxel, std::span<const std::uint16_t> slots) {
      if (voxel != current) {
        put<T>(sum, current, means);
        current = voxel;
        sum = {};
      }
      for (const std::uint16_t slot : slots) {
        const auto value = static_cast<double>(values[slot]);
        bool counts;
        if constexpr (std::is_integral_v<T>) counts = some_[slot] != 0;
        else counts = std::isfinite(value);
        sum.sum += counts ? value : 0.0;
        sum.count += counts;
      }
    });
    open = sum;
  }

  template <class T>
  static void put(const Sum& sum, std::uint32_t voxel, std::byte* means) {
    T value;
    if constexpr (std::is_integral_v<T>) value = sum.count > 0 ? static_cast<T>(std::floor(sum.sum / static_cast<double>(sum.count) + 0.5)) : T{};
    else value = static_cast<T>(static_cast<float>(sum.count > 0 ? sum.sum / static_cast<double>(sum.count) : std::numeric_limits<double>::quiet_NaN()));
    std::memcpy(means + voxel * sizeof value, &value, sizeof value);
  }

  const std::vector<LayerField>& fields_;
  std::size_t voxels_;
  std::vector<std::byte> means_;
  std::vector<Sum> open_;              // of each component, for open_voxel_
  std::uint32_t open_voxel_ = 0;
  std::vector<std::uint8_t> some_;
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
  std::byte* at = planar.data();
  for (const LayerField& f : fields)
    with_type(f.type, [&]<class T>(T) {
      const T nothing = std::is_integral_v<T> ? T{} : static_cast<T>(std::numeric_limits<float>::quiet_NaN());
      for (std::size_t i = 0; i < count * static_cast<std::size_t>(f.components); ++i, at += sizeof nothing) std::memcpy(at, &nothing, sizeof nothing);
    });
  return planar;
}

std::vector<std::byte> mean_of_children(const Store& store, std::uint32_t node, const std::vector<LayerField>& fields, const ReadValues& read) {
  const ChunkEntry& e = store.chunks()[node];
  VoxelCursor cursor(static_cast<int>(e.source_offset));
  VoxelMeans means(fields, e.count);
  MortonOrder morton;
  for (std::uint32_t c = 0; c < e.num_children; ++c) {
    const std::uint32_t child = e.first_child + c;
    const Chunk geometry = store.read_chunk(child);
    const std::vector<std::byte> values = read(child);
    const std::span<const std::uint16_t> order = morton.of(geometry.blocks, geometry.count);
    cursor.next_child(store.chunks()[child], geometry.blocks, order, morton.differences());
    if (cursor.num_voxels() > e.count) throw Error(concat(store.path().string(), ": chunk ", node, " holds ", e.count, " surfels, its children make more"));
    means.add(cursor, values.data(), geometry.count);
  }
  if (cursor.num_voxels() != e.count) throw Error(concat(store.path().string(), ": chunk ", node, " holds ", e.count, " surfels, its children make ", cursor.num_voxels()));
  return means.take();
}

}  // namespace chiaro::stream
