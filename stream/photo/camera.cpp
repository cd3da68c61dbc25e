#include "stream/photo/camera.h"

#include <Eigen/SVD>
#include <algorithm>
#include <cmath>
#include <cstring>
#include <limits>
#include <numbers>
#include <vector>

#include "stream/base/error.h"

namespace chiaro::stream {
namespace {

constexpr int kMaxSidePx = 1 << 20;
constexpr double kMaxTan2 = 1e8;  // tan^2 of the widest perspective ray that is looked at: 89.994 degrees
constexpr double kPlainRadius = 4999;   // below half of the largest: the search for the radius begins with its end
constexpr double kMaxTheta2 = std::numbers::pi * std::numbers::pi;
constexpr double kInfinity = std::numeric_limits<double>::infinity();

/// rho(s) = numerator(s) / denominator(s), s the squared radius; both start with 1.
struct Radial {
  std::array<double, 5> numerator{1, 0, 0, 0, 0};
  std::array<double, 4> denominator{1, 0, 0, 0};
  bool rational = false;
};

Radial radial_of(const Lens& lens) {
  Radial radial;
  if (lens.kind == LensKind::kFisheye) {
    std::copy_n(lens.k.begin(), 4, radial.numerator.begin() + 1);
    return radial;
  }
  radial.numerator = {1, lens.k[0], lens.k[1], lens.k[2], lens.k[6]};
  radial.denominator = {1, lens.k[3], lens.k[4], lens.k[5]};
  radial.rational = lens.k[3] != 0 || lens.k[4] != 0 || lens.k[5] != 0;
  return radial;
}

double value_of(const std::vector<double>& polynomial, double s) {
  double value = 0;
  for (std::size_t i = polynomial.size(); i-- > 0;) value = value * s + polynomial[i];
  return value;
}

/// All sign changes of a polynomial in (0, end), ascending: between neighbouring extrema it is monotone, so bisection finds each one.
std::vector<double> sign_changes(const std::vector<double>& polynomial, double end) {
  std::vector<double> roots;
  if (polynomial.size() < 2) return roots;
  std::vector<double> derivative(polynomial.size() - 1);
  for (std::size_t i = 1; i < polynomial.size(); ++i) derivative[i - 1] = polynomial[i] * static_cast<double>(i);
  std::vector<double> cuts = sign_changes(derivative, end);
  cuts.insert(cuts.begin(), 0.0);
  cuts.push_back(end);
  for (std::size_t i = 0; i + 1 < cuts.size(); ++i) {
    double lo = cuts[i], hi = cuts[i + 1];
    const bool positive = value_of(polynomial, lo) > 0;
    if ((value_of(polynomial, hi) > 0) == positive) continue;
    for (int step = 0; step < 200 && lo < hi; ++step) {
      const double middle = 0.5 * (lo + hi);
      if (middle <= lo || middle >= hi) break;
      ((value_of(polynomial, middle) > 0) == positive ? lo : hi) = middle;
    }
    roots.push_back(lo);
  }
  return roots;
}

/// Squared radius at which r rho(r^2) stops growing (the picture folds back), or infinity.
/// d(r rho)/dr has the sign of (N + 2 s N') D - 2 s N D', with D > 0.
double find_fold(const Radial& radial, double end) {
  const auto& n = radial.numerator;
  const auto& d = radial.denominator;
  std::vector<double> slope(n.size() + d.size() - 1, 0.0);
  for (std::size_t i = 0; i < n.size(); ++i)
    for (std::size_t j = 0; j < d.size(); ++j) slope[i + j] += n[i] * d[j] * (1 + 2 * static_cast<double>(i) - 2 * static_cast<double>(j));
  double fold = kInfinity;
  for (const std::vector<double>& polynomial : {slope, std::vector<double>(d.begin(), d.end())}) {
    const auto roots = sign_changes(polynomial, end);
    if (!roots.empty()) fold = std::min(fold, roots.front());
  }
  return fold;
}

/// find_fold() takes microseconds and is asked for each point, so each thread remembers the last few lenses.
double cached_fold(const Lens& lens, const Radial& radial) {
  struct Entry {
    std::array<double, 8> key{};
    double fold = 0;
    bool used = false;
  };
  thread_local std::array<Entry, 16> entries;
  std::array<double, 8> key{};
  std::copy(lens.k.begin(), lens.k.end(), key.begin());
  key[7] = static_cast<double>(lens.kind);
  std::uint64_t hash = 0;
  for (const double v : key) {
    std::uint64_t bits = 0;
    std::memcpy(&bits, &v, sizeof bits);
    hash = (hash ^ bits) * 0x9e3779b97f4a7c15ull;
  }
  Entry& entry = entries[hash >> 60];
  if (!entry.used || std::memcmp(entry.key.data(), key.data(), sizeof key) != 0) {
    entry.fold = find_fold(radial, lens.kind == LensKind::kFisheye ? kMaxTheta2 : kMaxTan2);
    entry.key = key;
    entry.used = true;
  }
  return entry.fold;
}

/// True while r rho grows on all of [0, s]. A plain polynomial is first bounded by its negative terms alone, which settles ordinary lenses.
bool grows_up_to(const Lens& lens, const Radial& radial, double s) {
  if (!radial.rational) {
    const auto& n = radial.numerator;
    const double falling = s * (std::min(3 * n[1], 0.0) + s * (std::min(5 * n[2], 0.0) + s * (std::min(7 * n[3], 0.0) + s * std::min(9 * n[4], 0.0))));
    if (1 + falling > 0) return true;
  }
  return s < cached_fold(lens, radial);
}

struct Distorted {
  double x = 0, y = 0;
  double xx = 1, xy = 0, yx = 0, yy = 1;  // Jacobian: d x_d / d x, d x_d / d y, ...
  double determinant() const { return xx * yy - xy * yx; }
};

bool has_tangential(const Lens& lens) { return lens.p[0] != 0 || lens.p[1] != 0; }

Distorted distort_radially(const Radial& radial, double x, double y) {
  const double s = x * x + y * y;
  const auto& n = radial.numerator;
  const auto& d = radial.denominator;
  const double num = 1 + s * (n[1] + s * (n[2] + s * (n[3] + s * n[4])));
  const double num_slope = n[1] + s * (2 * n[2] + s * (3 * n[3] + s * 4 * n[4]));
  double rho = num, rho_slope = num_slope;
  if (radial.rational) {
    const double den = 1 + s * (d[1] + s * (d[2] + s * d[3]));
    const double den_slope = d[1] + s * (2 * d[2] + s * 3 * d[3]);
    rho = num / den;
    rho_slope = (num_slope - rho * den_slope) / den;
  }
  Distorted out;
  out.x = x * rho;
  out.y = y * rho;
  out.xx = rho + 2 * x * x * rho_slope;
  out.xy = out.yx = 2 * x * y * rho_slope;
  out.yy = rho + 2 * y * y * rho_slope;
  return out;
}

Distorted distort(const Lens& lens, const Radial& radial, double x, double y) {
  Distorted out = distort_radially(radial, x, y);
  if (!has_tangential(lens)) return out;
  const double s = x * x + y * y;
  const auto [p1, p2, p3, p4] = lens.p;
  const double t = 1 + s * (p3 + s * p4), t_slope = p3 + 2 * s * p4;
  const double tx = 2 * p1 * x * y + p2 * (s + 2 * x * x), ty = p1 * (s + 2 * y * y) + 2 * p2 * x * y;
  const double cross = 2 * (p1 * x + p2 * y);
  out.x += tx * t;
  out.y += ty * t;
  out.xx += (2 * p1 * y + 6 * p2 * x) * t + tx * t_slope * 2 * x;
  out.xy += cross * t + tx * t_slope * 2 * y;
  out.yx += cross * t + ty * t_slope * 2 * x;
  out.yy += (6 * p1 * y + 2 * p2 * x) * t + ty * t_slope * 2 * y;
  return out;
}

bool in_range(const Lens& lens, const Radial& radial, double x, double y, const Distorted& distorted) {
  if (!grows_up_to(lens, radial, x * x + y * y)) return false;
  return !has_tangential(lens) || distorted.determinant() > 0;
}

/// Radius r with r rho(r^2) = wanted, by Newton inside a shrinking bracket; the fold (or a little inside it) where the lens never gets there.
double undistort_radius(const Lens& lens, const Radial& radial, double wanted) {
  const double fold = cached_fold(lens, radial);
  const double end = lens.kind == LensKind::kFisheye ? kMaxTheta2 : kMaxTan2;
  double lo = 0, hi = std::sqrt(std::min(fold, end));
  const auto distorted_radius = [&](double r, double& slope) {
    const Distorted d = distort_radially(radial, r, 0);
    slope = d.xx;
    return d.x;
  };
  double slope = 0;
  if (!(distorted_radius(hi * (1 - 1e-12), slope) > wanted)) return hi * 0.999;
  double r = std::min(wanted, 0.5 * hi);
  for (int step = 0; step < 200; ++step) {
    const double error = distorted_radius(r, slope) - wanted;
    if (error == 0) break;
    (error > 0 ? hi : lo) = r;
    double next = r - error / slope;
    if (!(next > lo && next < hi)) next = 0.5 * (lo + hi);
    if (next == r) break;
    r = next;
  }
  return r;
}

}  // namespace

bool is_pinhole(const Lens& lens) {
  const auto is_zero = [](double v) { return v == 0; };
  return lens.kind == LensKind::kPerspective && std::all_of(lens.k.begin(), lens.k.end(), is_zero) && std::all_of(lens.p.begin(), lens.p.end(), is_zero);
}

std::optional<Vec2d> project(const Lens& lens, const Vec3d& p_in_camera) {
  double x = 0, y = 0;
  const double z = p_in_camera.z();
  if (lens.kind == LensKind::kPerspective) {
    if (!(z > 0)) return std::nullopt;
    x = p_in_camera.x() / z;
    y = p_in_camera.y() / z;
  } else {
    const double across = std::hypot(p_in_camera.x(), p_in_camera.y());
    if (!(across > 0) && !(z > 0)) return std::nullopt;
    const double scale = across > 0 ? std::atan2(across, z) / across : 0;
    x = p_in_camera.x() * scale;
    y = p_in_camera.y() * scale;
  }
  const Radial radial = radial_of(lens);
  const Distorted distorted = distort(lens, radial, x, y);
  if (!in_range(lens, radial, x, y, distorted)) return std::nullopt;
  const Vec2d pixel(lens.cx + lens.fx * distorted.x + lens.skew * distorted.y, lens.cy + lens.fy * distorted.y);
  if (!pixel.allFinite()) return std::nullopt;
  return pixel;
}

std::optional<Vec3d> unproject(const Lens& lens, const Vec2d& pixel) {
  constexpr double kTolerance = 1e-10;
  const double y_wanted = (pixel.y() - lens.cy) / lens.fy, x_wanted = (pixel.x() - lens.cx - lens.skew * y_wanted) / lens.fx;
  if (std::abs(x_wanted) + std::abs(y_wanted) < kPlainRadius && is_pinhole(lens)) return Vec3d(x_wanted, y_wanted, 1).normalized();   // what the search below ends with, to the bit
  const double r_wanted = std::hypot(x_wanted, y_wanted);
  if (!std::isfinite(r_wanted)) return std::nullopt;
  const Radial radial = radial_of(lens);
  const double scale = r_wanted > 0 ? undistort_radius(lens, radial, r_wanted) / r_wanted : 1;
  double x = x_wanted * scale, y = y_wanted * scale;
  Distorted distorted = distort(lens, radial, x, y);
  double error = std::hypot(distorted.x - x_wanted, distorted.y - y_wanted);
  for (int step = 0; step < 50 && error > 0; ++step) {
    const double dx = distorted.x - x_wanted, dy = distorted.y - y_wanted, det = distorted.determinant();
    if (!(std::abs(det) > 0)) break;
    double step_x = (distorted.yy * dx - distorted.xy * dy) / det, step_y = (distorted.xx * dy - distorted.yx * dx) / det;
    bool better = false;
    for (int halving = 0; halving < 20 && !better; ++halving, step_x *= 0.5, step_y *= 0.5) {
      const Distorted trial = distort(lens, radial, x - step_x, y - step_y);
      const double trial_error = std::hypot(trial.x - x_wanted, trial.y - y_wanted);
      if (!(trial_error < error)) continue;
      better = true;
      x -= step_x;
      y -= step_y;
      distorted = trial;
      error = trial_error;
    }
    if (!better) break;
  }
  if (!(error <= kTolerance * (1 + r_wanted)) || !in_range(lens, radial, x, y, distorted)) return std::nullopt;
  if (lens.kind == LensKind::kPerspective) return Vec3d(x, y, 1).normalized();
  const double theta = std::hypot(x, y);
  if (theta > std::numbers::pi) return std::nullopt;
  const double sinc = theta > 0 ? std::sin(theta) / theta : 1;
  return Vec3d(x * sinc, y * sinc, std::cos(theta));
}

double blur_px(const Camera& camera, double depth_along_axis) {
  const Focus& focus = camera.focus;
  if (!(focus.aperture > 0 && depth_along_axis > 0)) return 0;
  return focus.aperture * 0.5 * (camera.lens.fx + camera.lens.fy) * std::abs(1 / focus.distance - 1 / depth_along_axis);
}

void check_camera(Camera& camera, const std::string& where) {
  const auto fail = [&](const auto&... what) { throw Error(concat(where, ": camera \"", camera.photograph, "\": ", what...)); };
  const Lens& lens = camera.lens;
  if (lens.width_px <= 0 || lens.height_px <= 0 || lens.width_px > kMaxSidePx || lens.height_px > kMaxSidePx)
    fail("size ", lens.width_px, " x ", lens.height_px, " pixels, expected 1 to ", kMaxSidePx);
  if (!(lens.fx > 0) || !(lens.fy > 0) || !std::isfinite(lens.fx) || !std::isfinite(lens.fy))
    fail("focal length ", lens.fx, ", ", lens.fy, " pixels, expected positive numbers");
  for (const double v : {lens.cx, lens.cy, lens.skew})
    if (!std::isfinite(v)) fail("principal point or skew is not finite");
  for (const double v : lens.k)
    if (!std::isfinite(v)) fail("radial distortion is not finite");
  for (const double v : lens.p)
    if (!std::isfinite(v)) fail("tangential distortion is not finite");
  const Focus& focus = camera.focus;
  if (!(focus.aperture >= 0 && std::isfinite(focus.aperture)) || (focus.aperture > 0 && !(focus.distance > 0)))
    fail("focus: aperture ", focus.aperture, " at distance ", focus.distance, ", expected an aperture of 0 or more and a distance above 0");
  Mat3d& rotation = camera.pose.rotation_camera_from_world;
  if (!rotation.allFinite() || !camera.pose.translation_camera_from_world.allFinite()) fail("its pose is not finite");
  const double deviation = (rotation * rotation.transpose() - Mat3d::Identity()).cwiseAbs().maxCoeff();
  if (!(deviation <= 1e-4)) fail("rotation is not orthonormal: R R^T differs from 1 by ", deviation);
  if (!(rotation.determinant() > 0)) fail("rotation mirrors: determinant ", rotation.determinant(), ", expected 1");
  const Eigen::JacobiSVD<Mat3d> svd(rotation, Eigen::ComputeFullU | Eigen::ComputeFullV);
  rotation = svd.matrixU() * svd.matrixV().transpose();
}

Lens scaled_to(const Lens& lens, int width_px, int height_px, const std::string& where) {
  if (width_px <= 0 || height_px <= 0 || lens.width_px <= 0 || lens.height_px <= 0)
    throw Error(concat(where, ": size ", width_px, " x ", height_px, " cannot be matched with a lens of ", lens.width_px, " x ", lens.height_px, " pixels"));
  const double scale_x = static_cast<double>(width_px) / lens.width_px, scale_y = static_cast<double>(height_px) / lens.height_px;
  // Each side is within a pixel of a proportion that both share.
  const bool in_proportion = std::max((width_px - 1.0) / lens.width_px, (height_px - 1.0) / lens.height_px) <= std::min((width_px + 1.0) / lens.width_px, (height_px + 1.0) / lens.height_px);
  constexpr double kLeastScaling = 0.02;
  const bool same = width_px == lens.width_px && height_px == lens.height_px;
  if (!in_proportion || (!same && std::max(std::abs(scale_x - 1), std::abs(scale_y - 1)) < kLeastScaling))
    throw Error(concat(where, ": is ", width_px, " x ", height_px, " pixels, but its camera was calibrated for ", lens.width_px, " x ", lens.height_px,
                       ": no copy in another size (rotated, cropped, with a border, undistorted, or RAW where the camera is that of smaller JPEGs?)"));
  Lens out = lens;
  out.width_px = width_px;
  out.height_px = height_px;
  out.fx *= scale_x;
  out.cx *= scale_x;
  out.skew *= scale_x;
  out.fy *= scale_y;
  out.cy *= scale_y;
  return out;
}

Lens lens_of_cells(const Lens& lens, int cell_px) {
  Lens out = lens;
  out.width_px /= cell_px;
  out.height_px /= cell_px;
  for (double* v : {&out.fx, &out.fy, &out.cx, &out.cy, &out.skew}) *v /= cell_px;
  return out;
}

}  // namespace chiaro::stream
