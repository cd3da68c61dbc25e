#include "tools/report.h"

#include <algorithm>
#include <cmath>
#include <numeric>
#include <set>

#include "tools/camera_record.h"
#include "tools/light_spread_json.h"
#include "tools/report_data.h"
#include "tools/table.h"

namespace chiaro::tools {
namespace {
namespace fs = std::filesystem;

void require_finished_run(const RunFolder& folder) {
  std::error_code code;
  if (!fs::is_directory(folder.root, code)) throw Error(concat(folder.root.string(), ": no such folder"));
  for (const fs::path& file : {folder.project(), folder.record(), folder.lights()})
    if (!fs::exists(file, code))
      throw Error(concat(folder.root.string(), ": not the folder of a finished run: ", fs::relative(file, folder.root, code).string(), " is missing; `chiaro run` writes it"));
}

void read_left_out(ReportData& data) {
  for (const Json& one : member(data.record, "left_out"))
    data.left_out.push_back({text_of(member(one, "kind")), text_of(member(one, "name")), text_of(member(one, "reason")), count_of(member(one, "amount"))});
  for (const Json& note : member(data.record, "notes")) data.notes.push_back(text_of(note));
}

double pair_value(const Json& pair, std::size_t i) { return pair.is_array() && pair.size() == 2 ? number_of(pair[i]) : NAN; }

/// The acquisition that the lights of `acquisition` were solved with, mostly itself: what is known of its flash is known of both.
const Json& lead_of(const Json& acquisition, const Json& all) {
  const std::string name = text_of(member(acquisition, "lights_of"));
  for (const Json& other : all)
    if (!name.empty() && text_of(member(other, "acquisition")) == name) return other;
  return acquisition;
}

std::uint64_t references_of(const Json& lead, const Json& all) {
  std::uint64_t references = 0;
  for (const Json& other : all)
    if (&lead_of(other, all) == &lead) references += count_of(member(other, "references"));
  return references;
}

/// Empty where no light was solved: photographs without flash measure that of another acquisition.
std::string scale_sentence(const Json& light, const Json& acquisition, const Json& all, const std::string& method) {
  const Json& lead = lead_of(acquisition, all);
  if (&lead != &acquisition && !member(light, "absolute_scale").is_string()) return "";
  const auto references = references_of(lead, all);
  const Json& range = member(lead, "calibrated_range");
  if (method == "direct")
    return concat("The absolute scale is that of the middle of the calibrated flash range; neither ambient light nor bounces were taken off, so shaded parts come out too bright.");
  if (text_of(member(light, "absolute_scale")) != "calibrated")
    return "Nothing of known reflectance or brightness was given: the absolute scale rests on light that bounced between surfaces, and on the guess that the brightest of them reflect 80 %. Trust ratios of albedo, not its level.";
  if (references > 0)
    return concat("The absolute scale comes from ", references == 1 ? "a reference target" : concat(references, " reference targets"), " of known albedo",
                  range.is_array() ? ", together with the calibrated flash range." : ".");
  return concat("The absolute scale comes from the calibrated flash range, ", format_number(pair_value(range, 0), 4), " to ", format_number(pair_value(range, 1), 4),
                " W/sr: a flash that was really brighter makes every albedo darker by the same factor.");
}

std::string percent_change(double change) { return concat(change < 0 ? "\u2212" : "+", format_number(100 * std::abs(change), 2), "\u00a0%"); }

std::string open_direction_sentence(const Json& open) {
  const auto at = [&](const char* name, std::size_t end) { return pair_value(member(open, name), end); };
  if (!std::isfinite(at("flash_intensity", 0)) || !(at("flash_intensity", 0) < at("flash_intensity", 1))) return "";
  const auto ends = [&](const char* name) { return concat(format_number(at(name, 0), 4), " … ", format_number(at(name, 1), 4)); };
  std::string sentence = concat("Least certain, two standard deviations either way: flash ", ends("flash_intensity"), " W/sr");
  if (at("ambient", 1) > 0) sentence += concat(" with ambient radiance ", ends("ambient"));
  sentence += concat(". Along it the albedo of what the flash lights changes by ", percent_change(at("albedo_change_in_flash_light", 0)), " … ", percent_change(at("albedo_change_in_flash_light", 1)));
  if (at("ambient", 1) > 0)
    sentence += concat(", of what only the ambient light reaches by ", percent_change(at("albedo_change_in_ambient_light", 0)), " … ", percent_change(at("albedo_change_in_ambient_light", 1)));
  return sentence + ".";
}

ReportedLight read_light(const Json& light, const Json& acquisition, const Json& all, const std::string& method) {
  ReportedLight out;
  out.acquisition = text_of(member(acquisition, "acquisition"));
  out.photograph = text_of(member(light, "photograph"));
  out.how = text_of(member(acquisition, "how"));
  out.scale = scale_sentence(light, acquisition, all, method);
  out.flash = number_of(member(light, "flash_intensity"));
  out.flash_sd = number_of(member(light, "flash_intensity_sd"));
  out.ambient = number_of(member(light, "ambient"));
  out.ambient_sd = number_of(member(light, "ambient_sd"));
  out.bounce = number_of(member(light, "bounce"));
  const Json& allowed = member(member(light, "allowed"), "flash_intensity");
  out.allowed_min = pair_value(allowed, 0);
  out.allowed_max = pair_value(allowed, 1);
  const Json& range = member(lead_of(acquisition, all), "calibrated_range");
  out.calibrated_min = pair_value(range, 0);
  out.calibrated_max = pair_value(range, 1);
  out.open_direction = open_direction_sentence(member(light, "open_direction"));
  if (!out.open_direction.empty()) out.picture = light_spread_svg(light, range);
  return out;
}

void read_lights(ReportData& data) {
  const std::string method = data.status.method;
  data.solved_lights = method != "none";
  const Json& all = member(data.lights, "acquisitions");
  for (const Json& a : all) {
    if (!data.solved_lights) continue;
    const Json& each = member(a, "photographs");
    if (!each.is_array())
      data.found.push_back(read_light(a, a, all, method));
    else
      for (const Json& one : each) data.found.push_back(read_light(one, a, all, method));
  }
}

void read_weights(const RunFolder& folder, ReportData& data) {
  const Json& weights = member(member(data.record, "blending"), "weights");
  const auto at = [&](const char* name) { return static_cast<float>(number_of(member(weights, name))); };
  const blend::WindowOptions options{.low_radius = at("low_radius"), .reference_footprint = at("footprint"), .border_px = at("border_px")};
  std::error_code code;
  if (!(options.low_radius > 0 && options.reference_footprint > 0 && options.border_px > 0 && options.border_px <= 64) || !std::filesystem::exists(folder.cameras(), code)) return;
  data.weights = options;
  for (PhotographCamera& c : read_camera_record(folder.cameras())) data.cameras[c.camera.photograph] = std::move(c.camera);
}

/// Photographs of the project that the run did not leave out.
std::vector<ReportedPhotograph> used_photographs(const ReportData& data, const fs::path& file) {
  std::set<std::string> left_out;
  for (const LeftOut& one : data.left_out)
    if (one.kind == "photograph") left_out.insert(one.name);
  std::vector<ReportedPhotograph> used;
  for (const Json& a : member(data.project, "acquisition")) {
    if (text_of(member(a, "role"), "flash") != "flash") continue;
    for (const Json& p : member(a, "photographs")) {
      ReportedPhotograph one;
      one.acquisition = text_of(member(a, "name"));
      one.key = text_of(member(p, "key"));
      one.file = fs::path(text_of(member(p, "file"))).filename().string();
      require_plain_name(one.key, file, "a photograph");
      if (!left_out.contains(one.key)) used.push_back(std::move(one));
    }
  }
  return used;
}

/// One exposure for all photographs: 99 % of the values that lie on the cloud are below white. A few photographs from near by, with the flash on top of the
/// object, must not leave the others in the dark: white is at most one stop above what the photograph in the middle of the set would have.
double choose_white(const RunFolder& folder, const ReportData& data) {
  constexpr double kShare = 0.99, kMostOverMiddle = 2;
  LogHistogram all;
  std::vector<double> each;
  for (const ReportedPhotograph& p : data.photographs) {
    ReportPhoto photo(folder, p.key, data.solved_lights);
    const LogHistogram own = radiance_histogram(photo);
    if (own.count() > 0) each.push_back(own.quantile(kShare));
    all.add(own);
  }
  if (each.empty()) return 1;
  std::sort(each.begin(), each.end());
  const double white = std::min(all.quantile(kShare), kMostOverMiddle * each[each.size() / 2]);
  return white > 0 ? white : 1;
}

PictureRanges measure_all(const RunFolder& folder, ReportData& data, Reporter& report) {
  PictureRanges ranges;
  report.begin("report: measure", data.photographs.size(), "photographs");
  std::uint64_t done = 0;
  for (ReportedPhotograph& p : data.photographs) {
    ReportPhoto photo(folder, p.key, data.solved_lights);
    p.width = photo.width();
    p.height = photo.height();
    p.measures = measure(photo, data.scales.white, ranges, report);
    report.progress(++done);
  }
  report.end();
  return ranges;
}

void choose_scales(ReportData& data, const PictureRanges& ranges) {
  // The top saturates: a few edges must not darken the rest. What is the same everywhere may end just above a round number: 1 % of play.
  const auto range = [](const LogHistogram& h) { return std::min(1.0, round_range(h.quantile(0.96) * 0.99)); };
  data.scales.difference = range(ranges.difference);
  data.scales.sigma = range(ranges.sigma);
  data.scales.indirect = range(ranges.indirect);
  data.scales.ambient = range(ranges.ambient);
  if (!data.solved_lights) data.scales.albedo_white = data.scales.white;
}

/// Photographs to show with pictures: all, or half evenly through the set and half the ones that are predicted worst.
std::set<std::size_t> choose_shown(const ReportData& data, std::size_t most) {
  const std::size_t n = data.photographs.size();
  std::set<std::size_t> shown;
  if (n <= most) {
    for (std::size_t i = 0; i < n; ++i) shown.insert(i);
    return shown;
  }
  for (std::size_t i = 0; i < most / 2; ++i) shown.insert(i * n / std::max<std::size_t>(1, most / 2));
  std::vector<std::size_t> order(n);
  std::iota(order.begin(), order.end(), std::size_t{0});
  const auto badness = [&](std::size_t i) { return std::isfinite(data.photographs[i].measures.psnr_srgb) ? -data.photographs[i].measures.psnr_srgb : -1e9; };
  std::stable_sort(order.begin(), order.end(), [&](std::size_t a, std::size_t b) { return badness(a) > badness(b); });
  for (const std::size_t i : order)
    if (shown.size() < most) shown.insert(i);
  return shown;
}

constexpr int kWeightsAreSmallerBy = 2;

std::uint64_t draw_all(const RunFolder& folder, ReportData& data, const std::set<std::size_t>& shown, int width, Reporter& report) {
  std::uint64_t bytes = 0, done = 0;
  report.begin("report: draw", shown.size(), "photographs");
  for (const std::size_t i : shown) {
    ReportedPhotograph& p = data.photographs[i];
    ReportPhoto photo(folder, p.key, data.solved_lights);
    p.pictures = draw(photo, data.scales, width, report);
    if (data.weights && data.cameras.contains(p.key)) p.weights = draw_weights(folder, data.cameras.at(p.key), *data.weights, std::max(1, width / kWeightsAreSmallerBy), report);
    for (const auto* pictures : {&p.pictures, &p.weights})
      for (const ReportPicture& picture : *pictures) bytes += (picture.png.size() + 2) / 3 * 4;
    report.progress(++done);
  }
  report.end();
  return bytes;
}

/// Narrower pictures until they fit. A first guess from the size of the set saves drawing large ones in vain.
int draw_within(const RunFolder& folder, ReportData& data, const ReportOptions& options, std::uint64_t bytes_for_pictures, Reporter& report) {
  const std::set<std::size_t> shown = choose_shown(data, options.max_pictures_of);
  data.shown = shown.size();
  double pixels_at_one = 0;   // of all pictures, were they one pixel wide
  constexpr double kWeightsCompress = 4;   // even areas
  const double pictures = (data.solved_lights ? 9.0 : 6.0) + (data.weights ? blend::kCriteria.size() + 1.0 : 0.0) / (kWeightsAreSmallerBy * kWeightsAreSmallerBy * kWeightsCompress);
  for (const std::size_t i : shown) pixels_at_one += pictures * data.photographs[i].height / data.photographs[i].width;
  constexpr double kLikelyBytesPerPixel = 1.0;
  double width = std::min<double>(options.max_picture_width, std::sqrt(static_cast<double>(bytes_for_pictures) / (kLikelyBytesPerPixel * std::max(1e-9, pixels_at_one))));
  for (;;) {
    const int whole = std::max(options.min_picture_width, static_cast<int>(width));
    const std::uint64_t bytes = draw_all(folder, data, shown, whole, report);
    if (bytes <= bytes_for_pictures || whole == options.min_picture_width) return whole;
    width = whole * 0.95 * std::sqrt(static_cast<double>(bytes_for_pictures) / static_cast<double>(bytes));
  }
}

}  // namespace

std::uint64_t ReportData::photographs_left_out() const {
  return static_cast<std::uint64_t>(std::count_if(left_out.begin(), left_out.end(), [](const LeftOut& one) { return one.kind == "photograph"; }));
}

double ReportData::coverage() const {
  const double seen = static_cast<double>(count("points_seen")), all = seen + static_cast<double>(count("points_unseen"));
  return all > 0 ? seen / all : NAN;
}

std::vector<std::string> ReportData::scale_sentences() const {
  if (!solved_lights) return {"No light was taken off (solve.method = \"none\"): the colours are those of the photographs, not albedo."};
  std::vector<std::string> sentences;
  for (const ReportedLight& light : found)
    if (!light.scale.empty() && std::find(sentences.begin(), sentences.end(), light.scale) == sentences.end()) sentences.push_back(light.scale);
  return sentences;
}

ReportResult write_report(const RunFolder& folder, Reporter& report, const ReportOptions& options) {
  require_finished_run(folder);
  ReportData data;
  data.status = read_status(folder);
  if (const std::string note = note_on_unfinished(data.status); !note.empty()) {
    data.notes.push_back(note);
    report.note(note);
  }
  data.project = read_json_object(folder.project());
  data.record = read_json_object(folder.record());
  data.lights = read_json_object(folder.lights());
  read_left_out(data);
  read_lights(data);
  read_weights(folder, data);
  data.photographs = used_photographs(data, folder.project());
  data.scales.white = choose_white(folder, data);
  choose_scales(data, measure_all(folder, data, report));
  const std::uint64_t text_bytes = report_html(data).size();
  const std::uint64_t left = options.max_bytes > text_bytes + 200'000 ? options.max_bytes - text_bytes - 200'000 : 0;

  ReportResult result;
  result.picture_width = draw_within(folder, data, options, left, report);
  const std::string html = report_html(data);
  make_folder(folder.report());
  result.json = folder.report() / "report.json";
  result.html = folder.report() / "index.html";
  write_text(result.json, report_json(data).dump(1, ' ', false, Json::error_handler_t::replace) + "\n");
  write_text(result.html, html);
  result.html_bytes = html.size();
  result.photographs = data.photographs.size();
  return result;
}

}  // namespace chiaro::tools
