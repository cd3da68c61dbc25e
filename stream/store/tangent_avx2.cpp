#include "stream/store/tangent_bodies.h"
#include "stream/store/tangent_vectors.h"

#if defined(CHIARO_AVX2)
namespace chiaro::stream {
namespace {

CHIARO_AVX2 inline __m256 dot(const std::array<float, 3>& a, __m256 x, __m256 y, __m256 z) {
  return _mm256_add_ps(_mm256_add_ps(_mm256_mul_ps(_mm256_set1_ps(a[0]), x), _mm256_mul_ps(_mm256_set1_ps(a[1]), y)), _mm256_mul_ps(_mm256_set1_ps(a[2]), z));
}

}  // namespace

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

}  // namespace chiaro::stream
#endif
