// Vertices with lists in binary PLY (OpenMVS names the photographs that see a point): rows of unequal length, brought to rows of scalars one after the other.
#include "stream/cloud/ply_list_rows.h"

#include <algorithm>
#include <cstring>

#include "stream/base/error.h"
#include "stream/cloud/scalars.h"

namespace chiaro::stream {
namespace {

class ListRowReader final : public PointReader {
 public:
  ListRowReader(File file, RowDecoder decoder, ListRows rows) : file_(std::move(file)), size_(file_.size()), decoder_(std::move(decoder)), rows_(std::move(rows)), at_(rows_.offset) {
    rows_at_once_ = std::clamp<std::size_t>(kWindowBytes / decoder_.layout().row_bytes, 1, 32768);
    check_count();
    if (!decoder_.needs_colour_samples()) return;
    const std::size_t count = fill(rows_at_once_);
    decoder_.sample_colours(packed_.data(), count);
    decoder_.decide_colour_scale();
    at_ = rows_.offset;
    done_ = 0;
  }
  const PointSchema& schema() const override { return decoder_.schema(); }
  void wants(PointParts parts) override { decoder_.wants(parts); }

  bool read(PointBlock& block, std::size_t max_points) override {
    block.clear();
    while (block.size() < max_points) {
      const std::size_t count = fill(std::min(max_points - block.size(), rows_at_once_));
      if (count == 0) break;
      decoder_.decode(packed_.data(), count, block);
    }
    return block.size() > 0;
  }

 private:
  static constexpr std::size_t kWindowBytes = 1 << 20;

  /// A row with empty lists is the shortest.
  void check_count() const {
    std::uint64_t least = 0;
    for (const ListColumn& column : rows_.columns) least += scalar_bytes(column.is_list ? column.count_type : column.type);
    const std::uint64_t left = size_ > rows_.offset ? size_ - rows_.offset : 0;
    if (rows_.count > left / least)
      throw Error(concat(file_.path().string(), ": the header declares ", rows_.count, " points of ", least, " bytes or more from offset ", rows_.offset, ", the file has ", size_, " bytes"));
  }

  /// Packs up to `most` further rows.
  std::size_t fill(std::size_t most) {
    const std::size_t row_bytes = decoder_.layout().row_bytes;
    const auto count = static_cast<std::size_t>(std::min<std::uint64_t>(most, rows_.count - done_));
    packed_.resize(count * row_bytes);
    for (std::size_t i = 0; i < count; ++i, ++done_) pack(packed_.data() + i * row_bytes);
    return count;
  }

  void pack(std::byte* to) {
    for (const ListColumn& column : rows_.columns) {
      if (!column.is_list) {
        take(column.type, to);
        to += scalar_bytes(column.type);
        continue;
      }
      std::byte bytes[8];
      take(column.count_type, bytes);
      const double length = load_scalar(column.count_type, bytes);
      if (!(length >= 0) || length * static_cast<double>(scalar_bytes(column.type)) > static_cast<double>(size_ - at_))
        throw Error(concat(file_.path().string(), ": offset ", at_, ": list '", column.name, "' of point ", done_ + 1, " of ", rows_.count, " has ", length, " entries, the file has ", size_, " bytes"));
      at_ += static_cast<std::uint64_t>(length) * scalar_bytes(column.type);
    }
  }

  /// The next scalar, little-endian.
  void take(ScalarType type, std::byte* to) {
    const std::size_t bytes = scalar_bytes(type);
    if (at_ < window_offset_ || at_ + bytes > window_offset_ + window_.size()) {
      window_.resize(kWindowBytes);
      window_.resize(file_.read_some_at(at_, window_.data(), window_.size()));
      window_offset_ = at_;
      if (window_.size() < bytes) throw Error(concat(file_.path().string(), ": ", done_, " of ", rows_.count, " points read, the file ends early at offset ", at_));
    }
    std::memcpy(to, window_.data() + (at_ - window_offset_), bytes);
    if (rows_.swap_bytes) std::reverse(to, to + bytes);
    at_ += bytes;
  }

  File file_;
  std::uint64_t size_;
  RowDecoder decoder_;
  ListRows rows_;
  std::uint64_t at_, done_ = 0, window_offset_ = 0;
  std::size_t rows_at_once_ = 1;
  std::vector<std::byte> window_, packed_;
};

}  // namespace

std::unique_ptr<PointReader> read_list_rows(File file, RowDecoder decoder, ListRows rows) { return std::make_unique<ListRowReader>(std::move(file), std::move(decoder), std::move(rows)); }

}  // namespace chiaro::stream
