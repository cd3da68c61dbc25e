#include "stream/cloud/pcl_tools.h"

#include <gmock/gmock.h>

#include <cmath>

#include "cloud_test_support.h"
#include "stream/base/parallel.h"
#include "stream/base/rng.h"
#include "stream/cloud/filtered.h"

namespace chiaro::stream {
namespace {

using ::testing::HasSubstr;

Vec3d random_point(std::uint64_t i, std::uint64_t seed = 1) {
  const auto u = uniform01x4(seed, Purpose::kTest, i, 0);
  return {static_cast<double>(u[0]), static_cast<double>(u[1]), static_cast<double>(u[2])};
}

/// A wavy sheet of `count` points at a large offset, with every 97th point lifted off it.
std::vector<Vec3d> sheet(std::size_t count, double lift, const Vec3d& origin = {4e5, 5e6, 100}) {
  std::vector<Vec3d> points;
  for (std::size_t i = 0; i < count; ++i) {
    const Vec3d u = random_point(i);
    points.push_back(origin +
                     Vec3d(4 * u.x(), 3 * u.y(),
                           0.2 * std::sin(5 * u.x()) * std::cos(4 * u.y()) + (lift > 0 && i % 97 == 5 ? lift * (0.5 + u.z()) : 0)));
  }
  return points;
}

/// The rule of pcl::StatisticalOutlierRemoval, slowly and in double.
std::vector<std::uint8_t> plain_inliers(const std::vector<Vec3d>& points, int neighbours, double multiplier) {
  std::vector<double> means;
  for (const Vec3d& p : points) {
    std::vector<double> d;
    for (const Vec3d& q : points) d.push_back((p - q).norm());
    std::sort(d.begin(), d.end());
    double sum = 0;
    for (int k = 1; k <= neighbours; ++k) sum += d[static_cast<std::size_t>(k)];
    means.push_back(sum / neighbours);
  }
  double sum = 0, squares = 0;
  for (const double m : means) sum += m, squares += m * m;
  const double n = static_cast<double>(means.size());
  const double threshold = sum / n + multiplier * std::sqrt((squares - sum * sum / n) / (n - 1));
  std::vector<std::uint8_t> keep;
  for (const double m : means) keep.push_back(m <= threshold);
  return keep;
}

/// A reader over points in memory, with a running number as extra.
class MemoryReader final : public PointReader {
 public:
  explicit MemoryReader(const std::vector<Vec3d>& points) : points_(points) { schema_.extras = {{"number", ScalarType::kU32}}; }
  const PointSchema& schema() const override { return schema_; }
  bool read(PointBlock& block, std::size_t max_points) override {
    block.clear();
    for (; next_ < points_.size() && block.size() < max_points; ++next_) {
      block.position.push_back(points_[next_]);
      const std::string number = bytes_of(static_cast<std::uint32_t>(next_));
      for (const char c : number) block.extras.push_back(static_cast<std::byte>(c));
    }
    return block.size() > 0;
  }

