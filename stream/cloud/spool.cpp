#include "stream/cloud/spool.h"

#include <fcntl.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstring>
#include <optional>

#include "stream/base/error.h"
#include "stream/base/file.h"

namespace chiaro::stream {

struct PointSpool::Spooled {
  File file;
  std::uint64_t bytes = 0;
  bool complete = false;
};

namespace {

namespace fs = std::filesystem;

/// Before the points of each block. Sections follow in this order: positions, normals, colours.
struct BlockHead {
  std::uint32_t points = 0;
  std::uint8_t on_grid = 0;        // positions as three 32-bit integers
  std::uint8_t colour_8_bit = 0;   // colours as bytes, that times 257
  std::uint8_t padding[2] = {};
};

template <class T>
void append(std::vector<std::byte>& to, const T* values, std::size_t count) {
  const std::size_t at = to.size();
  to.resize(at + count * sizeof(T));
  if (count > 0) std::memcpy(to.data() + at, values, count * sizeof(T));
}

// The integers of the positions, if they give them back bit by bit.
bool find_cells(const std::vector<Vec3d>& positions, const PositionGrid& grid, std::vector<std::int32_t>& cells) {
  cells.resize(3 * positions.size());
  const Vec3d steps = grid.scale.cwiseInverse();
  for (std::size_t i = 0; i < positions.size(); ++i)
    for (int k = 0; k < 3; ++k) {
      const double cell = std::nearbyint((positions[i][k] - grid.add[k]) * steps[k]);
      if (!(std::abs(cell) <= 2147483647.0)) return false;
      const auto stored = static_cast<std::int32_t>(cell);
      if (stored * grid.scale[k] + grid.add[k] != positions[i][k]) return false;
      cells[3 * i + static_cast<std::size_t>(k)] = stored;
    }
  return true;
}

bool find_bytes(const std::vector<std::array<std::uint16_t, 3>>& colours, std::vector<std::uint8_t>& bytes) {
  bytes.resize(3 * colours.size());
  for (std::size_t i = 0; i < colours.size(); ++i)
    for (std::size_t k = 0; k < 3; ++k) {
      const unsigned byte = colours[i][k] >> 8;
      if (257 * byte != colours[i][k]) return false;
      bytes[3 * i + k] = static_cast<std::uint8_t>(byte);
    }
  return true;
}

class BlockPacker {
 public:
  explicit BlockPacker(const std::optional<PositionGrid>& grid) : grid_(grid) {}

  const std::vector<std::byte>& pack(const PointBlock& block) {
    BlockHead head;
    head.points = static_cast<std::uint32_t>(block.size());
    head.on_grid = grid_ && find_cells(block.position, *grid_, cells_);
    head.colour_8_bit = find_bytes(block.colour, colours_);
    packed_.clear();
    append(packed_, &head, 1);
    if (head.on_grid) append(packed_, cells_.data(), cells_.size());
    else append(packed_, block.position.data()->data(), 3 * block.size());
    append(packed_, block.normal.data(), block.normal.size());
    if (head.colour_8_bit) append(packed_, colours_.data(), colours_.size());
    else append(packed_, block.colour.data(), block.colour.size());
    return packed_;
  }

 private:
  std::optional<PositionGrid> grid_;
  std::vector<std::int32_t> cells_;
  std::vector<std::uint8_t> colours_;
  std::vector<std::byte> packed_;
};

/// Passes points on and keeps them.
class KeepingReader final : public PointReader {
 public:
  KeepingReader(std::unique_ptr<PointReader> source, std::shared_ptr<PointSpool::Spooled> spooled, fs::path folder)
      : source_(std::move(source)), spooled_(std::move(spooled)), folder_(std::move(folder)), packer_(source_->schema().grid) {
    source_->wants(PointParts::kNoExtras);
  }

  const PointSchema& schema() const override { return source_->schema(); }

  bool read(PointBlock& block, std::size_t max_points) override {
    const bool more = source_->read(block, max_points);
    if (!spooled_) return more;
    try {
      if (more) keep(block);
      else spooled_->complete = true;
    } catch (const Error&) {  // a full disk, for instance
      give_up();
    }
    return more;
  }

 private:
  void keep(const PointBlock& block) {
    const std::vector<std::byte>& packed = packer_.pack(block);
    spooled_->file.write_at(spooled_->bytes, packed.data(), packed.size());
    spooled_->bytes += packed.size();
    // Half of the free disk at most.
    if (++blocks_ % 64 == 0 && free_disk_bytes(folder_) < spooled_->bytes) give_up();
  }

  void give_up() {
    spooled_->file = File();
    spooled_.reset();
  }

