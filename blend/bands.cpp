#include "blend/bands.h"

#include <algorithm>
#include <cmath>

#include "stream/base/parallel.h"

namespace chiaro::blend {
namespace {

constexpr int kChannels = FilterPixel::kChannels;
// 2^-30 of a unit: values up to 2^16 over lines of 2^16 pixels stay within 63 bits.
constexpr double kQuantum = 1.0 / (1 << 30), kMaxValue = 65536;

std::int64_t to_integer(float v) {
  const double limited = std::clamp(static_cast<double>(v), -kMaxValue, kMaxValue);
  return std::llround(limited / kQuantum);
}

/// One line of the image with its running sums; buffers are reused from line to line.
struct Line {
  std::vector<std::int64_t> sum;      // (n + 1) * kChannels
  std::vector<int> first, last;       // of the uninterrupted piece that each pixel belongs to
  std::vector<float> half;

  explicit Line(std::size_t n) : sum((n + 1) * kChannels), first(n), last(n), half(n) {}
};

template <class Pixel, class Step, class Stop>
void smooth_line(Line& line, int n, const Pixel& pixel, const Step& half, const Stop& stops_after) {
  for (int c = 0; c < kChannels; ++c) line.sum[static_cast<std::size_t>(c)] = 0;
  for (int i = 0; i < n; ++i) {
    const std::size_t at = static_cast<std::size_t>(i) * kChannels;
    for (int c = 0; c < kChannels; ++c)
      line.sum[at + kChannels + static_cast<std::size_t>(c)] = line.sum[at + static_cast<std::size_t>(c)] + to_integer(pixel(i).value[c]);
    line.first[static_cast<std::size_t>(i)] = i > 0 && !stops_after(i - 1) ? line.first[static_cast<std::size_t>(i - 1)] : i;
    line.half[static_cast<std::size_t>(i)] = half(i);
  }
  for (int i = n - 1; i >= 0; --i) line.last[static_cast<std::size_t>(i)] = i + 1 < n && !stops_after(i) ? line.last[static_cast<std::size_t>(i + 1)] : i;

  for (int i = 0; i < n; ++i) {
    // The box [i + 0.5 - h, i + 0.5 + h] cut to the piece; pixels at its two ends count by the share that lies inside.
    const double h = std::max(0.5f, line.half[static_cast<std::size_t>(i)]);
    const double lo = std::max<double>(i + 0.5 - h, line.first[static_cast<std::size_t>(i)]);
    const double hi = std::min<double>(i + 0.5 + h, line.last[static_cast<std::size_t>(i)] + 1);
    const int first_whole = static_cast<int>(std::ceil(lo)), end_whole = static_cast<int>(std::floor(hi));
    const double share_lo = first_whole - lo, share_hi = hi - end_whole, scale = kQuantum / (2 * h);
    const auto at = [&](int k, int c) { return line.sum[static_cast<std::size_t>(k) * kChannels + static_cast<std::size_t>(c)]; };
    for (int c = 0; c < kChannels; ++c) {
      double sum = static_cast<double>(at(end_whole, c) - at(first_whole, c));
      if (share_lo > 0) sum += share_lo * static_cast<double>(at(first_whole, c) - at(first_whole - 1, c));
      if (share_hi > 0) sum += share_hi * static_cast<double>(at(end_whole + 1, c) - at(end_whole, c));
      pixel(i).value[c] = static_cast<float>(sum * scale);
    }
  }
}

void smooth_rows(std::span<FilterPixel> pixels, std::span<const FilterStep> steps, int width, int rows) {
  parallel_blocks(static_cast<std::size_t>(rows), 8, [&](std::size_t y0, std::size_t y1) {
    Line line(static_cast<std::size_t>(width));
    for (std::size_t y = y0; y < y1; ++y) {
      FilterPixel* p = &pixels[y * static_cast<std::size_t>(width)];
      const FilterStep* s = &steps[y * static_cast<std::size_t>(width)];
      smooth_line(line, width, [&](int i) -> FilterPixel& { return p[i]; }, [&](int i) { return s[i].half_x; }, [&](int i) { return s[i].stop_right; });
    }
  });
}

void smooth_columns(std::span<FilterPixel> pixels, std::span<const FilterStep> steps, int width, int rows) {
  parallel_blocks(static_cast<std::size_t>(width), 16, [&](std::size_t x0, std::size_t x1) {
    Line line(static_cast<std::size_t>(rows));
    const auto stride = static_cast<std::size_t>(width);
    for (std::size_t x = x0; x < x1; ++x) {
      const auto index = [&](int i) { return static_cast<std::size_t>(i) * stride + x; };
      smooth_line(line, rows, [&](int i) -> FilterPixel& { return pixels[index(i)]; }, [&](int i) { return steps[index(i)].half_y; },
                  [&](int i) { return steps[index(i)].stop_below; });
    }
  });
}

}  // namespace

Vec2f box_half_widths(float radius, float footprint, const Vec3f& n) {
  if (!(footprint > 0)) return Vec2f::Zero();
  // A disc with unit normal n reaches radius * sqrt(1 - n_x^2) along x; two boxes of half that give the tent.
  const float half = 0.5f * std::min(kMaxLowRadiusPx, radius / footprint);
  return {half * std::sqrt(std::max(0.0f, 1 - n.x() * n.x())), half * std::sqrt(std::max(0.0f, 1 - n.y() * n.y()))};
}

bool depth_breaks(const DepthSample& a, const DepthSample& b) {
  if (!(a.depth > 0 && b.depth > 0)) return true;
  const float c = std::max(0.05f, std::min(a.cosv, b.cosv));
  const float slope = std::sqrt(std::max(0.0f, 1 - c * c)) / c;
  const float allowed = 2 * std::max(a.footprint, b.footprint) * (0.5f + slope) + std::max(a.radius, b.radius);
  return !(std::abs(a.depth - b.depth) <= allowed);
}

void smooth_surface(std::span<FilterPixel> pixels, std::span<const FilterStep> steps, int width, int rows) {
  for (int pass = 0; pass < 2; ++pass) {
    smooth_columns(pixels, steps, width, rows);
    smooth_rows(pixels, steps, width, rows);
  }
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
