/// The files of a layer, byte by byte (docs/store-format.md), and the rule of its inner values: shared by layers and their repair.
#pragma once
#include <cstdint>
#include <filesystem>
#include <functional>
#include <string>
#include <vector>

#include "stream/store/layer.h"

namespace chiaro::stream {

inline constexpr std::size_t kMaxFields = 64;
inline constexpr int kMaxComponents = 64;

/// The first 40 bytes of a layer's index.bin; one u32 checksum a chunk follows.
struct LayerHeader {
  char magic[8];
  std::uint32_t version, record_bytes;
  std::uint64_t chunks, values_bytes;
  std::uint32_t records_crc, header_crc;
};
static_assert(sizeof(LayerHeader) == 40);

LayerHeader layer_header(std::size_t record_bytes, std::uint64_t values_bytes, const std::vector<std::uint32_t>& crc);
std::uint32_t header_crc_of(const LayerHeader& header);
bool has_layer_magic(const LayerHeader& header);

/// What layer.json holds.
struct LayerInfo {
  std::string store_key;
  std::vector<LayerField> fields;
  std::string provenance;
};
std::string layer_json_text(const LayerInfo& info);
/// throws Error naming the path and the member that is missing or wrong.
LayerInfo parse_layer_json(const std::filesystem::path& path, const std::string& text);

std::filesystem::path layer_path(const Store& store, const std::string& name);
std::size_t record_bytes_of(const std::vector<LayerField>& fields);
/// Where each chunk's values begin, and the end: chunks in index order, nothing between.
std::vector<std::uint64_t> value_offsets(const Store& store, std::size_t record_bytes);

/// Planar values of `count` surfels that nobody saw.
std::vector<std::byte> unseen_values(const std::vector<LayerField>& fields, std::uint32_t count);
using ReadValues = std::function<std::vector<std::byte>(std::uint32_t chunk)>;
/// Planar values of an inner node from those of its children. throws Error if the children do not make as many surfels as the node has.
std::vector<std::byte> mean_of_children(const Store& store, std::uint32_t node, const std::vector<LayerField>& fields, const ReadValues& read);

}  // namespace chiaro::stream
