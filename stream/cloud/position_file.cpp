#include "stream/cloud/position_file.h"

namespace chiaro::stream {
namespace {

class Splitter {
 public:
  Splitter(File& records, File& other, std::uint64_t capacity, Reporter& report)
      : records_(records), other_(other), capacity_(capacity), report_(report) {}

  PositionSplit split(std::uint64_t count) {
    std::vector<PositionLeaf> open = {{0, count, bounds_of(0, count)}};
    PositionSplit result{{}, open[0].box};
    std::vector<PositionLeaf>& leaves = result.leaves;
    while (!open.empty()) {
      report_.check();
      const PositionLeaf node = open.back();
      open.pop_back();
      if (node.count == 0) continue;
      if (node.count <= capacity_) {
        leaves.push_back(node);
      } else if ((node.box.max.array() == node.box.min.array()).all()) {
        // All in one place: any cut is as good as another.
        for (std::uint64_t at = 0; at < node.count; at += capacity_)
          leaves.push_back({node.first + at, std::min(capacity_, node.count - at), node.box});
      } else {
        const auto [low, high] = cut(node);
        open.push_back(high);
        open.push_back(low);
      }
    }
    return result;
  }

 private:
  Box3d bounds_of(std::uint64_t first, std::uint64_t count) const {
    Box3d box;
    for_records(records_, first, count, [&](const PositionRecord& r) { box.extend(r.at()); });
    return box;
  }

  // The middle of the box always parts it; the median of a sample does so into equal halves, unless many values are the same.
  std::pair<PositionLeaf, PositionLeaf> cut(const PositionLeaf& node) {
    int axis = 0;
    (node.box.max - node.box.min).maxCoeff(&axis);
    double at = sample_median(node, axis);
    if (!(at >= node.box.min[axis] && at < node.box.max[axis])) at = node.box.min[axis] + (node.box.max[axis] - node.box.min[axis]) / 2;
    if (!(at < node.box.max[axis])) at = node.box.min[axis];
    std::uint64_t num_low = 0;
    for_records(records_, node.first, node.count, [&](const PositionRecord& r) { num_low += r.position[axis] <= at; });
    PositionLeaf low{node.first, num_low, {}}, high{node.first + num_low, node.count - num_low, {}};
    PositionSink lows(other_, low.first, 16384), highs(other_, high.first, 16384);
    for_records(records_, node.first, node.count, [&](const PositionRecord& r) {
      const bool is_low = r.position[axis] <= at;
      (is_low ? lows : highs).add(r);
      (is_low ? low : high).box.extend(r.at());
    });
    lows.flush();
    highs.flush();
    copy_back(node);
    return {low, high};
  }

  double sample_median(const PositionLeaf& node, int axis) const {
    constexpr std::uint64_t kSamples = 1024;
    const std::uint64_t stride = std::max<std::uint64_t>(1, node.count / kSamples);
    std::vector<double> values;
    for (std::uint64_t i = 0; i < node.count; i += stride) {
      PositionRecord record;
      records_.read_at((node.first + i) * sizeof(PositionRecord), &record, sizeof record);
      values.push_back(record.position[axis]);
    }
    std::nth_element(values.begin(), values.begin() + static_cast<std::ptrdiff_t>(values.size() / 2), values.end());
    return values[values.size() / 2];
  }

  void copy_back(const PositionLeaf& node) {
    std::vector<char> buffer(1 << 20);
    const std::uint64_t begin = node.first * sizeof(PositionRecord), bytes = node.count * sizeof(PositionRecord);
    for (std::uint64_t done = 0; done < bytes;) {
      const std::size_t n = static_cast<std::size_t>(std::min<std::uint64_t>(buffer.size(), bytes - done));
      other_.read_at(begin + done, buffer.data(), n);
      records_.write_at(begin + done, buffer.data(), n);
      done += n;
    }
  }

  File& records_;
  File& other_;
  std::uint64_t capacity_;
  Reporter& report_;
};

}  // namespace

PositionSplit split_positions(File& records, File& other, std::uint64_t count, std::uint64_t capacity, Reporter& report) { return Splitter(records, other, capacity, report).split(count); }

}  // namespace chiaro::stream
