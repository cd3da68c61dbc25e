#include "blend/bands.h"

#include <algorithm>
#include <cmath>

#include "stream/base/parallel.h"

namespace chiaro::blend {
namespace {

constexpr int kLevels = 5;                // blocks of 1 .. kPyramidRows pixels
constexpr float kLeastRadiusBlocks = 4;   // a coarser level is taken from twice this radius on

float radius_in_pixels(float radius, float footprint) { return std::min(kMaxLowRadiusPx, radius / footprint); }

int level_for(float radius_px) {
  int level = 0;
  while (level + 1 < kLevels && radius_px >= 2 * kLeastRadiusBlocks * static_cast<float>(1 << level)) ++level;
  return level;
}

/// Mean of up to four samples by area; those far from the largest belong to another surface.
SurfacePixel merged(const SurfacePixel* const* children, int count, float radius) {
  const SurfacePixel* largest = children[0];
  for (int i = 1; i < count; ++i)
    if (children[i]->area > largest->area) largest = children[i];
  SurfacePixel sum;
  if (!(largest->area > 0)) return sum;
  for (int i = 0; i < count; ++i) {
    const SurfacePixel& c = *children[i];
    if (!(c.area > 0) || (c.position - largest->position).squaredNorm() > 0.25f * radius * radius) continue;
    sum.area += c.area;
    sum.position += c.area * c.position;
    sum.albedo += c.area * c.albedo;
    sum.normal += c.area * c.normal;
    sum.cosv += c.area * c.cosv;
  }
  const float scale = 1 / sum.area;
  sum.position *= scale;
  sum.albedo *= scale;
  sum.normal *= scale;
  sum.cosv *= scale;
  return sum;
}

}  // namespace

SurfacePyramid::Level SurfacePyramid::halve(const Level& fine, float radius) {
  Level coarse{(fine.width + 1) / 2, (fine.rows + 1) / 2, {}};
  coarse.blocks.resize(static_cast<std::size_t>(coarse.width) * static_cast<std::size_t>(coarse.rows));
  parallel_blocks(static_cast<std::size_t>(coarse.rows), 8, [&](std::size_t y0, std::size_t y1) {
    for (auto y = static_cast<int>(y0); y < static_cast<int>(y1); ++y)
      for (int x = 0; x < coarse.width; ++x) {
        const SurfacePixel* children[4] = {};
        int count = 0;
        for (int v = 2 * y; v < std::min(fine.rows, 2 * y + 2); ++v)
          for (int u = 2 * x; u < std::min(fine.width, 2 * x + 2); ++u) children[count++] = &fine.at(u, v);
        coarse.blocks[static_cast<std::size_t>(y) * static_cast<std::size_t>(coarse.width) + static_cast<std::size_t>(x)] = merged(children, count, radius);
      }
  });
  return coarse;
}

SurfacePyramid::SurfacePyramid(std::vector<SurfacePixel> pixels, int width, int rows, float radius) : radius_(radius) {
  levels_.push_back({width, rows, std::move(pixels)});
  while (levels_.size() < kLevels) levels_.push_back(halve(levels_.back(), radius));
}

SurfaceMean SurfacePyramid::mean(int x, int y, float footprint) const {
  SurfaceMean result;
  const SurfacePixel& centre = pixel(x, y);
  if (!(centre.area > 0) || !(footprint > 0)) return result;
  const float radius_px = radius_in_pixels(radius_, footprint), inverse_squared = 1 / (radius_px * footprint * radius_px * footprint);
  const int level = level_for(radius_px), reach = static_cast<int>(std::ceil(radius_px / static_cast<float>(1 << level))) + 1;
  const Level& blocks = levels_[static_cast<std::size_t>(level)];
  const int x0 = std::max(0, (x >> level) - reach), x1 = std::min(blocks.width - 1, (x >> level) + reach);
  const int y0 = std::max(0, (y >> level) - reach), y1 = std::min(blocks.rows - 1, (y >> level) + reach);
  float weights = 0, facing_weights = 0;
  for (int v = y0; v <= y1; ++v) {
    const SurfacePixel* row = &blocks.at(0, v);
    for (int u = x0; u <= x1; ++u) {
      const SurfacePixel& b = row[u];
      const float squared = (b.position - centre.position).squaredNorm() * inverse_squared;
      if (!(squared < 1)) continue;
      const float w = (1 - squared) * b.area;   // 0 where there is nothing
      weights += w;
      result.albedo += w * b.albedo;
      const float facing = w * std::max(0.0f, b.normal.dot(centre.normal));
      facing_weights += facing;
      result.cosv += facing * b.cosv;
    }
  }
  if (!(weights > 0)) return {centre.albedo, centre.cosv, true};   // a block whose middle lies beyond the radius: the pixel speaks for itself
  result.albedo /= weights;
  result.cosv = facing_weights > 0 ? result.cosv / facing_weights : centre.cosv;
  result.valid = true;
  return result;
}

int reach_rows(float radius, float smallest_footprint) {
  if (!(smallest_footprint > 0)) return 0;
  const float radius_px = radius_in_pixels(radius, smallest_footprint);
  return static_cast<int>(std::ceil(radius_px)) + 3 * (1 << level_for(radius_px));
}

std::vector<float> distance_to_marked(std::span<const std::uint8_t> marked, int width, int rows, float cap) {
  const auto stride = static_cast<std::size_t>(width);
  std::vector<float> in_column(marked.size()), distance(marked.size());
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
      for (int x = 0; x < width; ++x) {
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
