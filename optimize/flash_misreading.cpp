#include "optimize/flash_misreading.h"

#include <algorithm>
#include <cmath>

#include "optimize/light_residuals.h"
#include "stream/base/error.h"

namespace chiaro::optimize {
namespace {

constexpr double kFarLess = 0.85;   ///< offsets that are right: 1.1 and more, of four scenes; y and z turned over: 0.35, 0.48, 0.78, 0.85
constexpr double kAsMuch = 1.2;     ///< 1.14 in a chamber with y and z turned over
constexpr double kExplained = 0.1;  ///< surfaces that no reading explains, as metal, say nothing
constexpr double kLit = 0.8;        ///< of the flash without shadows
constexpr std::size_t kLeastGroups = 100;

/// Rows: what x, y and z should have been, of what was written.
Mat3d axes(const Vec3d& x, const Vec3d& y, const Vec3d& z) {
  Mat3d m;
  m << x.transpose(), y.transpose(), z.transpose();
  return m;
}

/// Irradiance of a place per unit of the flash's intensity, shadows aside.
double unshadowed(const Vec3d& place, const Vec3d& normal, const Vec3d& flash) {
  const Vec3d to_flash = flash - place;
  const double length = to_flash.norm();
  return length > 0 ? std::max(0.0, normal.dot(to_flash)) / (length * length * length) : 0;
}

/// Samples that no shadow of the flash as written reaches, and what of their flash is not geometry: the pixels' mean.
struct Unshadowed {
  std::vector<LightSample> samples;
  std::vector<double> mean;
};

/// Four digits of the longest.
std::string rounded(const Vec3d& v) {
  const double steps = v.norm() > 0 ? std::pow(10.0, 3 - std::floor(std::log10(v.norm()))) : 1;
  const auto number = [&](double x) { return std::round(x * steps) / steps + 0.0; };   // no -0
  return concat("[", number(v.x()), ", ", number(v.y()), ", ", number(v.z()), "]");
}

std::string per_cent(double relative) { return concat(std::round(1000 * relative) / 10, " %"); }

}  // namespace

std::vector<OffsetReading> usual_readings() {
  const Vec3d x = Vec3d::UnitX(), y = Vec3d::UnitY(), z = Vec3d::UnitZ();
  std::vector<OffsetReading> readings{{axes(x, -y, -z), "with y up and z backwards, as OpenGL has it"},
                                      {axes(x, -y, z), "with y up"},
                                      {axes(x, -z, y), "with y forward and z up"},
                                      {axes(-x, y, z), "with x to the left"},
                                      {axes(-x, -y, z), "for pictures the other way up"},
                                      {axes(-y, x, z), "for pictures before they were turned clockwise"},
                                      {axes(y, -x, z), "for pictures before they were turned counter-clockwise"},
                                      {axes(-x, -y, -z), "from the flash to the camera"}};
  for (const auto& [factor, mistake] : {std::pair{1000.0, "in a unit 1000 times as long as that of cloud and cameras (m beside mm)"}, std::pair{100.0, "in a unit 100 times as long as that of cloud and cameras (m beside cm)"},
                                        std::pair{10.0, "in a unit 10 times as long as that of cloud and cameras (cm beside mm)"}, std::pair{0.1, "in a tenth of the unit of cloud and cameras (mm beside cm)"},
                                        std::pair{0.01, "in a hundredth of the unit of cloud and cameras (cm beside m)"}, std::pair{0.001, "in a thousandth of the unit of cloud and cameras (mm beside m)"}})
    readings.push_back({factor * Mat3d::Identity(), mistake});
  return readings;
}

bool is_worth_telling(const Misreading& m, bool light_varies) { return m.scatter < kExplained && m.scatter < (light_varies ? kAsMuch : kFarLess) * m.scatter_corrected; }

std::optional<Misreading> find_misreading(std::span<const LightSample> samples, std::span<const Vec3f> position, std::span<const Vec3f> normal, const FlashUnder& flash_under,
                                          std::span<const ReferenceSample> references, const LightSolveOptions& options, const Lights& as_written) {
  const auto flash_at = [&](const LightSample& s, const Mat3d& offset_from_written) {
    return unshadowed(position[s.group].cast<double>(), normal[s.group].cast<double>(), flash_under(s.photograph, offset_from_written));
  };
  Unshadowed lit;
  for (const LightSample& s : samples) {
    const double whole = s.flash_photograph ? flash_at(s, Mat3d::Identity()) : 0, mean = whole > 0 ? static_cast<double>(s.flash) / whole : 0;
    if (s.flash_photograph && !(mean > kLit)) continue;
    lit.samples.push_back(s);
    lit.mean.push_back(mean);
  }
  if (groups_of(lit.samples).size() < kLeastGroups) return std::nullopt;
  const double written = solve_lights(lit.samples, references, options, as_written).scatter;
  std::optional<Misreading> best;
  for (const OffsetReading& reading : usual_readings()) {
    for (std::size_t i = 0; i < lit.samples.size(); ++i)
      if (LightSample& s = lit.samples[i]; s.flash_photograph) s.flash = static_cast<float>(lit.mean[i] * flash_at(s, reading.offset_from_written));
    const double scatter = solve_lights(lit.samples, references, options, as_written).scatter;
    if (scatter < kFarLess * written && (!best || scatter < best->scatter)) best = Misreading{reading, scatter, written, written};
  }
  return best;
}

std::string misreading_note(const Misreading& found, const Vec3d& written) {
  const std::string instead = rounded(found.reading.offset_from_written * written);
  const bool settled = found.scatter_corrected < found.scatter_as_written;
  return concat("flash.offset_in_camera = ", rounded(written), " looks as if it were written ", found.reading.mistake, ": with ", instead, " the photographs differ by ", per_cent(found.scatter),
                " where they show the same surface, as it stands by ", per_cent(found.scatter_as_written), settled ? concat(" (", per_cent(found.scatter_corrected), " with all that was taken out)") : "",
                ". Nothing was changed, and the albedo is by what stands there: if that is the mistake, write offset_in_camera = ", instead, " (right, down, forward) and run again");
}

}  // namespace chiaro::optimize
