/// Colours per point, whatever they come from: point files, layers of a store, arrays.
#pragma once
#include <cstdint>
#include <filesystem>
#include <memory>
#include <optional>
#include <string>
#include <vector>

#include "stream/base/types.h"

namespace chiaro::tools {

struct ColourBlock {
  std::vector<Vec3d> position;  ///< empty where the source has none
  std::vector<Vec3f> albedo;    ///< linear, NaN = unseen; empty where the source has none
  std::vector<Vec3f> colour;    ///< linear, from sRGB; empty where the source has none
  std::size_t size() const { return albedo.empty() ? colour.size() : albedo.size(); }
};

/// A stream of coloured points, in blocks.
class ColourSource {
 public:
  virtual ~ColourSource() = default;
  virtual bool has_albedo() const = 0;
  virtual bool has_colour() const = 0;
  virtual bool has_position() const = 0;
  virtual bool position_is_double() const { return false; }
  /// Number of points if known beforehand; never trusted.
  virtual std::uint64_t declared_points() const = 0;
  /// What two sources must share for their points to be the same ones: the store's key, or "" for files in point order.
  virtual std::string order_key() const { return {}; }
  /// The next block, of the source's own size; false at the end.
  virtual bool read(ColourBlock& block) = 0;
};

/// A point file (PLY, LAS, PCD, text) with albedo_r, albedo_g, albedo_b or colours; `DIR:LAYER` with DIR a store or the folder of a run; a .npy
/// array (N, 3) of linear albedos.
/// throws Error if there is no such file or layer, or no colour in it.
std::unique_ptr<ColourSource> open_colours(const std::string& spec);

/// Whether the text names coloured points and not a picture.
bool names_points(const std::string& spec);

/// "DIR:LAYER" in two; nothing if it is the name of an existing file or holds no colon.
std::optional<std::pair<std::filesystem::path, std::string>> split_layer(const std::string& spec);

/// A store's folder: DIR itself, or DIR/store.chiaro for the folder of a run. throws Error if it is neither.
std::filesystem::path store_folder(const std::filesystem::path& dir);

}  // namespace chiaro::tools
