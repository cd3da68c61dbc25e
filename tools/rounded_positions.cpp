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

double largest_step(const Box3d& bounds) {
  double step = 0;
  for (int axis = 0; axis < 3; ++axis) step = std::max({step, float_step(bounds.min[axis]), float_step(bounds.max[axis])});
  return step;
}

double mean_spacing(const stream::Store& store) {
  double sum = 0, points = 0;
  for (const std::uint32_t leaf : store.leaves()) {
    const stream::ChunkEntry& entry = store.chunks()[leaf];
    sum += static_cast<double>(entry.spacing) * entry.count;
    points += entry.count;
  }
  return points > 0 ? sum / points : 0;
}

bool is_single_precision(const std::filesystem::path& file, std::uint64_t memory_bytes) {
  const auto reader = stream::open_points(file, memory_bytes);
  reader->wants(stream::PointParts::kPositions);
  stream::PointBlock block;
  if (!reader->read(block, kLookedAt)) return false;
  return std::all_of(block.position.begin(), block.position.end(), [](const Vec3d& p) { return !p.allFinite() || p == p.cast<float>().cast<double>(); });
}

}  // namespace

std::vector<std::string> notes_on_rounded_positions(const stream::Store& store, const std::vector<std::filesystem::path>& files, std::uint64_t memory_bytes) {
  std::vector<std::string> notes;
  const double step = largest_step(store.manifest().bounds), spacing = mean_spacing(store);
  if (step <= kSmallStep * spacing) return notes;
  const std::string& unit = store.manifest().unit;
  for (const std::filesystem::path& file : files)
    if (is_single_precision(file, memory_bytes))
      notes.push_back(concat(file.filename().string(), ": its coordinates have single precision, which far from the origin means steps of ", format_number(step, 3), " ", unit, ", and the points lie about ",
                             format_number(spacing, 3), " ", unit, " apart: their shape is lost in the steps. Write it again in double precision, or cloud and cameras with an offset taken off"));
  return notes;
}

}  // namespace chiaro::tools
