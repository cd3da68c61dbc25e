#include "tools/light_spread_json.h"

#include <Eigen/Dense>
#include <algorithm>
#include <cmath>
#include <nlohmann/json.hpp>
#include <numbers>
#include <optional>
#include <sstream>

#include "tools/table.h"

namespace chiaro::tools {
namespace {

using Json = nlohmann::ordered_json;

/// The picture's own coordinates: flash to the right, ambient upwards.
struct Plot {
  static constexpr double kWidth = 420, kHeight = 260, kLeft = 64, kBottom = 44, kTop = 12, kRight = 12;
  double x0, x1, y0, y1;
  double x(double flash) const { return kLeft + (flash - x0) / (x1 - x0) * (kWidth - kLeft - kRight); }
  double y(double ambient) const { return kHeight - kBottom - (ambient - y0) / (y1 - y0) * (kHeight - kBottom - kTop); }
};

struct Ellipse {
  double flash, ambient;
  Eigen::Matrix2d root;   ///< of the covariance of (flash, ambient), not of logarithms
  std::array<double, 2> at(double deviations, double angle) const {
    const Eigen::Vector2d p = deviations * (root * Eigen::Vector2d(std::cos(angle), std::sin(angle)));
    return {flash + p[0], std::max(0.0, ambient + p[1])};
  }
};

std::string path_of(const Plot& plot, const Ellipse& e, double deviations) {
  std::ostringstream d;
  d.precision(5);
  constexpr int kSteps = 72;
  for (int i = 0; i < kSteps; ++i) {
    const auto [flash, ambient] = e.at(deviations, 2 * std::numbers::pi * i / kSteps);
    d << (i ? " L" : "M") << plot.x(flash) << ' ' << plot.y(ambient);
  }
  return d.str() + " Z";
}

std::optional<Ellipse> ellipse_of(const Json& light) {
  const auto number = [&](const char* name) { return light.contains(name) && light[name].is_number() ? light[name].get<double>() : NAN; };
  const Json covariance = light.value("covariance", Json());
  const Json names = light.value("covariance_of", Json());
  if (!covariance.is_array() || covariance.size() < 2 || !names.is_array() || names.size() < 2 || names[1] != "sky_0" || !covariance[0].is_array() || !covariance[1].is_array() ||
      covariance[0].size() < 2 || covariance[1].size() < 2)
    return std::nullopt;
  for (int i = 0; i < 2; ++i)
    for (int k = 0; k < 2; ++k)
      if (!covariance[static_cast<std::size_t>(i)][static_cast<std::size_t>(k)].is_number()) return std::nullopt;
  Ellipse e{number("flash_intensity"), number("ambient"), {}};
  if (!(e.flash > 0) || !(e.ambient >= 0)) return std::nullopt;
  Eigen::Matrix2d c;
  c << covariance[0][0].get<double>() * e.flash * e.flash, covariance[0][1].get<double>() * e.flash, covariance[1][0].get<double>() * e.flash, covariance[1][1].get<double>();
  const Eigen::SelfAdjointEigenSolver<Eigen::Matrix2d> eigen(c);
  if (!(eigen.eigenvalues()[1] > 0) || !std::isfinite(eigen.eigenvalues()[1])) return std::nullopt;
  e.root = eigen.eigenvectors() * eigen.eigenvalues().cwiseMax(0.0).cwiseSqrt().asDiagonal();
  return e;
}

}  // namespace

Json to_json(const LightSpread& s) {
  return {{"flash_intensity", s.flash_intensity}, {"ambient", s.ambient}, {"albedo_change_in_flash_light", s.albedo_in_flash}, {"albedo_change_in_ambient_light", s.albedo_in_ambient}};
}

std::string light_spread_svg(const Json& light, const Json& calibrated_range) {
  const auto e = ellipse_of(light);
  if (!e) return "";
  const double reach_flash = 3 * e->root.row(0).norm(), reach_ambient = 3 * e->root.row(1).norm();
  Plot plot{std::max(0.0, e->flash - reach_flash), e->flash + reach_flash, std::max(0.0, e->ambient - reach_ambient), e->ambient + reach_ambient};
  const bool calibrated = calibrated_range.is_array() && calibrated_range.size() == 2 && calibrated_range[0].is_number() && calibrated_range[1].is_number();
  if (calibrated) {
    plot.x0 = std::min(plot.x0, 0.99 * calibrated_range[0].get<double>());
    plot.x1 = std::max(plot.x1, 1.01 * calibrated_range[1].get<double>());
  }
  if (!(plot.x1 > plot.x0)) return "";
  if (!(plot.y1 > plot.y0)) plot.y1 = plot.y0 + 1;
  const double left = Plot::kLeft, right = Plot::kWidth - Plot::kRight, top = Plot::kTop, bottom = Plot::kHeight - Plot::kBottom;
  std::ostringstream svg;
  svg.precision(5);
  svg << "<svg viewBox=\"0 0 " << Plot::kWidth << ' ' << Plot::kHeight << "\" width=\"" << Plot::kWidth << "\" height=\"" << Plot::kHeight
      << "\" role=\"img\" aria-label=\"flash and ambient light that the photographs allow\" font-size=\"11\" fill=\"none\" stroke=\"currentColor\">";
  if (calibrated)
    svg << "<rect x=\"" << plot.x(calibrated_range[0].get<double>()) << "\" y=\"" << top << "\" width=\"" << plot.x(calibrated_range[1].get<double>()) - plot.x(calibrated_range[0].get<double>())
        << "\" height=\"" << bottom - top << "\" fill=\"currentColor\" fill-opacity=\"0.08\" stroke=\"none\"/>";
  svg << "<path d=\"M" << left << ' ' << top << " V" << bottom << " H" << right << "\" stroke-opacity=\"0.5\"/>";
  svg << "<path d=\"" << path_of(plot, *e, 2) << "\" fill=\"currentColor\" fill-opacity=\"0.12\"/><path d=\"" << path_of(plot, *e, 1) << "\" fill=\"currentColor\" fill-opacity=\"0.2\"/>";
  svg << "<circle cx=\"" << plot.x(e->flash) << "\" cy=\"" << plot.y(e->ambient) << "\" r=\"2.5\" fill=\"currentColor\"/>";
  const auto text = [&](double x, double y, const char* anchor, const std::string& words) {
    svg << "<text x=\"" << x << "\" y=\"" << y << "\" text-anchor=\"" << anchor << "\" fill=\"currentColor\" stroke=\"none\">" << words << "</text>";
  };
  text(left, bottom + 15, "start", format_number(plot.x0, 3));
  text(right, bottom + 15, "end", format_number(plot.x1, 3));
  text(left - 5, bottom, "end", format_number(plot.y0, 3));
  text(left - 5, top + 9, "end", format_number(plot.y1, 3));
  text((left + right) / 2, Plot::kHeight - 8, "middle", calibrated ? "flash, W/sr (shaded: calibrated range)" : "flash, W/sr (no calibrated range)");
  svg << "<text x=\"14\" y=\"" << (top + bottom) / 2 << "\" text-anchor=\"middle\" fill=\"currentColor\" stroke=\"none\" transform=\"rotate(-90 14 " << (top + bottom) / 2 << ")\">ambient radiance</text></svg>";
  return svg.str();
}

}  // namespace chiaro::tools
