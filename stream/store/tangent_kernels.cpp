#include "stream/store/tangent_kernels.h"

#include <algorithm>
#include <cmath>

#include "stream/store/tangent_bodies.h"
#include "stream/store/tangent_vectors.h"

namespace chiaro::stream {
namespace {

// What tangent_vectors.h computes for a neighbour; with the same operations in the same order.
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

// Bits of the corners beyond the line (wx, wy) that are not settled.
std::uint64_t beyond_plain(const CellCorners& c, float wx, float wy) {
  std::uint64_t mask = 0;
  for (std::size_t k = 0; k < c.size; ++k) mask |= static_cast<std::uint64_t>((c.squared[k] >= 0) & (wx * c.x[k] + wy * c.y[k] > 1)) << k;
  return mask;
}

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
