/// Everything the report says, gathered once and then written as JSON and as HTML. For .cpp files only.
#pragma once
#include <map>
#include <optional>
#include <string>
#include <vector>

#include "tools/report_json.h"
#include "tools/report_photo.h"
#include "tools/report_weights.h"
#include "tools/status.h"

namespace chiaro::tools {

struct ReportedPhotograph {
  std::string acquisition, key, file;   ///< file: name without its folder
  int width = 0, height = 0;
  PhotoMeasures measures;
  std::vector<ReportPicture> pictures;  ///< empty where it is not shown
  std::vector<ReportPicture> weights;   ///< what its pixels count in the blend, see draw_weights()
};

struct LeftOut {
  std::string kind, name, reason;
  std::uint64_t amount = 0;
};

/// A light that was found: of an acquisition, or of one of its photographs.
struct ReportedLight {
  std::string acquisition, photograph;  ///< photograph: empty = all
  std::string how, scale;               ///< sentences
  double flash = 0, flash_sd = 0, ambient = 0, ambient_sd = 0, bounce = 1;   ///< NaN where there is none
  double allowed_min = 0, allowed_max = 0;       ///< flash intensities that the photographs allow
  double calibrated_min = 0, calibrated_max = 0; ///< range of the project file; NaN = none
  std::string open_direction;           ///< a sentence: what remains open, and what the albedo does along it; empty where nothing was solved
  std::string picture;                  ///< SVG of the same; may be empty
};

struct ReportData {
  Json project, record, lights;         ///< as they lie in the folder
  RunStatus status;
  bool solved_lights = true;            ///< false: solve.method = "none"
  std::vector<ReportedPhotograph> photographs;
  std::vector<ReportedLight> found;
  std::optional<blend::WindowOptions> weights;      ///< of the blend; nullopt for runs of before they were recorded
  std::map<std::string, stream::Camera> cameras;    ///< by key, of the photographs in the blend
  std::vector<LeftOut> left_out;
  std::vector<std::string> notes;
  PictureScales scales;
  std::size_t shown = 0;

  std::uint64_t count(const char* name) const { return count_of(member(member(record, "counts"), name)); }
  std::uint64_t photographs_left_out() const;
  /// Points with an albedo over points stored; NaN without points.
  double coverage() const;
  /// Where the absolute scale of the albedo comes from: one sentence a kind of case.
  std::vector<std::string> scale_sentences() const;
};

/// NaN of nothing.
double share(std::uint64_t part, std::uint64_t whole);
/// Median of one measure over the photographs; NaN where none has it.
double median_over(const ReportData& data, double PhotoMeasures::*value);
/// Of all tasks, when they ran.
double computing_seconds(const ReportData& data);
/// A method of the project file in words.
std::string method_in_words(const std::string& method);

Json report_json(const ReportData& data);
/// The whole page.
std::string report_html(const ReportData& data);

}  // namespace chiaro::tools