  std::unique_ptr<PointReader> source_;
  std::shared_ptr<PointSpool::Spooled> spooled_;  // none: given up
  fs::path folder_;
  BlockPacker packer_;
  std::uint64_t blocks_ = 0;
};

/// Gives kept points back, once.
class ReplayReader final : public PointReader {
 public:
  ReplayReader(std::shared_ptr<PointSpool::Spooled> spooled, const PointReader& source)
      : spooled_(std::move(spooled)), schema_(source.schema()), grid_(source.schema().grid) {}

  const PointSchema& schema() const override { return schema_; }

  bool read(PointBlock& block, std::size_t max_points) override {
    block.clear();
    if (next_ == pending_.size() && !load()) return false;
    const std::size_t count = std::min(max_points, pending_.size() - next_);
    if (next_ == 0 && count == pending_.size()) {
      std::swap(block, pending_);
      pending_.clear();
      return true;
    }
    copy(pending_.position, block.position, count);
    copy(pending_.normal, block.normal, count);
    copy(pending_.colour, block.colour, count);
    next_ += count;
    return count > 0;
  }

 private:
  template <class T>
  void copy(const std::vector<T>& from, std::vector<T>& to, std::size_t count) const {
    if (from.empty()) return;
    const auto first = from.begin() + static_cast<std::ptrdiff_t>(next_);
    to.assign(first, first + static_cast<std::ptrdiff_t>(count));
  }

  template <class T>
  void take(T* to, std::size_t count) {
    if (count > 0) spooled_->file.read_at(offset_, to, count * sizeof(T));
    offset_ += count * sizeof(T);
  }

  bool load() {
    pending_.clear();
    next_ = 0;
    if (offset_ == spooled_->bytes) return false;
    const std::uint64_t begin = offset_;
    BlockHead head;
    take(&head, 1);
    const std::size_t count = head.points;
    pending_.position.resize(count);
    if (head.on_grid) {
      cells_.resize(3 * count);
      take(cells_.data(), cells_.size());
      for (std::size_t i = 0; i < count; ++i)
        for (int k = 0; k < 3; ++k) pending_.position[i][k] = cells_[3 * i + static_cast<std::size_t>(k)] * grid_->scale[k] + grid_->add[k];
    } else {
      take(pending_.position.data()->data(), 3 * count);
    }
    if (schema_.has_normal) {
      pending_.normal.resize(count);
      take(pending_.normal.data()->data(), 3 * count);
    }
    if (schema_.has_colour) load_colours(head, count);
    // Whole pages before the next block; a file system that cannot do this keeps the space until the end.
    if (::fallocate(spooled_->file.descriptor(), FALLOC_FL_PUNCH_HOLE | FALLOC_FL_KEEP_SIZE, static_cast<::off_t>(begin), static_cast<::off_t>(offset_ - begin)) != 0) {
    }
    return true;
  }

  void load_colours(const BlockHead& head, std::size_t count) {
    pending_.colour.resize(count);
    if (!head.colour_8_bit) return take(pending_.colour.data()->data(), 3 * count);
    bytes_.resize(3 * count);
    take(bytes_.data(), bytes_.size());
    for (std::size_t i = 0; i < count; ++i)
      for (std::size_t k = 0; k < 3; ++k) pending_.colour[i][k] = static_cast<std::uint16_t>(257 * bytes_[3 * i + k]);
  }

  std::shared_ptr<PointSpool::Spooled> spooled_;
  PointSchema schema_;
  std::optional<PositionGrid> grid_;
  PointBlock pending_;
  std::size_t next_ = 0;
  std::uint64_t offset_ = 0;
  std::vector<std::int32_t> cells_;
  std::vector<std::uint8_t> bytes_;
};

/// A file that is gone when it is closed.
File nameless_file(const fs::path& folder, std::size_t cloud) {
  const fs::path path = folder / concat("spool_", cloud, ".tmp");
  File file(path, File::Mode::kCreate);
  fs::remove(path);
  return file;
}

}  // namespace

std::unique_ptr<PointReader> PointSpool::open(std::size_t cloud, Reading reading, const std::function<std::unique_ptr<PointReader>()>& open_source) {
  std::unique_ptr<PointReader> source = open_source();
  if (!source->decodes_slowly()) return source;
  std::shared_ptr<Spooled> spooled = std::move(clouds_[cloud]);  // an older one is given up
  clouds_.erase(cloud);
  if (reading == Reading::kSecond) {
    if (spooled && spooled->complete) return std::make_unique<ReplayReader>(std::move(spooled), *source);
    return source;
  }
  try {
    spooled = std::make_shared<Spooled>();
    spooled->file = nameless_file(folder_, cloud);
  } catch (const std::exception&) {
    return source;
  }
  clouds_[cloud] = spooled;
  return std::make_unique<KeepingReader>(std::move(source), spooled, folder_);
}

}  // namespace chiaro::stream
