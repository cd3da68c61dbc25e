#include "optimize/encoding_misreading.h"

#include <algorithm>
#include <cmath>
#include <numbers>
#include <vector>

#include "optimize/light_residuals.h"
#include "stream/base/error.h"
#include "stream/photo/image_io.h"

namespace chiaro::optimize {
namespace {

constexpr double kPi = std::numbers::pi;
constexpr double kFarBetter = 0.75;   ///< curves that were there: 0.14 to 0.53, of three scenes; linear values, as if they had one: 4 and more
constexpr double kExplained = 0.1;    ///< scatter of surfaces that the model does not explain either way, as metal, says nothing: a bronze in JPEG files 0.32 without the curve, 0.55 with it
constexpr double kFlashSd = 1;        ///< of ln: a calibrated range is in the numbers of pictures whose curve nobody has thought of
constexpr double kWhite = 1.001;
constexpr std::size_t kLeastGroups = 100;

double changed(CurveChange change, double v) { return change == CurveChange::kDecode ? stream::linear_from_srgb(v) : stream::srgb_from_linear(v); }

/// How many times larger it makes a small relative difference.
double enlarges(CurveChange change, double v) {
  constexpr double kStep = 1.01;
  return std::log(changed(change, v) / changed(change, v / kStep)) / std::log(kStep);
}

double value_of(float radiosity) { return std::clamp(static_cast<double>(radiosity) / kPi, 0.0, 1.0); }

template <class Radiosities>
void change_values(CurveChange change, Radiosities& radiosities) {
  for (float& b : radiosities) b = static_cast<float>(kPi * changed(change, value_of(b)));
}

bool is_of_a_picture(const LightSample& s) { return static_cast<double>(*std::max_element(s.radiosity.begin(), s.radiosity.end())) < kWhite * kPi; }

/// For values as they were taken.
double scatter_after(CurveChange change, std::span<const LightSample> samples, const LightSolveOptions& options, const Lights& start) {
  std::vector<LightSample> other(samples.begin(), samples.end());
  std::vector<double> larger;
  for (LightSample& s : other) {
    if (s.radiosity[1] > 0) larger.push_back(enlarges(change, value_of(s.radiosity[1])));
    change_values(change, s.radiosity);
    change_values(change, s.gathered);   // nearly: it is a mean of such values
  }
  const double times = upper_median(std::move(larger));
  return times > 0 ? solve_lights(other, {}, options, start).scatter / times : HUGE_VAL;
}

}  // namespace

bool explains_far_better(double scatter, double as_taken) { return scatter < kExplained && scatter < kFarBetter * as_taken; }

std::optional<EncodingMisreading> find_encoding_misreading(std::span<const LightSample> samples, const LightSolveOptions& options, const Lights& as_taken) {
  if (groups_of(samples).size() < kLeastGroups || !std::all_of(samples.begin(), samples.end(), is_of_a_picture)) return std::nullopt;
  LightSolveOptions wide = options;
  if (wide.flash_ln_sd) wide.flash_ln_sd = std::max(*wide.flash_ln_sd, kFlashSd);
  const double scatter = solve_lights(samples, {}, wide, as_taken).scatter;
  std::optional<EncodingMisreading> best;
  for (const CurveChange change : {CurveChange::kDecode, CurveChange::kEncode}) {
    const double after = scatter_after(change, samples, wide, as_taken);
    if (explains_far_better(after, best ? best->scatter / kFarBetter : scatter)) best = EncodingMisreading{change, after, scatter};
  }
  return best;
}

std::string encoding_note(const EncodingMisreading& found) {
  const bool decode = found.change == CurveChange::kDecode;
  const auto per_cent = [](double relative) { return concat(std::round(1000 * relative) / 10, " %"); };
  return concat("the photographs look as if they ", decode ? "held the sRGB curve, and are taken as linear" : "were linear, and the sRGB curve was taken off them", ": ", decode ? "with it taken off" : "as they are stored",
                " they differ by ", per_cent(found.scatter), " where they show the same surface, as they were taken by ", per_cent(found.scatter_as_taken),
                ". Nothing was changed, and the albedo is by what was taken: if that is the mistake, write encoding = ", decode ? "\"srgb\"" : "\"linear\"",
                " and run again. An intensity_range has to be in the numbers of linear values");
}

}  // namespace chiaro::optimize
