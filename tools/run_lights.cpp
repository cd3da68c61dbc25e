#include "tools/run_lights.h"

#include <algorithm>
#include <cmath>
#include <nlohmann/json.hpp>

#include "stream/base/error.h"
#include "stream/base/file.h"
#include "tools/light_record_json.h"
#include "tools/light_spread_json.h"
#include "tools/run_context_json.h"

namespace chiaro::tools {
namespace {
using Json = nlohmann::ordered_json;

std::vector<std::string> names_of_unknowns(const optimize::LightSolution& s) {
  std::vector<std::string> names{"ln_flash_intensity"};
  for (int k = 0; k < s.sky_terms; ++k) names.push_back("sky_" + std::to_string(k));
  if (s.sky_colour) names.insert(names.end(), {"ln_sky_red", "ln_sky_blue"});
  if (s.lights.floor) names.push_back("floor_albedo");
  if (s.lights.gloss.on) names.insert(names.end(), {"ln_gloss_reflectance", "ln_gloss_roughness"});
  names.push_back("bounce");
  return names;
}

/// What was found of one light, and how certain it is.
Json solution_json(const optimize::LightSolution& s, const optimize::ErrorModel& errors) {
  const double ln_sd = s.covariance.rows() > 0 ? std::sqrt(std::max(0.0, s.covariance(0, 0))) : 0;
  const int sky = s.sky_terms;
  const double ambient_sd = sky > 0 ? std::sqrt(std::max(0.0, s.covariance(1, 1) + s.ambient_open)) : 0;
  Json found{{"flash_intensity", s.lights.flash_intensity}, {"flash_intensity_sd", ln_sd * s.lights.flash_intensity},
              {"ambient", s.lights.sky[0]}, {"ambient_sd", ambient_sd}, {"sky", s.lights.sky},
              {"sky_colour", s.lights.sky_colour}, {"sky_basis", "1, y, z, x, xy, yz, 3z^2-1, xz, x^2-y^2 of the world direction"}, {"bounce", s.lights.bounce},
              {"covariance_of", names_of_unknowns(s)}, {"covariance", covariance_json(s)},
              {"allowed", {{"flash_intensity", {s.lights.flash_intensity * std::exp(-2 * ln_sd), s.lights.flash_intensity * std::exp(2 * ln_sd)}},
                           {"ambient", {std::max(0.0, s.lights.sky[0] - 2 * ambient_sd), s.lights.sky[0] + 2 * ambient_sd}}}},
              {"absolute_scale", s.scale_known ? "calibrated" : "from interreflections and a guess of the brightest albedo: trust ratios, not the scale"},
              {"scatter_of_ln_albedo", s.scatter}, {"samples", s.samples}, {"converged", s.converged}};
  found["errors"] = error_json(errors);
  found["open_direction"] = to_json(light_spread(s));
  if (s.lights.gloss.on) found["gloss"] = gloss_json(s.lights.gloss);
  if (s.lights.floor) found["floor_albedo"] = s.lights.floor_albedo;
  return found;
}

/// In words.
std::string how_found(const std::vector<Shoot>& shoots, const Shoot& shoot, SolveMethod method) {
  std::size_t n = 0, without_flash = 0;
  for (const Shoot& other : shoots)
    if (other.lead == shoot.lead) (other.has_flash() ? n : without_flash) += other.photos.size();
  const std::string dark = without_flash > 0 ? concat(" and ", without_flash, " without flash") : std::string();
  switch (method) {
    case SolveMethod::kJoint:
      if (shoots[shoot.lead].lights.lights.size() > 1) return "each photograph by itself, as they show too few places in common: log ratios of pairs of surfels of like chroma";
      return n + without_flash > 1 ? concat("jointly over ", n, " photographs", dark, ": log ratios of surfels seen at least twice") : std::string("one photograph: log ratios of pairs of surfels of like chroma");
    case SolveMethod::kSingle:
      if (without_flash > 0) return concat("each photograph by itself", dark, ": log ratios of surfels seen at least twice");
      return "each photograph by itself: log ratios of pairs of surfels of like chroma";
    case SolveMethod::kAdam: return "each photograph by itself: one-dimensional search of the flash, then Adam over albedo, flash and ambient; the result depends on its start";
    case SolveMethod::kDirect: return "not solved: the middle of the calibrated range, no ambient, no bounces";
    case SolveMethod::kNone: break;
  }
  return "";
}

void describe_lights(const std::vector<Shoot>& shoots, const Shoot& shoot, SolveMethod method, Json& a) {
  const optimize::AcquisitionResult& lights = shoots[shoot.lead].lights;
  a["sky_model"] = lights.sky_model;
  if (!lights.sky_evidence.empty()) a["sky_evidence"] = evidence_json(lights.sky_evidence);
  if (lights.gloss_evidence) a["gloss_evidence"] = *lights.gloss_evidence;
  a["proxy_surfels"] = lights.proxy_surfels;
  for (const Photo& p : shoot.photos) {
    if (p.index_in_lights >= lights.own_lights.size()) continue;
    const optimize::OwnLight& own = lights.own_lights[p.index_in_lights];
    if (own.exposure != 1) a["exposures"][p.input->key] = own.exposure;
    if (own.ambient != 1) a["ambient_factors"][p.input->key] = {{"factor", own.ambient}, {"sd", own.ambient * own.ambient_ln_sd}};
  }
  if (const Vec3d& shift = lights.pattern.flash_shift; !shift.isZero()) a["flash_shift_in_camera"] = {shift[0], shift[1], shift[2]};
  if (lights.spread[optimize::kExposure] > 0) a["exposure_spread"] = lights.spread[optimize::kExposure];
  if (lights.spread[optimize::kAmbient] > 0) a["ambient_spread"] = lights.spread[optimize::kAmbient];
  if (!lights.pattern.falloff.none()) a["falloff"] = falloff_json(lights.pattern.falloff);
  a["how"] = how_found(shoots, shoot, method);
  const Acquisition& input = *shoot.acquisition;
  if (input.flash->intensity_range) a["calibrated_range"] = *input.flash->intensity_range;
  a["references"] = std::count_if(input.references.begin(), input.references.end(), [&](const ReferenceInput& r) { return photo_of(shoot, r) != nullptr; });
  if (lights.lights.size() == 1) {
    a.update(solution_json(lights.lights[0], lights.errors[0]));
    return;
  }
  Json each = Json::array();
  for (std::size_t k = 0; k < shoot.photos.size() && !lights.lights.empty(); ++k) {
    Json j{{"photograph", shoot.photos[k].input->key}};
    const std::size_t which = lights.light_of_photograph[shoot.photos[k].index_in_lights];
    j.update(solution_json(lights.lights[which], lights.errors[which]));
    each.push_back(j);
  }
  a["photographs"] = each;
}

}  // namespace

void write_run_lights(const RunContext& run, const std::vector<Shoot>& shoots) {
  Json all = Json::array();
  for (const Shoot& shoot : shoots) {
    Json a{{"acquisition", shoot.acquisition->name}, {"method", name_of(run.project.method)}};
    if (run.project.method == SolveMethod::kNone) {
      a["how"] = "photographs taken as the colour itself; no light was solved";
    } else if (!shoot.has_flash()) {
      a["lights_of"] = shoots[shoot.lead].acquisition->name;
      a["how"] = concat("taken without flash: measures the ambient light of \"", shoots[shoot.lead].acquisition->name, "\"");
    } else {
      if (&shoot != &shoots[shoot.lead]) a["lights_of"] = shoots[shoot.lead].acquisition->name;
      describe_lights(shoots, shoot, run.project.method, a);
    }
    all.push_back(a);
  }
  write_text(run.folder.lights(), Json{{"acquisitions", all}}.dump(1) + "\n");
}

}  // namespace chiaro::tools
