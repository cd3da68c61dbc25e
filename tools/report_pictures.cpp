#include "tools/report_pictures.h"

#include "stream/base/error.h"
#include "tools/report_palette.h"

namespace chiaro::tools {
namespace {

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

}  // namespace

void how_to_read_pictures(Page& page, const ReportData& d) {
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

void photograph_pictures(Page& page, const ReportData& d) {
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

}  // namespace chiaro::tools
