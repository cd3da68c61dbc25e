/// Positions on disk, and their split into boxes that fit in memory: the scratch files of the search for outliers. Internal to stream/cloud.
#pragma once
#include <algorithm>
#include <cstdint>
#include <vector>

#include "stream/base/file.h"
#include "stream/base/report.h"
#include "stream/base/types.h"

namespace chiaro::stream {

struct PositionRecord {
  double position[3];
  std::uint64_t index;
  Vec3d at() const { return {position[0], position[1], position[2]}; }
};
static_assert(sizeof(PositionRecord) == 32);

struct PositionLeaf {
  std::uint64_t first = 0, count = 0;  ///< records in the file
  Box3d box;
};

/// Appends records through a buffer to one place of a file.
class PositionSink {
 public:
  PositionSink(File& file, std::uint64_t first, std::size_t buffered) : file_(&file), next_(first), limit_(buffered) {
    buffer_.reserve(limit_);
  }
  void add(const PositionRecord& record) {
    buffer_.push_back(record);
    if (buffer_.size() >= limit_) flush();
  }
  void flush() {
    if (!buffer_.empty()) file_->write_at(next_ * sizeof(PositionRecord), buffer_.data(), buffer_.size() * sizeof(PositionRecord));
    next_ += buffer_.size();
    buffer_.clear();
  }

 private:
  File* file_;
  std::uint64_t next_;
  std::size_t limit_;
  std::vector<PositionRecord> buffer_;
};

/// visit(record) for each, in order.
template <class Visit>
void for_records(const File& file, std::uint64_t first, std::uint64_t count, const Visit& visit) {
  constexpr std::uint64_t kAtOnce = 32768;
  std::vector<PositionRecord> buffer(std::min(kAtOnce, count));
  for (std::uint64_t done = 0; done < count;) {
    const std::uint64_t n = std::min<std::uint64_t>(buffer.size(), count - done);
    file.read_at((first + done) * sizeof(PositionRecord), buffer.data(), n * sizeof(PositionRecord));
    for (std::uint64_t i = 0; i < n; ++i) visit(buffer[i]);
    done += n;
  }
}

struct PositionSplit {
  std::vector<PositionLeaf> leaves;   ///< their boxes do not overlap
  Box3d bounds;                       ///< of all
};

/// Splits the first `count` records into leaves of at most `capacity`, around medians of a sample, partitioning back
/// and forth between two files. In the end `records` has them leaf by leaf.
PositionSplit split_positions(File& records, File& other, std::uint64_t count, std::uint64_t capacity, Reporter& report);

}  // namespace chiaro::stream
