#include "tools/report_data.h"

#include <algorithm>
#include <cmath>

namespace chiaro::tools {
namespace {

double median(std::vector<double> v) {
  std::erase_if(v, [](double x) { return std::isnan(x); });
  if (v.empty()) return NAN;
  std::sort(v.begin(), v.end());
  return v.size() % 2 ? v[v.size() / 2] : (v[v.size() / 2 - 1] + v[v.size() / 2]) / 2;
}

}  // namespace

double share(std::uint64_t part, std::uint64_t whole) { return whole > 0 ? static_cast<double>(part) / static_cast<double>(whole) : NAN; }

double median_over(const ReportData& d, double PhotoMeasures::*value) {
  std::vector<double> v;
  for (const ReportedPhotograph& p : d.photographs) v.push_back(p.measures.*value);
  return median(std::move(v));
}

double computing_seconds(const ReportData& d) {
  double sum = 0;
  for (const StageStatus& s : d.status.stages) sum += s.seconds;
  return sum;
}

std::string method_in_words(const std::string& method) {
  if (method == "joint") return "The lights were solved over all photographs of an acquisition together, then the albedo of each photograph, then all were blended.";
  if (method == "single") return "The lights were solved for each photograph by itself, then its albedo, then all were blended.";
  if (method == "adam") return "Lights and albedo of each photograph were found by gradient descent (Adam), then all were blended.";
  if (method == "direct") return "Only the direct light of the flash was taken off: no ambient light, no bounces. This is the standard pipeline, for comparison.";
  if (method == "none") return "The photographs were taken as the colour itself and blended; no light was taken off.";
  return "";
}

Json report_json(const ReportData& d) {
  Json out{{"version", text_of(member(d.record, "version"))}, {"project", d.status.project}, {"method", d.status.method}, {"layers", member(d.record, "layers")}};
  out["headline"] = {{"points_in", d.count("points_in")},
                     {"points_out", d.count("points_out")},
                     {"points_seen", d.count("points_seen")},
                     {"points_unseen", d.count("points_unseen")},
                     {"points_rejected", d.count("points_rejected")},
                     {"coverage", json_or_null(d.coverage())},
                     {"photographs_used", d.photographs.size()},
                     {"photographs_left_out", d.photographs_left_out()},
                     {"median_psnr_linear", json_or_null(median_over(d, &PhotoMeasures::psnr_linear))},
                     {"median_psnr_srgb", json_or_null(median_over(d, &PhotoMeasures::psnr_srgb))},
                     {"median_ssim", json_or_null(median_over(d, &PhotoMeasures::ssim))},
                     {"median_sigma", json_or_null(median_over(d, &PhotoMeasures::median_sigma))},
                     {"seconds", computing_seconds(d)},
                     {"seconds_last_run", member(d.record, "seconds")},
                     {"peak_bytes", member(member(d.record, "memory"), "peak_bytes")},
                     {"absolute_scale", d.scale_sentences()}};
  out["scales"] = {{"white_radiance", d.scales.white},     {"albedo_white", d.scales.albedo_white}, {"difference", d.scales.difference},
                   {"sigma", d.scales.sigma},              {"indirect", d.scales.indirect},         {"ambient", d.scales.ambient}};
  out["lights"] = Json::array();
  for (const ReportedLight& l : d.found)
    out["lights"].push_back({{"acquisition", l.acquisition}, {"photograph", l.photograph.empty() ? Json(nullptr) : Json(l.photograph)}, {"how", l.how},
                             {"flash_intensity", json_or_null(l.flash)}, {"flash_intensity_sd", json_or_null(l.flash_sd)}, {"ambient", json_or_null(l.ambient)},
                             {"ambient_sd", json_or_null(l.ambient_sd)}, {"bounce", json_or_null(l.bounce)}, {"allowed", {json_or_null(l.allowed_min), json_or_null(l.allowed_max)}},
                             {"calibrated", {json_or_null(l.calibrated_min), json_or_null(l.calibrated_max)}}, {"absolute_scale", l.scale.empty() ? Json(nullptr) : Json(l.scale)}});
  out["left_out"] = Json::array();
  for (const LeftOut& one : d.left_out) out["left_out"].push_back({{"kind", one.kind}, {"name", one.name}, {"reason", one.reason}, {"amount", one.amount}});
  out["photographs"] = Json::array();
  for (const ReportedPhotograph& p : d.photographs) {
    const PhotoMeasures& m = p.measures;
    Json one{{"key", p.key}, {"acquisition", p.acquisition}, {"file", p.file}, {"width", p.width}, {"height", p.height}, {"pixels", m.pixels}, {"pixels_usable", m.usable},
             {"pixels_on_cloud", m.on_cloud}, {"pixels_solved", m.solved}, {"pixels_predicted", m.predicted}, {"share_solved", json_or_null(share(m.solved, m.usable))},
             {"psnr_linear", json_or_null(m.psnr_linear)}, {"psnr_srgb", json_or_null(m.psnr_srgb)}, {"ssim", json_or_null(m.ssim)}, {"residual_rms", json_or_null(m.residual_rms)},
             {"residual_relative", json_or_null(m.residual_relative)}, {"median_sigma", json_or_null(m.median_sigma)}};
    if (d.solved_lights) one["shares"] = {{"direct", json_or_null(m.shares[0])}, {"indirect", json_or_null(m.shares[1])}, {"ambient", json_or_null(m.shares[2])}};
    out["photographs"].push_back(std::move(one));
  }
  out["stages"] = Json::array();
  for (const StageStatus& s : d.status.stages) out["stages"].push_back({{"name", s.name}, {"tasks", s.done}, {"seconds", s.seconds}});
  return out;
}

}  // namespace chiaro::tools
