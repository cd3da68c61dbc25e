// LAZ: the chunks of a file are independent, so a few are decompressed at once and handed out one after the other.
#include "stream/cloud/laz_rows.h"

#include <algorithm>

#include "stream/base/parallel.h"
#include "stream/cloud/rust_formats.h"

namespace chiaro::stream {
namespace {

struct LazFree {
  void operator()(void* laz) const { chiaro_laz_free(laz); }
};
struct DecoderFree {
  void operator()(void* decoder) const { chiaro_laz_decoder_free(decoder); }
};
using LazPtr = std::unique_ptr<void, LazFree>;
using DecoderPtr = std::unique_ptr<void, DecoderFree>;

constexpr std::uint64_t kBlockBytes = 1 << 20;           // of rows of a chunk that is streamed
constexpr std::uint64_t kWholeChunkBytes = 8ull << 20;   // a chunk that takes no more is decompressed in one go, beside others
constexpr std::size_t kChunksPerThread = 2;              // chunks take unequal time

class LazReader final : public PointReader {
 public:
  LazReader(File file, RowDecoder decoder, const LazRows& rows)
      : file_(std::move(file)), decoder_(std::move(decoder)), row_bytes_(decoder_.layout().row_bytes), memory_bytes_(rows.memory_bytes),
        whole_bytes_(std::min(kWholeChunkBytes, rows.memory_bytes / 16)) {
    open(rows);
    if (decoder_.needs_colour_samples()) sample_colours();
  }

  const PointSchema& schema() const override { return decoder_.schema(); }

  bool decodes_slowly() const override { return true; }

  // Spares the decompression of layers that nobody looks at, too.
  void wants(PointParts parts) override {
    parts_ = parts;
    decoder_.wants(parts);
  }

  bool read(PointBlock& block, std::size_t max_points) override {
    block.clear();
    while (block.size() < max_points) {
      if (front_ == pieces_.size() && !fill()) break;
      Piece& piece = pieces_[front_];
      const std::size_t count = std::min(max_points - block.size(), piece.count - piece.next);
      decoder_.decode(piece.rows.data() + piece.next * row_bytes_, count, block);
      piece.next += count;
      if (piece.next == piece.count) ++front_;
    }
    return block.size() > 0;
  }

 private:
  struct Piece {
    std::vector<std::byte> rows;
    std::size_t count = 0, next = 0;
  };

  void check(int code, const char* message) const {
    if (code != 0) throw Error(concat(file_.path().string(), ": ", message));
  }

  void open(const LazRows& rows) {
    ChiaroLazInput input{};
    input.descriptor = file_.descriptor();
    input.point_format = rows.point_format;
    input.file_bytes = file_.size();
    input.point_offset = rows.point_offset;
    input.count = rows.count;
    input.record_bytes = row_bytes_;
    input.vlr = reinterpret_cast<const std::uint8_t*>(rows.vlr.data());
    input.vlr_bytes = rows.vlr.size();
    char message[CHIARO_RUST_MESSAGE_BYTES] = {};
    void* handle = nullptr;
    check(chiaro_laz_open(&input, &handle, message), message);
    laz_.reset(handle);
    num_chunks_ = chiaro_laz_num_chunks(handle);
  }

  DecoderPtr make_decoder(std::uint64_t chunk) const {
    const std::uint64_t needed = chiaro_laz_chunk(laz_.get(), chunk).decoder_bytes;
    if (needed > memory_bytes_)
      throw Error(concat(file_.path().string(), ": chunk ", chunk + 1, " of ", num_chunks_, " has ", needed, " compressed bytes, ", memory_bytes_,
                         " are allowed; write the file with smaller chunks"));
    char message[CHIARO_RUST_MESSAGE_BYTES] = {};
    void* handle = nullptr;
    check(chiaro_laz_decoder_new(laz_.get(), chunk, static_cast<int>(parts_), &handle, message), message);
    return DecoderPtr(handle);
  }

