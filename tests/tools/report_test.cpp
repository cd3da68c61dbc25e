#include "tools/report.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <set>

#include "run_fixture.h"
#include "stream/base/error.h"
#include "tools/metrics.h"
#include "tools/report_palette.h"
#include "tools/report_photo.h"
#include "tools/report_weights.h"
#include "tools/table.h"

namespace chiaro::tools {
namespace {
using testing::HasSubstr;
using testing::Not;
using Json = nlohmann::ordered_json;

std::string page_of(const RunFixture& run) { return read_text(run.folder.report() / "index.html"); }
Json numbers_of(const RunFixture& run) { return Json::parse(read_text(run.folder.report() / "report.json")); }

std::size_t count_of(const std::string& text, const std::string& what) {
  std::size_t n = 0;
  for (std::size_t at = text.find(what); at != std::string::npos; at = text.find(what, at + what.size())) ++n;
  return n;
}

/// "" if every element is closed in order and every attribute is quoted; otherwise what is wrong.
std::string fault_of_html(const std::string& page) {
  static const std::set<std::string> kVoid{"meta", "img", "br"};
  std::vector<std::string> open;
  std::size_t at = page.find("<html");
  while ((at = page.find('<', at)) != std::string::npos) {
    const bool closes = page[at + 1] == '/';
    std::size_t i = at + 1 + closes;
    std::string name;
    while (i < page.size() && std::isalnum(static_cast<unsigned char>(page[i]))) name += page[i++];
    if (name.empty()) return "a bare <";
    for (bool quoted = false; i < page.size() && (quoted || page[i] != '>'); ++i) {
      if (page[i] == '"') quoted = !quoted;
      if (page[i] == '<') return "< inside the tag " + name;
    }
    if (i >= page.size()) return "unfinished tag " + name;
    if (!closes && !kVoid.contains(name)) open.push_back(name);
    if (closes) {
      if (open.empty() || open.back() != name) return "</" + name + "> closes " + (open.empty() ? "nothing" : open.back());
      open.pop_back();
    }
    at = name == "style" && !closes ? page.find("</style", i) : i;
  }
  return open.empty() ? "" : open.back() + " stays open";
}

// Photographs without flash, or of a second shutter time, have no calibration of their own: it is that of the acquisition whose lights they share.
TEST(Report, AcquisitionsThatShareLightsHaveOneScale) {
  RunFixture run;
  run.write();
  Json lights = run.lights();
  Json second{{"acquisition", "second"}, {"method", "joint"}, {"lights_of", "day1"}, {"how", "by hand"}, {"references", 0}};
  second.update(run.light(31.25));
  lights["acquisitions"].push_back(second);
  lights["acquisitions"].push_back({{"acquisition", "dark"}, {"method", "joint"}, {"lights_of", "day1"}, {"how", "taken without flash"}});
  write_text(run.folder.lights(), lights.dump());
  write_report(run.folder, silent_reporter());
  Json numbers = numbers_of(run);
  ASSERT_EQ(numbers["headline"]["absolute_scale"].size(), 1u) << numbers["headline"]["absolute_scale"];
  EXPECT_EQ(numbers["headline"]["absolute_scale"][0].get<std::string>().find("The absolute scale comes from the calibrated flash range, 25 to 34 W/sr"), 0u) << numbers["headline"];
  ASSERT_EQ(numbers["lights"].size(), 3u);
  EXPECT_EQ(numbers["lights"][1]["calibrated"], Json::array({25.0, 34.0}));
  EXPECT_TRUE(numbers["lights"][2]["absolute_scale"].is_null());

  lights["acquisitions"][1]["references"] = 1;
  write_text(run.folder.lights(), lights.dump());
  write_report(run.folder, silent_reporter());
  numbers = numbers_of(run);
  ASSERT_EQ(numbers["headline"]["absolute_scale"].size(), 1u) << numbers["headline"]["absolute_scale"];
  EXPECT_EQ(numbers["headline"]["absolute_scale"][0], "The absolute scale comes from a reference target of known albedo, together with the calibrated flash range.");
}

TEST(CubeHelix, RunsFromBlackToWhiteThroughGreensTeal) {
  EXPECT_EQ(cubehelix(0), (Rgb8{0, 0, 0}));
  EXPECT_EQ(cubehelix(1), (Rgb8{255, 255, 255}));
  // By hand for x = 1/2: phi = 2 pi (1/6 - 3/4) = -7 pi / 6, cos = -.8660254, sin = .5, a = 1/8.
  // R = .5 + .125 (.14861 * .8660254 + 1.78277 * .5) = .627511, G = .5 + .125 (.29227 * .8660254 - .90649 * .5) = .474983, B = .5 - .125 * 1.97294 * .8660254 = .286424.
  EXPECT_EQ(cubehelix(0.5), (Rgb8{160, 121, 73}));
  EXPECT_EQ(cubehelix(-3), cubehelix(0));
  EXPECT_EQ(cubehelix(7), cubehelix(1));
  EXPECT_EQ(cubehelix(NAN), cubehelix(0));
}

TEST(CubeHelix, GrowsLighterAllTheWay) {
  double before = -1;
  for (int i = 0; i <= 64; ++i) {
    const Rgb8 c = cubehelix(i / 64.0);
    const double lightness = 0.30 * c[0] + 0.59 * c[1] + 0.11 * c[2];   // the weights that the colour scheme is built on
    EXPECT_GT(lightness, before) << i;
    before = lightness;
  }
}

TEST(ReportPalette, ScalesEndAtRoundNumbers) {
  EXPECT_EQ(round_range(0.013), 0.02);
  EXPECT_EQ(round_range(0.05), 0.05);
  EXPECT_EQ(round_range(0.051), 0.1);
  EXPECT_EQ(round_range(3), 5);
  EXPECT_EQ(round_range(0), 1);
  EXPECT_EQ(round_range(NAN), 1);
}

TEST(ReportPalette, Base64IsThatOfTheRfc) {
  EXPECT_EQ(base64(""), "");
  EXPECT_EQ(base64("f"), "Zg==");
  EXPECT_EQ(base64("fo"), "Zm8=");
  EXPECT_EQ(base64("foobar"), "Zm9vYmFy");
  EXPECT_EQ(base64("\xff\xfe\xfd"), "//79");
}

TEST(ReportPalette, PngsReadBackAsTheyWereWritten) {
  const ScratchFolder scratch;
  const std::vector<Rgb8> pixels{{1, 2, 3}, {250, 128, 0}, {0, 0, 255}, {9, 8, 7}, {255, 255, 255}, {0, 0, 0}};
  write_text(scratch.path() / "rgb.png", png_rgb(3, 2, pixels));
  write_text(scratch.path() / "indexed.png", png_indexed(2, 1, std::vector<std::uint8_t>{1, 0}, std::vector<Rgb8>{{10, 20, 30}, {40, 50, 60}}));
  const stream::Image rgb = stream::read_image(scratch.path() / "rgb.png"), indexed = stream::read_image(scratch.path() / "indexed.png");
  ASSERT_EQ(rgb.width, 3);
  ASSERT_EQ(rgb.channels, 3);
  for (int i = 0; i < 6; ++i)
    for (int c = 0; c < 3; ++c) EXPECT_NEAR(rgb.at(i % 3, i / 3, c) * 255, pixels[static_cast<std::size_t>(i)][static_cast<std::size_t>(c)], 1e-3);
  EXPECT_NEAR(indexed.at(0, 0, 2) * 255, 60, 1e-3);
  EXPECT_NEAR(indexed.at(1, 0, 0) * 255, 10, 1e-3);
}

TEST(LogHistogram, GivesQuantilesWithinHalfAPerCent) {
  LogHistogram h;
  EXPECT_TRUE(std::isnan(h.quantile(0.5)));
  for (int i = 1; i <= 1000; ++i) h.add(i * 1e-3);
  EXPECT_NEAR(h.quantile(0.5), 0.5, 0.005 * 0.5);
  EXPECT_NEAR(h.quantile(0.99), 0.99, 0.005 * 0.99);
  for (int i = 0; i < 3000; ++i) h.add(i % 2 ? 0 : -5);
  EXPECT_EQ(h.quantile(0.5), 0);
  h.add(NAN);
  h.add(INFINITY);
}

TEST(Report, HoldsTheNumbersOfTheRun) {
  RunFixture run;
  run.write();
  const ReportResult result = write_report(run.folder, silent_reporter());
  EXPECT_EQ(result.photographs, 2u);
  const Json j = numbers_of(run);
  EXPECT_EQ(j["headline"]["points_in"], 123456);
  EXPECT_EQ(j["headline"]["points_unseen"], 23450);
  EXPECT_NEAR(j["headline"]["coverage"].get<double>(), 100000.0 / 123450, 1e-9);
  EXPECT_EQ(j["headline"]["photographs_used"], 2);
  EXPECT_EQ(j["headline"]["photographs_left_out"], 1);
  ASSERT_EQ(j["photographs"].size(), 2u);
  const Json& p = j["photographs"][0];
  EXPECT_EQ(p["pixels"], 1200);
  EXPECT_EQ(p["pixels_usable"], 39 * 30);
  EXPECT_EQ(p["pixels_solved"], 30 * 30);
  EXPECT_EQ(p["pixels_predicted"], 30 * 30);
  // Radiance 0.5 everywhere: white is 0.5 within the bins of the histogram, and a residual of 0.05 is a tenth of it: 20 dB.
  EXPECT_NEAR(j["scales"]["white_radiance"].get<double>(), 0.5, 0.005 * 0.5);
  EXPECT_NEAR(p["psnr_linear"].get<double>(), 20, 0.05);
  // sRGB of 1 is 1, of 0.9 it is 1.055 * 0.9^(1/2.4) - 0.055 = 0.954687: 26.87 dB.
  EXPECT_NEAR(p["psnr_srgb"].get<double>(), 26.87, 0.06);
  EXPECT_NEAR(p["residual_relative"].get<double>(), 0.1, 1e-4);
  EXPECT_NEAR(p["median_sigma"].get<double>(), 0.02, 0.0002);
  EXPECT_NEAR(p["shares"]["indirect"].get<double>(), 0.2, 1e-3);
  EXPECT_EQ(j["scales"]["indirect"], 0.2);
  EXPECT_EQ(j["scales"]["difference"], 0.1);
  EXPECT_EQ(j["scales"]["sigma"], 0.02);
  EXPECT_EQ(j["lights"][0]["flash_intensity"], 31.25);
}

TEST(Report, SaysThatTheLastRunDidNotEnd) {
  RunFixture run;
  run.write();
  write_report(run.folder, silent_reporter());
  EXPECT_THAT(page_of(run), Not(HasSubstr("did not come to its end")));
  write_text(run.folder.progress(), "=ingest\n+develop/photo_00\n");
  write_report(run.folder, silent_reporter());
  EXPECT_THAT(page_of(run), HasSubstr("the last run in this folder did not come to its end"));
}

TEST(Report, IsOneWellFormedPageThatNeedsNothingFromElsewhere) {
  RunFixture run;
  run.write();
  write_report(run.folder, silent_reporter());
  const std::string page = page_of(run);
  EXPECT_EQ(fault_of_html(page), "");
  EXPECT_TRUE(page.starts_with("<!DOCTYPE html>"));
  EXPECT_THAT(page, Not(HasSubstr("http")));
  EXPECT_THAT(page, Not(HasSubstr("<script")));
  EXPECT_THAT(page, Not(HasSubstr("<link")));
  EXPECT_THAT(page, Not(HasSubstr("url(")));
  EXPECT_EQ(count_of(page, "src="), count_of(page, "src=\"data:image/png;base64,"));
  EXPECT_EQ(count_of(page, "<img "), 2u * 9u);
}

TEST(Report, SaysWhatAReaderLooksFor) {
  RunFixture run;
  run.write();
  write_report(run.folder, silent_reporter());
  const std::string page = page_of(run);
  for (const char* words : {"123\u00a0456", "23\u00a0450", "81\u00a0%", "31.25\u00a0±\u00a00.75", "29.75 … 32.75", "25 … 34", "2 of 3", "no camera in &lt;sparse&gt;", "a note &amp; its end", "by hand", "300.00 MiB",
                            "made &lt;by&gt; &quot;hand&quot; &amp; more", "calibrated flash range, 25 to 34 W/sr"})
    EXPECT_THAT(page, HasSubstr(words));
  EXPECT_THAT(page, Not(HasSubstr("<by>")));
}

TEST(Report, SaysHowThePhotographsAgree) {
  RunFixture run;
  run.write();
  write_report(run.folder, silent_reporter());
  EXPECT_THAT(page_of(run), Not(HasSubstr("How the photographs agree")));   // a run of before it was recorded
  Json record = Json::parse(read_text(run.folder.record()));
  record["blending"] = {{"scatter", 0.0125},
                        {"photographs",
                         {{{"photograph", "photo_00"}, {"samples", 900}, {"rejected", 100}, {"gain", {0.8, 0.8, 0.8}}, {"shift_px", {-1.5, 2}},
                           {"disturbed", {{"x0", 12}, {"x1", 48}, {"y0", 24}, {"y1", 60}}}},
                          {{"photograph", "photo<01>"}, {"samples", 0}, {"rejected", 0}, {"gain", "?"}, {"shift_px", nullptr}, {"disturbed", nullptr}}}}};
  write_text(run.folder.record(), record.dump());
  write_report(run.folder, silent_reporter());
  const std::string page = page_of(run);
  EXPECT_EQ(fault_of_html(page), "");
  for (const char* words : {"How the photographs agree", "1.25", "2.5", "10\u00a0%", "pixels 12–48 across, 24–60 down", "photo&lt;01&gt;"}) EXPECT_THAT(page, HasSubstr(words));
}

TEST(Report, ShowsALightForEachPhotographWhereEachWasSolvedByItself) {
  RunFixture run;
  run.method = "adam";
  run.write();
  write_report(run.folder, silent_reporter());
  const Json j = numbers_of(run);
  ASSERT_EQ(j["lights"].size(), 2u);
  EXPECT_EQ(j["lights"][1]["photograph"], "photo_01");
  EXPECT_EQ(j["lights"][1]["flash_intensity"], 31);
  EXPECT_EQ(fault_of_html(page_of(run)), "");
}

TEST(Report, DoesWithoutLightsWhereNoneWereSolved) {
  RunFixture run;
  run.method = "none";
  run.write();
  write_report(run.folder, silent_reporter());
  const std::string page = page_of(run);
  EXPECT_EQ(fault_of_html(page), "");
  EXPECT_EQ(count_of(page, "<img "), 2u * 6u);
  EXPECT_THAT(page, HasSubstr("No light was taken off"));
  EXPECT_THAT(page, Not(HasSubstr("W/sr")));
  EXPECT_TRUE(numbers_of(run)["lights"].empty());
}

TEST(Report, CountsOnlyPixelsThatHaveAPrediction) {
  RunFixture run;
  run.residual = [](int x, int, int) { return x < 20 ? 0.0f : 0.05f; };   // the blended result has nothing there
  run.write();
  write_report(run.folder, silent_reporter());
  const Json p = numbers_of(run)["photographs"][0];
  EXPECT_EQ(p["pixels_solved"], 30 * 30);
  EXPECT_EQ(p["pixels_predicted"], 20 * 30);
  EXPECT_NEAR(p["psnr_linear"].get<double>(), 20, 0.05);
}

TEST(Report, MeasuresInBandsWhatAWholePictureGives) {
  RunFixture run;
  run.keys = {"tall"};
  run.width = 64;
  run.height = 8300;   // more than one band
  run.photo = [](int x, int y, int c) { return 0.3f + 0.2f * std::sin(0.37f * static_cast<float>(x) + 0.11f * static_cast<float>(y) + static_cast<float>(c)); };
  // Far off where one band ends and the next begins, so that a row counted twice or not at all shows.
  run.residual = [](int x, int y, int) { return (std::abs(y - 8192) < 6 ? 0.3f : 0.02f) * std::cos(0.9f * static_cast<float>(x * y % 17)); };
  run.solved = [](int x, int y) { return x > 3 && (x * 7 + y) % 331 != 0; };
  run.write();
  constexpr double kWhite = 0.5;
  ReportPhoto photo(run.folder, "tall", true);
  PictureRanges ranges;
  const PhotoMeasures m = measure(photo, kWhite, ranges, silent_reporter());

  const std::size_t n = static_cast<std::size_t>(run.width) * static_cast<std::size_t>(run.height);
  std::vector<float> a(3 * n), b(3 * n), ya(n), yb(n);
  std::vector<std::uint8_t> mask(n);
  for (std::size_t i = 0; i < n; ++i) {
    const int x = static_cast<int>(i) % run.width, y = static_cast<int>(i) / run.width;
    mask[i] = run.solved(x, y);
    for (int c = 0; c < 3; ++c) {
      b[3 * i + c] = run.photo(x, y, c) / static_cast<float>(kWhite);
      a[3 * i + c] = (run.photo(x, y, c) - run.residual(x, y, c)) / static_cast<float>(kWhite);
    }
  }
  EXPECT_NEAR(m.psnr_linear, psnr({run.width, run.height, 3, a}, {run.width, run.height, 3, b}, mask), 1e-4);
  for (auto* v : {&a, &b})
    for (float& x : *v) x = static_cast<float>(stream::srgb_from_linear(x));
  for (std::size_t i = 0; i < n; ++i) {
    ya[i] = 0.2126f * a[3 * i] + 0.7152f * a[3 * i + 1] + 0.0722f * a[3 * i + 2];
    yb[i] = 0.2126f * b[3 * i] + 0.7152f * b[3 * i + 1] + 0.0722f * b[3 * i + 2];
  }
  EXPECT_NEAR(m.psnr_srgb, psnr({run.width, run.height, 3, a}, {run.width, run.height, 3, b}, mask), 1e-4);
  const double whole = ssim({run.width, run.height, 1, ya}, {run.width, run.height, 1, yb}, mask);
  ASSERT_GT(whole, 0.1);
  ASSERT_LT(whole, 0.9999);
  EXPECT_NEAR(m.ssim, whole, 1e-6);
}

TEST(Report, ShrinksPicturesWithoutTurningOrClippingThem) {
  RunFixture run;
  run.keys = {"corner"};
  run.width = 100;
  run.height = 60;
  run.photo = [](int x, int y, int c) { return c == 0 ? static_cast<float>(x) / 100 : c == 1 ? static_cast<float>(y) / 60 : 0.0f; };
  run.write();
  ReportPhoto photo(run.folder, "corner", true);
  const auto pictures = draw(photo, PictureScales{}, 30, silent_reporter());
  ASSERT_EQ(pictures.size(), 9u);
  for (const ReportPicture& p : pictures) {
    EXPECT_EQ(p.width, 25) << p.kind;
    EXPECT_EQ(p.height, 15) << p.kind;
  }
  write_text(run.scratch.path() / "p.png", pictures[0].png);
  const stream::Image shown = stream::read_image(run.scratch.path() / "p.png");
  EXPECT_NEAR(stream::linear_from_srgb(shown.at(24, 0, 0)), 0.975, 0.01);   // red grows to the right
  EXPECT_NEAR(stream::linear_from_srgb(shown.at(0, 0, 0)), 0.015, 0.01);
  EXPECT_NEAR(stream::linear_from_srgb(shown.at(0, 14, 1)), 0.975, 0.02);   // green grows downwards
  EXPECT_NEAR(stream::linear_from_srgb(shown.at(24, 0, 1)), 0.025, 0.02);
}

stream::Image read_png(const RunFixture& run, const ReportPicture& picture) {
  write_text(run.scratch.path() / "p.png", picture.png);
  return stream::read_image(run.scratch.path() / "p.png");
}

TEST(Report, ShowsWhatEachCriterionSaysOfThePixels) {
  RunFixture run;
  run.weighed = true;
  run.write();
  write_report(run.folder, silent_reporter());
  const std::string page = page_of(run);
  EXPECT_EQ(fault_of_html(page), "");
  EXPECT_EQ(count_of(page, "<img "), 2u * (9u + blend::kCriteria.size() + 1));
  for (const blend::Criterion& c : blend::kCriteria) {
    EXPECT_EQ(count_of(page, concat("<b>", c.name, "</b>\nbright: ", c.bright)), 2u) << c.name;
  }
  EXPECT_THAT(page, HasSubstr("Focus counts where the project says what the lens was set to"));
}

TEST(Report, DrawsWeightsWhereTheyBelong) {
  RunFixture run;
  run.weighed = true;
  run.write();
  const auto pictures = draw_weights(run.folder, run.camera("photo_00"), {.low_radius = 0.4f, .reference_footprint = 0.05f, .border_px = 12}, 20, silent_reporter());
  ASSERT_EQ(pictures.size(), blend::kCriteria.size() + 1);
  const auto find = [&](const std::string& name) {
    const auto found = std::find_if(pictures.begin(), pictures.end(), [&](const ReportPicture& p) { return p.kind == name; });
    EXPECT_NE(found, pictures.end()) << name;
    return read_png(run, *found);
  };
  const auto shows = [](const stream::Image& image, int x, int y, double value) {
    const Rgb8 colour = cubehelix(value);
    for (int c = 0; c < 3; ++c) EXPECT_NEAR(image.at(x, y, c) * 255, colour[static_cast<std::size_t>(c)], 3) << x << ' ' << y << ' ' << c;
  };
  const stream::Image resolution = find("Resolution"), mask = find("Mask"), weight = find(kWeightProduct), confidence = find("Confidence");
  ASSERT_EQ(resolution.width, 20);
  ASSERT_EQ(resolution.height, 15);
  shows(resolution, 3, 7, 0.8);      // four pixels on the area of a typical one: 4 / (1 + 4)
  shows(resolution, 15, 7, 0.5);
  shows(mask, 0, 7, 0);              // x = 0 is masked
  shows(mask, 15, 7, 1);
  shows(mask, 3, 7, static_cast<double>(blend::mask_weight(6, 12)));
  shows(confidence, 15, 7, 0.5);     // sigma 2 %: half of the best
  shows(weight, 15, 7, 1 / 3.0);     // a ratio of 1 / 2
  shows(weight, 3, 7, 0);            // has no albedo
}

TEST(Report, StaysBelowItsSize) {
  RunFixture run;
  run.width = 320;
  run.height = 240;
  std::uint32_t state = 1;
  run.photo = [&](int, int, int) { return static_cast<float>((state = state * 1664525u + 1013904223u) >> 8) * 0x1p-24f; };   // noise: the worst to compress
  run.write();
  ReportOptions options;
  options.min_picture_width = 16;
  const ReportResult large = write_report(run.folder, silent_reporter(), options);
  EXPECT_EQ(large.picture_width, 640);
  options.max_bytes = large.html_bytes / 2 + 200'000;
  const ReportResult small = write_report(run.folder, silent_reporter(), options);
  EXPECT_LE(small.html_bytes, options.max_bytes);
  EXPECT_LT(small.picture_width, 320);
  EXPECT_EQ(fault_of_html(page_of(run)), "");
}

TEST(Report, IsTheSameEachTime) {
  RunFixture run;
  run.write();
  write_report(run.folder, silent_reporter());
  const std::string first = page_of(run), numbers = read_text(run.folder.report() / "report.json");
  write_report(run.folder, silent_reporter());
  EXPECT_EQ(page_of(run), first);
  EXPECT_EQ(read_text(run.folder.report() / "report.json"), numbers);
}

TEST(Report, ShowsTheWorstPhotographsOfAManifoldSet) {
  RunFixture run;
  run.keys.clear();
  for (int i = 0; i < 12; ++i) run.keys.push_back(concat("p", i));
  run.write();
  RunFixture& r = run;
  r.residual = [](int, int, int) { return 0.2f; };
  r.write_photograph("p7");
  ReportOptions options;
  options.max_pictures_of = 4;
  write_report(run.folder, silent_reporter(), options);
  const std::string page = page_of(run);
  EXPECT_EQ(count_of(page, "<section"), 4u);
  EXPECT_THAT(page, HasSubstr("<h3>p7</h3>"));
  EXPECT_THAT(page, HasSubstr("Pictures of 4 of 12 photographs"));
  EXPECT_EQ(numbers_of(run)["photographs"].size(), 12u);
}

void expect_error(const RunFixture& run, const std::string& words) {
  try {
    write_report(run.folder, silent_reporter());
    FAIL() << "no error; expected: " << words;
  } catch (const Error& e) {
    EXPECT_THAT(e.what(), HasSubstr(words));
  }
  EXPECT_FALSE(std::filesystem::exists(run.folder.report() / "index.html"));
}

TEST(Report, NamesWhatIsMissing) {
  RunFixture run;
  expect_error(run, "no such folder");
  run.write();
  for (const char* name : {"work/project.json", "run.json", "lights.json", "work/photographs/photo_01/radiance.raster", "work/photographs/photo_01/gbuffer.raster",
                           "work/photographs/photo_00/albedo.raster", "photographs/photo_01/residual.exr", "photographs/photo_01/light.exr"}) {
    std::filesystem::rename(run.folder.root / name, run.scratch.path() / "aside");
    expect_error(run, std::filesystem::path(name).filename().string());
    std::filesystem::rename(run.scratch.path() / "aside", run.folder.root / name);
  }
}

TEST(Report, NamesWhatIsDamaged) {
  RunFixture run;
  run.write();
  for (const char* name : {"work/project.json", "run.json", "lights.json", "work/photographs/photo_01/radiance.raster", "photographs/photo_00/residual.exr"}) {
    const std::string whole = read_text(run.folder.root / name);
    write_text(run.folder.root / name, whole.substr(0, whole.size() / 2));
    expect_error(run, std::filesystem::path(name).filename().string());
    write_text(run.folder.root / name, whole);
  }
  RunFixture other;
  other.width = 41;
  other.write();
  std::filesystem::copy_file(other.folder.albedo("photo_00"), run.folder.albedo("photo_00"), std::filesystem::copy_options::overwrite_existing);
  expect_error(run, "41 x 30 pixels");
}

TEST(Report, SurvivesJsonOfAnyShape) {
  RunFixture run;
  run.write();
  for (const char* text : {"[]", "{}", "null", "{\"acquisitions\":3}", "{\"acquisitions\":[{\"photographs\":[1,null,{\"flash_intensity\":\"x\"}]}]}", "{\"counts\":[],\"stages\":{\"a\":1},\"left_out\":7}",
                           "{\"acquisition\":[{\"name\":\"a\",\"photographs\":[{\"key\":\"../up\"}]}]}", "\xff\xfe", "[[[[[[[["})
    for (const char* name : {"work/project.json", "run.json", "lights.json"}) {
      const std::string whole = read_text(run.folder.root / name);
      write_text(run.folder.root / name, text);
      try {
        write_report(run.folder, silent_reporter());
        EXPECT_EQ(fault_of_html(page_of(run)), "") << name << ": " << text;
      } catch (const Error& e) {
        EXPECT_THAT(e.what(), HasSubstr(".")) << name << ": " << text;
      }
      write_text(run.folder.root / name, whole);
    }
}

}  // namespace
}  // namespace chiaro::tools
