#include <algorithm>
#include <cmath>

#include "stream/store/tangent_bodies.h"
#include "stream/store/tangent_vectors.h"

#if defined(CHIARO_AVX2)
namespace chiaro::stream {
namespace {

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

CHIARO_AVX512 inline __m512 dot(const std::array<float, 3>& a, __m512 x, __m512 y, __m512 z) {
  return _mm512_add_ps(_mm512_add_ps(_mm512_mul_ps(_mm512_set1_ps(a[0]), x), _mm512_mul_ps(_mm512_set1_ps(a[1]), y)), _mm512_mul_ps(_mm512_set1_ps(a[2]), z));
}

CHIARO_AVX512 inline std::uint32_t first_of_largest(__m512 values, __m512i numbers) {
  const __mmask16 largest = _mm512_cmp_ps_mask(values, _mm512_set1_ps(_mm512_reduce_max_ps(values)), _CMP_EQ_OQ);
  return static_cast<std::uint32_t>(_mm_cvtsi128_si32(_mm512_castsi512_si128(_mm512_maskz_compress_epi32(largest, numbers))));
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

}  // namespace

CHIARO_AVX512 void cell_avx512(const TangentLines& lines, float half, CellCorners& out) {
  DirectionVectors best(half);
  for (std::size_t k = 0; k < lines.num; ++k) best.take(lines.wx[k], lines.wy[k]);
  CornerVectors corners;
  corners_of(best, corners);
  corners.store(out);
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

}  // namespace chiaro::stream
#endif
