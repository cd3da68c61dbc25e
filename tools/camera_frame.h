/// Cameras that are hardly in the cloud's frame: another unit, or no scale at all.
#pragma once
#include <optional>
#include <span>
#include <string>

#include "stream/base/types.h"

namespace chiaro::tools {

/// Words on a camera that stands so far from the cloud that it could show it as a dot alone; absent where it does not. In parentheses, after what it lacks.
std::optional<std::string> far_camera(const Vec3d& camera, const Box3d& cloud, const std::string& unit);

/// A sentence on cameras that stand in one spot inside the cloud, where three and more would stand apart; absent where they do not.
std::optional<std::string> cameras_in_one_spot(std::span<const Vec3d> cameras, const Box3d& cloud, const std::string& unit);

}  // namespace chiaro::tools
