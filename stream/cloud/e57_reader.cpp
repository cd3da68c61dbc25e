// E57: several scans with their poses in one file, read one after the other.
#include <algorithm>
#include <bit>
#include <cstring>

#include "stream/base/error.h"
#include "stream/cloud/formats.h"
#include "stream/cloud/rust_formats.h"

namespace chiaro::stream {
namespace {

struct E57Free {
  void operator()(void* scans) const { chiaro_e57_free(scans); }
};

class E57Reader final : public PointReader {
 public:
  explicit E57Reader(File file) : file_(std::move(file)) {
    const ChiaroE57Input input{file_.descriptor(), file_.size(), std::bit_cast<std::uint64_t>(no_position().x())};
    char message[CHIARO_RUST_MESSAGE_BYTES] = {};
    void* handle = nullptr;
    check(chiaro_e57_open(&input, &handle, message), message);
    scans_.reset(handle);
    describe();
  }

  const PointSchema& schema() const override { return schema_; }

  bool read(PointBlock& block, std::size_t max_points) override {
    block.clear();
    const std::size_t most = std::min(max_points, kMostAtOnce);
    const std::size_t extra_bytes = schema_.extra_bytes();
    resize(block, most, extra_bytes);
    ChiaroE57Output output{};
    output.most_points = most;
    output.positions = block.position.data()->data();
    if (schema_.has_normal) output.normals = block.normal.data()->data();
    if (schema_.has_colour) output.colours = block.colour.data()->data();
    if (extra_bytes > 0) output.extras = reinterpret_cast<std::uint8_t*>(block.extras.data());
    std::uint64_t done = 0;
    char message[CHIARO_RUST_MESSAGE_BYTES] = {};
    const int code = most > 0 ? chiaro_e57_read(scans_.get(), &output, &done, message) : 0;
    resize(block, static_cast<std::size_t>(done), extra_bytes);
    check(code, message);
    return done > 0;
  }

 private:
  static constexpr std::size_t kMostAtOnce = 65536;

  void check(int code, const char* message) const {
    if (code != 0) throw Error(concat(file_.path().string(), ": ", message));
  }

  void describe() {
    const ChiaroE57Info info = chiaro_e57_info(scans_.get());
    schema_.declared_points = info.declared_points;
    schema_.position_is_double = info.position_is_double != 0;
    schema_.has_normal = info.has_normal != 0;
    schema_.has_colour = info.has_colour != 0;
    schema_.colour_is_16_bit = info.colour_is_16_bit != 0;
    for (std::uint64_t i = 0; i < info.num_properties; ++i) {
      const ChiaroE57Property property = chiaro_e57_property(scans_.get(), i);
      schema_.extras.push_back({property.name, static_cast<ScalarType>(property.scalar)});
    }
  }

  void resize(PointBlock& block, std::size_t count, std::size_t extra_bytes) const {
    block.position.resize(count);
    if (schema_.has_normal) block.normal.resize(count);
    if (schema_.has_colour) block.colour.resize(count);
    block.extras.resize(count * extra_bytes);
  }

  File file_;
  std::unique_ptr<void, E57Free> scans_;
  PointSchema schema_;
};

}  // namespace

std::unique_ptr<PointReader> open_e57(File file) { return std::make_unique<E57Reader>(std::move(file)); }

}  // namespace chiaro::stream
