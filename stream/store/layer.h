/// Layers: results beside the geometry, one record per surfel, parallel to the store's chunks. layers/NAME/{layer.json, values.bin, index.bin}.
///
/// Leaves are written first, in any order; finish_inner() filters them bottom-up to the inner nodes (mean over the surfels that each inner
/// surfel replaces), so that every cut has colour.
#pragma once
#include <cstdint>
#include <filesystem>
#include <memory>
#include <span>
#include <string>
#include <vector>

#include "stream/base/report.h"
#include "stream/base/types.h"
#include "stream/store/store.h"

namespace chiaro::stream {

enum class FieldType : std::uint8_t { kF32, kF16, kU16, kU8 };

struct LayerField {
  std::string name;     ///< "albedo", "sigma", "photos", "colour"
  FieldType type = FieldType::kF32;
  int components = 1;
};

/// Schema of an albedo layer: albedo (3 x f32, linear; NaN unseen), sigma (f32, relative; NaN unseen), photos (u16).
std::vector<LayerField> albedo_fields();
/// Schema of layer "input": colour (3 x u16, sRGB-encoded).
std::vector<LayerField> input_fields();

class LayerWriter {
 public:
  /// Writes to layers/NAME.part; commit() publishes. provenance: JSON text kept in layer.json (method, inputs, options).
  LayerWriter(const Store& store, std::string name, std::vector<LayerField> fields, std::string provenance_json);
  LayerWriter(LayerWriter&&) noexcept;
  ~LayerWriter();
  /// All values of one chunk, planar: field after field, component after component, `count` values each. Thread-safe for different chunks.
  void write_chunk(std::uint32_t chunk, std::span<const std::byte> planar);
  /// Filters leaves to inner nodes, level by level. f32/f16 fields: mean of the finite values (NaN if none); u16/u8: rounded mean over surfels with a non-zero value, 0 if none.
  void finish_inner(Reporter& report);
  void commit();

 private:
  struct Impl;
  std::unique_ptr<Impl> impl_;
};

class Layer {
 public:
  /// throws Error if it is absent, damaged, or belongs to another store (key mismatch).
  Layer(const Store& store, const std::string& name);
  Layer(Layer&&) noexcept;
  ~Layer();
  const std::vector<LayerField>& fields() const;
  const std::string& provenance_json() const;
  std::size_t record_bytes() const;
  /// Planar values of a chunk, CRC checked.
  std::vector<std::byte> read_chunk(std::uint32_t chunk) const;

 private:
  struct Impl;
  std::unique_ptr<Impl> impl_;
};

/// Letters, digits, '_', '-' and '.', at most 128, no dot in front, no ending of unfinished folders (.part, .old).
bool is_layer_name(const std::string& name);
bool has_layer(const Store& store, const std::string& name);
std::vector<std::string> layer_names(const Store& store);

/// Decoded albedo of a chunk (any level).
struct AlbedoValues {
  std::vector<Vec3f> albedo;        ///< linear; NaN = unseen
  std::vector<float> sigma;         ///< relative standard deviation
  std::vector<std::uint16_t> photos;
};
AlbedoValues read_albedo(const Layer& layer, const Store& store, std::uint32_t chunk);

/// Colour of a chunk from a layer with field "colour" (3 x u16, sRGB-encoded). throws Error if the layer has another schema.
std::vector<std::array<std::uint16_t, 3>> read_colour(const Layer& layer, const Store& store, std::uint32_t chunk);

}  // namespace chiaro::stream
