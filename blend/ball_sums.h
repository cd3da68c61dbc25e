/// Sums over balls around pixels: the inner loop of SurfacePyramid, for up to four pixels at a time, with AVX-512 or AVX2 where the processor has them. All
/// ways give the same bits: a ball's blocks are added in four lanes by their column, row by row, and nothing is contracted. Internal to blend.
#pragma once
#include <array>
#include <cstddef>
#include <limits>

namespace chiaro::blend {

/// What is kept of four blocks beside each other: a plane of four numbers after the other.
enum Plane : std::size_t { kX, kY, kZ, kArea, kRed, kGreen, kBlue, kNormalX, kNormalY, kNormalZ, kCos, kPlanes };
inline constexpr std::size_t kBlocksTogether = 4, kGroupFloats = kPlanes * kBlocksTogether;

inline constexpr std::size_t kBallsTogether = 4, kBallLanes = kBallsTogether * kBlocksTogether;
/// Columns of one ball are 19 at most; those of another one begin up to three farther on, and both ends are those of groups.
inline constexpr std::size_t kMostGroups = 7;

using BallLanes = std::array<float, kBallLanes>;   ///< four lanes a ball

/// Balls over the same rows of blocks.
struct alignas(64) BallBatch {
  BallLanes x, y, z, inverse_squared;   ///< centre, 1 / radius²
  BallLanes nx, ny, nz;                 ///< normal in the middle
  std::array<BallLanes, kMostGroups> within;   ///< 1 where a column of blocks is the ball's; kOutside: takes no part
  const float* first = nullptr;         ///< group of the first row, aligned to 16 bytes
  std::size_t row_stride = 0;           ///< floats from there to the next row
  std::size_t rows = 0, groups = 0, balls = 0;
  static constexpr float kOutside = -std::numeric_limits<float>::infinity();
};

/// Of each ball over its columns, those with the same place in their group together. Blocks weigh their area, less towards the rim; `facing` those that face as
/// the middle does.
struct alignas(64) BallSums {
  BallLanes weight, red, green, blue, facing, cosv;
};
void sum_balls(const BallBatch& batch, BallSums& sums);

/// Lanes of one ball. The same bits wherever a group begins.
inline float sum_of_lanes(const BallLanes& lanes, std::size_t ball) {
  const float* l = &lanes[ball * kBlocksTogether];
  return (l[0] + l[2]) + (l[1] + l[3]);
}

}  // namespace chiaro::blend
