#include <algorithm>
#include <cmath>
#include <map>

#include "stream/base/budget.h"
#include "tools/report_data.h"
#include "tools/table.h"

namespace chiaro::tools {
namespace {

// Neutral greys throughout: a coloured page would shift how the pictures look. One grey in the middle, as walls of viewing booths are.
const char* const kStyle = R"(
:root{--page:#4a4a4a;--panel:#3c3c3c;--line:#666;--text:#f2f2f2;--soft:#c4c4c4;--strong:#fff}
@media (prefers-color-scheme:light){:root{--page:#cfcfcf;--panel:#dedede;--line:#a0a0a0;--text:#1c1c1c;--soft:#474747;--strong:#000}}
@media print{:root{--page:#fff;--panel:#fff;--line:#999;--text:#000;--soft:#333;--strong:#000}section.photograph{break-inside:avoid}}
*{box-sizing:border-box}
body{margin:0;background:var(--page);color:var(--text);font:15px/1.5 system-ui,"Segoe UI","DejaVu Sans",Arial,sans-serif}
main{max-width:1500px;margin:0 auto;padding:24px}
h1{font-size:1.7em;margin:0;color:var(--strong)}
h2{font-size:1.25em;margin:2em 0 .5em;color:var(--strong)}
h3{font-size:1.05em;margin:0 0 .3em;color:var(--strong)}
p{max-width:95ch;margin:.4em 0}
.soft{color:var(--soft)}
.tiles{display:grid;grid-template-columns:repeat(auto-fill,minmax(185px,1fr));gap:10px;margin:18px 0}
.tile{background:var(--panel);border-radius:6px;padding:10px 14px}
.tile b{display:block;font-size:1.18em;font-weight:600;color:var(--strong);font-variant-numeric:tabular-nums}
.tile span{color:var(--soft);font-size:.9em}
.scroll{overflow-x:auto}
table{border-collapse:collapse;font-variant-numeric:tabular-nums;margin:.5em 0}
th,td{padding:3px 14px 3px 0;text-align:right;border-bottom:1px solid var(--line);vertical-align:top}
th{color:var(--soft);font-weight:600}
th.word,td.word{text-align:left}
td.long{min-width:20em;max-width:48em}
section.photograph{background:var(--panel);border-radius:6px;padding:14px 16px;margin:14px 0}
.pictures{display:grid;grid-template-columns:repeat(auto-fill,minmax(min(100%,400px),1fr));gap:14px;margin-top:10px}
.pictures.small{grid-template-columns:repeat(auto-fill,minmax(min(100%,240px),1fr))}
figure{margin:0}
figure img{display:block;width:100%;height:auto;background:#464646;image-rendering:auto}
figure.small-source img{image-rendering:pixelated}
figcaption{font-size:.88em;color:var(--soft);margin-top:4px}
figcaption b{color:var(--text);font-weight:600}
.bar{display:flex;align-items:center;gap:6px;margin-top:3px}
.bar i{flex:1;height:9px;border:1px solid #777}
dl{max-width:115ch;display:grid;grid-template-columns:max-content 1fr;gap:4px 18px;margin:.5em 0}
dt{font-weight:600}
dd{margin:0;color:var(--soft)}
details{background:var(--panel);border-radius:6px;padding:8px 14px;margin:10px 0}
summary{cursor:pointer}
pre{overflow:auto;max-height:70vh;font-size:12px;line-height:1.35}
)";

std::string percent(double share, int digits = 3) { return std::isfinite(share) ? format_number(100 * share, digits) + "\u00a0%" : "–"; }
std::string number(double v, int digits = 4) { return std::isnan(v) ? "–" : std::isinf(v) ? "identical" : format_number(v, digits); }
std::string with_sd(double v, double sd) { return std::isfinite(v) ? number(v) + (sd > 0 ? "\u00a0±\u00a0" + format_number(sd, 2) : "") : "–"; }
/// With spaces that do not break.
std::string counted(std::uint64_t n) {
  std::string out;
  for (const char c : format_count(n)) c == ' ' ? out += "\u00a0" : out += c;
  return out;
}
std::string interval(double a, double b) { return std::isfinite(a) && std::isfinite(b) ? number(a) + " … " + number(b) : "–"; }

/// Builds the page: every text goes through text(), everything else is written here.
class Page {
 public:
  Page& raw(std::string_view html) {
    out_ += html;
    return *this;
  }
  Page& text(std::string_view words) { return raw(html_escape(words)); }
  Page& element(std::string_view tag, std::string_view words, std::string_view attributes = "") {
    open(tag, attributes).text(words);
    return close(tag);
  }
  Page& open(std::string_view tag, std::string_view attributes = "") {
    raw("<").raw(tag);
    if (!attributes.empty()) raw(" ").raw(attributes);
    return raw(">");
  }
  Page& close(std::string_view tag) { return raw("</").raw(tag).raw(">\n"); }
  std::string take() { return std::move(out_); }

 private:
  std::string out_;
};

/// Cells that are words are named by `words`: 'w' word, 'l' long word, anything else a number.
void table(Page& page, const std::vector<std::string>& headers, std::string_view words, const std::vector<std::vector<std::string>>& rows) {
  const auto style = [&](std::size_t i) -> std::string_view {
    const char kind = i < words.size() ? words[i] : 'n';
    return kind == 'w' ? "class=\"word\"" : kind == 'l' ? "class=\"word long\"" : "";
  };
  page.open("div", "class=\"scroll\"").open("table").open("thead").open("tr");
  for (std::size_t i = 0; i < headers.size(); ++i) page.element("th", headers[i], style(i));
  page.close("tr").close("thead").open("tbody");
  for (const auto& row : rows) {
    page.open("tr");
    for (std::size_t i = 0; i < row.size(); ++i) page.element("td", row[i], style(i));
    page.close("tr");
  }
  page.close("tbody").close("table").close("div");
}

/// Background of a colour bar.
std::string gradient(bool grey) {
  if (grey) return "linear-gradient(90deg,#000,#fff)";
  std::string css = "linear-gradient(90deg";
  for (int i = 0; i <= 32; ++i) {
    const Rgb8 c = cubehelix(i / 32.0);
    css += concat(",rgb(", int{c[0]}, ',', int{c[1]}, ',', int{c[2]}, ')');
  }
  return css + ")";
}

// Top ------------------------------------------------------------------------------------------------------------------------------

void tile(Page& page, const std::string& value, const std::string& words) {
  page.open("div", "class=\"tile\"").element("b", value).element("span", words).close("div");
}

double median(std::vector<double> v) {
  std::erase_if(v, [](double x) { return std::isnan(x); });
  if (v.empty()) return NAN;
  std::sort(v.begin(), v.end());
  return v.size() % 2 ? v[v.size() / 2] : (v[v.size() / 2 - 1] + v[v.size() / 2]) / 2;
}

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

void tiles(Page& page, const ReportData& d) {
  const char* what = d.solved_lights ? "albedo" : "colour";
  page.open("div", "class=\"tiles\"");
  tile(page, counted(d.count("points_in")), "points read");
  tile(page, counted(d.count("points_out")), "points exported");
  if (const std::uint64_t n = d.count("points_inserted")) tile(page, counted(n), "points inserted between them");
  tile(page, percent(d.coverage()), concat("of the points were seen and have ", d.solved_lights ? "an albedo" : "a colour"));
  tile(page, counted(d.count("points_unseen")), "points no photograph saw well");
  tile(page, concat(d.photographs.size(), " of ", d.photographs.size() + d.photographs_left_out()), "photographs used");
  if (d.solved_lights && d.found.size() == 1) {
    tile(page, with_sd(d.found[0].flash, d.found[0].flash_sd), "flash, W/sr");
    tile(page, with_sd(d.found[0].ambient, d.found[0].ambient_sd), "ambient radiance");
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
  page.element("title", concat(name, ": chiaro report")).open("style").raw(kStyle).raw(concat(".helix{background:", gradient(false), "}\n.grey{background:", gradient(true), "}\n")).close("style").close("head").open("body").open("main");
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

double share(std::uint64_t part, std::uint64_t whole) { return whole > 0 ? static_cast<double>(part) / static_cast<double>(whole) : NAN; }

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

void how_to_read(Page& page, const ReportData& d) {
  page.element("h2", "How to read the pictures").open("dl");
  const auto say = [&](const char* name, const std::string& words) { page.element("dt", name).element("dd", words); };
  say("Photograph", "The input, linear values encoded as sRGB. All photographs have the same exposure, so that they can be compared; the brightest parts of the ones taken from nearest may be clipped to white.");
  say("Prediction", d.solved_lights ? "The final surface colour of all photographs together, lit again by the lights that were found, at the same exposure. It should look like the photograph."
                                    : "The blended colour of all photographs as seen from here, at the same exposure. It should look like the photograph.");
  if (d.solved_lights) {
    say("Albedo", "The colour of the surface itself, from this photograph alone: flash falloff, shading, ambient light and light from neighbouring surfaces are taken off. White is a surface that "
                  "reflects everything. Good albedo looks flat: shadows and bright spots that remain are errors, painted and stained parts are not.");
  } else {
    say("Colour", "The colour that this photograph contributes, at the same exposure.");
  }
  say("Difference", concat("How far prediction and photograph are apart, as a share of white. Black is no difference. Where structure of the surface shows, registration or geometry is off; where "
                           "smooth gradients show, ", d.solved_lights ? "the lights are." : "the photographs were lit differently."));
  say("Uncertainty", concat("Standard deviation of the ", d.solved_lights ? "albedo" : "colour", " relative to its value, from noise", d.solved_lights ? ", lights, normals and bounces together" : "",
                            ". Bright parts are better photographed again."));
  if (d.solved_lights)
    say("Direct, indirect, ambient", "Which share of the light at each place came straight from the flash, from the flash by way of other surfaces, and from the surroundings. The three add up to "
                                     "100 %. Each has its own scale, written below it.");
  say("Coverage", concat("Grey: how much of each pixel the cloud covers; brighter is more. Orange: within ", number(d.scales.edge_px), " pixels of an edge in depth, where a photograph counts less."));
  if (d.weights)
    say("What its pixels count in the blend", concat("One picture for each criterion, all on one scale from 0 to 100 %; bright is good, black pixels are not used. Resolution and the weight, which is the product of all, are "
                                                     "ratios w, drawn as w / (1 + w): half of the scale is a pixel of the typical size (", number(static_cast<double>(d.weights->reference_footprint)),
                                                     " units of the project on the surface) against which nothing speaks. Only ratios between photographs of a point matter. Focus counts where the ",
                                                     "project says what the lens was set to (acquisition.focus)."));
  say("Chequered grey", "No value: outside the mask, not on the cloud, saturated, or too dark to tell; in the prediction also where no photograph sees the surface well enough.");
  page.close("dl");
}

struct Caption {
  std::string title, words;
  double range = 0;   ///< end of the scale; 0 = no bar
  bool grey = false;
};

Caption caption_of(const std::string& kind, const ReportData& d, const PhotoMeasures& m) {
  if (kind == "photograph") return {"Photograph", "input"};
  if (kind == "prediction") return {"Prediction", concat("PSNR ", number(m.psnr_srgb), " dB, SSIM ", number(m.ssim))};
  if (kind == "albedo") return d.solved_lights ? Caption{"Albedo", "of this photograph alone"} : Caption{"Colour", "of this photograph alone"};
  if (kind == "difference") return {"Difference", concat("|photograph − prediction| over white; rms ", percent(m.residual_rms)), d.scales.difference};
  if (kind == "sigma") return {"Uncertainty", concat("relative standard deviation; median ", percent(m.median_sigma)), d.scales.sigma};
  if (kind == "direct") return {"Direct light", concat("straight from the flash; mean ", percent(m.shares[0])), 1, true};
  if (kind == "indirect") return {"Indirect light", concat("flash by way of other surfaces; mean ", percent(m.shares[1])), d.scales.indirect, true};
  if (kind == "ambient") return {"Ambient light", concat("from the surroundings; mean ", percent(m.shares[2])), d.scales.ambient, true};
  return {"Coverage and edges", concat(percent(share(m.on_cloud, m.usable)), " of the usable pixels meet the cloud")};
}

Caption caption_of_weight(const std::string& name) {
  for (const blend::Criterion& c : blend::kCriteria)
    if (c.name == name) return {name, concat("bright: ", c.bright), 1};
  return {name, "all of them multiplied; bright: counts much", 1};
}

void figure(Page& page, const ReportPicture& picture, const ReportedPhotograph& p, const Caption& caption) {
  page.open("figure", picture.width < 160 ? "class=\"small-source\"" : "");
  page.raw(concat("<img width=\"", picture.width, "\" height=\"", picture.height, "\" alt=\"")).text(concat(caption.title, ", ", p.key)).raw("\" src=\"data:image/png;base64,");
  page.raw(base64(picture.png)).raw("\">\n");
  page.open("figcaption").element("b", caption.title).text(caption.words);
  if (caption.range > 0)
    page.open("span", "class=\"bar\"").element("span", "0").open("i", caption.grey ? "class=\"grey\"" : "class=\"helix\"").close("i").element("span", percent(caption.range)).close("span");
  page.close("figcaption").close("figure");
}

void pictures(Page& page, const ReportData& d) {
  page.element("h2", "Photographs");
  if (d.shown > 0 && d.shown < d.photographs.size())
    page.element("p", concat("Pictures of ", d.shown, " of ", d.photographs.size(), " photographs: half of them evenly through the set, half those that are predicted worst. The others have their numbers above."));
  for (const ReportedPhotograph& p : d.photographs) {
    if (p.pictures.empty()) continue;
    page.open("section", "class=\"photograph\"").element("h3", p.key);
    page.element("p",
                 concat(p.file, ", ", p.width, " × ", p.height, " pixels, acquisition ", p.acquisition, ". ", counted(p.measures.usable), " pixels usable, ", counted(p.measures.solved),
                        " solved, ", counted(p.measures.predicted), " predicted."),
                 "class=\"soft\"");
    page.open("div", "class=\"pictures\"");
    for (const ReportPicture& picture : p.pictures) figure(page, picture, p, caption_of(picture.kind, d, p.measures));
    page.close("div");
    if (!p.weights.empty()) {
      page.open("details").element("summary", "What its pixels count in the blend").open("div", "class=\"pictures small\"");
      for (const ReportPicture& picture : p.weights) figure(page, picture, p, caption_of_weight(picture.kind));
      page.close("div").close("details");
    }
    page.close("section");
  }
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

std::string html_escape(std::string_view text) {
  // The JSON writer knows how to replace broken UTF-8; what it returns is a quoted literal, read back as text.
  const std::string whole = Json::parse(Json(std::string(text)).dump(-1, ' ', false, Json::error_handler_t::replace)).get<std::string>();
  std::string out;
  for (const char c : whole) {
    switch (c) {
      case '&': out += "&amp;"; break;
      case '<': out += "&lt;"; break;
      case '>': out += "&gt;"; break;
      case '"': out += "&quot;"; break;
      case '\'': out += "&#39;"; break;
      default: out += (static_cast<unsigned char>(c) < 32 && c != '\n' && c != '\t') || c == 127 ? ' ' : c;
    }
  }
  return out;
}

std::string method_in_words(const std::string& method) {
  if (method == "joint") return "The lights were solved over all photographs of an acquisition together, then the albedo of each photograph, then all were blended.";
  if (method == "single") return "The lights were solved for each photograph by itself, then its albedo, then all were blended.";
  if (method == "adam") return "Lights and albedo of each photograph were found by gradient descent (Adam), then all were blended.";
  if (method == "direct") return "Only the direct light of the flash was taken off: no ambient light, no bounces. This is the standard pipeline, for comparison.";
  if (method == "none") return "The photographs were taken as the colour itself and blended; no light was taken off.";
  return "";
}

std::string report_html(const ReportData& d) {
  Page page;
  head(page, d);
  lights(page, d);
  left_out(page, d);
  numbers(page, d);
  agreement(page, d);
  layers(page, d);
  how_to_read(page, d);
  pictures(page, d);
  times(page, d);
  page.element("h2", "Record");
  folded(page, "lights.json: lights with their covariance", d.lights);
  folded(page, "run.json: options, inputs with hashes, versions, timings, counts", d.record);
  folded(page, "project.json: the project with all defaults", d.project);
  page.close("main").close("body").raw("</html>\n");
  return page.take();
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
                             {"calibrated", {json_or_null(l.calibrated_min), json_or_null(l.calibrated_max)}}, {"absolute_scale", l.scale}});
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
