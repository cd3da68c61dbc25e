// Statistical outliers of a stream that does not fit in memory.
//
// 1. Positions with their running numbers go to a scratch file.
// 2. The file is split, around medians of a sample, into leaves that fit in memory; the leaves' boxes do not overlap.
// 3. Each leaf is searched: first among its own points, then, where neighbours may lie across its border, among the points around it (the
// halo).
// 4. What is still open (points further from everything than the halo is wide: mostly the outliers themselves) is searched in every leaf in
// reach. So every mean distance is exact, and mean, deviation and threshold are those of the whole cloud.
#include <algorithm>
#include <cmath>
#include <cstring>
#include <limits>
#include <stdexcept>

#include "stream/base/error.h"
#include "stream/base/file.h"
#include "stream/base/parallel.h"
#include "stream/cloud/filtered.h"
#include "stream/cloud/position_file.h"

namespace chiaro::stream {
namespace {

double distance_to_box(const Vec3d& p, const Box3d& box) { return (box.min - p).cwiseMax(p - box.max).cwiseMax(0.0).norm(); }

double distance_between(const Box3d& a, const Box3d& b) { return (a.min - b.max).cwiseMax(b.min - a.max).cwiseMax(0.0).norm(); }

/// How far a point inside the box is from its nearest side.
double depth_in_box(const Vec3d& p, const Box3d& box) {
  return std::max(0.0, std::min((p - box.min).minCoeff(), (box.max - p).minCoeff()));
}

/// Merges `found` sorted distances into the k smallest of `best`, sorted too.
void merge(double* best, std::size_t k, const double* distances, std::size_t found, std::vector<double>& scratch) {
  if (found == 0 || !(distances[0] < best[k - 1])) return;
  scratch.resize(k + found);
  std::merge(best, best + k, distances, distances + found, scratch.begin());
  std::copy_n(scratch.begin(), k, best);
}

/// Interleaves the low ten bits of three numbers.
std::uint32_t morton(const Vec3d& unit) {
  std::uint32_t code = 0;
  for (int axis = 0; axis < 3; ++axis) {
    std::uint32_t v = static_cast<std::uint32_t>(std::clamp(unit[axis], 0.0, 1.0) * 1023);
    v = (v | (v << 16)) & 0x030000ffu;
    v = (v | (v << 8)) & 0x0300f00fu;
    v = (v | (v << 4)) & 0x030c30c3u;
    v = (v | (v << 2)) & 0x09249249u;
    code |= v << axis;
  }
  return code;
}

/// Neighbours next to each other in memory: searching them in this order halves the time for clouds in random order.
void sort_along_curve(std::vector<Vec3d>& points, std::vector<std::uint64_t>& indices, const Box3d& box) {
  const Vec3d size = (box.max - box.min).cwiseMax(1e-300);
  std::vector<std::pair<std::uint32_t, std::uint32_t>> order(points.size());
  for (std::size_t i = 0; i < points.size(); ++i)
    order[i] = {morton((points[i] - box.min).cwiseQuotient(size)), static_cast<std::uint32_t>(i)};
  std::sort(order.begin(), order.end());
  std::vector<Vec3d> sorted_points(points.size());
  std::vector<std::uint64_t> sorted_indices(points.size());
  for (std::size_t i = 0; i < order.size(); ++i) {
    sorted_points[i] = points[order[i].second];
    sorted_indices[i] = indices[order[i].second];
  }
  points.swap(sorted_points);
  indices.swap(sorted_indices);
}

/// A point whose nearest points are not certain yet, with the best distances so far.
struct Open {
  Vec3d at;
  std::uint64_t index;
};

class OutlierSearch {
 public:
  OutlierSearch(const OutlierOptions& options, Reporter& report)
      : options_(options),
        report_(report),
        scratch_(options.scratch_folder),
        records_(scratch_.path() / "records", File::Mode::kCreate),
        other_(scratch_.path() / "split", File::Mode::kCreate) {
    if (options.neighbours < 1 || std::isnan(options.multiplier))
      throw std::invalid_argument("mark_outliers: neighbours must be 1 or more and the multiplier a number");
  }