 private:
  const std::vector<Vec3d>& points_;
  std::size_t next_ = 0;
  PointSchema schema_;
};

OutlierMarks mark(const std::vector<Vec3d>& points, std::uint64_t memory, int neighbours = 8, double multiplier = 2) {
  MemoryReader reader(points);
  OutlierOptions options;
  options.memory_bytes = memory;
  options.neighbours = neighbours;
  options.multiplier = multiplier;
  return mark_outliers(reader, options, silent_reporter());
}

TEST(StatisticalInliers, AgreeWithThePlainRule) {
  const std::vector<Vec3d> points = sheet(1500, 0.5, Vec3d::Zero());
  const std::vector<std::uint8_t> keep = statistical_inliers(points, 8, 2);
  EXPECT_EQ(keep, plain_inliers(points, 8, 2));
  EXPECT_GT(std::count(keep.begin(), keep.end(), 0), 10);
}

TEST(StatisticalInliers, TinyCloudsAndBadPositionsAreKept) {
  EXPECT_TRUE(statistical_inliers({}, 8, 2).empty());
  const std::vector<Vec3d> points = {{0, 0, 0}, {std::nan(""), 0, 0}, {1, 0, 0}, {0, 1, 0}};
  EXPECT_EQ(statistical_inliers(points, 50, 2), (std::vector<std::uint8_t>{1, 1, 1, 1}));
  EXPECT_EQ(statistical_inliers(std::vector<Vec3d>(5, Vec3d::Ones()), 3, 0), std::vector<std::uint8_t>(5, 1));
  EXPECT_THROW(statistical_inliers(points, 0, 2), std::invalid_argument);
}

TEST(MarkOutliers, GivesPclsAnswerForTheWholeCloudInAnyMemory) {
  std::vector<Vec3d> points = sheet(80'000, 0.5);
  points[77] = Vec3d(std::nan(""), 0, 0);
  points[4242] += Vec3d(0, 0, 5000);  // far from everything
  const std::vector<std::uint8_t> keep = statistical_inliers(points, 8, 2);
  // 16 MiB is the least: 35 000 points a leaf here, so four leaves with halos.
  for (const std::uint64_t memory : {std::uint64_t{1} << 30, std::uint64_t{1}}) {
    const OutlierMarks marks = mark(points, memory);
    EXPECT_EQ(marks.num_points, points.size());
    std::size_t differ = 0, rejected = 0;
    for (std::size_t i = 0; i < points.size(); ++i) {
      differ += marks.rejected(i) == (keep[i] != 0);
      rejected += marks.rejected(i);
    }
    EXPECT_EQ(rejected, marks.num_rejected);
    // PCL takes distances of coordinates rounded to float, ours are of the points as given: a mean at the threshold may fall on either
    // side.
    EXPECT_LE(differ, 1u);
    EXPECT_TRUE(marks.rejected(4242));
    EXPECT_FALSE(marks.rejected(77));
  }
}

TEST(MarkOutliers, OnePointVeryFarAwayDoesNotCostTheOthersTheirDigits) {
  std::vector<Vec3d> points = sheet(40'000, 0, Vec3d::Zero());
  const double spacing = mark(points, 1u << 30).mean_distance;
  points.push_back(Vec3d(1e12, 0, 0));
  points.push_back(Vec3d(0, 1e300, 0));
  for (const std::uint64_t memory : {std::uint64_t{1} << 30, std::uint64_t{1}}) {
    const OutlierMarks marks = mark(points, memory);
    EXPECT_EQ(marks.num_rejected, 1u);  // the mean and the deviation are of the size of the farthest point
    EXPECT_TRUE(marks.rejected(40'001));
  }
  points.pop_back();
  points.back() = Vec3d(1e6, 0, 0);
  EXPECT_NEAR(mark(points, 1).mean_distance, spacing + 1e6 / 40'001, 1e-3 * spacing + 1e-4);
}

TEST(MarkOutliers, DependsNeitherOnMemoryNorOnThreads) {
  const std::vector<Vec3d> points = sheet(60'000, 0.3);
  const OutlierMarks whole = mark(points, 1u << 30), split = mark(points, 1);
  EXPECT_EQ(whole.bits, split.bits);
  EXPECT_NEAR(whole.threshold, split.threshold, 1e-9);
  const ThreadLimit one(1);
  EXPECT_EQ(mark(points, 1).bits, split.bits);
}

TEST(MarkOutliers, ManyPointsInOnePlaceAreSplitToo) {
  std::vector<Vec3d> points(15'000, Vec3d(1, 2, 3));
  points.push_back(Vec3d(9, 9, 9));
  const OutlierMarks marks = mark(points, 1, 100);  // 6 000 points a leaf
  EXPECT_EQ(marks.num_rejected, 1u);
  EXPECT_TRUE(marks.rejected(15'000));
}

TEST(RemoveOutliers, DropsMarkedPointsWithTheirExtrasAndCountsThem) {
  const std::vector<Vec3d> points = sheet(20'000, 0.5);
  std::shared_ptr<const OutlierMarks> marks;
  const auto reader = remove_outliers([&] { return std::make_unique<MemoryReader>(points); }, OutlierOptions{}, silent_reporter(), &marks);
  const Cloud cloud = read_all(*reader, 501);
  EXPECT_EQ(cloud.points.size() + marks->num_rejected, points.size());
  EXPECT_GT(marks->num_rejected, 100u);
  for (std::size_t i = 0; i < cloud.points.size(); ++i) {
    const auto number = extra_of<std::uint32_t>(cloud, i, "number");
    ASSERT_FALSE(marks->rejected(number));
    ASSERT_EQ(cloud.points.position[i], points[number]);
  }
}

TEST(Transformed, MovesPositionsAndTurnsNormals) {
  const ScratchFolder folder;
  write_text(folder.path() / "a.xyz", "1 2 3 1 0 0\n4 5 6 0 1 0\n");
  Eigen::Isometry3d motion = Eigen::Isometry3d::Identity();
  motion.linear() = Eigen::AngleAxisd(std::acos(0.0), Vec3d::UnitZ()).toRotationMatrix();
  motion.translation() = Vec3d(10, 20, 30);
  const Cloud cloud = read_all(*transformed(open_points(folder.path() / "a.xyz"), motion));
  EXPECT_LT((cloud.points.position[0] - Vec3d(8, 21, 33)).norm(), 1e-12);
  EXPECT_LT((cloud.points.normal[0] - Vec3f(0, 1, 0)).norm(), 1e-6f);
}

/// Corner of a room with a bump: fixed in all six directions.
Vec3d corner_point(std::uint64_t i, std::uint64_t seed, const Vec3d& origin) {
  const Vec3d u = random_point(i, seed);
  Vec3d p(u.x() * 4, u.y() * 3, 0.25 * std::exp(-8 * ((u.x() - 0.4) * (u.x() - 0.4) + (u.y() - 0.6) * (u.y() - 0.6))));
  if (i % 3 == 1) p = Vec3d(u.x() * 4, 0, u.y() * 2);
  if (i % 3 == 2) p = Vec3d(0, u.x() * 3, u.y() * 2 + 0.1 * std::sin(3 * u.x()));
  return origin + p;
}

std::vector<Vec3d> corner(std::size_t count, std::uint64_t seed, const Vec3d& origin) {
  std::vector<Vec3d> points;
  for (std::size_t i = 0; i < count; ++i) points.push_back(corner_point(i, seed, origin));
  return points;
}

Eigen::Isometry3d moderate_motion(const Vec3d& about) {
  Eigen::Isometry3d motion = Eigen::Isometry3d::Identity();
  motion.linear() = Eigen::AngleAxisd(0.07, Vec3d(1, 2, 3).normalized()).toRotationMatrix();
  motion.translation() = about - motion.linear() * about + Vec3d(0.15, -0.1, 0.12);
  return motion;
}

TEST(AlignIcp, FindsAModerateMotionAtALargeOffset) {
  const Vec3d origin(4e5, 5e6, 100);
  const std::vector<Vec3d> target = corner(60'000, 1, origin);
  std::vector<Vec3d> source = corner(40'000, 2, origin);  // other samples of the same surface
  const Eigen::Isometry3d truth = moderate_motion(origin + Vec3d(2, 1.5, 1));
  for (Vec3d& p : source) p = truth.inverse() * p;
  const IcpResult result = align_icp(source, target, 1.0, 100);
  EXPECT_TRUE(result.converged);
  EXPECT_GT(result.iterations, 1);
  double worst = 0;
  for (const Vec3d& p : source) worst = std::max(worst, (result.target_from_source * p - truth * p).norm());
  EXPECT_LT(worst, 1e-3);  // a twentieth of the point spacing
  EXPECT_LT(result.rms_distance, 0.03);
  EXPECT_LT((result.target_from_source.linear() * result.target_from_source.linear().transpose() - Mat3d::Identity()).norm(), 1e-12);
}

TEST(AlignIcp, APlaneIsAlignedAcrossAndLeftAloneAlong) {
  std::vector<Vec3d> target, source;
  for (std::uint64_t i = 0; i < 5000; ++i) {
    const Vec3d u = random_point(i);
    target.emplace_back(u.x(), u.y(), 0);
    source.emplace_back(u.y() * 0.8 + 0.1, u.z() * 0.8 + 0.1, 0.03);
  }
  const IcpResult result = align_icp(source, target, 0.2, 50);
  ASSERT_TRUE(result.target_from_source.matrix().allFinite());
  for (const Vec3d& p : source) ASSERT_LT(std::abs((result.target_from_source * p).z()), 0.01);
}

TEST(AlignIcp, RefusesWhatCannotBeAligned) {
  const std::vector<Vec3d> few(2, Vec3d::Zero()), enough = corner(100, 1, Vec3d::Zero());
  EXPECT_THAT(error_of([&] { align_icp(few, enough, 1, 10); }), HasSubstr("3 points or more"));
  EXPECT_THROW(align_icp(enough, enough, 0, 10), std::invalid_argument);
  const std::vector<Vec3d> one_place(50, Vec3d::Ones());
  EXPECT_TRUE(align_icp(one_place, enough, 10, 10).target_from_source.matrix().allFinite());
  EXPECT_TRUE(align_icp(enough, one_place, 10, 10).target_from_source.matrix().allFinite());
}

TEST(AlignFiles, SubsamplesAndAligns) {
  const ScratchFolder folder;
  const Vec3d origin(1000, 2000, 0);
  const Eigen::Isometry3d truth = moderate_motion(origin);
  PointWriterOptions options;
  options.properties = {{"x", ScalarType::kF64}, {"y", ScalarType::kF64}, {"z", ScalarType::kF64}};
  for (const bool is_source : {false, true}) {
    const std::vector<Vec3d> points = corner(50'000, is_source ? 2 : 1, origin);
    options.num_points = points.size();
    auto writer = create_points(folder.path() / (is_source ? "source.ply" : "target.ply"), options);
    for (const Vec3d& p : points) {
      const Vec3d q = is_source ? Vec3d(truth.inverse() * p) : p;
      writer->write(reinterpret_cast<const std::byte*>(q.data()), 1);
    }
    writer->commit();
  }
  AlignOptions align;
  align.max_points = 20'000;
  align.max_distance = 1;
  const IcpResult result = align_files(folder.path() / "target.ply", folder.path() / "source.ply", align, silent_reporter());
  EXPECT_LT((result.target_from_source * origin - truth * origin).norm(), 3e-3);
  auto reader = open_points(folder.path() / "target.ply");
  const std::size_t kept = subsample(*reader, 20'000, silent_reporter()).size();
  EXPECT_LE(kept, 20'000u);
  EXPECT_GT(kept, 10'000u);
}

}  // namespace
}  // namespace chiaro::stream
