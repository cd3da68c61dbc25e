/// What the stages of a run share: the project, its folder, the record, and the photographs on their way. For the .cpp files of `run` only.
#pragma once
#include <functional>
#include <nlohmann/json.hpp>
#include <string>
#include <string_view>
#include <vector>

#include "optimize/acquisition.h"
#include "stream/base/budget.h"
#include "stream/base/hash.h"
#include "stream/base/report.h"
#include "stream/photo/camera.h"
#include "stream/photo/develop.h"
#include "tools/progress_log.h"
#include "tools/project.h"
#include "tools/run_folder.h"
#include "tools/run_record.h"
#include "tools/task_log.h"

namespace chiaro::tools {

struct Photo {
  const PhotographInput* input = nullptr;
  std::size_t index_in_acquisition = 0;   ///< of the project, for references
  stream::Camera camera;                  ///< once developed: of the working image
  stream::PictureSize size;               ///< of the picture; 0 where it cannot be read
  int binning = 1;                        ///< side of the cells of the picture's pixels that are pixels of the working image
  optimize::PixelNoise noise;
  std::size_t index_in_lights = 0;        ///< among all photographs that share their lights
  std::string radiance_key, gbuffer_key, albedo_key;
};

struct Shoot {
  const Acquisition* acquisition = nullptr;
  std::vector<Photo> photos;
  std::size_t lead = 0;                   ///< number of the shoot whose lights these photographs share: most often its own
  double ambient_scale = 1;               ///< shutter time beside the lead's
  bool has_flash() const { return acquisition->flash.has_value(); }
  // Of a lead:
  std::string transport_key, light_key;
  optimize::AcquisitionResult lights;
};

/// The photograph that shows a target; null where it was left out.
const Photo* photo_of(const Shoot& shoot, const ReferenceInput& reference);

/// What to look at where photographs and cloud have nothing in common: the end of a message.
inline constexpr std::string_view kNothingSeenHint = "are cameras and cloud in the same frame, and do the cloud's normals point outwards (cloud.normals = \"estimate\" does without them)?";

/// Begins the key of a stage: with the version of the pipeline, raised when a stage's result changes for the same inputs.
Hasher keyed(std::string_view stage);

struct RunContext {
  const Project& project;
  const RunFolder folder;
  const TaskLog tasks;
  MemoryBudget& budget;
  RunRecord& record;
  Reporter& report;
  ProgressLog progress;

  /// On the console and in the record.
  void note_both(const std::string& text);
  /// Says so, enters it in the record, and removes the pictures that an earlier run made of the photograph.
  void leave_out(const PhotographInput& photograph, const std::string& reason);
  /// Runs a task and enters it in the record.
  nlohmann::ordered_json task(const std::string& name, const std::string& key, const std::vector<std::filesystem::path>& outputs, const std::function<nlohmann::ordered_json()>& body);
  optimize::ObserveInput observe_input(const Shoot& shoot, const Photo& photo) const;
};

}  // namespace chiaro::tools
