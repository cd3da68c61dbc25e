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
SurfacePixel merged(const SurfacePixel* children, int count, float radius) {
  const SurfacePixel* largest = &children[0];
  for (int i = 1; i < count; ++i)
    if (children[i].area > largest->area) largest = &children[i];
  SurfacePixel sum;
  if (!(largest->area > 0)) return sum;
  for (int i = 0; i < count; ++i) {
    const SurfacePixel& c = children[i];
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

using Four = Eigen::Array4f;
using FourAt = Eigen::Map<const Four>;

}  // namespace

SurfacePlanes::SurfacePlanes(int width, int rows) : width_(width), rows_(rows), stride_(static_cast<std::size_t>(width) + 3) {
  for (auto& plane : values_) plane.assign(stride_ * static_cast<std::size_t>(rows), 0);
}

SurfacePixel SurfacePlanes::at(int x, int y) const {
  const std::size_t i = static_cast<std::size_t>(y) * stride_ + static_cast<std::size_t>(x);
  const auto three = [&](Plane first) { return Vec3f(values_[first][i], values_[first + 1u][i], values_[first + 2u][i]); };
  return {three(kX), values_[kArea][i], three(kRed), three(kNormalX), values_[kCos][i]};
}

void SurfacePlanes::set(int x, int y, const SurfacePixel& pixel) {
  const std::size_t i = static_cast<std::size_t>(y) * stride_ + static_cast<std::size_t>(x);
  for (std::size_t c = 0; c < 3; ++c) {
    values_[kX + c][i] = pixel.position[static_cast<Eigen::Index>(c)];
    values_[kRed + c][i] = pixel.albedo[static_cast<Eigen::Index>(c)];
    values_[kNormalX + c][i] = pixel.normal[static_cast<Eigen::Index>(c)];
  }
  values_[kArea][i] = pixel.area;
  values_[kCos][i] = pixel.cosv;
}

SurfacePlanes SurfacePyramid::halve(const SurfacePlanes& fine, float radius) {
  SurfacePlanes coarse((fine.width() + 1) / 2, (fine.rows() + 1) / 2);
  parallel_blocks(static_cast<std::size_t>(coarse.rows()), 8, [&](std::size_t y0, std::size_t y1) {
    for (auto y = static_cast<int>(y0); y < static_cast<int>(y1); ++y)
      for (int x = 0; x < coarse.width(); ++x) {
        SurfacePixel children[4];
        int count = 0;
        for (int v = 2 * y; v < std::min(fine.rows(), 2 * y + 2); ++v)
          for (int u = 2 * x; u < std::min(fine.width(), 2 * x + 2); ++u) children[count++] = fine.at(u, v);
        coarse.set(x, y, merged(children, count, radius));
      }
  });
  return coarse;
}

SurfacePyramid::SurfacePyramid(SurfacePlanes pixels, float radius) : radius_(radius) {
  levels_.push_back(std::move(pixels));
  while (levels_.size() < kLevels) levels_.push_back(halve(levels_.back(), radius));
}

SurfaceMean SurfacePyramid::mean(int x, int y, float footprint) const {
  SurfaceMean result;
  const SurfacePixel centre = levels_[0].at(x, y);
  if (!(centre.area > 0) || !(footprint > 0)) return result;
  const float radius_px = radius_in_pixels(radius_, footprint), inverse_squared = 1 / (radius_px * footprint * radius_px * footprint);
  const int level = level_for(radius_px), reach = static_cast<int>(std::ceil(radius_px / static_cast<float>(1 << level))) + 1;
  const SurfacePlanes& blocks = levels_[static_cast<std::size_t>(level)];
  const int x0 = std::max(0, (x >> level) - reach), x1 = std::min(blocks.width() - 1, (x >> level) + reach);
  const int y0 = std::max(0, (y >> level) - reach), y1 = std::min(blocks.rows() - 1, (y >> level) + reach);
  // Four blocks at a time; up to three beyond x1 take part where they are near enough, the same ones always.
  Four weights = Four::Zero(), red = Four::Zero(), green = Four::Zero(), blue = Four::Zero(), facing_weights = Four::Zero(), cosv = Four::Zero();
  using P = SurfacePlanes;
  for (int v = y0; v <= y1; ++v) {
    std::array<const float*, P::kPlanes> row;
    for (std::size_t p = 0; p < row.size(); ++p) row[p] = blocks.row(static_cast<P::Plane>(p), v);
    for (int u = x0; u <= x1; u += 4) {
      const Four dx = FourAt(row[P::kX] + u) - centre.position.x(), dy = FourAt(row[P::kY] + u) - centre.position.y(), dz = FourAt(row[P::kZ] + u) - centre.position.z();
      const Four w = (1 - (dx * dx + dy * dy + dz * dz) * inverse_squared).max(0.0f) * FourAt(row[P::kArea] + u);   // 0 where there is nothing
      if (!(w > 0).any()) continue;
      weights += w;
      red += w * FourAt(row[P::kRed] + u);
      green += w * FourAt(row[P::kGreen] + u);
      blue += w * FourAt(row[P::kBlue] + u);
      const Four facing = w * (FourAt(row[P::kNormalX] + u) * centre.normal.x() + FourAt(row[P::kNormalY] + u) * centre.normal.y() + FourAt(row[P::kNormalZ] + u) * centre.normal.z()).max(0.0f);
      facing_weights += facing;
      cosv += facing * FourAt(row[P::kCos] + u);
    }
  }
  const float weight = weights.sum(), facing_weight = facing_weights.sum();
  if (!(weight > 0)) return {centre.albedo, centre.cosv, true};   // a block whose middle lies beyond the radius: the pixel speaks for itself
  result.albedo = Vec3f(red.sum(), green.sum(), blue.sum()) / weight;
  result.cosv = facing_weight > 0 ? cosv.sum() / facing_weight : centre.cosv;
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
