/// How finely photographs show the cloud, where a blend has found that they lie beside their cameras.
#include "blend/detail.h"

#include <gtest/gtest.h>

#include <cmath>

#include "tests/blend/workplace.h"

namespace chiaro::blend {
namespace {

using namespace testing;

class DetailTest : public ::testing::Test {
 protected:
  std::vector<Detail> collect(const std::vector<BlendPhotograph>& photos, const std::vector<Alignment>& alignment, std::uint64_t memory = kPlenty) const {
    BlendOptions options;
    options.known = Findings{std::vector<std::array<double, 3>>(photos.size(), {1, 1, 1}), alignment, 0.01, {}};
    MemoryBudget budget(memory);
    std::filesystem::remove(w.folder.path() / "detail");   // or it would go on from there
    const LeafFile file = collect_detail(*w.store, photos, options, w.folder.path() / "detail", budget, silent_reporter());
    std::vector<Detail> all;
    for (std::size_t leaf = 0; leaf < w.store->leaves().size(); ++leaf) {
      const auto record = file.read<Detail>(leaf);
      all.insert(all.end(), record.surfels.begin(), record.surfels.end());
    }
    return all;
  }
  std::vector<Vec2d> pixels(const BlendPhotograph& photo) const {
    std::vector<Vec2d> all;
    for (const std::uint32_t leaf : w.store->leaves()) {
      const stream::Chunk chunk = w.store->read_chunk(leaf);
      for (std::uint32_t i = 0; i < chunk.count; ++i) all.push_back(*stream::project(photo.camera.lens, photo.camera.pose.camera_from_world(chunk.surfel(i).position_in_world)));
    }
    return all;
  }
  BlendPhotograph left_half(const std::string& name) const {
    ShotOptions options;
    options.mask = [](int x, int) -> std::uint8_t { return x < 80; };
    return w.photograph(name, Vec3d(0.5, 0.5, 1), Vec3d(0.5, 0.5, 0), options);
  }
  Workplace w{plane_scene()};
};

TEST_F(DetailTest, IsReadWhereThePhotographShowsTheSurface) {
  const BlendPhotograph photo = left_half("a");
  const std::vector<Vec2d> at = pixels(photo);
  for (const float shift : {0.0f, 12.0f}) {
    double farthest = 0;
    const std::vector<Detail> found = collect({photo}, {{Vec2f(shift, 0), 1}});
    for (std::size_t i = 0; i < at.size(); ++i)
      if (found[i].weight > 0) farthest = std::max(farthest, at[i].x() + static_cast<double>(shift));
    EXPECT_LE(farthest, 80.5) << shift;   // the middle of the last pixel, and what interpolation adds
    EXPECT_GT(farthest, 76) << shift;
  }
}

TEST_F(DetailTest, WhatIsTrustedLessCountsLess) {
  const std::vector<Detail> whole = collect({left_half("a")}, {{Vec2f::Zero(), 1}}), half = collect({left_half("a")}, {{Vec2f::Zero(), 0.5f}});
  for (std::size_t i = 0; i < whole.size(); ++i) ASSERT_EQ(half[i].weight, 0.5f * whole[i].weight);
}

TEST_F(DetailTest, PlacesBelongToTheirPhotographsInAnyOrderAndBudget) {
  const BlendPhotograph a = left_half("a"), b = w.photograph("b", Vec3d(0.4, 0.5, 0.8), Vec3d(0.5, 0.5, 0));
  const Alignment of_a{Vec2f(3, -9), 1}, of_b{Vec2f(-2, 7), 0.75f};
  const std::vector<Detail> expected = collect({a, b}, {of_a, of_b});
  for (const std::uint64_t memory : {kPlenty, std::uint64_t{2400} << 10}) {   // whole, and in bands
    const std::vector<Detail> found = collect({b, a}, {of_b, of_a}, memory);
    for (std::size_t i = 0; i < found.size(); ++i) {
      ASSERT_EQ(found[i].weight, expected[i].weight) << i;
      ASSERT_EQ(found[i].footprint, expected[i].footprint) << i;
    }
  }
}

}  // namespace
}  // namespace chiaro::blend
