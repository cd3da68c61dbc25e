/// The kernels of tangent_kernels.h for processors with AVX2 and AVX-512. Internal to them.
#pragma once
#include "stream/store/lanes.h"
#include "stream/store/tangent_kernels.h"

#if defined(CHIARO_AVX2)
namespace chiaro::stream {

bool lines_avx2(const CandidateView& c, const Place& p, float above, float limit, const TangentFrame& f, TangentLines& out);
std::size_t offsets_avx2(const CandidateView& c, const Place& p, float above, float limit, TangentLines& out);
void project_avx2(std::size_t last, const TangentFrame& f, TangentLines& out);
bool alike_avx2(const CandidateView& c, const Place& n, float least);
bool beyond_avx2(const TangentLines& lines, float x, float y, float distance);
void cell_avx2(const TangentLines& lines, float half, CellCorners& out);
/// Bits of the corners beyond the line (wx, wy) that are not settled.
std::uint64_t beyond_avx2(const CellCorners& c, float wx, float wy);

bool lines_avx512(const CandidateView& c, const Place& p, float above, float limit, const TangentFrame& f, TangentLines& out);
std::size_t offsets_avx512(const CandidateView& c, const Place& p, float above, float limit, TangentLines& out);
void project_avx512(std::size_t last, const TangentFrame& f, TangentLines& out);
bool beyond_avx512(const TangentLines& lines, float x, float y, float distance);
std::size_t line_before_avx512(const TangentLines& lines, float x, float y);
void cell_avx512(const TangentLines& lines, float half, CellCorners& out);
std::size_t farthest_avx512(const CellCorners& c);
/// Sets `started` of the points that it has done. Lines have room for 2 kLanes.
void nearest_corners_avx512(const CandidateView& c, std::span<SmoothPoint> points, std::span<TangentLines> lines, std::span<CellCorners> corners);

}  // namespace chiaro::stream
#endif
