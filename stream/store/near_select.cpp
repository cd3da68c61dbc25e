#include "stream/store/near_select.h"

#include <algorithm>
#include <array>
#include <utility>

#include "stream/store/lanes.h"

namespace chiaro::stream {
namespace {

constexpr float kFar = 1e30f;
using Corner = std::array<float, 3>;

// What is written for a candidate: always all of it, and the place moves on where the candidate is taken.
CHIARO_INLINE void put(const CandidateView& c, std::size_t k, std::size_t n, Selection& out) {
  out.x[n] = c.x[k];
  out.y[n] = c.y[k];
  out.z[n] = c.z[k];
  if (out.has_index) out.index[n] = c.index ? c.index[k] : static_cast<std::uint32_t>(k);
  if (!c.nx) return;
  out.nx[n] = c.nx[k];
  out.ny[n] = c.ny[k];
  out.nz[n] = c.nz[k];
  if (c.oriented) out.oriented[n] = c.oriented[k];
}

float gap_squared(const CandidateView& c, std::size_t k, const Corner& min, const Corner& max) {
  const auto gap = [](float p, float low, float high) { return std::max(0.0f, std::max(low - p, p - high)); };
  const float dx = gap(c.x[k], min[0], max[0]), dy = gap(c.y[k], min[1], max[1]), dz = gap(c.z[k], min[2], max[2]);
  return dx * dx + dy * dy + dz * dz;
}

std::size_t select_plain(const CandidateView& c, std::size_t first, std::size_t last, const Corner& min, const Corner& max, float limit, std::size_t n, Selection& out) {
  for (std::size_t k = first; k < last; ++k) {
    put(c, k, n, out);
    n += gap_squared(c, k, min, max) <= limit;
  }
  return n;
}

void split_plain(const CandidateView& c, const Corner& min, const Corner& max, float near, float far, Selection& nearer, Selection& farther) {
  for (std::size_t k = 0; k < c.num; ++k) {
    const float d = gap_squared(c, k, min, max);
    put(c, k, nearer.num, nearer);
    put(c, k, farther.num, farther);
    nearer.num += d <= near;
    farther.num += !(d <= near) && d <= far;
  }
}

std::size_t collect_plain(const CandidateView& c, float px, float py, float pz, float limit, NeighbourRow& out) {
  std::size_t n = 0;
  for (std::size_t k = 0; k < c.num; ++k) {
    const float dx = c.x[k] - px, dy = c.y[k] - py, dz = c.z[k] - pz, d = dx * dx + dy * dy + dz * dz;
    out.x[n] = dx;
    out.y[n] = dy;
    out.z[n] = dz;
    out.distance_squared[n] = d;
    out.candidate[n] = c.index ? c.index[k] : static_cast<std::uint32_t>(k);
    n += static_cast<std::size_t>(d <= limit) & static_cast<std::size_t>(d > 0);
  }
  return n;
}

unsigned boxes_plain(const EightBoxes& b, const Corner& min, const Corner& max, float limit) {
  unsigned mask = 0;
  for (std::size_t i = 0; i < 8; ++i) {
    float d = 0;
    for (std::size_t a = 0; a < 3; ++a) {
      const float gap = std::max(0.0f, std::max(min[a] - b.max[a][i], b.min[a][i] - max[a]));
      d = a == 0 ? gap * gap : d + gap * gap;
    }
    mask |= static_cast<unsigned>(d <= limit) << i;
  }
  return mask;
}

// Visits the groups whose boxes come within the limit, in order.
template <class Boxes, class Group>
CHIARO_INLINE void visit_tree(const BoxLevels& levels, const Boxes& boxes, const Group& group) {
  // Elements to look at: their level and number. A level adds at most eight, of which one is taken up at once.
  std::array<std::pair<std::uint32_t, std::uint32_t>, 128> stack;
  std::size_t depth = 0;
  stack[depth++] = {static_cast<std::uint32_t>(levels.size() - 1), 0};
  while (depth > 0) {
    const auto [level, element] = stack[--depth];
    unsigned mask = boxes(levels[level][element]);
    if (level == 0) {
      for (; mask != 0; mask &= mask - 1) group(8 * element + static_cast<std::uint32_t>(__builtin_ctz(mask)));
      continue;
    }
    while (mask != 0) {  // the last is pushed first
      const auto top = static_cast<std::uint32_t>(31 - __builtin_clz(mask));
      stack[depth++] = {level - 1, 8 * element + top};
      mask ^= 1u << top;
    }
  }
}

template <class Boxes, class Select>
CHIARO_INLINE void tree_body(const BoxLevels& levels, Selection& out, const Boxes& boxes, const Select& select) {
  visit_tree(levels, boxes, [&](std::uint32_t group) {
    out.reserve(out.num + kBoxedPoints, out.has_index, out.has_normals);
    out.num = select(group * kBoxedPoints, out.num);
  });
}

#if defined(CHIARO_AVX2)
// Distance to a box, for eight or sixteen at a time.
struct Avx2Box {
  __m256 low[3], high[3];
};
CHIARO_AVX2 inline Avx2Box avx2_box(const Corner& min, const Corner& max) {
  return {{_mm256_set1_ps(min[0]), _mm256_set1_ps(min[1]), _mm256_set1_ps(min[2])}, {_mm256_set1_ps(max[0]), _mm256_set1_ps(max[1]), _mm256_set1_ps(max[2])}};
}
CHIARO_AVX2 inline __m256 gap_squared(const Avx2Box& b, __m256 x, __m256 y, __m256 z) {
  const __m256 zero = _mm256_setzero_ps();
  const __m256 dx = _mm256_max_ps(zero, _mm256_max_ps(_mm256_sub_ps(b.low[0], x), _mm256_sub_ps(x, b.high[0])));
  const __m256 dy = _mm256_max_ps(zero, _mm256_max_ps(_mm256_sub_ps(b.low[1], y), _mm256_sub_ps(y, b.high[1])));
  const __m256 dz = _mm256_max_ps(zero, _mm256_max_ps(_mm256_sub_ps(b.low[2], z), _mm256_sub_ps(z, b.high[2])));
  return _mm256_add_ps(_mm256_add_ps(_mm256_mul_ps(dx, dx), _mm256_mul_ps(dy, dy)), _mm256_mul_ps(dz, dz));
}
CHIARO_AVX2 inline void put_lanes(float* to, __m256 v, __m256i order) { _mm256_storeu_ps(to, _mm256_permutevar8x32_ps(v, order)); }
CHIARO_AVX2 inline void put_lanes(std::uint32_t* to, __m256i v, __m256i order) { _mm256_storeu_si256(reinterpret_cast<__m256i*>(to), _mm256_permutevar8x32_epi32(v, order)); }
CHIARO_AVX2 inline __m256i load_numbers(const std::uint32_t* from) { return _mm256_loadu_si256(reinterpret_cast<const __m256i*>(from)); }
CHIARO_AVX2 inline __m256i numbers_from(std::size_t first) { return _mm256_add_epi32(_mm256_setr_epi32(0, 1, 2, 3, 4, 5, 6, 7), _mm256_set1_epi32(static_cast<int>(first))); }

CHIARO_AVX2 std::size_t collect_avx2(const CandidateView& c, float px, float py, float pz, float limit, NeighbourRow& out) {
  const __m256 x0 = _mm256_set1_ps(px), y0 = _mm256_set1_ps(py), z0 = _mm256_set1_ps(pz), most = _mm256_set1_ps(limit), zero = _mm256_setzero_ps();
  std::size_t n = 0;
  for (std::size_t k = 0; k < c.num; k += 8) {
    const __m256 dx = _mm256_sub_ps(_mm256_loadu_ps(c.x + k), x0), dy = _mm256_sub_ps(_mm256_loadu_ps(c.y + k), y0), dz = _mm256_sub_ps(_mm256_loadu_ps(c.z + k), z0);
    const __m256 d = _mm256_add_ps(_mm256_add_ps(_mm256_mul_ps(dx, dx), _mm256_mul_ps(dy, dy)), _mm256_mul_ps(dz, dz));
    const auto mask = static_cast<unsigned>(_mm256_movemask_ps(_mm256_and_ps(_mm256_cmp_ps(d, most, _CMP_LE_OQ), _mm256_cmp_ps(d, zero, _CMP_GT_OQ))));
    // No branch: which of the eight are near is hard to foretell.
    const __m256i order = compression_of(mask);
    put_lanes(&out.x[n], dx, order);
    put_lanes(&out.y[n], dy, order);
    put_lanes(&out.z[n], dz, order);
    put_lanes(&out.distance_squared[n], d, order);
    put_lanes(&out.candidate[n], c.index ? load_numbers(c.index + k) : numbers_from(k), order);
    n += static_cast<std::size_t>(_mm_popcnt_u32(mask));
  }
  return n;
}

CHIARO_AVX2 unsigned boxes_avx2(const EightBoxes& b, const Corner& min, const Corner& max, float limit) {
  const __m256 zero = _mm256_setzero_ps();
  __m256 d = zero;
  for (std::size_t a = 0; a < 3; ++a) {
    const __m256 below = _mm256_sub_ps(_mm256_set1_ps(min[a]), _mm256_loadu_ps(b.max[a])), above = _mm256_sub_ps(_mm256_loadu_ps(b.min[a]), _mm256_set1_ps(max[a]));
    const __m256 gap = _mm256_max_ps(zero, _mm256_max_ps(below, above)), square = _mm256_mul_ps(gap, gap);
    d = a == 0 ? square : _mm256_add_ps(d, square);
  }
  return static_cast<unsigned>(_mm256_movemask_ps(_mm256_cmp_ps(d, _mm256_set1_ps(limit), _CMP_LE_OQ)));
}

CHIARO_AVX2 inline void put_avx2(const CandidateView& c, std::size_t k, __m256 x, __m256 y, __m256 z, unsigned mask, std::size_t n, Selection& out) {
  const __m256i order = compression_of(mask);
  put_lanes(&out.x[n], x, order);
  put_lanes(&out.y[n], y, order);
  put_lanes(&out.z[n], z, order);
  if (out.has_index) put_lanes(&out.index[n], c.index ? load_numbers(c.index + k) : numbers_from(k), order);
  if (!c.nx) return;
  put_lanes(&out.nx[n], _mm256_loadu_ps(c.nx + k), order);
  put_lanes(&out.ny[n], _mm256_loadu_ps(c.ny + k), order);
  put_lanes(&out.nz[n], _mm256_loadu_ps(c.nz + k), order);
  if (c.oriented) put_lanes(&out.oriented[n], load_numbers(c.oriented + k), order);
}

// Behind the last candidate, up to a multiple of kLanes, there are far ones.
CHIARO_AVX2 std::size_t select_avx2(const CandidateView& c, std::size_t first, std::size_t last, const Corner& min, const Corner& max, float limit, std::size_t n, Selection& out) {
  const Avx2Box box = avx2_box(min, max);
  const __m256 most = _mm256_set1_ps(limit);
  for (std::size_t k = first; k < last; k += 8) {
    const __m256 x = _mm256_loadu_ps(c.x + k), y = _mm256_loadu_ps(c.y + k), z = _mm256_loadu_ps(c.z + k);
    const auto mask = static_cast<unsigned>(_mm256_movemask_ps(_mm256_cmp_ps(gap_squared(box, x, y, z), most, _CMP_LE_OQ)));
    if (mask == 0) continue;
    put_avx2(c, k, x, y, z, mask, n, out);
    n += static_cast<std::size_t>(_mm_popcnt_u32(mask));
  }
  return n;
}

CHIARO_AVX2 void split_avx2(const CandidateView& c, const Corner& min, const Corner& max, float near, float far, Selection& nearer, Selection& farther) {
  const Avx2Box box = avx2_box(min, max);
  const __m256 near_limit = _mm256_set1_ps(near), far_limit = _mm256_set1_ps(far);
  for (std::size_t k = 0; k < c.num; k += 8) {
    const __m256 x = _mm256_loadu_ps(c.x + k), y = _mm256_loadu_ps(c.y + k), z = _mm256_loadu_ps(c.z + k), d = gap_squared(box, x, y, z);
    const auto in_near = static_cast<unsigned>(_mm256_movemask_ps(_mm256_cmp_ps(d, near_limit, _CMP_LE_OQ)));
    const auto in_far = static_cast<unsigned>(_mm256_movemask_ps(_mm256_cmp_ps(d, far_limit, _CMP_LE_OQ))) & ~in_near;
    if (in_near != 0) put_avx2(c, k, x, y, z, in_near, nearer.num, nearer);
    if (in_far != 0) put_avx2(c, k, x, y, z, in_far, farther.num, farther);
    nearer.num += static_cast<std::size_t>(_mm_popcnt_u32(in_near));
    farther.num += static_cast<std::size_t>(_mm_popcnt_u32(in_far));
  }
}

struct Avx512Box {
  __m512 low[3], high[3];
};
CHIARO_AVX512 inline Avx512Box avx512_box(const Corner& min, const Corner& max) {
  return {{_mm512_set1_ps(min[0]), _mm512_set1_ps(min[1]), _mm512_set1_ps(min[2])}, {_mm512_set1_ps(max[0]), _mm512_set1_ps(max[1]), _mm512_set1_ps(max[2])}};
}
CHIARO_AVX512 inline __m512 gap_squared(const Avx512Box& b, __m512 x, __m512 y, __m512 z) {
  const __m512 zero = _mm512_setzero_ps();
  const __m512 dx = _mm512_max_ps(zero, _mm512_max_ps(_mm512_sub_ps(b.low[0], x), _mm512_sub_ps(x, b.high[0])));
  const __m512 dy = _mm512_max_ps(zero, _mm512_max_ps(_mm512_sub_ps(b.low[1], y), _mm512_sub_ps(y, b.high[1])));
  const __m512 dz = _mm512_max_ps(zero, _mm512_max_ps(_mm512_sub_ps(b.low[2], z), _mm512_sub_ps(z, b.high[2])));
  return _mm512_add_ps(_mm512_add_ps(_mm512_mul_ps(dx, dx), _mm512_mul_ps(dy, dy)), _mm512_mul_ps(dz, dz));
}
CHIARO_AVX512 inline void put_lanes(float* to, __m512 v, __mmask16 mask) { _mm512_storeu_ps(to, _mm512_maskz_compress_ps(mask, v)); }
CHIARO_AVX512 inline void put_lanes(std::uint32_t* to, __m512i v, __mmask16 mask) { _mm512_storeu_si512(to, _mm512_maskz_compress_epi32(mask, v)); }
CHIARO_AVX512 inline __m512i sixteen_numbers_from(std::size_t first) {
  return _mm512_add_epi32(_mm512_setr_epi32(0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15), _mm512_set1_epi32(static_cast<int>(first)));
}

CHIARO_AVX512 inline void put_avx512(const CandidateView& c, std::size_t k, __m512 x, __m512 y, __m512 z, __mmask16 mask, std::size_t n, Selection& out) {
  put_lanes(&out.x[n], x, mask);
  put_lanes(&out.y[n], y, mask);
  put_lanes(&out.z[n], z, mask);
  if (out.has_index) put_lanes(&out.index[n], c.index ? _mm512_loadu_si512(c.index + k) : sixteen_numbers_from(k), mask);
  if (!c.nx) return;
  put_lanes(&out.nx[n], _mm512_loadu_ps(c.nx + k), mask);
  put_lanes(&out.ny[n], _mm512_loadu_ps(c.ny + k), mask);
  put_lanes(&out.nz[n], _mm512_loadu_ps(c.nz + k), mask);
  if (c.oriented) put_lanes(&out.oriented[n], _mm512_loadu_si512(c.oriented + k), mask);
}

CHIARO_AVX512 std::size_t select_avx512(const CandidateView& c, std::size_t first, std::size_t last, const Corner& min, const Corner& max, float limit, std::size_t n, Selection& out) {
  const Avx512Box box = avx512_box(min, max);
  const __m512 most = _mm512_set1_ps(limit);
  for (std::size_t k = first; k < last; k += 16) {
    const __m512 x = _mm512_loadu_ps(c.x + k), y = _mm512_loadu_ps(c.y + k), z = _mm512_loadu_ps(c.z + k);
    const __mmask16 mask = _mm512_cmp_ps_mask(gap_squared(box, x, y, z), most, _CMP_LE_OQ);
    put_avx512(c, k, x, y, z, mask, n, out);
    n += static_cast<std::size_t>(_mm_popcnt_u32(mask));
  }
  return n;
}

CHIARO_AVX512 void split_avx512(const CandidateView& c, const Corner& min, const Corner& max, float near, float far, Selection& nearer, Selection& farther) {
  const Avx512Box box = avx512_box(min, max);
  const __m512 near_limit = _mm512_set1_ps(near), far_limit = _mm512_set1_ps(far);
  std::size_t n = 0, m = 0;
  for (std::size_t k = 0; k < c.num; k += 16) {
    const __m512 x = _mm512_loadu_ps(c.x + k), y = _mm512_loadu_ps(c.y + k), z = _mm512_loadu_ps(c.z + k), d = gap_squared(box, x, y, z);
    const __mmask16 in_near = _mm512_cmp_ps_mask(d, near_limit, _CMP_LE_OQ), in_far = _mm512_cmp_ps_mask(d, far_limit, _CMP_LE_OQ) & static_cast<__mmask16>(~in_near);
    put_avx512(c, k, x, y, z, in_near, n, nearer);
    put_avx512(c, k, x, y, z, in_far, m, farther);
    n += static_cast<std::size_t>(_mm_popcnt_u32(in_near));
    m += static_cast<std::size_t>(_mm_popcnt_u32(in_far));
  }
  nearer.num = n;
  farther.num = m;
}

CHIARO_AVX512 std::size_t collect_avx512(const CandidateView& c, float px, float py, float pz, float limit, NeighbourRow& out) {
  const __m512 x0 = _mm512_set1_ps(px), y0 = _mm512_set1_ps(py), z0 = _mm512_set1_ps(pz), most = _mm512_set1_ps(limit), zero = _mm512_setzero_ps();
  std::size_t n = 0;
  for (std::size_t k = 0; k < c.num; k += 16) {
    const __m512 dx = _mm512_sub_ps(_mm512_loadu_ps(c.x + k), x0), dy = _mm512_sub_ps(_mm512_loadu_ps(c.y + k), y0), dz = _mm512_sub_ps(_mm512_loadu_ps(c.z + k), z0);
    const __m512 d = _mm512_add_ps(_mm512_add_ps(_mm512_mul_ps(dx, dx), _mm512_mul_ps(dy, dy)), _mm512_mul_ps(dz, dz));
    const __mmask16 mask = _mm512_mask_cmp_ps_mask(_mm512_cmp_ps_mask(d, most, _CMP_LE_OQ), d, zero, _CMP_GT_OQ);
    put_lanes(&out.x[n], dx, mask);
    put_lanes(&out.y[n], dy, mask);
    put_lanes(&out.z[n], dz, mask);
    put_lanes(&out.distance_squared[n], d, mask);
    put_lanes(&out.candidate[n], c.index ? _mm512_loadu_si512(c.index + k) : sixteen_numbers_from(k), mask);
    n += static_cast<std::size_t>(_mm_popcnt_u32(mask));
  }
  return n;
}
#endif

}  // namespace

// Vectors are stored whole, so that there has to be room for one behind the last number.
void Selection::reserve(std::size_t most, bool with_index, bool with_normals) {
  has_index = with_index;
  has_normals = with_normals;
  const std::size_t room = x.size() >= most + 2 * kLanes ? x.size() : std::max(most + 2 * kLanes, 2 * x.size());
  if (x.size() < room)
    for (std::vector<float>* v : {&x, &y, &z}) v->resize(room);
  if (with_index && index.size() < room) index.resize(room);
  if (!with_normals || nx.size() >= room) return;
  for (std::vector<float>* v : {&nx, &ny, &nz}) v->resize(room);
  oriented.resize(room);
}

void Selection::pad() {
  for (std::size_t k = num; k < num + kLanes; ++k) x[k] = y[k] = z[k] = kFar;
}

CandidateView Selection::renumbered() const {
  CandidateView v{x.data(), y.data(), z.data(), num};
  if (has_normals) {
    v.nx = nx.data();
    v.ny = ny.data();
    v.nz = nz.data();
    v.oriented = oriented.data();
  }
  return v;
}

CandidateView Selection::view() const {
  CandidateView v = renumbered();
  if (has_index) v.index = index.data();
  return v;
}

void select_near_box(const CandidateView& c, const Corner& min, const Corner& max, float limit, bool with_index, Selection& out) {
  [[maybe_unused]] const VectorWidth width = vector_width();
  out.reserve(c.num, with_index, c.nx != nullptr);
#if defined(CHIARO_AVX2)
  out.num = width == VectorWidth::kAvx512 ? select_avx512(c, 0, c.num, min, max, limit, 0, out)
            : width == VectorWidth::kAvx2 ? select_avx2(c, 0, c.num, min, max, limit, 0, out)
                                          : select_plain(c, 0, c.num, min, max, limit, 0, out);
#else
  out.num = select_plain(c, 0, c.num, min, max, limit, 0, out);
#endif
  out.pad();
}

void split_near_box(const CandidateView& c, const Corner& min, const Corner& max, float near, float far, Selection& nearer, Selection& farther) {
  [[maybe_unused]] const VectorWidth width = vector_width();
  for (Selection* s : {&nearer, &farther}) {
    s->reserve(c.num, false, c.nx != nullptr);
    s->num = 0;
  }
#if defined(CHIARO_AVX2)
  if (width == VectorWidth::kAvx512) split_avx512(c, min, max, near, far, nearer, farther);
  else if (width == VectorWidth::kAvx2) split_avx2(c, min, max, near, far, nearer, farther);
  else split_plain(c, min, max, near, far, nearer, farther);
#else
  split_plain(c, min, max, near, far, nearer, farther);
#endif
  nearer.pad();
  farther.pad();
}

void select_from_tree(const CandidateView& c, const BoxLevels& levels, const Corner& min, const Corner& max, float limit, Selection& out) {
  [[maybe_unused]] const VectorWidth width = vector_width();
#if defined(CHIARO_AVX2)
  const auto boxes = [&](const EightBoxes& b) { return boxes_avx2(b, min, max, limit); };
  if (width == VectorWidth::kAvx512)
    return tree_body(levels, out, boxes, [&](std::size_t first, std::size_t n) { return select_avx512(c, first, first + kBoxedPoints, min, max, limit, n, out); });
  if (width == VectorWidth::kAvx2)
    return tree_body(levels, out, boxes, [&](std::size_t first, std::size_t n) { return select_avx2(c, first, first + kBoxedPoints, min, max, limit, n, out); });
#endif
  tree_body(levels, out, [&](const EightBoxes& b) { return boxes_plain(b, min, max, limit); },
            [&](std::size_t first, std::size_t n) { return select_plain(c, first, first + kBoxedPoints, min, max, limit, n, out); });
}

void collect_within(const CandidateView& c, float x, float y, float z, float limit, NeighbourRow& out) {
  [[maybe_unused]] const VectorWidth width = vector_width();
  out.reserve(c.num);
#if defined(CHIARO_AVX2)
  out.num = width == VectorWidth::kAvx512 ? collect_avx512(c, x, y, z, limit, out) : width == VectorWidth::kAvx2 ? collect_avx2(c, x, y, z, limit, out) : collect_plain(c, x, y, z, limit, out);
#else
  out.num = collect_plain(c, x, y, z, limit, out);
#endif
  out.pad();
}

}  // namespace chiaro::stream
