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
double variance_share(double number) { return (number + 1) / std::max(1.0, number - 2); }

// What eigenvalues_of() does for the smallest one, of all lanes side by side: a step waits for the one before. Each lane stops by itself, so that it does not
// matter which are taken together.
template <std::size_t N>
CHIARO_INLINE void smallest_roots(const LanePlanes::Row& constant, const LanePlanes::Row& linear, LanePlanes::Row& roots) {
  using Doubles = typename LaneTypes<N>::Doubles;
  constexpr std::size_t kGroups = kLanes / N;
  const Doubles zero{}, one = zero + 1.0;
  Doubles c0[kGroups], c1[kGroups], root[kGroups] = {}, goes_on[kGroups];
  for (std::size_t g = 0; g < kGroups; ++g) {
    load(&constant[g * N], c0[g]);
    load(&linear[g * N], c1[g]);
    goes_on[g] = one;
  }
  for (int i = 0; i < kMostSteps; ++i) {
    Doubles any = zero;
    for (std::size_t g = 0; g < kGroups; ++g) {
      const Doubles slope = c1[g] + root[g] * (3.0 * root[g] - 2.0);
      Doubles step = (c0[g] - root[g] * (c1[g] + root[g] * (root[g] - 1.0))) / slope;
      step = slope > zero + kFlat ? step : zero;
      step *= goes_on[g];
      root[g] += step;
      goes_on[g] = step > kStepShare * root[g] ? one : zero;
      any += goes_on[g];
    }
    double left[N], sum = 0;
    store(any, left);
    for (const double l : left) sum += l;
    if (sum == 0) break;
  }
  for (std::size_t g = 0; g < kGroups; ++g) store(root[g], &roots[g * N]);
}

// N planes: what plane_of() does up to the eigenvalues.
template <std::size_t N>
CHIARO_INLINE void covariances_of_some(const LaneMoments& sums, std::size_t first, LanePlanes& out, LanePlanes::Row& constant, LanePlanes::Row& linear) {
  using Floats = typename LaneTypes<N>::Floats;
  using Doubles = typename LaneTypes<N>::Doubles;
  Doubles m[kTerms];
  for (std::size_t t = 0; t < kTerms; ++t) {
    Floats f;
    load(&sums.sum[t][first], f);
    m[t] = __builtin_convertvector(f, Doubles);
  }
  const Doubles share = 1.0 / m[9];
  for (std::size_t t = 0; t < 9; ++t) m[t] *= share;
  Doubles c[6] = {m[3] - m[0] * m[0], m[4] - m[0] * m[1], m[5] - m[0] * m[2], m[6] - m[1] * m[1], m[7] - m[1] * m[2], m[8] - m[2] * m[2]};
  const Doubles scale = c[0] + c[3] + c[5], over = 1.0 / scale;
  for (Doubles& v : c) v *= over;
  const Doubles c1 = c[0] * c[3] - c[1] * c[1] + c[0] * c[5] - c[2] * c[2] + c[3] * c[5] - c[4] * c[4];
  const Doubles c0 = c[0] * (c[3] * c[5] - c[4] * c[4]) - c[1] * (c[1] * c[5] - c[4] * c[2]) + c[2] * (c[1] * c[4] - c[3] * c[2]);
  store(c0, &constant[first]);
  store(c1, &linear[first]);
  store(scale, &out.scale[first]);
  for (std::size_t a = 0; a < 3; ++a) store(m[a], &out.mean[a][first]);
  for (std::size_t t = 0; t < 6; ++t) store(c[t], &out.covariance[t][first]);
}

// The rest of it.
template <std::size_t N>
CHIARO_INLINE void judge_some(const LaneMoments& sums, std::size_t first, const LanePlanes::Row& linear, LanePlanes& out) {
  using Floats = typename LaneTypes<N>::Floats;
  using Doubles = typename LaneTypes<N>::Doubles;
  using Mask = typename LaneTypes<N>::DoubleMask;
  Floats counted;
  load(&sums.sum[9][first], counted);
  Doubles root, scale, c1;
  load(&out.root[first], root);
  load(&out.scale[first], scale);
  load(&linear[first], c1);
  const Doubles zero{}, one = zero + 1.0, all = __builtin_convertvector(counted, Doubles), number = all - 1.0, freedom = number - 2.0, lowest = root > zero ? root : zero;
  // Of two numbers with this sum and product, the smaller is at least kLine of the larger if product / sum^2 is at least kLine / (1 + kLine)^2.
  const Doubles sum = 1.0 - root, product = c1 - root * sum, least = (kLine / ((1 + kLine) * (1 + kLine))) * sum * sum;
  const Mask sure = (number >= zero + kEnoughForPlane) & (scale > zero) & (product >= least);
  for (std::size_t k = 0; k < N; ++k) out.sure[first + k] = sure[k] != 0;
  const Doubles variance_off = lowest * scale * (all / (freedom > one ? freedom : one));
  store(variance_off, &out.variance_off[first]);
}