  OutlierMarks run(PointReader& reader) {
    store(reader);
    marks_.bits.assign((marks_.num_points + 63) / 64, 0);
    if (num_finite_ < 2) return std::move(marks_);
    // The nearest of all is the point itself, at distance 0.
    k_ = static_cast<std::size_t>(std::min<std::uint64_t>(static_cast<std::uint64_t>(options_.neighbours), num_finite_ - 1)) + 1;
    const std::uint64_t memory = std::max<std::uint64_t>(options_.memory_bytes, 16 << 20);
    // A record, its float copy, PCL's point, FLANN's tree and copy are some 110 bytes; a leaf and a halo of the same size are held at a
    // time.
    capacity_ = memory / (2 * (128 + 12 * k_));
    means_ = File(scratch_.path() / "means", File::Mode::kCreate);
    PositionSplit split = split_positions(records_, other_, num_finite_, capacity_, report_);
    leaves_ = std::move(split.leaves);
    diagonal_ = (split.bounds.max - split.bounds.min).norm();
    report_.begin("outliers", num_finite_, "points");
    std::uint64_t done = 0;
    for (std::size_t i = 0; i < leaves_.size(); ++i) {
      report_.check();
      search_leaf(i);
      if (open_.size() >= max_open()) search_open();
      report_.progress(done += leaves_[i].count);
    }
    search_open();
    report_.end();
    mark();
    return std::move(marks_);
  }

 private:
  std::size_t max_open() const { return std::max<std::size_t>(1024, static_cast<std::size_t>(capacity_) / 4); }

  void store(PointReader& reader) {
    PositionSink sink(records_, 0, 32768);
    PointBlock block;
    while (reader.read(block, 65536)) {
      report_.check();
      for (const Vec3d& p : block.position) {
        const std::uint64_t index = marks_.num_points++;
        if (!p.allFinite()) continue;
        sink.add({{p.x(), p.y(), p.z()}, index});
        ++num_finite_;
      }
    }
    sink.flush();
  }

  void load(const PositionLeaf& leaf, std::vector<Vec3d>& points, std::vector<std::uint64_t>* indices) const {
    for_records(records_, leaf.first, leaf.count, [&](const PositionRecord& r) {
      points.push_back(r.at());
      if (indices) indices->push_back(r.index);
    });
  }

  /// k best distances of each query in the tree, merged into `best` (k per query).
  void search(const NeighbourTree& tree, std::span<const Vec3d> queries, double* best) const {
    constexpr std::size_t kGrain = 1024;
    parallel_blocks(queries.size(), kGrain, [&](std::size_t begin, std::size_t end) {
      std::vector<std::uint32_t> indices;
      std::vector<double> distances, scratch;
      const std::size_t found = tree.search(queries.subspan(begin, end - begin), k_, indices, distances);
      for (std::size_t q = begin; q < end; ++q) merge(best + q * k_, k_, distances.data() + (q - begin) * k_, found, scratch);
    });
  }

  void search_leaf(std::size_t leaf_idx) {
    const PositionLeaf& leaf = leaves_[leaf_idx];
    std::vector<Vec3d> points;
    std::vector<std::uint64_t> indices;
    load(leaf, points, &indices);
    sort_along_curve(points, indices, leaf.box);
    std::vector<double> best(points.size() * k_, std::numeric_limits<double>::infinity());
    search(NeighbourTree(points), points, best.data());

    double reach = 0;
    std::vector<std::size_t> border;
    if (leaves_.size() > 1) {
      for (std::size_t i = 0; i < points.size(); ++i)
        if (!(best[i * k_ + k_ - 1] <= depth_in_box(points[i], leaf.box))) border.push_back(i);
      reach = halo_width(best, border);
      search_halo(leaf_idx, points, border, best, reach);
    }
    std::vector<bool> is_border(points.size(), false);
    for (const std::size_t i : border) is_border[i] = true;
    for (std::size_t i = 0; i < points.size(); ++i) {
      const double* b = best.data() + i * k_;
      if (!is_border[i] || b[k_ - 1] <= depth_in_box(points[i], leaf.box) + reach) {
        write_mean(indices[i], b);
      } else {
        open_.push_back({points[i], indices[i]});
        open_best_.insert(open_best_.end(), b, b + k_);
      }
    }
  }

