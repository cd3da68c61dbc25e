#include "tools/colour_spaces.h"

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <numbers>

namespace chiaro::tools {
namespace {

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

double lab_curve(double t) {
  constexpr double kDelta = 6.0 / 29;
  return t > kDelta * kDelta * kDelta ? std::cbrt(t) : t / (3 * kDelta * kDelta) + 4.0 / 29;
}

}  // namespace

Triple ycxcz(const Triple& rgb) {
  const Triple v = relative_xyz(rgb);
  return {116 * v[1] - 16, 500 * (v[0] - v[1]), 200 * (v[1] - v[2])};
}

Triple rgb_from_ycxcz(const Triple& ycc) {
  const double y = (ycc[0] + 16) / 116;
  return rgb_from_relative_xyz({y + ycc[1] / 500, y, y - ycc[2] / 200});
}

Triple lab_from_linear(const Triple& rgb) {
  const Triple v = relative_xyz(rgb);
  const double x = lab_curve(v[0]), y = lab_curve(v[1]), z = lab_curve(v[2]);
  return {116 * y - 16, 500 * (x - y), 200 * (y - z)};
}

double delta_e_2000(const Triple& lab_1, const Triple& lab_2) {
  constexpr double kDegree = std::numbers::pi / 180, k25To7 = 6103515625.0;
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

}  // namespace chiaro::tools
