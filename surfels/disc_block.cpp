#include "surfels/disc_block.h"

#include <array>
#include <cmath>

#include "stream/base/intrinsics.h"

#if defined(__x86_64__)
#define CHIARO_AVX512 __attribute__((target("avx512f,avx512bw,avx512dq,avx512vl")))
#endif

// One code path a machine may choose from at run time.
#if defined(__x86_64__) && defined(__GNUC__) && !defined(__clang__) && !defined(__SANITIZE_ADDRESS__) && !defined(__SANITIZE_THREAD__)
#define CHIARO_CLONES __attribute__((target_clones("avx2", "default")))
#else
#define CHIARO_CLONES
#endif

namespace chiaro::surfels {
namespace {

using stream::DiscClip;
using stream::SurfelBlock;

// Squared radii over the largest: a sixteenth of an octave a code, so that sixteen codes lower it is a quarter, exactly.
struct RadiusTable {
  alignas(64) std::array<float, 256> all;
  alignas(64) std::array<float, 16> top;   // of the codes 240 .. 255
  RadiusTable() {
    for (std::size_t i = 0; i < 256; ++i) {
      const float r = stream::decode_radius(static_cast<std::uint8_t>(240 + i % 16), 1.0f);
      all[i] = std::ldexp(r * r, 2 * (static_cast<int>(i / 16) - 15));
      if (i >= 240) top[i - 240] = all[i];
    }
  }
};
const RadiusTable kRadii;

constexpr float kOverSnorm = 1.0f / stream::kSnorm;

CHIARO_CLONES std::uint32_t intersect_plain(const SurfelBlock& block, const float* radius2, const DiscScale& scale, const LocalRay& ray, float share, BlockHits& hits) {
  const float ox = ray.origin[0], oy = ray.origin[1], oz = ray.origin[2], dx = ray.direction[0], dy = ray.direction[1], dz = ray.direction[2];
  const float most = scale.radius2_max * share, step = scale.step, t_min = ray.t_min, t_max = ray.t_max;
  float* r2 = hits.radius2;
  alignas(64) std::uint32_t met[16];
  for (int i = 0; i < 16; ++i) r2[i] = (block.flags[i] & SurfelBlock::kPadding) ? 0.0f : radius2[block.log_radius[i]] * most;
  for (int i = 0; i < 16; ++i) {
    const float u = static_cast<float>(block.normal_u[i] & ~15) * kOverSnorm, v = static_cast<float>(block.normal_v[i] & ~15) * kOverSnorm;
    const float nz = 1.0f - std::fabs(u) - std::fabs(v);
    const float fold = nz < 0.0f ? -nz : 0.0f;
    const float nx = u + (u >= 0.0f ? -fold : fold), ny = v + (v >= 0.0f ? -fold : fold);
    const float cx = (static_cast<float>(block.x[i]) + 0.5f) * step - ox;
    const float cy = (static_cast<float>(block.y[i]) + 0.5f) * step - oy;
    const float cz = (static_cast<float>(block.z[i]) + 0.5f) * step - oz;
    const float t = (nx * cx + ny * cy + nz * cz) / (nx * dx + ny * dy + nz * dz);
    const float ex = t * dx - cx, ey = t * dy - cy, ez = t * dz - cz, d2 = ex * ex + ey * ey + ez * ez;
    hits.t[i] = t;
    hits.distance2[i] = d2;
    met[i] = static_cast<std::uint32_t>((d2 < r2[i]) & (t > t_min) & (t <= t_max)) << i;
  }
  std::uint32_t mask = 0;
  for (int i = 0; i < 16; ++i) mask |= met[i];
  return mask;
}

#if defined(CHIARO_AVX512)
CHIARO_AVX512 inline __m512 load_coordinate(const std::array<std::uint16_t, 16>& q, __m512 step, float origin) {
  const __m512 v = _mm512_cvtepi32_ps(_mm512_cvtepu16_epi32(_mm256_loadu_si256(reinterpret_cast<const __m256i*>(q.data()))));
  return _mm512_sub_ps(_mm512_mul_ps(_mm512_add_ps(v, _mm512_set1_ps(0.5f)), step), _mm512_set1_ps(origin));
}
CHIARO_AVX512 inline __m512 load_normal(const std::array<std::int16_t, 16>& q) {
  const __m256i upper = _mm256_and_si256(_mm256_loadu_si256(reinterpret_cast<const __m256i*>(q.data())), _mm256_set1_epi16(~15));
  return _mm512_mul_ps(_mm512_cvtepi32_ps(_mm512_cvtepi16_epi32(upper)), _mm512_set1_ps(kOverSnorm));
}
CHIARO_AVX512 inline __m512 dot(__m512 ax, __m512 ay, __m512 az, __m512 bx, __m512 by, __m512 bz) {
  return _mm512_add_ps(_mm512_add_ps(_mm512_mul_ps(ax, bx), _mm512_mul_ps(ay, by)), _mm512_mul_ps(az, bz));
}

// What intersect_plain() does. Most blocks that Embree offers are missed, so first the spheres around the discs: rounding moves the ray's distance from a centre by
// 4e-7 of the centre's distance from the origin at most, and (r + error)^2 <= 17/16 r^2 + 17 error^2.
CHIARO_AVX512 std::uint32_t intersect_avx512(const SurfelBlock& block, const DiscScale& scale, const LocalRay& ray, float share, BlockHits& hits) {
  const __m512 zero = _mm512_setzero_ps(), step = _mm512_set1_ps(scale.step);
  const __m512 dx = _mm512_set1_ps(ray.direction[0]), dy = _mm512_set1_ps(ray.direction[1]), dz = _mm512_set1_ps(ray.direction[2]);
  const __m512 cx = load_coordinate(block.x, step, ray.origin[0]), cy = load_coordinate(block.y, step, ray.origin[1]), cz = load_coordinate(block.z, step, ray.origin[2]);
  const __m128i codes = _mm_loadu_si128(reinterpret_cast<const __m128i*>(block.log_radius.data())), flags = _mm_loadu_si128(reinterpret_cast<const __m128i*>(block.flags.data()));
  const __m512i code = _mm512_cvtepu8_epi32(codes), octaves = _mm512_sub_epi32(_mm512_set1_epi32(15), _mm512_srli_epi32(code, 4));
  const __m512i top = _mm512_castps_si512(_mm512_permutexvar_ps(code, _mm512_load_ps(kRadii.top.data())));   // by the lower four bits
  const __m512 radius2 = _mm512_castsi512_ps(_mm512_sub_epi32(top, _mm512_slli_epi32(octaves, 24)));
  const __m512 r2 = _mm512_mul_ps(radius2, _mm512_set1_ps(scale.radius2_max * share));
  const __m512 along = dot(cx, cy, cz, dx, dy, dz), far2 = dot(cx, cy, cz, cx, cy, cz);
  const __m512 sx = _mm512_sub_ps(cx, _mm512_mul_ps(along, dx)), sy = _mm512_sub_ps(cy, _mm512_mul_ps(along, dy)), sz = _mm512_sub_ps(cz, _mm512_mul_ps(along, dz));
  const __m512 most = _mm512_add_ps(_mm512_mul_ps(r2, _mm512_set1_ps(1.0626f)), _mm512_mul_ps(far2, _mm512_set1_ps(17 * 4e-7f * 4e-7f)));
  __mmask16 mask = _mm512_mask_cmp_ps_mask(_mm_testn_epi8_mask(flags, _mm_set1_epi8(SurfelBlock::kPadding)), dot(sx, sy, sz, sx, sy, sz), most, _CMP_LE_OQ);
  if (mask == 0) return 0;
  const __m512 u = load_normal(block.normal_u), v = load_normal(block.normal_v);
  const __m512 nz = _mm512_sub_ps(_mm512_sub_ps(_mm512_set1_ps(1), _mm512_abs_ps(u)), _mm512_abs_ps(v)), fold = _mm512_max_ps(_mm512_sub_ps(zero, nz), zero);
  const __m512 sign = _mm512_set1_ps(-0.0f);
  const __m512 nx = _mm512_sub_ps(u, _mm512_or_ps(fold, _mm512_and_ps(u, sign))), ny = _mm512_sub_ps(v, _mm512_or_ps(fold, _mm512_and_ps(v, sign)));
  const __m512 t = _mm512_div_ps(dot(nx, ny, nz, cx, cy, cz), dot(nx, ny, nz, dx, dy, dz));
  const __m512 ex = _mm512_sub_ps(_mm512_mul_ps(t, dx), cx), ey = _mm512_sub_ps(_mm512_mul_ps(t, dy), cy), ez = _mm512_sub_ps(_mm512_mul_ps(t, dz), cz);
  const __m512 d2 = dot(ex, ey, ez, ex, ey, ez);
  mask = _mm512_mask_cmp_ps_mask(mask, d2, r2, _CMP_LT_OQ);
  mask = _mm512_mask_cmp_ps_mask(mask, t, _mm512_set1_ps(ray.t_min), _CMP_GT_OQ);
  mask = _mm512_mask_cmp_ps_mask(mask, t, _mm512_set1_ps(ray.t_max), _CMP_LE_OQ);
  if (mask == 0) return 0;
  _mm512_store_ps(hits.t, t);
  _mm512_store_ps(hits.distance2, d2);
  _mm512_store_ps(hits.radius2, r2);
  return mask;
}

bool has_avx512() {
  return __builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512bw") && __builtin_cpu_supports("avx512dq") && __builtin_cpu_supports("avx512vl");
}
bool wide = has_avx512();
#endif

}  // namespace

void use_wide_discs(bool use) {
#if defined(CHIARO_AVX512)
  wide = use && has_avx512();
#else
  static_cast<void>(use);
#endif
}

std::uint32_t intersect_block(const SurfelBlock& block, const DiscScale& scale, const LocalRay& ray, float share, BlockHits& hits) {
#if defined(CHIARO_AVX512)
  if (wide) return intersect_avx512(block, scale, ray, share, hits);
#endif
  return intersect_plain(block, kRadii.all.data(), scale, ray, share, hits);
}

CHIARO_CLONES BlockBox box_of_block(const SurfelBlock& block, const DiscScale& scale) {
  alignas(64) float normal[3][16], radius[16], low[16], high[16];
  stream::decode_normals(block, normal[0], normal[1], normal[2]);
  for (int i = 0; i < 16; ++i) radius[i] = kRadii.all[block.log_radius[i]] * scale.radius2_max;
  for (int i = 0; i < 16; ++i) radius[i] = std::sqrt(radius[i]);
  BlockBox box;
  for (std::size_t a = 0; a < 3; ++a) {
    const std::array<std::uint16_t, 16>& q = a == 0 ? block.x : a == 1 ? block.y : block.z;
    const float* n = normal[a];
    for (int i = 0; i < 16; ++i) {
      // A disc of radius r with normal n reaches r * sqrt(1 - n_a^2) along axis a; a little more against rounding.
      const float across2 = 1.0f - n[i] * n[i], reach = radius[i] * std::sqrt(across2 > 0.0f ? across2 : 0.0f) + (radius[i] * 1e-3f + 1e-6f);
      const float centre = (static_cast<float>(q[i]) + 0.5f) * scale.step;
      const bool padding = (block.flags[i] & SurfelBlock::kPadding) != 0;
      low[i] = padding ? 1e30f : centre - reach;
      high[i] = padding ? -1e30f : centre + reach;
    }
    for (int half = 8; half > 0; half /= 2)
      for (int i = 0; i < half; ++i) {
        low[i] = low[i + half] < low[i] ? low[i + half] : low[i];
        high[i] = high[i + half] > high[i] ? high[i + half] : high[i];
      }
    box.lower[a] = low[0];
    box.upper[a] = high[0];
  }
  return box;
}

float radius2_of(const SurfelBlock& block, std::size_t lane, const DiscScale& scale) { return kRadii.all[block.log_radius[lane]] * scale.radius2_max; }

// The clip line, see stream::DiscClip: two triangle waves around the diamond.
bool is_beyond_clip(const SurfelBlock& block, std::size_t lane, const DiscScale& scale, const LocalRay& ray, float t) {
  const int clip = stream::clip_of(block, lane);
  const float q[3] = {static_cast<float>(block.x[lane]), static_cast<float>(block.y[lane]), static_cast<float>(block.z[lane])};
  float e[3];
  for (int a = 0; a < 3; ++a) e[a] = t * ray.direction[a] - ((q[a] + 0.5f) * scale.step - ray.origin[a]);
  const Vec3f n = stream::decode_octahedron(block.normal_u[lane], block.normal_v[lane]).cwiseAbs();   // what encode_clip() chooses the axes by
  const bool z = n[2] >= n[0] && n[2] >= n[1], y = n[1] >= n[0];
  const float a = z ? e[0] : y ? e[2] : e[1], b = z ? e[1] : y ? e[0] : e[2];
  const float turn = static_cast<float>(clip >> 5) * (4.0f / DiscClip::kDirections), quarter = turn >= 1.0f ? turn - 1.0f : turn + 3.0f;
  const float u = std::fabs(turn - 2.0f) - 1.0f, v = std::fabs(quarter - 2.0f) - 1.0f;
  const float away = static_cast<float>((clip & 31) - 1) * (1.0f / DiscClip::kDistances) * std::sqrt(radius2_of(block, lane, scale));
  return u * a + v * b > away;
}

}  // namespace chiaro::surfels
