/// Photographs that are held together, and what they take of the budget.
#include "blend/photo_walk.h"

#include <gtest/gtest.h>

#include <mutex>

#include "stream/base/parallel.h"
#include "tests/blend/workplace.h"

namespace chiaro::blend {
namespace {

using namespace testing;

/// Many leaves and one photograph of a few pixels, as often as it is asked for: what is known of the leaves takes more than its window.
class PhotoWalkMemory : public ::testing::Test {
 protected:
  struct Seen {
    std::vector<std::uint64_t> used_by_group;   // bytes of the budget, most of them; by the place of a group's last photograph
    std::size_t most_together = 0, visits = 0;
  };
  Seen look(std::size_t photographs, std::uint64_t budget_bytes) const {
    MemoryBudget budget(budget_bytes);
    Seen seen;
    {
      WindowCache windows({0.1f}, budget);
      PhotoWalk walk(*w.store, std::vector<const BlendPhotograph*>(kMost, &photo), windows, budget, silent_reporter());
      std::vector<std::uint32_t> which(photographs);
      for (std::uint32_t k = 0; k < photographs; ++k) which[k] = k;
      seen.used_by_group.assign(photographs, 0);
      std::mutex mutex;
      walk.look(which, 1, 0, [&](const PhotoWalk::Visit& v) {
        const std::lock_guard lock(mutex);
        std::uint64_t& used = seen.used_by_group[v.views.back().photograph];
        used = std::max(used, budget.used_bytes());
        seen.most_together = std::max(seen.most_together, v.views.size());
        seen.visits += v.views.size();
      });
    }
    EXPECT_EQ(budget.used_bytes(), 0u);
    EXPECT_LE(budget.peak_bytes(), budget_bytes);
    return seen;
  }
  std::uint64_t rows_bytes() const { return w.store->leaves().size() * sizeof(RowSpan); }
  static constexpr std::size_t kMost = 64;
  const Workplace w{plane_scene(), true, 16};
  const BlendPhotograph photo = shoot(w.scene, look_at("a", Vec3d(0.5, 0.5, 0.8), Vec3d(0.5, 0.5, 0), 16, 12, 15), w.folder.path());
};

TEST_F(PhotoWalkMemory, RowsOfLeavesAreCharged) {
  const ThreadLimit one(1);
  ASSERT_GT(rows_bytes(), 4000u);
  const std::uint64_t alone = look(1, kPlenty).used_by_group.back(), together = look(kMost, kPlenty).used_by_group.back();
  EXPECT_EQ(together - alone, (kMost - 1) * rows_bytes());
}

TEST_F(PhotoWalkMemory, RoomForTheNextPhotographIsChargedUntilItIsGivenBack) {
  MemoryBudget budget(kPlenty);
  WindowCache windows({0.1f}, budget);
  const BlendPhotograph other = photo;
  const std::uint64_t pixels = 16 * 12, window = pixels * held_bytes_per_pixel(0), room = pixels * window_bytes_per_pixel(0) - window;
  for (const std::uint64_t held : {1u, 2u}) {
    ASSERT_TRUE(windows.whole(held == 1 ? photo : other, 0, kPlenty));
    EXPECT_EQ(windows.room_bytes(), room);
    EXPECT_EQ(budget.used_bytes(), held * window + room);   // both stay
  }
  EXPECT_FALSE(windows.whole(*std::make_unique<BlendPhotograph>(photo), kPlenty, kPlenty));
  windows.give_room_back();
  EXPECT_EQ(windows.room_bytes(), 0u);
  EXPECT_EQ(budget.used_bytes(), 2 * window);
}

TEST_F(PhotoWalkMemory, RoomForPreparingIsGivenBackBeforeLeavesAreVisited) {
  const ThreadLimit one(1);
  const std::uint64_t used = look(1, kPlenty).used_by_group.back(), most_besides = 16 * 12 * held_bytes_per_pixel(0) + rows_bytes();
  EXPECT_LT(used, most_besides + stream::geometry_bytes(16) + 16 * 12 * (window_bytes_per_pixel(0) - held_bytes_per_pixel(0)));
}

TEST_F(PhotoWalkMemory, ASmallBudgetMakesSmallerGroups) {
  const Seen whole = look(kMost, kPlenty);
  EXPECT_EQ(whole.most_together, kMost);
  const Seen some = look(kMost, 60 * rows_bytes());
  EXPECT_EQ(some.visits, whole.visits);
  EXPECT_GE(some.most_together, 4u);
  EXPECT_LE(some.most_together, 20u);   // a third of the budget
}

}  // namespace
}  // namespace chiaro::blend
