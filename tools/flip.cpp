// FLIP, as tools/metrics.h says it.
#include <algorithm>
#include <cmath>
#include <numbers>
#include <stdexcept>

#include "tools/colour_spaces.h"
#include "tools/metric_bands.h"

namespace chiaro::tools {
namespace {

constexpr double kPi = std::numbers::pi;

/// Chroma shrinks with lightness (Hunt).
Triple hunt(const Triple& lab) { return {lab[0], 0.01 * lab[0] * lab[1], 0.01 * lab[0] * lab[2]}; }

double hyab(const Triple& a, const Triple& b) { return std::abs(a[0] - b[0]) + std::hypot(a[1] - b[1], a[2] - b[2]); }

/// The filters for one viewing distance. Contrast sensitivity: Gaussians per opponent channel (the blue-yellow one is a sum of two), each
/// separable; features: first and second derivative of a Gaussian.
struct FlipFilters {
  int radius = 0;  ///< the largest: the halo of a band
  std::vector<double> achromatic, red_green, blue_yellow_1, blue_yellow_2;
  double blue_yellow_weight_1 = 1, blue_yellow_weight_2 = 0;
  std::vector<double> blur, edge, point;

  explicit FlipFilters(double ppd) {
    // Fitted parameters a, b of a * sqrt(pi / b) * exp(-pi^2 r^2 / b), r in degrees (table 1 of the paper).
    const double b_achromatic = 0.0047, b_red_green = 0.0053, a_1 = 34.1, b_1 = 0.04, a_2 = 13.5, b_2 = 0.025;
    const int csf_radius = static_cast<int>(std::ceil(3 * std::sqrt(b_1 / (2 * kPi * kPi)) * ppd));
    const auto kernel = [&](double b) { return gaussian(std::sqrt(b / (2 * kPi * kPi)) * ppd, csf_radius); };
    achromatic = kernel(b_achromatic);
    red_green = kernel(b_red_green);
    blue_yellow_1 = kernel(b_1);
    blue_yellow_2 = kernel(b_2);
    // kernel() sums to 1, so the weights carry each Gaussian's own sum over the 2-D window.
    const auto volume = [&](double a, double b) {
      double sum = 0;
      for (int i = -csf_radius; i <= csf_radius; ++i) sum += std::exp(-kPi * kPi * i * i / (ppd * ppd * b));
      return a * std::sqrt(kPi / b) * sum * sum;
    };
    const double volume_1 = volume(a_1, b_1), volume_2 = volume(a_2, b_2);
    blue_yellow_weight_1 = volume_1 / (volume_1 + volume_2);
    blue_yellow_weight_2 = volume_2 / (volume_1 + volume_2);

    const double sigma = 0.5 * 0.082 * ppd;  // feature width in degrees
    const int feature_radius = static_cast<int>(std::ceil(3 * sigma));
    blur = gaussian(sigma, feature_radius);
    for (int i = -feature_radius; i <= feature_radius; ++i) {
      const double g = std::exp(-0.5 * i * i / (sigma * sigma));
      edge.push_back(-i * g);
      point.push_back((i * i / (sigma * sigma) - 1) * g);
    }
    normalise_parts(edge);
    normalise_parts(point);
    radius = std::max(csf_radius, feature_radius);
  }

