#include "stream/cloud/filtered.h"

#include <algorithm>
#include <cmath>
#include <cstring>
#include <stdexcept>

#include "stream/base/error.h"

namespace chiaro::stream {
namespace {

constexpr std::size_t kBlock = 65536;

class TransformedReader final : public PointReader {
 public:
  TransformedReader(std::unique_ptr<PointReader> reader, const Eigen::Isometry3d& motion) : reader_(std::move(reader)), motion_(motion) {}
  const PointSchema& schema() const override { return reader_->schema(); }
  bool read(PointBlock& block, std::size_t max_points) override {
    if (!reader_->read(block, max_points)) return false;
    const Eigen::Matrix3f turn = motion_.linear().cast<float>();
    for (Vec3d& p : block.position) p = motion_ * p;
    for (Vec3f& n : block.normal) n = turn * n;
    return true;
  }

 private:
  std::unique_ptr<PointReader> reader_;
  Eigen::Isometry3d motion_;
};

class MarkedReader final : public PointReader {
 public:
  MarkedReader(std::unique_ptr<PointReader> reader, std::shared_ptr<const OutlierMarks> marks)
      : reader_(std::move(reader)), marks_(std::move(marks)), schema_(reader_->schema()) {
    extra_bytes_ = schema_.extra_bytes();
    if (schema_.declared_points >= marks_->num_rejected) schema_.declared_points -= marks_->num_rejected;
  }
  const PointSchema& schema() const override { return schema_; }
  bool read(PointBlock& block, std::size_t max_points) override {
    while (reader_->read(block, max_points)) {
      drop_marked(block);
      if (block.size() > 0) return true;
    }
    return false;
  }

 private:
  void drop_marked(PointBlock& block) {
    const std::size_t count = block.size();
    if (count > marks_->num_points - next_)
      throw Error(concat("the cloud has more than the ", marks_->num_points, " points that were searched for outliers"));
    std::size_t kept = 0;
    for (std::size_t i = 0; i < count; ++i) {
      if (marks_->rejected(next_ + i)) continue;
      if (kept != i) {
        block.position[kept] = block.position[i];
        if (schema_.has_normal) block.normal[kept] = block.normal[i];
        if (schema_.has_colour) block.colour[kept] = block.colour[i];
        if (extra_bytes_ > 0) std::memcpy(block.extras.data() + kept * extra_bytes_, block.extras.data() + i * extra_bytes_, extra_bytes_);
      }
      ++kept;
    }
    next_ += count;
    block.position.resize(kept);
    if (schema_.has_normal) block.normal.resize(kept);
    if (schema_.has_colour) block.colour.resize(kept);
    block.extras.resize(kept * extra_bytes_);
  }

  std::unique_ptr<PointReader> reader_;
  std::shared_ptr<const OutlierMarks> marks_;
  PointSchema schema_;
  std::size_t extra_bytes_ = 0;
  std::uint64_t next_ = 0;
};

double diagonal_of(const std::vector<Vec3d>& points) {
  Box3d box;
  for (const Vec3d& p : points) box.extend(p);
  return box.empty() ? 0 : (box.max - box.min).norm();
}

}  // namespace

std::unique_ptr<PointReader> transformed(std::unique_ptr<PointReader> reader, const Eigen::Isometry3d& target_from_source) {
  return std::make_unique<TransformedReader>(std::move(reader), target_from_source);
}

std::unique_ptr<PointReader> without_marked(std::unique_ptr<PointReader> reader, std::shared_ptr<const OutlierMarks> marks) {
  return std::make_unique<MarkedReader>(std::move(reader), std::move(marks));
}

std::unique_ptr<PointReader> remove_outliers(const std::function<std::unique_ptr<PointReader>()>& open, const OutlierOptions& options,
                                             Reporter& report, std::shared_ptr<const OutlierMarks>* marks) {
  const auto found = std::make_shared<const OutlierMarks>(mark_outliers(*open(), options, report));
  if (marks) *marks = found;
  return without_marked(open(), found);
}

std::vector<Vec3d> subsample(PointReader& reader, std::size_t max_points, Reporter& report) {
  if (max_points < 1) throw std::invalid_argument("subsample: max_points must be 1 or more");
  std::vector<Vec3d> kept;
  std::uint64_t stride = 1, index = 0;
  PointBlock block;
  while (reader.read(block, kBlock)) {
    report.check();
    for (const Vec3d& p : block.position) {
      if (!p.allFinite()) continue;
      if (index++ % stride == 0) kept.push_back(p);
      if (kept.size() <= 2 * max_points) continue;
      for (std::size_t i = 0; 2 * i < kept.size(); ++i) kept[i] = kept[2 * i];
      kept.resize((kept.size() + 1) / 2);
      stride *= 2;
    }
  }
  if (kept.size() > max_points) {
    for (std::size_t i = 0; 2 * i < kept.size(); ++i) kept[i] = kept[2 * i];
    kept.resize((kept.size() + 1) / 2);
  }
  return kept;
}

IcpResult align_files(const std::filesystem::path& target_path, const std::filesystem::path& source_path, const AlignOptions& options,
                      Reporter& report) {
  const std::vector<Vec3d> target = subsample(*open_points(target_path, options.memory_bytes), options.max_points, report);
  const std::vector<Vec3d> source = subsample(*open_points(source_path, options.memory_bytes), options.max_points, report);
  report.check();
  const double max_distance = options.max_distance > 0 ? options.max_distance : 0.02 * diagonal_of(target);
  if (!(max_distance > 0)) throw Error(concat(target_path.string(), ": all points lie in one place, nothing to align to"));
  return align_icp(source, target, max_distance, options.max_iterations);
}

}  // namespace chiaro::stream
