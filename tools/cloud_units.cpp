#include "tools/cloud_units.h"

#include <array>
#include <cmath>

#include "stream/base/error.h"
#include "stream/base/types.h"
#include "stream/cloud/point_stream.h"

namespace chiaro::tools {
namespace {

constexpr std::size_t kLookedAt = 16384;   ///< points: a part of the cloud, where they come as they were scanned
constexpr double kAlike = 5;               ///< times: sizes of what the first points of two scans of one object cover
constexpr std::array kFactors{1000.0, 100.0, 0.01, 0.001};

struct Extent {
  Vec3d middle = Vec3d::Zero();
  double size = 0;
};

Extent extent_of(const std::filesystem::path& file, std::uint64_t memory_bytes) {
  const auto reader = stream::open_points(file, memory_bytes);
  reader->wants(stream::PointParts::kPositions);
  stream::PointBlock block;
  reader->read(block, kLookedAt);
  Box3d box;
  for (const Vec3d& p : block.position)
    if (p.allFinite()) box.extend(p);
  return box.empty() ? Extent{} : Extent{(box.min + box.max) / 2, (box.max - box.min).norm()};
}

/// Of about the same size, and in one place.
bool fit(const Extent& a, const Extent& b) {
  return a.size > 0 && b.size > 0 && a.size < kAlike * b.size && b.size < kAlike * a.size && (a.middle - b.middle).norm() < a.size + b.size;
}

Extent scaled(const Extent& e, double factor) { return {factor * e.middle, factor * e.size}; }

/// The factor that makes `other` fit; 1 where none does.
double factor_to(const Extent& first, const Extent& other) {
  double best = 1, least = kAlike;
  for (const double factor : kFactors) {
    const double unlike = std::exp(std::fabs(std::log(factor * other.size / first.size)));
    if (!(unlike < least) || !fit(first, scaled(other, factor))) continue;
    best = factor;
    least = unlike;
  }
  return best;
}

std::string sentence(const std::filesystem::path& large, const std::filesystem::path& small, double factor) {
  return concat(large.filename().string(), " has coordinates ", factor, " times as large as those of ", small.filename().string(), " and would fit it otherwise: is it in ", factor > 500 ? "millimetres" : "centimetres",
                ", and the other in metres? All clouds are taken to be in one unit, project.unit");
}

}  // namespace

std::vector<std::string> notes_on_units(const std::vector<std::filesystem::path>& files, std::uint64_t memory_bytes) {
  std::vector<std::string> notes;
  if (files.size() < 2) return notes;
  const Extent first = extent_of(files[0], memory_bytes);
  for (std::size_t i = 1; i < files.size(); ++i) {
    const double factor = factor_to(first, extent_of(files[i], memory_bytes));
    if (factor < 1) notes.push_back(sentence(files[i], files[0], std::round(1 / factor)));
    if (factor > 1) notes.push_back(sentence(files[0], files[i], factor));
  }
  return notes;
}

}  // namespace chiaro::tools
