/// Two sets of colours of the same points: how much they differ, per point and in sum.
#pragma once
#include <cstdint>
#include <filesystem>
#include <string>

#include "stream/base/report.h"

namespace chiaro::tools {

/// Of one value per point. Median and 95th percentile come from a histogram with 4096 steps a factor of two: within 0.03 % of the true ones.
struct Distribution {
  double mean = 0, median = 0, p95 = 0, max = 0;
};

struct PointComparison {
  std::uint64_t points = 0;         ///< of each
  std::uint64_t compared = 0;       ///< both finite
  std::uint64_t unseen_a = 0, unseen_b = 0;  ///< not finite in A, in B
  std::uint64_t elsewhere = 0;      ///< points that lie in A and B farther apart than a thousandth of the extent: another order, or another frame
  std::string compared_values;      ///< "albedo" or "colour": what both have
  Distribution difference;          ///< |a - b|, mean of the channels, linear
  Distribution relative;            ///< |a - b| / b, mean of the channels with b > 0.001
  double rms = 0;                   ///< root of the mean squared difference over points and channels
  double bias = 0;                  ///< mean of a - b
  double scale = 1;                 ///< s that makes s * a nearest to b in the least squares: how much of the difference is one factor
  Distribution relative_scaled;     ///< relative difference of s * a
  double delta_e = 0;               ///< mean CIEDE2000
  double picture_range = 0;         ///< relative difference of full colour in the picture; 0 without one
};

/// a, b: see open_colours(). B is the reference. out: where to write the differences as a point file (x y z, difference_r/g/b = a - b,
/// difference, relative; NaN where not compared), empty = nowhere.
/// picture: where to draw them as a PNG of the cloud from six sides (see DifferencePicture), signed: mean over the channels of (a - b) / b; empty = nowhere.
/// Two passes over both, in bounded memory. Points are matched by their order.
/// throws Error if out or picture is a or b, if the numbers of points differ, if the sources have no values in common or show different points.
PointComparison compare_points(const std::string& a, const std::string& b, const std::filesystem::path& out, Reporter& report, const std::filesystem::path& picture = {});

}  // namespace chiaro::tools
