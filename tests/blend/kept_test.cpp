/// A blend that goes on from a kept one gives the bits of a blend from the beginning.
#include "blend/kept.h"

#include <gtest/gtest.h>

#include <fstream>

#include "stream/base/error.h"
#include "stream/base/parallel.h"
#include "tests/blend/stopping_reporter.h"
#include "tests/blend/workplace.h"

namespace chiaro::blend {
namespace {

using namespace testing;

/// A long wall; photographs along it see their part and their neighbours' borders.
AnalyticScene wall_scene() {
  AnalyticScene scene = plane_scene();
  scene.rectangles = {{Vec3d(0, 0, 0), Vec3d(4, 0, 0), Vec3d(0, 1, 0)}};
  scene.albedo = [](const Vec3d& p) -> Vec3f { return smooth_paint(p) + Vec3f::Constant(0.1f * static_cast<float>(std::sin(60 * p.x()) * std::sin(55 * p.y()))); };
  return scene;
}

class Kept : public ::testing::Test {
 protected:
  explicit Kept(AnalyticScene scene = wall_scene()) : w(std::move(scene)) {}
  BlendPhotograph at(const std::string& name, double x, const ShotOptions& options = {}) const { return w.photograph(name, Vec3d(x, 0.5, 0.8), Vec3d(x, 0.5, 0), options); }
  /// Twelve along the wall, three and more at each place.
  std::vector<BlendPhotograph> along() const {
    std::vector<BlendPhotograph> photos;
    for (int k = 0; k < 12; ++k) photos.push_back(at("p" + std::to_string(10 + k), 0.2 + 0.32 * k));
    return photos;
  }
  BlendStats keep(const std::vector<BlendPhotograph>& photos, Reporter& report = silent_reporter(), std::uint64_t budget = kPlenty) const {
    BlendOptions options;
    options.keep = w.folder.path() / "kept";
    return w.run(photos, options, budget, report);
  }
  /// Bytes of the layer and all findings of a blend from the beginning against those of `photos` after what is kept.
  BlendStats expect_same_as_from_the_beginning(const std::vector<BlendPhotograph>& photos) const {
    const BlendStats on = keep(photos);
    const auto found = w.bytes();
    const BlendStats anew = w.run(photos);
    EXPECT_EQ(found, w.bytes());
    EXPECT_EQ(on.samples, anew.samples);
    EXPECT_EQ(on.points_disputed, anew.points_disputed);
    EXPECT_EQ(on.leaves, anew.leaves);
    for (std::size_t k = 0; k < photos.size(); ++k) {
      EXPECT_EQ(on.photographs[k].samples, anew.photographs[k].samples) << k;
      EXPECT_EQ(on.photographs[k].rejected, anew.photographs[k].rejected) << k;
      EXPECT_EQ(on.photographs[k].gain, anew.photographs[k].gain) << k;
      EXPECT_EQ(on.photographs[k].inspection.shift_px, anew.photographs[k].inspection.shift_px) << k;
      EXPECT_EQ(on.photographs[k].inspection.correlation, anew.photographs[k].inspection.correlation) << k;
    }
    return on;
  }
  Workplace w;
};

TEST_F(Kept, APhotographMoreCostsWhatItSees) {
  std::vector<BlendPhotograph> photos = along();
  const BlendStats first = keep(photos);
  EXPECT_EQ(first.leaves_kept, 0u);
  EXPECT_EQ(first.photographs_read, photos.size());
  photos.insert(photos.begin() + 3, at("p105", 0.4));   // in the middle of the order of names
  const BlendStats on = expect_same_as_from_the_beginning(photos);
  EXPECT_GT(on.leaves_kept, on.leaves / 2);
  EXPECT_LT(on.photographs_read, photos.size() / 2 + 1);
  // the same again costs nothing
  const BlendStats same = keep(photos);
  EXPECT_EQ(same.photographs_read, 0u);
  EXPECT_EQ(same.leaves_kept, same.leaves);
}

TEST_F(Kept, APhotographLessToo) {
  std::vector<BlendPhotograph> photos = along();
  keep(photos);
  photos.erase(photos.begin() + 10);
  const BlendStats on = expect_same_as_from_the_beginning(photos);
  EXPECT_GT(on.leaves_kept, 0u);
  EXPECT_LT(on.photographs_read, photos.size());
  photos.clear();
  EXPECT_EQ(keep(photos).points_seen, 0u);
}

TEST_F(Kept, AnotherPictureOfTheSameNameIsAnotherPhotograph) {
  std::vector<BlendPhotograph> photos = along();
  keep(photos);
  ShotOptions darker;
  darker.mask = [](int x, int) -> std::uint8_t { return x < 80; };
  photos[0] = at("p10", 0.2, darker);
  const BlendStats on = expect_same_as_from_the_beginning(photos);
  EXPECT_GT(on.leaves_kept, 0u);
}

TEST_F(Kept, FullBallotsAreCollectedAnew) {
  // More than eight at one place: what a withdrawn vote had displaced comes back.
  std::vector<BlendPhotograph> photos = along();
  for (int k = 0; k < 9; ++k) photos.push_back(at("q" + std::to_string(k), 0.3 + 0.01 * k, gained(k == 4 ? 1.15f : 1)));
  keep(photos);
  for (const std::size_t gone : {photos.size() - 1, std::size_t{2}, photos.size() - 5}) {
    photos.erase(photos.begin() + static_cast<std::ptrdiff_t>(gone));
    expect_same_as_from_the_beginning(photos);
  }
}

TEST_F(Kept, ReadingsThatHadNoVoteGoToo) {
  // Nine from near by fill the ballots; the one from afar is in the sums there, but not among the votes.
  std::vector<BlendPhotograph> photos;
  for (int k = 0; k < 9; ++k) photos.push_back(at("q" + std::to_string(k), 0.5 + 0.001 * k));
  photos.push_back(w.photograph("far", Vec3d(0.5, 0.5, 1.1), Vec3d(0.5, 0.5, 0), [] {
    ShotOptions part;   // no more of the wall than the others see
    part.mask = [](int x, int y) -> std::uint8_t { return x > 45 && x < 115 && y > 35 && y < 85; };
    return part;
  }()));
  keep(photos);
  photos.pop_back();
  expect_same_as_from_the_beginning(photos);
  photos.push_back(at("after", 0.5, gained(1.05f)));
  expect_same_as_from_the_beginning(photos);
}

TEST_F(Kept, DisturbancesThatComeAndGoLeaveNothingBehind) {
  std::vector<BlendPhotograph> photos = along();
  keep(photos);
  ShotOptions odd = gained(1.3f);
  odd.paint = [](int x, int y, const Vec3f& a) -> Vec3f { return x > 40 && x < 90 && y > 30 && y < 90 ? Vec3f(0.9f, 0.1f, 0.05f) : a; };
  photos.push_back(at("x", 1.5, odd));
  expect_same_as_from_the_beginning(photos);
  photos.pop_back();
  expect_same_as_from_the_beginning(photos);
}

/// The same brightness in every picture, so that what is kept is gone on from whatever comes.
AnalyticScene even_wall_scene() {
  AnalyticScene scene = wall_scene();
  scene.albedo = [](const Vec3d& p) -> Vec3f { return Vec3f::Constant(0.4f + 0.1f * static_cast<float>(std::sin(60 * p.x()) * std::sin(55 * p.y()))); };
  return scene;
}

class KeptOfAnEvenWall : public Kept {
 protected:
  KeptOfAnEvenWall() : Kept(even_wall_scene()) {}
  /// Of a blend before, which had no other scale.
  BlendStats expect_same_after(const std::vector<BlendPhotograph>& photos) const {
    const BlendStats on = expect_same_as_from_the_beginning(photos);
    EXPECT_GT(on.leaves_kept, 0u);
    return on;
  }
};

TEST_F(KeptOfAnEvenWall, AFactorThatChangesIsAppliedWhereTheNewPhotographSeesNothing) {
  // Two groups, each of its own brightness, until a photograph between them tells the factor; a third one has nothing to do with them.
  std::vector<BlendPhotograph> photos{at("a", 0.3), at("b", 0.5), at("c", 0.7), at("r", 1.9, gained(1.1f)), at("s", 2.1, gained(1.1f))};
  photos.push_back(at("y", 3.4));
  photos.push_back(at("z", 3.5));
  const BlendStats before = keep(photos);
  for (const std::size_t k : {3u, 4u}) EXPECT_EQ(before.photographs[k].gain[0], 1) << k;
  photos.push_back(at("between", 1.3));
  const BlendStats on = expect_same_after(photos);
  for (const std::size_t k : {3u, 4u}) EXPECT_NEAR(on.photographs[k].gain[0], 1 / 1.1, 0.01) << k;
}

TEST_F(KeptOfAnEvenWall, AToleranceThatChangesJudgesAnewWhereTheNewPhotographsSeeNothing) {
  ShotOptions patch;   // a little more than the least tolerance allows
  patch.paint = [](int x, int, const Vec3f& a) -> Vec3f { return x > 60 && x < 100 ? Vec3f(1.05f * a) : a; };
  std::vector<BlendPhotograph> photos{at("a", 0.5), at("b", 0.52), at("c", 0.5, patch)};
  const BlendStats before = keep(photos);
  for (int k = 0; k < 4; ++k) {
    ShotOptions uneven;
    uneven.paint = [k](int x, int, const Vec3f& a) -> Vec3f { return a * (1 + 0.1f * std::sin(0.15f * static_cast<float>(x) + 1.6f * static_cast<float>(k))); };
    photos.push_back(at("far" + std::to_string(k), 3.4, uneven));
  }
  const BlendStats on = expect_same_as_from_the_beginning(photos);
  EXPECT_GT(on.tolerance.of_votes(), 1.5f * before.tolerance.of_votes());
}

TEST_F(KeptOfAnEvenWall, AToleranceOfReadingsWithoutVotesThatChangesJudgesAnewToo) {
  // At each of two places nine from near by, of which eight have a vote, and others from afar that see no more of the wall.
  const auto from_afar = [&](const std::string& name, double x, float share) {
    ShotOptions part;
    part.mask = [](int px, int py) -> std::uint8_t { return px > 45 && px < 115 && py > 35 && py < 85; };
    part.paint = [share](int px, int, const Vec3f& a) -> Vec3f { return a * (1 + share * (px % 20 < 10 ? 1.0f : -1.0f)); };
    return w.photograph(name, Vec3d(x, 0.5, 1.1), Vec3d(x, 0.5, 0), part);
  };
  std::vector<BlendPhotograph> photos;
  for (int k = 0; k < 9; ++k) photos.push_back(at("a" + std::to_string(k), 0.5 + 0.001 * k));
  photos.push_back(from_afar("b", 0.5, 0.045f));   // a little more than the least tolerance allows
  const BlendStats before = keep(photos);
  for (int k = 0; k < 9; ++k) photos.push_back(at("c" + std::to_string(k), 3.4 + 0.001 * k));
  for (int k = 0; k < 3; ++k) photos.push_back(from_afar("d" + std::to_string(k), 3.4, 0.1f));
  const BlendStats on = expect_same_as_from_the_beginning(photos);
  EXPECT_EQ(on.tolerance.of_votes(), before.tolerance.of_votes());
  EXPECT_GT(on.tolerance.by_class[1], 1.5f * before.tolerance.by_class[1]);
  EXPECT_LT(on.photographs[9].rejected, before.photographs[9].rejected);
}

TEST_F(KeptOfAnEvenWall, APlaceThatIsFoundIsReadAnewWhereTheNewPhotographSeesNothing) {
  // Of two photographs nobody knows which one lies beside its place. Others far away say how far readings scatter.
  std::vector<BlendPhotograph> photos{at("a", 0.5), at("b", 0.9)};
  for (int k = 0; k < 5; ++k) photos.push_back(at("far" + std::to_string(k), 2.6 + 0.2 * k));
  stream::Camera moved = photos[1].camera;
  moved.photograph = "moved";
  moved.lens.cx += 2;
  photos[1].albedo = shoot(w.scene, moved, w.folder.path()).albedo;
  keep(photos);
  photos.push_back(at("c", 0.55));
  const BlendStats on = expect_same_after(photos);
  EXPECT_NEAR(on.photographs[1].alignment.shift_px.x(), 2, 0.2);
}

TEST_F(Kept, OtherOptionsAndDamageBeginAnew) {
  const std::vector<BlendPhotograph> photos = along();
  keep(photos);
  BlendOptions options;
  options.keep = w.folder.path() / "kept";
  options.low_band_px = 6;
  EXPECT_EQ(w.run(photos, options).leaves_kept, 0u);
  keep(photos);
  {
    File state(w.folder.path() / "kept/state", File::Mode::kReadWrite);
    unsigned char byte = 0;
    state.read_at(state.size() - 100, &byte, 1);
    byte ^= 4;
    state.write_at(state.size() - 100, &byte, 1);   // in what is known of the last photograph
  }
  EXPECT_EQ(keep(photos).leaves_kept, 0u);
  std::filesystem::resize_file(w.folder.path() / "kept/state", 100);
  EXPECT_EQ(keep(photos).leaves_kept, 0u);
  std::filesystem::remove(w.folder.path() / "kept/votes");
  EXPECT_EQ(keep(photos).leaves_kept, 0u);
  EXPECT_EQ(keep(photos).photographs_read, 0u);
}

TEST_F(Kept, AStoppedOneGoesOnToTheSameBytes) {
  std::vector<BlendPhotograph> photos = along();
  keep(photos);
  photos.push_back(at("late", 2.0, gained(0.9f)));
  photos.erase(photos.begin());
  const int stops = stops_until_done(20, 40, [&](Reporter& report, int before) { keep(photos, report, before % 2 == 0 ? kPlenty : 3000 << 10); });
  ASSERT_LT(stops, 200);
  EXPECT_GE(stops, 3);
  const auto found = w.bytes();
  w.run(photos);
  EXPECT_EQ(found, w.bytes());
}

TEST_F(Kept, TheStateTakesNoMoreThanWasForeseen) {
  const BlendStats stats = keep(along());
  std::uint64_t bytes = 0;
  for (const char* file : {"votes", "sums"}) bytes += allocated_bytes(w.folder.path() / "kept" / file);
  EXPECT_GT(bytes, std::uint64_t{stats.points_seen} * (sizeof(Accumulator) + sizeof(Ballot)));
  EXPECT_LE(bytes, stats.scratch_bytes + 4 * 4096);   // and their headers
}

TEST(NumbersNow, FollowKeysAndRefuseAnotherOrder) {
  const auto then = [](std::initializer_list<const char*> keys) {
    std::vector<PhotographState> states;
    for (const char* key : keys) states.push_back({key, Vec3f::Zero(), {}, {}});
    return states;
  };
  const std::vector<std::string> now{"a", "b", "b", "d"};
  EXPECT_EQ(numbers_now(then({"a", "b", "c", "d"}), now), (std::vector<std::uint32_t>{0, 1, 0xffffffffu, 3}));
  EXPECT_EQ(numbers_now(then({"b", "b", "b"}), now), (std::vector<std::uint32_t>{1, 2, 0xffffffffu}));
  EXPECT_FALSE(numbers_now(then({"d", "a"}), now));
}

}  // namespace
}  // namespace chiaro::blend
