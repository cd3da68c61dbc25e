#include "tools/compare_points.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <cmath>
#include <cstring>
#include <fstream>
#include <limits>

#include "stream/base/budget.h"
#include "stream/base/error.h"
#include "stream/base/file.h"
#include "stream/cloud/point_stream.h"
#include "stream/store/layer.h"
#include "stream/store/octree_build.h"
#include "stream/photo/image_io.h"
#include "tools/colour_source.h"
#include "tools/compare_picture.h"

namespace chiaro::tools {
namespace {

namespace fs = std::filesystem;
using testing::HasSubstr;
constexpr float kNanF = std::numeric_limits<float>::quiet_NaN();

class ComparePointsTest : public testing::Test {
 protected:
  /// An ascii PLY of albedos.
  std::string albedo_ply(const std::string& name, const std::vector<Vec3f>& albedo) {
    std::ofstream out(scratch_.path() / name);
    out << "ply\nformat ascii 1.0\nelement vertex " << albedo.size()
        << "\nproperty float x\nproperty float y\nproperty float z\nproperty float albedo_r\nproperty float albedo_g\nproperty float albedo_b\nend_header\n";
    for (std::size_t i = 0; i < albedo.size(); ++i) out << i << ' ' << static_cast<double>(i) * 0.5 << " 0 " << albedo[i].x() << ' ' << albedo[i].y() << ' ' << albedo[i].z() << '\n';
    return (scratch_.path() / name).string();
  }
  std::string colour_ply(const std::string& name, const std::vector<int>& grey) {
    std::ofstream out(scratch_.path() / name);
    out << "ply\nformat ascii 1.0\nelement vertex " << grey.size()
        << "\nproperty float x\nproperty float y\nproperty float z\nproperty uchar red\nproperty uchar green\nproperty uchar blue\nend_header\n";
    for (std::size_t i = 0; i < grey.size(); ++i) out << i << " 0 " << static_cast<double>(i) * 0.25 << ' ' << grey[i] << ' ' << grey[i] << ' ' << grey[i] << '\n';
    return (scratch_.path() / name).string();
  }
  static std::string complaint(const std::string& a, const std::string& b, const fs::path& out = {}) {
    try {
      compare_points(a, b, out, silent_reporter());
    } catch (const Error& e) {
      return e.what();
    }
    return "none";
  }
  ScratchFolder scratch_;
};

TEST_F(ComparePointsTest, MeasuresAFactorAndTakesItOut) {
  std::vector<Vec3f> truth, result;
  for (int i = 0; i < 1000; ++i) {
    truth.push_back(Vec3f(0.1f, 0.2f, 0.4f) * (1 + 0.001f * static_cast<float>(i)));
    result.push_back(truth.back() * 1.25f);
  }
  result[7] = Vec3f::Constant(kNanF);
  const PointComparison r = compare_points(albedo_ply("a.ply", result), albedo_ply("b.ply", truth), {}, silent_reporter());
  EXPECT_EQ(r.compared_values, "albedo");
  EXPECT_EQ(r.points, 1000u);
  EXPECT_EQ(r.compared, 999u);
  EXPECT_EQ(r.unseen_a, 1u);
  EXPECT_EQ(r.unseen_b, 0u);
  const double kTol = 1e-4;  // six digits in the text files
  EXPECT_NEAR(r.relative.mean, 0.25, kTol);
  EXPECT_NEAR(r.relative.median, 0.25, kTol);
  EXPECT_NEAR(r.relative.p95, 0.25, kTol);
  EXPECT_NEAR(r.scale, 0.8, kTol);
  EXPECT_LT(r.relative_scaled.max, kTol);
  EXPECT_NEAR(r.difference.max, 0.25 * 0.7 / 3 * 1.999, kTol);
  EXPECT_GT(r.bias, 0);
}

TEST_F(ComparePointsTest, FindsQuantilesOfKnownDifferences) {
  std::vector<Vec3f> truth, result;
  for (int i = 1; i <= 1000; ++i) {
    truth.push_back(Vec3f::Constant(0.5f));
    result.push_back(Vec3f::Constant(0.5f + 0.0001f * static_cast<float>(i)));
  }
  const PointComparison r = compare_points(albedo_ply("a.ply", result), albedo_ply("b.ply", truth), {}, silent_reporter());
  EXPECT_NEAR(r.difference.median, 0.05, 0.05 * 3e-4 + 1e-6);
  EXPECT_NEAR(r.difference.p95, 0.095, 0.095 * 3e-4 + 1e-6);
  EXPECT_NEAR(r.difference.max, 0.1, 1e-6);
  EXPECT_NEAR(r.difference.mean, 0.05005, 1e-6);
}

TEST_F(ComparePointsTest, ThreePointsByHand) {
  // A - B: 0.1, 0.2 and -0.6 in all channels; of B = 0.5, but for a channel that is too dark to divide by
  const PointComparison r = compare_points(albedo_ply("a.ply", {{0.6f, 0.6f, 0.6f}, {0.7f, 0.7f, 0.2005f}, {0.4f, 0.4f, 0.4f}}),
                                           albedo_ply("b.ply", {{0.5f, 0.5f, 0.5f}, {0.5f, 0.5f, 0.0005f}, {1, 1, 1}}), {}, silent_reporter());
  EXPECT_NEAR(r.bias, -0.1, 1e-6);
  EXPECT_NEAR(r.rms, std::sqrt((0.01 + 0.04 + 0.36) / 3), 1e-6);
  EXPECT_NEAR(r.difference.median, 0.2, 0.2 * 3e-4);
  EXPECT_NEAR(r.relative.median, 0.4, 0.4 * 3e-4);
  EXPECT_NEAR(r.relative.max, 0.6, 1e-6);
  EXPECT_NEAR(r.relative.mean, (0.2 + 0.4 + 0.6) / 3, 1e-6);
}

TEST_F(ComparePointsTest, IsZeroForTheSameFile) {
  const std::string a = albedo_ply("a.ply", {{0, 0.5f, 1}, {0.2f, 0.3f, 0.4f}});
  const PointComparison r = compare_points(a, a, {}, silent_reporter());
  EXPECT_EQ(r.difference.max, 0);
  EXPECT_EQ(r.difference.median, 0);
  EXPECT_EQ(r.rms, 0);
  EXPECT_EQ(r.delta_e, 0);
  EXPECT_NEAR(r.scale, 1, 1e-12);
}

TEST_F(ComparePointsTest, ComparesColoursInLinearLight) {
  const PointComparison r = compare_points(colour_ply("a.ply", {188, 188}), colour_ply("b.ply", {188, 0}), {}, silent_reporter());
  EXPECT_EQ(r.compared_values, "colour");
  EXPECT_NEAR(r.difference.max, 0.5028865, 1e-5);
  EXPECT_EQ(r.relative.max, 0) << "a black reference has no relative difference";
}

TEST_F(ComparePointsTest, TakesFilledPointsForUnseen) {
  std::ofstream(scratch_.path() / "a.ply") << "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\nproperty float albedo_r\nproperty float albedo_g\n"
                                              "property float albedo_b\nproperty ushort photos\nend_header\n0 0 0 0.5 0.5 0.5 2\n1 0.5 0 0.9 0.9 0.9 0\n2 1 0 0.5 0.5 0.5 1\n";
  const std::string a = (scratch_.path() / "a.ply").string(), b = albedo_ply("b.ply", {{0.4f, 0.4f, 0.4f}, {0.4f, 0.4f, 0.4f}, {0.4f, 0.4f, 0.4f}});
  const PointComparison r = compare_points(a, b, {}, silent_reporter()), other_way = compare_points(b, a, {}, silent_reporter());
  EXPECT_EQ(r.points, 3u);
  EXPECT_EQ(r.compared, 2u);
  EXPECT_EQ(r.unseen_a, 1u);
  EXPECT_EQ(other_way.unseen_b, 1u);
  EXPECT_NEAR(r.difference.max, 0.1, 1e-6);
}

TEST_F(ComparePointsTest, WritesTheDifferences) {
  const fs::path out = scratch_.path() / "diff.ply";
  compare_points(albedo_ply("a.ply", {{0.5f, 0.5f, 0.5f}, {kNanF, kNanF, kNanF}}), albedo_ply("b.ply", {{0.4f, 0.5f, 0.8f}, {1, 1, 1}}), out, silent_reporter());
  const auto reader = stream::open_points(out);
  std::vector<std::string> names;
  for (const auto& property : reader->schema().extras) names.push_back(property.name);
  EXPECT_EQ(names, (std::vector<std::string>{"difference_r", "difference_g", "difference_b", "difference", "relative"}));
  stream::PointBlock block;
  ASSERT_TRUE(reader->read(block, 100));
  ASSERT_EQ(block.size(), 2u);
  EXPECT_EQ(block.position[1], Vec3d(1, 0.5, 0));
  float values[10];
  std::memcpy(values, block.extras.data(), sizeof values);
  EXPECT_NEAR(values[0], 0.1, 1e-6);
  EXPECT_NEAR(values[2], -0.3, 1e-6);
  EXPECT_NEAR(values[3], 0.4 / 3, 1e-6);
  EXPECT_NEAR(values[4], (0.25 + 0 + 0.375) / 3, 1e-6);
  EXPECT_TRUE(std::isnan(values[5]) && std::isnan(values[8]) && std::isnan(values[9]));
}

TEST_F(ComparePointsTest, RefusesWhatCannotBeCompared) {
  const std::string two = albedo_ply("two.ply", {{0, 0.5f, 1}, {1, 1, 1}}), three = albedo_ply("three.ply", {{0, 0.5f, 1}, {1, 1, 1}, {1, 1, 1}});
  const std::string grey = colour_ply("grey.ply", {1, 2});
  EXPECT_THAT(complaint(two, three), HasSubstr("two.ply has 2 points"));
  EXPECT_THAT(complaint(three, two), HasSubstr("three.ply has more"));
  EXPECT_THAT(complaint(two, grey), HasSubstr("nothing to compare"));
  EXPECT_THAT(complaint(two, "absent.ply"), HasSubstr("absent.ply"));
  EXPECT_THAT(complaint(two, scratch_.path().string() + ":albedo"), HasSubstr("neither a store"));
  std::ofstream(scratch_.path() / "bare.ply") << "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nproperty float z\nend_header\n0 0 0\n";
  EXPECT_THAT(complaint((scratch_.path() / "bare.ply").string(), two), HasSubstr("neither albedo_r"));
  EXPECT_THAT(complaint(two, two, scratch_.path() / "diff.obj"), HasSubstr("diff.obj"));
  EXPECT_FALSE(fs::exists(scratch_.path() / "diff.obj"));
}

TEST_F(ComparePointsTest, CountsPointsThatLieElsewhere) {
  const auto file = [&](const char* name, double shift, bool reversed) {
    std::ofstream out(scratch_.path() / name);
    out << "ply\nformat ascii 1.0\nelement vertex 100\nproperty float x\nproperty float y\nproperty float z\nproperty uchar red\nproperty uchar green\nproperty uchar blue\nend_header\n";
    for (int k = 0; k < 100; ++k) {
      const int i = reversed ? 99 - k : k;
      out << i + shift << ' ' << i % 7 << " 0 " << i << ' ' << i << ' ' << i << '\n';
    }
    return (scratch_.path() / name).string();
  };
  const std::string a = file("a.ply", 0, false);
  const auto elsewhere = [&](const std::string& b) { return compare_points(a, b, {}, silent_reporter()).elsewhere; };
  EXPECT_EQ(elsewhere(a), 0u);
  EXPECT_EQ(elsewhere(file("rounded.ply", 0.01, false)), 0u);
  EXPECT_EQ(elsewhere(file("moved.ply", 1, false)), 100u);
  EXPECT_EQ(elsewhere(file("reversed.ply", 0, true)), 100u);
}

TEST_F(ComparePointsTest, NeverWritesOverWhatIsCompared) {
  const std::string a = albedo_ply("a.ply", {{0.5f, 0.5f, 0.5f}}), b = albedo_ply("b.ply", {{0.4f, 0.5f, 0.8f}});
  const std::string before = read_text(a);
  fs::create_directory(scratch_.path() / "sub");
  EXPECT_THAT(complaint(a, b, scratch_.path() / "sub/../a.ply"), HasSubstr("is what is compared"));
  EXPECT_THAT(complaint(b, a, a), HasSubstr("is what is compared"));
  EXPECT_EQ(read_text(a), before);
}

TEST_F(ComparePointsTest, PointsStayInStepWhateverTheBlocks) {
  // A point that a run has inserted stands first in one of the files: its blocks begin and end elsewhere.
  constexpr int kCount = 140000;   // more than two blocks
  const auto write = [&](const std::string& name, bool inserted) {
    std::ofstream out(scratch_.path() / name);
    out << "ply\nformat ascii 1.0\nelement vertex " << kCount + inserted << "\nproperty float x\nproperty float y\nproperty float z\nproperty float albedo_r\nproperty float albedo_g\nproperty float albedo_b\n"
        << "property uchar inserted\nend_header\n";
    if (inserted) out << "0 0 0 9 9 9 1\n";
    for (int i = 0; i < kCount; ++i) out << "0 0 0 " << i + 1 << " 1 1 0\n";
    return (scratch_.path() / name).string();
  };
  const PointComparison r = compare_points(write("a.ply", true), write("b.ply", false), {}, silent_reporter());
  EXPECT_EQ(r.points, static_cast<std::uint64_t>(kCount));
  EXPECT_EQ(r.difference.max, 0);
}

/// A small store with the layers that a run leaves.
class CompareLayersTest : public ComparePointsTest {
 protected:
  static constexpr int kPoints = 5000;
  fs::path build(const std::string& name, int points = kPoints) {
    std::vector<int> grey(points);
    for (int i = 0; i < points; ++i) grey[i] = i % 256;
    const std::string cloud = colour_ply(name + ".ply", grey);
    MemoryBudget budget(256u << 20);
    stream::build_store({cloud}, scratch_.path() / (name + ".chiaro"), {}, budget, silent_reporter());
    return scratch_.path() / (name + ".chiaro");
  }
  static void add_layer(const fs::path& folder, const std::string& name, float albedo) {
    const stream::Store store(folder);
    stream::LayerWriter writer(store, name, stream::albedo_fields(), "{}");
    for (const std::uint32_t leaf : store.leaves()) {
      const std::size_t count = store.chunks()[leaf].count;
      std::vector<std::byte> planar(count * (3 * 4 + 4 + 2));
      std::vector<float> values(count * 4, albedo);
      std::memcpy(planar.data(), values.data(), count * 16);
      writer.write_chunk(leaf, planar);
    }
    writer.finish_inner(silent_reporter());
    writer.commit();
  }
};

TEST_F(CompareLayersTest, ComparesLayersOfOneStore) {
  const fs::path store = build("s");
  add_layer(store, "day1", 0.5f);
  add_layer(store, "day2", 0.4f);
  const PointComparison r = compare_points(store.string() + ":day1", store.string() + ":day2", scratch_.path() / "d.ply", silent_reporter());
  EXPECT_EQ(r.points, static_cast<std::uint64_t>(kPoints));
  EXPECT_NEAR(r.relative.mean, 0.25, 1e-6);
  EXPECT_TRUE(fs::exists(scratch_.path() / "d.ply"));
  const PointComparison colours = compare_points(store.string() + ":input", store.string() + ":input", {}, silent_reporter());
  EXPECT_EQ(colours.compared_values, "colour");
  EXPECT_EQ(colours.difference.max, 0);
  EXPECT_THAT(complaint(store.string() + ":day3", store.string() + ":day2"), HasSubstr("no layer \"day3\"; did you mean"));
  EXPECT_THAT(complaint(store.string() + ":day1", (scratch_.path() / "s.ply").string()), HasSubstr("nothing to compare"));
  EXPECT_THAT(complaint(store.string() + ":input", (scratch_.path() / "s.ply").string()), HasSubstr("not the same points"));
}

TEST_F(CompareLayersTest, RefusesALayerOfAnotherStore) {
  const fs::path mine = build("mine"), other = build("other", kPoints - 1);
  add_layer(mine, "day1", 0.5f);
  add_layer(other, "day2", 0.5f);
  EXPECT_THAT(complaint(mine.string() + ":day1", other.string() + ":day2"), HasSubstr("not the same points"));
  // and one that was copied in
  fs::copy(other / "layers" / "day2", mine / "layers" / "day2", fs::copy_options::recursive);
  EXPECT_THAT(complaint(mine.string() + ":day1", mine.string() + ":day2"), HasSubstr("day2"));
}

TEST_F(CompareLayersTest, DrawsTheDifference) {
  const fs::path store = build("s");
  add_layer(store, "day1", 0.5f);
  add_layer(store, "day2", 0.4f);
  const fs::path file = scratch_.path() / "d.png";
  const PointComparison r = compare_points(store.string() + ":day1", store.string() + ":day2", {}, silent_reporter(), file);
  EXPECT_EQ(r.picture_range, 0.5);
  const stream::Image drawn = stream::read_image(file);
  float most_red = -1, least_red = 1;   // beside blue, above the scale: A is brighter all over
  for (int y = 0; y < drawn.height - 30; ++y)
    for (int x = 0; x < drawn.width; ++x) {
      const float* p = &drawn.values[3 * (static_cast<std::size_t>(y) * static_cast<std::size_t>(drawn.width) + static_cast<std::size_t>(x))];
      most_red = std::max(most_red, p[0] - p[2]);
      least_red = std::min(least_red, p[0] - p[2]);
    }
  EXPECT_GT(most_red, 0.1f);
  EXPECT_GE(least_red, 0);
  EXPECT_THROW(compare_points(store.string() + ":day1", store.string() + ":day2", {}, silent_reporter(), scratch_.path() / "absent" / "d.png"), Error);
}

using Colour = std::array<std::uint8_t, 3>;

TEST(DifferencePicture, ColoursSayWhoIsBrighter) {
  EXPECT_EQ(DifferencePicture::colour(0, 0.1), (Colour{247, 247, 247}));
  EXPECT_EQ(DifferencePicture::colour(0.1, 0.1), DifferencePicture::colour(3, 0.1));
  EXPECT_GT(DifferencePicture::colour(0.1, 0.1)[0], DifferencePicture::colour(0.1, 0.1)[2]);
  EXPECT_LT(DifferencePicture::colour(-0.1, 0.1)[0], DifferencePicture::colour(-0.1, 0.1)[2]);
  EXPECT_EQ(DifferencePicture::colour(std::nan(""), 0.1), (Colour{128, 128, 128}));
}

TEST(DifferencePicture, TheNearerPointHidesTheOneBehind) {
  Box3d box;
  box.extend(Vec3d(0, 0, 0));
  box.extend(Vec3d(1, 1, 1));
  DifferencePicture picture(box, 100000000, 0.1);
  const Colour red = DifferencePicture::colour(1, 0.1), blue = DifferencePicture::colour(-1, 0.1);
  // in the same place as seen from the front, which looks along +y: the red one, y = 0, hides the blue one whatever the order
  picture.add(Vec3d(0.5, 1, 0.5), -1);
  picture.add(Vec3d(0.5, 0, 0.5), 1);
  picture.add(Vec3d(0.5, 1, 0.5), -1);
  picture.add(Vec3d(std::nan(""), 0, 0), 1);
  int reds = 0, blues = 0;
  for (int y = 0; y < picture.height() - 30; ++y)   // the scale stands below
    for (int x = 0; x < picture.width(); ++x) {
      reds += picture.pixel(x, y) == red;
      blues += picture.pixel(x, y) == blue;
    }
  EXPECT_EQ(reds, 5);    // all but the back
  EXPECT_EQ(blues, 5);   // all but the front
  EXPECT_TRUE(picture.width() > 1500 && picture.width() <= 1620);
}

TEST(DifferencePicture, TheNearerPointHidesTheOneBehindFarFromTheOriginToo) {
  const Vec3d utm(512000, 5400000, 300);
  Box3d box;
  box.extend(utm);
  box.extend(utm + Vec3d(10, 10, 10));
  DifferencePicture picture(box, 100000000, 0.1);
  for (int i = 0; i < 9; ++i) {   // as in the test above, but 20 cm apart
    picture.add(utm + Vec3d(1 + i, 5.2 + 0.13 * i, 5), -1);
    picture.add(utm + Vec3d(1 + i, 5 + 0.13 * i, 5), 1);
  }
  const Colour red = DifferencePicture::colour(1, 0.1), blue = DifferencePicture::colour(-1, 0.1);
  int reds = 0, blues = 0;
  for (int y = 0; y < picture.height() / 2 - 15; ++y)   // the front is the first view; top and bottom stand below
    for (int x = 0; x < picture.width() / 4; ++x) {
      reds += picture.pixel(x, y) == red;
      blues += picture.pixel(x, y) == blue;
    }
  EXPECT_EQ(reds, 9);
  EXPECT_EQ(blues, 0);
}

TEST(DifferencePicture, PointsAreAsLargeAsTheirSpacing) {
  Box3d box;
  box.extend(Vec3d(0, 0, 0));
  box.extend(Vec3d(1, 1, 1));
  // 600 points on six faces of a unit cube: 0.1 apart, of 1540 pixels for 4 units; no more than 17 wide
  DifferencePicture picture(box, 600, 0.1);
  picture.add(Vec3d(0.5, 0.5, 0.5), 1);
  int reds = 0;
  for (int y = 0; y < picture.height() - 30; ++y)
    for (int x = 0; x < picture.width(); ++x) reds += picture.pixel(x, y) == DifferencePicture::colour(1, 0.1);
  EXPECT_EQ(reds, 6 * 17 * 17);
}

TEST(DifferencePicture, FlatAndTinyCloudsHaveAPicture) {
  Box3d point;
  point.extend(Vec3d(5, 5, 5));
  DifferencePicture(point, 1, 0.1).add(Vec3d(5, 5, 5), 0);
  Box3d flat = point;
  flat.extend(Vec3d(9, 8, 5));
  DifferencePicture picture(flat, 100, 0.1);
  picture.add(Vec3d(9, 8, 5), 0);
  EXPECT_LT(picture.height(), 2000);
  Box3d mast = point;
  mast.extend(Vec3d(5, 5, 100));
  const DifferencePicture high(mast, 100, 0.1);
  EXPECT_LT(high.height(), 8000);
  EXPECT_LE(high.width(), 1620);
}

TEST(NamesPoints, TellsPicturesFromPoints) {
  EXPECT_TRUE(names_points("a.PLY"));
  EXPECT_TRUE(names_points("truth/albedo.npy"));
  for (const char* cloud : {"a.laz", "a.e57", "a.ptx", "a.xyzrgb", "a.xyzn"}) EXPECT_TRUE(names_points(cloud)) << cloud;
  EXPECT_TRUE(names_points("x.out:albedo"));
  EXPECT_FALSE(names_points("a.exr"));
  EXPECT_FALSE(names_points("a:"));
}

}  // namespace
}  // namespace chiaro::tools
