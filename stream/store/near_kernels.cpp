#include "stream/store/near_kernels.h"

#include <algorithm>
#include <cmath>
#include <limits>

#include "stream/store/lanes.h"

namespace chiaro::stream {
namespace {

constexpr float kInfinity = std::numeric_limits<float>::infinity();

template <std::size_t N>
CHIARO_INLINE void nearest_body(const CandidateView& c, const LanePoints& p, Nearest& out) {
  using Floats = typename LaneTypes<N>::Floats;
  for (std::size_t first = 0; first < kLanes; first += N) {
    Floats px, py, pz, best[kNearest];
    load(&p.x[first], px);
    load(&p.y[first], py);
    load(&p.z[first], pz);
    const Floats far = Floats{} + kInfinity;
    for (Floats& b : best) b = far;
    for (std::size_t k = 0; k < c.num; ++k) {
      const Floats dx = c.x[k] - px, dy = c.y[k] - py, dz = c.z[k] - pz;
      Floats d = dx * dx + dy * dy + dz * dz;
      d = d > Floats{} ? d : far;
      for (Floats& b : best) {
        const Floats low = b < d ? b : d;
        d = b < d ? d : b;
        b = low;
      }
    }
    for (std::size_t i = 0; i < kNearest; ++i) store(best[i], &out.squared[i][first]);
  }
}

// Roots in a loop of their own, from a copy: only so does the compiler take many at once.
CHIARO_INLINE void distances_body(const Nearest& nearest, LaneFloats& sixth, LaneFloats& mean) {
  LaneFloats sum{}, number{}, distance{};
  for (const LaneFloats& squared : nearest.squared) {
    const LaneFloats from = squared;
    for (std::size_t lane = 0; lane < kLanes; ++lane) distance[lane] = std::sqrt(from[lane]);
    for (std::size_t lane = 0; lane < kLanes; ++lane) {
      const bool there = distance[lane] < kInfinity;
      sum[lane] += there ? distance[lane] : 0.0f;
      number[lane] += there ? 1.0f : 0.0f;
    }
  }
  for (std::size_t lane = 0; lane < kLanes; ++lane) mean[lane] = number[lane] > 0 ? sum[lane] / number[lane] : 0.0f;
  sixth = distance;
}

template <class Floats>
CHIARO_INLINE void add_terms(const Floats& x, const Floats& y, const Floats& z, Floats* sums) {
  sums[0] += x;
  sums[1] += y;
  sums[2] += z;
  sums[3] += x * x;
  sums[4] += x * y;
  sums[5] += x * z;
  sums[6] += y * y;
  sums[7] += y * z;
  sums[8] += z * z;
}

template <std::size_t N>
CHIARO_INLINE void moments_body(const CandidateView& c, const LanePoints& p, const LaneFloats& limits, LaneMoments& out) {
  using Floats = typename LaneTypes<N>::Floats;
  using Mask = typename LaneTypes<N>::Mask;
  for (std::size_t first = 0; first < kLanes; first += N) {
    Floats px, py, pz, limit, sums[kTerms];
    load(&p.x[first], px);
    load(&p.y[first], py);
    load(&p.z[first], pz);
    load(&limits[first], limit);
    for (std::size_t t = 0; t < kTerms; ++t) load(&out.sum[t][first], sums[t]);
    const Floats one = Floats{} + 1.0f;
    for (std::size_t k = 0; k < c.num; ++k) {
      Floats x = c.x[k] - px, y = c.y[k] - py, z = c.z[k] - pz;
      const Mask inside = x * x + y * y + z * z <= limit;
      x = inside ? x : Floats{};
      y = inside ? y : Floats{};
      z = inside ? z : Floats{};
      add_terms(x, y, z, sums);
      sums[9] += inside ? one : Floats{};
    }
    for (std::size_t t = 0; t < kTerms; ++t) store(sums[t], &out.sum[t][first]);
  }
}

// Always by eight lanes, which are added in the same order.
CHIARO_INLINE double lanes_together(const LaneTypes<8>::Floats& sum) {
  float l[8];
  store(sum, l);
  return static_cast<double>(((l[0] + l[4]) + (l[2] + l[6])) + ((l[1] + l[5]) + (l[3] + l[7])));
}

CHIARO_INLINE void row_moments_body(const NeighbourRow& row, float limit, Moments& out) {
  using Floats = LaneTypes<8>::Floats;
  Floats sums[kTerms] = {};
  const Floats limits = Floats{} + limit, one = Floats{} + 1.0f;
  for (std::size_t k = 0; k < row.num; k += 8) {
    Floats x, y, z, d;
    load(&row.x[k], x);
    load(&row.y[k], y);
    load(&row.z[k], z);
    load(&row.distance_squared[k], d);
    const LaneTypes<8>::Mask inside = d <= limits;
    x = inside ? x : Floats{};
    y = inside ? y : Floats{};
    z = inside ? z : Floats{};
    sums[9] += inside ? one : Floats{};
    add_terms(x, y, z, sums);
  }
  for (std::size_t t = 0; t < kTerms; ++t) out[t] = lanes_together(sums[t]);
}

#if defined(CHIARO_AVX2)
CHIARO_AVX2 void nearest_avx2(const CandidateView& c, const LanePoints& p, Nearest& out) { nearest_body<8>(c, p, out); }
CHIARO_AVX2 void distances_avx2(const Nearest& nearest, LaneFloats& sixth, LaneFloats& mean) { distances_body(nearest, sixth, mean); }
CHIARO_AVX2 void row_moments_avx2(const NeighbourRow& row, float limit, Moments& out) { row_moments_body(row, limit, out); }
CHIARO_AVX2 void moments_avx2(const CandidateView& c, const LanePoints& p, const LaneFloats& limits, LaneMoments& out) { moments_body<8>(c, p, limits, out); }

CHIARO_AVX512 void nearest_avx512(const CandidateView& c, const LanePoints& p, Nearest& out) { nearest_body<16>(c, p, out); }
CHIARO_AVX512 void distances_avx512(const Nearest& nearest, LaneFloats& sixth, LaneFloats& mean) { distances_body(nearest, sixth, mean); }

// What moments_body() does. Additions are what it waits for: some processors have other units for products, which add as well, and round the same, by a product with one.
CHIARO_AVX512 void moments_avx512(const CandidateView& c, const LanePoints& p, const LaneFloats& limits, LaneMoments& out) {
  const __m512 px = _mm512_loadu_ps(p.x.data()), py = _mm512_loadu_ps(p.y.data()), pz = _mm512_loadu_ps(p.z.data()), limit = _mm512_loadu_ps(limits.data());
  __m512 one = _mm512_set1_ps(1), sums[kTerms];
  __asm__("" : "+v"(one));   // not known to be one: the compiler would make additions again
  for (std::size_t t = 0; t < kTerms; ++t) sums[t] = _mm512_loadu_ps(out.sum[t].data());
  for (std::size_t k = 0; k < c.num; ++k) {
    __m512 x = _mm512_sub_ps(_mm512_set1_ps(c.x[k]), px), y = _mm512_sub_ps(_mm512_set1_ps(c.y[k]), py), z = _mm512_sub_ps(_mm512_set1_ps(c.z[k]), pz);
    const __m512 xx = _mm512_mul_ps(x, x), yy = _mm512_mul_ps(y, y), zz = _mm512_mul_ps(z, z);
    const __mmask16 inside = _mm512_cmp_ps_mask(_mm512_add_ps(_mm512_add_ps(xx, yy), zz), limit, _CMP_LE_OQ);
    sums[0] = _mm512_mask_add_ps(sums[0], inside, sums[0], x);
    sums[1] = _mm512_mask_add_ps(sums[1], inside, sums[1], y);
    sums[2] = _mm512_mask_add_ps(sums[2], inside, sums[2], z);
    sums[3] = _mm512_mask3_fmadd_ps(xx, one, sums[3], inside);
    sums[4] = _mm512_mask_add_ps(sums[4], inside, sums[4], _mm512_mul_ps(x, y));
    sums[5] = _mm512_mask_add_ps(sums[5], inside, sums[5], _mm512_mul_ps(x, z));
    sums[6] = _mm512_mask3_fmadd_ps(yy, one, sums[6], inside);
    sums[7] = _mm512_mask_add_ps(sums[7], inside, sums[7], _mm512_mul_ps(y, z));
    sums[8] = _mm512_mask3_fmadd_ps(zz, one, sums[8], inside);
    sums[9] = _mm512_mask3_fmadd_ps(one, one, sums[9], inside);
  }
  for (std::size_t t = 0; t < kTerms; ++t) _mm512_storeu_ps(out.sum[t].data(), sums[t]);
}
#endif

}  // namespace

// Vectors are stored whole, so that there has to be room for one behind the last number.
void NeighbourRow::reserve(std::size_t most) {
  const std::size_t room = most + 2 * kLanes;
  if (x.size() >= room) return;
  for (std::vector<float>* v : {&x, &y, &z, &distance_squared}) v->resize(room);
  candidate.resize(room);
}

void NeighbourRow::pad() {
  for (std::size_t k = num; k < num + kLanes; ++k) {
    x[k] = y[k] = z[k] = 0;
    distance_squared[k] = kInfinity;
    candidate[k] = 0;
  }
}

void nearest_of(const CandidateView& c, const LanePoints& p, Nearest& out) {
#if defined(CHIARO_AVX2)
  if (vector_width() == VectorWidth::kAvx512) return nearest_avx512(c, p, out);
  if (vector_width() == VectorWidth::kAvx2) return nearest_avx2(c, p, out);
#endif
  nearest_body<8>(c, p, out);
}

void distances_of(const Nearest& nearest, LaneFloats& sixth, LaneFloats& mean) {
#if defined(CHIARO_AVX2)
  if (vector_width() == VectorWidth::kAvx512) return distances_avx512(nearest, sixth, mean);
  if (vector_width() == VectorWidth::kAvx2) return distances_avx2(nearest, sixth, mean);
#endif
  distances_body(nearest, sixth, mean);
}

Moments moments_within(const NeighbourRow& row, float limit) {
  Moments out;
#if defined(CHIARO_AVX2)
  if (vector_width() >= VectorWidth::kAvx2) {
    row_moments_avx2(row, limit, out);
    return out;
  }
#endif
  row_moments_body(row, limit, out);
  return out;
}

void add_moments(const CandidateView& c, const LanePoints& p, const LaneFloats& limits, LaneMoments& out) {
#if defined(CHIARO_AVX2)
  if (vector_width() == VectorWidth::kAvx512) return moments_avx512(c, p, limits, out);
  if (vector_width() == VectorWidth::kAvx2) return moments_avx2(c, p, limits, out);
#endif
  moments_body<8>(c, p, limits, out);
}

}  // namespace chiaro::stream
