/// views.toml: cameras from which `chiaro render` predicts photographs. Contract: docs/project-file.md.
#pragma once
#include <filesystem>
#include <optional>
#include <string>
#include <vector>

#include "stream/photo/camera.h"

namespace chiaro::tools {

struct ViewInput {
  std::string name;                              ///< file name of the picture, without extension
  stream::Lens lens;
  stream::Pose pose;
  std::optional<Vec3d> flash_offset_in_camera;   ///< absent: the acquisition's
  std::optional<double> flash_intensity;         ///< absent: the acquisition's
  double ambient_scale = 1;
};

/// throws UsageError with file, line and column for wrong types, missing or unknown keys, singular poses, names that are no file names.
std::vector<ViewInput> load_views(const std::filesystem::path& path);

}  // namespace chiaro::tools
