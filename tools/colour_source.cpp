#include "tools/colour_source.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <cstring>
#include <limits>
#include <system_error>

#include "stream/base/error.h"
#include "stream/base/text.h"
#include "stream/cloud/point_stream.h"
#include "stream/photo/image_io.h"
#include "stream/store/layer.h"
#include "stream/store/store.h"
#include "tools/npy_reader.h"
#include "tools/suggest.h"

namespace chiaro::tools {
namespace fs = std::filesystem;
namespace {

constexpr std::size_t kBlockPoints = 1 << 16;

/// 16-bit sRGB codes to linear, by table.
class SrgbTable {
 public:
  SrgbTable() : linear_(65536) {
    for (std::size_t i = 0; i < linear_.size(); ++i) linear_[i] = static_cast<float>(stream::linear_from_srgb(static_cast<double>(i) / 65535));
  }
  Vec3f operator()(const std::array<std::uint16_t, 3>& code) const { return {linear_[code[0]], linear_[code[1]], linear_[code[2]]}; }

 private:
  std::vector<float> linear_;
};

const SrgbTable& srgb_table() {
  static const SrgbTable table;
  return table;
}

class FileColours final : public ColourSource {
 public:
  explicit FileColours(const fs::path& path) : reader_(stream::open_points(path)) {
    std::size_t offset = 0;
    const char* names[] = {"albedo_r", "albedo_g", "albedo_b"};
    for (const stream::PointProperty& property : reader_->schema().extras) {
      for (std::size_t c = 0; c < 3; ++c)
        if (property.name == names[c] && (property.type == stream::ScalarType::kF32 || property.type == stream::ScalarType::kF64)) {
          offsets_[c] = offset;
          is_double_[c] = property.type == stream::ScalarType::kF64;
        }
      if (property.name == "inserted" && property.type == stream::ScalarType::kU8) inserted_ = offset;
      if (property.name == "photos" && property.type == stream::ScalarType::kU16) photos_ = offset;
      offset += stream::scalar_bytes(property.type);
    }
    row_bytes_ = offset;
    if (!has_albedo() && !has_colour()) throw Error(concat(path.string(), ": the points have neither albedo_r, albedo_g, albedo_b nor colours"));
  }
  bool has_albedo() const override { return offsets_[0] != kNone && offsets_[1] != kNone && offsets_[2] != kNone; }
  bool has_colour() const override { return reader_->schema().has_colour; }
  bool has_position() const override { return true; }
  bool position_is_double() const override { return reader_->schema().position_is_double; }
  std::uint64_t declared_points() const override { return reader_->schema().declared_points; }
  bool read(ColourBlock& block) override {
    do {
      if (!reader_->read(points_, kBlockPoints)) return false;
      block = {};
      for (std::size_t i = 0; i < points_.size(); ++i)
        if (inserted_ == kNone || points_.extras[i * row_bytes_ + inserted_] == std::byte{0}) add(i, block);
    } while (block.position.empty());
    return true;
  }

 private:
  static constexpr std::size_t kNone = std::numeric_limits<std::size_t>::max();
  void add(std::size_t i, ColourBlock& block) const {
    block.position.push_back(points_.position[i]);
    if (!points_.colour.empty()) block.colour.push_back(srgb_table()(points_.colour[i]));
    if (!has_albedo()) return;
    Vec3f& albedo = block.albedo.emplace_back(Vec3f::Constant(std::numeric_limits<float>::quiet_NaN()));
    if (is_filled(i)) return;
    for (std::size_t c = 0; c < 3; ++c) albedo[static_cast<Eigen::Index>(c)] = scalar(points_.extras.data() + i * row_bytes_ + offsets_[c], is_double_[c]);
  }
  /// No photograph shows it: what an export has there is of its neighbours (`--fill`), and no result.
  bool is_filled(std::size_t i) const {
    if (photos_ == kNone) return false;
    std::uint16_t photos = 0;
    std::memcpy(&photos, points_.extras.data() + i * row_bytes_ + photos_, sizeof photos);
    return photos == 0;
  }
  static float scalar(const std::byte* at, bool is_double) {
    if (is_double) {
      double value = 0;
      std::memcpy(&value, at, sizeof value);
      return static_cast<float>(value);
    }
    float value = 0;
    std::memcpy(&value, at, sizeof value);
    return value;
  }
  std::unique_ptr<stream::PointReader> reader_;
  stream::PointBlock points_;
  std::array<std::size_t, 3> offsets_{kNone, kNone, kNone};
  std::array<bool, 3> is_double_{};
  std::size_t inserted_ = kNone;   ///< of points that a run has added (blend.refine): they are left out
  std::size_t photos_ = kNone;
  std::size_t row_bytes_ = 0;
};

class ArrayColours final : public ColourSource {
 public:
  explicit ArrayColours(const fs::path& path) : reader_(path) {}
  bool has_albedo() const override { return true; }
  bool has_colour() const override { return false; }
  bool has_position() const override { return false; }
  std::uint64_t declared_points() const override { return reader_.rows(); }
  bool read(ColourBlock& block) override {
    block = {};
    block.albedo = reader_.read(kBlockPoints);
    return !block.albedo.empty();
  }

