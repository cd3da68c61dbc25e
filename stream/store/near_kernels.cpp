#include "stream/store/near_kernels.h"

#include <algorithm>
#include <limits>
#include <utility>

#include "stream/store/block.h"
#include "stream/store/lanes.h"

#if defined(__x86_64__)
#include <immintrin.h>
#endif

namespace chiaro::stream {
namespace {

#if defined(CHIARO_AVX2)
bool has_avx2() { return __builtin_cpu_supports("avx2") && __builtin_cpu_supports("popcnt"); }
bool use_avx2 = has_avx2();
#endif

constexpr float kInfinity = std::numeric_limits<float>::infinity();

CHIARO_INLINE void nearest_body(const CandidateView& c, const EightPoints& p, Nearest& out) {
  Lanes px, py, pz, best[kNearest];
  load(p.x.data(), px);
  load(p.y.data(), py);
  load(p.z.data(), pz);
  const Lanes far = Lanes{} + kInfinity;
  for (Lanes& b : best) b = far;
  for (std::size_t k = 0; k < c.num; ++k) {
    const Lanes dx = c.x[k] - px, dy = c.y[k] - py, dz = c.z[k] - pz;
    Lanes d = dx * dx + dy * dy + dz * dz;
    d = d > Lanes{} ? d : far;
    for (Lanes& b : best) {
      const Lanes low = b < d ? b : d;
      d = b < d ? d : b;
      b = low;
    }
  }
  for (std::size_t i = 0; i < kNearest; ++i) store(best[i], out.squared[i]);
}

std::size_t collect_plain(const CandidateView& c, float px, float py, float pz, float limit, NeighbourRow& out) {
  float *x = out.x.data(), *y = out.y.data(), *z = out.z.data(), *d2 = out.distance_squared.data();
  std::uint32_t* candidate = out.candidate.data();
  std::size_t n = 0;
  for (std::size_t k = 0; k < c.num; ++k) {
    const float dx = c.x[k] - px, dy = c.y[k] - py, dz = c.z[k] - pz, d = dx * dx + dy * dy + dz * dz;
    x[n] = dx;
    y[n] = dy;
    z[n] = dz;
    d2[n] = d;
    candidate[n] = c.index ? c.index[k] : static_cast<std::uint32_t>(k);
    n += static_cast<std::size_t>(d <= limit) & static_cast<std::size_t>(d > 0);
  }
  return n;
}

std::size_t select_plain(const CandidateView& c, std::size_t first, std::size_t last, const std::array<float, 3>& min, const std::array<float, 3>& max, float limit, std::size_t n, Selection& out) {
  const auto gap = [](float p, float low, float high) { return std::max(0.0f, std::max(low - p, p - high)); };
  for (std::size_t k = first; k < last; ++k) {
    const float dx = gap(c.x[k], min[0], max[0]), dy = gap(c.y[k], min[1], max[1]), dz = gap(c.z[k], min[2], max[2]);
    out.x[n] = c.x[k];
    out.y[n] = c.y[k];
    out.z[n] = c.z[k];
    out.index[n] = c.index ? c.index[k] : static_cast<std::uint32_t>(k);
    n += dx * dx + dy * dy + dz * dz <= limit;
  }
  return n;
}

void grow(Selection& s, std::size_t size) {
  if (s.x.size() >= size) return;
  size = std::max(size, 2 * s.x.size());
  for (std::vector<float>* v : {&s.x, &s.y, &s.z}) v->resize(size);
  s.index.resize(size);
}

unsigned boxes_plain(const EightBoxes& b, const std::array<float, 3>& min, const std::array<float, 3>& max, float limit) {
  unsigned mask = 0;
  for (std::size_t i = 0; i < kLanes; ++i) {
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

CHIARO_INLINE void add_terms(const Lanes& x, const Lanes& y, const Lanes& z, Lanes* sums) {
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

// Sums of the eight lanes of nine vectors, always in the same order.
CHIARO_INLINE void add_lanes(const Lanes (&sums)[9], Moments& out) {
  float lanes[9][kLanes];
  for (std::size_t t = 0; t < 9; ++t) store(sums[t], lanes[t]);
  for (std::size_t t = 0; t < 9; ++t) {
    const float* l = lanes[t];
    out[t] = static_cast<double>(((l[0] + l[4]) + (l[2] + l[6])) + ((l[1] + l[5]) + (l[3] + l[7])));
  }
}

CHIARO_INLINE void moments_body(const NeighbourRow& row, float limit, Moments& out) {
  Lanes sums[9] = {};
  Lanes number = {};
  const Lanes limits = Lanes{} + limit, one = Lanes{} + 1.0f;
  for (std::size_t k = 0; k < row.num; k += kLanes) {
    Lanes x, y, z, d;
    load(&row.x[k], x);
    load(&row.y[k], y);
    load(&row.z[k], z);
    load(&row.distance_squared[k], d);
    const LaneMask inside = d <= limits;
    x = inside ? x : Lanes{};
    y = inside ? y : Lanes{};
    z = inside ? z : Lanes{};
    number += inside ? one : Lanes{};
    add_terms(x, y, z, sums);
  }
  add_lanes(sums, out);
  float n[kLanes];
  store(number, n);
  out[9] = static_cast<double>(((n[0] + n[4]) + (n[2] + n[6])) + ((n[1] + n[5]) + (n[3] + n[7])));
}

CHIARO_INLINE void eight_moments_body(const CandidateView& c, const EightPoints& p, const std::array<float, kLanes>& limits, EightMoments& out) {
  Lanes px, py, pz, limit, sums[kTerms] = {};
  load(p.x.data(), px);
  load(p.y.data(), py);
  load(p.z.data(), pz);
  load(limits.data(), limit);
  const Lanes one = Lanes{} + 1.0f;
  for (std::size_t k = 0; k < c.num; ++k) {
    Lanes x = c.x[k] - px, y = c.y[k] - py, z = c.z[k] - pz;
    const LaneMask inside = x * x + y * y + z * z <= limit;
    x = inside ? x : Lanes{};
    y = inside ? y : Lanes{};
    z = inside ? z : Lanes{};
    add_terms(x, y, z, sums);
    sums[9] += inside ? one : Lanes{};
  }
  for (std::size_t t = 0; t < kTerms; ++t) store(sums[t], out.sum[t].data());
}

constexpr float kCos[kLanes] = {1, 0.70710678f, 0, -0.70710678f, -1, -0.70710678f, 0, 0.70710678f};
constexpr float kSin[kLanes] = {0, 0.70710678f, 1, 0.70710678f, 0, -0.70710678f, -1, -0.70710678f};

// What has the largest product with a direction is met first.
CHIARO_INLINE void lines_of_directions(const float* wx, const float* wy, std::size_t num, float half, EightLines& out) {
  Lanes c, s, best, best_x, best_y;
  load(kCos, c);
  load(kSin, s);
  const float side = 1 / half;
  const float square_x[kLanes] = {side, side, 0, 0, -side, -side, 0, 0}, square_y[kLanes] = {0, 0, side, side, 0, 0, -side, -side};
  load(square_x, best_x);
  load(square_y, best_y);
  best = c * best_x + s * best_y;
  for (std::size_t k = 0; k < num; ++k) {
    const Lanes vx = Lanes{} + wx[k], vy = Lanes{} + wy[k], along = c * vx + s * vy;
    const LaneMask first = along > best;
    best = first ? along : best;
    best_x = first ? vx : best_x;
    best_y = first ? vy : best_y;
  }
  store(best_x, out.x.data());
  store(best_y, out.y.data());
  out.x[8] = out.x[0];
  out.y[8] = out.y[0];
  Lanes next_x, next_y;
  load(out.x.data() + 1, next_x);
  load(out.y.data() + 1, next_y);
  const Lanes cross = best_x * next_y - best_y * next_x, corner_x = (next_y - best_y) / cross, corner_y = (best_x - next_x) / cross;
  const LaneMask same = (best_x == next_x) & (best_y == next_y), meet = cross > Lanes{};
  Lanes squared = corner_x * corner_x + corner_y * corner_y;
  squared = meet ? squared : Lanes{} + kInfinity;
  squared = same ? Lanes{} - 1.0f : squared;
  store(corner_x, out.corner_x.data());
  store(corner_y, out.corner_y.data());
  store(squared, out.corner_squared.data());
}

CHIARO_INLINE std::size_t line_before_body(const float* wx, const float* wy, std::size_t num, float x, float y) {
  Lanes best = Lanes{} + 1.00001f;
  LaneMask number = {0, 1, 2, 3, 4, 5, 6, 7}, which = LaneMask{} - 1;
  for (std::size_t k = 0; k < num; k += kLanes) {
    Lanes lx, ly;
    load(wx + k, lx);
    load(wy + k, ly);
    const Lanes along = lx * x + ly * y;
    const LaneMask more = along > best;
    best = more ? along : best;
    which = more ? number : which;
    number += 8;
  }
  float values[kLanes];
  std::int32_t numbers[kLanes];
  store(best, values);
  __builtin_memcpy(numbers, &which, sizeof numbers);
  std::size_t at = 0;
  for (std::size_t lane = 1; lane < kLanes; ++lane)
    if (values[lane] > values[at]) at = lane;
  return numbers[at] < 0 ? num : static_cast<std::size_t>(numbers[at]);
}

CHIARO_INLINE bool any_of(const LaneMask& mask) {
  std::uint64_t words[4];
  __builtin_memcpy(words, &mask, sizeof mask);
  return (words[0] | words[1] | words[2] | words[3]) != 0;
}

CHIARO_INLINE void absolute_of(const Lanes& v, Lanes& out) { out = v < Lanes{} ? -v : v; }

CHIARO_INLINE bool lines_body(const NeighbourRow& row, const NeighbourNormals& normals, const TangentFrame& f, TangentLines& out) {
  const Lanes reach = Lanes{} + f.edge_reach * f.edge_reach, other_face = Lanes{} + f.other_face;
  const LaneMask own_oriented = LaneMask{} - static_cast<std::int32_t>(f.oriented);
  for (std::size_t k = 0; k < row.num; k += kLanes) {
    Lanes x, y, z, d, nx, ny, nz;
    LaneMask oriented;
    load(&row.x[k], x);
    load(&row.y[k], y);
    load(&row.z[k], z);
    load(&row.distance_squared[k], d);
    load(&normals.x[k], nx);
    load(&normals.y[k], ny);
    load(&normals.z[k], nz);
    __builtin_memcpy(&oriented, &normals.oriented[k], sizeof oriented);
    const Lanes cosine = f.normal[0] * nx + f.normal[1] * ny + f.normal[2] * nz;
    Lanes size;
    absolute_of(cosine, size);
    if (any_of((size < other_face) & (d <= reach))) return false;
    const Lanes height = f.normal[0] * x + f.normal[1] * y + f.normal[2] * z;
    const LaneMask both = oriented & own_oriented;
    const Lanes towards = both ? cosine : size;
    const LaneMask holds = (4.0f * height * height <= d) & (towards >= Lanes{} + 0.5f);
    const Lanes u = f.u[0] * x + f.u[1] * y + f.u[2] * z, v = f.v[0] * x + f.v[1] * y + f.v[2] * z, over = 2.0f / d;
    store(u, &out.u[k]);
    store(v, &out.v[k]);
    store(holds ? u * over : Lanes{}, &out.wx[k]);
    store(holds ? v * over : Lanes{}, &out.wy[k]);
  }
  return true;
}

CHIARO_INLINE bool beyond_body(const TangentLines& lines, float x, float y, float distance, std::size_t num) {
  const Lanes far = Lanes{} + distance;
  for (std::size_t k = 0; k < num; k += kLanes) {
    Lanes u, v;
    load(&lines.u[k], u);
    load(&lines.v[k], v);
    const Lanes across = v * x - u * y;
    Lanes aside;
    absolute_of(across, aside);
    if (any_of((u * x + v * y >= far) & (aside <= far))) return true;
  }
  return false;
}

#if defined(CHIARO_AVX2)
// Which lanes to take so that those of a mask come first.
struct Compression {
  alignas(32) std::int32_t lane[256][8];
  constexpr Compression() : lane{} {
    for (int mask = 0; mask < 256; ++mask) {
      int n = 0;
      for (int i = 0; i < 8; ++i)
        if (mask & (1 << i)) lane[mask][n++] = i;
    }
  }
};
constexpr Compression kCompression;

CHIARO_AVX2 std::size_t collect_avx2(const CandidateView& c, float px, float py, float pz, float limit, NeighbourRow& out) {
  const __m256 x0 = _mm256_set1_ps(px), y0 = _mm256_set1_ps(py), z0 = _mm256_set1_ps(pz), most = _mm256_set1_ps(limit), zero = _mm256_setzero_ps();
  __m256i number = _mm256_setr_epi32(0, 1, 2, 3, 4, 5, 6, 7);
  const __m256i eight = _mm256_set1_epi32(8);
  float *x = out.x.data(), *y = out.y.data(), *z = out.z.data(), *d2 = out.distance_squared.data();
  std::uint32_t* candidate = out.candidate.data();
  std::size_t n = 0;
  for (std::size_t k = 0; k < c.num; k += kLanes) {
    const __m256 dx = _mm256_sub_ps(_mm256_loadu_ps(c.x + k), x0), dy = _mm256_sub_ps(_mm256_loadu_ps(c.y + k), y0), dz = _mm256_sub_ps(_mm256_loadu_ps(c.z + k), z0);
    const __m256 d = _mm256_add_ps(_mm256_add_ps(_mm256_mul_ps(dx, dx), _mm256_mul_ps(dy, dy)), _mm256_mul_ps(dz, dz));
    const auto mask = static_cast<unsigned>(_mm256_movemask_ps(_mm256_and_ps(_mm256_cmp_ps(d, most, _CMP_LE_OQ), _mm256_cmp_ps(d, zero, _CMP_GT_OQ))));
    // No branch: which of the eight are near is hard to foretell.
    const __m256i order = _mm256_load_si256(reinterpret_cast<const __m256i*>(kCompression.lane[mask]));
    const __m256i index = c.index ? _mm256_loadu_si256(reinterpret_cast<const __m256i*>(c.index + k)) : number;
    _mm256_storeu_ps(x + n, _mm256_permutevar8x32_ps(dx, order));
    _mm256_storeu_ps(y + n, _mm256_permutevar8x32_ps(dy, order));
    _mm256_storeu_ps(z + n, _mm256_permutevar8x32_ps(dz, order));
    _mm256_storeu_ps(d2 + n, _mm256_permutevar8x32_ps(d, order));
    _mm256_storeu_si256(reinterpret_cast<__m256i*>(candidate + n), _mm256_permutevar8x32_epi32(index, order));
    n += static_cast<std::size_t>(_mm_popcnt_u32(mask));
    number = _mm256_add_epi32(number, eight);
  }
  return n;
}

CHIARO_AVX2 unsigned boxes_avx2(const EightBoxes& b, const std::array<float, 3>& min, const std::array<float, 3>& max, float limit) {
  const __m256 zero = _mm256_setzero_ps();
  __m256 d = zero;
  for (std::size_t a = 0; a < 3; ++a) {
    const __m256 below = _mm256_sub_ps(_mm256_set1_ps(min[a]), _mm256_loadu_ps(b.max[a])), above = _mm256_sub_ps(_mm256_loadu_ps(b.min[a]), _mm256_set1_ps(max[a]));
    const __m256 gap = _mm256_max_ps(zero, _mm256_max_ps(below, above)), square = _mm256_mul_ps(gap, gap);
    d = a == 0 ? square : _mm256_add_ps(d, square);
  }
  return static_cast<unsigned>(_mm256_movemask_ps(_mm256_cmp_ps(d, _mm256_set1_ps(limit), _CMP_LE_OQ)));
}

// Behind the last candidate, up to a multiple of eight, there are far ones.
CHIARO_AVX2 std::size_t select_avx2(const CandidateView& c, std::size_t first, std::size_t last, const std::array<float, 3>& min, const std::array<float, 3>& max, float limit,
                                    std::size_t n, Selection& out) {
  const __m256 low_x = _mm256_set1_ps(min[0]), low_y = _mm256_set1_ps(min[1]), low_z = _mm256_set1_ps(min[2]);
  const __m256 high_x = _mm256_set1_ps(max[0]), high_y = _mm256_set1_ps(max[1]), high_z = _mm256_set1_ps(max[2]);
  const __m256 most = _mm256_set1_ps(limit), zero = _mm256_setzero_ps();
  const __m256i eight = _mm256_set1_epi32(8);
  __m256i number = _mm256_add_epi32(_mm256_setr_epi32(0, 1, 2, 3, 4, 5, 6, 7), _mm256_set1_epi32(static_cast<int>(first)));
  for (std::size_t k = first; k < last; k += kLanes) {
    const __m256 x = _mm256_loadu_ps(c.x + k), y = _mm256_loadu_ps(c.y + k), z = _mm256_loadu_ps(c.z + k);
    const __m256 dx = _mm256_max_ps(zero, _mm256_max_ps(_mm256_sub_ps(low_x, x), _mm256_sub_ps(x, high_x)));
    const __m256 dy = _mm256_max_ps(zero, _mm256_max_ps(_mm256_sub_ps(low_y, y), _mm256_sub_ps(y, high_y)));
    const __m256 dz = _mm256_max_ps(zero, _mm256_max_ps(_mm256_sub_ps(low_z, z), _mm256_sub_ps(z, high_z)));
    const __m256 d = _mm256_add_ps(_mm256_add_ps(_mm256_mul_ps(dx, dx), _mm256_mul_ps(dy, dy)), _mm256_mul_ps(dz, dz));
    const auto mask = static_cast<unsigned>(_mm256_movemask_ps(_mm256_cmp_ps(d, most, _CMP_LE_OQ)));
    if (mask != 0) {
      const __m256i order = _mm256_load_si256(reinterpret_cast<const __m256i*>(kCompression.lane[mask]));
      const __m256i index = c.index ? _mm256_loadu_si256(reinterpret_cast<const __m256i*>(c.index + k)) : number;
      _mm256_storeu_ps(&out.x[n], _mm256_permutevar8x32_ps(x, order));
      _mm256_storeu_ps(&out.y[n], _mm256_permutevar8x32_ps(y, order));
      _mm256_storeu_ps(&out.z[n], _mm256_permutevar8x32_ps(z, order));
      _mm256_storeu_si256(reinterpret_cast<__m256i*>(&out.index[n]), _mm256_permutevar8x32_epi32(index, order));
      n += static_cast<std::size_t>(_mm_popcnt_u32(mask));
    }
    number = _mm256_add_epi32(number, eight);
  }
  return n;
}

CHIARO_AVX2 void tree_avx2(const CandidateView& c, const BoxLevels& levels, const std::array<float, 3>& min, const std::array<float, 3>& max, float limit, Selection& out) {
  visit_tree(levels, [&](const EightBoxes& b) { return boxes_avx2(b, min, max, limit); },
             [&](std::uint32_t group) {
               grow(out, out.num + kBoxedPoints + 2 * kLanes);
               out.num = select_avx2(c, group * kBoxedPoints, group * kBoxedPoints + kBoxedPoints, min, max, limit, out.num, out);
             });
}

CHIARO_AVX2 void nearest_avx2(const CandidateView& c, const EightPoints& p, Nearest& out) {
  const __m256 px = _mm256_loadu_ps(p.x.data()), py = _mm256_loadu_ps(p.y.data()), pz = _mm256_loadu_ps(p.z.data());
  const __m256 far = _mm256_set1_ps(kInfinity), zero = _mm256_setzero_ps();
  __m256 best[kNearest] = {far, far, far, far, far, far};
  for (std::size_t k = 0; k < c.num; ++k) {
    const __m256 dx = _mm256_sub_ps(_mm256_set1_ps(c.x[k]), px), dy = _mm256_sub_ps(_mm256_set1_ps(c.y[k]), py), dz = _mm256_sub_ps(_mm256_set1_ps(c.z[k]), pz);
    __m256 d = _mm256_add_ps(_mm256_add_ps(_mm256_mul_ps(dx, dx), _mm256_mul_ps(dy, dy)), _mm256_mul_ps(dz, dz));
    d = _mm256_blendv_ps(far, d, _mm256_cmp_ps(d, zero, _CMP_GT_OQ));
    for (std::size_t i = 0; i < kNearest; ++i) {
      const __m256 low = _mm256_min_ps(best[i], d);
      d = _mm256_max_ps(best[i], d);
      best[i] = low;
    }
  }
  for (std::size_t i = 0; i < kNearest; ++i) _mm256_storeu_ps(out.squared[i], best[i]);
}
CHIARO_AVX2 void moments_avx2(const NeighbourRow& row, float limit, Moments& out) { moments_body(row, limit, out); }
CHIARO_AVX2 void eight_moments_avx2(const CandidateView& c, const EightPoints& p, const std::array<float, kLanes>& limits, EightMoments& out) { eight_moments_body(c, p, limits, out); }
CHIARO_AVX2 bool lines_avx2(const NeighbourRow& row, const NeighbourNormals& normals, const TangentFrame& frame, TangentLines& out) { return lines_body(row, normals, frame, out); }
CHIARO_AVX2 bool beyond_avx2(const TangentLines& lines, float x, float y, float distance, std::size_t num) { return beyond_body(lines, x, y, distance, num); }
CHIARO_AVX2 void directions_avx2(const float* wx, const float* wy, std::size_t num, float half, EightLines& out) { lines_of_directions(wx, wy, num, half, out); }
CHIARO_AVX2 std::size_t line_before_avx2(const float* wx, const float* wy, std::size_t num, float x, float y) { return line_before_body(wx, wy, num, x, y); }
#endif

}  // namespace

void use_wide_vectors(bool use) {
#if defined(CHIARO_AVX2)
  use_avx2 = use && has_avx2();
#else
  static_cast<void>(use);
#endif
}

bool wide_vectors() {
#if defined(CHIARO_AVX2)
  return use_avx2;
#else
  return false;
#endif
}

void NeighbourRow::reserve(std::size_t most) {
  most = (most + 2 * kLanes) / kLanes * kLanes;
  if (x.size() >= most) return;
  for (std::vector<float>* v : {&x, &y, &z, &distance_squared}) v->resize(most);
  candidate.resize(most);
}

void NeighbourRow::pad() {
  const std::size_t end = (num + kLanes - 1) / kLanes * kLanes;
  for (std::size_t k = num; k < end; ++k) {
    x[k] = y[k] = z[k] = 0;
    distance_squared[k] = kInfinity;
    candidate[k] = 0;
  }
}

void nearest_of(const CandidateView& c, const EightPoints& p, Nearest& out) {
#if defined(CHIARO_AVX2)
  if (use_avx2) return nearest_avx2(c, p, out);
#endif
  nearest_body(c, p, out);
}

void select_near_box(const CandidateView& c, const std::array<float, 3>& min, const std::array<float, 3>& max, float limit, Selection& out) {
  grow(out, c.num + 2 * kLanes);
#if defined(CHIARO_AVX2)
  out.num = use_avx2 ? select_avx2(c, 0, c.num, min, max, limit, 0, out) : select_plain(c, 0, c.num, min, max, limit, 0, out);
#else
  out.num = select_plain(c, 0, c.num, min, max, limit, 0, out);
#endif
  for (std::size_t k = out.num; k < out.num + kLanes; ++k) out.x[k] = out.y[k] = out.z[k] = 1e30f;
}

void select_from_tree(const CandidateView& c, const BoxLevels& levels, const std::array<float, 3>& min, const std::array<float, 3>& max, float limit, Selection& out) {
#if defined(CHIARO_AVX2)
  if (use_avx2) return tree_avx2(c, levels, min, max, limit, out);
#endif
  visit_tree(levels, [&](const EightBoxes& b) { return boxes_plain(b, min, max, limit); },
             [&](std::uint32_t group) {
               grow(out, out.num + kBoxedPoints + 2 * kLanes);
               out.num = select_plain(c, group * kBoxedPoints, group * kBoxedPoints + kBoxedPoints, min, max, limit, out.num, out);
             });
}

void collect_within(const CandidateView& c, float x, float y, float z, float limit, NeighbourRow& out) {
  out.reserve(c.num);
#if defined(CHIARO_AVX2)
  out.num = use_avx2 ? collect_avx2(c, x, y, z, limit, out) : collect_plain(c, x, y, z, limit, out);
#else
  out.num = collect_plain(c, x, y, z, limit, out);
#endif
  out.pad();
}

Moments moments_within(const NeighbourRow& row, float limit) {
  Moments out;
#if defined(CHIARO_AVX2)
  if (use_avx2) {
    moments_avx2(row, limit, out);
    return out;
  }
#endif
  moments_body(row, limit, out);
  return out;
}

void moments_of(const CandidateView& c, const EightPoints& p, const std::array<float, kLanes>& limits, EightMoments& out) {
#if defined(CHIARO_AVX2)
  if (use_avx2) return eight_moments_avx2(c, p, limits, out);
#endif
  eight_moments_body(c, p, limits, out);
}

EightLines nearest_lines(const float* wx, const float* wy, std::size_t num, float half) {
  EightLines out;
#if defined(CHIARO_AVX2)
  if (use_avx2) {
    directions_avx2(wx, wy, num, half, out);
    return out;
  }
#endif
  lines_of_directions(wx, wy, num, half, out);
  return out;
}

std::size_t line_before(const float* wx, const float* wy, std::size_t num, float x, float y) {
#if defined(CHIARO_AVX2)
  if (use_avx2) return line_before_avx2(wx, wy, num, x, y);
#endif
  return line_before_body(wx, wy, num, x, y);
}

void NeighbourNormals::take(const float* nx, const float* ny, const float* nz, const std::uint8_t* flags, const NeighbourRow& row) {
  if (x.size() < row.x.size()) {
    for (std::vector<float>* v : {&x, &y, &z}) v->resize(row.x.size());
    oriented.resize(row.x.size());
  }
  const std::size_t end = (row.num + kLanes - 1) / kLanes * kLanes;
  for (std::size_t k = 0; k < end; ++k) {
    const std::uint32_t j = row.candidate[k];
    x[k] = nx[j];
    y[k] = ny[j];
    z[k] = nz[j];
    oriented[k] = 0u - static_cast<std::uint32_t>((flags[j] & SurfelBlock::kOriented) != 0);
  }
}

bool TangentLines::make(const NeighbourRow& row, const NeighbourNormals& normals, const TangentFrame& frame) {
  if (u.size() < row.x.size())
    for (std::vector<float>* values : {&u, &v, &wx, &wy}) values->resize(row.x.size());
#if defined(CHIARO_AVX2)
  if (use_avx2) return lines_avx2(row, normals, frame, *this);
#endif
  return lines_body(row, normals, frame, *this);
}

bool TangentLines::is_beyond(float x, float y, float distance, std::size_t num) const {
#if defined(CHIARO_AVX2)
  if (use_avx2) return beyond_avx2(*this, x, y, distance, num);
#endif
  return beyond_body(*this, x, y, distance, num);
}

}  // namespace chiaro::stream
