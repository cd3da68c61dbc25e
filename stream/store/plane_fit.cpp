#include "stream/store/plane_fit.h"

#include <Eigen/Eigenvalues>
#include <algorithm>
#include <array>
#include <cmath>

#include "stream/store/lanes.h"

namespace chiaro::stream {
namespace {

constexpr int kMostSteps = 30;
constexpr double kFlat = 1e-12;       // of the polynomial: two roots fall together
constexpr double kStepShare = 1e-5;   // the next step would be about the square of it
constexpr double kLine = 0.01;        // second of the largest eigenvalue
constexpr double kOutwards = 1e-9;
constexpr double kClear = 1e-14;

/// Eigenvalues of a symmetric matrix of trace 1 that has none below zero, smallest first.
///
/// The smallest root of the characteristic polynomial by Newton's method: the polynomial rises and is concave up to it, so steps from 0 never pass it.
Vec3d eigenvalues_of(const Mat3d& a) {
  const double c1 = a(0, 0) * a(1, 1) - a(0, 1) * a(0, 1) + a(0, 0) * a(2, 2) - a(0, 2) * a(0, 2) + a(1, 1) * a(2, 2) - a(1, 2) * a(1, 2);
  const double c0 = a.determinant();
  double root = 0;
  for (int i = 0; i < kMostSteps; ++i) {
    const double slope = c1 + root * (3 * root - 2);
    if (!(slope > kFlat)) break;
    const double step = (c0 - root * (c1 + root * (root - 1))) / slope;
    root += step;
    if (!(step > kStepShare * root)) break;
  }
  const double sum = 1 - root, product = std::max(0.0, c1 - root * sum);
  const double largest = 0.5 * (sum + std::sqrt(std::max(0.0, sum * sum - 4 * product)));
  return {root, product / largest, largest};
}

// Much faster than a general solver; where two roots fall together the axis is not defined well and the general solver decides.
Vec3d smallest_axis_of(const Mat3d& a, double root) {
  Mat3d b = a;
  for (int i = 0; i < 3; ++i) b(i, i) -= root;
  const Vec3d crosses[3] = {b.col(0).cross(b.col(1)), b.col(0).cross(b.col(2)), b.col(1).cross(b.col(2))};
  const double norms[3] = {crosses[0].squaredNorm(), crosses[1].squaredNorm(), crosses[2].squaredNorm()};
  const std::size_t best = norms[0] >= norms[1] ? (norms[0] >= norms[2] ? 0 : 2) : (norms[1] >= norms[2] ? 1 : 2);
  if (norms[best] > kClear) return crosses[best] / std::sqrt(norms[best]);
  return Eigen::SelfAdjointEigenSolver<Mat3d>(a).eigenvectors().col(0);
}

// With the plane's three degrees of freedom taken off.
CHIARO_INLINE double variance_share(double number) { return (number + 1) / std::max(1.0, number - 2); }

// Four planes: what plane_of() does.
CHIARO_INLINE void planes_of_half(const EightMoments& sums, std::size_t first, EightPlanes& out) {
  HalfLanes m[kTerms];
  for (std::size_t t = 0; t < kTerms; ++t)
    for (std::size_t i = 0; i < 4; ++i) m[t][i] = static_cast<double>(sums.sum[t][first + i]);
  const HalfLanes zero{}, number = m[9] - 1.0, share = 1.0 / m[9];
  for (std::size_t t = 0; t < 9; ++t) m[t] *= share;
  HalfLanes c[6] = {m[3] - m[0] * m[0], m[4] - m[0] * m[1], m[5] - m[0] * m[2], m[6] - m[1] * m[1], m[7] - m[1] * m[2], m[8] - m[2] * m[2]};
  const HalfLanes scale = c[0] + c[3] + c[5], over = 1.0 / scale;
  for (HalfLanes& v : c) v *= over;
  const HalfLanes c1 = c[0] * c[3] - c[1] * c[1] + c[0] * c[5] - c[2] * c[2] + c[3] * c[5] - c[4] * c[4];
  const HalfLanes c0 = c[0] * (c[3] * c[5] - c[4] * c[4]) - c[1] * (c[1] * c[5] - c[4] * c[2]) + c[2] * (c[1] * c[4] - c[3] * c[2]);
  HalfLanes root = zero;
  for (int i = 0; i < kMostSteps; ++i) {
    const HalfLanes slope = c1 + root * (3.0 * root - 2.0);
    const HalfLaneMask rising = slope > zero + kFlat;
    HalfLanes step = (c0 - root * (c1 + root * (root - 1.0))) / slope;
    step = rising ? step : zero;
    root += step;
    const HalfLaneMask going = step > kStepShare * root;
    if ((going[0] | going[1] | going[2] | going[3]) == 0) break;
  }
  const HalfLanes sum = 1.0 - root, product = c1 - root * sum, discriminant = sum * sum - 4.0 * product;
  for (std::size_t i = 0; i < 4; ++i) {
    const double largest = 0.5 * (sum[i] + std::sqrt(std::max(0.0, discriminant[i])));
    out.sure[first + i] = number[i] >= kEnoughForPlane && scale[i] > 0 && product[i] >= kLine * largest * largest;
    out.variance_off[first + i] = std::max(0.0, root[i]) * scale[i] * variance_share(number[i]);
  }
  store(root, &out.root[first]);
  store(scale, &out.scale[first]);
  for (std::size_t a = 0; a < 3; ++a) store(m[a], &out.mean[a][first]);
  for (std::size_t t = 0; t < 6; ++t) store(c[t], &out.covariance[t][first]);
}

CHIARO_INLINE void planes_body(const EightMoments& sums, EightPlanes& out) {
  planes_of_half(sums, 0, out);
  planes_of_half(sums, 4, out);
}

// Four normals: what normal_of() does.
CHIARO_INLINE void normals_of_half(const EightPlanes& planes, std::size_t first, EightNormals& out) {
  HalfLanes c[6], root;
  for (std::size_t t = 0; t < 6; ++t) load(&planes.covariance[t][first], c[t]);
  load(&planes.root[first], root);
  const HalfLanes xx = c[0] - root, yy = c[3] - root, zz = c[5] - root;
  // Products of two columns lie along the axis; the longest is the surest.
  const HalfLanes products[3][3] = {{c[1] * c[4] - c[2] * yy, c[2] * c[1] - xx * c[4], xx * yy - c[1] * c[1]},
                                    {c[1] * zz - c[2] * c[4], c[2] * c[2] - xx * zz, xx * c[4] - c[1] * c[2]},
                                    {yy * zz - c[4] * c[4], c[4] * c[2] - c[1] * zz, c[1] * c[4] - yy * c[2]}};
  HalfLanes x{}, y{}, z{}, best = HalfLanes{} - 1.0;
  for (const auto& p : products) {
    const HalfLanes squared = p[0] * p[0] + p[1] * p[1] + p[2] * p[2];
    const HalfLaneMask longer = squared > best;
    x = longer ? p[0] : x;
    y = longer ? p[1] : y;
    z = longer ? p[2] : z;
    best = longer ? squared : best;
  }
  for (std::size_t i = 0; i < 4; ++i) {
    const double over = 1 / std::sqrt(best[i]), nx = x[i] * over, ny = y[i] * over, nz = z[i] * over;
    const double outwards = -(nx * planes.mean[0][first + i] + ny * planes.mean[1][first + i] + nz * planes.mean[2][first + i]);
    const bool flip = std::abs(outwards) > kOutwards * std::sqrt(planes.scale[first + i]) ? outwards < 0 : nz < 0;
    out.x[first + i] = flip ? -nx : nx;
    out.y[first + i] = flip ? -ny : ny;
    out.z[first + i] = flip ? -nz : nz;
    out.clear[first + i] = best[i] > kClear;
  }
}

CHIARO_INLINE void normals_body(const EightPlanes& planes, EightNormals& out) {
  normals_of_half(planes, 0, out);
  normals_of_half(planes, 4, out);
}

#if defined(CHIARO_AVX2)
CHIARO_AVX2 void planes_avx2(const EightMoments& sums, EightPlanes& out) { planes_body(sums, out); }
CHIARO_AVX2 void normals_avx2(const EightPlanes& planes, EightNormals& out) { normals_body(planes, out); }
#endif

}  // namespace

Vec3f across(const Vec3f& v) {
  const Vec3f axis = std::abs(v.z()) < 0.9f * v.norm() ? Vec3f::UnitZ() : Vec3f::UnitX();
  return v.cross(axis).normalized();
}

Plane plane_of(const Moments& sums) {
  Plane plane;
  const double n = sums[9];
  if (n < 3) return plane;
  std::array<double, 9> m;
  const double share = 1 / (n + 1);  // the point itself is the origin
  for (std::size_t i = 0; i < 9; ++i) m[i] = sums[i] * share;
  plane.covariance << m[3] - m[0] * m[0], m[4] - m[0] * m[1], m[5] - m[0] * m[2],
                      m[4] - m[0] * m[1], m[6] - m[1] * m[1], m[7] - m[1] * m[2],
                      m[5] - m[0] * m[2], m[7] - m[1] * m[2], m[8] - m[2] * m[2];
  plane.scale = plane.covariance.trace();
  if (!(plane.scale > 0)) return plane;
  plane.covariance *= 1 / plane.scale;
  plane.mean = {m[0], m[1], m[2]};
  plane.values = eigenvalues_of(plane.covariance);
  plane.line = plane.values[1] < kLine * plane.values[2];
  plane.isolated = plane.values[1] < 1e-4 * plane.values[2];
  plane.variance_off = std::max(0.0, plane.values[0]) * plane.scale * variance_share(n);
  return plane;
}

NormalFit normal_of(const Plane& plane) {
  NormalFit fit;
  fit.isolated = plane.isolated;
  if (!(plane.scale > 0)) return fit;
  if (plane.isolated) {
    fit.normal = across(Eigen::SelfAdjointEigenSolver<Mat3d>(plane.covariance).eigenvectors().col(2).cast<float>());
    return fit;
  }
  const Vec3d normal = smallest_axis_of(plane.covariance, plane.values[0]);
  const double outwards = -normal.dot(plane.mean);
  const bool flip = std::abs(outwards) > kOutwards * std::sqrt(plane.scale) ? outwards < 0 : normal.z() < 0;
  fit.normal = (flip ? -normal : normal).normalized().cast<float>();
  return fit;
}

void EightPlanes::take(std::size_t lane, const EightPlanes& from) {
  sure[lane] = from.sure[lane];
  variance_off[lane] = from.variance_off[lane];
  root[lane] = from.root[lane];
  scale[lane] = from.scale[lane];
  for (std::size_t a = 0; a < mean.size(); ++a) mean[a][lane] = from.mean[a][lane];
  for (std::size_t t = 0; t < covariance.size(); ++t) covariance[t][lane] = from.covariance[t][lane];
}

EightPlanes planes_of(const EightMoments& sums) {
  EightPlanes planes;
#if defined(CHIARO_AVX2)
  if (wide_vectors()) {
    planes_avx2(sums, planes);
    return planes;
  }
#endif
  planes_body(sums, planes);
  return planes;
}

EightNormals normals_of(const EightPlanes& planes) {
  EightNormals normals;
#if defined(CHIARO_AVX2)
  if (wide_vectors()) {
    normals_avx2(planes, normals);
    return normals;
  }
#endif
  normals_body(planes, normals);
  return normals;
}

}  // namespace chiaro::stream