  /// Positive weights sum to 1, negative ones to -1.
  static void normalise_parts(std::vector<double>& kernel) {
    double positive = 0, negative = 0;
    for (const double k : kernel) (k > 0 ? positive : negative) += k;
    for (double& k : kernel) k /= k > 0 ? positive : -negative;
  }
};

/// What a viewer sees of one picture in a band: perceived colour, and strength of edges and points.
struct FlipView {
  std::vector<Triple> colour;
  Rows edges, points;
};

Rows magnitude(const Rows& x, const Rows& y) {
  Rows out(x.width, x.count);
  for (std::size_t i = 0; i < out.values.size(); ++i) out.values[i] = std::hypot(x.values[i], y.values[i]);
  return out;
}

FlipView flip_view(const PixelView& image, const PixelView& outside, MaskView mask, int y0, int y1, const FlipFilters& filters) {
  const int halo = filters.radius, rows = y1 - y0 + 2 * halo;
  Rows y(image.width, rows), cx(image.width, rows), cz(image.width, rows), feature(image.width, rows);
  for (int r = 0; r < rows; ++r)
    for (int x = 0; x < image.width; ++x) {
      const std::size_t pixel = static_cast<std::size_t>(std::clamp(y0 - halo + r, 0, image.height - 1)) * static_cast<std::size_t>(image.width) + static_cast<std::size_t>(x);
      const PixelView& source = counts(mask, pixel) ? image : outside;
      Triple rgb;
      // max first: a NaN beyond the mask becomes 0.
      for (std::size_t c = 0; c < 3; ++c) rgb[c] = std::min(1.0, std::max(0.0, static_cast<double>(source.values[pixel * 3 + c])));
      const Triple ycc = ycxcz(rgb);
      y.row(r)[x] = ycc[0];
      cx.row(r)[x] = ycc[1];
      cz.row(r)[x] = ycc[2];
      feature.row(r)[x] = (ycc[0] + 16) / 116;
    }
  const Rows y_seen = along_columns(along_rows(y, filters.achromatic), halo, filters.achromatic);
  const Rows cx_seen = along_columns(along_rows(cx, filters.red_green), halo, filters.red_green);
  const Rows cz_1 = along_columns(along_rows(cz, filters.blue_yellow_1), halo, filters.blue_yellow_1);
  const Rows cz_2 = along_columns(along_rows(cz, filters.blue_yellow_2), halo, filters.blue_yellow_2);
  FlipView view{{}, Rows(0, 0), Rows(0, 0)};
  view.colour.resize(y_seen.values.size());
  for (std::size_t i = 0; i < view.colour.size(); ++i) {
    const double cz_seen = filters.blue_yellow_weight_1 * cz_1.values[i] + filters.blue_yellow_weight_2 * cz_2.values[i];
    Triple rgb = rgb_from_ycxcz({y_seen.values[i], cx_seen.values[i], cz_seen});
    for (double& c : rgb) c = std::clamp(c, 0.0, 1.0);
    view.colour[i] = hunt(lab_from_linear(rgb));
  }
  const Rows blurred = along_rows(feature, filters.blur);
  view.edges = magnitude(along_columns(along_rows(feature, filters.edge), halo, filters.blur), along_columns(blurred, halo, filters.edge));
  view.points = magnitude(along_columns(along_rows(feature, filters.point), halo, filters.blur), along_columns(blurred, halo, filters.point));
  return view;
}

/// Error of colour, 0..1: large differences are compressed into the last twentieth.
double flip_colour_error(const Triple& a, const Triple& b) {
  constexpr double kExponent = 0.7, kKnee = 0.4, kKneeValue = 0.95;
  static const double largest =
      std::pow(hyab(hunt(lab_from_linear({0, 1, 0})), hunt(lab_from_linear({0, 0, 1}))), kExponent);
  const double error = std::pow(hyab(a, b), kExponent), knee = kKnee * largest;
  return error < knee ? error * kKneeValue / knee : kKneeValue + (error - knee) / (largest - knee) * (1 - kKneeValue);
}

}  // namespace

FlipResult flip(const PixelView& test, const PixelView& reference, MaskView mask, const FlipOptions& options) {
  require_alike(test, reference, mask, 3);
  if (!(options.pixels_per_degree > 0 && options.pixels_per_degree < 1e4)) throw std::invalid_argument("flip: pixels_per_degree is outside (0, 10000)");
  FlipResult result;
  if (options.keep_map) result.map.resize(static_cast<std::size_t>(test.width) * static_cast<std::size_t>(test.height));
  const FlipFilters filters(options.pixels_per_degree);
  const Sum sum = sum_over_bands(test.height, [&](int y0, int y1) {
    const FlipView seen_test = flip_view(test, reference, mask, y0, y1, filters), seen_reference = flip_view(reference, reference, mask, y0, y1, filters);
    Sum band;
    for (std::size_t i = 0; i < seen_test.colour.size(); ++i) {
      const double colour_error = flip_colour_error(seen_test.colour[i], seen_reference.colour[i]);
      const double edges = std::abs(seen_test.edges.values[i] - seen_reference.edges.values[i]);
      const double points = std::abs(seen_test.points.values[i] - seen_reference.points.values[i]);
      const double feature_error = std::sqrt(std::max(edges, points) / std::numbers::sqrt2);
      const double error = std::pow(colour_error, 1 - feature_error);
      const std::size_t pixel = static_cast<std::size_t>(y0) * static_cast<std::size_t>(test.width) + i;
      if (options.keep_map) result.map[pixel] = static_cast<float>(error);
      if (counts(mask, pixel)) band += {error, 1};
    }
    return band;
  });
  result.mean = has_bad_value(test, reference, mask) ? kNan : sum.mean();
  return result;
}

}  // namespace chiaro::tools