  // Wide enough for nine of ten points at the border; the others are searched one by one later.
  double halo_width(const std::vector<double>& best, const std::vector<std::size_t>& border) const {
    std::vector<double> widths;
    for (const std::size_t i : border)
      if (std::isfinite(best[i * k_ + k_ - 1])) widths.push_back(best[i * k_ + k_ - 1]);
    if (widths.empty()) return 0;
    const auto at = widths.begin() + static_cast<std::ptrdiff_t>(widths.size() * 9 / 10);
    std::nth_element(widths.begin(), at, widths.end());
    return *at;
  }

  // `reach` becomes 0 where the halo would not fit in memory.
  void search_halo(std::size_t leaf_idx, const std::vector<Vec3d>& points, const std::vector<std::size_t>& border,
                   std::vector<double>& best, double& reach) {
    const PositionLeaf& leaf = leaves_[leaf_idx];
    std::vector<Vec3d> halo;
    for (std::size_t j = 0; j < leaves_.size() && halo.size() <= capacity_; ++j) {
      if (j == leaf_idx || distance_between(leaves_[j].box, leaf.box) > reach) continue;
      for_records(records_, leaves_[j].first, leaves_[j].count, [&](const PositionRecord& r) {
        if (halo.size() <= capacity_ && distance_to_box(r.at(), leaf.box) <= reach) halo.push_back(r.at());
      });
    }
    if (halo.size() > capacity_) reach = 0;  // nothing beyond the box is known
    if (reach == 0 || halo.empty()) return;
    std::vector<Vec3d> queries;
    std::vector<double> found;
    for (const std::size_t i : border) {
      queries.push_back(points[i]);
      found.insert(found.end(), best.begin() + static_cast<std::ptrdiff_t>(i * k_),
                   best.begin() + static_cast<std::ptrdiff_t>(i * k_ + k_));
    }
    search(NeighbourTree(halo), queries, found.data());
    for (std::size_t b = 0; b < border.size(); ++b)
      std::copy_n(found.begin() + static_cast<std::ptrdiff_t>(b * k_), k_, best.begin() + static_cast<std::ptrdiff_t>(border[b] * k_));
  }

  // From scratch over all leaves in reach: what was found so far may hold points of the halo, which must not count twice.
  void search_open() {
    if (open_.empty()) return;
    std::vector<double> bound(open_.size());
    // Room for rounding: the search picks neighbours in floats.
    for (std::size_t i = 0; i < open_.size(); ++i) bound[i] = open_best_[i * k_ + k_ - 1] * (1 + 1e-6) + 1e-6 * diagonal_;
    std::fill(open_best_.begin(), open_best_.end(), std::numeric_limits<double>::infinity());
    for (const PositionLeaf& leaf : leaves_) {
      report_.check();
      std::vector<std::size_t> in_reach;
      for (std::size_t i = 0; i < open_.size(); ++i)
        if (distance_to_box(open_[i].at, leaf.box) <= std::min(bound[i], open_best_[i * k_ + k_ - 1])) in_reach.push_back(i);
      if (in_reach.empty()) continue;
      std::vector<Vec3d> points, queries;
      load(leaf, points, nullptr);
      std::vector<double> best;
      for (const std::size_t i : in_reach) {
        queries.push_back(open_[i].at);
        best.insert(best.end(), open_best_.begin() + static_cast<std::ptrdiff_t>(i * k_),
                    open_best_.begin() + static_cast<std::ptrdiff_t>(i * k_ + k_));
      }
      search(NeighbourTree(points), queries, best.data());
      for (std::size_t q = 0; q < in_reach.size(); ++q)
        std::copy_n(best.begin() + static_cast<std::ptrdiff_t>(q * k_), k_,
                    open_best_.begin() + static_cast<std::ptrdiff_t>(in_reach[q] * k_));
    }
    for (std::size_t i = 0; i < open_.size(); ++i) write_mean(open_[i].index, open_best_.data() + i * k_);
    open_.clear();
    open_best_.clear();
  }

