#include "blend/bands.h"

#include <algorithm>
#include <cmath>

#include "blend/four.h"
#include "stream/base/parallel.h"

namespace chiaro::blend {
namespace {

constexpr std::size_t kLevels = 5;                // blocks of 1 .. kPyramidRows pixels
constexpr float kLeastRadiusBlocks = 4;   // a coarser level is taken from twice this radius on

float radius_in_pixels(float radius, float footprint) { return std::min(kMaxLowRadiusPx, radius / footprint); }

int level_for(float radius_px) {
  int level = 0;
  while (level + 1 < static_cast<int>(kLevels) && radius_px >= 2 * kLeastRadiusBlocks * static_cast<float>(1 << level)) ++level;
  return level;
}

/// Four blocks beside each other, a number of each in a Four.
using FourBlocks = std::array<Four, kPlanes>;

/// Every second of eight blocks from group `group` of a row on, the first or the second of each pair. Those beyond the row's end show nothing.
FourBlocks every_second(const float* row, std::size_t groups, std::size_t group, bool second) {
  FourBlocks blocks;
  for (std::size_t p = 0; p < kPlanes; ++p) {
    const auto four = [&](std::size_t g) { return g < groups ? load_four(row + g * kGroupFloats + p * kBlocksTogether) : Four{}; };
    const Four left = four(group), right = four(group + 1);
    blocks[p] = second ? __builtin_shufflevector(left, right, 1, 3, 5, 7) : __builtin_shufflevector(left, right, 0, 2, 4, 6);
  }
  return blocks;
}

/// Means of four blocks each by area; those far from the largest belong to another surface.
FourBlocks merged(const std::array<FourBlocks, 4>& children, float radius) {
  Four area = children[0][kArea], x = children[0][kX], y = children[0][kY], z = children[0][kZ];   // of the largest, the first of equals
  for (std::size_t i = 1; i < children.size(); ++i) {
    const FourMask is_larger = children[i][kArea] > area;
    area = is_larger ? children[i][kArea] : area;
    x = is_larger ? children[i][kX] : x;
    y = is_larger ? children[i][kY] : y;
    z = is_larger ? children[i][kZ] : z;
  }
  FourBlocks sum{};
  for (const FourBlocks& c : children) {
    const Four dx = c[kX] - x, dy = c[kY] - y, dz = c[kZ] - z;
    const FourMask is_far = dx * dx + (dy * dy + dz * dz) > 0.25f * radius * radius;
    const Four weight = is_far ? Four{} : positive(c[kArea]);
    for (std::size_t p = 0; p < kPlanes; ++p) sum[p] += p == kArea ? weight : weight * c[p];
  }
  const FourMask is_there = area > 0;
  const Four scale = 1 / sum[kArea];
  for (std::size_t p = 0; p < kPlanes; ++p) sum[p] = is_there ? (p == kArea ? sum[p] : sum[p] * scale) : Four{};
  return sum;
}

constexpr int kTogether = static_cast<int>(kBlocksTogether);
constexpr int kMostColumnsApart = 3;   // of balls that are summed together

}  // namespace

SurfacePlanes::SurfacePlanes(int width, int rows)
    : width_(width), rows_(rows), groups_((static_cast<std::size_t>(width) + 3 + kBlocksTogether - 1) / kBlocksTogether), values_(groups_ * static_cast<std::size_t>(rows) * kGroupFloats) {}

SurfacePixel SurfacePlanes::at(int x, int y) const {
  const float* value = &values_[index(x, y)];
  const auto one = [&](Plane plane) { return value[plane * kBlocksTogether]; };
  return {{one(kX), one(kY), one(kZ)}, one(kArea), {one(kRed), one(kGreen), one(kBlue)}, {one(kNormalX), one(kNormalY), one(kNormalZ)}, one(kCos)};
}

void SurfacePlanes::set(int x, int y, const SurfacePixel& pixel) {
  float* value = &values_[index(x, y)];
  const auto three = [&](Plane first, const Vec3f& v) {
    for (std::size_t c = 0; c < 3; ++c) value[(first + c) * kBlocksTogether] = v[static_cast<Eigen::Index>(c)];
  };
  three(kX, pixel.position);
  three(kRed, pixel.albedo);
  three(kNormalX, pixel.normal);
  value[kArea * kBlocksTogether] = pixel.area;
  value[kCos * kBlocksTogether] = pixel.cosv;
}

void SurfacePyramid::halve(const SurfacePlanes& fine, float radius, SurfacePlanes& coarse) {
  coarse.fit((fine.width() + 1) / 2, (fine.rows() + 1) / 2);
  const std::size_t groups = fine.row_stride() / kGroupFloats;
  parallel_blocks(static_cast<std::size_t>(coarse.rows()), 8, [&](std::size_t y0, std::size_t y1) {
    for (auto y = static_cast<int>(y0); y < static_cast<int>(y1); ++y) {
      const float *upper = fine.group(0, 2 * y), *lower = 2 * y + 1 < fine.rows() ? fine.group(0, 2 * y + 1) : nullptr;
      for (int x = 0; x < coarse.width(); x += kTogether) {
        const std::size_t group = static_cast<std::size_t>(2 * x) / kBlocksTogether, below = lower ? groups : 0;
        const FourBlocks blocks = merged({every_second(upper, groups, group, false), every_second(upper, groups, group, true), every_second(lower, below, group, false), every_second(lower, below, group, true)}, radius);
        float* to = coarse.group(x, y);
        for (std::size_t p = 0; p < kPlanes; ++p) store_four(blocks[p], to + p * kBlocksTogether);
      }
    }
  });
}

SurfacePyramid::SurfacePyramid(SurfacePlanes pixels, float radius) : SurfacePyramid(std::vector<SurfacePlanes>{std::move(pixels)}, radius) {}

SurfacePyramid::SurfacePyramid(std::vector<SurfacePlanes> levels, float radius) : levels_(std::move(levels)), radius_(radius) {
  levels_.resize(kLevels);
  for (std::size_t i = 1; i < kLevels; ++i) halve(levels_[i - 1], radius, levels_[i]);
}

/// Around a pixel, and the blocks that may be part of it.
struct SurfacePyramid::Ball {
  SurfacePixel centre;
  float inverse_squared = 0;   // 1 / radius²
  int x = 0, level = 0, reach = 0;
  int column() const { return x >> level; }
};

std::optional<SurfacePyramid::Ball> SurfacePyramid::ball_around(int x, int y, float footprint) const {
  if (!(footprint > 0)) return std::nullopt;
  Ball ball{.centre = levels_[0].at(x, y), .x = x};
  if (!(ball.centre.area > 0)) return std::nullopt;
  const float radius_px = radius_in_pixels(radius_, footprint);
  ball.inverse_squared = 1 / (radius_px * footprint * radius_px * footprint);
  ball.level = level_for(radius_px);
  ball.reach = static_cast<int>(std::ceil(radius_px / static_cast<float>(1 << ball.level))) + 1;
  return ball;
}

void SurfacePyramid::means(int y, std::span<const float> footprints, std::span<SurfaceMean> means) const {
  std::array<Ball, kBallsTogether> balls;
  std::size_t num = 0;
  const auto sum = [&] {
    if (num == 0) return;
    const std::array<SurfaceMean, kBallsTogether> found = means_of({balls.data(), num}, y);
    for (std::size_t i = 0; i < num; ++i) means[static_cast<std::size_t>(balls[i].x)] = found[i];
    num = 0;
  };
  for (std::size_t x = 0; x < footprints.size(); ++x) {
    means[x] = {};
    const auto ball = ball_around(static_cast<int>(x), y, footprints[x]);
    if (!ball) continue;
    if (num == kBallsTogether || (num > 0 && (ball->level != balls[0].level || ball->reach != balls[0].reach || ball->column() - balls[0].column() > kMostColumnsApart))) sum();
    balls[num++] = *ball;
  }
  sum();
}

/// Of balls of one level and reach.
std::array<SurfaceMean, kBallsTogether> SurfacePyramid::means_of(std::span<const Ball> balls, int y) const {
  const SurfacePlanes& blocks = levels_[static_cast<std::size_t>(balls[0].level)];
  const int row = y >> balls[0].level, reach = balls[0].reach, y0 = std::max(0, row - reach), y1 = std::min(blocks.rows() - 1, row + reach);
  // The columns of each, by four from the first on: up to three beyond its reach take part where they are near enough, the same ones always.
  std::array<int, kBallsTogether> begin{}, end{};
  for (std::size_t i = 0; i < balls.size(); ++i) {
    begin[i] = std::max(0, balls[i].column() - reach);
    end[i] = begin[i] + (std::min(blocks.width() - 1, balls[i].column() + reach) - begin[i] + kTogether) / kTogether * kTogether;
  }
  const int first = begin[0] / kTogether * kTogether, groups = (end[balls.size() - 1] - first + kTogether - 1) / kTogether;
  BallBatch batch;
  batch.first = blocks.group(first, y0);
  batch.row_stride = blocks.row_stride();
  batch.rows = static_cast<std::size_t>(y1 - y0 + 1);
  batch.groups = static_cast<std::size_t>(groups);
  batch.balls = balls.size();
  for (std::size_t i = 0; i < kBallsTogether; ++i) {
    const Ball& b = balls[std::min(i, balls.size() - 1)];
    for (std::size_t lane = i * kBlocksTogether; lane < (i + 1) * kBlocksTogether; ++lane) {
      batch.x[lane] = b.centre.position.x();
      batch.y[lane] = b.centre.position.y();
      batch.z[lane] = b.centre.position.z();
      batch.inverse_squared[lane] = b.inverse_squared;
      batch.nx[lane] = b.centre.normal.x();
      batch.ny[lane] = b.centre.normal.y();
      batch.nz[lane] = b.centre.normal.z();
    }
  }
  for (int g = 0; g < groups; ++g)
    for (std::size_t lane = 0; lane < kBallLanes; ++lane) {
      const std::size_t i = lane / kBlocksTogether;
      const int column = first + g * kTogether + static_cast<int>(lane % kBlocksTogether);
      batch.within[static_cast<std::size_t>(g)][lane] = column >= begin[i] && column < end[i] ? 1 : BallBatch::kOutside;   // balls that are not there have no columns
    }
  BallSums sums;
  sum_balls(batch, sums);
  std::array<SurfaceMean, kBallsTogether> means;
  for (std::size_t i = 0; i < balls.size(); ++i) {
    SurfaceMean& mean = means[i];
    const SurfacePixel& centre = balls[i].centre;
    const float weight = sum_of_lanes(sums.weight, i), facing = sum_of_lanes(sums.facing, i);
    mean.valid = true;
    mean.albedo = weight > 0 ? Vec3f(Vec3f(sum_of_lanes(sums.red, i), sum_of_lanes(sums.green, i), sum_of_lanes(sums.blue, i)) / weight) : centre.albedo;   // a block whose middle lies beyond the radius: the pixel speaks for itself
    mean.cosv = facing > 0 ? sum_of_lanes(sums.cosv, i) / facing : centre.cosv;
  }
  return means;
}

SurfaceMean SurfacePyramid::mean(int x, int y, float footprint) const {
  const auto ball = ball_around(x, y, footprint);
  return ball ? means_of({&*ball, 1}, y)[0] : SurfaceMean{};
}

int reach_rows(float radius, float smallest_footprint) {
  if (!(smallest_footprint > 0)) return 0;
  const float radius_px = radius_in_pixels(radius, smallest_footprint);
  return static_cast<int>(std::ceil(radius_px)) + 3 * (1 << level_for(radius_px));
}

std::vector<float> distance_to_marked(std::span<const std::uint8_t> marked, int width, int rows, float cap) {
  const auto stride = static_cast<std::size_t>(width);
  const float farthest = std::sqrt(cap * cap);   // as it comes out below
  std::vector<float> distance(marked.size(), farthest);
  if (std::none_of(marked.begin(), marked.end(), [](std::uint8_t mark) { return mark != 0; })) return distance;
  std::vector<float> in_column(marked.size());
  parallel_blocks(stride, 64, [&](std::size_t x0, std::size_t x1) {
    for (std::size_t x = x0; x < x1; ++x) {
      float d = cap;
      for (int y = 0; y < rows; ++y) {
        const std::size_t i = static_cast<std::size_t>(y) * stride + x;
        in_column[i] = d = marked[i] ? 0 : std::min(cap, d + 1);
      }
      d = cap;
      for (int y = rows - 1; y >= 0; --y) {
        const std::size_t i = static_cast<std::size_t>(y) * stride + x;
        d = marked[i] ? 0 : std::min(cap, d + 1);
        in_column[i] = std::min(in_column[i], d);
      }
    }
  });
  parallel_blocks(static_cast<std::size_t>(rows), 8, [&](std::size_t y0, std::size_t y1) {
    for (std::size_t y = y0; y < y1; ++y) {
      const float* row = &in_column[y * stride];
      int before = -width, after = 0;   // the nearest columns that know of a mark
      for (int x = 0; x < width; ++x) {
        while (after < width && (after < x || !(row[after] < cap))) ++after;
        if (row[x] < cap) before = x;
        if (static_cast<float>(x - before) >= cap && (after == width || static_cast<float>(after - x) >= cap)) continue;
        float best = cap * cap;
        for (int dx = 0; static_cast<float>(dx) * static_cast<float>(dx) < best; ++dx) {
          const float across = static_cast<float>(dx) * static_cast<float>(dx);
          if (x - dx >= 0) best = std::min(best, across + row[x - dx] * row[x - dx]);
          if (x + dx < width) best = std::min(best, across + row[x + dx] * row[x + dx]);
        }
        distance[y * stride + static_cast<std::size_t>(x)] = std::sqrt(best);
      }
    }
  });
  return distance;
}

}  // namespace chiaro::blend
