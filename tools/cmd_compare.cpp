/// chiaro compare A B: two pictures, or two sets of coloured points.
#include <cmath>
#include <nlohmann/json.hpp>
#include <ostream>

#include "stream/base/error.h"
#include "stream/base/parallel.h"
#include "stream/base/text.h"
#include "tools/args.h"
#include "tools/colour_source.h"
#include "tools/commands.h"
#include "tools/compare_images.h"
#include "tools/compare_points.h"
#include "tools/table.h"

namespace chiaro::tools {
namespace {
using Json = nlohmann::ordered_json;

struct Words {
  std::string a, b, mask, out, picture;
  bool srgb = false, as_stored = false, clip = false;
  double peak = 1;
  int threads = 0;
};

/// NaN and infinity have no JSON number: null.
Json number(double value) { return std::isfinite(value) ? Json(value) : Json(nullptr); }

Json json_of(const Distribution& d) { return {{"mean", number(d.mean)}, {"median", number(d.median)}, {"p95", number(d.p95)}, {"max", number(d.max)}}; }

void print_images(const Words& words, const ImageComparison& r, Console& console) {
  if (console.json) {
    Json out{{"kind", "images"}, {"a", words.a}, {"b", words.b}, {"width", r.width}, {"height", r.height}, {"pixels", r.pixels}, {"not_finite", r.not_finite},
             {"values", words.srgb ? "srgb" : "linear"}, {"clipped", words.clip}, {"psnr", number(r.psnr)}, {"identical", r.mse == 0}, {"ssim", number(r.ssim)}, {"ssim_rgb", number(r.ssim_rgb)},
             {"flip", number(r.flip)}, {"mse", number(r.mse)}, {"relative_error", number(r.relative_error)}, {"delta_e", number(r.delta_e)}, {"notes", r.notes}};
    return console.result(out.dump(-1, ' ', false, Json::error_handler_t::replace));
  }
  for (const std::string& note : r.notes) console.report().note(note);
  Table table({"", "", ""}, {Table::Align::kLeft, Table::Align::kRight, Table::Align::kLeft});
  table.row({"psnr", format_number(r.psnr, 5), concat("dB, peak ", words.peak, words.srgb ? ", sRGB values" : ", linear values", words.clip ? ", clipped" : "")});
  table.row({"ssim", format_number(r.ssim, 5), "luminance"});
  table.row({"ssim_rgb", format_number(r.ssim_rgb, 5), "mean of the channels"});
  table.row({"flip", format_number(r.flip, 5), "0 alike .. 1, 67 pixels per degree"});
  table.row({"mse", format_number(r.mse, 5)});
  table.row({"relative_error", format_number(r.relative_error, 5), "mean of |A - B| / B"});
  table.row({"delta_e", format_number(r.delta_e, 5), "mean CIEDE2000"});
  table.row({"pixels", format_count(r.pixels), concat("of ", r.width, " x ", r.height)});
  if (r.not_finite) table.row({"not finite", format_count(r.not_finite), "pixels that are NaN or infinite: no measure is valid"});
  console.out() << table.text();
}

void print_points(const Words& words, const PointComparison& r, Console& console) {
  if (console.json) {
    Json out{{"kind", "points"}, {"a", words.a}, {"b", words.b}, {"values", r.compared_values}, {"points", r.points}, {"compared", r.compared}, {"unseen_a", r.unseen_a},
             {"unseen_b", r.unseen_b}, {"elsewhere", r.elsewhere}, {"difference", json_of(r.difference)}, {"relative", json_of(r.relative)}, {"relative_error", number(r.relative.mean)}, {"rms", number(r.rms)},
             {"bias", number(r.bias)}, {"scale", number(r.scale)}, {"relative_scaled", json_of(r.relative_scaled)}, {"delta_e", number(r.delta_e)}};
    if (!words.picture.empty()) out["picture"] = {{"file", words.picture}, {"range", number(r.picture_range)}};
    return console.result(out.dump(-1, ' ', false, Json::error_handler_t::replace));
  }
  Table table({r.compared_values, "mean", "median", "p95", "max"});
  const auto row = [&](const char* name, const Distribution& d) { table.row({name, format_number(d.mean), format_number(d.median), format_number(d.p95), format_number(d.max)}); };
  row("difference |A - B|", r.difference);
  row("relative |A - B| / B", r.relative);
  row("relative, A scaled", r.relative_scaled);
  console.out() << table.text() << '\n';
  Table more({"", "", ""}, {Table::Align::kLeft, Table::Align::kRight, Table::Align::kLeft});
  more.row({"rms", format_number(r.rms)});
  more.row({"bias", format_number(r.bias), "mean of A - B"});
  more.row({"scale", format_number(r.scale, 5), "factor on A that fits B best"});
  more.row({"delta_e", format_number(r.delta_e), "mean CIEDE2000"});
  more.row({"points", format_count(r.compared), concat("of ", format_count(r.points), "; unseen in A ", format_count(r.unseen_a), ", in B ", format_count(r.unseen_b))});
  if (!words.picture.empty()) more.row({"picture", words.picture, concat("full colour at relative differences of ", format_number(r.picture_range))});
  console.out() << more.text();
  if (r.elsewhere)
    console.report().note(concat(format_count(r.elsewhere), " of ", format_count(r.points), " points do not lie in the same place in A and B. Points match by their order: if one file was sorted, cropped or thinned, "
                                 "these numbers compare different points"));
}

}  // namespace

int run_compare(std::span<const std::string> args, Console& console) {
  Words words;
  Args parser("compare",
              "How alike two pictures are (EXR, PNG, TIFF, JPEG), or the colours of two clouds of the same points:\n"
              "point files that ingest reads, layers of stores (DIR:LAYER), or .npy arrays of linear albedos. B is the reference.\n"
              "8-bit pictures and PNG are taken as sRGB and linearised; all else is linear.");
  parser.positional("A", words.a, "what is measured");
  parser.positional("B", words.b, "the reference");
  parser.option("--mask", words.mask, "pictures: white = use", "FILE");
  parser.flag("--srgb", words.srgb, "pictures: psnr, ssim, mse and relative error on sRGB-encoded values instead of linear ones");
  parser.flag("--as-stored", words.as_stored, "pictures: take 8-bit files and PNG as linear");
  parser.option("--peak", words.peak, "pictures: the value of white, for psnr", "VALUE", 1e-6, 1e9);
  parser.flag("--clip", words.clip, "pictures: values below 0 and above white count as 0 and as white");
  parser.option("--out", words.out, "points: write the difference of each point to this .ply, .las or .pcd", "FILE");
  parser.option("--picture", words.picture, "points: draw the differences on the cloud, from six sides; blue: A darker, red: A brighter", "FILE.png");
  parser.option("--threads", words.threads, "threads; 0 = all cores", "N", 0, 4096);
  parser.common(console);
  if (!parser.parse(args, console)) return 0;
  const ThreadLimit limit(words.threads);

  const bool points = names_points(words.a);
  if (points != names_points(words.b)) throw UsageError(concat("chiaro compare: ", words.a, " and ", words.b, ": one is a picture, the other a set of points"));
  if (points) {
    if (!words.picture.empty() && lower_extension(words.picture) != ".png") throw UsageError(concat("chiaro compare: --picture ", words.picture, ": expected FILE.png"));
    for (const char* flag : {"--mask", "--srgb", "--as-stored", "--peak", "--clip"})
      if (parser.count(flag)) throw UsageError(concat("chiaro compare: ", flag, " is for pictures"));
    // JSON output is one line: programs read it as a whole.
    print_points(words, compare_points(words.a, words.b, words.out, console.json ? silent_reporter() : console.report(), words.picture), console);
    return 0;
  }
  if (!words.out.empty()) throw UsageError("chiaro compare: --out is for points");
  if (!words.picture.empty()) throw UsageError("chiaro compare: --picture is for points");
  CompareImagesOptions options;
  options.mask = words.mask;
  options.srgb = words.srgb;
  options.as_stored = words.as_stored;
  options.peak = words.peak;
  options.clip = words.clip;
  print_images(words, compare_images(words.a, words.b, options), console);
  return 0;
}

}  // namespace chiaro::tools
