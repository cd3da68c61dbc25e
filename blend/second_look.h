/// Second look at photographs, once all have voted: each against what the others agree on.
#pragma once
#include <cstdint>
#include <span>
#include <vector>

#include "blend/agreement.h"
#include "blend/inspect.h"
#include "blend/leaf_file.h"
#include "blend/photo_walk.h"

namespace chiaro::blend {

/// References outlive it; the photographs are those of the walk.
struct SecondLook {
  const stream::Store& store;
  const std::vector<const BlendPhotograph*>& photographs;
  LeafFile& votes;
  PhotoWalk& walk;
  const Agreement& agreement;
  Tolerance tolerance;
  float brightness;
  Reporter& report;

  /// Of photographs, ascending; tolerance.of_votes() is all that has to be known. In the order of `which`. Memory: 50 KB a photograph.
  std::vector<ReadingDistances> distances(std::span<const std::uint32_t> which) const;
  /// photographs: ascending. shift_px: where they are read; the shifts found are whole ones. Memory: about 40 KB a photograph.
  std::vector<Inspection> inspect(std::span<const std::uint32_t> which, const Vec2f& shift_px) const;
  /// A photograph that is read in the wrong place is judged and correlated wrongly too: `found` is looked at once more from where it seems to be.
  Alignment align(std::uint32_t photograph, Inspection& found) const;

 private:
  /// Calls judge(view's number, slot, surfel's place, reading, with its factor of brightness, majority, ballot) for readings of surfels with a majority, of about so many surfels a photograph.
  template <class Judge>
  void for_judged(const PhotoWalk::Visit& v, const Vec2f& shift_px, std::uint64_t most_surfels, const Judge& judge) const;
};

}  // namespace chiaro::blend
