#include "blend/ball_sums.h"

#include "blend/four.h"
#include "stream/base/intrinsics.h"
#include "stream/base/vector_width.h"

namespace chiaro::blend {
namespace {

void sum_plain(const BallBatch& b, std::size_t ball, BallSums& sums) {
  const std::size_t at = ball * kBlocksTogether;
  const Four x = load_four(&b.x[at]), y = load_four(&b.y[at]), z = load_four(&b.z[at]), inverse_squared = load_four(&b.inverse_squared[at]), nx = load_four(&b.nx[at]), ny = load_four(&b.ny[at]), nz = load_four(&b.nz[at]);
  Four weight{}, red{}, green{}, blue{}, facing{}, cosv{};
  for (std::size_t v = 0; v < b.rows; ++v) {
    const float* group = b.first + v * b.row_stride;
    for (std::size_t g = 0; g < b.groups; ++g, group += kGroupFloats) {
      const auto plane = [&](Plane p) { return load_four(group + p * kBlocksTogether); };
      const Four dx = plane(kX) - x, dy = plane(kY) - y, dz = plane(kZ) - z;
      const Four w = positive(load_four(&b.within[g][at]) - (dx * dx + dy * dy + dz * dz) * inverse_squared) * plane(kArea);   // 0 where there is nothing
      if (!is_any(w > 0)) continue;
      weight += w;
      red += w * plane(kRed);
      green += w * plane(kGreen);
      blue += w * plane(kBlue);
      const Four towards = w * positive(plane(kNormalX) * nx + plane(kNormalY) * ny + plane(kNormalZ) * nz);
      facing += towards;
      cosv += towards * plane(kCos);
    }
  }
  store_four(weight, &sums.weight[at]);
  store_four(red, &sums.red[at]);
  store_four(green, &sums.green[at]);
  store_four(blue, &sums.blue[at]);
  store_four(facing, &sums.facing[at]);
  store_four(cosv, &sums.cosv[at]);
}

#if defined(CHIARO_AVX2)
/// Four blocks, before each of two balls.
CHIARO_AVX2 inline __m256 twice(const float* four) { return _mm256_broadcast_ps(reinterpret_cast<const __m128*>(four)); }
CHIARO_AVX2 inline __m256 plus_product(__m256 sum, __m256 a, __m256 b) { return _mm256_add_ps(sum, _mm256_mul_ps(a, b)); }

CHIARO_AVX2 void sum_avx2(const BallBatch& b, std::size_t ball, BallSums& sums) {
  const std::size_t at = ball * kBlocksTogether;
  const __m256 zero = _mm256_setzero_ps(), x = _mm256_load_ps(&b.x[at]), y = _mm256_load_ps(&b.y[at]), z = _mm256_load_ps(&b.z[at]), inverse_squared = _mm256_load_ps(&b.inverse_squared[at]);
  const __m256 nx = _mm256_load_ps(&b.nx[at]), ny = _mm256_load_ps(&b.ny[at]), nz = _mm256_load_ps(&b.nz[at]);
  __m256 weight = zero, red = zero, green = zero, blue = zero, facing = zero, cosv = zero;
  for (std::size_t v = 0; v < b.rows; ++v) {
    const float* group = b.first + v * b.row_stride;
    for (std::size_t g = 0; g < b.groups; ++g, group += kGroupFloats) {
      const __m256 dx = _mm256_sub_ps(twice(group + 4 * kX), x), dy = _mm256_sub_ps(twice(group + 4 * kY), y), dz = _mm256_sub_ps(twice(group + 4 * kZ), z);
      const __m256 squared = plus_product(plus_product(_mm256_mul_ps(dx, dx), dy, dy), dz, dz);
      const __m256 near = _mm256_sub_ps(_mm256_load_ps(&b.within[g][at]), _mm256_mul_ps(squared, inverse_squared)), w = _mm256_mul_ps(_mm256_max_ps(near, zero), twice(group + 4 * kArea));
      if (_mm256_movemask_ps(_mm256_cmp_ps(w, zero, _CMP_GT_OQ)) == 0) continue;
      weight = _mm256_add_ps(weight, w);
      red = plus_product(red, w, twice(group + 4 * kRed));
      green = plus_product(green, w, twice(group + 4 * kGreen));
      blue = plus_product(blue, w, twice(group + 4 * kBlue));
      const __m256 along = plus_product(plus_product(_mm256_mul_ps(twice(group + 4 * kNormalX), nx), twice(group + 4 * kNormalY), ny), twice(group + 4 * kNormalZ), nz);
      const __m256 towards = _mm256_mul_ps(w, _mm256_max_ps(along, zero));
      facing = _mm256_add_ps(facing, towards);
      cosv = plus_product(cosv, towards, twice(group + 4 * kCos));
    }
  }
  _mm256_store_ps(&sums.weight[at], weight);
  _mm256_store_ps(&sums.red[at], red);
  _mm256_store_ps(&sums.green[at], green);
  _mm256_store_ps(&sums.blue[at], blue);
  _mm256_store_ps(&sums.facing[at], facing);
  _mm256_store_ps(&sums.cosv[at], cosv);
}

/// Four blocks, before each of four balls.
CHIARO_AVX512 inline __m512 four_times(const float* four) { return _mm512_broadcast_f32x4(_mm_load_ps(four)); }
CHIARO_AVX512 inline __m512 plus_product(__m512 sum, __m512 a, __m512 b) { return _mm512_add_ps(sum, _mm512_mul_ps(a, b)); }

CHIARO_AVX512 void sum_avx512(const BallBatch& b, BallSums& sums) {
  const __m512 zero = _mm512_setzero_ps(), x = _mm512_load_ps(b.x.data()), y = _mm512_load_ps(b.y.data()), z = _mm512_load_ps(b.z.data()), inverse_squared = _mm512_load_ps(b.inverse_squared.data());
  const __m512 nx = _mm512_load_ps(b.nx.data()), ny = _mm512_load_ps(b.ny.data()), nz = _mm512_load_ps(b.nz.data());
  __m512 weight = zero, red = zero, green = zero, blue = zero, facing = zero, cosv = zero;
  for (std::size_t v = 0; v < b.rows; ++v) {
    const float* group = b.first + v * b.row_stride;
    for (std::size_t g = 0; g < b.groups; ++g, group += kGroupFloats) {
      const __m512 dx = _mm512_sub_ps(four_times(group + 4 * kX), x), dy = _mm512_sub_ps(four_times(group + 4 * kY), y), dz = _mm512_sub_ps(four_times(group + 4 * kZ), z);
      const __m512 squared = plus_product(plus_product(_mm512_mul_ps(dx, dx), dy, dy), dz, dz);
      const __m512 near = _mm512_sub_ps(_mm512_load_ps(b.within[g].data()), _mm512_mul_ps(squared, inverse_squared)), w = _mm512_mul_ps(_mm512_max_ps(near, zero), four_times(group + 4 * kArea));
      if (_mm512_cmp_ps_mask(w, zero, _CMP_GT_OQ) == 0) continue;
      weight = _mm512_add_ps(weight, w);
      red = plus_product(red, w, four_times(group + 4 * kRed));
      green = plus_product(green, w, four_times(group + 4 * kGreen));
      blue = plus_product(blue, w, four_times(group + 4 * kBlue));
      const __m512 along = plus_product(plus_product(_mm512_mul_ps(four_times(group + 4 * kNormalX), nx), four_times(group + 4 * kNormalY), ny), four_times(group + 4 * kNormalZ), nz);
      const __m512 towards = _mm512_mul_ps(w, _mm512_max_ps(along, zero));
      facing = _mm512_add_ps(facing, towards);
      cosv = plus_product(cosv, towards, four_times(group + 4 * kCos));
    }
  }
  _mm512_store_ps(sums.weight.data(), weight);
  _mm512_store_ps(sums.red.data(), red);
  _mm512_store_ps(sums.green.data(), green);
  _mm512_store_ps(sums.blue.data(), blue);
  _mm512_store_ps(sums.facing.data(), facing);
  _mm512_store_ps(sums.cosv.data(), cosv);
}
#endif

}  // namespace

void sum_balls(const BallBatch& batch, BallSums& sums) {
#if defined(CHIARO_AVX2)
  if (vector_width() == VectorWidth::kAvx512) return sum_avx512(batch, sums);
  if (vector_width() == VectorWidth::kAvx2) {
    for (std::size_t ball = 0; ball < batch.balls; ball += 2) sum_avx2(batch, ball, sums);
    return;
  }
#endif
  for (std::size_t ball = 0; ball < batch.balls; ++ball) sum_plain(batch, ball, sums);
}

}  // namespace chiaro::blend
