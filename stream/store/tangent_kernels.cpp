#include "stream/store/tangent_kernels.h"

#include <algorithm>
#include <cmath>
#include <limits>

#include "stream/store/lanes.h"

namespace chiaro::stream {
namespace {

constexpr float kInfinity = std::numeric_limits<float>::infinity();
constexpr float kBeyond = 1.00001f;

template <class Mask>
CHIARO_INLINE bool any_of(const Mask& mask) {
  std::uint64_t words[sizeof(Mask) / 8], all = 0;
  __builtin_memcpy(words, &mask, sizeof mask);
  for (const std::uint64_t word : words) all |= word;
  return all != 0;
}

template <class Floats>
CHIARO_INLINE void absolute_of(const Floats& v, Floats& out) {
  out = v < Floats{} ? -v : v;
}

// What the bodies below compute for a neighbour; with the same operations in the same order.
bool lines_plain(const CandidateView& c, const Place& p, float above, float limit, const TangentFrame& f, TangentLines& out) {
  const float reach = f.edge_reach * f.edge_reach;
  bool edge = false;
  std::size_t n = out.num;
  for (std::size_t k = 0; k < c.num; ++k) {
    const float x = c.x[k] - p[0], y = c.y[k] - p[1], z = c.z[k] - p[2], d = x * x + y * y + z * z;
    if (!(d <= limit && d > above)) continue;
    const float cosine = f.normal[0] * c.nx[k] + f.normal[1] * c.ny[k] + f.normal[2] * c.nz[k], size = std::abs(cosine);
    edge |= size < f.other_face && d <= reach;
    const float towards = f.oriented && c.oriented[k] != 0 ? cosine : size, height = f.normal[0] * x + f.normal[1] * y + f.normal[2] * z;
    const bool holds = 4 * height * height <= d && towards >= 0.5f;
    const float over = 2 / d;
    out.u[n] = f.u[0] * x + f.u[1] * y + f.u[2] * z;
    out.v[n] = f.v[0] * x + f.v[1] * y + f.v[2] * z;
    out.wx[n] = holds ? out.u[n] * over : 0;
    out.wy[n] = holds ? out.v[n] * over : 0;
    ++n;
  }
  out.num = n;
  return !edge;
}

// Offsets of those near, where u, v and wx will stand.
std::size_t offsets_plain(const CandidateView& c, const Place& p, float above, float limit, TangentLines& out) {
  std::size_t n = out.num;
  for (std::size_t k = 0; k < c.num; ++k) {
    const float x = c.x[k] - p[0], y = c.y[k] - p[1], z = c.z[k] - p[2], d = x * x + y * y + z * z;
    out.u[n] = x;
    out.v[n] = y;
    out.wx[n] = z;
    n += static_cast<std::size_t>(d <= limit) & static_cast<std::size_t>(d > above);
  }
  return n;
}

// Lines of these.
template <std::size_t N>
CHIARO_INLINE void project_body(std::size_t last, const TangentFrame& f, TangentLines& out) {
  using Floats = typename LaneTypes<N>::Floats;
  using Mask = typename LaneTypes<N>::Mask;
  for (std::size_t k = out.num; k < last; k += N) {
    Floats x, y, z;
    load(&out.u[k], x);
    load(&out.v[k], y);
    load(&out.wx[k], z);
    const Floats d = x * x + y * y + z * z, height = f.normal[0] * x + f.normal[1] * y + f.normal[2] * z, over = 2.0f / d;
    const Floats u = f.u[0] * x + f.u[1] * y + f.u[2] * z, v = f.v[0] * x + f.v[1] * y + f.v[2] * z, wx = u * over, wy = v * over;
    const Mask holds = 4.0f * height * height <= d;
    store(u, &out.u[k]);
    store(v, &out.v[k]);
    store(Floats(holds ? wx : Floats{}), &out.wx[k]);
    store(Floats(holds ? wy : Floats{}), &out.wy[k]);
  }
  out.num = last;
}

template <std::size_t N>
CHIARO_INLINE bool alike_body(const CandidateView& c, const Place& n, float least) {
  using Floats = typename LaneTypes<N>::Floats;
  using Mask = typename LaneTypes<N>::Mask;
  Mask turned{};
  const Floats limit = Floats{} + least;
  std::size_t k = 0;
  for (; k + N <= c.num; k += N) {
    Floats x, y, z, size;
    Mask oriented;
    load(c.nx + k, x);
    load(c.ny + k, y);
    load(c.nz + k, z);
    load(c.oriented + k, oriented);
    const Floats cosine = n[0] * x + n[1] * y + n[2] * z;
    absolute_of(cosine, size);
    turned |= ~((oriented ? cosine : size) >= limit);
  }
  bool all = !any_of(turned);
  for (; k < c.num; ++k) {
    const float cosine = n[0] * c.nx[k] + n[1] * c.ny[k] + n[2] * c.nz[k];
    all = all && (c.oriented[k] != 0 ? cosine : std::abs(cosine)) >= least;
  }
  return all;
}

template <std::size_t N>
CHIARO_INLINE bool beyond_body(const TangentLines& lines, float x, float y, float distance) {
  using Floats = typename LaneTypes<N>::Floats;
  typename LaneTypes<N>::Mask found{};
  const Floats far = Floats{} + distance;
  for (std::size_t k = 0; k < lines.num; k += N) {
    Floats u, v, aside;
    load(&lines.u[k], u);
    load(&lines.v[k], v);
    absolute_of(v * x - u * y, aside);
    found |= (u * x + v * y >= far) & (aside <= far);
  }
  return any_of(found);
}

std::size_t line_before_plain(const TangentLines& lines, float x, float y) {
  float best = kBeyond;
  std::size_t at = lines.num;
  for (std::size_t lane = 0; lane < kLanes; ++lane)
    for (std::size_t k = lane; k < lines.num; k += kLanes) {
      const float along = lines.wx[k] * x + lines.wy[k] * y;
      at = along > best ? k : at;
      best = along > best ? along : best;
    }
  return at;
}

constexpr float kD1 = 0.92387953f, kD2 = 0.70710678f, kD3 = 0.38268343f;
constexpr float kCos[CellCorners::kDirections] = {1, kD1, kD2, kD3, 0, -kD3, -kD2, -kD1, -1, -kD1, -kD2, -kD3, 0, kD3, kD2, kD1};
constexpr float kSin[CellCorners::kDirections] = {0, kD3, kD2, kD1, 1, kD1, kD2, kD3, 0, -kD3, -kD2, -kD1, -1, -kD1, -kD2, -kD3};
// The side of a square that is met first.
constexpr float kSquareX[CellCorners::kDirections] = {1, 1, 1, 0, 0, 0, -1, -1, -1, -1, -1, 0, 0, 0, 1, 1};
constexpr float kSquareY[CellCorners::kDirections] = {0, 0, 0, 1, 1, 1, 0, 0, 0, 0, 0, -1, -1, -1, 0, 0};

// What has the largest product with a direction is met first.
template <std::size_t N>
CHIARO_INLINE void directions_body(const TangentLines& lines, float half, CellCorners& out) {
  using Floats = typename LaneTypes<N>::Floats;
  using Mask = typename LaneTypes<N>::Mask;
  for (std::size_t first = 0; first < CellCorners::kDirections; first += N) {
    Floats c, s, best_x, best_y;
    load(kCos + first, c);
    load(kSin + first, s);
    load(kSquareX + first, best_x);
    load(kSquareY + first, best_y);
    best_x *= 1 / half;
    best_y *= 1 / half;
    Floats best = c * best_x + s * best_y;
    for (std::size_t k = 0; k < lines.num; ++k) {
      const float wx = lines.wx[k], wy = lines.wy[k];
      const Floats along = c * wx + s * wy;
      const Mask nearer = along > best;
      best = nearer ? along : best;
      best_x = nearer ? Floats{} + wx : best_x;
      best_y = nearer ? Floats{} + wy : best_y;
    }
    store(best_x, &out.ax[first]);
    store(best_y, &out.ay[first]);
  }
}

template <std::size_t N>
CHIARO_INLINE void corners_body(CellCorners& out) {
  using Floats = typename LaneTypes<N>::Floats;
  using Mask = typename LaneTypes<N>::Mask;
  constexpr std::size_t kLast = CellCorners::kDirections;
  out.ax[kLast] = out.ax[0];
  out.ay[kLast] = out.ay[0];
  for (std::size_t first = 0; first < kLast; first += N) {
    Floats ax, ay, bx, by;
    load(&out.ax[first], ax);
    load(&out.ay[first], ay);
    load(&out.ax[first + 1], bx);
    load(&out.ay[first + 1], by);
    const Floats cross = ax * by - ay * bx, over = 1.0f / cross, x = (by - ay) * over, y = (ax - bx) * over;
    const Mask same = (ax == bx) & (ay == by), meet = cross > Floats{};
    Floats squared = x * x + y * y;
    squared = meet ? squared : Floats{} + kInfinity;
    squared = same ? Floats{} - 1.0f : squared;
    store(bx, &out.bx[first]);
    store(by, &out.by[first]);
    store(x, &out.x[first]);
    store(y, &out.y[first]);
    store(squared, &out.squared[first]);
  }
  out.size = kLast;
}

template <std::size_t N>
CHIARO_INLINE void cell_body(const TangentLines& lines, float half, CellCorners& out) {
  directions_body<N>(lines, half, out);
  corners_body<N>(out);
}

// Bits of the corners beyond the line (wx, wy) that are not settled.
std::uint64_t beyond_plain(const CellCorners& c, float wx, float wy) {
  std::uint64_t mask = 0;
  for (std::size_t k = 0; k < c.size; ++k) mask |= static_cast<std::uint64_t>((c.squared[k] >= 0) & (wx * c.x[k] + wy * c.y[k] > 1)) << k;
  return mask;
}

#if defined(CHIARO_AVX2)
CHIARO_AVX2 std::uint64_t beyond_avx2(const CellCorners& c, float wx, float wy) {
  const __m256 dx = _mm256_set1_ps(wx), dy = _mm256_set1_ps(wy);
  std::uint64_t mask = 0;
  for (std::size_t k = 0; k < c.size; k += 8) {
    const __m256 along = _mm256_add_ps(_mm256_mul_ps(dx, _mm256_load_ps(&c.x[k])), _mm256_mul_ps(dy, _mm256_load_ps(&c.y[k])));
    const __m256 open = _mm256_cmp_ps(_mm256_load_ps(&c.squared[k]), _mm256_setzero_ps(), _CMP_GE_OQ), beyond = _mm256_cmp_ps(along, _mm256_set1_ps(1), _CMP_GT_OQ);
    mask |= static_cast<std::uint64_t>(static_cast<unsigned>(_mm256_movemask_ps(_mm256_and_ps(open, beyond)))) << k;
  }
  return c.size < CellCorners::kMost ? mask & ((std::uint64_t{1} << c.size) - 1) : mask;
}

CHIARO_AVX2 inline __m256 dot(const std::array<float, 3>& a, __m256 x, __m256 y, __m256 z) {
  return _mm256_add_ps(_mm256_add_ps(_mm256_mul_ps(_mm256_set1_ps(a[0]), x), _mm256_mul_ps(_mm256_set1_ps(a[1]), y)), _mm256_mul_ps(_mm256_set1_ps(a[2]), z));
}

CHIARO_AVX2 bool lines_avx2(const CandidateView& c, const Place& p, float above, float limit, const TangentFrame& f, TangentLines& out) {
  const __m256 x0 = _mm256_set1_ps(p[0]), y0 = _mm256_set1_ps(p[1]), z0 = _mm256_set1_ps(p[2]), most = _mm256_set1_ps(limit), least = _mm256_set1_ps(above);
  const __m256 reach = _mm256_set1_ps(f.edge_reach * f.edge_reach), other_face = _mm256_set1_ps(f.other_face), sign = _mm256_set1_ps(-0.0f);
  std::size_t n = out.num;
  int edge = 0;
  for (std::size_t k = 0; k < c.num; k += 8) {
    const __m256 x = _mm256_sub_ps(_mm256_loadu_ps(c.x + k), x0), y = _mm256_sub_ps(_mm256_loadu_ps(c.y + k), y0), z = _mm256_sub_ps(_mm256_loadu_ps(c.z + k), z0);
    const __m256 d = _mm256_add_ps(_mm256_add_ps(_mm256_mul_ps(x, x), _mm256_mul_ps(y, y)), _mm256_mul_ps(z, z));
    const __m256 near = _mm256_and_ps(_mm256_cmp_ps(d, most, _CMP_LE_OQ), _mm256_cmp_ps(d, least, _CMP_GT_OQ));
    const auto mask = static_cast<unsigned>(_mm256_movemask_ps(near));
    if (mask == 0) continue;
    const __m256 cosine = dot(f.normal, _mm256_loadu_ps(c.nx + k), _mm256_loadu_ps(c.ny + k), _mm256_loadu_ps(c.nz + k)), size = _mm256_andnot_ps(sign, cosine);
    edge |= _mm256_movemask_ps(_mm256_and_ps(near, _mm256_and_ps(_mm256_cmp_ps(size, other_face, _CMP_LT_OQ), _mm256_cmp_ps(d, reach, _CMP_LE_OQ))));
    const __m256 towards = f.oriented ? _mm256_blendv_ps(size, cosine, _mm256_loadu_ps(reinterpret_cast<const float*>(c.oriented + k))) : size;
    const __m256 height = dot(f.normal, x, y, z), four_squared = _mm256_mul_ps(_mm256_mul_ps(_mm256_set1_ps(4), height), height);
    const __m256 holds = _mm256_and_ps(_mm256_cmp_ps(four_squared, d, _CMP_LE_OQ), _mm256_cmp_ps(towards, _mm256_set1_ps(0.5f), _CMP_GE_OQ));
    const __m256 u = dot(f.u, x, y, z), v = dot(f.v, x, y, z), over = _mm256_div_ps(_mm256_set1_ps(2), d);
    const __m256i order = compression_of(mask);
    _mm256_storeu_ps(&out.u[n], _mm256_permutevar8x32_ps(u, order));
    _mm256_storeu_ps(&out.v[n], _mm256_permutevar8x32_ps(v, order));
    _mm256_storeu_ps(&out.wx[n], _mm256_permutevar8x32_ps(_mm256_and_ps(holds, _mm256_mul_ps(u, over)), order));
    _mm256_storeu_ps(&out.wy[n], _mm256_permutevar8x32_ps(_mm256_and_ps(holds, _mm256_mul_ps(v, over)), order));
    n += static_cast<std::size_t>(_mm_popcnt_u32(mask));
  }
  out.num = n;
  return edge == 0;
}

CHIARO_AVX2 std::size_t offsets_avx2(const CandidateView& c, const Place& p, float above, float limit, TangentLines& out) {
  const __m256 x0 = _mm256_set1_ps(p[0]), y0 = _mm256_set1_ps(p[1]), z0 = _mm256_set1_ps(p[2]), most = _mm256_set1_ps(limit), least = _mm256_set1_ps(above);
  std::size_t n = out.num;
  for (std::size_t k = 0; k < c.num; k += 8) {
    const __m256 x = _mm256_sub_ps(_mm256_loadu_ps(c.x + k), x0), y = _mm256_sub_ps(_mm256_loadu_ps(c.y + k), y0), z = _mm256_sub_ps(_mm256_loadu_ps(c.z + k), z0);
    const __m256 d = _mm256_add_ps(_mm256_add_ps(_mm256_mul_ps(x, x), _mm256_mul_ps(y, y)), _mm256_mul_ps(z, z));
    const auto mask = static_cast<unsigned>(_mm256_movemask_ps(_mm256_and_ps(_mm256_cmp_ps(d, most, _CMP_LE_OQ), _mm256_cmp_ps(d, least, _CMP_GT_OQ))));
    const __m256i order = compression_of(mask);
    _mm256_storeu_ps(&out.u[n], _mm256_permutevar8x32_ps(x, order));
    _mm256_storeu_ps(&out.v[n], _mm256_permutevar8x32_ps(y, order));
    _mm256_storeu_ps(&out.wx[n], _mm256_permutevar8x32_ps(z, order));
    n += static_cast<std::size_t>(_mm_popcnt_u32(mask));
  }
  return n;
}
CHIARO_AVX2 void project_avx2(std::size_t last, const TangentFrame& f, TangentLines& out) { project_body<8>(last, f, out); }
CHIARO_AVX2 bool alike_avx2(const CandidateView& c, const Place& n, float least) { return alike_body<8>(c, n, least); }
CHIARO_AVX2 bool beyond_avx2(const TangentLines& lines, float x, float y, float distance) { return beyond_body<8>(lines, x, y, distance); }
CHIARO_AVX2 void cell_avx2(const TangentLines& lines, float half, CellCorners& out) { cell_body<8>(lines, half, out); }


// What directions_body() does: of all lines taken, and of the square, the one met first in each direction.
struct DirectionVectors {
  __m512 c, s, ax, ay, best;
  CHIARO_AVX512 explicit DirectionVectors(float half) {
    const __m512 over_half = _mm512_set1_ps(1 / half);
    c = _mm512_loadu_ps(kCos);
    s = _mm512_loadu_ps(kSin);
    ax = _mm512_mul_ps(_mm512_loadu_ps(kSquareX), over_half);
    ay = _mm512_mul_ps(_mm512_loadu_ps(kSquareY), over_half);
    best = _mm512_add_ps(_mm512_mul_ps(c, ax), _mm512_mul_ps(s, ay));
  }
  CHIARO_AVX512 void take(float wx_, float wy_) {
    const __m512 wx = _mm512_set1_ps(wx_), wy = _mm512_set1_ps(wy_), along = _mm512_add_ps(_mm512_mul_ps(c, wx), _mm512_mul_ps(s, wy));
    const __mmask16 nearer = _mm512_cmp_ps_mask(along, best, _CMP_GT_OQ);
    best = _mm512_max_ps(along, best);
    ax = _mm512_mask_mov_ps(ax, nearer, wx);
    ay = _mm512_mask_mov_ps(ay, nearer, wy);
  }
};

struct CornerVectors {
  __m512 ax, ay, bx, by, x, y, squared;
  // As CellCorners::set().
  CHIARO_AVX512 void set(__mmask16 at, float ax_, float ay_, float bx_, float by_) {
    const float cross = ax_ * by_ - ay_ * bx_, x_ = (by_ - ay_) / cross, y_ = (ax_ - bx_) / cross;
    ax = _mm512_mask_mov_ps(ax, at, _mm512_set1_ps(ax_));
    ay = _mm512_mask_mov_ps(ay, at, _mm512_set1_ps(ay_));
    bx = _mm512_mask_mov_ps(bx, at, _mm512_set1_ps(bx_));
    by = _mm512_mask_mov_ps(by, at, _mm512_set1_ps(by_));
    x = _mm512_mask_mov_ps(x, at, _mm512_set1_ps(x_));
    y = _mm512_mask_mov_ps(y, at, _mm512_set1_ps(y_));
    squared = _mm512_mask_mov_ps(squared, at, _mm512_set1_ps(cross > 0 ? x_ * x_ + y_ * y_ : kInfinity));
  }
  CHIARO_AVX512 void store(CellCorners& out) const {
    _mm512_store_ps(&out.ax[0], ax);
    _mm512_store_ps(&out.ay[0], ay);
    _mm512_store_ps(&out.bx[0], bx);
    _mm512_store_ps(&out.by[0], by);
    _mm512_store_ps(&out.x[0], x);
    _mm512_store_ps(&out.y[0], y);
    _mm512_store_ps(&out.squared[0], squared);
    out.size = CellCorners::kDirections;
  }
};

// What corners_body() does; the next line comes from the register.
CHIARO_AVX512 inline void corners_of(const DirectionVectors& lines, CornerVectors& out) {
  const __m512i next = _mm512_setr_epi32(1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15, 0);
  const __m512 ax = lines.ax, ay = lines.ay, bx = _mm512_permutexvar_ps(next, ax), by = _mm512_permutexvar_ps(next, ay);
  const __m512 cross = _mm512_sub_ps(_mm512_mul_ps(ax, by), _mm512_mul_ps(ay, bx)), over = _mm512_div_ps(_mm512_set1_ps(1), cross);
  const __m512 x = _mm512_mul_ps(_mm512_sub_ps(by, ay), over), y = _mm512_mul_ps(_mm512_sub_ps(ax, bx), over);
  const __mmask16 same = _mm512_mask_cmp_ps_mask(_mm512_cmp_ps_mask(ax, bx, _CMP_EQ_OQ), ay, by, _CMP_EQ_OQ), meet = _mm512_cmp_ps_mask(cross, _mm512_setzero_ps(), _CMP_GT_OQ);
  __m512 squared = _mm512_add_ps(_mm512_mul_ps(x, x), _mm512_mul_ps(y, y));
  squared = _mm512_mask_mov_ps(_mm512_set1_ps(kInfinity), meet, squared);
  squared = _mm512_mask_mov_ps(squared, same, _mm512_set1_ps(-1));
  out = {ax, ay, bx, by, x, y, squared};
}

CHIARO_AVX512 void cell_avx512(const TangentLines& lines, float half, CellCorners& out) {
  DirectionVectors best(half);
  for (std::size_t k = 0; k < lines.num; ++k) best.take(lines.wx[k], lines.wy[k]);
  CornerVectors corners;
  corners_of(best, corners);
  corners.store(out);
}

CHIARO_AVX512 inline __m512 dot(const std::array<float, 3>& a, __m512 x, __m512 y, __m512 z) {
  return _mm512_add_ps(_mm512_add_ps(_mm512_mul_ps(_mm512_set1_ps(a[0]), x), _mm512_mul_ps(_mm512_set1_ps(a[1]), y)), _mm512_mul_ps(_mm512_set1_ps(a[2]), z));
}

CHIARO_AVX512 bool lines_avx512(const CandidateView& c, const Place& p, float above, float limit, const TangentFrame& f, TangentLines& out) {
  const __m512 x0 = _mm512_set1_ps(p[0]), y0 = _mm512_set1_ps(p[1]), z0 = _mm512_set1_ps(p[2]), most = _mm512_set1_ps(limit), least = _mm512_set1_ps(above);
  const __m512 reach = _mm512_set1_ps(f.edge_reach * f.edge_reach), other_face = _mm512_set1_ps(f.other_face);
  std::size_t n = out.num;
  unsigned edge = 0;
  for (std::size_t k = 0; k < c.num; k += 16) {
    const __m512 x = _mm512_sub_ps(_mm512_loadu_ps(c.x + k), x0), y = _mm512_sub_ps(_mm512_loadu_ps(c.y + k), y0), z = _mm512_sub_ps(_mm512_loadu_ps(c.z + k), z0);
    const __m512 d = _mm512_add_ps(_mm512_add_ps(_mm512_mul_ps(x, x), _mm512_mul_ps(y, y)), _mm512_mul_ps(z, z));
    const __mmask16 mask = _mm512_mask_cmp_ps_mask(_mm512_cmp_ps_mask(d, most, _CMP_LE_OQ), d, least, _CMP_GT_OQ);
    const __m512 cosine = dot(f.normal, _mm512_loadu_ps(c.nx + k), _mm512_loadu_ps(c.ny + k), _mm512_loadu_ps(c.nz + k)), size = _mm512_abs_ps(cosine);
    edge |= _mm512_mask_cmp_ps_mask(_mm512_mask_cmp_ps_mask(mask, size, other_face, _CMP_LT_OQ), d, reach, _CMP_LE_OQ);
    __m512 towards = size;
    if (f.oriented) {
      const __m512i oriented = _mm512_loadu_si512(c.oriented + k);
      towards = _mm512_mask_mov_ps(size, _mm512_test_epi32_mask(oriented, oriented), cosine);
    }
    const __m512 height = dot(f.normal, x, y, z), four_squared = _mm512_mul_ps(_mm512_mul_ps(_mm512_set1_ps(4), height), height);
    const __mmask16 holds = _mm512_mask_cmp_ps_mask(_mm512_cmp_ps_mask(four_squared, d, _CMP_LE_OQ), towards, _mm512_set1_ps(0.5f), _CMP_GE_OQ);
    const __m512 u = dot(f.u, x, y, z), v = dot(f.v, x, y, z), over = _mm512_div_ps(_mm512_set1_ps(2), d);
    _mm512_storeu_ps(&out.u[n], _mm512_maskz_compress_ps(mask, u));
    _mm512_storeu_ps(&out.v[n], _mm512_maskz_compress_ps(mask, v));
    _mm512_storeu_ps(&out.wx[n], _mm512_maskz_compress_ps(mask, _mm512_maskz_mul_ps(holds, u, over)));
    _mm512_storeu_ps(&out.wy[n], _mm512_maskz_compress_ps(mask, _mm512_maskz_mul_ps(holds, v, over)));
    n += static_cast<std::size_t>(_mm_popcnt_u32(mask));
  }
  out.num = n;
  return edge == 0;
}

CHIARO_AVX512 std::size_t offsets_avx512(const CandidateView& c, const Place& p, float above, float limit, TangentLines& out) {
  const __m512 x0 = _mm512_set1_ps(p[0]), y0 = _mm512_set1_ps(p[1]), z0 = _mm512_set1_ps(p[2]), most = _mm512_set1_ps(limit), least = _mm512_set1_ps(above);
  std::size_t n = out.num;
  for (std::size_t k = 0; k < c.num; k += 16) {
    const __m512 x = _mm512_sub_ps(_mm512_loadu_ps(c.x + k), x0), y = _mm512_sub_ps(_mm512_loadu_ps(c.y + k), y0), z = _mm512_sub_ps(_mm512_loadu_ps(c.z + k), z0);
    const __m512 d = _mm512_add_ps(_mm512_add_ps(_mm512_mul_ps(x, x), _mm512_mul_ps(y, y)), _mm512_mul_ps(z, z));
    const __mmask16 mask = _mm512_mask_cmp_ps_mask(_mm512_cmp_ps_mask(d, most, _CMP_LE_OQ), d, least, _CMP_GT_OQ);
    _mm512_storeu_ps(&out.u[n], _mm512_maskz_compress_ps(mask, x));
    _mm512_storeu_ps(&out.v[n], _mm512_maskz_compress_ps(mask, y));
    _mm512_storeu_ps(&out.wx[n], _mm512_maskz_compress_ps(mask, z));
    n += static_cast<std::size_t>(_mm_popcnt_u32(mask));
  }
  return n;
}
CHIARO_AVX512 void project_avx512(std::size_t last, const TangentFrame& f, TangentLines& out) { project_body<16>(last, f, out); }

CHIARO_AVX512 bool beyond_avx512(const TangentLines& lines, float x, float y, float distance) {
  const __m512 dx = _mm512_set1_ps(x), dy = _mm512_set1_ps(y), far = _mm512_set1_ps(distance);
  unsigned found = 0;
  for (std::size_t k = 0; k < lines.num; k += 16) {
    const __m512 u = _mm512_loadu_ps(&lines.u[k]), v = _mm512_loadu_ps(&lines.v[k]);
    const __m512 aside = _mm512_abs_ps(_mm512_sub_ps(_mm512_mul_ps(v, dx), _mm512_mul_ps(u, dy)));
    const __mmask16 beyond = _mm512_cmp_ps_mask(_mm512_add_ps(_mm512_mul_ps(u, dx), _mm512_mul_ps(v, dy)), far, _CMP_GE_OQ);
    found |= _mm512_mask_cmp_ps_mask(beyond, aside, far, _CMP_LE_OQ);
  }
  return found != 0;
}

CHIARO_AVX512 inline std::uint32_t first_of_largest(__m512 values, __m512i numbers) {
  const __mmask16 largest = _mm512_cmp_ps_mask(values, _mm512_set1_ps(_mm512_reduce_max_ps(values)), _CMP_EQ_OQ);
  return static_cast<std::uint32_t>(_mm_cvtsi128_si32(_mm512_castsi512_si128(_mm512_maskz_compress_epi32(largest, numbers))));
}

CHIARO_AVX512 std::size_t line_before_avx512(const TangentLines& lines, float x, float y) {
  const __m512 dx = _mm512_set1_ps(x), dy = _mm512_set1_ps(y);
  __m512 best = _mm512_set1_ps(kBeyond);
  __m512i which = _mm512_set1_epi32(-1), number = _mm512_setr_epi32(0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15);
  for (std::size_t k = 0; k < lines.num; k += 16) {
    const __m512 along = _mm512_add_ps(_mm512_mul_ps(_mm512_loadu_ps(&lines.wx[k]), dx), _mm512_mul_ps(_mm512_loadu_ps(&lines.wy[k]), dy));
    const __mmask16 more = _mm512_cmp_ps_mask(along, best, _CMP_GT_OQ);
    best = _mm512_mask_mov_ps(best, more, along);
    which = _mm512_mask_mov_epi32(which, more, number);
    number = _mm512_add_epi32(number, _mm512_set1_epi32(16));
  }
  const std::uint32_t at = first_of_largest(best, which);   // no line: all bits set
  return at < lines.num ? at : lines.num;
}

CHIARO_AVX512 std::size_t farthest_avx512(const CellCorners& c) {
  __m512 best = _mm512_load_ps(&c.squared[0]);
  __m512i which = _mm512_setr_epi32(0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15), number = which;
  for (std::size_t k = 16; k < c.size; k += 16) {
    number = _mm512_add_epi32(number, _mm512_set1_epi32(16));
    const __mmask16 there = static_cast<__mmask16>(c.size - k >= 16 ? 0xffff : (1u << (c.size - k)) - 1);
    const __m512 next = _mm512_maskz_loadu_ps(there, &c.squared[k]);
    const __mmask16 more = _mm512_mask_cmp_ps_mask(there, next, best, _CMP_GT_OQ);
    best = _mm512_mask_mov_ps(best, more, next);
    which = _mm512_mask_mov_epi32(which, more, number);
  }
  return first_of_largest(best, which);
}

// Lines of one point, zero behind the last one.
struct FewLines {
  alignas(64) float u[3 * kLanes], v[3 * kLanes], wx[3 * kLanes], wy[3 * kLanes];
  std::size_t num;
  bool fit() const { return num <= 2 * kLanes; }
};

// As offsets_avx512(), from nothing. More than 32: not all are there.
CHIARO_AVX512 inline void few_offsets(const CandidateView& c, const Place& p, float limit, FewLines& out) {
  const __m512 x0 = _mm512_set1_ps(p[0]), y0 = _mm512_set1_ps(p[1]), z0 = _mm512_set1_ps(p[2]), most = _mm512_set1_ps(limit), zero = _mm512_setzero_ps();
  std::size_t n = 0;
  for (std::size_t k = 0; k < c.num && n <= 2 * kLanes; k += 16) {
    const __m512 x = _mm512_sub_ps(_mm512_loadu_ps(c.x + k), x0), y = _mm512_sub_ps(_mm512_loadu_ps(c.y + k), y0), z = _mm512_sub_ps(_mm512_loadu_ps(c.z + k), z0);
    const __m512 d = _mm512_add_ps(_mm512_add_ps(_mm512_mul_ps(x, x), _mm512_mul_ps(y, y)), _mm512_mul_ps(z, z));
    const __mmask16 mask = _mm512_mask_cmp_ps_mask(_mm512_cmp_ps_mask(d, most, _CMP_LE_OQ), d, zero, _CMP_GT_OQ);
    _mm512_storeu_ps(out.u + n, _mm512_maskz_compress_ps(mask, x));
    _mm512_storeu_ps(out.v + n, _mm512_maskz_compress_ps(mask, y));
    _mm512_storeu_ps(out.wx + n, _mm512_maskz_compress_ps(mask, z));
    n += static_cast<std::size_t>(_mm_popcnt_u32(mask));
  }
  out.num = n;
}

// As project_body().
CHIARO_AVX512 inline void few_lines(const TangentFrame& f, FewLines& lines) {
  for (std::size_t k = 0; k < 2 * kLanes; k += 16) {
    const auto there = static_cast<__mmask16>(lines.num >= k + 16 ? 0xffff : lines.num <= k ? 0 : (1u << (lines.num - k)) - 1);
    if (there == 0) {
      for (float* values : {lines.u, lines.v, lines.wx, lines.wy}) _mm512_store_ps(values + k, _mm512_setzero_ps());
      continue;
    }
    const __m512 x = _mm512_maskz_load_ps(there, lines.u + k), y = _mm512_maskz_load_ps(there, lines.v + k), z = _mm512_maskz_load_ps(there, lines.wx + k);
    const __m512 d = _mm512_add_ps(_mm512_add_ps(_mm512_mul_ps(x, x), _mm512_mul_ps(y, y)), _mm512_mul_ps(z, z)), over = _mm512_div_ps(_mm512_set1_ps(2), d);
    const __m512 height = dot(f.normal, x, y, z), four_squared = _mm512_mul_ps(_mm512_mul_ps(_mm512_set1_ps(4), height), height);
    const __mmask16 holds = _mm512_mask_cmp_ps_mask(there, four_squared, d, _CMP_LE_OQ);
    const __m512 u = dot(f.u, x, y, z), v = dot(f.v, x, y, z);
    _mm512_store_ps(lines.u + k, u);
    _mm512_store_ps(lines.v + k, v);
    _mm512_store_ps(lines.wx + k, _mm512_maskz_mul_ps(holds, u, over));
    _mm512_store_ps(lines.wy + k, _mm512_maskz_mul_ps(holds, v, over));
  }
}

CHIARO_AVX512 inline float at_first(__mmask16 mask, __m512 v) { return _mm512_cvtss_f32(_mm512_maskz_compress_ps(mask, v)); }
CHIARO_AVX512 inline __mmask16 first_of(unsigned mask) { return static_cast<__mmask16>(mask & (0u - mask)); }

// What farthest_corner(), CellCorners and TangentLines do with the two registers, while each cut takes one corner and leaves room for another. 0 where it does not, and
// where the corner is not settled by these lines.
CHIARO_AVX512 inline float settle(const FewLines& lines, const SmoothPoint& p, CornerVectors& c) {
  const __m512 wx0 = _mm512_load_ps(lines.wx), wx1 = _mm512_load_ps(lines.wx + 16), wy0 = _mm512_load_ps(lines.wy), wy1 = _mm512_load_ps(lines.wy + 16);
  const __m512 beyond_limit = _mm512_set1_ps(kBeyond), one = _mm512_set1_ps(1), zero = _mm512_setzero_ps();
  for (std::size_t cuts = 0; cuts < CellCorners::kMost; ++cuts) {
    const __m512 most = _mm512_set1_ps(_mm512_reduce_max_ps(c.squared));
    const __mmask16 at = first_of(_mm512_cmp_ps_mask(c.squared, most, _CMP_EQ_OQ));
    const float squared = _mm512_cvtss_f32(most), x = at_first(at, c.x), y = at_first(at, c.y);
    if (!(squared >= 0 && squared < kInfinity)) return 0;
    const __m512 dx = _mm512_set1_ps(x), dy = _mm512_set1_ps(y);
    const __m512 first = _mm512_add_ps(_mm512_mul_ps(wx0, dx), _mm512_mul_ps(wy0, dy)), second = _mm512_add_ps(_mm512_mul_ps(wx1, dx), _mm512_mul_ps(wy1, dy));
    const __m512 farther = _mm512_max_ps(first, second);
    if (_mm512_cmp_ps_mask(farther, beyond_limit, _CMP_GT_OQ) == 0) {
      const float d = std::sqrt(squared);
      if (std::max(std::abs(x), std::abs(y)) >= 0.9999f * p.half || 2 * d > p.reach) return 0;
      if (d <= p.scale) return d;
      const __m512 ex = _mm512_set1_ps(x / d), ey = _mm512_set1_ps(y / d), far = _mm512_set1_ps(d);
      for (std::size_t k = 0; k < 2 * kLanes; k += 16) {
        const __m512 u = _mm512_load_ps(lines.u + k), v = _mm512_load_ps(lines.v + k), aside = _mm512_abs_ps(_mm512_sub_ps(_mm512_mul_ps(v, ex), _mm512_mul_ps(u, ey)));
        const __mmask16 beyond = _mm512_cmp_ps_mask(_mm512_add_ps(_mm512_mul_ps(u, ex), _mm512_mul_ps(v, ey)), far, _CMP_GE_OQ);
        if (_mm512_mask_cmp_ps_mask(beyond, aside, far, _CMP_LE_OQ) != 0) return d;
      }
      return 0;
    }
    // Of equals the first by (number modulo kLanes, number).
    const __mmask16 best = first_of(_mm512_cmp_ps_mask(farther, _mm512_set1_ps(_mm512_reduce_max_ps(farther)), _CMP_EQ_OQ)), in_second = _mm512_mask_cmp_ps_mask(best, second, first, _CMP_GT_OQ);
    const float wx = in_second ? at_first(in_second, wx1) : at_first(best, wx0), wy = in_second ? at_first(in_second, wy1) : at_first(best, wy0);
    const __mmask16 open = _mm512_cmp_ps_mask(c.squared, zero, _CMP_GE_OQ);
    const __m512 along = _mm512_add_ps(_mm512_mul_ps(_mm512_set1_ps(wx), c.x), _mm512_mul_ps(_mm512_set1_ps(wy), c.y));
    const unsigned cut = _mm512_mask_cmp_ps_mask(open, along, one, _CMP_GT_OQ), settled = _mm512_cmp_ps_mask(c.squared, zero, _CMP_LT_OQ);
    if ((cut & ~static_cast<unsigned>(at)) != 0 || settled == 0) return 0;
    const float ax = at_first(at, c.ax), ay = at_first(at, c.ay), bx = at_first(at, c.bx), by = at_first(at, c.by);
    c.set(first_of(settled), wx, wy, bx, by);
    c.set(at, ax, ay, wx, wy);
  }
  return 0;
}

CHIARO_AVX512 inline void start_few(const FewLines& lines, float half, CornerVectors& out) {
  DirectionVectors best(half);
  for (std::size_t k = 0; k < lines.num; k += 4)   // zeros behind the last one change nothing
    for (std::size_t i = 0; i < 4; ++i) best.take(lines.wx[k + i], lines.wy[k + i]);
  corners_of(best, out);
}

CHIARO_AVX512 inline void keep(const FewLines& from, TangentLines& to) {
  for (std::size_t k = 0; k < 2 * kLanes; k += 16) {
    _mm512_storeu_ps(&to.u[k], _mm512_load_ps(from.u + k));
    _mm512_storeu_ps(&to.v[k], _mm512_load_ps(from.v + k));
    _mm512_storeu_ps(&to.wx[k], _mm512_load_ps(from.wx + k));
    _mm512_storeu_ps(&to.wy[k], _mm512_load_ps(from.wy + k));
  }
  for (std::vector<float>* values : {&to.u, &to.v, &to.wx, &to.wy}) std::fill_n(values->begin() + 2 * kLanes, kLanes, 0.0f);
}

// One step after the other for all points: their chains of operations are long and do not wait for each other.
CHIARO_AVX512 void nearest_corners_avx512(const CandidateView& c, std::span<SmoothPoint> points, std::span<TangentLines> lines, std::span<CellCorners> corners) {
  std::array<FewLines, kLanes> few;
  std::array<CornerVectors, kLanes> cells;
  for (std::size_t at = 0; at < points.size(); ++at)
    if (points[at].wanted) few_offsets(c, points[at].place, points[at].reach * points[at].reach, few[at]);
  for (std::size_t at = 0; at < points.size(); ++at) {
    points[at].started = points[at].wanted && few[at].fit();
    if (points[at].started) few_lines(points[at].frame, few[at]);
  }
  for (std::size_t at = 0; at < points.size(); ++at)
    if (points[at].started) start_few(few[at], points[at].half, cells[at]);
  for (std::size_t at = 0; at < points.size(); ++at) {
    if (!points[at].started) continue;
    points[at].distance = settle(few[at], points[at], cells[at]);
    lines[at].num = few[at].num;
    if (points[at].distance > 0) continue;
    keep(few[at], lines[at]);
    cells[at].store(corners[at]);
  }
}
#endif

}  // namespace

namespace {

bool add_lines(const CandidateView& c, const Place& p, float above, float limit, const TangentFrame& frame, TangentLines& out) {
#if defined(CHIARO_AVX2)
  if (vector_width() == VectorWidth::kAvx512) return lines_avx512(c, p, above, limit, frame, out);
  if (vector_width() == VectorWidth::kAvx2) return lines_avx2(c, p, above, limit, frame, out);
#endif
  return lines_plain(c, p, above, limit, frame, out);
}

void add_smooth_lines(const CandidateView& c, const Place& p, float above, float limit, const TangentFrame& frame, TangentLines& out) {
#if defined(CHIARO_AVX2)
  if (vector_width() == VectorWidth::kAvx512) return project_avx512(offsets_avx512(c, p, above, limit, out), frame, out);
  if (vector_width() == VectorWidth::kAvx2) return project_avx2(offsets_avx2(c, p, above, limit, out), frame, out);
#endif
  project_body<8>(offsets_plain(c, p, above, limit, out), frame, out);
}

}  // namespace

// Vectors are stored whole.
void TangentLines::make_room(std::size_t most) {
  if (u.size() >= most + 2 * kLanes) return;
  for (std::vector<float>* values : {&u, &v, &wx, &wy}) values->resize(most + 2 * kLanes);
}

bool TangentLines::add(const CandidateView& c, const Place& point, float above, float limit, const TangentFrame& frame) {
  make_room(num + c.num);
  bool smooth = true;
  if (c.nx) smooth = add_lines(c, point, above, limit, frame, *this);
  else add_smooth_lines(c, point, above, limit, frame, *this);
  for (std::vector<float>* values : {&u, &v, &wx, &wy}) std::fill_n(values->begin() + static_cast<std::ptrdiff_t>(num), kLanes, 0.0f);
  return smooth;
}

bool all_alike(const CandidateView& c, const Place& normal, float least) {
#if defined(CHIARO_AVX2)
  if (vector_width() >= VectorWidth::kAvx2) return alike_avx2(c, normal, least);
#endif
  return alike_body<8>(c, normal, least);
}

bool TangentLines::is_beyond(float x, float y, float distance) const {
#if defined(CHIARO_AVX2)
  if (vector_width() == VectorWidth::kAvx512) return beyond_avx512(*this, x, y, distance);
  if (vector_width() == VectorWidth::kAvx2) return beyond_avx2(*this, x, y, distance);
#endif
  return beyond_body<8>(*this, x, y, distance);
}

std::size_t TangentLines::line_before(float x, float y) const {
#if defined(CHIARO_AVX2)
  if (vector_width() == VectorWidth::kAvx512) return line_before_avx512(*this, x, y);
#endif
  return line_before_plain(*this, x, y);
}

void CellCorners::set(std::size_t at, float ax_, float ay_, float bx_, float by_) {
  const float cross = ax_ * by_ - ay_ * bx_;
  ax[at] = ax_;
  ay[at] = ay_;
  bx[at] = bx_;
  by[at] = by_;
  x[at] = (by_ - ay_) / cross;
  y[at] = (ax_ - bx_) / cross;
  squared[at] = cross > 0 ? x[at] * x[at] + y[at] * y[at] : kInfinity;
}

bool CellCorners::cut(std::size_t at, float wx, float wy) {
#if defined(CHIARO_AVX2)
  std::uint64_t beyond = vector_width() >= VectorWidth::kAvx2 ? beyond_avx2(*this, wx, wy) : beyond_plain(*this, wx, wy);
#else
  std::uint64_t beyond = beyond_plain(*this, wx, wy);
#endif
  beyond &= ~(std::uint64_t{1} << at);
  // Those next to it on either side, then next to these.
  float first_x = ax[at], first_y = ay[at], last_x = bx[at], last_y = by[at];
  for (std::uint64_t left = beyond; left != 0;) {
    const auto k = static_cast<std::size_t>(__builtin_ctzll(left));
    left &= left - 1;
    const bool before = bx[k] == first_x && by[k] == first_y, after = ax[k] == last_x && ay[k] == last_y;
    if (!before && !after) continue;
    if (before) first_x = ax[k], first_y = ay[k];
    else last_x = bx[k], last_y = by[k];
    squared[k] = -1;
    beyond &= ~(std::uint64_t{1} << k);
    left = beyond;
  }
  const auto free = static_cast<std::size_t>(std::find_if(squared.begin(), squared.begin() + static_cast<std::ptrdiff_t>(size), [](float v) { return v < 0; }) - squared.begin());
  if (free == kMost) return false;
  if (free == size) ++size;
  set(free, wx, wy, last_x, last_y);
  set(at, first_x, first_y, wx, wy);
  return true;
}

std::size_t CellCorners::farthest() const {
#if defined(CHIARO_AVX2)
  if (vector_width() == VectorWidth::kAvx512) return farthest_avx512(*this);
#endif
  std::size_t at = 0;
  for (std::size_t lane = 0; lane < kLanes; ++lane)
    for (std::size_t i = lane; i < size; i += kLanes) at = squared[i] > squared[at] ? i : at;
  return at;
}

void start_cell(const TangentLines& lines, float half, CellCorners& corners) {
#if defined(CHIARO_AVX2)
  if (vector_width() == VectorWidth::kAvx512) return cell_avx512(lines, half, corners);
  if (vector_width() == VectorWidth::kAvx2) return cell_avx2(lines, half, corners);
#endif
  cell_body<8>(lines, half, corners);
}

void nearest_corners(const CandidateView& c, std::span<SmoothPoint> points, std::span<TangentLines> lines, std::span<CellCorners> corners) {
#if defined(CHIARO_AVX2)
  if (vector_width() == VectorWidth::kAvx512) {
    for (TangentLines& l : lines) l.make_room(2 * kLanes);
    nearest_corners_avx512(c, points, lines, corners);
  }
#endif
  for (std::size_t at = 0; at < points.size(); ++at) {
    SmoothPoint& p = points[at];
    if (!p.wanted || p.started) continue;
    lines[at].clear();
    lines[at].add(c, p.place, 0, p.reach * p.reach, p.frame);
    start_cell(lines[at], p.half, corners[at]);
  }
}

}  // namespace chiaro::stream
