/// What the kernels of tangent_kernels.h have in common for all widths. Internal to them.
#pragma once
#include <limits>

#include "stream/store/lanes.h"
#include "stream/store/tangent_kernels.h"

namespace chiaro::stream {

inline constexpr float kInfinity = std::numeric_limits<float>::infinity();
inline constexpr float kBeyond = 1.00001f;

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

inline constexpr float kD1 = 0.92387953f, kD2 = 0.70710678f, kD3 = 0.38268343f;
inline constexpr float kCos[CellCorners::kDirections] = {1, kD1, kD2, kD3, 0, -kD3, -kD2, -kD1, -1, -kD1, -kD2, -kD3, 0, kD3, kD2, kD1};
inline constexpr float kSin[CellCorners::kDirections] = {0, kD3, kD2, kD1, 1, kD1, kD2, kD3, 0, -kD3, -kD2, -kD1, -1, -kD1, -kD2, -kD3};
// The side of a square that is met first.
inline constexpr float kSquareX[CellCorners::kDirections] = {1, 1, 1, 0, 0, 0, -1, -1, -1, -1, -1, 0, 0, 0, 1, 1};
inline constexpr float kSquareY[CellCorners::kDirections] = {0, 0, 0, 1, 1, 1, 0, 0, 0, 0, 0, -1, -1, -1, 0, 0};

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

}  // namespace chiaro::stream
