#include "tools/camera_frame.h"

#include <cstdint>

#include "stream/base/error.h"
#include "tools/table.h"

namespace chiaro::tools {
namespace {

constexpr double kFar = 50;          ///< of the cloud's diagonal: it is then seen under one degree
constexpr double kOneSpot = 0.005;   ///< of the cloud's diagonal

double diagonal(const Box3d& box) { return (box.max - box.min).norm(); }

std::string length(double v, const std::string& unit) { return concat(v < 1000 || v > 1e15 ? format_number(v, 3) : format_count(static_cast<std::uint64_t>(v)), ' ', unit); }

}  // namespace

std::optional<std::string> far_camera(const Vec3d& camera, const Box3d& cloud, const std::string& unit) {
  const double distance = (camera - camera.cwiseMax(cloud.min).cwiseMin(cloud.max)).norm(), size = diagonal(cloud);
  if (!(distance > kFar * size)) return std::nullopt;
  return concat(" (its camera stands ", length(distance, unit), " from it, and the cloud is ", length(size, unit), " across: are cameras and cloud in one unit, and one frame?)");
}

std::optional<std::string> cameras_in_one_spot(std::span<const Vec3d> cameras, const Box3d& cloud, const std::string& unit) {
  if (cameras.size() < 3) return std::nullopt;
  Box3d spot;
  for (const Vec3d& c : cameras) spot.extend(c);
  const double apart = diagonal(spot), size = diagonal(cloud);
  const bool inside = (spot.min.array() >= cloud.min.array()).all() && (spot.max.array() <= cloud.max.array()).all();
  if (!inside || !(apart < kOneSpot * size)) return std::nullopt;
  return concat("all ", cameras.size(), " cameras stand within ", length(apart, unit), " of each other, inside a cloud that is ", length(size, unit),
                " across: right for pictures from one tripod. If not, cameras and cloud are in different units (m beside mm), or the cameras were never given a scale");
}

}  // namespace chiaro::tools