 private:
  NpyReader reader_;
};

/// Leaves of a store in their order; one block a leaf.
class LayerColours final : public ColourSource {
 public:
  LayerColours(const fs::path& folder, const std::string& name) : store_(folder), layer_(open_layer(folder, name)) {
    for (const stream::LayerField& field : layer_.fields()) {
      has_albedo_ = has_albedo_ || field.name == "albedo";
      has_colour_ = has_colour_ || field.name == "colour";
    }
    if (!has_albedo_ && !has_colour_) throw Error(concat(folder.string(), ": layer \"", name, "\" has neither albedo nor colour"));
  }
  bool has_albedo() const override { return has_albedo_; }
  bool has_colour() const override { return has_colour_; }
  bool has_position() const override { return true; }
  bool position_is_double() const override { return true; }
  std::uint64_t declared_points() const override { return store_.manifest().points_stored; }
  std::string order_key() const override { return store_.manifest().key; }
  bool read(ColourBlock& block) override {
    if (next_ == store_.leaves().size()) return false;
    const std::uint32_t leaf = store_.leaves()[next_++];
    block = {};
    const stream::Chunk chunk = store_.read_chunk(leaf);
    for (std::uint32_t i = 0; i < chunk.count; ++i) block.position.push_back(chunk.surfel(i).position_in_world);
    if (has_albedo_) block.albedo = stream::read_albedo(layer_, store_, leaf).albedo;
    if (has_colour_)
      for (const auto& code : stream::read_colour(layer_, store_, leaf)) block.colour.push_back(srgb_table()(code));
    return true;
  }

 private:
  stream::Layer open_layer(const fs::path& folder, const std::string& name) const {
    if (stream::has_layer(store_, name)) return stream::Layer(store_, name);
    throw Error(concat(folder.string(), ": no layer \"", name, "\"", suggestion(name, stream::layer_names(store_))));
  }
  stream::Store store_;
  stream::Layer layer_;
  bool has_albedo_ = false, has_colour_ = false;
  std::size_t next_ = 0;
};

}  // namespace

std::optional<std::pair<fs::path, std::string>> split_layer(const std::string& spec) {
  std::error_code code;
  const std::size_t colon = spec.rfind(':');
  if (colon == std::string::npos || colon == 0 || colon + 1 == spec.size() || fs::exists(spec, code)) return std::nullopt;
  return std::pair{fs::path(spec.substr(0, colon)), spec.substr(colon + 1)};
}

fs::path store_folder(const fs::path& dir) {
  std::error_code code;
  for (const fs::path& folder : {dir, dir / "store.chiaro"})
    if (fs::exists(folder / "manifest.json", code)) return folder;
  throw Error(concat(dir.string(), ": neither a store (NAME.chiaro) nor the folder of a run"));
}

bool names_points(const std::string& spec) {
  if (split_layer(spec)) return true;
  const std::string extension = lower_extension(spec);
  for (const char* e : {".ply", ".las", ".laz", ".pcd", ".e57", ".ptx", ".xyz", ".xyzn", ".xyzrgb", ".txt", ".asc", ".csv", ".pts", ".npy"})
    if (extension == e) return true;
  return false;
}

std::unique_ptr<ColourSource> open_colours(const std::string& spec) {
  if (const auto layer = split_layer(spec)) return std::make_unique<LayerColours>(store_folder(layer->first), layer->second);
  if (lower_extension(spec) == ".npy") return std::make_unique<ArrayColours>(spec);
  return std::make_unique<FileColours>(spec);
}

}  // namespace chiaro::tools
