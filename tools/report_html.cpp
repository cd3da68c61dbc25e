#include <algorithm>
#include <cmath>
#include <map>

#include "stream/base/budget.h"
#include "tools/report_data.h"
#include "tools/report_page.h"
#include "tools/report_pictures.h"
#include "tools/table.h"

namespace chiaro::tools {
namespace {

// Top ------------------------------------------------------------------------------------------------------------------------------

void tile(Page& page, const std::string& value, const std::string& words) {
  page.open("div", "class=\"tile\"").element("b", value).element("span", words).close("div");
}

void tiles(Page& page, const ReportData& d) {
  const char* what = d.solved_lights ? "albedo" : "colour";
  page.open("div", "class=\"tiles\"");
  tile(page, counted(d.count("points_in")), "points read");
  tile(page, counted(d.count("points_out")), "points exported");
  if (const std::uint64_t n = d.count("points_inserted")) tile(page, counted(n), "points inserted between them");
  tile(page, percent(d.coverage()), concat("of the points were seen and have ", d.solved_lights ? "an albedo" : "a colour"));
  tile(page, counted(d.count("points_unseen")), "points no photograph saw well");
  tile(page, concat(d.photographs.size(), " of ", d.photographs.size() + d.photographs_left_out()), "photographs used");
  const auto is_found = [](const ReportedLight& l) { return std::isfinite(l.flash); };   // photographs without flash measure that of others
  if (d.solved_lights && std::count_if(d.found.begin(), d.found.end(), is_found) == 1) {
    const ReportedLight& light = *std::find_if(d.found.begin(), d.found.end(), is_found);
    tile(page, with_sd(light.flash, light.flash_sd), "flash, W/sr");
    tile(page, with_sd(light.ambient, light.ambient_sd), "ambient radiance");
  }
  tile(page, percent(median_over(d, &PhotoMeasures::median_sigma)), concat("typical uncertainty of one photograph's ", what));
  tile(page, number(median_over(d, &PhotoMeasures::psnr_srgb)) + (std::isfinite(median_over(d, &PhotoMeasures::psnr_srgb)) ? "\u00a0dB" : ""), "prediction against photograph (PSNR, sRGB), median");
  tile(page, format_seconds(computing_seconds(d)), "computing time");
  const std::uint64_t peak = count_of(member(member(d.record, "memory"), "peak_bytes")), limit = count_of(member(member(d.record, "memory"), "limit_bytes"));
  if (peak > 0) tile(page, format_bytes(peak), limit > 0 ? concat("peak memory, of ", format_bytes(limit), " allowed") : std::string("peak memory"));
  page.close("div");
}

void head(Page& page, const ReportData& d) {
  const std::string name = d.status.project.empty() ? "run" : d.status.project;
  page.raw("<!DOCTYPE html>\n<html lang=\"en\">\n<head>\n<meta charset=\"utf-8\">\n<meta name=\"viewport\" content=\"width=device-width, initial-scale=1\">\n");
  page.element("title", concat(name, ": chiaro report")).open("style").raw(page_style()).close("style").close("head").open("body").open("main");
  page.element("h1", name);
  page.element("p", concat("Report of chiaro ", text_of(member(d.record, "version")), ", run of ", text_of(member(d.record, "started"), "unknown date"), ". ", method_in_words(d.status.method)),
               "class=\"soft\"");
  tiles(page, d);
  for (const std::string& sentence : d.scale_sentences()) page.element("p", sentence);
}

void lights(Page& page, const ReportData& d) {
  if (d.found.empty()) return;
  page.element("h2", "Lights");
  page.element("p",
               "What lit the object, as far as the photographs tell. The interval is what they and the calibration allow together (two standard deviations); albedo moves with the flash "
               "in inverse proportion.",
               "class=\"soft\"");
  std::vector<std::vector<std::string>> rows;
  for (const ReportedLight& l : d.found)
    rows.push_back({l.acquisition, l.photograph.empty() ? "all" : l.photograph, with_sd(l.flash, l.flash_sd), interval(l.allowed_min, l.allowed_max), interval(l.calibrated_min, l.calibrated_max),
                    with_sd(l.ambient, l.ambient_sd), number(l.bounce), l.how});
  table(page, {"acquisition", "photograph", "flash, W/sr", "allowed", "calibrated", "ambient radiance", "bounce factor", "how it was found"}, "wwnnnnnl", rows);
  // One picture is worth a look; of fifty single photographs the table is.
  constexpr std::size_t kMostPictures = 6;
  for (std::size_t i = 0; i < std::min(d.found.size(), kMostPictures); ++i) {
    const ReportedLight& l = d.found[i];
    if (l.open_direction.empty()) continue;
    page.element("p", concat(d.found.size() > 1 ? concat(l.photograph.empty() ? l.acquisition : l.photograph, ". ") : std::string(), l.open_direction));
    if (!l.picture.empty()) page.open("p").raw(l.picture).close("p");
  }
}

void left_out(Page& page, const ReportData& d) {
  if (!d.left_out.empty()) {
    page.element("h2", "Left out");
    std::vector<std::vector<std::string>> rows;
    for (const LeftOut& one : d.left_out) rows.push_back({one.kind, one.name, one.kind == "photograph" ? "" : counted(one.amount), one.reason});
    table(page, {"kind", "name", "how many", "why"}, "wwnl", rows);
  }
  if (d.notes.empty()) return;
  page.element("h2", "Notes of the run").open("ul");
  for (const std::string& note : d.notes) page.element("li", note);
  page.close("ul");
}

// Photographs ----------------------------------------------------------------------------------------------------------------------

void numbers(Page& page, const ReportData& d) {
  page.element("h2", "Photographs in numbers");
  page.element("p",
               concat(d.solved_lights ? "The prediction is the blended result, lit again as this photograph was. A high agreement says that all photographs tell the same story of the surface; it "
                                        "does not by itself say that the split into light and albedo is right. "
                                      : "The prediction is the blended result as seen from here. A high agreement says that all photographs tell the same story of the surface. ",
                      "PSNR linear has its peak at the white of the pictures (radiance ",
                      number(d.scales.white), "), PSNR and SSIM otherwise are of sRGB-encoded values; all within the pixels that have a prediction."),
               "class=\"soft\"");
  std::vector<std::string> headers{"photograph", "size", "solved", "PSNR linear, dB", "PSNR sRGB, dB", "SSIM", "residual rms", "median sigma"};
  if (d.solved_lights) headers.insert(headers.end(), {"direct", "indirect", "ambient"});
  std::vector<std::vector<std::string>> rows;
  for (const ReportedPhotograph& p : d.photographs) {
    const PhotoMeasures& m = p.measures;
    rows.push_back({p.key, concat(p.width, " × ", p.height), percent(share(m.solved, m.usable)), number(m.psnr_linear), number(m.psnr_srgb), number(m.ssim), percent(m.residual_relative),
                    percent(m.median_sigma)});
    if (d.solved_lights)
      for (const double s : m.shares) rows.back().push_back(percent(s));
  }
  table(page, headers, "w", rows);
}

/// What the blend found of each photograph. Runs of before it was recorded have nothing here.
void agreement(Page& page, const ReportData& d) {
  const Json& blending = member(d.record, "blending");
  const Json& photographs = member(blending, "photographs");
  if (!photographs.is_array() || photographs.empty()) return;
  page.element("h2", "How the photographs agree");
  page.element("p",
               concat("Two photographs of the same point differ by ", percent(number_of(member(blending, "scatter"))), " in the middle of all pairs. Brightness is against the others, on what they show together; ",
                      "“beside its place” is how far the photograph shows the surface from where its camera puts it. Readings are left out where most other photographs contradict them."),
               "class=\"soft\"");
  std::vector<std::vector<std::string>> rows;
  for (const Json& p : photographs) {
    const Json &gain = member(p, "gain"), &shift = member(p, "shift_px"), &region = member(p, "disturbed");
    const double used = number_of(member(p, "samples")), rejected = number_of(member(p, "rejected"));
    const double middle = gain.is_array() && gain.size() == 3 ? std::cbrt(number_of(gain[0]) * number_of(gain[1]) * number_of(gain[2])) : NAN;
    const double length = shift.is_array() && shift.size() == 2 ? std::hypot(number_of(shift[0]), number_of(shift[1])) : NAN;
    rows.push_back({text_of(member(p, "photograph")), number(1 / middle), std::isfinite(length) ? number(length) : "–", percent(rejected / (used + rejected)),
                    region.is_object() ? concat("pixels ", count_of(member(region, "x0")), "–", count_of(member(region, "x1")), " across, ", count_of(member(region, "y0")), "–", count_of(member(region, "y1")), " down")
                                       : std::string("–")});
  }
  table(page, {"photograph", "brightness", "beside its place, px", "left out", "shows something else at"}, "wnnnl", rows);
}

/// Where the store holds more than this run's result.
void layers(Page& page, const ReportData& d) {
  std::vector<std::vector<std::string>> rows;
  for (const Json& one : member(d.record, "layers")) {
    const Json& made = member(one, "provenance");
    std::string acquisitions;
    for (const Json& name : member(made, "acquisitions")) acquisitions += (acquisitions.empty() ? "" : ", ") + text_of(name);
    const bool is_ours = member(one, "this_run").is_boolean() && member(one, "this_run").get<bool>();
    rows.push_back({text_of(member(one, "name")), text_of(member(made, "method")), counted(count_of(member(made, "photographs"))), acquisitions, is_ours ? "shown here" : ""});
  }
  if (rows.size() < 2) return;
  page.element("h2", "Layers of the store");
  page.element("p", "Results beside each other on the same points. chiaro compare DIR:ONE DIR:OTHER shows what differs.", "class=\"soft\"");
  table(page, {"layer", "method", "photographs", "acquisitions", ""}, "wwnww", rows);
}

// Record ---------------------------------------------------------------------------------------------------------------------------

void times(Page& page, const ReportData& d) {
  std::map<std::string, std::size_t> reused;
  for (const Json& s : member(d.record, "stages")) {
    const std::string name = text_of(member(s, "name"));
    if (member(s, "reused").is_boolean() && member(s, "reused").get<bool>()) ++reused[name.substr(0, name.find('/'))];
  }
  page.element("h2", "Time and storage");
  page.element("p", concat("Times are those of the tasks when they ran; the last run itself took ", format_seconds(number_of(member(d.record, "seconds"), 0)), "."), "class=\"soft\"");
  std::vector<std::vector<std::string>> rows;
  for (const StageStatus& s : d.status.stages)
    rows.push_back({s.name, counted(s.done), counted(reused[s.name]), format_seconds(s.seconds), s.done ? format_seconds(s.seconds / static_cast<double>(s.done)) : "–"});
  rows.push_back({"all", "", "", format_seconds(computing_seconds(d)), ""});
  table(page, {"stage", "tasks", "kept from an earlier run", "time", "per task"}, "w", rows);
  rows.clear();
  for (const PartSize& p : d.status.parts)
    if (p.name != "report") rows.push_back({p.name, format_bytes(p.bytes), counted(p.files)});
  table(page, {"part", "size", "files"}, "w", rows);
}

void folded(Page& page, const char* title, const Json& json) {
  constexpr std::size_t kMost = 1 << 20;
  std::string text = json.dump(1, ' ', false, Json::error_handler_t::replace);
  if (text.size() > kMost) text = text.substr(0, kMost) + "\n… cut here; the file has all of it";
  page.open("details").element("summary", title).open("pre").text(text).close("pre").close("details");
}

}  // namespace

std::string report_html(const ReportData& d) {
  Page page;
  head(page, d);
  lights(page, d);
  left_out(page, d);
  numbers(page, d);
  agreement(page, d);
  layers(page, d);
  how_to_read_pictures(page, d);
  photograph_pictures(page, d);
  times(page, d);
  page.element("h2", "Record");
  folded(page, "lights.json: lights with their covariance", d.lights);
  folded(page, "run.json: options, inputs with hashes, versions, timings, counts", d.record);
  folded(page, "project.json: the project with all defaults", d.project);
  page.close("main").close("body").raw("</html>\n");
  return page.take();
}

}  // namespace chiaro::tools
