/// Whole photographs ready to be read at surfels, within the memory budget. Preparing one costs more than reading it, and each is read three times.
#pragma once
#include <cstdint>
#include <map>
#include <memory>

#include "blend/blend.h"
#include "blend/photo_window.h"
#include "stream/base/budget.h"

namespace chiaro::blend {

/// The first photographs that were asked for stay, as long as a quarter of what was free in the beginning holds them, and 32 of them at most: memory is the same for hundreds
/// and thousands. Walks come by in the same order every time, so that whatever else stayed would go before it is asked for again. One thread at a time.
class WindowCache {
 public:
  WindowCache(const WindowOptions& options, MemoryBudget& budget) : options_(options), budget_(budget), most_kept_(budget.free_bytes() / 4) {}

  /// All rows of a photograph, from where they are or prepared now; the budget holds them as long as the pointer lives. nullptr if there is no room: where
  /// it takes more than what `held` leaves of `most`, or cannot be prepared at once.
  std::shared_ptr<const PhotoWindow> whole(const BlendPhotograph& photograph, std::uint64_t held, std::uint64_t most);
  /// What the budget holds for preparing the next one. Callers give it back once they have all that they want.
  std::uint64_t room_bytes() const { return room_lease_.bytes(); }
  void give_room_back();
  const WindowOptions& options() const { return options_; }

 private:
  WindowOptions options_;
  MemoryBudget& budget_;
  std::uint64_t most_kept_, kept_bytes_ = 0;
  WindowRoom room_;
  BudgetLease room_lease_;
  std::map<const BlendPhotograph*, std::shared_ptr<const PhotoWindow>> kept_;
};

}  // namespace chiaro::blend