  // As a float, as PCL keeps it. Means lie in the order of the stream, so that sums do not depend on the leaves.
  void write_mean(std::uint64_t index, const double* best) {
    double sum = 0;
    for (std::size_t j = 1; j < k_; ++j) sum += best[j];
    pending_.push_back({index, static_cast<float>(sum / static_cast<double>(k_ - 1))});
    if (pending_.size() >= 65536) flush_means();
  }

  // Sorted, so that runs of neighbouring numbers go out in one write.
  void flush_means() {
    std::sort(pending_.begin(), pending_.end(), [](const Mean& a, const Mean& b) { return a.index < b.index; });
    std::vector<float> run;
    for (std::size_t i = 0; i < pending_.size(); ++i) {
      run.push_back(pending_[i].value);
      if (i + 1 < pending_.size() && pending_[i + 1].index == pending_[i].index + 1) continue;
      means_.write_at((pending_[i].index + 1 - run.size()) * sizeof(float), run.data(), run.size() * sizeof(float));
      run.clear();
    }
    pending_.clear();
  }

  // Points without a finite position have left holes of zeros in the file: PCL counts them as 0 in its sums, and so do we.
  template <class Visit>
  void for_means(const Visit& visit) const {
    std::vector<float> buffer(65536);
    for (std::uint64_t first = 0; first < marks_.num_points; first += buffer.size()) {
      const std::size_t n = static_cast<std::size_t>(std::min<std::uint64_t>(buffer.size(), marks_.num_points - first));
      means_.read_at(first * sizeof(float), buffer.data(), n * sizeof(float));
      for (std::size_t i = 0; i < n; ++i) visit(first + i, static_cast<double>(buffer[i]));
    }
  }

  void mark() {
    flush_means();
    means_.truncate(marks_.num_points * sizeof(float));
    double sum = 0, squares = 0;
    for_means([&](std::uint64_t, double mean) {
      sum += mean;
      squares += mean * mean;
    });
    const double n = static_cast<double>(num_finite_);
    const double variance = std::max(0.0, (squares - sum * sum / n) / (n - 1));
    marks_.mean_distance = sum / n;
    marks_.threshold = marks_.mean_distance + options_.multiplier * std::sqrt(variance);
    for_means([&](std::uint64_t index, double mean) {
      if (!(mean > marks_.threshold)) return;
      marks_.bits[index >> 6] |= std::uint64_t{1} << (index & 63);
      ++marks_.num_rejected;
    });
  }

  struct Mean {
    std::uint64_t index;
    float value;
  };

  const OutlierOptions options_;
  Reporter& report_;
  ScratchFolder scratch_;
  File records_, other_, means_;
  std::uint64_t num_finite_ = 0, capacity_ = 0;
  std::size_t k_ = 0;
  double diagonal_ = 0;
  std::vector<PositionLeaf> leaves_;
  std::vector<Open> open_;
  std::vector<double> open_best_;  // k_ per open point
  std::vector<Mean> pending_;
  OutlierMarks marks_;
};

}  // namespace

OutlierMarks mark_outliers(PointReader& reader, const OutlierOptions& options, Reporter& report) {
  return OutlierSearch(options, report).run(reader);
}

}  // namespace chiaro::stream
