/// One photograph against what the others agree on: does it lie where its camera says, and which part of it shows something else.
///
/// A photograph's detail (the high band over the low one, so that brightness takes no part) is correlated with the median detail of the other photographs,
/// at every offset of a few pixels: the best offset is how far the photograph is shifted on the surface. All counts are whole numbers: the same bits in any order.
#pragma once
#include <array>
#include <cstdint>
#include <optional>
#include <vector>

#include "blend/ballot.h"
#include "blend/photo_window.h"

namespace chiaro::blend {

inline constexpr int kSearchPx = 4;                        ///< largest shift that is looked for, each way
inline constexpr int kOffsets = 2 * kSearchPx + 1;
inline constexpr int kInspectMargin = kSearchPx + 2;       ///< rows that a window needs above and below

/// Sums for the correlations at all offsets.
struct ShiftCounts {
  std::int64_t n = 0, r = 0, rr = 0;
  std::array<std::int64_t, kOffsets * kOffsets> d{}, dd{}, rd{};
  void merge(const ShiftCounts& other);
};

/// The image in 3 x 3 parts for shifts, and in cells for what disagrees.
struct InspectionCounts {
  InspectionCounts(int width, int height);
  void merge(const InspectionCounts& other);
  std::size_t cell(const Vec2d& pixel) const;
  int width = 0, height = 0, cell_px = 16, cells_x = 0, cells_y = 0;
  std::array<ShiftCounts, 9> parts;
  std::vector<std::uint32_t> judged, outvoted, compared;   ///< by cell: readings where there is a majority, those it contradicts, and those whose detail was compared (two others show it)
};

/// One surfel that this photograph sees at `pixel` and that has a majority. log_low: its reading, gain applied.
void inspect_reading(const Ballot& ballot, const Majority& majority, std::uint16_t photograph, const Vec3f& log_low, float tolerance, const Vec2d& pixel, const PhotoWindow& window,
                     InspectionCounts& counts);

struct Inspection {
  std::optional<Vec2f> shift_px;   ///< the photograph shows things that much to the right of and below where its camera puts them; nullopt: the detail in common does not tell
  float shift_sd_px = 0;           ///< standard deviation of that, by how sharp the correlation's peak is
  float shift_spread_px = 0;       ///< how far parts of the image are from that: a rotation or a wrong lens
  float correlation = 0;           ///< of its detail with the others', at the best offset
  std::uint64_t shift_readings = 0;
  struct Region {
    int x0 = 0, y0 = 0, x1 = 0, y1 = 0;   ///< pixels, half-open
    std::uint64_t outvoted = 0, judged = 0;
    float chance = 0;                     ///< that as much is outvoted side by side though nothing is there
  };
  std::optional<Region> disturbed; ///< the largest connected part in which most readings are outvoted
};
Inspection conclude(const InspectionCounts& counts);

/// What is done about a shift: where it is clear and the same all over the image, the photograph is read beside; what is left costs weight.
struct Alignment {
  Vec2f shift_px = Vec2f::Zero();
  float trust = 1;
};
Alignment alignment_for(const Inspection& inspection);

}  // namespace chiaro::blend
