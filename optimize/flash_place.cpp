#include "optimize/flash_place.h"

#include <algorithm>
#include <cmath>
#include <vector>

#include "optimize/light_residuals.h"

namespace chiaro::optimize {
namespace {

constexpr int kUnknowns = 6;   // shift x, y, z; ln flash; ln ambient; bounce
using Vec = Eigen::Matrix<double, kUnknowns, 1>;
using Mat = Eigen::Matrix<double, kUnknowns, kUnknowns>;
constexpr int kRounds = 8;

struct Row {
  double residual = 0, weight = 0;
  Vec effect = Vec::Zero();   ///< of the unknowns on the residual
};

/// Of ln(B / H), mean of the channels. False where it says nothing.
bool row_of(const LightSample& s, const Lights& lights, Row& row) {
  if (!s.flash_photograph) return false;
  row.residual = 0;
  row.effect.setZero();
  for (int c = 0; c < 3; ++c) {
    const double h = irradiance(lights, s, c), b = body_radiosity(lights, s, c);
    if (!(h > 0) || !(b > 0)) return false;
    row.residual += std::log(b / h) / 3;
    const double direct = lights.flash_intensity * static_cast<double>(s.flash) / h, gathered = static_cast<double>(s.gathered[static_cast<std::size_t>(c)]) / h;
    row.effect.head<3>() -= direct / 3 * s.flash_by_shift.cast<double>();
    row.effect[3] -= direct / 3;
    row.effect[4] -= std::max(0.0, 1 - direct - lights.bounce * gathered) / 3;
    row.effect[5] -= gathered / 3;
  }
  row.weight = sample_weight(lights, s) * static_cast<double>(s.trust);
  return row.weight > 0;
}

/// Rows as deviations from their group's mean.
std::vector<Row> deviations(std::span<const LightSample> samples, const Lights& lights) {
  std::vector<Row> all, group;
  for (std::size_t i = 0; i < samples.size();) {
    const std::uint32_t id = samples[i].group;
    group.clear();
    for (; i < samples.size() && samples[i].group == id; ++i)
      if (Row r; row_of(samples[i], lights, r)) group.push_back(r);
    if (group.size() < 2) continue;
    double weight = 0, residual = 0;
    Vec effect = Vec::Zero();
    for (const Row& r : group) {
      weight += r.weight;
      residual += r.weight * r.residual;
      effect += r.weight * r.effect;
    }
    for (Row& r : group) {
      r.residual -= residual / weight;
      r.effect -= effect / weight;
    }
    all.insert(all.end(), group.begin(), group.end());
  }
  return all;
}

double robust_scale(const std::vector<Row>& rows, const Vec& x) {
  std::vector<double> sizes;
  for (const Row& r : rows) sizes.push_back(std::sqrt(r.weight) * std::fabs(r.residual + r.effect.dot(x)));
  const auto mid = sizes.begin() + static_cast<std::ptrdiff_t>(sizes.size() / 2);
  std::nth_element(sizes.begin(), mid, sizes.end());
  return std::max(0.1, 1.4826 * *mid);
}

}  // namespace

FlashPlace find_flash_place(std::span<const LightSample> samples, const Lights& lights, const Vec3d& already, double independent, const FlashPlaceOptions& options) {
  const std::vector<Row> rows = deviations(samples, lights);
  FlashPlace found;
  found.shift_in_camera = already;
  if (rows.empty()) return found;
  Vec prior;
  prior << Vec3d::Constant(1 / (options.prior_sd * options.prior_sd)), 1 / (options.lights_sd * options.lights_sd), 1 / (options.lights_sd * options.lights_sd),
      1 / (options.bounce_sd * options.bounce_sd);
  Vec x = Vec::Zero();
  Mat a;
  for (int round = 0; round < kRounds; ++round) {
    const double scale = robust_scale(rows, x), share = std::min(1.0, independent / static_cast<double>(rows.size())) / std::max(1.0, scale * scale);
    a = prior.asDiagonal();
    Vec b = Vec::Zero();
    b.head<3>() = -prior.head<3>().cwiseProduct(already);
    for (const Row& r : rows) {
      const double now = r.residual + r.effect.dot(x), w = share * r.weight / (1 + r.weight * now * now / (kCauchy * kCauchy * scale * scale));
      a += w * r.effect * r.effect.transpose();
      b -= w * r.residual * r.effect;
    }
    x = a.ldlt().solve(b);
  }
  found.before = robust_scale(rows, Vec::Zero());
  found.after = robust_scale(rows, x);
  const Mat covariance = a.inverse();
  found.shift_in_camera = already + x.head<3>();
  found.sd = covariance.diagonal().head<3>().cwiseSqrt();
  const Mat3d information = covariance.topLeftCorner<3, 3>().inverse();
  found.chi2 = found.shift_in_camera.dot(information * found.shift_in_camera);
  const Eigen::Matrix<double, 2, 3> with_shift = covariance.block<2, 3>(3, 0);
  found.lights_covariance = with_shift * information * with_shift.transpose();
  return found;
}

double flash_factor(const Vec3d& place, const Vec3d& normal, const Vec3d& flash, const Vec3d& moved) {
  const Vec3d before = flash - place, after = moved - place;
  const double cosine = normal.dot(before) / std::pow(before.norm(), 3), now = normal.dot(after) / std::pow(after.norm(), 3);
  if (!(cosine > 0)) return 1;
  return std::clamp(now / cosine, 0.5, 2.0);
}

}  // namespace chiaro::optimize
