#include "tools/metrics.h"

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <limits>
#include <numbers>
#include <stdexcept>

#include "stream/base/parallel.h"

namespace chiaro::tools {
namespace {

constexpr double kPi = std::numbers::pi;
constexpr double kNan = std::numeric_limits<double>::quiet_NaN();
constexpr int kBandRows = 32;  ///< rows of one task; fixed, so that sums do not depend on threads

void check(const PixelView& test, const PixelView& reference, MaskView mask, int channels = 0) {
  const auto fits = [](const PixelView& v) {
    return v.width > 0 && v.height > 0 && v.channels > 0 &&
           v.values.size() == static_cast<std::size_t>(v.width) * static_cast<std::size_t>(v.height) * static_cast<std::size_t>(v.channels);
  };
  if (!fits(test) || !fits(reference)) throw std::invalid_argument("metrics: a picture's values do not fit its size");
  if (test.width != reference.width || test.height != reference.height || test.channels != reference.channels)
    throw std::invalid_argument("metrics: the pictures differ in size or channels");
  if (!mask.empty() && mask.size() != static_cast<std::size_t>(test.width) * static_cast<std::size_t>(test.height))
    throw std::invalid_argument("metrics: the mask has another size than the pictures");
  if (channels && test.channels != channels) throw std::invalid_argument("metrics: the pictures need 3 channels");
}

bool counts(MaskView mask, std::size_t pixel) { return mask.empty() || mask[pixel] != 0; }

struct Sum {
  double total = 0;
  double count = 0;
  Sum& operator+=(const Sum& other) {
    total += other.total;
    count += other.count;
    return *this;
  }
  double mean() const { return count > 0 ? total / count : kNan; }
};

/// Mean of f(test value, reference value) over masked values for which f says so.
template <class F>
double mean_over_values(const PixelView& test, const PixelView& reference, MaskView mask, F f) {
  const std::size_t pixels = static_cast<std::size_t>(test.width) * static_cast<std::size_t>(test.height), channels = static_cast<std::size_t>(test.channels);
  return deterministic_sum<Sum>(pixels, 1 << 14, {}, [&](std::size_t begin, std::size_t end) {
           Sum sum;
           for (std::size_t p = begin; p < end; ++p)
             if (counts(mask, p))
               for (std::size_t i = p * channels; i < (p + 1) * channels; ++i) sum += f(test.values[i], reference.values[i]);
           return sum;
         }).mean();
}

/// Runs rows(y0, y1) over bands of the picture and adds up what they return.
template <class F>
Sum sum_over_bands(int height, F rows) {
  const std::size_t bands = (static_cast<std::size_t>(height) + kBandRows - 1) / kBandRows;
  return deterministic_sum<Sum>(bands, 1, {}, [&](std::size_t begin, std::size_t end) {
    Sum sum;
    for (std::size_t b = begin; b < end; ++b) sum += rows(static_cast<int>(b) * kBandRows, std::min(height, static_cast<int>(b + 1) * kBandRows));
    return sum;
  });
}

std::vector<double> gaussian(double sigma, int radius) {
  std::vector<double> kernel;
  double sum = 0;
  for (int i = -radius; i <= radius; ++i) {
    kernel.push_back(std::exp(-0.5 * i * i / (sigma * sigma)));
    sum += kernel.back();
  }
  for (double& k : kernel) k /= sum;
  return kernel;
}

/// A band of rows of one quantity.
struct Rows {
  int width = 0, count = 0;
  std::vector<double> values;
  Rows(int width_px, int rows) : width(width_px), count(rows), values(static_cast<std::size_t>(width_px) * static_cast<std::size_t>(rows)) {}
  double* row(int y) { return values.data() + static_cast<std::ptrdiff_t>(y) * width; }
  const double* row(int y) const { return values.data() + static_cast<std::ptrdiff_t>(y) * width; }
};

/// Correlates every row with the kernel; the row's end values go on beyond its ends.
Rows along_rows(const Rows& in, const std::vector<double>& kernel) {
  const int radius = static_cast<int>(kernel.size()) / 2;
  Rows out(in.width, in.count);
  for (int y = 0; y < in.count; ++y) {
    const double* from = in.row(y);
    double* to = out.row(y);
    for (int x = 0; x < in.width; ++x) {
      double sum = 0;
      if (x >= radius && x + radius < in.width)
        for (int i = -radius; i <= radius; ++i) sum += kernel[static_cast<std::size_t>(i + radius)] * from[x + i];
      else
        for (int i = -radius; i <= radius; ++i) sum += kernel[static_cast<std::size_t>(i + radius)] * from[std::clamp(x + i, 0, in.width - 1)];
      to[x] = sum;
    }
  }
  return out;
}

/// Correlates columns; `in` has `halo` rows more above and below than the result.
Rows along_columns(const Rows& in, int halo, const std::vector<double>& kernel) {
  const int radius = static_cast<int>(kernel.size()) / 2;
  Rows out(in.width, in.count - 2 * halo);
  for (int y = 0; y < out.count; ++y) {
    double* to = out.row(y);
    for (int i = -radius; i <= radius; ++i) {
      const double k = kernel[static_cast<std::size_t>(i + radius)];
      const double* from = in.row(y + halo + i);
      for (int x = 0; x < in.width; ++x) to[x] += k * from[x];
    }
  }
  return out;
}

// SSIM -----------------------------------------------------------------------------------------------------------------------------

constexpr int kSsimRadius = 5;  // 11 x 11

/// No unmasked pixel within 5 px.
bool is_inside(MaskView mask, int width, int x, int y) {
  if (mask.empty()) return true;
  for (int dy = -kSsimRadius; dy <= kSsimRadius; ++dy)
    for (int dx = -kSsimRadius; dx <= kSsimRadius; ++dx)
      if (dx * dx + dy * dy <= kSsimRadius * kSsimRadius && !mask[static_cast<std::size_t>(y + dy) * static_cast<std::size_t>(width) + static_cast<std::size_t>(x + dx)]) return false;
  return true;
}

/// The six windowed sums of one channel over rows [y0, y1), which keep 5 rows from the border.
struct SsimMoments {
  Rows weight, a, b, aa, bb, ab;
};

SsimMoments ssim_moments(const PixelView& test, const PixelView& reference, MaskView mask, int channel, int y0, int y1, const std::vector<double>& kernel) {
  const int rows = y1 - y0 + 2 * kSsimRadius;
  std::vector<Rows> planes(6, Rows(test.width, rows));
  for (int y = 0; y < rows; ++y)
    for (int x = 0; x < test.width; ++x) {
      const std::size_t pixel = static_cast<std::size_t>(y + y0 - kSsimRadius) * static_cast<std::size_t>(test.width) + static_cast<std::size_t>(x);
      if (!counts(mask, pixel)) continue;  // all six stay 0
      const std::size_t i = pixel * static_cast<std::size_t>(test.channels) + static_cast<std::size_t>(channel);
      const double a = test.values[i], b = reference.values[i];
      const double values[] = {1, a, b, a * a, b * b, a * b};
      for (std::size_t k = 0; k < 6; ++k) planes[k].row(y)[x] = values[k];
    }
  for (Rows& plane : planes) plane = along_columns(along_rows(plane, kernel), kSsimRadius, kernel);
  return {std::move(planes[0]), std::move(planes[1]), std::move(planes[2]), std::move(planes[3]), std::move(planes[4]), std::move(planes[5])};
}

double ssim_of(double mean_a, double mean_b, double mean_aa, double mean_bb, double mean_ab) {
  constexpr double kC1 = 0.01 * 0.01, kC2 = 0.03 * 0.03;
  const double var_a = mean_aa - mean_a * mean_a, var_b = mean_bb - mean_b * mean_b, covariance = mean_ab - mean_a * mean_b;
  return (2 * mean_a * mean_b + kC1) * (2 * covariance + kC2) / ((mean_a * mean_a + mean_b * mean_b + kC1) * (var_a + var_b + kC2));
}

// FLIP -----------------------------------------------------------------------------------------------------------------------------

using Triple = std::array<double, 3>;

// CIE XYZ of linear sRGB, as the exact ratios that follow from the primaries' and the white's chromaticities.
constexpr double kXyz[3][3] = {{10135552.0 / 24577794, 8788810.0 / 24577794, 4435075.0 / 24577794},
                               {2613072.0 / 12288897, 8788810.0 / 12288897, 887015.0 / 12288897},
                               {1425312.0 / 73733382, 8788810.0 / 73733382, 70074185.0 / 73733382}};
constexpr Triple kWhite = {kXyz[0][0] + kXyz[0][1] + kXyz[0][2], kXyz[1][0] + kXyz[1][1] + kXyz[1][2], kXyz[2][0] + kXyz[2][1] + kXyz[2][2]};

/// XYZ divided by the white.
Triple relative_xyz(const Triple& rgb) {
  Triple xyz;
  for (std::size_t r = 0; r < 3; ++r) xyz[r] = (kXyz[r][0] * rgb[0] + kXyz[r][1] * rgb[1] + kXyz[r][2] * rgb[2]) / kWhite[r];
  return xyz;
}

/// Inverse of kXyz by cofactors, once.
struct InverseXyz {
  double m[3][3];
  InverseXyz() {
    const auto& a = kXyz;
    const double det = a[0][0] * (a[1][1] * a[2][2] - a[1][2] * a[2][1]) - a[0][1] * (a[1][0] * a[2][2] - a[1][2] * a[2][0]) +
                       a[0][2] * (a[1][0] * a[2][1] - a[1][1] * a[2][0]);
    for (int r = 0; r < 3; ++r)
      for (int c = 0; c < 3; ++c) {
        const int r1 = (r + 1) % 3, r2 = (r + 2) % 3, c1 = (c + 1) % 3, c2 = (c + 2) % 3;
        m[c][r] = (a[r1][c1] * a[r2][c2] - a[r1][c2] * a[r2][c1]) / det;
      }
  }
};

Triple rgb_from_relative_xyz(const Triple& xyz) {
  static const InverseXyz inverse;
  Triple rgb;
  for (std::size_t r = 0; r < 3; ++r)
    rgb[r] = inverse.m[r][0] * xyz[0] * kWhite[0] + inverse.m[r][1] * xyz[1] * kWhite[1] + inverse.m[r][2] * xyz[2] * kWhite[2];
  return rgb;
}

/// A linear opponent space: like Lab, without the cube root.
Triple ycxcz(const Triple& rgb) {
  const Triple v = relative_xyz(rgb);
  return {116 * v[1] - 16, 500 * (v[0] - v[1]), 200 * (v[1] - v[2])};
}

Triple rgb_from_ycxcz(const Triple& ycc) {
  const double y = (ycc[0] + 16) / 116;
  return rgb_from_relative_xyz({y + ycc[1] / 500, y, y - ycc[2] / 200});
}

double lab_curve(double t) {
  constexpr double kDelta = 6.0 / 29;
  return t > kDelta * kDelta * kDelta ? std::cbrt(t) : t / (3 * kDelta * kDelta) + 4.0 / 29;
}

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

bool has_bad_value(const PixelView& test, const PixelView& reference, MaskView mask) {
  return std::isnan(mean_over_values(test, reference, mask, [](float a, float b) { return Sum{std::isfinite(a) && std::isfinite(b) ? 0 : kNan, 1}; }));
}

}  // namespace

double mse(const PixelView& test, const PixelView& reference, MaskView mask) {
  check(test, reference, mask);
  const double mean = mean_over_values(test, reference, mask, [](float a, float b) {
    const double difference = static_cast<double>(a) - static_cast<double>(b);
    return Sum{difference * difference, 1};
  });
  return std::isfinite(mean) ? mean : kNan;
}

double psnr(const PixelView& test, const PixelView& reference, MaskView mask, double peak) { return 10 * std::log10(peak * peak / mse(test, reference, mask)); }

double relative_error(const PixelView& test, const PixelView& reference, MaskView mask, double floor) {
  check(test, reference, mask);
  const double mean = mean_over_values(test, reference, mask, [floor](float a, float b) {
    if (!std::isfinite(a) || !std::isfinite(b)) return Sum{kNan, 1};
    if (!(static_cast<double>(b) > floor)) return Sum{};
    return Sum{std::abs(static_cast<double>(a) - static_cast<double>(b)) / static_cast<double>(b), 1};
  });
  return std::isfinite(mean) ? mean : kNan;
}

double ssim(const PixelView& test, const PixelView& reference, MaskView mask) {
  check(test, reference, mask);
  if (has_bad_value(test, reference, mask)) return kNan;
  const std::vector<double> kernel = gaussian(1.5, kSsimRadius);
  return sum_over_bands(test.height, [&](int y0, int y1) {
           y0 = std::max(y0, kSsimRadius);
           y1 = std::min(y1, test.height - kSsimRadius);
           Sum sum;
           if (y0 >= y1) return sum;
           for (int c = 0; c < test.channels; ++c) {
             const SsimMoments m = ssim_moments(test, reference, mask, c, y0, y1, kernel);
             for (int y = y0; y < y1; ++y)
               for (int x = kSsimRadius; x < test.width - kSsimRadius; ++x) {
                 if (!is_inside(mask, test.width, x, y)) continue;
                 const std::size_t i = static_cast<std::size_t>(y - y0) * static_cast<std::size_t>(test.width) + static_cast<std::size_t>(x);
                 const double w = m.weight.values[i];
                 sum += {ssim_of(m.a.values[i] / w, m.b.values[i] / w, m.aa.values[i] / w, m.bb.values[i] / w, m.ab.values[i] / w), 1};
               }
           }
           return sum;
         }).mean();
}

FlipResult flip(const PixelView& test, const PixelView& reference, MaskView mask, const FlipOptions& options) {
  check(test, reference, mask, 3);
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

std::vector<float> luminance(const PixelView& rgb) {
  check(rgb, rgb, {}, 3);
  std::vector<float> y(rgb.values.size() / 3);
  for (std::size_t i = 0; i < y.size(); ++i) y[i] = 0.2126f * rgb.values[3 * i] + 0.7152f * rgb.values[3 * i + 1] + 0.0722f * rgb.values[3 * i + 2];
  return y;
}

std::array<double, 3> lab_from_linear(const std::array<double, 3>& rgb) {
  const Triple v = relative_xyz(rgb);
  const double x = lab_curve(v[0]), y = lab_curve(v[1]), z = lab_curve(v[2]);
  return {116 * y - 16, 500 * (x - y), 200 * (y - z)};
}

double delta_e_2000(const std::array<double, 3>& lab_1, const std::array<double, 3>& lab_2) {
  constexpr double kDegree = kPi / 180, k25To7 = 6103515625.0;
  const double mean_chroma = (std::hypot(lab_1[1], lab_1[2]) + std::hypot(lab_2[1], lab_2[2])) / 2;
  const double chroma_7 = std::pow(mean_chroma, 7), g = 0.5 * (1 - std::sqrt(chroma_7 / (chroma_7 + k25To7)));
  const double a_1 = (1 + g) * lab_1[1], a_2 = (1 + g) * lab_2[1];
  const double c_1 = std::hypot(a_1, lab_1[2]), c_2 = std::hypot(a_2, lab_2[2]);
  // Hue angles in degrees, [0, 360); 0 for grey.
  const auto hue = [&](double a, double b) {
    if (a == 0 && b == 0) return 0.0;
    const double h = std::atan2(b, a) / kDegree;
    return h < 0 ? h + 360 : h;
  };
  const double h_1 = hue(a_1, lab_1[2]), h_2 = hue(a_2, lab_2[2]);
  const bool is_grey = c_1 * c_2 == 0;
  double d_hue = is_grey ? 0 : h_2 - h_1;
  if (d_hue > 180) d_hue -= 360;
  if (d_hue < -180) d_hue += 360;
  double mean_hue = is_grey ? h_1 + h_2 : (h_1 + h_2) / 2;
  if (!is_grey && std::abs(h_1 - h_2) > 180) mean_hue += h_1 + h_2 < 360 ? 180 : -180;

  const double d_l = lab_2[0] - lab_1[0], d_c = c_2 - c_1, d_h = 2 * std::sqrt(c_1 * c_2) * std::sin(d_hue / 2 * kDegree);
  const double mean_l = (lab_1[0] + lab_2[0]) / 2, mean_c = (c_1 + c_2) / 2;
  const double t = 1 - 0.17 * std::cos((mean_hue - 30) * kDegree) + 0.24 * std::cos(2 * mean_hue * kDegree) + 0.32 * std::cos((3 * mean_hue + 6) * kDegree) -
                   0.20 * std::cos((4 * mean_hue - 63) * kDegree);
  const double l_50 = (mean_l - 50) * (mean_l - 50);
  const double s_l = 1 + 0.015 * l_50 / std::sqrt(20 + l_50), s_c = 1 + 0.045 * mean_c, s_h = 1 + 0.015 * mean_c * t;
  const double hue_bump = (mean_hue - 275) / 25, rotation = 30 * std::exp(-hue_bump * hue_bump);
  const double mean_c_7 = std::pow(mean_c, 7), r_c = 2 * std::sqrt(mean_c_7 / (mean_c_7 + k25To7));
  const double r_t = -std::sin(2 * rotation * kDegree) * r_c;
  const double l = d_l / s_l, c = d_c / s_c, h = d_h / s_h;
  return std::sqrt(std::max(0.0, l * l + c * c + h * h + r_t * c * h));
}

double mean_delta_e_2000(const PixelView& test, const PixelView& reference, MaskView mask) {
  check(test, reference, mask, 3);
  const std::size_t pixels = static_cast<std::size_t>(test.width) * static_cast<std::size_t>(test.height);
  const auto lab = [](const PixelView& view, std::size_t pixel) {
    return lab_from_linear({view.values[3 * pixel], view.values[3 * pixel + 1], view.values[3 * pixel + 2]});
  };
  return deterministic_sum<Sum>(pixels, 1 << 12, {}, [&](std::size_t begin, std::size_t end) {
           Sum sum;
           for (std::size_t p = begin; p < end; ++p)
             if (counts(mask, p)) sum += {delta_e_2000(lab(test, p), lab(reference, p)), 1};
           return sum;
         }).mean();
}

}  // namespace chiaro::tools