// N normals: what normal_of() does, but for their length.
template <std::size_t N>
CHIARO_INLINE void normals_of_some(const LanePlanes& planes, std::size_t first, LaneNormals& out) {
  using Doubles = typename LaneTypes<N>::Doubles;
  using Mask = typename LaneTypes<N>::DoubleMask;
  Doubles c[6], root, mean[3], scale;
  for (std::size_t t = 0; t < 6; ++t) load(&planes.covariance[t][first], c[t]);
  for (std::size_t a = 0; a < 3; ++a) load(&planes.mean[a][first], mean[a]);
  load(&planes.root[first], root);
  load(&planes.scale[first], scale);
  const Doubles xx = c[0] - root, yy = c[3] - root, zz = c[5] - root;
  // Products of two columns lie along the axis; the longest is the surest.
  const Doubles products[3][3] = {{c[1] * c[4] - c[2] * yy, c[2] * c[1] - xx * c[4], xx * yy - c[1] * c[1]},
                                  {c[1] * zz - c[2] * c[4], c[2] * c[2] - xx * zz, xx * c[4] - c[1] * c[2]},
                                  {yy * zz - c[4] * c[4], c[4] * c[2] - c[1] * zz, c[1] * c[4] - yy * c[2]}};
  Doubles x{}, y{}, z{}, best = Doubles{} - 1.0;
  for (const auto& p : products) {
    const Doubles squared = p[0] * p[0] + p[1] * p[1] + p[2] * p[2];
    const Mask longer = squared > best;
    x = longer ? p[0] : x;
    y = longer ? p[1] : y;
    z = longer ? p[2] : z;
    best = longer ? squared : best;
  }
  const Doubles zero{}, outwards = -(x * mean[0] + y * mean[1] + z * mean[2]);
  const Doubles side = outwards * outwards > (kOutwards * kOutwards) * scale * best ? outwards : z;
  x = side < zero ? -x : x;
  y = side < zero ? -y : y;
  z = side < zero ? -z : z;
  double length_squared[N];
  store(best, length_squared);
  for (std::size_t k = 0; k < N; ++k) out.clear[first + k] = length_squared[k] > kClear;
  store(x, &out.x[first]);
  store(y, &out.y[first]);
  store(z, &out.z[first]);
}

template <std::size_t N>
CHIARO_INLINE void planes_body(const LaneMoments& sums, LanePlanes& out) {
  LanePlanes::Row constant, linear;
  for (std::size_t first = 0; first < kLanes; first += N) covariances_of_some<N>(sums, first, out, constant, linear);
  smallest_roots<N>(constant, linear, out.root);
  for (std::size_t first = 0; first < kLanes; first += N) judge_some<N>(sums, first, linear, out);
}
template <std::size_t N>
CHIARO_INLINE void normals_body(const LanePlanes& planes, LaneNormals& out) {
  for (std::size_t first = 0; first < kLanes; first += N) normals_of_some<N>(planes, first, out);
}

#if defined(CHIARO_AVX2)
CHIARO_AVX2 void planes_avx2(const LaneMoments& sums, LanePlanes& out) { planes_body<4>(sums, out); }
CHIARO_AVX2 void normals_avx2(const LanePlanes& planes, LaneNormals& out) { normals_body<4>(planes, out); }
CHIARO_AVX512 void planes_avx512(const LaneMoments& sums, LanePlanes& out) { planes_body<8>(sums, out); }
CHIARO_AVX512 void normals_avx512(const LanePlanes& planes, LaneNormals& out) { normals_body<8>(planes, out); }
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

void LanePlanes::take(std::size_t lane, const LanePlanes& from) {
  sure[lane] = from.sure[lane];
  variance_off[lane] = from.variance_off[lane];
  root[lane] = from.root[lane];
  scale[lane] = from.scale[lane];
  for (std::size_t a = 0; a < mean.size(); ++a) mean[a][lane] = from.mean[a][lane];
  for (std::size_t t = 0; t < covariance.size(); ++t) covariance[t][lane] = from.covariance[t][lane];
}

void planes_of(const LaneMoments& sums, LanePlanes& planes) {
#if defined(CHIARO_AVX2)
  if (vector_width() == VectorWidth::kAvx512) return planes_avx512(sums, planes);
  if (vector_width() == VectorWidth::kAvx2) return planes_avx2(sums, planes);
#endif
  planes_body<4>(sums, planes);
}

void normals_of(const LanePlanes& planes, LaneNormals& normals) {
#if defined(CHIARO_AVX2)
  if (vector_width() == VectorWidth::kAvx512) return normals_avx512(planes, normals);
  if (vector_width() == VectorWidth::kAvx2) return normals_avx2(planes, normals);
#endif
  normals_body<4>(planes, normals);
}

}  // namespace chiaro::stream
