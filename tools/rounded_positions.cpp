#include "tools/rounded_positions.h"

#include <algorithm>
#include <cmath>
#include <limits>

#include "stream/base/error.h"
#include "stream/cloud/point_stream.h"
#include "tools/table.h"

namespace chiaro::tools {
namespace {

constexpr std::size_t kLookedAt = 16384;   ///< points: of doubles, hardly one is a float by chance
/// Of the distance between points. At a quarter rounding moves a point by 7 % of it, which tilts an estimated normal by a degree or two.
constexpr double kSmallStep = 0.25;

/// What single precision steps by at `value`.
double float_step(double value) {
  const float at = static_cast<float>(std::abs(value));
  return static_cast<double>(std::nextafter(at, std::numeric_limits<float>::infinity())) - static_cast<double>(at);
}

double largest_step(const Vec3d& position) { return float_step(position.cwiseAbs().maxCoeff()); }

double mean_spacing(const stream::Store& store) {
  double sum = 0, points = 0;
  for (const std::uint32_t leaf : store.leaves()) {
    const stream::ChunkEntry& entry = store.chunks()[leaf];
    sum += static_cast<double>(entry.spacing) * entry.count;
    points += entry.count;
  }
  return points > 0 ? sum / points : 0;
}

/// The step of single precision at most of the first points, where all of them have no more than that; else 0. Stray points far away do not count.
double step_of_single_precision(const std::filesystem::path& file, std::uint64_t memory_bytes) {
  const auto reader = stream::open_points(file, memory_bytes);
  reader->wants(stream::PointParts::kPositions);
  stream::PointBlock block;
  if (!reader->read(block, kLookedAt)) return 0;
  std::vector<double> steps;
  for (const Vec3d& p : block.position) {
    if (!p.allFinite()) continue;
    if (p != p.cast<float>().cast<double>()) return 0;
    steps.push_back(largest_step(p));
  }
  if (steps.empty()) return 0;
  const auto middle = steps.begin() + static_cast<std::ptrdiff_t>(steps.size() / 2);
  std::nth_element(steps.begin(), middle, steps.end());
  return *middle;
}

}  // namespace

std::vector<std::string> notes_on_rounded_positions(const stream::Store& store, const std::vector<std::filesystem::path>& files, std::uint64_t memory_bytes) {
  std::vector<std::string> notes;
  const Box3d& bounds = store.manifest().bounds;
  const double spacing = mean_spacing(store);
  if (spacing == 0) return notes;   // one place alone
  if (std::max(largest_step(bounds.min), largest_step(bounds.max)) <= kSmallStep * spacing) return notes;
  const std::string& unit = store.manifest().unit;
  for (const std::filesystem::path& file : files)
    if (const double step = step_of_single_precision(file, memory_bytes); step > kSmallStep * spacing)
      notes.push_back(concat(file.filename().string(), ": its coordinates have single precision, which far from the origin means steps of ", format_number(step, 3), " ", unit, ", and the points lie about ",
                             format_number(spacing, 3), " ", unit, " apart: their shape is lost in the steps. Write it again in double precision, or cloud and cameras with an offset taken off"));
  return notes;
}

}  // namespace chiaro::tools