  void decode(void* decoder, Piece& piece, std::size_t count) const {
    piece.rows.resize(count * row_bytes_);
    piece.count = count;
    piece.next = 0;
    char message[CHIARO_RUST_MESSAGE_BYTES] = {};
    check(chiaro_laz_decode(decoder, reinterpret_cast<std::uint8_t*>(piece.rows.data()), piece.rows.size(), message), message);
  }

  bool is_whole(const ChiaroLazChunk& chunk) const {
    return chunk.points <= whole_bytes_ / row_bytes_ && chunk.decoder_bytes <= whole_bytes_;
  }

  // The next pieces in file order; false at the end of the file.
  bool fill() {
    front_ = 0;
    pieces_.resize(std::max(pieces_.size(), std::size_t{1}));
    if (streamed_) return stream_piece();
    if (next_chunk_ == num_chunks_) return false;
    std::size_t count = 0;
    const std::size_t most = kChunksPerThread * static_cast<std::size_t>(std::max(1, ThreadLimit::current()));
    while (count < most && next_chunk_ + count < num_chunks_ && is_whole(chiaro_laz_chunk(laz_.get(), next_chunk_ + count))) ++count;
    if (count == 0) {
      streamed_ = make_decoder(next_chunk_);
      left_in_chunk_ = chiaro_laz_chunk(laz_.get(), next_chunk_).points;
      ++next_chunk_;
      return stream_piece();
    }
    pieces_.resize(count);
    parallel_blocks(count, 1, [&](std::size_t begin, std::size_t end) {
      for (std::size_t i = begin; i < end; ++i) {
        const std::uint64_t chunk = next_chunk_ + i;
        const DecoderPtr decoder = make_decoder(chunk);
        decode(decoder.get(), pieces_[i], static_cast<std::size_t>(chiaro_laz_chunk(laz_.get(), chunk).points));
      }
    });
    next_chunk_ += count;
    return true;
  }

  bool stream_piece() {
    pieces_.resize(1);
    const std::uint64_t count = std::min<std::uint64_t>(left_in_chunk_, std::max<std::uint64_t>(1, kBlockBytes / row_bytes_));
    decode(streamed_.get(), pieces_[0], static_cast<std::size_t>(count));
    left_in_chunk_ -= count;
    if (left_in_chunk_ == 0) streamed_.reset();
    return true;
  }

  // The first points of chunks that are spread over the file.
  void sample_colours() {
    constexpr std::uint64_t kRuns = 32, kRunLength = 256;
    Piece piece;
    for (std::uint64_t run = 0; run < std::min(kRuns, num_chunks_); ++run) {
      const std::uint64_t chunk = run * num_chunks_ / std::min(kRuns, num_chunks_);
      const DecoderPtr decoder = make_decoder(chunk);
      decode(decoder.get(), piece, static_cast<std::size_t>(std::min(kRunLength, chiaro_laz_chunk(laz_.get(), chunk).points)));
      decoder_.sample_colours(piece.rows.data(), piece.count);
    }
    decoder_.decide_colour_scale();
  }

  File file_;
  RowDecoder decoder_;
  std::size_t row_bytes_;
  std::uint64_t memory_bytes_, whole_bytes_;
  PointParts parts_ = PointParts::kAll;
  LazPtr laz_;
  std::uint64_t num_chunks_ = 0, next_chunk_ = 0;
  DecoderPtr streamed_;  // of a chunk too large for one piece
  std::uint64_t left_in_chunk_ = 0;
  std::vector<Piece> pieces_;
  std::size_t front_ = 0;
};

}  // namespace

std::unique_ptr<PointReader> read_laz_rows(File file, RowDecoder decoder, LazRows rows) {
  if (rows.vlr.empty())
    throw Error(concat(file.path().string(), ": the header says that the points are compressed (LAZ), and no record 22204 of 'laszip encoded' says how"));
  return std::make_unique<LazReader>(std::move(file), std::move(decoder), rows);
}

}  // namespace chiaro::stream
