/// The photographs that are in a run's result, as they were used: lens of the photograph's own size, pose, and what blending found about each. Written by run,
/// read by render.
#pragma once
#include <array>
#include <filesystem>
#include <optional>
#include <string>
#include <vector>

#include "stream/photo/camera.h"

namespace chiaro::tools {

struct PhotographCamera {
  std::string acquisition;
  stream::Camera camera;                  ///< camera.photograph: the photograph's key
  std::optional<Vec3d> flash_in_camera;   ///< project units
  std::array<double, 3> gain{1, 1, 1};    ///< see blend::PhotographStats
  std::array<double, 2> shift_px{0, 0};   ///< see blend::Alignment
  double trust = 1;
};

/// Atomic.
void write_camera_record(const std::filesystem::path& file, const std::vector<PhotographCamera>& cameras);
/// throws Error with the file and the photograph where it is damaged.
std::vector<PhotographCamera> read_camera_record(const std::filesystem::path& file);

}  // namespace chiaro::tools
