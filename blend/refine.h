/// Adaptive refinement: new points where the photographs show more than the cloud samples. They are found here; their albedo is blended as that of all others.
#pragma once
#include <filesystem>
#include <memory>
#include <span>

#include "blend/blend.h"
#include "stream/cloud/point_stream.h"

namespace chiaro::blend {

struct RefineStats {
  std::uint64_t inserted = 0;
  std::uint64_t asked = 0;                 ///< about as many would bring the cloud to the footprint of the best photograph everywhere
  double coarser = 1;                      ///< new points keep so many times that footprint, for all to fit in the budget
  std::uint64_t surfels = 0, refined = 0;  ///< of the cloud; those with new points around
  std::uint64_t unseen = 0;                ///< seen by no photograph
  std::uint64_t fine_enough = 0;           ///< no photograph is clearly finer there, or not after `coarser`
  std::uint64_t without_surface = 0;       ///< alone, on a border or an edge: what lies between the points is not known
  std::uint64_t over_budget = 0;           ///< would have new points around, but the budget does not hold those of the coarsest step either: none are inserted then
};

/// Writes new points to `file`, by leaf of the store. most: their number at most; where no step of the common factor keeps to it the file has none, and a note says so. Memory: leaves as the budget allows, not more with more points.
/// The same bytes for any number of threads. throws Error (no space), Cancelled.
RefineStats find_new_points(const stream::Store& store, std::span<const BlendPhotograph> photographs, const BlendOptions& options, std::uint64_t most,
                            const std::filesystem::path& file, const std::filesystem::path& scratch, MemoryBudget& budget, Reporter& report);

/// The points of such a file, with normals. throws Error.
std::unique_ptr<stream::PointReader> read_new_points(const std::filesystem::path& file);

}  // namespace chiaro::blend
